"""`hysteresis`: a path sticks and slips.

play    y += P_w(y_path) − y_path, P_w follows once a play of half-width w is taken up
stick   the same, but it jumps all the way once the force is w
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compensator.arrays import Vector
from compensator.model.effects.base import Effect, Signals, register
from compensator.model.effects.hypothesis import Free, Hypothesis, RecordSignals, Setting, proposes, shown
from compensator.model.effects.table import Table

FORMS = ("play", "stick")


def followed(form: str, at: float, wanted: float, half: float) -> float:
    """Return where it stands after one step."""
    if form == "play":
        return min(max(at, wanted - half), wanted + half)
    return wanted if abs(wanted - at) > half else at


def _trace(form: str, share: Vector, half: float) -> Vector:
    """Return where it stands after each step: `followed` over a record, without a call for each sample."""
    at, out = 0.0, []
    if form == "stick":
        for wanted in share.tolist():
            if not -half <= wanted - at <= half:
                at = wanted
            out.append(at)
        return np.array(out)
    for wanted in share.tolist():
        if at < wanted - half:
            at = wanted - half
        elif at > wanted + half:
            at = wanted + half
        out.append(at)
    return np.array(out)


@register("hysteresis")
class HysteresisEffect:
    """The streaming side."""

    kind = "hysteresis"
    channels: tuple[str, ...] = ()

    def __init__(self, table: Mapping[str, Any]) -> None:
        keys = Table("hysteresis", table, ("path", "half_width_um"))
        self._path = keys.text("path", ("DTF", "TDTF", "all"))
        self._form = keys.text("form", FORMS)
        self._half = keys.number("half_width_um", 0.0, 1e4)
        self._at = 0.0

    @classmethod
    def from_table(cls, table: Mapping[str, Any], period_s: float) -> Effect:
        """Make the effect from its table in the model file."""
        del period_s
        return cls(table)

    def step(self, signals: Signals) -> float:
        """Advance by one sample."""
        share = {"DTF": signals.y_dtf_um, "TDTF": signals.y_tdtf_um}.get(
            self._path, signals.y_dtf_um + signals.y_tdtf_um
        )
        self._at = followed(self._form, self._at, share, self._half)
        return self._at - share

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""
        return (self._at,)

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""
        (self._at,) = state


@dataclass(frozen=True, slots=True, kw_only=True)
class HysteresisHypothesis(Hypothesis):
    """The side of a whole record."""

    kind: ClassVar[str] = "hysteresis"
    acts_on: str = "DTF"
    law: str = "play"

    def fixed(self, waves: RecordSignals, values: Sequence[float]) -> Vector | None:
        """Return how far it stands behind."""
        share = waves.y_dtf_um + waves.y_tdtf_um if self.acts_on == "all" else waves.share(self.acts_on)
        return _trace(self.law, share, float(values[0])) - share

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        return {"path": self.acts_on, "form": self.law, "half_width_um": values[0]}

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what sticks."""
        return (
            f"The deformation by the {self.path} sticks and slips with a half-width of "
            f"{shown(named['half_width_um'])} µm ({rms_um:.2g} µm rms): a joint or guide with play or friction."
        )


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose play and sticking of every path, and of both together."""
    for path in setting.paths:
        size = setting.sizes_um[path]
        for law in FORMS:
            # Where it slips all the way, the residual is no smooth function of the width: try many.
            grid = tuple(float(w) for w in size * np.geomspace(0.002, 0.4, 14 if law == "play" else 90))
            free = (Free(name="half_width_um", low=size * 5e-4, high=size * 0.5, grid=grid),)
            yield HysteresisHypothesis(path=path, form=law, law=law, acts_on=path, free=free)
            if path == "DTF" and len(setting.paths) > 1:
                yield HysteresisHypothesis(path=path, form=f"{law}, both", law=law, acts_on="all", free=free)
