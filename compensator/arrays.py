"""Array types for signatures, and constants and figures that all packages share."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

#: A missing value.
NAN = math.nan
#: Larger than any measurement, coefficient, gain or noise; powers of larger numbers would not be finite.
LARGEST = 1e30

#: One number for each sample or parameter, shape (n,).
Vector = npt.NDArray[np.float64]
#: Rows and columns of numbers, shape (n, m).
Matrix = npt.NDArray[np.float64]
#: Which samples take part, shape (n,).
Mask = npt.NDArray[np.bool_]
#: Indices of samples, shape (n,).
Indices = npt.NDArray[np.int_]
#: Poles and zeros, shape (n,).
ComplexVector = npt.NDArray[np.complex128]


def rms_of(values: Vector) -> float:
    """Return the root mean square of the values that are not missing.

    Examples
    --------
    >>> rms_of(np.array([3.0, NAN, -3.0]))
    3.0
    """
    return float(np.sqrt(np.nanmean(values**2)))
