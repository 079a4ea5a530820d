"""`dynamics`: a path is there, its time behaviour is wrong: a mode is missing, or one has another time constant.

missing    y += gain · L(τ) · drive
mistimed   y += change · [(1 + τ₀ s) / (1 + τ s) − 1] · y_path,   τ₀ a time constant of the path
changed    y += Σ_i gain_i · L(τ_i) · drive + Σ_i gain_ambient_i · L(τ_i) · ambient

A machine that was altered answers otherwise to its heat and to the air, both at once: the row of lags of `changed` can
be any such difference.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.model.effects.base import Effect, Signals, register
from compensator.model.effects.hypothesis import (
    ROW_RIDGE,
    Hypothesis,
    RecordSignals,
    Setting,
    lowpass,
    proposes,
    row,
    shown,
)
from compensator.model.effects.stream import Lag, Row
from compensator.model.effects.table import Table

FORMS = ("missing", "mistimed")
CHANGED = "changed"


@register("dynamics")
class DynamicsEffect:
    """The streaming side."""

    kind = "dynamics"
    channels: tuple[str, ...] = ()

    def __init__(self, table: Mapping[str, Any], period_s: float) -> None:
        keys = Table("dynamics", table, ("path", "tau_min", "gain", "instead_of_min"))
        self._tdtf = keys.text("path", ("DTF", "TDTF")) == "TDTF"
        self._missing = keys.text("form", FORMS) == "missing"
        tau = keys.number("tau_min", 0.0, 1e5)
        self._lag = Lag(tau, period_s / 60.0)
        self._gain = keys.number("gain") if self._missing else 1.0
        self._lead = 0.0 if self._missing else keys.number("instead_of_min", 0.0, 1e5) / tau

    @classmethod
    def from_table(cls, table: Mapping[str, Any], period_s: float) -> Effect:
        """Make the effect from its table in the model file."""
        return ChangedEffect(table, period_s) if table.get("form") == CHANGED else cls(table, period_s)

    def step(self, signals: Signals) -> float:
        """Advance by one sample."""
        if self._missing:
            return self._gain * self._lag.step(signals.ambient_k if self._tdtf else signals.drive)
        share = signals.y_tdtf_um if self._tdtf else signals.y_dtf_um
        # (1 + τ₀ s) / (1 + τ s) − 1 = (τ₀/τ − 1) (1 − L(τ))
        return (self._lead - 1.0) * (share - self._lag.step(share))

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""
        return self._lag.state

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""
        self._lag.state = state


class ChangedEffect:
    """The streaming side of paths that answer otherwise."""

    kind = "dynamics"
    channels: tuple[str, ...] = ()

    def __init__(self, table: Mapping[str, Any], period_s: float) -> None:
        keys = Table("dynamics", table, ("path", "tau_min", "gain", "gain_ambient"))
        keys.text("path", ("DTF",))
        taus = keys.numbers("tau_min", 0.0, 1e5)
        self._rows = tuple(Row(taus, keys.numbers(key), period_s / 60.0) for key in ("gain", "gain_ambient"))

    def step(self, signals: Signals) -> float:
        """Advance by one sample."""
        return self._rows[0].step(signals.drive) + self._rows[1].step(signals.ambient_k)

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""
        return (*self._rows[0].state, *self._rows[1].state)

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""
        half = len(state) // 2
        self._rows[0].state, self._rows[1].state = state[:half], state[half:]


@dataclass(frozen=True, slots=True, kw_only=True)
class MissingMode(Hypothesis):
    """A mode that the path lacks."""

    kind: ClassVar[str] = "dynamics"

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return what drives the path, behind the lag."""
        return lowpass(waves.source(self.path), values[0], waves.period_min)[:, None]

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        return {"path": self.path, "form": "missing", "tau_min": values[0], "gain": amplitudes[0]}

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what is missing."""
        return (
            f"The {self.path} lacks a mode with a time constant of {shown(named['tau_min'])} min ({rms_um:.2g} µm rms):"
            " a mass takes part that the calibration did not see, or saw too short."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MistimedMode(Hypothesis):
    """A mode of the path with another time constant."""

    kind: ClassVar[str] = "dynamics"
    instead_of_min: float = 1.0

    def fixed(self, waves: RecordSignals, values: Sequence[float]) -> Vector | None:
        """Return the difference that the other time constant makes."""
        share = waves.share(self.path)
        change = (self.instead_of_min / values[0] - 1.0) * (share - lowpass(share, values[0], waves.period_min))
        return np.asarray(change)

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        return {"path": self.path, "form": "mistimed", "tau_min": values[0], "instead_of_min": self.instead_of_min}

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what is mistimed."""
        return (
            f"A mode of the {self.path} has a time constant of {shown(named['tau_min'])} min instead of "
            f"{shown(self.instead_of_min)} min ({rms_um:.2g} µm rms): it stores or loses heat otherwise than at the "
            "calibration."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangedPaths(Hypothesis):
    """Paths that answer otherwise than at the calibration, in any linear way."""

    kind: ClassVar[str] = "dynamics"
    ridge: ClassVar[float] = ROW_RIDGE
    taus_min: tuple[float, ...] = ()

    @property
    def parameters(self) -> int:
        """Number of parameters that the data spends on it: fewer than gains, because they are held together."""
        return 6

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return what drives the paths, behind each lag."""
        return np.hstack([row(u, self.taus_min, waves.period_min) for u in (waves.drive, waves.ambient_k)])

    def named(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, float]:
        """Return the change of each path's gain at rest."""
        count = len(self.taus_min)
        names = self.amplitudes[0].rpartition("_")[0], self.amplitudes[count].rpartition("_")[0]
        return {names[0]: math.fsum(amplitudes[:count]), names[1]: math.fsum(amplitudes[count:])}

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        count = len(self.taus_min)
        return {
            "path": "DTF",
            "form": CHANGED,
            "tau_min": list(self.taus_min),
            "gain": list(amplitudes[:count]),
            "gain_ambient": list(amplitudes[count:]),
        }

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what is changed."""
        return (
            f"The DTF, and the TDTF with it, has another course of time than at the calibration ({rms_um:.2g} µm rms): "
            "a mass or a contact was added, removed or altered."
        )


def changed_paths(setting: Setting) -> ChangedPaths:
    """Return the hypothesis that the paths answer otherwise."""
    taus = setting.row_min
    unit = "w" if setting.has_ttf else "k"
    names = (f"change_um_per_{unit}", "change_ambient_um_per_k")
    amplitudes = tuple(f"{name}_{i}" for name in names for i in range(1, len(taus) + 1))
    return ChangedPaths(path="DTF", form=CHANGED, taus_min=taus, amplitudes=amplitudes)


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose a missing mode and another time constant for each mode of every path."""
    for path in setting.paths:
        unit = "k" if path == "TDTF" or not setting.has_ttf else "w"
        yield MissingMode(path=path, form="missing", free=(setting.tau(),), amplitudes=(f"gain_um_per_{unit}",))
        for tau in setting.taus_min.get(path, ()):
            if tau > 2.0 * setting.period_min:
                yield MistimedMode(path=path, form=f"mistimed {tau:.3g}", free=(setting.tau(),), instead_of_min=tau)
