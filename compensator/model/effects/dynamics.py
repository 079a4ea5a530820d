"""`dynamics`: a path is there, its time behaviour is wrong: a mode is missing, or has another time constant.

missing    y += gain · L(τ) · drive
mistimed   y += change · [(1 + τ₀ s) / (1 + τ s) − 1] · y_path,   τ₀ a time constant of the path
changed    y += Σ_i gain_i · L(τ_i) · drive + Σ_i gain_ambient_i · L(τ_i) · ambient

Altering a machine changes its response to heat and to ambient temperature at once: the filter bank of `changed` can
represent any such difference.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np

from compensator.model.effects.base import BankEffect, Effect, Run, number, numbers, only, register, text
from compensator.model.effects.blocks import Block, FilterBank, Lag, S
from compensator.model.effects.hypothesis import Context, Free, Hypothesis, numbered, proposes
from compensator.model.effects.seen import Seen, digits
from compensator.model.effects.signals import Signals


@register
class MissingMode(Effect):
    """A mode that the path lacks."""

    kind = "dynamics"
    linear = ("gain",)
    path: str = text("DTF", "TDTF")
    form: str = only(default="missing")
    tau_min: float = number(0.0, 1e5)
    gain: float = number()

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        return (Lag(self.tau_min, period_min),)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        return self.gain * run[0](signals.source(self.path))

    def explain(self, seen: Seen) -> str:
        return (
            f"{seen.words}: the {self.path}{seen.path_words} lacks a mode with a time constant of "
            f"{digits(self.tau_min)} min. It is a thermal mass that the calibration did not excite, or not for long "
            "enough."
        )


@register
class MistimedMode(Effect):
    """A mode of the path that has another time constant."""

    kind = "dynamics"
    path: str = text("DTF", "TDTF")
    form: str = only(default="mistimed")
    tau_min: float = number(1e-9, 1e5)
    instead_of_min: float = number(0.0, 1e5)

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        return (Lag(self.tau_min, period_min),)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        share = signals.share(self.path)
        # (1 + τ₀ s) / (1 + τ s) − 1 = (τ₀/τ − 1) (1 − L(τ))
        return (self.instead_of_min / self.tau_min - 1.0) * (share - run[0](share))

    def explain(self, seen: Seen) -> str:
        return (
            f"{seen.words} after changes: a mode of the {self.path}{seen.path_words} has a time constant of "
            f"{digits(self.tau_min)} min instead of {digits(self.instead_of_min)} min. Heat is stored or lost "
            "differently than during calibration."
        )


@register
class ChangedPaths(BankEffect, Effect):
    """Paths that respond differently than during calibration, in any linear way."""

    kind = "dynamics"
    linear = ("gain", "gain_ambient")
    background = True
    has_any_form = True
    path: str = only(default="DTF")
    form: str = only(default="changed")
    tau_min: tuple[float, ...] = numbers(0.0, 1e5)
    gain: tuple[float, ...] = numbers()
    gain_ambient: tuple[float, ...] = numbers()

    @property
    def off_at_zero(self) -> tuple[str, ...] | None:
        return None  # that of the ambient changes, too

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        return (FilterBank(self.tau_min, (self.gain, self.gain_ambient), period_min),)

    def inputs(self, signals: Signals[S], run: Sequence[Run[S]]) -> tuple[S, ...]:
        return signals.drive, signals.ambient_k

    def named(self, given: dict[str, float]) -> dict[str, float]:
        """Return the change of each path's gain at rest."""
        names = [name.rpartition("_")[0] for name in given]
        return {names[0]: math.fsum(self.gain), names[-1]: math.fsum(self.gain_ambient)}

    def explain(self, seen: Seen) -> str:
        return (
            f"{seen.words}: DTF and TDTF have other dynamics than during calibration. A mass or a contact was added, "
            "removed or altered."
        )


#: Changes of a time constant that the search begins with. The response grows with them: of two neighbours the larger
#: one is never so large that in the place of a change between them it explains less than nothing.
CHANGES = (0.03, 0.06, 0.12, 0.25, 0.5)


@proposes
def modes(context: Context) -> Iterator[Hypothesis]:
    """Propose a further mode of every path, each of its modes that is slow enough to be seen, any change of both."""
    for path in context.paths:
        missing = MissingMode(path=path, tau_min=0.0, gain=1.0)
        name = f"gain_um_per_{context.drive_unit(path)}"
        sizes = (context.gain_change(path),)
        yield Hypothesis(effect=missing, form="missing", free=(context.tau(),), amplitudes=(name,), sizes=sizes)
    for path in context.paths:
        for tau in context.taus_min.get(path, ()):
            if tau > 2.0 * context.period_min:
                mistimed = MistimedMode(path=path, tau_min=tau, instead_of_min=tau)
                yield Hypothesis(effect=mistimed, form=f"mistimed {tau:.3g}", free=(_near(context.tau(), tau),))
    taus = context.bank_min
    ones = (1.0,) * len(taus)
    names = f"change_um_per_{context.drive_unit('DTF')}", "change_ambient_um_per_k"
    amplitudes = tuple(n for name in names for n in numbered(name, len(taus)))
    both = ChangedPaths(tau_min=taus, gain=ones, gain_ambient=ones)
    sizes = tuple(np.repeat([context.gain_change("DTF"), context.gain_change("TDTF")], len(taus)).tolist())
    yield Hypothesis(effect=both, form="changed", amplitudes=amplitudes, sizes=sizes)


def _near(free: Free, tau_min: float) -> Free:
    """Return a time constant whose search also begins with small changes of one that it may have instead."""
    near = [tau_min * (1.0 + change) ** sign for change in CHANGES for sign in (-1, 1)]
    grid = {*free.grid, *(tau for tau in near if free.low < tau < free.high)}
    return dataclasses.replace(free, grid=tuple(sorted(grid)))
