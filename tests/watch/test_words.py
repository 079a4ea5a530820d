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


def test_an_event_with_several_suspects_sends_nobody_to_a_healthy_sensor() -> None:
    def state(*reasons: str) -> str:
        data = {"state": "degraded", "reasons": list(reasons)}
        return to_do(Event(schema=SCHEMA, machine="m", seq=1, time_utc_ns=1, kind="state", text="", data=data))

    assert "Compare AT" in state("implausible:at_degc") and "Compare AT" not in state(
        "implausible:at_degc", "implausible:model"
    )
    both = state("implausible:at_degc", "implausible:t_q_degc", "t_q_missing")
    assert both.startswith("Measure the part;") and both.count("Measure the part") == 1 and "thermocouple" in both


def test_a_way_back_that_waits_for_the_disk_is_no_model_that_was_refused() -> None:
    def said(**more: str) -> str:
        data = {"ok": False, "action": "back", **more}
        return to_do(Event(schema=SCHEMA, machine="m", seq=1, time_utc_ns=1, kind="adopt", text="", data=data))

    assert "disk" in said(by="loop") and "refused" not in said(by="loop")
    assert "refused" in said()
