"""A machine with simulated devices, its service as a process of its own, and receivers in sessions of their own."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from compensator.recording.reading import read_messages, recordings
from sim_hardware.wire import IcpDas, ModbusTcpServer, Rack

QUILL = Path(__file__).parents[2] / "compensator/model/quill.toml"
#: Largest change of the offset, µm/min.
RATE_UM_PER_MIN = 12.0
PATIENCE_S = 60.0
#: Reasons with which an offset is published before it is on disk.
EARLY = {"recording_late", "recording_failed"}
#: The service, but for how long it waits for a token that a dead one may have left.
SOON = """
from compensator.cli import main
from compensator.service import presence
presence.STALE_S = {stale_s}
raise SystemExit(main())
"""


def session(**keys: Any) -> Any:
    """A Zenoh session that looks for nobody."""
    config = zenoh.Config()
    retry = {"period_init_ms": 100, "period_max_ms": 300, "period_increase_factor": 1.5}
    for key, value in {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/retry": retry,
        **{key.replace("__", "/"): value for key, value in keys.items()},
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Receiver:
    """Notes every offset and event, as bytes, in the order in which they come."""

    def __init__(self, prefix: str, **keys: Any) -> None:
        self.prefix = prefix
        self.offsets: list[bytes] = []
        self.events: list[dict[str, Any]] = []
        self._keys = keys
        self._came = threading.Condition()

    def __enter__(self) -> Receiver:
        self.session = session(**self._keys)
        self.session.declare_subscriber(f"{self.prefix}/thermal/y/offset", self._offset)
        self.session.declare_subscriber(f"{self.prefix}/thermal/event", self._event)
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def _offset(self, sample: Any) -> None:
        with self._came:
            self.offsets.append(sample.payload.to_bytes())
            self._came.notify_all()

    def _event(self, sample: Any) -> None:
        with self._came:
            self.events.append(json.loads(sample.payload.to_bytes()))
            self._came.notify_all()

    def wait(self, done: Callable[[], bool], what: str, timeout_s: float = PATIENCE_S) -> None:
        with self._came:
            assert self._came.wait_for(done, timeout_s), what

    def more(self, count: int) -> None:
        """Wait for so many offsets more."""
        wanted = len(self.offsets) + count
        self.wait(lambda: len(self.offsets) >= wanted, f"offset {wanted}, got {len(self.offsets)}")

    @property
    def messages(self) -> list[dict[str, Any]]:
        return [json.loads(data) for data in self.offsets]

    def ask(self, key: str, payload: bytes = b"", timeout_s: float = 10.0) -> list[dict[str, Any]]:
        """Replies to a query below the prefix."""
        replies = self.session.get(f"{self.prefix}/thermal/{key}", payload=payload, timeout=timeout_s)
        return [json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]


class Site:
    """One machine: devices that answer for as long as it is open, a configuration, a service that can be started.

    The temperatures move by themselves, so that each offset differs from the one before.
    """

    def __init__(
        self,
        folder: Path,
        *,
        name: str = "vmc-07",
        period_s: float = 0.5,
        polls: int = 2,
        connect: list[str],
        recording: str = "recordings",
        extra: str = "",
    ) -> None:
        self.folder, self.name, self.prefix = folder, name, f"shop/{name}"
        self.recordings = folder / recording
        self._rack = Rack()
        began = time.monotonic()

        def t_q() -> float:
            return 26.0 + 2.0 * math.sin((time.monotonic() - began) / 30.0)

        couples = IcpDas("et-7018z", ranges="T", sources={0: t_q, 1: lambda: 21.0})
        self._server = ModbusTcpServer({1: couples})
        self._period_s, self._polls, self._connect, self._recording, self._extra = (
            period_s,
            polls,
            connect,
            recording,
            extra,
        )
        self.config = folder / "machine.toml"

    def __enter__(self) -> Site:
        self._rack.__enter__()
        self._rack.add(self._server)
        model = self.folder / "fast.toml"
        text = QUILL.read_text(encoding="utf-8")
        model.write_text(
            text.replace("sample_period_s = 60.0", f"sample_period_s = {self._period_s}"), encoding="utf-8"
        )
        self.model = model
        self.config.write_text(self.text(), encoding="utf-8")
        return self

    def __exit__(self, *error: Any) -> None:
        self._rack.__exit__(*error)

    def text(self) -> str:
        return f"""[machine]
name = "{self.name}"
[model]
file = "fast.toml"
[sampling]
poll_interval_s = {self._period_s / self._polls}
[limits]
offset_max_um = 200.0
offset_rate_max_um_per_min = {RATE_UM_PER_MIN}
[limits.validity]
t_q_degc = [10.0, 60.0]
at_degc = [10.0, 35.0]
[loss]
predict_for_min = 10.0
[zero]
rest_rate_um_per_min = 0.2
[guards]
t_q_below_at_max_k = 5.0
[zenoh]
prefix = "{self.prefix}"
mode = "peer"
connect = {json.dumps(self._connect)}
[recording]
folder = "{self._recording}"
{self._extra}
[[line]]
name = "cabinet"
protocol = "modbus-tcp"
host = "127.0.0.1"
tcp_port = {self._server.port}
[[device]]
name = "couples"
line = "cabinet"
model = "icpdas-et7018z"
address = 1
format = "hex"
inputs = [{{ input = 0, couple = "T" }}, {{ input = 1, couple = "T" }}]
[[channel]]
name = "t_q_degc"
device = "couples"
input = 0
range = [0.0, 80.0]
rate_max_per_min = 100.0
stuck_after_min = 60.0
[[channel]]
name = "at_degc"
device = "couples"
input = 1
range = [0.0, 50.0]
rate_max_per_min = 100.0
stuck_after_min = 6000.0
"""

    def start(
        self, config: Path | None = None, *, stale_s: float | None = None, **options: Any
    ) -> subprocess.Popen[str]:
        """Start the service; it may not be ready yet. With `stale_s` it waits for that long until a token counts."""
        program = ["-m", "compensator"] if stale_s is None else ["-c", SOON.format(stale_s=stale_s)]
        command = [sys.executable, *program, "run", "--config", str(config or self.config)]
        return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)

    @contextlib.contextmanager
    def service(self, **options: Any) -> Iterator[subprocess.Popen[str]]:
        """The service, until the end of the block."""
        process = self.start(**options)
        try:
            yield process
        finally:
            end(process)

    def on_disk(self, newest: int | None = None) -> dict[int, bytes]:
        """Every recorded offset by its number; of so many files where that is given. None stands there twice."""
        found: dict[int, bytes] = {}
        for path in recordings(self.recordings, self.name)[-(newest or 0) :]:
            for record in read_messages(path, ("offset",)):
                seq = json.loads(record.data)["seq"]
                assert seq not in found, (path.name, seq)
                found[seq] = record.data
        return found

    def missing(self) -> list[int]:
        """Numbers that stand in no recording; of so many samples the service itself says that it stood still."""
        numbers = self.on_disk()
        missing = sorted(set(range(min(numbers), max(numbers))) - set(numbers))
        said = 0
        for path in recordings(self.recordings, self.name):
            events = [json.loads(record.data) for record in read_messages(path, ("event",))]
            said += sum(event["data"]["missing"] for event in events if event["kind"] == "restart")
        assert len(missing) == said, (missing, said)
        return missing

    def replay(self, public_key: Path | None = None) -> dict[str, Any]:
        """What `compensator replay` says, with its exit code; with a key it knows the head of the chain, too."""
        command = [sys.executable, "-m", "compensator", "replay", str(self.recordings), "--json"]
        if public_key is not None:
            head = self.recordings.parent / f"{self.name}.head.json"
            command += ["--public-key", str(public_key), "--head", str(head)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
        assert done.stdout, done.stderr
        return {**json.loads(done.stdout), "exit": done.returncode}


def end(process: subprocess.Popen[str]) -> str:
    """Kill a process, if it still runs; return what it said."""
    process.kill()
    _, said = process.communicate()
    return said


def check_received(offsets: list[bytes], period_s: float) -> dict[str, float]:
    """Numbers only grow, and nothing jumps: by time, at least one sample, at the permitted rate."""
    messages = [json.loads(data) for data in offsets]
    worst = 0.0
    for before, after in itertools.pairwise(messages):
        assert after["seq"] > before["seq"], (before, after)
        if before["y_offset_um"] is None:
            continue
        assert after["y_offset_um"] is not None, after
        seconds = max((after["time_utc_ns"] - before["time_utc_ns"]) / 1e9, period_s)
        share = abs(after["y_offset_um"] - before["y_offset_um"]) / (RATE_UM_PER_MIN * seconds / 60.0)
        assert share <= 1.0 + 1e-9, (before, after)
        worst = max(worst, share)
    return {"offsets": len(messages), "largest_share_of_rate": worst}


def is_early(data: bytes) -> bool:
    """Whether an offset says of itself that it was published before it was on disk."""
    return bool(EARLY & set(json.loads(data)["reasons"]))
