"""`nonlinear`: the gain of a path depends on its own size.

square       y += change · y_path² / 100 µm
odd square   y += change · y_path · |y_path| / 100 µm
cube         y += change · y_path³ / (100 µm)²
drive        y += change · G · (drive · |drive|) / 100, the size of what drives it
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from compensator.model.effects.base import Effect, Run, number, numbers, only, register, text
from compensator.model.effects.blocks import Block, Function, S
from compensator.model.effects.hypothesis import Context, Hypothesis, digits
from compensator.model.effects.signals import Signals
from compensator.model.transfer_function import SampledTransferFunction

FORMS = ("square", "odd square", "cube")


@register
class Nonlinear(Effect):
    """A curve of the path's share."""

    kind = "nonlinear"
    linear = ("change",)
    path: str = text("DTF", "TDTF")
    form: str = text(*FORMS)
    change: float = number()

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        """Return the curve of the share."""
        share = signals.share(self.path)
        part = share / 100.0
        if self.form == "cube":
            return self.change * (share * part * part)
        return self.change * (share * (part if self.form == "square" else abs(part)))

    def explain(self, rms_um: float) -> str:
        per = "100 W or K of its input" if self.form == "drive" else "100 µm"
        return (
            f"The gain of the {self.path} changes with its own size, by {digits(100.0 * self.change)} % per {per} "
            f"({rms_um:.2g} µm rms): a joint that yields, or surfaces that lose more heat when hot."
        )

    @classmethod
    def propose(cls, context: Context) -> Iterator[Hypothesis]:
        """Propose every curve of every path."""
        for path in context.paths:
            for form in FORMS:
                curve = cls(path=path, form=form, change=1.0)
                yield Hypothesis(effect=curve, form=form, amplitudes=("change_per_100",))


@register
class NonlinearDrive(Nonlinear):
    """The response of the path to a curve of its drive."""

    form: str = only(default="drive")
    b: tuple[float, ...] = numbers()
    a: tuple[float, ...] = numbers()

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        return (Function(SampledTransferFunction(b=self.b, a=self.a, period_s=60.0 * period_min)),)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        """Return the response to the curved drive."""
        drive = signals.source(self.path)
        return self.change * run[0](drive * abs(drive) / 100.0)

    @classmethod
    def propose(cls, context: Context) -> Iterator[Hypothesis]:
        """Propose every path."""
        for path in context.paths:
            b, a = context.functions[path]
            drive = cls(path=path, change=1.0, b=b, a=a)
            yield Hypothesis(effect=drive, form="drive", amplitudes=("change_per_100",))
