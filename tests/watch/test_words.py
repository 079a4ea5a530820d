"""What somebody at the machine is told to do."""

from __future__ import annotations

from compensator.messages import SCHEMA, Event
from compensator.watch.words import to_do


def test_a_changed_recording_is_no_matter_of_the_disk() -> None:
    def said(code: str) -> str:
        data = {"code": code, "file": "a.mcap"}
        return to_do(Event(schema=SCHEMA, machine="m", seq=1, time_utc_ns=0, kind="recording", text="", data=data))

    assert "public key" in said("not_as_written") and "disk" not in said("not_as_written")
    assert "disk" in said("head_not_kept")
