"""Events are read by kind and data; those of version 0.1.0, which have a text only, are read as well."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest

from compensator.events import (
    DOUBT,
    EventKind,
    Note,
    PauseData,
    RecordingCode,
    RecordingData,
    ZeroData,
    command_of,
    data_of,
    is_recorded,
)
from compensator.messages import SCHEMA, Event, encode


def event(kind: str, text: str = "", **data: Any) -> Event:
    """An event as it comes out of a recording."""
    made = Event(schema=SCHEMA, machine="vmc-07", seq=3, time_utc_ns=0, kind=kind, text=text, data=data)
    return msgspec.json.decode(encode(made), type=Event)


def test_data_survive_a_recording() -> None:
    zero = ZeroData(mode="warm", t_q_degc=20.1, at_degc=19.9, y_um=math.nan)
    assert data_of(event("zero", **zero.table()), ZeroData) == msgspec.structs.replace(zero, y_um=None)
    removed = RecordingData(code=RecordingCode.REMOVED, removed=["a.mcap"], bytes=3)
    assert removed.table() == {"code": "removed", "removed": ["a.mcap"], "bytes": 3}
    assert data_of(event("recording", **removed.table()), RecordingData) == removed


@pytest.mark.parametrize("data", [{"published_early": True}, {"removed": [1]}, {"lost": "3"}, {"code": "unheard_of"}])
def test_data_that_are_none_are_not_believed(data: dict[str, Any]) -> None:
    assert data_of(event("recording", **data), RecordingData) is None


def test_a_pause_of_unknown_length_is_none_of_no_length() -> None:
    unknown = event("restart", missing=None, minutes=None, bridged=False, y_std_um=None)
    pause = data_of(unknown, PauseData)
    assert pause is not None and pause.missing is None
    assert data_of(event("restart", file="a.mcap", samples=3), PauseData) is None


def test_a_note_is_recorded_by_its_data_and_in_version_0_1_0_by_its_text() -> None:
    zero = ZeroData(mode="rest", t_q_degc=20.0, at_degc=20.0, y_um=0.1).table()
    note = Note(EventKind.ZERO, "zero on a machine at rest", zero)
    assert is_recorded(note, event("zero", "in other words", **zero))
    assert not is_recorded(note, event("zero", note.text, **{**zero, "t_q_degc": 20.5}))
    assert is_recorded(note, event("zero", note.text)) and not is_recorded(note, event("zero", "in other words"))
    assert not is_recorded(note, event("plausibility", note.text))
    # It did not doubt a zero at rest.
    doubted = Note(EventKind.ZERO, f"{note.text}{DOUBT}the machine is warm", zero | {"warm_um": 60.0})
    assert is_recorded(doubted, event("zero", note.text)) and not is_recorded(doubted, event("zero", **zero))


def test_the_name_of_a_command() -> None:
    assert command_of(event("command", "in words", command="hold")) == "hold"
    assert command_of(event("command", "hold", by="anna")) == "hold"  # version 0.1.0


@pytest.mark.parametrize(
    ("data", "resolved"),
    [
        ({"code": "disk_back", "lost": 0}, True),
        ({"code": "recovered", "file": "a.mcap"}, True),
        ({"code": "disk_failed"}, False),
        ({"code": "not_removed"}, False),
        ({"code": "not_as_written", "file": "a.mcap"}, False),
        ({"code": "head_not_kept"}, False),
        ({"lost": 3}, True),  # version 0.1.0
        ({"removed": ["a.mcap"], "bytes": 3}, True),
        ({}, False),
    ],
)
def test_what_needs_nothing_to_be_done(data: dict[str, Any], resolved: bool) -> None:
    found = data_of(event("recording", **data), RecordingData)
    assert found is not None and found.is_resolved is resolved
