"""deploy/examples/probe.py as a program: what it sends is the command's payload, and it prints the answer."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from compensator.messages import ProbeRequest
from tests.ports import free_port
from tests.receiver.wire import PREFIX, ScriptedService, router

PROGRAM = Path(__file__).resolve().parents[2] / "deploy/examples/probe.py"


def call(port: int, *more: str) -> subprocess.CompletedProcess[str]:
    words = [f"tcp/127.0.0.1:{port}", PREFIX, "sphere-1", "3.2", "-12.3", *more]
    return subprocess.run([sys.executable, PROGRAM, *words], capture_output=True, text=True, timeout=60, check=False)


def test_it_sends_one_probe_and_prints_the_answer() -> None:
    port = free_port()
    with router(port), ScriptedService(port) as service:
        begin_ns = time.time_ns()
        done = call(port, "30")
        assert (done.returncode, done.stdout) == (0, "heard\n"), done.stderr
        (payload,) = service.probes
        probe = msgspec.convert(payload, ProbeRequest)
        assert (probe.measured_um, probe.offset_applied_um, probe.feature, probe.axis) == (3.2, -12.3, "sphere-1", "y")
        assert begin_ns < probe.time_utc_ns + 30_000_000_000 < time.time_ns()
        service.probe_answer = {"ok": False, "text": "probe: from the future", "code": "probe_future"}
        done = call(port, "-3600")
        assert (done.returncode, done.stdout) == (1, "refused: probe: from the future\n")


def test_no_answer_is_no_success() -> None:
    port = free_port()
    with router(port):
        done = call(port)
    assert done.returncode == 1 and "no answer" in done.stderr


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "expected: python probe.py ENDPOINT"),
        (["tcp/127.0.0.1:1", PREFIX, "sphere-1", "3.2"], "expected: python probe.py ENDPOINT"),
        (["tcp/127.0.0.1:1", PREFIX, "sphere-1", "3,2", "0"], "expected: python probe.py ENDPOINT"),
        (["tcp/127.0.0.1:1", PREFIX, "", "3.2", "0"], "FEATURE is empty"),
        (["tcp/127.0.0.1:1", PREFIX, "sphere-1", "3.2", "0"], "tcp/127.0.0.1:1: not reached"),
        (["nonsense", PREFIX, "sphere-1", "3.2", "0"], "nonsense: not reached"),
    ],
)
def test_a_mistake_is_one_line(words: list[str], expected: str) -> None:
    command = [sys.executable, PROGRAM, *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (1, "") and len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith(expected)
