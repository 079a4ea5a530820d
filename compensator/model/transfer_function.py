"""Rational transfer functions with units, and their sampled form.

A path of the thermal model is written, as usual in the field, as a quotient of polynomials in *s* with
the time in **minutes**:

    G(s) = (n_0 + n_1 s + n_2 s² + …) / (d_0 + d_1 s + d_2 s² + …)

and evaluated in the sampled form that Tustin's rule makes of it at the sample period *T*,

    s = (2/T) · (1 − z⁻¹) / (1 + z⁻¹),    G(z) = (b_0 + b_1 z⁻¹ + …) / (1 + a_1 z⁻¹ + …).

All coefficient arithmetic is plain float arithmetic in a fixed order, so that two machines with the
same model file get the same bits: an audit depends on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from compensator.arrays import ComplexVector, Vector
from compensator.errors import ModelError


def _trimmed(coefficients: Sequence[float]) -> tuple[float, ...]:
    """Drop zero coefficients of the highest powers (ascending order)."""
    values = [float(c) for c in coefficients]
    while len(values) > 1 and values[-1] == 0.0:
        values.pop()
    return tuple(values)


def _product(p: Sequence[float], q: Sequence[float]) -> list[float]:
    result = [0.0] * (len(p) + len(q) - 1)
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            result[i + j] += a * b
    return result


def _power(p: Sequence[float], exponent: int) -> list[float]:
    result = [1.0]
    for _ in range(exponent):
        result = _product(result, p)
    return result


def _substituted(
    coefficients: Sequence[float], order: int, top: Sequence[float], bottom: Sequence[float]
) -> list[float]:
    """Substitute top/bottom for the variable of an ascending polynomial, times bottom^order."""
    result = [0.0] * (order + 1)
    for power, coefficient in enumerate(coefficients):
        term = _product(_power(top, power), _power(bottom, order - power))
        for i, t in enumerate(term):
            result[i] += coefficient * t
    return result


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledTransferFunction:
    """A transfer function in z⁻¹ at a fixed sample period.

    Parameters
    ----------
    b : tuple of float
        Numerator, ascending powers of z⁻¹; `b[0]` is the direct feed-through.
    a : tuple of float
        Denominator, ascending powers of z⁻¹, `a[0] == 1`.
    period_s : float
        Sample period, s.
    """

    b: tuple[float, ...]
    a: tuple[float, ...]
    period_s: float

    def __post_init__(self) -> None:
        if not self.b or not self.a or self.a[0] != 1.0:
            raise ModelError("a sampled transfer function needs a numerator and a denominator that starts with 1")
        if not all(math.isfinite(c) for c in (*self.b, *self.a)):
            raise ModelError("a sampled transfer function has a coefficient that is not finite")

    @property
    def order(self) -> int:
        """Number of states."""
        return max(len(self.b), len(self.a)) - 1

    @property
    def dc_gain(self) -> float:
        """Gain at rest, Σb / Σa."""
        return math.fsum(self.b) / math.fsum(self.a)

    def poles(self) -> ComplexVector:
        """Return the poles in the z plane."""
        return np.roots(self.a).astype(np.complex128)

    def zeros(self) -> ComplexVector:
        """Return the zeros in the z plane."""
        return np.roots(self.b).astype(np.complex128)

    def time_constants_min(self) -> list[float]:
        """Return the time constants of Tustin's continuous image, ascending, min; 0 for a pole that has none.

        *τ = T/2 · (1 + p) / (1 − p)* with the magnitude of each pole.
        """
        half = self.period_s / 120.0
        sizes = np.abs(self.poles())
        return sorted(float(half * (1.0 + p) / (1.0 - p)) if 0.0 < p < 1.0 else 0.0 for p in sizes)

    def is_stable(self) -> bool:
        """Return whether every pole lies inside the unit circle."""
        return bool(np.all(np.abs(self.poles()) < 1.0))

    def check_stable(self) -> None:
        """Refuse poles outside of the unit circle.

        Raises
        ------
        ModelError
            Naming the worst of them.
        """
        if not self.is_stable():
            raise ModelError(f"unstable: pole at z = {max(self.poles(), key=abs):.6g}, expected |z| < 1")

    def times(self, other: SampledTransferFunction) -> SampledTransferFunction:
        """Return this function and another of the same period in series."""
        return SampledTransferFunction(
            b=tuple(_product(self.b, other.b)), a=tuple(_product(self.a, other.a)), period_s=self.period_s
        )

    def observer_form(self) -> tuple[tuple[float, ...], tuple[float, ...], float]:
        """Return the observer canonical state space.

            x_i[k+1] = x_{i+1}[k] − a_i x_1[k] + B_i u[k],    y[k] = x_1[k] + D u[k]

        Returns
        -------
        a : tuple of float
            `a_1 … a_n`.
        B : tuple of float
            `b_i − a_i b_0` for i = 1 … n.
        D : float
            `b_0`.
        """
        n = self.order
        b = (*self.b, *([0.0] * (n + 1 - len(self.b))))
        a = (*self.a, *([0.0] * (n + 1 - len(self.a))))
        return a[1:], tuple(b[i] - a[i] * b[0] for i in range(1, n + 1)), b[0]

    def response(self, u: npt.ArrayLike) -> Vector:
        """Compute the response from rest to a whole input record.

        Parameters
        ----------
        u : array_like, shape (n,)
            Input at each sample.

        Returns
        -------
        numpy.ndarray, shape (n,)
            Output at each sample.

        Examples
        --------
        >>> SampledTransferFunction(b=(0.5,), a=(1.0, -0.5), period_s=60.0).response([1, 1, 1])
        array([0.5  , 0.75 , 0.875])
        """
        return _filtered(self.b, self.a, u)

    def inverse_response(self, y: npt.ArrayLike) -> Vector:
        """Compute the input, from rest, that gives an output record; needs `b[0]` other than 0.

        Parameters
        ----------
        y : array_like, shape (n,)
            Output at each sample.

        Returns
        -------
        numpy.ndarray, shape (n,)
            Input at each sample.

        Examples
        --------
        >>> SampledTransferFunction(b=(0.5,), a=(1.0, -0.5), period_s=60.0).inverse_response([0.5, 0.75, 0.875])
        array([1., 1., 1.])
        """
        return _filtered(self.a, self.b, y)


def _filtered(b: Sequence[float], a: Sequence[float], values: npt.ArrayLike) -> Vector:
    from scipy.signal import lfilter  # here, because the service never needs it and it costs 40 MB

    return np.asarray(lfilter(b, a, np.asarray(values, dtype=float)), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferFunction:
    """A transfer function in s, time in minutes, with a unit.

    Parameters
    ----------
    numerator, denominator : tuple of float
        Ascending powers of s, s in 1/min.
    unit : str
        Unit of the gain, such as `um/W`.

    Raises
    ------
    ModelError
        If it is not proper, or a coefficient is not finite.

    Examples
    --------
    >>> first_order = TransferFunction(numerator=(-3.0,), denominator=(1.0, 100 / 60), unit="um/K")
    >>> first_order.dc_gain, [round(t, 3) for t in first_order.time_constants_min()]
    (-3.0, [1.667])
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    unit: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "numerator", _trimmed(self.numerator))
        object.__setattr__(self, "denominator", _trimmed(self.denominator))
        if not all(math.isfinite(c) for c in (*self.numerator, *self.denominator)):
            raise ModelError("a transfer function has a coefficient that is not finite")
        if self.denominator == (0.0,):
            raise ModelError("a transfer function has a denominator of zero")
        if len(self.numerator) > len(self.denominator):
            raise ModelError(
                f"a transfer function has numerator degree {len(self.numerator) - 1} above "
                f"denominator degree {len(self.denominator) - 1}; it must be proper"
            )

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.denominator) - 1

    @property
    def dc_gain(self) -> float:
        """Gain at rest, in `unit`."""
        return self.numerator[0] / self.denominator[0] if self.denominator[0] else math.inf

    def poles_per_min(self) -> ComplexVector:
        """Return the poles, 1/min."""
        return np.roots(self.denominator[::-1]).astype(np.complex128)

    def zeros_per_min(self) -> ComplexVector:
        """Return the zeros, 1/min."""
        return np.roots(self.numerator[::-1]).astype(np.complex128)

    def time_constants_min(self) -> list[float]:
        """Return −1/Re(pole) for every pole, ascending, minutes."""
        return sorted(float(-1.0 / p.real) if p.real else math.inf for p in self.poles_per_min())

    def sampled(self, period_s: float) -> SampledTransferFunction:
        """Apply Tustin's rule.

        Parameters
        ----------
        period_s : float
            Sample period, s.

        Returns
        -------
        SampledTransferFunction
            Normalised to a leading denominator coefficient of 1.

        Raises
        ------
        ModelError
            If a pole sits at the rule's singular point s = 2/T.
        """
        rate = 2.0 / (period_s / 60.0)
        b, a = (
            _substituted([c * rate**k for k, c in enumerate(polynomial)], self.order, [1.0, -1.0], [1.0, 1.0])
            for polynomial in (self.numerator, self.denominator)
        )
        if a[0] == 0.0:
            raise ModelError(f"a pole at s = {rate:g}/min cannot be sampled at {period_s:g} s")
        return SampledTransferFunction(
            b=tuple(c / a[0] for c in b), a=(1.0, *(c / a[0] for c in a[1:])), period_s=period_s
        )


def continuous_image(sampled: SampledTransferFunction, *, unit: str) -> TransferFunction:
    """Undo Tustin's rule.

        z⁻¹ = (1 − sT/2) / (1 + sT/2)

    Parameters
    ----------
    sampled : SampledTransferFunction
        What was identified at the sample period.
    unit : str
        Unit of the gain.

    Returns
    -------
    TransferFunction
        The function in s (1/min) whose Tustin image is `sampled`, highest denominator coefficient 1.

    Raises
    ------
    ModelError
        If a pole sits at z = −1, which has no image.
    """
    half = sampled.period_s / 60.0 / 2.0
    numerator, denominator = (
        _substituted(polynomial, sampled.order, [1.0, -half], [1.0, half]) for polynomial in (sampled.b, sampled.a)
    )
    lead = denominator[-1]
    if abs(lead) < 1e-14 * max(abs(c) for c in denominator):
        raise ModelError("a pole at z = -1 has no continuous image")
    return TransferFunction(
        numerator=tuple(c / lead for c in numerator),
        denominator=tuple(c / lead for c in denominator),
        unit=unit,
    )
