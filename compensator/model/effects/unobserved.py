"""`unobserved`: something acts that no channel shows: when, how fast, how large.

    y += Σ_k size_k · L(τ) · H(t − t_k)

A source that acts through a lag, switched on and off at times that no channel shows. It cannot be deployed: when it
will be switched next is not known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compensator.arrays import Matrix
from compensator.model.effects.base import Effect, register
from compensator.model.effects.blocks import Block, Lag
from compensator.model.effects.seen import Seen, digits
from compensator.model.effects.signals import RecordSignals


@register
class Unobserved(Effect):
    """Steps through a common lag; the diagnosis finds their times, because that needs the residual.

    Parameters
    ----------
    tau_min : float
        The lag, min.
    times : tuple of (int, float)
        Record and time, min, of each switching.
    sizes_um : tuple of float
        Size of each, µm.
    """

    kind = "unobserved"
    linear = ("sizes_um",)
    deployable = False
    observed = False
    jumps = True
    # So free a form finds something in every residual.
    worth, worth_with_others = 0.15, 0.75
    tau_min: float = 1.0
    times: tuple[tuple[int, float], ...] = ()
    sizes_um: tuple[float, ...] = ()

    def columns(self, record: RecordSignals, blocks: Sequence[Block]) -> Matrix:
        columns = []
        for number, at in self.times:
            step = np.clip((record.minutes - at) / record.period_min + 1.0, 0.0, 1.0)
            columns.append(Lag(self.tau_min, record.period_min).filter(step * float(number == record.number)))
        return np.column_stack(columns)

    def explain(self, seen: Seen) -> str:
        first, count = min(at for _, at in self.times) / 60.0, len(self.times)
        return (
            f"{seen.words}: something acts that no channel shows, switched {count} time{'s' * (count > 1)} from "
            f"{first:.1f} h on, with a lag of {digits(self.tau_min)} min. Find what runs then (pump, cooler, drive, "
            "sun) and log a channel of it."
        )
