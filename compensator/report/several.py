"""The further axes of a machine on the page of its recordings: figures of each, and its offset over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from compensator.axes import label_of
from compensator.codes import State
from compensator.messages_axes import SHOWN_UNITS, UNITS
from compensator.report.figure import Figure, Strip
from compensator.report.history import FOLLOWED, History, Period
from compensator.report.local_time import shown
from compensator.report.notation import or_null, plain, signed
from compensator.report.page import Block, Cell, CodeLink, Table


def unit_of(name: str) -> str:
    """Return the unit of a further output as it is shown: of an axis, a tilt (`a`, `b`) or a slope (`y_slope`).

    Examples
    --------
    >>> unit_of("z"), unit_of("a"), unit_of("y_slope")
    ('µm', 'µrad', 'µm/m')
    """
    return SHOWN_UNITS["um_per_m" if name.endswith("_slope") else UNITS[name]]


def title_of(name: str) -> str:
    """Return how a further output is named to people.

    Examples
    --------
    >>> title_of("z"), title_of("a"), title_of("y_slope")
    ('Z', 'tilt A', 'slope of Y')
    """
    if name.endswith("_slope"):
        return f"slope of {label_of(name.removesuffix('_slope'))}"
    return f"tilt {name.upper()}" if unit_of(name) == "µrad" else label_of(name)


def axis_blocks(history: History, curves: Callable[..., Figure], last: str) -> list[Block]:
    """Return a table of all further axes and a figure of each; nothing for a machine with Y alone.

    Parameters
    ----------
    history : History
        History read from the recordings.
    curves : callable
        Draws curves of the history: title, label, names with their curves.
    last : str
        Head of a column with the last time, with its zone.
    """
    if not history.axes:
        return []
    rows = [[*_row(name, figures), _reasons(history, name)] for name, figures in history.axes.items()]
    head = [
        "axis",
        "unit",
        "largest offset",
        "measured, rms",
        "remaining, rms",
        "residual, rms",
        "samples held",
        "reasons",
    ]
    note = "Measured, remaining and residual only where the axis has a displacement sensor. Y is above."
    blocks: list[Block] = [Table(title="Further axes", head=head, rows=rows, note=note)]
    blocks += _states_apart(history, last)
    for name, figures in history.axes.items():
        drawn = {"offset": f"axis {name} offset"}
        if figures.left.samples:
            drawn = {"measured": f"axis {name} measured", "remaining": f"axis {name} left"} | drawn
        title = title_of(name)
        blocks.append(curves(history, f"Offset: {title}", f"{title}, {unit_of(name)}", drawn))
    return blocks


def in_words(history: History) -> str:
    """Return what remains of the further axes that were measured, for the verdict; empty where none was."""
    found = [
        f"; {title_of(name)}: {figures.measured.rms:.1f} {unit_of(name)} rms, of which {figures.left.rms:.1f} remain"
        for name, figures in history.axes.items()
        if figures.left.samples
    ]
    found += [
        f"; {title_of(axis)} did not follow for {seconds / 60.0:.0f} min of it"
        for axis, seconds in unfollowed(history).items()
    ]
    return "".join(found)


def unfollowed(history: History) -> dict[str, float]:
    """Return for how long each further axis did not follow the machine while Y was in another state, s."""
    found: dict[str, float] = {}
    for (axis, state), seconds in history.apart_seconds.items():
        if state not in FOLLOWED:
            found[axis] = found.get(axis, 0.0) + seconds
    return found


def strips_apart(history: History) -> list[Strip]:
    """Return when each further axis was in another state than Y."""
    return [
        Strip(f"{title_of(axis)}: {state}", tuple(history.apart[axis, state].pieces), 1 if state == State.OK else 0)
        for axis, state in sorted(history.apart)
    ]


def _states_apart(history: History, last_at: str) -> list[Block]:
    rows: list[list[Cell]] = []
    for axis, state in sorted(history.apart):
        stretches, seconds = history.apart[axis, state], history.apart_seconds[axis, state]
        last = shown(stretches.pieces[-1][1])
        rows.append([title_of(axis), CodeLink(state), f"{seconds / 60.0:.0f}", str(stretches.count), last])
    head = ["axis", "state", "min", "times", last_at]
    title = "Where an axis was in another state than Y"
    return [Table(title=title, head=head, rows=rows)] if rows else []


def figures_of_axes(history: History) -> dict[str, Any]:
    """Return the figures of the further axes, for `--json`; nothing for a machine with Y alone."""
    found = {
        name: {
            "unit": unit_of(name),
            "largest_offset": or_null(figures.offset.peak),
            "measured_rms": or_null(figures.measured.rms),
            "left_rms": or_null(figures.left.rms),
            "residual_rms": or_null(figures.residual.rms),
            **_minutes_apart(history, name),
        }
        for name, figures in history.axes.items()
    }
    return {"axes": found} if found else {}


def _minutes_apart(history: History, name: str) -> dict[str, Any]:
    own = {state: round(s / 60.0, 1) for (axis, state), s in history.apart_seconds.items() if axis == name}
    return {"minutes_unlike_y": own} if own else {}


def _row(name: str, figures: Period) -> list[Any]:
    held = figures.seconds.get("hold", 0.0) + figures.seconds.get("fault", 0.0)
    return [
        title_of(name),
        unit_of(name),
        signed(figures.offset.peak, 1),
        plain(figures.measured.rms, 2),
        plain(figures.left.rms, 2),
        plain(figures.residual.rms, 2),
        f"{held:.0f}",
    ]


def _reasons(history: History, name: str) -> str:
    """Return the reasons of an axis with the number of their samples, the most frequent first."""
    return ", ".join(f"{reason} {count}" for reason, count in history.axis_reasons[name].most_common()) or "none"
