"""The page of ten simulated days: the error of each day with the first model and with the loop, and what it decided."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.events import EventKind, LoopAction
from compensator.messages import Event
from compensator.report.figure import Edges
from compensator.report.page import Block, Cell, Figure, Line, Marks, Page, Section, Table, Words
from compensator.report.story import Story, story_tables

DAYS = 10
_DAY_H = 24.0
_NS_H = 3600e9
_NAMES = {"sensor": "machine with a displacement sensor", "probes": "machine with a touch probe each hour"}
#: Decisions of the loop on the picture, and their points.
_MARKED = (
    (LoopAction.SHADOW, "in shadow", "x"),
    (LoopAction.ADOPT, "adopted", "o"),
    (LoopAction.BACK, "gone back", "x"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Times:
    """When something happens to both machines, h since the start."""

    first_begins_h: float
    second_begins_h: float
    break_h: float
    repaired_h: float
    first_ends_h: float

    def told(self) -> list[tuple[float, str, str]]:
        """Return what happens, in order: when, in a word for the picture, and in a sentence."""
        return [
            (
                self.first_begins_h,
                "bearing heats",
                "the bearing begins to heat the nose, which no calibration has seen",
            ),
            (self.second_begins_h, "fan motor heats", "the motor of the fan begins to heat the column"),
            (
                self.break_h,
                "T_Q breaks",
                f"the couple of T_Q breaks, for {self.repaired_h - self.break_h:g} h: the offset is held",
            ),
            (self.first_ends_h, "bearing stops", "the bearing no longer heats"),
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineDays:
    """Ten days of a machine.

    Parameters
    ----------
    name : str
        `sensor` or `probes`.
    is_probed : bool
        Whether Y is measured by a touch probe.
    times : Times
        What happens to it.
    start_ns : int
        Start, ns since 1970 UTC.
    t_h, first_um, loop_um : numpy.ndarray, shape (n,)
        Time in h; error with the first model and with the loop, µm.
    model_sha256 : sequence of str, length n
        The model in force.
    events : sequence of Event
        Events of the loop.
    """

    name: str
    is_probed: bool
    times: Times
    start_ns: int
    t_h: Vector
    first_um: Vector
    loop_um: Vector
    model_sha256: Sequence[str]
    events: Sequence[Event]

    def by_day(self, error_um: Vector) -> Vector:
        """Return the root mean square of an error for each day, shape (10,), µm."""
        day = np.minimum(self.t_h // _DAY_H, DAYS - 1).astype(int)
        squares = np.bincount(day, weights=error_um**2, minlength=DAYS)
        return np.asarray(np.sqrt(squares / np.bincount(day, minlength=DAYS)))

    def decided(self, *actions: str) -> list[tuple[float, Event]]:
        """Return the decisions of these kinds with their times, h."""
        return [
            ((event.time_utc_ns - self.start_ns) / _NS_H, event)
            for event in self.events
            if event.kind == EventKind.LOOP and event.data.get("step") in actions
        ]

    def during_break(self) -> list[Event]:
        """Return what came from the broken couple.

        It was adopted or gone back to while the couple was broken, or within two hours after it if found since then.
        """
        broken_h, mended_h, found = self.times.break_h, self.times.repaired_h, list[Event]()
        for t_h, event in self.decided(LoopAction.ADOPT, LoopAction.BACK):
            began_h = (event.data.get("since_utc_ns", 0) - self.start_ns) / _NS_H
            if broken_h <= t_h <= mended_h or broken_h <= began_h <= t_h <= mended_h + 2.0:
                found.append(event)
        return found

    def figures(self) -> dict[str, Any]:
        """Return the figures for `--json`."""
        return {
            "rms_um_by_day": {
                "first_model": self.by_day(self.first_um).tolist(),
                "loop": self.by_day(self.loop_um).tolist(),
            },
            "happens_h": asdict(self.times),
            "decisions": [
                {
                    "time_h": t_h,
                    "step": event.data["step"],
                    "effects": event.data.get("effects", []),
                    "text": event.text,
                }
                for t_h, event in self.decided(*LoopAction)
            ],
            "models": len(set(self.model_sha256)),
        }


def days_table(days: Sequence[MachineDays]) -> Table:
    """Return the error of each day."""
    head = ["day", "what acts"]
    for one in days:
        head += [f"{one.name}: first model", "with the loop"]
    columns = [values for one in days for values in (one.by_day(one.first_um), one.by_day(one.loop_um))]
    rows: list[list[Cell]] = []
    for day in range(DAYS):
        rows.append([str(day + 1), _acting(days[0].times, day), *(f"{column[day]:.2f}" for column in columns)])
    note = "Error in Y against the true deformation of the simulated machine, µm rms over each day."
    return Table(title="Error of each day, µm rms", head=head, rows=rows, note=note)


def _acting(times: Times, day: int) -> str:
    begin, end = _DAY_H * day, _DAY_H * (day + 1)
    parts = []
    if times.first_begins_h < end and times.first_ends_h > begin:
        ends = f" until hour {times.first_ends_h - begin:.0f}" if times.first_ends_h < end else ""
        parts.append(f"bearing{_from_hour(times.first_begins_h, begin)}{ends}")
    if times.second_begins_h < end:
        parts.append(f"fan motor{_from_hour(times.second_begins_h, begin)}")
    if begin <= times.break_h < end:
        parts.append("T_Q broken")
    return ", ".join(parts) or "nothing"


def _from_hour(begins_h: float, day_h: float) -> str:
    return f" from hour {begins_h - day_h:.0f}" if begins_h > day_h else ""


def days_verdict(days: Sequence[MachineDays]) -> str:
    """Return the result: what the loop reduced, and on which days it made the error larger."""
    parts = []
    for one in days:
        acting = one.t_h >= one.times.first_begins_h
        first, loop = (float(np.sqrt(np.mean(error[acting] ** 2))) for error in (one.first_um, one.loop_um))
        parts.append(f"from {first:.1f} to {loop:.1f} µm rms on the {_NAMES[one.name]}")
    wrong = sum(len(one.during_break()) for one in days)
    broken = f"{wrong} change(s) came from a broken couple" if wrong else "nothing was adopted from a broken couple"
    text = (
        "Two effects that no calibration has seen came, and one went; from the first one to the end of day 10 the "
        f"loop changed the error, the time to learn included, {', and '.join(parts)}; {broken}."
    )
    return " ".join([text, *(worse for one in days if (worse := _worse_days(one)))])


def _worse_days(one: MachineDays) -> str:
    """Return in a sentence on which days the loop leaves more than the first model by 5 % and 0.05 µm."""
    pairs = enumerate(zip(one.by_day(one.first_um), one.by_day(one.loop_um), strict=True), start=1)
    worse = [
        f"day {day} ({loop:.1f} instead of {first:.1f} µm)"
        for day, (first, loop) in pairs
        if loop > max(1.05 * first, first + 0.05)
    ]
    return f"Worse than with the first model alone on the {_NAMES[one.name]}: {', '.join(worse)}." if worse else ""


def days_page(days: Sequence[MachineDays]) -> Page:
    """Make the page."""
    bad = any(
        one.during_break() or _worse_days(one) or np.mean(one.loop_um**2) >= np.mean(one.first_um**2) for one in days
    )
    happens: list[Cell] = [
        f"Day {h // _DAY_H + 1:.0f}, hour {h % _DAY_H:.0f}: {words}." for h, _, words in days[0].times.told()
    ]
    blocks: list[Block] = [
        _picture(days),
        Words(title="What happens to both machines", lines=happens),
        days_table(days),
        *(section for one in days for section in _decisions(one)),
    ]
    return Page(title="Ten days unattended", verdict=days_verdict(days), blocks=blocks, tone="warn" if bad else "good")


def _picture(days: Sequence[MachineDays]) -> Figure:
    panels = [_panel(one) for one in days]
    note = (
        "Above the machine with a displacement sensor, below the one with a touch probe each hour. Each step is one "
        "day; vertical lines: what happens to the machine; points: what the loop decided."
    )
    title = "Error of each day with the first model, and with the loop"
    return replace(panels[0], title=title, below=tuple(panels[1:]), note=note)


def _panel(one: MachineDays) -> Figure:
    first, loop = one.by_day(one.first_um), one.by_day(one.loop_um)
    top = 1.15 * float(max(first.max(), loop.max()))
    marks = []
    for action, words, marker in _MARKED:
        at = np.array([t_h / _DAY_H + 1.0 for t_h, _ in one.decided(action)])
        if at.size:
            marks.append(Marks(words, at, np.full(at.size, top), marker=marker))  # type: ignore[arg-type]
    changes = tuple(Edges(words, (t_h / _DAY_H + 1.0,)) for t_h, words, _ in one.times.told())
    return Figure(
        title="",
        x_label="day of the run, 1 to 10",
        y_label=f"{'probe' if one.is_probed else 'sensor'}: rms, µm",
        lines=(_steps("first model", first), _steps("with the loop", loop)),
        marks=tuple(marks),
        edges=changes,
        x_limits=(1.0, DAYS + 1.0),
        limits=(0.0,),
        height=2.6,
    )


def _steps(name: str, by_day: Vector) -> Line:
    """Return the values of days as a curve of steps."""
    days = np.arange(1.0, by_day.size + 1.0)
    return Line(name, np.column_stack((days, days + 1.0)).ravel(), np.repeat(by_day, 2), weight=2.0)


def _decisions(one: MachineDays) -> Iterator[Section]:
    story = Story()
    for event in one.events:
        story.add(event)
    yield Section(title=f"What the loop decided: {_NAMES[one.name]}", blocks=story_tables(story))
