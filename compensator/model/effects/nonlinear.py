"""`nonlinear`: a path's strength depends on its own size.

square       y += change · y_path² / 100 µm
odd square   y += change · y_path · |y_path| / 100 µm
cube         y += change · y_path³ / (100 µm)²
drive        y += change · G · (drive · |drive|) / 100, the size of what drives it
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compensator.arrays import Matrix
from compensator.model.effects.base import Effect, Signals, register
from compensator.model.effects.hypothesis import Hypothesis, RecordSignals, Setting, proposes, shown
from compensator.model.effects.stream import Function
from compensator.model.effects.table import Table
from compensator.model.transfer_function import SampledTransferFunction

FORMS = ("square", "odd square", "cube", "drive")


def _shaped(form: str, size: float) -> float:
    part = size / 100.0
    if form == "square":
        return size * part
    return size * abs(part) if form == "odd square" else size * part * part


@register("nonlinear")
class NonlinearEffect:
    """The streaming side."""

    kind = "nonlinear"
    channels: tuple[str, ...] = ()

    def __init__(self, table: Mapping[str, Any], period_s: float) -> None:
        keys = Table("nonlinear", table, ("path", "change", "b", "a"))
        self._tdtf = keys.text("path", ("DTF", "TDTF")) == "TDTF"
        self._form = keys.text("form", FORMS)
        self._change = keys.number("change")
        self._function: Function | None = None
        if self._form == "drive":
            self._function = Function(
                SampledTransferFunction(b=keys.numbers("b"), a=keys.numbers("a"), period_s=period_s)
            )

    @classmethod
    def from_table(cls, table: Mapping[str, Any], period_s: float) -> Effect:
        """Make the effect from its table in the model file."""
        return cls(table, period_s)

    def step(self, signals: Signals) -> float:
        """Advance by one sample."""
        if self._function is not None:
            drive = signals.ambient_k if self._tdtf else signals.drive
            return self._change * self._function.step(drive * abs(drive) / 100.0)
        return self._change * _shaped(self._form, signals.y_tdtf_um if self._tdtf else signals.y_dtf_um)

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""
        return self._function.state if self._function is not None else ()

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""
        if self._function is not None:
            self._function.state = state


@dataclass(frozen=True, slots=True, kw_only=True)
class NonlinearHypothesis(Hypothesis):
    """The side of a whole record."""

    kind: ClassVar[str] = "nonlinear"
    function: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return the curve of the share, or the path's answer to the curve of its drive."""
        if self.form == "drive":
            drive = waves.source(self.path)
            return waves.function(self.path).response(drive * np.abs(drive) / 100.0)[:, None]
        share = waves.share(self.path)
        size = {"square": share, "odd square": np.abs(share), "cube": share * share / 100.0}[self.form]
        return np.asarray(share * size / 100.0)[:, None]

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        extra: dict[str, Any] = {}
        if self.form == "drive":
            extra = {"b": list(self.function[0]), "a": list(self.function[1])}
        return {"path": self.path, "form": self.form, "change": amplitudes[0], **extra}

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what depends on the size."""
        change = next(iter(named.values()))
        per = "100 W or K of its drive" if self.form == "drive" else "100 µm"
        return (
            f"The strength of the {self.path} changes with its own size, by {shown(100.0 * change)} % for {per} "
            f"({rms_um:.2g} µm rms): a joint that gives way, or surfaces that lose heat better when hot."
        )


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose curves of every path."""
    for path in setting.paths:
        for form in FORMS:
            yield NonlinearHypothesis(
                path=path, form=form, amplitudes=("change_per_100",), function=setting.functions.get(path, ((), ()))
            )
