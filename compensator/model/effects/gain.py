"""`gain`: a path is there, its gain is wrong:  y += change · y_path."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from compensator.model.effects.base import Effect, Run, number, register, text
from compensator.model.effects.blocks import S
from compensator.model.effects.hypothesis import Context, Hypothesis, proposes
from compensator.model.effects.seen import Seen, digits
from compensator.model.effects.signals import Signals


@register
class Gain(Effect):
    """A change of a path's gain, as a share of it."""

    kind = "gain"
    linear = ("change",)
    names_background = True
    path: str = text("DTF", "TDTF")
    change: float = number(-10.0, 10.0)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        return self.change * signals.share(self.path)

    def explain(self, seen: Seen) -> str:
        if self.change < -1.0:
            path = f"{self.path}{seen.path_words}".removesuffix(",")
            return f"{seen.words}: Y moves against the {path}. Check the sign of measured Y."
        return (
            f"{seen.words}: the model's gain of the {self.path}{seen.path_words} is "
            f"{digits(abs(100.0 * self.change))} % too {'low' if self.change > 0 else 'high'}. "
            "The machine responds differently than during calibration."
        )


@proposes
def gains(context: Context) -> Iterator[Hypothesis]:
    """Propose every path."""
    for path in context.paths:
        yield Hypothesis(effect=Gain(path=path, change=1.0), amplitudes=("change",), sizes=(context.change(path),))
