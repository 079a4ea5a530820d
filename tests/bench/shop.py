"""A shop of 200 machines through one router: is anything lost, how late does it arrive, what does it cost.

`python -m tests.bench.shop [PERIOD_S SAMPLES]…` measures; without numbers 1 s and 60 s.

The router is a process of its own. The machines are the service's own publishers, a session each, in a few processes;
all of them publish a sample at the same instant, as services do whose clocks are set by one time service. Messages
have the sizes of a service with six channels. What hears them is `watch` with its recorder, in one process more.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from compensator.clock import SystemClock
from compensator.config import Zenoh
from compensator.messages import ChannelSample, EstimateMessage, Offset, Sample, Status, encode
from compensator.service.publisher import Publisher
from compensator.watch.listener import Listener, of_endpoints
from compensator.watch.shop import Shop
from compensator.watch.shop_recorder import ShopRecorder
from tests.bench.figures import Figure, told
from tests.ports import free_port

MACHINES, PROCESSES = 200, 4
#: Messages of one sample of one machine.
KINDS = ("offset", "sample", "estimate", "status")
CHANNELS = ("t_q_degc", "at_degc", "y_um", "base_degc", "spindle_rpm", "coolant_degc")


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What came of one run.

    Parameters
    ----------
    sent, heard, recorded : int
        Messages.
    missed : int
        Of the offsets, samples and estimates, by the recorder's own count.
    late_ms : numpy.ndarray, shape (heard,)
        From the publisher's call to the listener's, ms.
    router_pct, watch_pct : float
        Processor time while samples came, per cent of a core.
    bytes_per_sample : float
        Payload of one machine's messages of one sample.
    """

    sent: int
    heard: int
    recorded: int
    missed: int
    late_ms: np.ndarray[Any, np.dtype[np.float64]]
    router_pct: float
    watch_pct: float
    bytes_per_sample: float


def messages(machine: str, seq: int) -> Iterator[tuple[str, bytes]]:
    """Yield what a service publishes of one sample, with the time of each call as its time."""
    head = {"schema": 1, "machine": machine, "seq": seq}
    channel = ChannelSample(
        mean=31.41592653589793,
        min=31.29,
        max=31.52,
        spread=0.05123456789,
        count=60,
        polls=60,
        quality="good",
        device_quality="good",
    )
    yield (
        "offset",
        encode(
            Offset(
                **head,
                time_utc_ns=time.time_ns(),
                valid_for_s=150.0,
                y_offset_um=-12.345678901234567,
                y_offset_rate_um_per_min=-0.8123456789,
                y_offset_std_um=0.4212345678,
                state="ok",
                reasons=[],
                model_sha256="0" * 64,
            )
        ),
    )
    yield (
        "sample",
        encode(Sample(**head, time_utc_ns=time.time_ns(), period_s=60.0, channels=dict.fromkeys(CHANNELS, channel))),
    )
    values = dict.fromkeys(
        (
            "t_q_ref_degc",
            "at_ref_degc",
            "y_ref_um",
            "heat_w",
            "heat_std_w",
            "y_dtf_um",
            "y_tdtf_um",
            "y_base_um",
            "y_pred_um",
            "y_std_um",
            "y_rate_um_per_min",
            "y_um",
            "residual_um",
        ),
        12.345678901234567,
    )
    yield "estimate", encode(EstimateMessage(**head, time_utc_ns=time.time_ns(), y_effects_um=[1.2345678], **values))
    yield (
        "status",
        encode(
            Status(
                **head,
                time_utc_ns=time.time_ns(),
                state="ok",
                reasons=[],
                version="0.1.0",
                model="vmc",
                model_kind="heat",
                model_sha256="0" * 64,
                started_utc_ns=1,
                recording=f"{machine}_20260105T060000Z.mcap",
                devices=dict.fromkeys(("spindle-couples", "cabinet-couples", "control", "probe"), "ok"),
            )
        ),
    )


# ---------------------------------------------------------------------------- the processes


def route(port: int) -> None:
    """Be the router until stdin ends."""
    import zenoh

    from compensator.service.session import session_config

    with zenoh.open(session_config(Zenoh(prefix="router", mode="router", listen=[f"tcp/127.0.0.1:{port}"]))):
        say("ready")
        sys.stdin.read()
        time.sleep(1.0)  # where all are ended at once, those that would complain go first


def publish(port: int, first: int, count: int, period_s: float, samples: int) -> None:
    """Be some machines: open, wait until somebody hears each, and publish on the second that is told."""
    lines = obeyed()
    names = [f"vmc-{i:03d}" for i in range(first, first + count)]
    publishers = [
        Publisher(
            Zenoh(prefix=f"shop/{name}", mode="peer", connect=[f"tcp/127.0.0.1:{port}"]),
            lambda name, payload, sender: {"ok": False, "text": "not here"},
        )
        for name in names
    ]
    with ExitStack() as stack, ThreadPoolExecutor(count) as pool:
        for opened in [pool.submit(stack.enter_context, publisher) for publisher in publishers]:
            opened.result()
        while not all(one.matching_status.matching for p in publishers for one in p._publishers.values()):
            time.sleep(0.05)
        say("ready")
        start = float(lines.get())
        for seq in range(samples):
            time.sleep(max(start + seq * period_s - time.time(), 0.0))
            for publisher, name in zip(publishers, names, strict=True):
                for kind, data in messages(name, seq):
                    publisher.publish(kind, data)
        say("done")
        threading.Event().wait()


def obeyed() -> queue.SimpleQueue[str]:
    """Return the lines of stdin; at its end this process is over at once.

    As if killed: 50 sessions that close one after the other would each say meanwhile that the router is gone.
    """
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)
        os._exit(0)

    threading.Thread(target=read, daemon=True).start()
    return lines


class Late:
    """A sink that notes how late each message is."""

    def __init__(self) -> None:
        self.late_ns: list[int] = []

    def receive(self, key: str, payload: bytes, *, asked: bool = False) -> None:
        if not asked:
            now_ns = time.time_ns()
            at = payload.index(b'"time_utc_ns":') + 14
            self.late_ns.append(now_ns - int(payload[at : payload.index(b",", at)]))

    def set_alive(self, key: str, alive: bool) -> None:
        return


def hear(port: int, folder: Path) -> None:
    """Be the watch with its recorder until stdin ends; tell how many were heard whenever a line comes."""
    late, shop = Late(), Shop(SystemClock())
    with ExitStack() as stack:
        recorder = stack.enter_context(ShopRecorder(folder, "shop", SystemClock()))
        source = of_endpoints("shop", [f"tcp/127.0.0.1:{port}"])
        stack.enter_context(Listener(source, late, shop, recorder)).open()
        say("ready")
        for _ in sys.stdin:
            say(len(late.late_ns))
    tokens = recorder.messages - len(late.late_ns)
    say(
        {
            "late_ns": late.late_ns,
            "recorded": recorder.messages - tokens,
            "missed": sum(recorder.missed().values()),
            "machines": len(shop.overview()),
            "tokens": tokens,
        }
    )


def say(what: Any) -> None:
    print(json.dumps(what), flush=True)


# ---------------------------------------------------------------------------- one run


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def started(*arguments: object) -> Iterator[tuple[subprocess.Popen[str], IO[str], IO[str]]]:
    """Run this module as a process of its own; yield it when it is ready."""
    command = [sys.executable, "-m", "tests.bench.shop", *map(str, arguments)]
    # A group of its own: Ctrl-C reaches this process alone, which ends machines and watch before their router.
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        try:
            assert process.stdin is not None and process.stdout is not None
            yield process, process.stdin, process.stdout
        finally:
            process.kill()


def answer(out: IO[str]) -> Any:
    line = out.readline()
    if not line:
        raise RuntimeError("a process of the shop has ended")
    return json.loads(line)


def measure(
    folder: Path, period_s: float, samples: int, machines: int = MACHINES, processes: int = PROCESSES
) -> Measured:
    """Run a shop.

    Parameters
    ----------
    folder : pathlib.Path
        Where the recording goes.
    period_s : float
        Time between two samples of a machine, s.
    samples, machines, processes : int
        How many samples of how many machines in how many processes.
    """
    port = free_port()
    each, sent = machines // processes, machines * samples * len(KINDS)
    with ExitStack() as stack:
        router, _, out = stack.enter_context(started("route", port))
        answer(out)
        watch, asks, answers = stack.enter_context(started("hear", port, folder))
        answer(answers)
        shops = [
            stack.enter_context(started("publish", port, i * each, each, period_s, samples)) for i in range(processes)
        ]
        for _, _, out in shops:
            answer(out)
        start = np.ceil(time.time() + 0.5)
        for _, into, _ in shops:
            into.write(f"{start}\n")
            into.flush()
        time.sleep(max(start - time.time() - 0.2, 0.0))
        before, began = (cpu_seconds(router.pid), cpu_seconds(watch.pid)), time.monotonic()
        for _, _, out in shops:
            answer(out)
        heard, waited = 0, time.monotonic()
        while heard < sent and time.monotonic() - waited < 10.0:
            asks.write("\n")
            asks.flush()
            heard = answer(answers)
            time.sleep(0.05)
        # The last sample's period belongs to it, as every other's.
        time.sleep(max(samples * period_s - (time.monotonic() - began), 0.0) if period_s <= 1.0 else 0.0)
        seconds = max(time.monotonic() - began, samples * period_s)
        router_s, watch_s = cpu_seconds(router.pid) - before[0], cpu_seconds(watch.pid) - before[1]
        asks.close()
        found = answer(answers)
    late_ms = np.array(found["late_ns"]) / 1e6
    size = sum(len(data) for _, data in messages("vmc-000", 1))
    return Measured(
        sent=sent,
        heard=late_ms.size,
        recorded=found["recorded"],
        missed=found["missed"],
        late_ms=late_ms,
        router_pct=100.0 * router_s / seconds,
        watch_pct=100.0 * watch_s / seconds,
        bytes_per_sample=float(size),
    )


def report(runs: tuple[tuple[float, int], ...] = ((1.0, 60), (60.0, 3))) -> Iterator[Figure]:
    """Yield what is lost, how late it arrives and what it costs, for each pace: period, s, and number of samples."""
    for period_s, samples in runs:
        with tempfile.TemporaryDirectory() as folder:
            got = measure(Path(folder), period_s, samples)
        middle, high, most = np.percentile(got.late_ms, [50, 99, 100])
        pace = f"{MACHINES} machines at one instant every {period_s:g} s through one router, {samples} samples"
        yield told(
            Figure(
                what=f"{pace}: lost of {got.sent} messages ({got.bytes_per_sample:.0f} bytes a sample)",
                found=f"{got.sent - got.heard} on the way, {got.sent - got.recorded} not recorded",
                wanted="none",
            )
        )
        yield told(
            Figure(
                what=f"{pace}: from the call of one to the call of the other",
                found=f"{middle:.1f} ms median, {high:.1f} 99th percentile, {most:.0f} most",
            )
        )
        yield told(
            Figure(
                what=f"{pace}: processor",
                found=f"{got.router_pct:.1f} % of a core for the router",
                beside=f"{got.watch_pct:.1f} % for watch with its recorder",
            )
        )


def main() -> None:
    """Measure what stands on the command line, or be one of the processes."""
    role, *rest = sys.argv[1:] or [""]
    if role == "route":
        return route(int(rest[0]))
    if role == "hear":
        return hear(int(rest[0]), Path(rest[1]))
    if role == "publish":
        port, first, count = map(int, rest[:3])
        return publish(port, first, count, float(rest[3]), int(rest[4]))
    numbers = [float(word) for word in sys.argv[1:]] or [1.0, 60.0, 60.0, 3.0]
    list(report(tuple((numbers[i], int(numbers[i + 1])) for i in range(0, len(numbers), 2))))
    return None


if __name__ == "__main__":
    main()
