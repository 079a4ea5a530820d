"""`hysteresis`: a path sticks and slips.

play    y += P_w(y_path) − y_path, P_w follows once a play of half-width w is taken up
stick   the same, but it jumps all the way once it is off by more than w
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from compensator.model.effects.base import Effect, Run, number, register, text
from compensator.model.effects.blocks import Block, Play, S, Stick
from compensator.model.effects.hypothesis import Context, Free, Hypothesis, proposes
from compensator.model.effects.seen import Seen, digits
from compensator.model.effects.signals import Signals

FORMS = ("play", "stick")


@register
class Hysteresis(Effect):
    """Play or stick-slip of one path, or of both together."""

    kind = "hysteresis"
    starts_anywhere = True
    path: str = text("DTF", "TDTF", "all")
    form: str = text(*FORMS)
    half_width_um: float = number(0.0, 1e4)

    @property
    def off_at_zero(self) -> tuple[str, ...] | None:
        return None  # a joint rests wherever it sticks

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        return ((Play if self.form == "play" else Stick)(self.half_width_um),)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        share = signals.share(self.path)
        return run[0](share) - share

    def explain(self, seen: Seen) -> str:
        what = "deformation" if self.path == "all" else f"deformation from the {self.path}"
        return (
            f"{seen.words}: the {what}{seen.path_words} sticks and slips with a half-width of "
            f"{digits(self.half_width_um)} µm. A joint or guideway has play or friction."
        )


@proposes
def plays(context: Context) -> Iterator[Hypothesis]:
    """Propose play and stick-slip of every path, and of both together."""
    for path, form in itertools.product(context.paths, FORMS):
        size = context.sizes_um[path]
        # With stick-slip the residual is not a smooth function of the width: try many.
        grid = tuple(float(w) for w in size * np.geomspace(0.002, 0.4, 14 if form == "play" else 90))
        free = (Free(name="half_width_um", low=size * 5e-4, high=size * 0.5, grid=grid),)
        yield Hypothesis(effect=Hysteresis(path=path, form=form, half_width_um=0.0), form=form, free=free)
        if path == "DTF" and len(context.paths) > 1:
            both = Hysteresis(path="all", form=form, half_width_um=0.0)
            yield Hypothesis(effect=both, form=f"{form}, both", free=free, path=path)
