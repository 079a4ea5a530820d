"""Thermal error compensation for machine tools."""

import os

__version__ = "0.1.0"

# Matrices here are small: further threads of BLAS gain nothing and, on a busy machine, spend their time waiting.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
