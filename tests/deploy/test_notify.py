"""What the service tells its manager and the journal, and above all when it does not."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.clock import NS
from compensator.commands.run import Reporter, level, status
from compensator.demo.machine import configuration
from compensator.messages import Event, Offset
from compensator.recording.reading import recordings
from compensator.service import systemd
from compensator.service.compensation import Outcome
from compensator.service.systemd import ServiceManager
from tests.cli.test_adopt import LINES
from tests.cli.test_commands import load_fast_model
from tests.ports import free_port
from tests.service.simulated import Bench


class Listener:
    """A service manager's end of the protocol: a datagram socket and what came over it."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "notify"
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(self.path))
        self.lines: list[str] = []

    def environment(self, watchdog_s: float | None = None) -> dict[str, str]:
        usec = {} if watchdog_s is None else {"WATCHDOG_USEC": str(round(watchdog_s * 1e6))}
        return {"NOTIFY_SOCKET": str(self.path)} | usec

    def drain(self) -> list[str]:
        """Take what has come so far."""
        while select.select([self.socket], [], [], 0.0)[0]:
            self.lines += self.socket.recv(65536).decode().splitlines()
        return self.lines

    def until(self, done: Callable[[list[str]], bool], timeout_s: float = 60.0) -> list[str]:
        end = time.monotonic() + timeout_s
        while not done(self.drain()):
            left = end - time.monotonic()
            assert left > 0, self.lines
            select.select([self.socket], [], [], left)
        return self.lines


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[Listener]:
    made = Listener(tmp_path)
    yield made
    made.socket.close()


def offset(**changes: Any) -> Offset:
    values: dict[str, Any] = {
        "schema": 1,
        "machine": "vmc-07",
        "seq": 7,
        "time_utc_ns": 1,
        "valid_for_s": 150.0,
        "y_offset_um": -12.341,
        "y_offset_rate_um_per_min": -0.81,
        "y_offset_std_um": 0.4,
        "state": "ok",
        "reasons": [],
        "model_sha256": "",
    }
    return Offset(**values | changes)


def event(kind: str, text: str = "", **data: Any) -> Event:
    return Event(schema=1, machine="vmc-07", seq=3, time_utc_ns=1, kind=kind, text=text, data=data)


# ---------------------------------------------------------------------------- protocol


def test_the_manager_is_told_in_its_own_protocol(listener: Listener) -> None:
    with ServiceManager(listener.environment(30.0)) as manager:
        assert manager.watchdog_s == 30.0
        manager.status("one\nline  only")  # a second line would be taken for another message
        manager.ready()
        manager.alive()
        manager.watch(5.0)
        manager.watch(60.0)
        manager.watch(600.0)
        manager.stopping()
    assert listener.drain() == [
        "STATUS=one line only",
        "READY=1",
        "WATCHDOG=1",
        "WATCHDOG_USEC=180000000",
        "EXTEND_TIMEOUT_USEC=1800000000",
        "WATCHDOG_USEC=1800000000",
        "STOPPING=1",
    ]


def test_an_abstract_address_is_understood() -> None:
    name = f"compensator-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind("\0" + name)
        with ServiceManager({"NOTIFY_SOCKET": "@" + name}) as manager:
            manager.ready()
        assert server.recv(100) == b"READY=1"


@pytest.mark.parametrize("changes", [{"WATCHDOG_USEC": ""}, {"WATCHDOG_USEC": "soon"}, {"WATCHDOG_PID": "1"}])
def test_without_a_watchdog_for_this_process_no_sign_of_life_is_sent(listener: Listener, changes: Any) -> None:
    with ServiceManager(listener.environment(30.0) | changes) as manager:
        assert manager.watchdog_s is None
        manager.alive()
        manager.watch(60.0)
    assert listener.drain() == []


def test_a_manager_that_does_not_read_never_holds_the_service_up(listener: Listener) -> None:
    with ServiceManager(listener.environment(30.0)) as manager:
        for _ in range(5000):  # far more than the socket's queue takes; a sending that waits would never end
            manager.alive()
        manager.ready()  # must arrive: without it the manager ends the service
        manager.alive()
        assert "READY=1" not in listener.drain()
        manager.alive()
        assert listener.drain()[-2:] == ["READY=1", "WATCHDOG=1"]
        manager.alive()
        assert listener.drain().count("READY=1") == 1
        listener.socket.close()
        manager.alive()


# ---------------------------------------------------------------------------- sampling and signs of life


class ImpatientClock:
    """Virtual time, with a device that is still silent when the poll has waited for it."""

    def __init__(self, clock: Any) -> None:
        self._clock = clock

    def __getattr__(self, name: str) -> Any:
        return getattr(self._clock, name)

    async def settle(self, tasks: Collection[asyncio.Task[Any]], timeout_s: float) -> None:
        for _ in range(5):
            await asyncio.sleep(0)


async def test_a_device_that_never_answers_is_no_standstill(bench: Bench) -> None:
    """Hours without a sensor: the offset is held, and the watchdog is fed with each poll all the same."""
    polls: list[int] = []

    async def never() -> Any:
        await asyncio.get_running_loop().create_future()

    bench.daemon._clock = bench.daemon._sampler._clock = ImpatientClock(bench.clock)
    bench.at_sample[5] = lambda: setattr(bench.device, "read", never)

    def took(outcome: Outcome) -> None:
        bench.outcomes.append(outcome)
        bench.at_sample.pop(outcome.offset.seq, lambda: None)()

    await bench.daemon.run(samples=60, on_sample=took, on_poll=lambda: polls.append(bench.clock.monotonic_ns()))
    assert bench.outcomes[-1].offset.state == "hold"
    assert len(polls) >= 59 * 6
    assert max(b - a for a, b in itertools.pairwise(polls)) <= 10 * NS


def test_no_sign_of_life_while_the_loop_stands_still(bench: Bench, listener: Listener) -> None:
    """A call that blocks in the middle of a poll: nothing is sampled any more, and so nothing is said."""
    stuck, free = threading.Event(), threading.Event()
    read = bench.device.read

    async def blocked() -> Any:
        if len([name for name, _ in bench.published if name == "offset"]) == 3:
            stuck.set()
            assert free.wait(60.0)
        return await read()

    bench.device.read = blocked  # type: ignore[method-assign]
    with ServiceManager(listener.environment(30.0)) as manager:
        reporter = Reporter(manager)

        def polled() -> None:
            reporter.report_poll()
            listener.drain()  # a socket's queue is short

        work = threading.Thread(target=lambda: asyncio.run(bench.daemon.run(samples=5, on_poll=polled)))
        work.start()
        assert stuck.wait(60.0)
        fed = listener.drain().count("WATCHDOG=1")
        assert listener.lines[0] == "READY=1"
        # Every poll before the one that hangs was told, and that one was not.
        polls = (bench.clock.monotonic_ns() // NS) // 10
        free.set()
        work.join(60.0)
        assert fed == polls - 1
    assert listener.drain().count("WATCHDOG=1") > fed


def test_a_held_internal_error_counts_as_work_and_is_told(bench: Bench, listener: Listener) -> None:
    with ServiceManager(listener.environment(30.0)) as manager:
        reporter = Reporter(manager)
        publish = bench.daemon._publish
        bench.daemon._publish = lambda name, data: (publish(name, data), reporter.report_message(name, data))[0]
        bench.daemon._compensation.process = lambda raw: 1 / 0  # type: ignore[method-assign,assignment,return-value]
        asyncio.run(bench.daemon.run(samples=2, on_poll=reporter.report_poll))
    assert listener.drain().count("WATCHDOG=1") >= 7
    assert any("internal_error" in line for line in listener.lines if line.startswith("STATUS="))


# ---------------------------------------------------------------------------- words


def test_status_line() -> None:
    assert status(offset()) == "ok: Y offset -12.34 µm, -0.81 µm/min; sample 7"
    held = offset(state="hold", reasons=["t_q_missing", "prediction_expired"], y_offset_rate_um_per_min=None)
    assert status(held) == "hold (t_q_missing, prediction_expired): Y offset -12.34 µm; sample 7"
    assert status(offset(state="starting", y_offset_um=None)) == "starting: no offset yet; sample 7"


@pytest.mark.parametrize(
    ("happened", "expected"),
    [
        (event("state", state="ok", reasons=[]), logging.INFO),
        (event("state", state="hold", reasons=["x"]), logging.WARNING),
        (event("state", state="degraded", reasons=["x"]), logging.WARNING),
        (event("state", state="fault", reasons=["x"]), logging.ERROR),
        (event("device", ok=False, device="x"), logging.WARNING),
        (event("device", ok=True, device="x"), logging.INFO),
        (event("error"), logging.ERROR),
        (event("zero"), logging.INFO),
    ],
)
def test_what_somebody_must_see_is_a_warning(happened: Event, expected: int) -> None:
    assert level(happened) == expected


def parsed(data: bytes) -> dict[str, str]:
    """Read a datagram as journald does, from its documentation."""
    fields = {}
    while data:
        line, _, data = data.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            (size,) = struct.unpack("<Q", data[:8])
            value, data = data[8 : 8 + size], data[9 + size :]
        fields[name.decode()] = value.decode()
    return fields


def test_events_reach_the_journal_with_their_fields(tmp_path: Path, listener: Listener) -> None:
    log = logging.getLogger("compensator")
    handler = systemd.JournalHandler(str(listener.path))
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        with ServiceManager({}) as manager:
            reporter = Reporter(manager)
            changed = event("state", "hold t_q_missing", state="hold", reasons=["t_q_missing"])
            reporter.report_message("event", msgspec.json.encode(changed))
            first = parsed(listener.socket.recv(65536))
            reporter.report_message("event", msgspec.json.encode(event("device", "two\nlines", ok=True)))
            second = parsed(listener.socket.recv(65536))
    finally:
        log.removeHandler(handler)
        log.setLevel(logging.NOTSET)
        handler.close()
    assert first == {
        "MESSAGE": "state: hold t_q_missing",
        "PRIORITY": "4",
        "SYSLOG_IDENTIFIER": "compensator",
        "LOGGER": "compensator",
        "MACHINE": "vmc-07",
        "SEQ": "3",
        "KIND": "state",
        "STATE": "hold",
        "REASONS": "t_q_missing",
    }
    assert second["MESSAGE"] == "device: two\nlines" and second["STATE"] == "hold" and second["PRIORITY"] == "6"


@pytest.fixture
def refused(tmp_path: Path) -> Iterator[Callable[..., None]]:
    """What logs a line while nobody is at the journal's socket."""
    handler = systemd.JournalHandler(str(tmp_path / "nobody"))
    yield lambda *words: handler.emit(logging.LogRecord("compensator", logging.INFO, "", 0, words[0], words[1:], None))
    handler.close()


def test_a_journal_that_is_gone_loses_no_line(refused: Callable[..., None], capfd: pytest.CaptureFixture[str]) -> None:
    refused("still said")
    assert capfd.readouterr().err == "still said\n"
    refused("%d µm", 3)
    refused("µ" * 9000)
    assert capfd.readouterr().err.startswith("3 µm\n" + "µ" * 2000)
    refused("%d", "no number")
    assert "--- Logging error ---" in capfd.readouterr().err


def test_a_stream_that_nobody_reads_neither_blocks_a_line_nor_ends_the_service(
    refused: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    read, write = os.pipe()
    with os.fdopen(write, "w", buffering=1) as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        logging_all = threading.Thread(target=lambda: [refused("x" * 100) for _ in range(3000)], daemon=True)
        logging_all.start()
        logging_all.join(60.0)
        blocked = logging_all.is_alive()
        os.close(read)
        logging_all.join(60.0)
        assert not blocked
        refused("to a broken pipe")
    refused("to a closed stream")


def test_only_the_stream_that_systemd_names_is_the_journal(tmp_path: Path) -> None:
    with (tmp_path / "file").open("w") as file:
        found = os.fstat(file.fileno())
        named = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}
        assert systemd.is_connected(named, file.fileno())
        assert not systemd.is_connected({}, file.fileno())
        with (tmp_path / "other").open("w") as other:
            assert not systemd.is_connected(named, other.fileno())
    assert not systemd.is_connected(named, 9999)


# ---------------------------------------------------------------------------- the real process


def test_the_process_under_a_manager(tmp_path: Path, listener: Listener) -> None:
    """`compensator run` with no device there at all: ready, alive in pace, its state in words, ending, all finished."""
    config = tmp_path / "machine.toml"
    text = configuration("vmc-07", LINES, free_port()).replace('"quill"', f'"{load_fast_model(tmp_path).name}"')
    config.write_text(text.replace("poll_interval_s = 10.0", "poll_interval_s = 0.25"), encoding="utf-8")
    with (tmp_path / "stderr").open("w") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "compensator", "run", "--config", str(config)],
            stderr=stderr,
            env=os.environ | listener.environment(0.1),
        )
        try:
            lines = listener.until(lambda lines: lines.count("WATCHDOG=1") >= 6)
            assert lines[:3] == [
                "STATUS=starting: reading the last recording",
                "WATCHDOG_USEC=750000",
                "STATUS=starting: waiting for the first poll",
            ]
            assert lines.count("READY=1") == 1 and lines.index("READY=1") < lines.index("WATCHDOG=1")
            listener.until(lambda lines: any("no offset yet; sample" in line for line in lines))
            process.send_signal(signal.SIGTERM)
            listener.until(lambda lines: "STOPPING=1" in lines)
            assert process.wait(60) == 0
        finally:
            process.kill()
            process.wait()
    said = (tmp_path / "stderr").read_text()
    assert "compensator: running" in said and "device: " in said and "recording finished" in said
    assert recordings(tmp_path / "recordings", "vmc-07")[0].read_bytes().endswith(b"\x89MCAP0\r\n")
    assert "Traceback" not in said
