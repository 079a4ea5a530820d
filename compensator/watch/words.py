"""What is shown, in words: a machine's verdict, its reasons, its events, and how old something is."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple

from compensator.clock import NS
from compensator.events import EventKind, RecordingData, data_of
from compensator.messages import Event
from compensator.reasons import explain

Tone = Literal["good", "warn", "bad"]

#: What a machine is shown as → how much it needs somebody.
TONES: Mapping[str, Tone] = {
    "ok": "good",
    "starting": "warn",
    "degraded": "warn",
    "hold": "bad",
    "fault": "bad",
    "silent": "bad",
    "unknown": "bad",
}
#: A sign beside each, so that colour is not needed.
SIGNS: Mapping[Tone, str] = {"good": "✓", "warn": "⚠", "bad": "✗"}
#: Kind of an event → what to do.
_DO: Mapping[str, str] = {
    "device": "Check power, cable and address of the device; `compensator probe` reads it once.",
    "recording": "Check free space, permissions and the disk.",
    "clock": "Check the time service of the machine's computer.",
    "error": "Report it with its text; the offset is held until the service is well again.",
    "command_refused": "Find out who sent it and whether they may; the offset was not touched.",
    "adopt": "The model before goes on; see what is said of the new one.",
    "restart": "Nothing while the standard deviation is small enough for the work.",
}


class Words(NamedTuple):
    """A code with what it means and what to do."""

    code: str
    means: str
    do: str


def in_words(code: str) -> Words:
    """Return a state or reason in words; one that is unknown is said to be so.

    Examples
    --------
    >>> in_words("ok").do
    'Nothing.'
    """
    found = explain(code)
    if found is None:
        return Words(
            code, "This program does not know the code; the service may be newer.", "Bring both to one version."
        )
    return Words(code, *found)


def to_do(event: Event) -> str:
    """Return what to do about an event; empty where there is nothing."""
    if event.kind in ("device", "adopt") and event.data.get("ok") is not False:
        return ""
    if event.kind == "state":
        state = str(event.data.get("state", ""))
        reasons = event.data.get("reasons")
        codes = [str(code) for code in reasons] if isinstance(reasons, list) and reasons else [state]
        return " ".join(dict.fromkeys(in_words(code).do for code in codes)) if state not in ("", "ok") else ""
    recording = data_of(event, RecordingData) if event.kind == EventKind.RECORDING else None
    if recording is not None and recording.is_resolved:
        return ""
    return _DO.get(event.kind, "")


def here(time_ns: int) -> datetime:
    """Return a time as the clock on this computer's wall shows it; recordings and messages stay in UTC.

    Parameters
    ----------
    time_ns : int
        ns since 1970 UTC.
    """
    return datetime.fromtimestamp(time_ns / NS, UTC).astimezone()


def zone(time: datetime) -> str:
    """Name the time zone of a local time, with what it is ahead of UTC.

    Examples
    --------
    >>> from datetime import timedelta, timezone
    >>> zone(datetime(2026, 1, 5, tzinfo=timezone(timedelta(hours=1), "CET"))), zone(datetime(2026, 1, 5, tzinfo=UTC))
    ('CET (UTC+01:00)', 'UTC')
    """
    name, ahead = f"{time:%Z}", f"{time:%z}"
    return "UTC" if name == "UTC" else f"{name} (UTC{ahead[:3]}:{ahead[3:5]})"


def age(seconds: float) -> str:
    """Write how old something is.

    Examples
    --------
    >>> age(7.4), age(130), age(7000), age(200_000)
    ('7 s', '2 min', '1 h 56 min', '2.3 d')
    """
    if seconds < 120:
        return f"{max(seconds, 0.0):.0f} s"
    if seconds < 3600:
        return f"{seconds // 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{seconds // 3600:.0f} h {seconds % 3600 // 60:.0f} min"
    return f"{seconds / 86400:.1f} d"


def signed(value: Any, digits: int = 2) -> str:
    """Write a number with its sign; a dash where there is none.

    Examples
    --------
    >>> signed(1.234), signed(-0.5), signed(None)
    ('+1.23', '−0.50', '–')
    """
    return f"{value:+.{digits}f}".replace("-", "−") if isinstance(value, (int, float)) else "–"


def plain(value: Any, digits: int = 2) -> str:
    """Write a number; a dash where there is none."""
    return f"{value:.{digits}f}".replace("-", "−") if isinstance(value, (int, float)) else "–"
