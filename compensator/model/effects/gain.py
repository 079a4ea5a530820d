"""`gain`: a path is there, its strength is wrong:  y += change · y_path."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from compensator.arrays import Matrix
from compensator.model.effects.base import Effect, Signals, register
from compensator.model.effects.hypothesis import Hypothesis, RecordSignals, Setting, proposes, shown
from compensator.model.effects.table import Table


@register("gain")
class GainEffect:
    """The streaming side."""

    kind = "gain"
    channels: tuple[str, ...] = ()

    def __init__(self, table: Mapping[str, Any]) -> None:
        keys = Table("gain", table, ("path", "change"))
        self._tdtf = keys.text("path", ("DTF", "TDTF")) == "TDTF"
        self._change = keys.number("change", -10.0, 10.0)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], period_s: float) -> Effect:
        """Make the effect from its table in the model file."""
        del period_s
        return cls(table)

    def step(self, signals: Signals) -> float:
        """Return the part of the path's share that is missing."""
        return self._change * (signals.y_tdtf_um if self._tdtf else signals.y_dtf_um)

    def snapshot(self) -> tuple[float, ...]:
        """Return the state: none."""
        return ()

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GainHypothesis(Hypothesis):
    """The side of a whole record."""

    kind: ClassVar[str] = "gain"

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return the path's share."""
        return waves.share(self.path)[:, None]

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        return {"path": self.path, "change": amplitudes[0]}

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what is wrong."""
        return (
            f"The {self.path} is {shown(100.0 * named['change'])} % too "
            f"{'weak' if named['change'] > 0 else 'strong'} ({rms_um:.2g} µm rms): the machine answers with another "
            "strength than at the calibration."
        )


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose every path."""
    for path in setting.paths:
        yield GainHypothesis(path=path, amplitudes=("change",))
