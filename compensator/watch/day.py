"""The last day of a machine in the terminal: sparklines and a strip of states."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from compensator.clock import NS
from compensator.report.local_time import here
from compensator.report.notation import plain
from compensator.watch.words import TONES

_BARS = "▁▂▃▄▅▆▇█"
#: Bar of each severity: higher is worse, so that the strip is readable without colour.
_STRIP = {"good": "▁", "warn": "▄", "bad": "█"}
#: Colour of each severity.
STYLES = {"good": "green", "warn": "yellow", "bad": "bold red"}
#: Rows: name, column of the history, unit.
_ROWS = (
    ("offset", "y_offset_um", "µm"),
    ("DTF", "y_dtf_um", "µm"),
    ("TDTF", "y_tdtf_um", "µm"),
    ("effects", "effects", "µm"),
    ("residual", "residual_um", "µm"),
    ("T_Q", "t_q_degc", "°C"),
    ("AT", "at_degc", "°C"),
)
_SHORT = ("offset", "residual")
#: Width of the name before and the range after the bars.
_BESIDE = 38


def drawn(history: Mapping[str, Sequence[Any]], width: int, *, short: bool = False) -> list[RenderableType]:
    """Return the last day as sparklines with range and unit, and a strip of states.

    Parameters
    ----------
    history : mapping of str to sequence
        Columns as in `MachineHistory`.
    width : int
        Available width, characters.
    short : bool
        Offset, residual and states only.
    """
    t_s = history.get("t_s", ())
    count = max(width - _BESIDE, 12)
    lines: list[RenderableType] = []
    for name, column, unit in _ROWS:
        if short and name not in _SHORT:
            continue
        series = _summed(history.get(column, ())) if column == "effects" else list(history.get(column, ()))
        values = [value for value in series if value is not None]
        if len(values) < 2:
            continue
        extent = f"{plain(min(values), 1)} to {plain(max(values), 1)} {unit}"
        bars = sparkline(evenly(t_s, series, count))
        lines.append(Text.assemble((f"{name:<9}", "dim"), f"{bars:<{count}}", f" {extent}"))
    if lines:
        wide = min(count, len(t_s))
        lines += [_strip(t_s, history["state"], wide), _axis(t_s, wide)]
    return lines


def _summed(effects: Sequence[Sequence[float | None]]) -> list[float | None]:
    return [sum(part) if part and None not in part else None for part in effects]  # type: ignore[arg-type]


def _strip(t_s: Sequence[float], states: Sequence[str | None], count: int) -> Text:
    """Draw the worst state of each part; a part without messages is blank."""
    order = ("good", "warn", "bad")
    worst = [-1] * count
    span = max(t_s[-1] - t_s[0], 1e-9)
    for t, state in zip(t_s, states, strict=True):
        i = min(int((t - t_s[0]) / span * count), count - 1)
        if state is not None:
            worst[i] = max(worst[i], order.index(TONES.get(state, "bad")))
    text = Text.assemble(("state    ", "dim"))
    for level in worst:
        text.append(" " if level < 0 else _STRIP[order[level]], style="" if level < 0 else STYLES[order[level]])
    return text.append(" ▁ ok ▄ caution █ hold, fault", style="dim")


def _axis(t_s: Sequence[float], count: int) -> Text:
    begin, end = (f"{here(round(t * NS)):%H:%M}" for t in (t_s[0], t_s[-1]))
    line = begin + f"{end:>{max(count - len(begin), len(end) + 1)}}"
    return Text(f"{'':<9}{line} {(t_s[-1] - t_s[0]) / 3600.0:.1f} h", style="dim")


def evenly(t_s: Sequence[float], values: Sequence[float | None], width: int) -> list[float | None]:
    """Return means over at most `width` equal steps of time; None where there is no value."""
    if len(t_s) < 2 or t_s[-1] <= t_s[0]:
        return list(values)
    count = min(width, len(t_s))
    parts: list[list[float]] = [[] for _ in range(count)]
    for t, value in zip(t_s, values, strict=True):
        if value is not None and math.isfinite(value):
            parts[min(int((t - t_s[0]) / (t_s[-1] - t_s[0]) * count), count - 1)].append(value)
    return [sum(part) / len(part) if part else None for part in parts]


def sparkline(values: Sequence[float | None]) -> str:
    """Draw values as bars; a missing value is blank.

    Examples
    --------
    >>> sparkline([0.0, 1.0, None, 2.0])
    '▁▅ █'
    """
    known = [value for value in values if value is not None]
    low, high = min(known, default=0.0), max(known, default=0.0)
    scale = (len(_BARS) - 1) / (high - low) if high > low else 0.0
    return "".join(" " if value is None else _BARS[round((value - low) * scale)] for value in values)
