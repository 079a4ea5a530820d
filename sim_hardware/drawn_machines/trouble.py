"""What goes wrong beside the machine: sensors that fail, a mount that creeps, hands, pauses of the service."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["break", "jump", "stuck", "exchange", "creep", "slip", "period", "hand"]

#: Troubles of a temperature, and of the measurement of Y.
OF_TEMPERATURES: tuple[Kind, ...] = ("break", "jump", "stuck", "exchange")
OF_Y: tuple[Kind, ...] = ("creep", "slip", "period", "hand")
DAY_MIN = 1440


@dataclass(frozen=True, slots=True, kw_only=True)
class Trouble:
    """Something that is wrong for a time, and no effect of the machine.

    Parameters
    ----------
    kind : {"break", "jump", "stuck", "exchange", "creep", "slip", "period", "hand"}
        A couple breaks; reads wrong by a constant; repeats its value; T_Q and AT are exchanged. The mount of the
        displacement sensor, or of the feature that is probed, creeps; slips; sways (a sine of an hour); somebody leans
        on it.
    channel : str
        `t_q_degc`, `at_degc` or `y_um`.
    from_min, to_min : int
        First minute, and the first one after it. What has crept or slipped stays.
    size : float
        In K or µm: of a jump, slip or hand, of the whole creep, amplitude of a period.
    """

    kind: Kind
    channel: str
    from_min: int
    to_min: int
    size: float = 0.0

    def act(self, columns: dict[str, Array]) -> None:
        """Change what is read, in place; NaN is a broken couple. A channel that is not there is left out."""
        if self.channel not in columns:
            return
        during, values = slice(self.from_min, self.to_min), columns[self.channel]
        if self.kind == "break":
            values[during] = np.nan
        elif self.kind == "stuck":
            values[during] = values[self.from_min]
        elif self.kind == "exchange":
            at = columns["at_degc"]
            values[during], at[during] = at[during].copy(), values[during].copy()
        elif self.kind in ("jump", "hand"):
            values[during] += self.size
        else:
            values += self.shift_um(values.size)

    def shift_um(self, n: int) -> Array:
        """Return by how much the mount has moved, µm, shape (n,); 0 for what does not move it."""
        t = np.arange(n, dtype=np.float64)
        if self.kind == "period":
            return self.size * np.sin(2.0 * np.pi * (t - self.from_min) / 60.0) * self._during(t)
        if self.kind not in ("creep", "slip"):
            return np.zeros(n)
        grown = (t - self.from_min) / max(self.to_min - self.from_min, 1)
        return self.size * np.clip(grown, 0.0, 1.0)

    def _during(self, t: Array) -> Array:
        return ((t >= self.from_min) & (t < self.to_min)).astype(np.float64)


def draw_troubles(rng: np.random.Generator, days: int, *, probed: bool) -> tuple[Trouble, ...]:
    """Draw up to three troubles of a week; with touch probes the feature's mount may creep or slip."""
    found = []
    kinds = [*OF_TEMPERATURES, *(kind for kind in OF_Y if not (probed and kind in ("hand", "period")))]
    for kind in rng.choice(kinds, size=int(rng.integers(1, 4)), replace=False):
        begin = int(rng.uniform(0.5, days - 0.5) * DAY_MIN)
        minutes = int(rng.uniform(1.0, 20.0) * 60.0)
        sign = float(rng.choice([-1.0, 1.0]))
        channel, size = str(rng.choice(["t_q_degc", "at_degc"])), 0.0
        if kind == "exchange":
            channel = "t_q_degc"
        elif kind == "jump":
            size = sign * float(rng.uniform(1.5, 6.0))
        elif kind in OF_Y:
            channel = "y_um"
            size = sign * float(rng.uniform(4.0, 15.0)) * (0.5 if kind == "period" else 1.0)
            minutes = {"creep": minutes * 3, "slip": 1, "hand": int(rng.uniform(2.0, 15.0))}.get(str(kind), minutes)
        end = min(begin + minutes, days * DAY_MIN)
        found.append(Trouble(kind=str(kind), channel=channel, from_min=begin, to_min=end, size=size))  # type: ignore[arg-type]
    return tuple(sorted(found, key=lambda trouble: trouble.from_min))


def draw_visits(rng: np.random.Generator, troubles: Sequence[Trouble]) -> tuple[int, ...]:
    """Draw when a person has seen to a trouble, min; a new zero acknowledges what has moved or was exchanged."""
    found = []
    for trouble in troubles:
        if trouble.kind in ("creep", "slip"):
            found.append(trouble.from_min + int(rng.uniform(240.0, 600.0)))
        if trouble.kind in ("creep", "exchange", "jump", "stuck"):
            found.append(trouble.to_min + int(rng.uniform(20.0, 120.0)))
    return tuple(sorted(found))


def draw_pauses(rng: np.random.Generator, days: int) -> tuple[tuple[int, int], ...]:
    """Draw up to three times in which the service does not run: first minute, and the first one after it."""
    begins = rng.uniform(0.3, days - 0.1, size=int(rng.integers(0, 4))) * DAY_MIN
    return tuple((int(begin), int(begin + rng.uniform(2.0, 60.0))) for begin in sorted(begins))


def moved_um(troubles: Sequence[Trouble], n: int) -> Array:
    """Return by how much the measurement of Y has moved in all, µm, shape (n,)."""
    return np.asarray(np.sum([np.zeros(n), *(trouble.shift_um(n) for trouble in troubles)], axis=0))


def spoiled(columns: Mapping[str, Array], troubles: Sequence[Trouble]) -> dict[str, Array]:
    """Return what is read with all troubles."""
    found = {name: values.copy() for name, values in columns.items()}
    for trouble in troubles:
        trouble.act(found)
    return found
