"""Probes that are a pair: two of one direction, at two heights, as in a nest of five probes.

Two probes of one direction see the same displacement, and a tilt each by its height. So they move nearly alike, faster
and slower, unlike any other probe.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Vector
from compensator.axes import AXES

#: Changes over this time are compared, min: the slow common drift of all probes says nothing of a direction.
CHANGE_MIN = 60.0
#: Correlation of a pair at least, and of each of its probes with any other probe at most.
PAIR, OTHERS = 0.95, 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two probes that are probably of one direction.

    Parameters
    ----------
    first, second : str
        Their names.
    correlation : float
        Of their changes over an hour.
    others : float
        Largest magnitude of the correlation of one of them with another probe; 0 without one.
    ratio : float
        How far the second moves where the first moves by 1.
    apart_um : float
        How far they move apart within a record, µm; of two that move against each other, if both counted in the same
        sense.
    share : bool
        Whether the data permit common time constants.
    """

    first: str
    second: str
    correlation: float
    others: float
    ratio: float
    apart_um: float
    share: bool

    @property
    def both_ways(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """Each probe with the other one."""
        return (self.first, self.second), (self.second, self.first)

    def __str__(self) -> str:
        way = "alike" if self.correlation > 0.0 else "against each other"
        beside = f", with any other probe by {self.others:.2f} at most" if self.others else ""
        poles = "they have common time constants" if self.share else "the data contradict common time constants"
        return (
            f"{self.first} and {self.second} are probably a pair, of one direction at two heights: they move {way} "
            f"(their changes over an hour correlate by {self.correlation:+.3f}{beside}), {self.second} by "
            f"{self.ratio:.2f} of {self.first}; {poles}."
        )


def pairs(
    measured: Mapping[str, Sequence[Vector]], period_s: float, shared: Sequence[Sequence[str]] = ()
) -> Iterator[Pair]:
    """Yield the probes that are probably pairs.

    Where three move alike, which of them are a pair does not show, and none is proposed. Axes of a control have
    directions of their own, so they are no pair of each other; the slope of an axis, such as `y_slope`, is no probe.

    Parameters
    ----------
    measured : mapping of str to sequence of numpy.ndarray
        Deformation of each probe in each record, the same records for all, µm; NaN where missing.
    period_s : float
        Sample period, s.
    shared : sequence of sequence of str
        Probes that share their time constants.

    Examples
    --------
    >>> slow, other = np.sin(np.arange(600) / 90.0), np.cos(np.arange(600) / 70.0)
    >>> [(p.first, p.second) for p in pairs({"a": [slow], "b": [0.8 * slow], "c": [other]}, 60.0)]
    [('a', 'b')]
    """
    lag = max(1, round(CHANGE_MIN * 60.0 / period_s))
    probes = {name: values for name, values in measured.items() if name.removesuffix("_slope") not in AXES}
    changes = {name: np.concatenate([v[lag:] - v[:-lag] for v in values]) for name, values in probes.items()}
    found: dict[frozenset[str], tuple[float, float]] = {}
    for first, second in itertools.combinations(changes, 2):
        a, b = changes[first], changes[second]
        known = np.isfinite(a) & np.isfinite(b)
        if known.sum() > lag and np.ptp(a[known]) > 0.0 and np.ptp(b[known]) > 0.0:
            cross = np.cov(a[known], b[known])
            correlation = float(cross[0, 1] / np.sqrt(cross[0, 0] * cross[1, 1]))
            found[frozenset((first, second))] = (correlation, float(cross[0, 1] / cross[0, 0]))
    for first, second in itertools.combinations(changes, 2):
        correlation, ratio = found.get(frozenset((first, second)), (0.0, 0.0))
        beside = [abs(r) for names, (r, _) in found.items() if len(names & {first, second}) == 1]
        sign = math.copysign(1.0, correlation)
        if abs(correlation) >= PAIR and max(beside, default=0.0) <= OTHERS:
            yield Pair(
                first=first,
                second=second,
                correlation=correlation,
                others=max(beside, default=0.0),
                ratio=ratio,
                apart_um=max(_span(a - sign * b) for a, b in zip(probes[first], probes[second], strict=True)),
                share=any(first in group and second in group for group in shared),
            )


def _span(values: Vector) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if known.size else 0.0
