"""Audits recordings: complete, unchanged, and reproduced to the bit by the engine from the raw samples."""
