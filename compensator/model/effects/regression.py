"""`regression`: the remainder, a regularised linear response of several channels.

y += limited(Σ_c Σ_i gain_ci · L(τ_i) · [f_c(c) − f_c(c at the start)], most),   f_c(c) = c or c · |c|

It corrects what the channels explain and no named effect does, and explains nothing itself: the search never proposes
it, and where `most_um` is given it goes no further to either side. With F the low-rank factor of the gains' covariance,
φ the outputs of all lags and b what lies beyond the limit, its variance is Σ_r (F_r · φ)² + b².
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import mul
from typing import Any

from compensator.arrays import LARGEST, NAN
from compensator.errors import ModelError
from compensator.model.effects.base import (
    REFUSED,
    BankEffect,
    Effect,
    Run,
    numbers,
    optional_number,
    optional_rows,
    register,
    rows,
    texts,
)
from compensator.model.effects.blocks import Block, ChangeSeen, FilterBank, Limit, S, lag_or_none
from compensator.model.effects.seen import Seen, rounded
from compensator.model.effects.signals import Signals
from compensator.model.table import shown

#: Names of the base's own inputs: its drive by the kind of model, W or K, and the change of the ambient, K.
DRIVE: Mapping[str, str] = {"heat": "heat_w", "direct": "t_q_degc - at_degc"}
AMBIENT = "at_degc"
#: Most channels, lags for each, and rows of the factor: the time of a step grows with their product.
MOST_CHANNELS, MOST_LAGS, MOST_ROWS = 64, 12, 8
#: Channels named in the explanation.
_NAMED = 6


@register
class Regression(BankEffect, Effect):
    """Several channels through common lags.

    Parameters
    ----------
    channels : tuple of str
        Logged channels, and the base's own inputs: `DRIVE` and `AMBIENT`. A channel may stand twice, with both
        exponents.
    exponents : tuple of float
        For each channel, 1, or 2 for its square with the sign kept.
    taus_min : tuple of float
        Time constants of the lags, common to all channels, min; 0 is undelayed.
    gains : tuple of tuple of float
        For each channel, the gain behind each lag, µm per the channel's unit to the power of its exponent.
    std_factor : tuple of tuple of float
        Rows F_r with the covariance of the gains Σ_r F_r' F_r; in a row as many numbers as there are gains, channel by
        channel. Empty: they state no variance.
    most_um : float
        How far it goes to either side, µm; without a limit by default.

    Raises
    ------
    ModelError
        If the parameters do not fit together, naming key and value.
    """

    kind = "regression"
    comment = "The remainder: a regularised linear response of several channels. A correction that explains nothing."
    acts_in_part = True
    channels: tuple[str, ...] = texts()
    exponents: tuple[float, ...] = numbers(1.0, 2.0)
    taus_min: tuple[float, ...] = numbers(0.0, 1e5)
    gains: tuple[tuple[float, ...], ...] = rows()
    std_factor: tuple[tuple[float, ...], ...] = optional_rows()
    most_um: float = optional_number(0.0, LARGEST, default=math.inf)

    def __post_init__(self) -> None:
        gains = len(self.channels) * len(self.taus_min)
        _check_count("channels", self.channels, 1, MOST_CHANNELS, "channels")
        _check_count("exponents", self.exponents, len(self.channels), len(self.channels), "numbers, one a channel")
        _check_count("taus_min", self.taus_min, 1, MOST_LAGS, "numbers")
        _check_count("gains", self.gains, len(self.channels), len(self.channels), "rows, one a channel")
        _check_count("std_factor", self.std_factor, 0, MOST_ROWS, "rows")
        for row in self.gains:
            _check_count("gains", row, len(self.taus_min), len(self.taus_min), "numbers in a row, one of each taus_min")
        for row in self.std_factor:
            _check_count("std_factor", row, gains, gains, "numbers in a row, one a gain")
        self._check_channels()
        _check_each("taus_min", self.taus_min, lambda tau: 0.0 <= tau <= 1e5, "from 0 to 100000")
        if self.most_um != math.inf:
            _check_each("most_um", (self.most_um,), lambda most: 0.0 <= most <= LARGEST, "a number from 0 on")
        for name, rows_of in (("gains", self.gains), ("std_factor", self.std_factor)):
            for row in rows_of:
                _check_each(name, row, lambda value: -LARGEST < value < LARGEST, "finite")

    def _check_channels(self) -> None:
        names = ", ".join(map(repr, (*DRIVE.values(), AMBIENT)))
        _check_each(
            "channels",
            self.channels,
            lambda name: name == AMBIENT or name not in REFUSED,
            f"a logged channel or an input of the base: {names}",
        )
        _check_each("exponents", self.exponents, lambda exponent: exponent in (1, 2), "1 or 2")
        pairs = list(zip(self.channels, self.exponents, strict=True))
        _check_each("channels", pairs, lambda pair: pairs.count(pair) == 1, "one entry for each channel and exponent")

    # ------------------------------------------------------------------ law

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        changes = [ChangeSeen() for name in self.channels if not _is_of_base(name)]
        limits = [Limit(self.most_um)] if self._is_limited else []
        return *limits, *changes, FilterBank(self.taus_min, self.gains, period_min, lag=lag_or_none)

    def inputs(self, signals: Signals[S], run: Sequence[Run[S]]) -> tuple[S, ...]:
        """Return each channel through its curve: as its change from the start, those of the base as they are."""
        changes = iter(run[self._is_limited :])
        found = []
        for name, exponent in zip(self.channels, self.exponents, strict=True):
            u = _signal(signals, name)
            curved = u if exponent == 1 else u * abs(u)
            found.append(curved if _is_of_base(name) else next(changes)(curved))
        return tuple(found)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        added = BankEffect.law(self, signals, run)
        return run[0](added) if self._is_limited else added

    @property
    def _is_limited(self) -> bool:
        return math.isfinite(self.most_um)

    @property
    def has_variance(self) -> bool:
        return bool(self.std_factor) or self._is_limited

    def variance_um2(self, blocks: Sequence[Block]) -> float:
        bank = blocks[-1]
        assert isinstance(bank, FilterBank)
        outputs = bank.outputs
        beyond_um = blocks[0].state[0] if self._is_limited else 0.0
        # fsum, because it rounds once: the same bits on every processor, in every version of Python.
        return math.fsum(math.fsum(map(mul, row, outputs)) ** 2 for row in self.std_factor) + beyond_um**2

    # ------------------------------------------------------------------ contract

    @property
    def measured(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for name in self.channels if not _is_of_base(name)))

    def channels_that_matter(self) -> tuple[str, ...]:
        """Return the channels with a gain."""
        return tuple(name for name, row in zip(self.channels, self.gains, strict=True) if any(row))

    @property
    def time_constants_min(self) -> tuple[float, ...]:
        return self.taus_min

    def check_base(self, kind: str) -> None:
        for name in self.channels:
            if name in DRIVE.values() and name != DRIVE[kind]:
                expected = f"{DRIVE[kind]!r}, the drive of a model of kind {kind!r}"
                raise ModelError(f"effect regression: channels = {name!r}, expected {expected}")

    def explain(self, seen: Seen) -> str:
        names = list(dict.fromkeys(self.channels))
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        limit = f", and goes no further than {rounded(self.most_um)} µm to either side" if self._is_limited else ""
        return (
            f"{seen.words}: the remainder, a regularised linear response of {', '.join(names[:_NAMED])}{more}. It is a "
            f"correction that explains nothing{limit}."
        )

    def to_table(self) -> dict[str, Any]:
        table = Effect.to_table(self)
        return {key: value for key, value in table.items() if key != "std_factor" or value}


def _check_count(key: str, values: Sequence[Any], low: int, high: int, what: str) -> None:
    if not low <= len(values) <= high:
        count = str(low) if low == high else f"{low} to {high}"
        raise ModelError(f"effect regression: {key} = {shown(values)} of length {len(values)}, expected {count} {what}")


def _check_each(key: str, values: Iterable[Any], is_right: Callable[[Any], bool], expected: str) -> None:
    for value in values:
        if not is_right(value):
            raise ModelError(f"effect regression: {key} = {shown(value)}, expected {expected}")


def _is_of_base(name: str) -> bool:
    return name == AMBIENT or name in DRIVE.values()


def _signal(signals: Signals[S], name: str) -> S:
    if name == AMBIENT:
        return signals.ambient_k
    if name in DRIVE.values():
        return signals.drive
    # What is not among the channels was never seen.
    return signals.channels.get(name, NAN * signals.drive)
