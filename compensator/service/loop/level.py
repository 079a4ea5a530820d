"""At which level a candidate is adopted: what measured Y shows since its effect began, or none.

A candidate is judged by changes of Y. Where an effect began after the zero its level is not known: the candidate counts
its channel from the zero, when the effect did not act. Measured Y shows it if nothing else can have moved Y. Until some
time the present model was right about this zero, and about changes more so than the candidate: the effect did not act
yet. Where it has acted all the time, and a mount slips, the candidate is the better one before. While the two are
compared what the candidate leaves neither grows nor shrinks, as it would with a mount that creeps; before that the
effect may still have grown to its full size. And it is no larger than twice what the candidate moves: a small effect
is not the cause of a large level, but at the zero its channel may have been as far from where it has none as it moves.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from compensator.arrays import Vector, rms_of
from compensator.diagnose.residual.change import BLOCK_MIN, FEWEST_BLOCKS, QUIET, changed_at
from compensator.messages import number
from compensator.service.loop.trust import is_disturbed
from compensator.service.outcome import Outcome, sets_zero, sets_zero_at_rest
from compensator.service.transfer.refutation import FLOOR_UM
from compensator.service.transfer.second_opinion import is_unusable
from compensator.service.transfer.two_models import BLOCK_NS

#: The present model was right before if it erred by less than `QUIET` of what it errs by since then, and its error
#: changed by less than this part of what the candidate's changed by.
RIGHTER = 0.8
#: The candidate's residual stays if its first and second half differ by less than this part of the present one's error,
#: and the median of its deviations is less than that part.
STAYS, SPREAD = 0.25, 0.3
#: The level is no larger than so many times the range by which the candidate moves.
_MOST = 2.0
#: Blocks that show a constant: they differ by no more than `SPREAD` of it.
_CONSTANT = 12
#: A channel reads 0 if its mean is no more than so many standard deviations within the sample.
_NOISE = 3.0
#: Blocks that are remembered.
_BLOCKS = 144


class ErrorBlocks(msgspec.Struct, kw_only=True):
    """Block means of a model's residual since the last zero, and the open block.

    Parameters
    ----------
    blocks : list of (int, float)
        Number since 1970, and mean, µm.
    number, count : int
        Number of the open block, and its usable samples.
    sum_um : float
        Their sum.
    """

    blocks: list[tuple[int, float]] = []
    number: int = 0
    count: int = 0
    sum_um: float = 0.0

    def update(self, outcome: Outcome) -> None:
        """Add a sample of the model, unless it shows a fault by itself, or the model's state is not known."""
        if sets_zero(outcome):
            self.clear()
        residual_um, block = number(outcome.estimate.residual_um), outcome.sample.time_utc_ns // BLOCK_NS
        if block != self.number:
            if self.count:
                self.blocks = [*self.blocks, (self.number, self.sum_um / self.count)][-_BLOCKS:]
            self.number, self.count, self.sum_um = block, 0, 0.0
        if np.isfinite(residual_um) and not (is_disturbed(outcome.offset.reasons) or is_unusable(outcome)):
            self.count, self.sum_um = self.count + 1, self.sum_um + residual_um

    def go_on_after(self, before: ErrorBlocks) -> None:
        """Take over what a model with the same effects has left before the first block."""
        first = self.blocks[0][0] if self.blocks else self.number
        self.blocks = [*(block for block in before.blocks if block[0] < first), *self.blocks][-_BLOCKS:]

    def move_clock(self, by_ns: int) -> None:
        """Move all times, as the clock was set."""
        by = round(by_ns / BLOCK_NS)
        self.blocks, self.number = [(number + by, mean) for number, mean in self.blocks], self.number + by

    def clear(self) -> None:
        """Begin anew: at a zero, or with another model."""
        self.blocks, self.count, self.sum_um = [], 0, 0.0


def channels_at_zero(outcome: Outcome) -> list[str] | None:
    """Return the channels that read 0, within their noise, at a sample that sets a zero; None if not one at rest."""
    if not sets_zero_at_rest(outcome):
        return None
    read = (
        (name, number(one.mean), number(one.spread)) for name, one in outcome.sample.channels.items() if one.is_good
    )
    return [name for name, mean, spread in read if abs(mean) <= _NOISE * spread]


def is_constant(blocks: Sequence[tuple[int, float]]) -> bool:
    """Return whether a model has left nothing but a constant for hours: Y was shifted, and moves as it predicts.

    Examples
    --------
    >>> is_constant([(n, 5.0 + 0.2 * (n % 3)) for n in range(12)]), is_constant([(n, 0.4 * n) for n in range(12)])
    (True, False)
    """
    last = [mean for _, mean in blocks[-_CONSTANT:]]
    return len(last) == _CONSTANT and max(last) - min(last) <= SPREAD * abs(sum(last)) / _CONSTANT


def level_um(
    present: Sequence[tuple[int, float]], other: Sequence[tuple[int, float]], *, since_ns: int = 0
) -> float | None:
    """Return the level of another model that measured Y shows; None if it shows none.

    Parameters
    ----------
    present, other : sequence of (int, float)
        Number and mean of each block of the residuals of the present and the other model, µm, about the last zero.
    since_ns : int
        Since when the two are compared, ns since 1970 UTC.

    Returns
    -------
    float or None
        Median of the other model's residual since the present one began to err and they are compared, µm.

    Examples
    --------
    >>> began = [(n, 0.1 * (n % 2) if n < 12 else 7.0 + n % 2) for n in range(40)]
    >>> level_um(began, [(n, 6.0 * (n % 2) if n < 12 else 6.0) for n in range(40)])
    6.0
    >>> level_um(began, [(n, 0.1 if n < 12 else 6.0) for n in range(40)]) is None  # the effect acted before: a slip
    True
    >>> level_um(began, [(n, 0.1 if n < 10 else 6.0) for n in range(40)]) is None  # one that is seen some blocks late
    True
    >>> level_um(began, [(n, 6.0 * (n % 2) if n < 12 else 0.3 * n) for n in range(40)]) is None  # a mount that creeps
    True
    >>> level_um(began, [(n, 0.8 * (n % 2) if n < 12 else 6.5) for n in range(40)]) is None  # it moves Y by 2 µm only
    True
    """
    others = dict(other)
    numbers = np.array([n for n, _ in present if n in others])
    own, rest = np.array([(mean, others[n]) for n, mean in present if n in others]).reshape(-1, 2).T
    if numbers.size < 2 * FEWEST_BLOCKS:
        return None
    at_s = changed_at(60.0 * BLOCK_MIN * numbers, own, FLOOR_UM)
    if at_s is None:
        return None
    since = numbers >= round(at_s / (60.0 * BLOCK_MIN))
    compared = since & (numbers * BLOCK_NS >= since_ns)
    if np.sum(compared) < FEWEST_BLOCKS:
        return None
    left_um, error_um = rest[compared], rms_of(own[compared])
    own_before, rest_before = own[~since], rest[~since]
    was_right = rms_of(own_before) < QUIET * error_um and np.std(own_before) < RIGHTER * np.std(rest_before)
    # The time may be found some blocks after a slip, which is then among those before.
    was_right = was_right and _spread(rest_before) >= QUIET * _spread(own_before)
    # Medians: while the effect begins, its lag is seen.
    middle_um, spread_um = float(np.median(left_um)), _spread(left_um)
    halves = np.median(left_um[: left_um.size // 2]), np.median(left_um[left_um.size // 2 :])
    stays = abs(halves[1] - halves[0]) < STAYS * error_um and spread_um < SPREAD * error_um
    moves = abs(middle_um) <= _MOST * np.ptp(own - rest)
    return middle_um if was_right and stays and moves else None


def _spread(values: Vector) -> float:
    """Return the median of how far values are from their median."""
    return float(np.median(np.abs(values - np.median(values))))
