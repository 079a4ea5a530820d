"""The page of a machine's recordings over a day, a week or a year."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from compensator.clock import NS
from compensator.codes import AuditRemark, RecordingEnd, Remark, State, explain
from compensator.report.envelope import line_of
from compensator.report.history import (
    EPISODES,
    EVENTS,
    FOLLOWED,
    NO_RECORDING,
    PROBES,
    Episode,
    History,
    Period,
    ProbeShown,
    Spread,
)
from compensator.report.local_time import here, shown, zone, zone_at
from compensator.report.notation import or_null, plain, signed
from compensator.report.page import (
    Block,
    Cell,
    CodeLink,
    Details,
    Figure,
    Marks,
    Page,
    Section,
    Span,
    Strip,
    Table,
    Tone,
    Words,
    warnings_of,
)
from compensator.report.several import axis_blocks, figures_of_axes, strips_apart, unfollowed
from compensator.report.several import in_words as axes_in_words
from compensator.report.story import figures_of, in_words, story_section

#: Order of the states on the page.
STATES = (State.OK, State.DEGRADED, State.STARTING, State.HOLD, State.FAULT, NO_RECORDING)
#: Share of the time without a following offset (or degraded) above which the verdict is worse.
_MUCH = 0.1
#: A remaining error beyond this multiple of the stated standard deviation is attributed to the model or a sensor.
_BEYOND = 3.0
#: Longest table of days; more days are summed by months.
_DAYS = 31
#: Longest table that is shown unfolded, rows.
_ROWS = 12
#: Largest numbers of curves and of shaded intervals in a figure.
_CURVES, _SHADED = 5, 100
_UNITS = (
    ("_degc", "temperature, °C"),
    ("_um", "displacement, µm"),
    ("_w", "power, W"),
    ("_rpm", "speed, 1/min"),
    ("_k", "temperature difference, K"),
    ("_pct", "share, %"),
    ("_a", "current, A"),
    ("_v", "voltage, V"),
    ("_bar", "pressure, bar"),
    ("_l_per_min", "flow, l/min"),
)


def page_of(history: History) -> Page:
    """Make the page of a machine's recordings.

    Parameters
    ----------
    history : History
        History read from the recordings.
    """
    beyond = _beyond(history.whole)
    blocks: list[Block] = [
        _offset(history),
        *warnings_of([beyond] if beyond else []),
        *_story(history),
        _band(history),
        _figures(history),
        *axis_blocks(history, _curves, _in_zone("last", history)),
        _states(history),
    ]
    if history.reasons:
        blocks.append(_reasons(history))
    if history.episodes:
        blocks.append(_episodes(history))
    blocks += [
        _shares(history),
        *_residual(history),
        *_probes(history),
        *_temperatures(history),
        *_days(history),
        _missed(history),
    ]
    blocks += [_events(history), *_other_channels(history), _files(history)]
    return Page(
        title=f"{history.machine or 'Recordings'}: {span(history)}",
        verdict=verdict(history),
        blocks=blocks,
        tone=_tone(history),
        data=tuple(file.name for file in history.files),
    )


def figures(history: History) -> dict[str, object]:
    """Return the figures of the page, for `--json`."""
    whole = history.whole
    return {
        "machine": history.machine,
        "from_utc": _utc(history.first_s),
        "to_utc": _utc(history.last_s),
        "samples": whole.samples,
        "files": len(history.files),
        "minutes": {state: round(seconds / 60.0, 1) for state, seconds in whole.seconds.items()},
        "largest_offset_um": or_null(whole.offset.peak),
        "residual_rms_um": or_null(whole.residual.rms),
        "measured_rms_um": or_null(whole.measured.rms),
        "left_rms_um": or_null(whole.left.rms),
        "models": list(history.models),
        **_probe_figures(history),
        **figures_of(history.story),
        **figures_of_axes(history),
        "events": history.events_count,
        "alarms": history.episodes_count,
    }


def span(history: History) -> str:
    """Return the interval that the recordings cover."""
    first, last = (here(round(t * NS)) for t in (history.first_s, history.last_s))
    same_day = first.date() == last.date()
    return f"{first:%Y-%m-%d %H:%M} to {last:{'%H:%M' if same_day else '%Y-%m-%d %H:%M'}} {zone(last)}"


def verdict(history: History) -> str:
    """Return the result in one sentence."""
    whole, seconds = history.whole, history.whole.seconds
    total = sum(seconds.values())
    followed = sum(seconds[state] for state in FOLLOWED)
    # "All" only if nothing is missing.
    share = "all" if followed == total else f"{min(100.0 * followed / total, 99.9):.1f} %"
    words = f"The offset followed the machine for {share} of {_hours(total)}"
    if whole.left.samples:
        words += (
            f"; the measured error in Y was {whole.measured.rms:.1f} µm rms, of which {whole.left.rms:.1f} remain with "
            f"the offset applied{_against_stated(whole)}"
        )
    elif whole.offset.samples:
        words += f"; it reached {signed(whole.offset.peak, 1)} µm"
    words += axes_in_words(history)
    if history.probes_left.samples and not whole.left.samples:
        left = history.probes_left
        words += f"; {left.samples} probe(s) found {left.rms:.1f} µm rms with the offset applied"
    return f"{words}. {in_words(history.story)}".rstrip()


def _against_stated(whole: Period) -> str:
    """Compare the remaining error with the standard deviation that the service states."""
    if _beyond(whole) is not None:
        return (
            f": {whole.left.rms / whole.std.rms:.0f} times the standard deviation of {_short(whole.std.rms)} that the "
            "service states, so the model lacks an effect or a sensor is faulty"
        )
    return f" (the service states a standard deviation of {_short(whole.std.rms)})" if whole.std.rms > 0.0 else ""


def _beyond(whole: Period) -> Remark | None:
    """Warn if the remaining error exceeds the standard deviation that the service states."""
    if not (whole.left.samples and 0.0 < _BEYOND * whole.std.rms < whole.left.rms):
        return None
    remains = (
        f"{_short(whole.left.rms)} rms remain with the offset applied; the service states {_short(whole.std.rms)}."
    )
    return Remark(AuditRemark.LEFT_BEYOND_STATED, remains)


def _short(value_um: float) -> str:
    return f"{value_um:.2f} µm" if value_um < 1.0 else f"{value_um:.1f} µm"


def _tone(history: History) -> Tone:
    seconds = history.whole.seconds
    total = sum(seconds.values())
    without = total - sum(seconds[state] for state in FOLLOWED) + max(unfollowed(history).values(), default=0.0)
    worse = history.whole.left.samples and history.whole.left.rms > history.whole.measured.rms
    if State.FAULT in history.states or without > _MUCH * total or worse:
        return "bad"
    doubtful = without or seconds[State.DEGRADED] > _MUCH * total or _beyond(history.whole) is not None
    return "warn" if doubtful else "good"


# ---------------------------------------------------------------------------- figures


def _curves(
    history: History,
    title: str,
    y_label: str,
    curves: Mapping[str, str],
    note: str = "",
    height: float = 2.8,
    spans: tuple[Span, ...] = (),
) -> Figure:
    drawn = [(name, history.curves[key]) for name, key in curves.items() if key in history.curves]
    lines = tuple(line_of(name, curve) for name, curve in drawn)
    if any(line.band is not None for line in lines):
        note = f"{note} Lines are means; the band spans the lowest and highest values.".strip()
    return Figure(
        title=title,
        x_label=_in_zone("time", history),
        y_label=y_label,
        lines=lines,
        clock=True,
        local=True,
        height=height,
        note=note,
        x_limits=(history.first_s, history.last_s),
        spans=spans,
    )


def _offset(history: History) -> Figure:
    held = [
        Span("offset held", *piece)
        for state in (State.HOLD, State.FAULT)
        if state in history.states
        for piece in history.states[state].pieces
    ]
    curves = {"offset": "offset"}
    words = f"Largest offset {signed(history.whole.offset.peak, 1)} µm."
    if history.whole.left.samples:
        curves = {"measured": "measured", "remaining (measured + offset)": "left"} | curves
        words += f" Remaining error: {history.whole.left.rms:.2f} µm rms."
    return _curves(history, "Offset and remaining error", "Y, µm", curves, words, 3.4, tuple(held[:_SHADED]))


def _story(history: History) -> list[Block]:
    """Return the story of the models; nothing if none was found, compared or changed."""
    if history.story.is_empty:
        return []
    left = {}
    for date, day in history.days.items():
        noon = datetime.fromisoformat(f"{date}T12:00:00+00:00").timestamp()
        left[noon] = day.left.rms if day.left.samples else day.probed.rms
    section = story_section(
        history.story,
        left_by_day=left,
        in_force={sha: stretches.pieces for sha, stretches in history.in_force.items()},
        names={sha: name for sha, (name, _) in history.models.items()},
        x_limits=(history.first_s, history.last_s),
    )
    return [section]


def _band(history: History) -> Figure:
    strips = [
        Strip(state, tuple(history.states[state].pieces), 1 if state == State.OK else 0)
        for state in STATES
        if state in history.states
    ]
    strips += strips_apart(history)
    strips += [Strip(reason, tuple(stretch.pieces), 3) for reason, stretch in history.reasons.items()]
    if history.events:
        strips.append(Strip("events", tuple((t, t) for t, _, _ in history.events), 4))
    shares = [f"{state} {_share(history, state)}" for state in STATES if state in history.states]
    return Figure(
        title="States and reasons",
        x_label=_in_zone("time", history),
        y_label="state, reason",
        strips=tuple(strips),
        clock=True,
        local=True,
        x_limits=(history.first_s, history.last_s),
        height=1.1 + 0.27 * len(strips),
        note=f"{', '.join(shares)}.",
    )


def _shares(history: History) -> Figure:
    curves = {key.removeprefix("share "): key for key in history.curves if key.startswith("share ")}
    note = "Since the zero. The offset is the negative sum, within its limits."
    if "share probes" in history.curves:
        note = (
            "Since the zero. The correction by touch probes (probes) is a share of its own; the offset is the negative "
            "sum of all shares, within its limits."
        )
    return _curves(history, "Predicted deformation by path", "Y, µm", curves, note)


def _residual(history: History) -> list[Block]:
    residual = history.whole.residual
    if not residual.samples:
        if history.probes_count:
            return []
        return [Words(title="Residual", lines=["Y was not measured: there is no residual."])]
    note = f"{residual.rms:.2f} µm rms; the largest is {signed(residual.peak, 1)} µm, {shown(residual.at_s)}."
    return [_curves(history, "Residual, measured − predicted", "residual, µm", {"residual": "residual"}, note)]


def _probes(history: History) -> list[Block]:
    """Return measured against predicted deformation at the probes, and the probes that were refused."""
    if not history.probes_count:
        return []
    taken = [probe for probe in history.probes if probe.taken]
    refused = [probe for probe in history.probes if not probe.taken]
    marks = [_marks("taken", taken, "o"), _marks("refused", refused, "x")]
    lines = tuple(line_of(name, history.curves[name]) for name in ("predicted",) if name in history.curves)
    left = history.probes_left
    note = f"{history.probes_taken} of {history.probes_count} probe(s) taken."
    if left.samples:
        note += (
            f" Remaining error at these, with the offset applied and the probe's own noise: {left.rms:.2f} µm rms, the "
            f"largest {signed(left.peak, 1)} µm, {shown(left.at_s)}."
        )
    figure = Figure(
        title="Touch probes, measured against predicted deformation",
        x_label=_in_zone("time", history),
        y_label="Y, µm",
        lines=lines,
        marks=tuple(mark for mark in marks if mark.x.size),
        clock=True,
        local=True,
        note=note,
        x_limits=(history.first_s, history.last_s),
    )
    rows: list[list[Cell]] = [
        [
            shown(probe.at_s),
            probe.feature or "without a name",
            plain(probe.deformation_um, 2),
            plain(probe.predicted_um, 2),
            signed(probe.left_um, 2),
            "taken" if probe.taken else "refused",
            CodeLink(probe.code) if probe.code else "",
        ]
        for probe in history.probes
    ]
    head = [
        _in_zone("time", history),
        "feature",
        "measured, µm",
        "predicted, µm",
        "left with the offset, µm",
        "",
        "code",
    ]
    last = f"The last {PROBES} of {history.probes_count}. " if history.probes_count > PROBES else ""
    words = "Measured: the deformation, measured value less offset applied. Each feature has its own zero."
    return [figure, _folded("Probes", head, rows, f"{last}{words}")]


def _marks(name: str, probes: Sequence[ProbeShown], marker: Literal["x", "o"]) -> Marks:
    read = [probe for probe in probes if not math.isnan(probe.deformation_um)]
    x, y = (np.array([getattr(probe, key) for probe in read]) for key in ("at_s", "deformation_um"))
    return Marks(name, x, y, marker=marker)


def _probe_figures(history: History) -> dict[str, object]:
    if not history.probes_count:
        return {}
    left_um = or_null(history.probes_left.rms)
    return {"probes": history.probes_count, "probes_taken": history.probes_taken, "probes_left_rms_um": left_um}


def _temperatures(history: History) -> list[Block]:
    curves = {"T_Q": "channel t_q_degc", "AT": "channel at_degc"}
    heat = _curves(history, "Heat, estimated from T_Q and AT", "heat, W", {"heat": "heat"}, height=2.4)
    note = "Gaps: no usable value."
    temperatures = _curves(history, "Temperatures used by the model", "temperature, °C", curves, note, 2.6)
    return [temperatures, heat] if history.curves["heat"].known else [temperatures]


def _other_channels(history: History) -> list[Block]:
    groups: defaultdict[str, list[str]] = defaultdict(list)
    for name in history.channels:
        if name not in ("t_q_degc", "at_degc", "y_um"):
            unit = next((words for ending, words in _UNITS if name.endswith(ending)), f"{name}, unit as in its name")
            groups[unit].append(name)
    pictures = [
        _curves(
            history,
            f"Other channels: {unit.partition(',')[0]}",
            unit,
            {name: f"channel {name}" for name in names[i : i + _CURVES]},
            height=2.4,
        )
        for unit, names in groups.items()
        for i in range(0, len(names), _CURVES)
    ]
    return [Details(title="Other channels", blocks=pictures)] if pictures else []


# ---------------------------------------------------------------------------- tables


def _figures(history: History) -> Table:
    whole = history.whole
    rows = [
        ["largest offset", signed(whole.offset.peak, 1), "µm", _at(whole.offset)],
        ["largest standard deviation of the offset", plain(whole.std.peak, 2), "µm", _at(whole.std)],
        ["measured error in Y, rms", plain(whole.measured.rms, 2), "µm", ""],
        ["remaining error, rms", plain(whole.left.rms, 2), "µm", ""],
        ["largest remaining error", signed(whole.left.peak, 1), "µm", _at(whole.left)],
        ["residual, rms", plain(whole.residual.rms, 2), "µm", ""],
        ["samples", str(whole.samples), "", ""],
    ]
    if history.probes_count:
        left = history.probes_left
        rows[-1:-1] = [
            ["remaining error at the probes, rms", plain(left.rms, 2), "µm", ""],
            ["largest remaining error at a probe", signed(left.peak, 1), "µm", _at(left)],
            ["probes taken", f"{history.probes_taken} of {history.probes_count}", "", ""],
        ]
    note = "" if whole.measured.samples else "Y was not measured: –."
    if history.probes_count and not whole.measured.samples:
        note = "Y was measured by touch probes only: a remaining error is known at their times."
    return Table(title="Figures", head=["", "value", "unit", "when"], rows=rows, note=note)


def _states(history: History) -> Table:
    rows: list[list[Cell]] = []
    for state in STATES:
        if state in history.states:
            seconds, times = history.whole.seconds[state], history.states[state].count
            meaning, action = explain(state) or ("The service did not run.", "See the events before and after.")
            cell: Cell = state if state == NO_RECORDING else CodeLink(state)
            rows.append([cell, _minutes(seconds), _share(history, state), str(times), meaning, action])
    head = ["state", "min", "share", "times", "meaning", "action"]
    note = "The state of Y." if history.axes else ""
    return Table(title="Time in each state", rows=rows, head=head, note=note)


def _reasons(history: History) -> Table:
    rows: list[list[Cell]] = []
    for reason, stretch in sorted(history.reasons.items(), key=lambda item: -history.reason_seconds[item[0]]):
        meaning, action = explain(reason) or ("", "")
        seconds, last = history.reason_seconds[reason], stretch.pieces[-1][1]
        rows.append([CodeLink(reason), _minutes(seconds), str(stretch.count), shown(last), meaning, action])
    return Table(
        title="Reasons",
        rows=rows,
        head=["reason", "min", "times", _in_zone("last", history), "meaning", "action"],
    )


def _episodes(history: History) -> Block:
    def row(episode: Episode) -> list[Cell]:
        reasons: list[str | CodeLink] = []
        for reason in episode.reasons:
            reasons += [", ", CodeLink(reason)] if reasons else [CodeLink(reason)]
        state: Cell = CodeLink(episode.state) if episode.state else NO_RECORDING
        return [shown(episode.first_s), _minutes(episode.seconds), state, tuple(reasons)]

    note = f"The longest {EPISODES} of {history.episodes_count}." if history.episodes_count > EPISODES else ""
    rows = [row(episode) for episode in history.episodes]
    return _folded(
        "Alarms: every interval not in state ok",
        [_in_zone("from", history), "min", "state", "reasons"],
        rows,
        note,
    )


def _days(history: History) -> list[Block]:
    if len(history.days) < 2:
        return []
    head = [
        "day",
        "samples",
        "ok, min",
        "degraded, min",
        "held, min",
        "no recording, min",
        "largest offset, µm",
        "remaining error, µm rms",
        "residual, µm rms",
    ]
    days = [_day(date, period) for date, period in sorted(history.days.items())]
    if len(days) <= _DAYS:
        return [Table(title="Day by day", head=head, rows=days)]
    months: defaultdict[str, Period] = defaultdict(Period)
    for date, period in sorted(history.days.items()):
        months[date[:7]].join(period)
    rows = [_day(month, period) for month, period in months.items()]
    return [
        Table(title="Month by month", head=["month", *head[1:]], rows=rows),
        Details(title=f"Day by day, {len(days)} days", blocks=[Table(head=head, rows=days)]),
    ]


def _day(name: str, period: Period) -> list[Cell]:
    seconds = period.seconds
    held = sum(seconds[state] for state in (State.STARTING, State.HOLD, State.FAULT))
    times = (seconds[State.OK], seconds[State.DEGRADED], held, seconds[NO_RECORDING])
    return [
        name,
        str(period.samples),
        *map(_minutes, times),
        signed(period.offset.peak, 1),
        plain(period.left.rms, 2),
        plain(period.residual.rms, 2),
    ]


def _missed(history: History) -> Block:
    rows: list[list[Cell]] = []
    for name, missed in history.channels.items():
        if missed.missing or missed.errors:
            why = _codes(missed.qualities)
            rows.append(
                [
                    name,
                    f"{missed.missing}",
                    f"{100.0 * missed.missing / missed.samples:.1f} %",
                    why,
                    _codes(missed.errors),
                ]
            )
    if not rows:
        return Words(title="Missing values", lines=["None: every channel had a good value in every sample."])
    whole = len(history.channels) - len(rows)
    return Table(
        title="Missing values",
        rows=rows,
        head=["channel", "samples missing", "share", "reason", "single bad readings"],
        note=f"{whole} other channel(s): no missing value." if whole else "",
    )


def _codes(counts: Mapping[str, int]) -> Cell:
    parts: list[str | CodeLink] = []
    for code, number in sorted(counts.items(), key=lambda item: -item[1]):
        parts += [", ", CodeLink(code), f" {number}"] if parts else [CodeLink(code), f" {number}"]
    return tuple(parts) or ""


def _events(history: History) -> Block:
    rows: list[list[Cell]] = [[shown(t), kind, text] for t, kind, text in history.events]
    note = f"The last {EVENTS} of {history.events_count}." if history.events_count > EVENTS else ""
    return _folded("Events", [_in_zone("time", history), "kind", "event"], rows, note)


def _files(history: History) -> Details:
    files: list[list[Cell]] = [
        [
            file.name,
            str(file.samples),
            shown(file.first_s),
            shown(file.last_s),
            CodeLink(file.end) if isinstance(file.end, RecordingEnd) else file.end,
        ]
        for file in history.files
    ]
    models: list[list[Cell]] = [[name, shown(first), sha] for sha, (name, first) in history.models.items()]
    return Details(
        title=f"{len(files)} recording(s), {len(models)} model(s)",
        blocks=[
            Table(
                title="Recordings",
                head=[
                    "file",
                    "samples",
                    _in_zone("first", history),
                    _in_zone("last", history),
                    "end",
                ],
                rows=files,
                note="Integrity is not checked here; use compensator replay.",
            ),
            Table(title="Models", head=["model", _in_zone("from", history), "SHA-256"], rows=models),
        ],
    )


def _folded(title: str, head: Sequence[str], rows: Sequence[Sequence[Cell]], note: str) -> Block:
    """Return a table, folded if it is long."""
    if len(rows) <= _ROWS:
        return Table(title=title, head=head, rows=rows, note=note)
    table = Table(head=head, rows=rows, note=note)
    return Section(title=title, blocks=[Details(title=f"All {len(rows)}", blocks=[table])])


# ---------------------------------------------------------------------------- text


def _in_zone(words: str, history: History) -> str:
    """Return the label of a time with its zone."""
    return f"{words}, {zone_at(history.last_s)}"


def _utc(t_s: float) -> str | None:
    return None if math.isnan(t_s) else f"{datetime.fromtimestamp(t_s, UTC):%Y-%m-%d %H:%M}"


def _at(spread: Spread) -> str:
    return "" if math.isnan(spread.at_s) else shown(spread.at_s)


def _minutes(seconds: float) -> str:
    return f"{seconds / 60.0:.0f}" if seconds >= 600.0 or seconds == 0.0 else f"{seconds / 60.0:.1f}"


def _hours(seconds: float) -> str:
    return f"{seconds / 3600.0:.1f} h" if seconds < 48 * 3600.0 else f"{seconds / 86400.0:.1f} days"


def _share(history: History, state: str) -> str:
    share = history.whole.seconds[state] / sum(history.whole.seconds.values())
    # Never rounded to 0 or 100 %.
    shown = share if share in (0.0, 1.0) else min(max(share, 0.0005), 0.9995)
    return f"{100.0 * shown:.1f} %"
