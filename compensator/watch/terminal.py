"""A machine or a shop in the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from compensator.clock import NS
from compensator.watch.shop import Shop, headline
from compensator.watch.words import SIGNS, age, plain, signed

_STYLES = {"good": "green", "warn": "yellow", "bad": "bold red"}
_BARS = "▁▂▃▄▅▆▇█"
#: Width from which on a column is shown in the table of a shop: (heading, least width of the terminal).
_COLUMNS = (
    ("machine", 0), ("state", 0), ("offset µm", 0), ("µm/min", 100), ("std µm", 100), ("residual µm", 84),
    ("T_Q °C", 120), ("AT °C", 120), ("age", 0), ("alive", 72), ("last 24 h", 140), ("why", 60),
)  # fmt: skip
#: Events shown of one machine.
EVENTS = 6


def view(shop: Shop, *, prefix: str, where: str, connected: bool, console: Console) -> RenderableType:
    """Return what is shown now: the machine of the prefix, or all below it.

    Parameters
    ----------
    shop : Shop
        What is known.
    prefix, where : str
        What is watched, and over which endpoint.
    connected : bool
        Whether there is a connection.
    console : rich.console.Console
        Its size says how much there is room for.
    """
    machines = shop.overview()
    about = Text(f"{prefix or 'everything'} at {where}, {_utc()}", style="dim")
    parts: list[RenderableType] = [Text(headline(machines), style="bold"), about]
    if not connected:
        parts.append(Text(f"✗ No connection to {where}; trying again. What stands here is old.", style="bold red"))
    if len(machines) == 1:
        parts.append(detail(machines[0], shop.history(machines[0]["prefix"]), console.width))
    elif machines:
        parts.append(overview(shop, machines, console.width, rows=max(console.height - 8, 5)))
    if shop.ignored:
        parts.append(Text(f"{shop.ignored} message(s) with keys or of machines that are not followed.", style="yellow"))
    parts.append(Text("Ctrl-C ends the view; nothing is sent to the machines.", style="dim"))
    return Group(*parts)


def _utc() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


# ---------------------------------------------------------------------------- a shop


def overview(shop: Shop, machines: Sequence[dict[str, Any]], width: int, rows: int | None = None) -> RenderableType:
    """Return the table of a shop, those that need somebody first.

    Parameters
    ----------
    shop : Shop
        For the last day of each.
    machines : sequence of dict
        Snapshots.
    width : int
        Of the terminal, letters.
    rows : int, optional
        So many at most; how many were left out is said.
    """
    names = [name for name, least in _COLUMNS if width >= least]
    table = Table(expand=width < 140, box=None, padding=(0, 1, 0, 0), header_style="dim")
    for name in names:
        left, why = name in ("machine", "state", "why", "alive", "last 24 h"), name == "why"
        table.add_column(
            name, justify="left" if left else "right", no_wrap=name != "machine", overflow="ellipsis",
            ratio=1 if why and width < 140 else None, max_width=max(40, width - 140) if why else None,
        )  # fmt: skip
    shown = machines[:rows]
    for machine in shown:
        cells = _cells(machine)
        if "last 24 h" in names:
            cells["last 24 h"] = Text(_offsets(shop.history(machine["prefix"]), 24))
        table.add_row(*(cells[name] for name in names))
    left_out = machines[len(shown) :]
    if not left_out:
        return table
    return Group(
        table, Text(f"… and {len(left_out)} more ({headline(list(left_out)).partition(': ')[2]})", style="bold")
    )


def _cells(machine: dict[str, Any]) -> dict[str, Text]:
    why = " ".join([reason["means"] for reason in machine["reasons"]] + machine["warnings"])
    if machine["shown"] == "silent":
        why = " ".join([machine["means"], *machine["warnings"]])
    return {
        "machine": Text(machine["prefix"]), "state": state(machine),
        "offset µm": Text(signed(machine["y_offset_um"]), style="dim" if machine["shown"] == "silent" else ""),
        "µm/min": Text(signed(machine["y_offset_rate_um_per_min"])), "std µm": Text(plain(machine["y_offset_std_um"])),
        "residual µm": Text(signed(machine["residual_um"])), "T_Q °C": Text(plain(machine["t_q_degc"])),
        "AT °C": Text(plain(machine["at_degc"])),
        "age": Text(age(machine["age_s"]) if machine["age_s"] is not None else "–"),
        "alive": Text(_alive(machine)), "why": Text(why),
    }  # fmt: skip


def _alive(machine: dict[str, Any]) -> str:
    return {True: "alive", False: "gone", None: "?"}[machine["alive"]]


def state(machine: dict[str, Any]) -> Text:
    """Return what a machine is shown as, with a sign."""
    tone = machine["tone"]
    return Text(f"{SIGNS[tone]} {machine['shown']}", style=_STYLES[tone])


# ---------------------------------------------------------------------------- one machine


def detail(machine: dict[str, Any], history: dict[str, list[Any]], width: int) -> RenderableType:
    """Return everything of one machine."""
    parts: list[RenderableType] = [_verdict(machine)]
    pairs = _pairs(machine)
    per_row = 1 + (width >= 60) + 2 * (width >= 110)
    numbers = Table.grid(padding=(0, 2))
    for i in range(0, len(pairs), per_row):
        numbers.add_row(*(cell for name, value in pairs[i : i + per_row] for cell in (Text(name, style="dim"), value)))
    lists = [(title, lines) for title, lines in _lists(machine) if lines]
    urgent = [(title, lines) for title, lines in lists if title in ("Why", "Mind")]
    parts += [_titled(title, lines) for title, lines in urgent]
    parts += [Text(""), numbers, *_last_day(history, width)]
    parts += [_titled(title, lines) for title, lines in lists[len(urgent) :]]
    return Panel(
        Group(*parts), title=f"{machine['machine']}  ({machine['prefix']})", border_style=_STYLES[machine["tone"]]
    )


def _verdict(machine: dict[str, Any]) -> Text:
    text = state(machine)
    old = age(machine["age_s"]) if machine["age_s"] is not None else ""
    if machine["shown"] == "silent":
        text.append(f" for {old}; the last offset was {signed(machine['y_offset_um'])} µm", style="bold red")
    elif machine["shown"] != "unknown":
        text.append(f"  offset {signed(machine['y_offset_um'])} µm, {old} old", style="bold")
    text.append(f"\n{machine['means']}", style="")
    if machine["tone"] != "good":
        text.append(f" {machine['do']}")
    return text


def _pairs(machine: dict[str, Any]) -> list[tuple[str, Text]]:
    missed = f"{machine['received']} received, {machine['missed']} missed"
    return [
        ("rate, µm/min", Text(signed(machine["y_offset_rate_um_per_min"]))),
        ("std, µm", Text(plain(machine["y_offset_std_um"]))),
        ("measured Y, µm", Text(signed(machine["y_um"]))), ("residual, µm", Text(signed(machine["residual_um"]))),
        ("T_Q, °C", Text(plain(machine["t_q_degc"]))), ("AT, °C", Text(plain(machine["at_degc"]))),
        ("heat, W", Text(plain(machine["heat_w"], 1))), ("predicted Y, µm", Text(signed(machine["y_pred_um"]))),
        *((f"{share['name']}, µm", Text(signed(share["y_um"]))) for share in machine["shares"]),
        ("alive", Text(_alive(machine))), ("messages", Text(missed)),
        ("model", Text(f"{machine['model'] or '–'} {(machine['model_sha256'] or '')[:8]}")),
        ("recording", Text(machine["recording"] or "–")),
    ]  # fmt: skip


def _last_day(history: dict[str, list[Any]], width: int) -> list[RenderableType]:
    lines: list[RenderableType] = []
    rows = (("offset", "y_offset_um", "µm"), ("residual", "residual_um", "µm"), ("T_Q", "t_q_degc", "°C"),
            ("AT", "at_degc", "°C"))  # fmt: skip
    for name, column, unit in rows:
        values = [value for value in history.get(column, []) if value is not None]
        if len(values) > 1:
            hours = (history["t_s"][-1] - history["t_s"][0]) / 3600.0
            said = f"{plain(min(values), 1)} to {plain(max(values), 1)} {unit}"
            bars = sparkline(_evenly(history["t_s"], history[column], max(width - 46, 12)), max(width - 46, 12))
            lines.append(Text.assemble((f"{name:<9}", "dim"), bars, f" {said}", (f" in {hours:.1f} h", "dim")))
    return lines


def _lists(machine: dict[str, Any]) -> list[tuple[str, list[str]]]:
    reasons = [f"{one['code']}: {one['means']} {one['do']}" for one in machine["reasons"]]
    channels = [
        f"{name}: {one['quality']}" + (f" ({', '.join(f'{n} {code}' for code, n in one['errors'].items())})"
                                       if one["errors"] else "")
        for name, one in machine["channels"].items() if one["quality"] != "good"
    ]  # fmt: skip
    devices = [f"{name}: {error}" for name, error in (machine["devices"] or {}).items() if error != "ok"]
    events = [
        f"{datetime.fromtimestamp(event['time_utc_ns'] / NS, UTC):%m-%d %H:%M:%S} {event['kind']}: {event['text']}"
        + (f" → {event['do']}" if event["do"] else "")
        for event in machine["events"][:EVENTS]
    ]
    mind = [warning.marked for warning in machine["warnings"]]
    return [
        ("Why", reasons),
        ("Mind", mind),
        ("Channels", channels),
        ("Devices", devices),
        ("Last events (UTC)", events),
    ]


def _titled(title: str, lines: list[str]) -> RenderableType:
    table = Table.grid(padding=(0, 1))
    for line in lines:
        table.add_row(Text("•"), Text(line))
    return Group(Text(f"\n{title}", style="bold"), table)


def _offsets(history: dict[str, list[Any]], width: int) -> str:
    return sparkline(_evenly(history["t_s"], history["y_offset_um"], width), width) if history else ""


def _evenly(t_s: Sequence[float], values: Sequence[float | None], width: int) -> list[float | None]:
    """Return the values at even steps of time, None where nothing was heard."""
    if len(t_s) < 2 or t_s[-1] <= t_s[0]:
        return list(values)
    count = min(width, len(t_s))
    parts: list[list[float]] = [[] for _ in range(count)]
    for t, value in zip(t_s, values, strict=True):
        if value is not None:
            parts[min(int((t - t_s[0]) / (t_s[-1] - t_s[0]) * count), count - 1)].append(value)
    return [sum(part) / len(part) if part else None for part in parts]


def sparkline(values: Sequence[float | None], width: int) -> str:
    """Draw values as a line of bars, the mean of each part; a part without any is a blank.

    Examples
    --------
    >>> sparkline([0.0, 1.0, None, 2.0], 4)
    '▁▅ █'
    """
    if not values:
        return ""
    count = min(width, len(values))
    parts = [values[i * len(values) // count : (i + 1) * len(values) // count] for i in range(count)]
    means = [[v for v in part if v is not None and math.isfinite(v)] for part in parts]
    known = [sum(part) / len(part) for part in means if part]
    if not known:
        return " " * count
    low, high = min(known), max(known)
    scale = (len(_BARS) - 1) / (high - low) if high > low else 0.0
    return "".join(_BARS[round((sum(p) / len(p) - low) * scale)] if p else " " for p in means)


# ---------------------------------------------------------------------------- without a terminal


def line(machine: dict[str, Any]) -> str:
    """Return a machine in one line, for a pipe or a log."""
    when = (
        f"{datetime.fromtimestamp(machine['time_utc_ns'] / NS, UTC):%Y-%m-%dT%H:%M:%SZ}"
        if machine["time_utc_ns"]
        else "–"
    )
    old = f"{age(machine['age_s'])} old" if machine["age_s"] is not None else "no offset"
    words = [
        when, machine["prefix"], machine["shown"], f"offset {signed(machine['y_offset_um'])} µm ({old})",
        f"residual {signed(machine['residual_um'])} µm", *(reason["code"] for reason in machine["reasons"]),
        *machine["warnings"],
    ]  # fmt: skip
    return "  ".join(words)
