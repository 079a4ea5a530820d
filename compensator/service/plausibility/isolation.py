"""Fault isolation: whether T_Q, AT, measured Y or the model explains a residual best.

A fault of T_Q or AT acts on the residual through the model, so its shape in time is the model's response to a ramp or
a step in that input. A fault of the probe is itself a ramp or step. A wrong gain of the model, or a probe with another
scale, appears as a fraction of the prediction. Size and onset of every shape are fitted and the likelihoods compared;
every fault whose likelihood is at least 1/20 of the best is a suspect.

Model errors are correlated in time, so residual and shapes first pass the same first-order whitening filter. Sums go
block by block, for all shapes and onsets at once, so that an audit finds the same suspects on another processor.

Source: Basseville and Nikiforov, Detection of Abrupt Changes (1993), chapter 7 (generalised likelihood ratio).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.model.engine import Engine
from compensator.model.thermal_model import ThermalModel

#: Suspects whose log likelihood is within this of the best cannot be distinguished from it: odds of 20.
LOG_ODDS = 3.0
#: Remaining mean square with the best shape, relative to the expected one, above which no shape fits.
MISFIT = 4.0
#: Part of a residual that a sensor's fault must explain to be suspected where no shape fits. A fault of another shape,
#: such as T_Q that has come off, explains more of it; an effect of the machine that comes and goes soon leaves less.
LEAST_SHARE = 0.75
#: Samples without a change before a response is computed, so that the observer's gains have settled.
_SETTLING = 120


@dataclass(frozen=True, slots=True)
class ResidualBlock:
    """Means of a few samples, µm: the residual (NaN if too few were usable), its standard deviation, the prediction."""

    residual_um: float
    std_um: float
    predicted_um: float


@dataclass(frozen=True, slots=True)
class FaultFit:
    """How well one shape explains a residual.

    Parameters
    ----------
    suspect : str
        `t_q_degc`, `at_degc`, `y_um` or `model`.
    words : str
        The fault with its size, such as `T_Q drifts by +0.1 K/h`.
    blocks_ago : int
        Number of blocks since it started.
    gain : float
        Log likelihood over that of no fault.
    share : float
        Part of the whitened residual's square that it explains.
    """

    suspect: str
    words: str
    blocks_ago: int
    gain: float
    share: float = 0.0


#: Number of a block, its whitened value times its weight, and the weight.
_Whitened = tuple[int, float, float]


@dataclass(frozen=True, slots=True)
class _Shape:
    suspect: str
    unit: str
    what: str
    values: tuple[float, ...]


class FaultIsolation:
    """Fits the fault shapes of one model to residuals.

    Parameters
    ----------
    model : ThermalModel
        The running model.
    block_samples, window : int
        Samples in a block, and number of blocks.
    keep : float
        Correlation of the residuals of two consecutive blocks.
    """

    def __init__(self, model: ThermalModel, block_samples: int, window: int, keep: float) -> None:
        self._model = model
        self._samples = block_samples
        self._window = window
        self._keep = keep
        self._hours = block_samples * model.period_s / 3600.0

    def fits(self, blocks: Sequence[ResidualBlock]) -> tuple[list[FaultFit], bool]:
        """Return the best fit of each suspect, the most likely first, and whether even the best fits badly.

        Parameters
        ----------
        blocks : sequence of ResidualBlock
            The newest last.
        """
        z = [block.residual_um / block.std_um for block in blocks]
        whitened = _whitened(z, self._keep)
        stds = np.array([block.std_um for block in blocks])
        moved = self._moved[: len(blocks), : len(blocks) - 1]
        sizes, gains = _fitted(whitened, moved / stds[:, None, None], self._keep)
        best: dict[str, tuple[float, float, _Shape, int]] = {}
        for begin, row in enumerate(gains.tolist()):
            for i, (shape, gain) in enumerate(zip(self._shapes, row, strict=True)):
                if shape.suspect not in best or gain > best[shape.suspect][0]:
                    best[shape.suspect] = gain, float(sizes[begin, i]), shape, begin
        fits = [
            FaultFit(shape.suspect, f"{shape.what} by {size:+.2g} {shape.unit}", len(blocks) - begin, gain)
            for gain, size, shape, begin in best.values()
        ]
        ranked = sorted([*fits, self._as_prediction(blocks, whitened)], key=lambda fit: (-fit.gain, fit.suspect))
        energy, count = _energy(z, self._keep)
        if energy > 0.0:
            ranked = [dataclasses.replace(fit, share=fit.gain / energy) for fit in ranked]
        left = 2.0 * (energy - ranked[0].gain)
        return ranked, count > 0 and left > MISFIT * count

    def _as_prediction(self, blocks: Sequence[ResidualBlock], whitened: Sequence[_Whitened]) -> FaultFit:
        v = np.array([block.predicted_um / block.std_um for block in blocks])
        size, gain = (float(found) for found in _fitted(whitened, v, self._keep))
        words = f"measured Y is {1.0 + size:.2f} times the prediction"
        return FaultFit("model", words, len(blocks), gain)

    @cached_property
    def _shapes(self) -> tuple[_Shape, ...]:
        """The faults' effects on the residual."""
        made = []
        for suspect, t_q, at in (("t_q_degc", 1.0, 0.0), ("at_degc", 0.0, 1.0)):
            name = "T_Q" if t_q else "AT"
            made.append(_Shape(suspect, "K/h", f"{name} drifts", self._response(t_q, at, ramp=True)))
            made.append(_Shape(suspect, "K", f"{name} jumped", self._response(t_q, at, ramp=False)))
        hours = tuple((i + 0.5) * self._hours for i in range(self._window))
        made.append(_Shape("y_um", "µm/h", "measured Y drifts", hours))
        made.append(_Shape("y_um", "µm", "measured Y jumped", (1.0,) * self._window))
        return tuple(made)

    @cached_property
    def _moved(self) -> Matrix:
        """The shapes by block, for each block that they may begin in, shape (blocks, begins, shapes)."""
        found = np.zeros((self._window, self._window, len(self._shapes)))
        for i, shape in enumerate(self._shapes):
            for begin in range(self._window):
                found[begin:, begin, i] = shape.values[: self._window - begin]
        return found

    def _response(self, t_q_k: float, at_k: float, *, ramp: bool) -> tuple[float, ...]:
        """Return the effect of a sensor fault on the residual, µm by block: minus its effect on the prediction."""
        engine = Engine(dataclasses.replace(self._model, effects=(), parts=(), outputs=()))
        engine.set_reference(0.0, 0.0)
        for _ in range(_SETTLING):
            engine.step(0.0, 0.0)
        values = []
        per_sample = self._model.period_s / 3600.0
        for block in range(self._window):
            total = 0.0
            for i in range(self._samples):
                size = (block * self._samples + i + 1) * per_sample if ramp else 1.0
                total -= engine.step(size * t_q_k, size * at_k).y_um
            values.append(total / self._samples)
        return tuple(values)


def _whitened(z: Sequence[float], keep: float) -> list[_Whitened]:
    """Return the values that are not missing, whitened: the number of each, its value times its weight, its weight."""
    found: list[_Whitened] = []
    weight, before = 1.0, 0.0
    for i, zi in enumerate(z):
        if not math.isnan(zi):
            found.append((i, weight * (zi - keep * before), weight))
            weight, before = 1.0 / (1.0 - keep * keep), zi
    return found


def _fitted(z: Sequence[_Whitened], v: Vector, keep: float) -> tuple[Vector, Vector]:
    """Return size and log likelihood gain of shapes, by block along the first axis; missing blocks are left out."""
    cross, square, before = (np.zeros(v.shape[1:]) for _ in range(3))
    for i, weighted, weight in z:
        ev = v[i] - keep * before
        cross += weighted * ev
        square += weight * ev * ev
        before = v[i]
    explains = square > 0.0
    divided = np.where(explains, square, 1.0)
    return np.where(explains, cross / divided, 0.0), np.where(explains, 0.5 * cross * cross / divided, 0.0)


def _energy(z: Sequence[float], keep: float) -> tuple[float, int]:
    """Return half the whitened square of a residual, and the number of blocks."""
    total, count, before = 0.0, 0, math.nan
    for zi in z:
        if math.isnan(zi):
            continue
        e = zi if math.isnan(before) else (zi - keep * before) / math.sqrt(1.0 - keep * keep)
        total += 0.5 * e * e
        count += 1
        before = zi
    return total, count
