"""Diagnosis: trace a residual to an effect that the model lacks, and add that effect."""
