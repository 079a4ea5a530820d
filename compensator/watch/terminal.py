"""View of a machine or a shop in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from compensator.clock import NS
from compensator.codes import SampleQuality, WatchWarning
from compensator.errors import one_line
from compensator.report.local_time import here, zone
from compensator.report.notation import plain, signed
from compensator.watch.day import STYLES, drawn, evenly, sparkline
from compensator.watch.history import StateInterval, state_intervals
from compensator.watch.shop import Shop, headline
from compensator.watch.words import SIGNS, TONES, age, probe_text

#: Columns of the table of a shop: heading, minimum width of the terminal.
_COLUMNS = (
    ("machine", 0),
    ("state", 0),
    ("offset µm", 0),
    ("µm/min", 100),
    ("std µm", 100),
    ("residual µm", 84),
    ("T_Q °C", 120),
    ("AT °C", 120),
    ("age", 0),
    ("alive", 72),
    ("last 24 h", 140),
    ("reasons", 60),
)
#: Numbers of events and of intervals in one state shown for one machine.
EVENTS, INTERVALS = 6, 4
#: Minimum height of a terminal for the complete view.
TALL = 44
#: Lists above the numbers; the other lists follow the last day.
URGENT, PAST = ("Reasons", "Warnings", "Channels", "Devices"), "States of the last day, the newest first"


def view(
    shop: Shop, *, prefix: str, where: str, connected: bool, console: Console, stays: bool = True
) -> RenderableType:
    """Return the present view: the machine of the prefix, or all below it.

    Parameters
    ----------
    shop : Shop
        The machines.
    prefix, where : str
        Prefix and endpoints.
    connected : bool
        Whether there is a connection.
    console : rich.console.Console
        Its size limits the view.
    stays : bool
        Whether the view is updated until Ctrl-C.
    """
    machines = shop.overview()
    now = here(shop.now_ns())
    about = _text(f"{prefix or 'everything'} at {where}, {now:%Y-%m-%d %H:%M:%S} {zone(now)}", style="dim")
    parts: list[RenderableType] = [_text(headline(machines), style="bold"), about]
    if not connected:
        parts.append(
            _text(f"✗ No connection to {where}; retrying. The values below are out of date.", style="bold red")
        )
    if len(machines) == 1:
        history = shop.history(machines[0]["prefix"])
        short = stays and console.height < TALL
        parts.append(detail(machines[0], history, console.width, shop.now_ns(), short=short))
    elif machines:
        rows = max(console.height - 8, 5)
        parts.append(overview(shop, machines, console.width, rows=rows))
        parts += _to_do(machines[:rows], console.width, console.height - 8 - len(machines))
    if shop.ignored:
        parts.append(
            _text(f"{shop.ignored} message(s) with unknown keys or of further machines ignored.", style="yellow")
        )
    if stays:
        parts.append(Text("Ctrl-C ends the view. Nothing is sent to the machines.", style="dim"))
    return Group(*parts)


def _to_do(machines: Sequence[dict[str, Any]], width: int, rows: int) -> list[RenderableType]:
    """Return the actions by machine, as far as they fit below the table."""
    lines: list[RenderableType] = []
    for machine in machines:
        found = machine["headline"]
        text = _text(
            f"{SIGNS[machine['tone']]} {machine['prefix']} {machine['shown']}: {found['word']}. {found['text']}"
        )
        rows -= -(-text.cell_len // max(width - 2, 1))
        if machine["tone"] == "good" or rows < 1:
            break
        lines.append(text)
    return [Text("\nActions", style="bold"), *lines] if lines else []


# ---------------------------------------------------------------------------- a shop


def overview(shop: Shop, machines: Sequence[dict[str, Any]], width: int, rows: int | None = None) -> RenderableType:
    """Return the table of a shop, the most severe first.

    Parameters
    ----------
    shop : Shop
        For the last day of each machine.
    machines : sequence of dict
        Snapshots.
    width : int
        Width of the terminal, characters.
    rows : int, optional
        Largest number of rows; the number of omitted machines is shown.
    """
    names = [name for name, least in _COLUMNS if width >= least]
    table = Table(expand=width < 140, box=None, padding=(0, 1, 0, 0), header_style="dim")
    for name in names:
        left, why = name in ("machine", "state", "reasons", "alive", "last 24 h"), name == "reasons"
        table.add_column(
            name,
            justify="left" if left else "right",
            no_wrap=name != "machine",
            overflow="ellipsis",
            ratio=1 if why and width < 140 else None,
            max_width=max(40, width - 140) if why else None,
        )
    shown = machines[:rows]
    for machine in shown:
        cells = _cells(machine)
        if "last 24 h" in names:
            history = shop.history(machine["prefix"])
            cells["last 24 h"] = _text(sparkline(evenly(history["t_s"], history["y_offset_um"], 24)))
        table.add_row(*(cells[name] for name in names))
    left_out = machines[len(shown) :]
    if not left_out:
        return table
    return Group(
        table, _text(f"… and {len(left_out)} more ({headline(list(left_out)).partition(': ')[2]})", style="bold")
    )


def _cells(machine: dict[str, Any]) -> dict[str, Text]:
    # Codes, because sentences would be cut off; the actions are below, or in the view of one machine.
    reasons = [reason["code"] for reason in machine["reasons"]] if machine["shown"] != WatchWarning.SILENT else []
    why = " ".join([*reasons, *machine["warning_codes"]])
    return {
        "machine": _text(machine["prefix"]),
        "state": state(machine),
        "offset µm": _text(
            signed(machine["y_offset_um"]), style="dim" if machine["shown"] == WatchWarning.SILENT else ""
        ),
        "µm/min": _text(signed(machine["y_offset_rate_um_per_min"])),
        "std µm": _text(plain(machine["y_offset_std_um"])),
        "residual µm": _text(signed(machine["residual_um"])),
        "T_Q °C": _text(plain(machine["t_q_degc"])),
        "AT °C": _text(plain(machine["at_degc"])),
        "age": _text(age(machine["age_s"]) if machine["age_s"] is not None else "–"),
        "alive": _text(_alive(machine)),
        "reasons": _text(why),
    }


def _alive(machine: dict[str, Any]) -> str:
    return {True: "alive", False: "gone", None: "?"}[machine["alive"]]


def state(machine: dict[str, Any]) -> Text:
    """Return the shown state of a machine with its sign."""
    tone = machine["tone"]
    return _text(f"{SIGNS[tone]} {machine['shown']}", style=STYLES[tone])


# ---------------------------------------------------------------------------- one machine


def detail(
    machine: dict[str, Any], history: dict[str, list[Any]], width: int, now_ns: int, *, short: bool = False
) -> RenderableType:
    """Return the view of one machine.

    Parameters
    ----------
    machine : dict
        Snapshot.
    history : dict of str to list
        Its last day, by columns.
    width : int
        Width of the terminal, characters.
    now_ns : int
        Now, ns since 1970 UTC.
    short : bool
        Omit what does not fit a low terminal, which cuts the view off at the bottom.
    """
    parts: list[RenderableType] = [_verdict(machine)]
    pairs = _pairs(machine)
    per_row = 1 + (width >= 60) + 2 * (width >= 110)
    numbers = Table.grid(padding=(0, 2))
    for i in range(0, len(pairs), per_row):
        numbers.add_row(*(cell for name, value in pairs[i : i + per_row] for cell in (_text(name, style="dim"), value)))
    intervals = state_intervals(history, machine["valid_for_s"])[: INTERVALS // 2 if short else INTERVALS]
    past = [_interval_text(interval, now_ns) for interval in intervals]
    lists = [(title, lines) for title, lines in _lists(machine, past, here(now_ns)) if lines]
    urgent = [(title, lines) for title, lines in lists if title in URGENT]
    parts += [_titled(title, lines) for title, lines in urgent]
    parts += [
        Text(""),
        numbers,
        *_axes(machine),
        *([_text(probe_text(machine["probe"]))] if machine["probe"] is not None else []),
        *(_text(line) for line in _loop_lines(machine)),
        *([] if short else [_text(_about(machine), style="dim")]),
        *drawn(history, width - 4, short=short),
    ]
    parts += [_titled(title, lines) for title, lines in lists[len(urgent) :]]
    title = _text(f"{machine['machine']}  ({machine['prefix']})")
    return Panel(Group(*parts), title=title, border_style=STYLES[machine["tone"]])


def _axes(machine: dict[str, Any]) -> list[RenderableType]:
    """Return a table of every axis of a machine that has several."""
    if not machine.get("axes"):
        return []
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in ("axis", "state", "offset", "per min", "std", "slope", "reasons"):
        table.add_column(name, justify="right" if name in ("offset", "per min", "std", "slope") else "left")
    for axis in machine["axes"]:
        slope = f"{signed(axis['slope_um_per_m'])} µm/m" if "slope_um_per_m" in axis else ""
        table.add_row(
            _text(axis["label"]),
            _text(axis["state"] or "not received", style=STYLES[TONES.get(axis["state"] or "", "bad")]),
            f"{signed(axis['offset'])} {axis['unit']}",
            signed(axis["rate_per_min"]),
            plain(axis["std"]),
            slope,
            _text(" ".join(axis["reasons"])),
        )
    return [Text(""), table]


def _loop_lines(machine: dict[str, Any]) -> list[str]:
    """Return what the service does about its model, and what a person can answer to a proposal."""
    loop = machine.get("loop")
    if loop is None:
        return []
    asked = loop["commands"] if loop["phase"] == "proposed" else []
    return [loop["line"], *(f"  {command}" for command in asked)]


def _verdict(machine: dict[str, Any]) -> Text:
    """Return whether one may cut, why, and the state with the offset."""
    found, style = machine["headline"], STYLES[machine["tone"]]
    text = _text(f"{SIGNS[machine['tone']]} {found['word']}", style=f"bold {style}")
    text.append(f"  {one_line(found['text'])}\n", style="")
    old = age(machine["age_s"]) if machine["age_s"] is not None else ""
    text.append(one_line(machine["shown"]), style=style)
    if machine["shown"] == WatchWarning.SILENT:
        text.append(f" for {old}; the last offset was {signed(machine['y_offset_um'])} µm", style="bold red")
    elif machine["y_offset_um"] is None and machine["shown"] != WatchWarning.UNKNOWN:
        text.append(f"  no offset, {old} old", style="bold")
    elif machine["shown"] != WatchWarning.UNKNOWN:
        text.append(f"  offset {signed(machine['y_offset_um'])} µm, {old} old", style="bold")
    text.append(f"\n{one_line(machine['means'])}", style="dim")
    return text


def _pairs(machine: dict[str, Any]) -> list[tuple[str, Text]]:
    return [
        ("rate, µm/min", _text(signed(machine["y_offset_rate_um_per_min"]))),
        ("std, µm", _text(plain(machine["y_offset_std_um"]))),
        ("measured Y, µm", _text(signed(machine["y_um"]))),
        ("residual, µm", _text(signed(machine["residual_um"]))),
        ("T_Q, °C", _text(plain(machine["t_q_degc"]))),
        ("AT, °C", _text(plain(machine["at_degc"]))),
        ("heat, W", _text(plain(machine["heat_w"], 1))),
        ("predicted Y, µm", _text(signed(machine["y_pred_um"]))),
        *((f"{share['name']}, µm", _text(signed(share["y_um"]))) for share in machine["shares"]),
    ]


def _about(machine: dict[str, Any]) -> str:
    """Return service, messages, model and recording in one line."""
    model = f"{machine['model'] or '–'} {(machine['model_sha256'] or '')[:8]}".rstrip()
    return (
        f"service {_alive(machine)}; {machine['received']} messages received, {machine['missed']} missed; "
        f"model {model}; recording {machine['recording'] or '–'}"
    )


def _lists(machine: dict[str, Any], past: list[str], now: datetime) -> list[tuple[str, list[str]]]:
    reasons = [f"{one['code']}: {one['means']} {one['do']}" for one in machine["reasons"]]
    channels = [
        _channel(name, one) for name, one in machine["channels"].items() if one["quality"] != SampleQuality.GOOD
    ]
    # A driver's error begins with the name of its device.
    devices = [
        f"{name}: {error.removeprefix(f'{name}: ')}"
        for name, error in (machine["devices"] or {}).items()
        if error != "ok"
    ]
    events = [
        f"{here(event['time_utc_ns']):%m-%d %H:%M:%S} {event['kind']}: {event['text']}"
        + (f" → {event['do']}" if event["do"] else "")
        for event in machine["events"][:EVENTS]
    ]
    warned = [warning.marked for warning in machine["warnings"]]
    return [
        ("Reasons", reasons),
        ("Warnings", warned),
        ("Channels", channels),
        ("Devices", devices),
        (PAST, past),
        (f"Last events, {zone(now)}", events),
    ]


def _channel(name: str, channel: dict[str, Any]) -> str:
    errors = ", ".join(f"{count} × {code}" for code, count in channel["errors"].items())
    return f"{name}: {channel['quality']}" + (f" ({errors})" if errors else "") + f": {channel['do']}"


def _interval_text(interval: StateInterval, now_ns: int) -> str:
    begin = here(round(interval.begin_s * NS))
    when = f"{begin:%H:%M}" if begin.date() == here(now_ns).date() else f"{begin:%m-%d %H:%M}"
    text = f"{when} {interval.state} for {age(interval.end_s - interval.begin_s)}"
    return f"{text}: {interval.reasons}" if interval.reasons else text


def _titled(title: str, lines: list[str]) -> RenderableType:
    table = Table.grid(padding=(0, 1))
    for line in lines:
        table.add_row(Text("•"), _text(line))
    return Group(Text(f"\n{title}", style="bold"), table)


# ---------------------------------------------------------------------------- without a terminal


def line(machine: dict[str, Any]) -> str:
    """Return a machine as one line, for a pipe or a log."""
    when = (
        f"{datetime.fromtimestamp(machine['time_utc_ns'] / NS, UTC):%Y-%m-%dT%H:%M:%SZ}"
        if machine["time_utc_ns"]
        else "–"
    )
    old = f"{age(machine['age_s'])} old" if machine["age_s"] is not None else "no offset"
    words = [
        when,
        machine["prefix"],
        machine["shown"],
        f"offset {signed(machine['y_offset_um'])} µm ({old})",
        f"residual {signed(machine['residual_um'])} µm",
        *(
            f"{axis['label']} {signed(axis['offset'])} {axis['unit']}"
            for axis in machine.get("axes", ())
            if axis["axis"] != "y"
        ),
        *(reason["code"] for reason in machine["reasons"]),
        *(["probe wanted"] if machine["probe"] is not None and machine["probe"]["wanted"] else []),
        *(["better model proposed"] if machine.get("loop", {}).get("phase") == "proposed" else []),
        *machine["warnings"],
    ]
    return one_line("  ".join(words))


def _text(content: str, style: str = "") -> Text:
    """Return a text on one line: it may hold a name or a value of a stranger."""
    return Text(one_line(content), style=style)
