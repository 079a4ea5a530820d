"""Whether a probe is wanted, as the receiver learns it from the service's status; and what it records for probes."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from compensator.receiver import ProbeWanted, Receiver, Rejected
from compensator.receiver.applied_record import applied_at
from compensator.receiver.message import parse_status
from tests.ports import free_port
from tests.receiver.test_subscriber import settings
from tests.receiver.wire import ScriptedService, router, until

WANTED = {"probe_wanted": True, "wanted_by_ns": 17, "wanted_std_um": 2.5, "wanted_tolerance_um": 2.0}
HOUR_NS = 3_600_000_000_000


def test_it_is_what_the_newest_status_says_while_the_service_is_there() -> None:
    port, now = free_port(), [1000.0]
    with router(port), Receiver(settings(port), clock=lambda: now[0]) as receiver:
        assert receiver.probe_wanted is None
        with ScriptedService(port) as service:
            service.put_status(**WANTED, heard=False)
            until(lambda: receiver.poll() and receiver.probe_wanted is not None, "the answer or the message")
            assert receiver.probe_wanted == ProbeWanted(wanted=True, by_utc_ns=17, std_um=2.5, tolerance_um=2.0)
            service.put_status(probe_wanted=False, wanted_by_ns=None)
            until(lambda: receiver.poll() and receiver.probe_wanted.wanted is False, "no longer wanted")
            assert receiver.probe_wanted == ProbeWanted(wanted=False, by_utc_ns=None, std_um=None, tolerance_um=None)
            service.put_status(**WANTED, machine="vmc-08")
            service.put_status(probe_wanted="yes")
            service.put_status(**WANTED)
            until(lambda: receiver.poll() and receiver.probe_wanted.wanted, "the next good one")
            now[0] += 601.0
            assert receiver.probe_wanted is None  # too old to send somebody to the machine
            service.put_status(**WANTED)
            until(lambda: receiver.poll() and receiver.probe_wanted, "a new one")
            service.put_status(state="ok")  # a service without probes
            until(lambda: receiver.poll() and receiver.probe_wanted is None, "nothing about probes")
            service.put_status(**WANTED)
            until(lambda: receiver.poll() and receiver.probe_wanted, "a new one")
        until(lambda: receiver.poll() and receiver.probe_wanted is None, "the service has ended")


def test_an_old_answer_is_old() -> None:
    port = free_port()
    with router(port), ScriptedService(port) as service:
        service.put_status(**WANTED, heard=False, time_utc_ns=time.time_ns() - HOUR_NS)
        with Receiver(settings(port)) as receiver:
            until(lambda: receiver.poll() and receiver._wanted is not None, "the answer")
            assert receiver.probe_wanted is None


def test_a_status_that_waited_while_the_loop_stood_still_is_old() -> None:
    port, now_s = free_port(), [1000.0]

    def heard_after_a_pause(receiver: Receiver) -> bool:
        now_s[0] += 7200.0
        receiver.poll()
        return receiver._wanted is not None

    with router(port), Receiver(settings(port), clock=lambda: now_s[0]) as receiver, ScriptedService(port) as service:
        until(lambda: receiver.poll() and receiver.follower.alive and not receiver._status_answers, "the queries' end")
        service.put_status(**WANTED, time_utc_ns=time.time_ns() - HOUR_NS)
        until(lambda: heard_after_a_pause(receiver), "the message")
        assert receiver.probe_wanted is None


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"[]",
        b'{"schema": 2, "machine": "vmc-07", "probe_wanted": true}',
        b'{"schema": 1, "machine": "vmc-07", "probe_wanted": 1}',
        b'{"schema": 1, "machine": "vmc-07", "probe_wanted": true, "wanted_by_ns": -1}',
        b'{"schema": 1, "machine": "vmc-07", "probe_wanted": true, "wanted_std_um": "2"}',
        b'{"schema": 1, "machine": "vmc-07", "probe_wanted": true, "probe_wanted": false}',
    ],
)
def test_a_status_that_is_not_understood_is_dropped(payload: bytes) -> None:
    with pytest.raises(Rejected):
        parse_status(payload, "vmc-07")


def test_what_the_control_had_is_recorded(tmp_path: Path) -> None:
    path = tmp_path / "applied.txt"
    now_ns = [1_000_000_000_000]
    receiver = Receiver(settings(1, applied_file=str(path)), utc_ns=lambda: now_ns[0])
    receiver.record(-3.0)
    now_ns[0] += 3_000_000_000
    receiver.record(None)
    assert applied_at(path, now_ns[0] - 2_000_000_000) == -3.0 and applied_at(path, now_ns[0]) is None
    Receiver(settings(1)).record(-3.0)  # not asked for: nothing is written
    receiver = Receiver(settings(1, applied_file=str(tmp_path / "none" / "applied.txt")))
    receiver.record(1.0)
    assert "applied_not_recorded" in {reason.code for reason in receiver.poll().reasons}
