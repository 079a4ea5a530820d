"""Coefficients, gains and time constants of two models, compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from compensator.arrays import NAN, Vector
from compensator.errors import ModelError
from compensator.model.thermal_model import Path, ThermalModel
from compensator.model.transfer_function import SampledTransferFunction, TransferFunction, continuous_image


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One figure of a path in both models.

    Parameters
    ----------
    path : str
        TTF, DTF or TDTF.
    figure : str
        Name of the coefficient, gain or time constant, with its unit.
    found, std, reference : float
        Identified value, its standard error (NaN without a covariance), and the other model's value.
    """

    path: str
    figure: str
    found: float
    std: float
    reference: float

    @property
    def deviations(self) -> float:
        """Difference in standard errors."""
        return (self.found - self.reference) / self.std if self.std > 0 else NAN


def compare(found: ThermalModel, reference: ThermalModel) -> list[Row]:
    """Compare the paths of two models as functions of s with a highest denominator coefficient of 1.

    Parameters
    ----------
    found, reference : ThermalModel
        The identified model and the reference.

    Returns
    -------
    list of Row
        Gain at rest and time constants of each path that both models have; coefficients if the orders are equal.
    """
    rows: list[Row] = []
    for name in ("TTF", "DTF", "TDTF"):
        first: Path | None = getattr(found, name.lower())
        second: Path | None = getattr(reference, name.lower())
        if first is not None and second is not None and first.unit == second.unit:
            rows += _rows(name, first, second)
    return rows


class _Figure(NamedTuple):
    """A figure of a path of some order: its gain, or a time constant or coefficient by number."""

    quantity: Literal["gain", "tau", "numerator", "denominator"]
    number: int = 0
    order: int = 0

    def label(self, unit: str) -> str:
        """Return its name, with its unit."""
        if self.quantity == "gain":
            return f"gain at rest, {unit}"
        if self.quantity == "tau":
            return f"time constant {self.number} of {self.order}, min"
        return f"{self.quantity} s^{self.number} of {self.order}"


def _rows(name: str, found: Path, reference: Path) -> Iterator[Row]:
    mine, other = _figures(found.in_s()), _figures(reference.in_s())
    stds = _standard_errors(found, list(mine))
    unit = found.unit.replace("um", "µm")
    for figure, value in mine.items():
        if figure in other:
            label = figure.label(unit)
            yield Row(path=name, figure=label, found=value, std=stds[figure], reference=other[figure])


def _figures(function: TransferFunction) -> dict[_Figure, float]:
    order = function.order
    figures = {_Figure("gain"): function.dc_gain}
    for i, tau in enumerate(function.time_constants_min(), start=1):
        figures[_Figure("tau", i, order)] = tau
    lead = function.denominator[-1]
    figures |= {_Figure("numerator", i, order): value / lead for i, value in enumerate(function.numerator)}
    figures |= {_Figure("denominator", i, order): value / lead for i, value in enumerate(function.denominator[:order])}
    return figures


def _standard_errors(path: Path, figures: list[_Figure]) -> dict[_Figure, float]:
    """Propagate the covariance of b and a by central differences; the gain has its own standard error."""
    if path.covariance is None:
        return dict.fromkeys(figures, NAN)
    covariance = np.array(path.covariance)
    sampled = path.sampled
    values = np.array([*sampled.b, *sampled.a[1:]])
    steps = 1e-7 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    gradient = np.zeros((len(figures), values.size))
    for i, step in enumerate(steps):
        if step == 0.0:
            continue
        above, below = (_moved(path, values, i, side * step) for side in (1.0, -1.0))
        gradient[:, i] = [(above.get(figure, NAN) - below.get(figure, NAN)) / (2.0 * step) for figure in figures]
    variance = np.einsum("ij,jk,ik->i", gradient, covariance, gradient)
    found = dict(zip(figures, np.sqrt(np.maximum(variance, 0.0)).tolist(), strict=True))
    return found | {_Figure("gain"): path.gain_with_std()[1]}


def _moved(path: Path, values: Vector, index: int, step: float) -> dict[_Figure, float]:
    moved = values.copy()
    moved[index] += step
    count = len(path.sampled.b)
    sampled = SampledTransferFunction(
        b=tuple(moved[:count].tolist()), a=(1.0, *moved[count:].tolist()), period_s=path.sampled.period_s
    )
    try:
        return _figures(continuous_image(sampled, unit=path.unit))
    except ModelError:
        return {}
