"""Sums of a channel's values in one block, from which mean, extremes and quality are computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.protocols.capancdt import FULL_SCALE


@dataclass(frozen=True, slots=True, kw_only=True)
class Sums:
    """Sums of one channel in one block.

    Parameters
    ----------
    time_s : float
        Arrival of the block, on the loop's clock.
    count, total, minimum, maximum : int
        Of the values as sent.
    under, over : int
        How many of them are at or beyond an end of the converter.
    """

    time_s: float
    count: int
    total: int
    minimum: int
    maximum: int
    under: int
    over: int


def sums(values: Sequence[int], time_s: float) -> Sums:
    """Sum a channel's values.

    Examples
    --------
    >>> kept = sums([0, 5, 7], 0.0)
    >>> kept.total, kept.under, kept.over
    (12, 1, 0)
    """
    return Sums(
        time_s=time_s,
        count=len(values),
        total=sum(values),
        minimum=min(values),
        maximum=max(values),
        under=sum(value <= 0 for value in values),
        over=sum(value >= FULL_SCALE for value in values),
    )
