"""The TTF: from the known heat to T_Q − AT, with an inverse that the service can use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Mask, Vector
from compensator.data.runs import Run
from compensator.errors import DataError, ModelError
from compensator.identify.output_error import OutputErrorFit, Segment, Structure
from compensator.identify.rest import settle_starts
from compensator.model.thermal_model import check_inverse
from compensator.model.transfer_function import SampledTransferFunction


@dataclass(frozen=True, slots=True, kw_only=True)
class TemperatureFit:
    """A TTF and the properties of its inverse.

    Parameters
    ----------
    fit : OutputErrorFit
        Fit from heat to T_Q − AT.
    segments : tuple of Segment
        Data of the fit.
    held_out_k : float
        Root mean square of the free-run error on held-out folds, K.
    noise_gain_w_per_k : float
        Standard deviation of the inverse's output for white noise of 1 K on T_Q − AT, W/K.
    remark : str
        Change of the structure that made the inverse usable; empty without one.
    """

    fit: OutputErrorFit
    segments: tuple[Segment, ...]
    held_out_k: float
    noise_gain_w_per_k: float
    remark: str

    @property
    def function(self) -> SampledTransferFunction:
        """The TTF."""
        return self.fit.function()

    def heat(self, difference_k: Vector) -> Vector:
        """Return the heat from T_Q − AT by the inverse, from rest, W."""
        return self.function.inverse_response(difference_k)


def fit_temperature(
    runs: Sequence[Run],
    used: Sequence[Mask],
    ttf: tuple[int, int, int],
    *,
    period_s: float,
    folds: int,
) -> TemperatureFit:
    """Fit a TTF whose inverse is causal, stable and does not ring.

    If the inverse of the requested structure is not usable, numerator terms are removed until it is. With a single
    term it always is; the loss of accuracy shows in the fit.

    Parameters
    ----------
    runs : sequence of Run
        Runs; those with known heat are used.
    used : sequence of array of bool
        Samples of each run that are fitted.
    ttf : tuple of int
        nb, nf, nk.
    period_s : float
        Sample period, s.
    folds : int
        Blocks for the held-out error.

    Raises
    ------
    DataError
        If no numerator gives a usable inverse.
    """
    free = [
        Segment.of(run.heat_w, run.difference_k, mask)
        for run, mask in zip(runs, used, strict=True)
        if run.heat_w is not None
    ]
    terms, order, _ = ttf
    remark = ""
    for nb in range(terms, 0, -1):
        structure = Structure(order=order, terms=(nb,))
        segments, found = settle_starts(free, structure, period_s, folds)
        result = found.whole
        function = result.function()
        try:
            check_inverse("the TTF", function)
        except ModelError as error:
            remark = f"TTF with nb {terms}: {error}; fitted with nb {nb - 1} instead"
            continue
        errors = np.concatenate(found.errors)
        return TemperatureFit(
            fit=result,
            segments=tuple(segments),
            held_out_k=float(np.sqrt(np.mean(errors**2))),
            noise_gain_w_per_k=noise_gain(function),
            remark=remark,
        )
    raise DataError(
        f"no usable inverse: {remark}. Check that t_q_degc is near the heat source, and that heat_w is its heat."
    )


def noise_gain(function: SampledTransferFunction) -> float:
    """Return the standard deviation of the inverse's output for white noise of 1 at its input.

    Examples
    --------
    >>> round(noise_gain(SampledTransferFunction(b=(0.5,), a=(1.0,), period_s=60.0)), 6)
    2.0
    """
    impulse = np.zeros(5000)
    impulse[0] = 1.0
    return float(np.linalg.norm(function.inverse_response(impulse)))
