"""Probes sent to a service that is a process of its own: replies, verdicts, a kill −9 between, the audit."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from compensator.audit.machine_audit import audit
from compensator.config import load_config
from compensator.messages import ProbeRequest, shipped_schema
from compensator.recording.reading import messages, recordings
from compensator.service.command_client import send_probe
from tests.ports import free_port
from tests.receiver.wire import router
from tests.soak.site import RATE_UM_PER_MIN, Receiver, Site, end

PERIOD_S = 0.5
PROBE = """[probe]
std_um = 1.0
measured_max_um = 60.0
largest_um = 40.0
tolerance_um = 3.0
match_um = 0.5
"""


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def site(tmp_path: Path, port: int) -> Iterator[Site]:
    with Site(tmp_path, connect=[f"tcp/127.0.0.1:{port}"], period_s=PERIOD_S, extra=PROBE) as site:
        yield site


class Control:
    """A control that follows the offset, and probes."""

    def __init__(self, site: Site, receiver: Receiver) -> None:
        self.settings = load_config(site.config).config.zenoh
        self.receiver = receiver

    def request(self, left_um: float = 1.0, **changes: Any) -> ProbeRequest:
        """A probe at the newest sample that finds so much left: of now there is no prediction on a busy computer."""
        self.receiver.more(1)
        offset = self.receiver.messages[-1]
        usual = {
            "schema": 1,
            "time_utc_ns": offset["time_utc_ns"],
            "axis": "y",
            "measured_um": left_um,
            "offset_applied_um": offset["y_offset_um"],
            "feature": "bore",
        }
        return ProbeRequest(**(usual | changes))

    def send(self, request: ProbeRequest) -> dict[str, Any]:
        return send_probe(self.settings, request, timeout_s=10.0)

    def decided(self, request: ProbeRequest) -> dict[str, Any]:
        """Wait for the event with the verdict on a probe."""

        def found() -> list[dict[str, Any]]:
            return [
                event["data"]
                for event in self.receiver.events
                if event["kind"] == "probe" and event["data"]["probe_utc_ns"] == request.time_utc_ns
            ]

        self.receiver.wait(lambda: bool(found()), "the verdict on a probe")
        return found()[0]


def test_a_probe_is_answered_decided_recorded_and_survives_a_kill(site: Site, port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{port}"
    receiver = Receiver("shop/vmc-07", mode="client", connect__endpoints=[endpoint], connect__timeout_ms=10_000)
    with router(port), receiver:
        control = Control(site, receiver)
        process = site.start()
        try:
            receiver.more(4)
            first = control.request(2.0)
            reply = control.send(first)
            assert reply["ok"] and reply["code"] == "", reply
            assert control.decided(first)["taken"]
            wrong = control.request(2.0, offset_applied_um=first.offset_applied_um + 9.0)
            reply = control.send(wrong)
            assert (reply["ok"], reply["code"]) == (False, "probe_mismatch"), reply
            assert control.decided(wrong)["code"] == "probe_mismatch"
            (malformed,) = receiver.ask("command/probe", b'{"schema": 1, "measured": 3}')
            assert malformed["code"] == "probe_malformed" and not malformed["ok"]
            receiver.more(2)  # the status comes after the event
            (status,) = receiver.ask("status")
            assert status["probe_wanted"] is True and status["wanted_why"] == "probe_mismatch"
            assert set(status) <= set(json.loads(shipped_schema("status"))["properties"])
        finally:
            end(process)  # kill −9
        process = site.start()
        try:
            receiver.more(4)
            assert control.send(first)["code"] == "probe_duplicate"
            again = control.request(1.0)
            assert control.send(again)["ok"] and control.decided(again)["taken"]
            receiver.more(2)
            # The correction of before the kill is still there: the second probe was expected.
            assert abs(control.decided(again)["innovation_um"]) < 5.0
        finally:
            end(process)
    offsets = [message["y_offset_um"] for message in receiver.messages if message["y_offset_um"] is not None]
    steps = [abs(after - before) for before, after in itertools.pairwise(offsets)]
    assert max(steps) <= RATE_UM_PER_MIN * PERIOD_S / 60.0 + 1e-9
    found = audit(recordings(site.recordings, "vmc-07"))
    assert found.clean, found
    probes = [one for path in recordings(site.recordings, "vmc-07") for one in messages(path, ("probe",))]
    codes = [probe.code if not probe.taken else "taken" for probe in probes]
    assert codes == ["taken", "probe_mismatch", "probe_malformed", "probe_duplicate", "taken"]
