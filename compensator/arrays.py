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


def stretches_of(mask: Mask) -> list[tuple[int, int]]:
    """Return the first and past last sample of each stretch of a mask.

    Examples
    --------
    >>> stretches_of(np.array([True, False, True, True]))
    [(0, 1), (2, 4)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(int), [0])))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def rms_of(values: Vector) -> float:
    """Return the root mean square of the values that are not missing.

    Examples
    --------
    >>> rms_of(np.array([3.0, NAN, -3.0]))
    3.0
    """
    return float(np.sqrt(np.nanmean(values**2)))
