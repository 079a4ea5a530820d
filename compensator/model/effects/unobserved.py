"""`unobserved`: something acts that no channel shows: when, how fast, how large.

    y += Σ_k size_k · L(τ) · H(t − t_k)

A source that is switched on and off at times that no channel tells, behind a lag. It is not deployable: nobody
knows when it will be switched next.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from compensator.arrays import Matrix
from compensator.model.effects.hypothesis import Hypothesis, RecordSignals, lowpass, shown


@dataclass(frozen=True, slots=True, kw_only=True)
class Unobserved(Hypothesis):
    """Steps behind a common lag; the search for their times is the diagnosis's, because it needs the residual.

    Parameters
    ----------
    times : tuple of (int, float)
        Record and time, min, of each switching.
    sizes : tuple of int
        Samples of each record, to know which one a `RecordSignals` is.
    """

    kind: ClassVar[str] = "unobserved"
    deployable: ClassVar[bool] = False
    # So free a form finds something in every residual.
    worth: ClassVar[float] = 0.15
    times: tuple[tuple[int, float], ...] = ()
    order: tuple[int, ...] = ()

    @property
    def parameters(self) -> int:
        """Number of parameters: the lag, and time and size of each switching."""
        return 1 + 2 * len(self.times)

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return each switching behind the lag; zero in other records than its own."""
        record = self.order.index(id(waves)) if id(waves) in self.order else 0
        minutes = np.arange(waves.size, dtype=np.float64) * waves.period_min
        columns = []
        for where, at in self.times:
            step = np.clip((minutes - at) / waves.period_min + 1.0, 0.0, 1.0) * float(where == record)
            columns.append(lowpass(np.asarray(step), values[0], waves.period_min))
        return np.column_stack(columns)

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say when, how fast and how large."""
        largest = max((abs(v) for n, v in named.items() if n.startswith("size")), default=0.0)
        first = min(at for _, at in self.times) / 60.0
        return (
            f"Something acts that no channel shows: from {first:.1f} h on it was switched {len(self.times)} times and "
            f"moves Y by up to {shown(largest)} µm with a lag of {shown(named['tau_min'])} min ({rms_um:.2g} µm rms). "
            "Find what runs then (pump, cooler, drive, sun) and log a channel of it."
        )
