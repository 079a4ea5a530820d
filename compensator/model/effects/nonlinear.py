"""`nonlinear`: the gain of a path depends on its own size.

square       y += change · y_path² / 100 µm
odd square   y += change · y_path · |y_path| / 100 µm
cube         y += change · y_path³ / (100 µm)²
drive        y += change · G · (drive · |drive|) / 100, the size of what drives it
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

from compensator.model.effects.base import Effect, Run, number, numbers, only, register, text
from compensator.model.effects.blocks import Block, Function, S
from compensator.model.effects.hypothesis import Context, Hypothesis, proposes
from compensator.model.effects.seen import Seen, digits
from compensator.model.effects.signals import Signals
from compensator.model.transfer_function import SampledTransferFunction

FORMS = ("square", "odd square", "cube")


@register
class Nonlinear(Effect):
    """A curve of the path's share."""

    kind = "nonlinear"
    counts_from_rest = True
    linear = ("change",)
    path: str = text("DTF", "TDTF")
    form: str = text(*FORMS)
    change: float = number()

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        share = signals.share_from_rest(self.path)
        part = share / 100.0
        if self.form == "cube":
            return self.change * (share * part * part)
        return self.change * (share * (part if self.form == "square" else abs(part)))

    def explain(self, seen: Seen) -> str:
        per = "100 W or K of its input" if self.form == "drive" else "100 µm"
        return (
            f"{seen.words}: the gain of the {self.path}{seen.path_words} changes with its own size, by "
            f"{digits(100.0 * self.change)} % per {per}. A joint yields, or surfaces lose more heat when hot."
        )


@register
class NonlinearDrive(Nonlinear):
    """The response of the path to a curve of its drive."""

    form: str = only(default="drive")
    b: tuple[float, ...] = numbers()
    a: tuple[float, ...] = numbers()

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        return (Function(SampledTransferFunction(b=self.b, a=self.a, period_s=60.0 * period_min)),)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        drive = signals.source_from_rest(self.path)
        return self.change * run[0](drive * abs(drive) / 100.0)


@proposes
def curves(context: Context) -> Iterator[Hypothesis]:
    """Propose every curve of every path, and of its drive."""
    for path, form in itertools.product(context.paths, FORMS):
        effect = Nonlinear(path=path, form=form, change=1.0)
        yield Hypothesis(effect=effect, form=form, amplitudes=("change_per_100",))
    for path in context.paths:
        b, a = context.functions[path]
        effect = NonlinearDrive(path=path, change=1.0, b=b, a=a)
        yield Hypothesis(effect=effect, form="drive", amplitudes=("change_per_100",))
