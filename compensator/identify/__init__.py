"""Identification: from measured runs to a thermal model with standard errors, held-out errors and warnings."""
