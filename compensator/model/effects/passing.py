"""`drift`, `step`, `periodic`: what no input explains and time alone describes.

None of them can be deployed: a probe's mount that drifts or slips is no error of the machine, and a period
that no channel shows has no phase that a model could know.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.model.effects.hypothesis import Free, Hypothesis, RecordSignals, Setting, proposes, shown


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift(Hypothesis):
    """A ramp over the record."""

    kind: ClassVar[str] = "drift"
    deployable: ClassVar[bool] = False
    worth_beside: ClassVar[float] = 0.75

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return the time, h."""
        hours: Vector = np.arange(waves.size, dtype=np.float64) * waves.period_min / 60.0
        return hours[:, None]

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what drifts."""
        return (
            f"Y drifts by {shown(named['um_per_h'])} µm an hour ({rms_um:.2g} µm rms) whatever the inputs do: a "
            "creeping probe mount is no error of the machine. Check the mount, measure against a fixed reference."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Settling(Drift):
    """A ramp that dies out."""

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return 1 − exp(−t/τ)."""
        minutes: Vector = np.arange(waves.size, dtype=np.float64) * waves.period_min
        return np.asarray(1.0 - np.exp(-minutes / values[0]))[:, None]

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what settles."""
        return (
            f"Y drifts by {shown(named['size_um'])} µm with a time constant of {shown(named['tau_min'])} min "
            f"({rms_um:.2g} µm rms) whatever the inputs do: a mount or a joint that settles is no error of the "
            "machine. Check the mount, measure against a fixed reference."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Step(Hypothesis):
    """A jump at a time."""

    kind: ClassVar[str] = "step"
    deployable: ClassVar[bool] = False
    worth_beside: ClassVar[float] = 0.75

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return 0 before and 1 after, over one sample."""
        minutes = np.arange(waves.size) * waves.period_min
        return np.asarray(np.clip((minutes - values[0]) / waves.period_min + 1.0, 0.0, 1.0))[:, None]

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what jumped."""
        return (
            f"Y jumps by {shown(named['jump_um'])} µm at {named['at_min'] / 60.0:.2f} h ({rms_um:.2g} µm rms) and "
            "stays: something was knocked or slipped. Look at the probe's mount and at the clamping; zero again."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Periodic(Hypothesis):
    """A period that no channel shows."""

    kind: ClassVar[str] = "periodic"
    deployable: ClassVar[bool] = False
    worth_beside: ClassVar[float] = 0.75

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return sine and cosine."""
        angle = 2.0 * np.pi * np.arange(waves.size) * waves.period_min / values[0]
        return np.column_stack((np.sin(angle), np.cos(angle)))

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what swings."""
        size = float(np.hypot(named["sine_um"], named["cosine_um"]))
        return (
            f"Y swings by ±{shown(size)} µm with a period of {shown(named['period_min'])} min that no channel shows "
            f"({rms_um:.2g} µm rms): air conditioning, lubrication, a cabinet's cooler. Log its channel."
        )


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose a ramp, a jump anywhere and every period that the record holds twice."""
    minutes, period = setting.minutes, setting.period_min
    yield Drift(form="ramp", amplitudes=("um_per_h",))
    taus = tuple(float(t) for t in np.geomspace(minutes / 8.0, 2.0 * minutes, 6))
    settle = Free(name="tau_min", low=minutes / 10.0, high=3.0 * minutes, grid=taus)
    yield Settling(form="settling", free=(settle,), amplitudes=("size_um",))
    grid = tuple(float(t) for t in np.arange(5.0 * period, minutes - 5.0 * period, max(period, minutes / 600.0)))
    at = Free(name="at_min", low=period, high=minutes - period, grid=grid, log=False)
    yield Step(form="jump", free=(at,), amplitudes=("jump_um",))
    frequencies = np.arange(2.0, minutes / (4.0 * period), 0.35) / minutes
    periods = tuple(float(p) for p in 1.0 / frequencies)
    free = Free(name="period_min", low=4.0 * period, high=minutes / 1.9, grid=periods)
    yield Periodic(form="sine", free=(free,), amplitudes=("sine_um", "cosine_um"))
