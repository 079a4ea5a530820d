"""A year of samples: made by the service's own compensation and recorder, then audited; time, ratio and memory.

`python -m tests.bench.audit [FOLDER]` keeps the recordings in FOLDER and uses them again.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest import mock

import msgspec
from mcap.reader import make_reader

from compensator.audit.machine_audit import audit
from compensator.commands.workers import workers
from compensator.messages import MESSAGES
from compensator.recording.container import PAYLOAD, Container
from compensator.recording.reading import recordings
from tests.audit.made import MACHINE, Service
from tests.bench.figures import Figure, spread, told

SAMPLES = 525_600
DECODERS = {topic: msgspec.json.Decoder(kind) for topic, kind in MESSAGES.items()}


def make(folder: Path, samples: int = SAMPLES) -> None:
    """Record a year, faster than real time: nothing is synced."""
    with mock.patch("os.fsync", lambda descriptor: None):
        Service(folder).run(samples).stop()


def read_with_library(path: Path) -> int:
    """Read and decode every message with the mcap library, in its fast order."""
    count = 0
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            DECODERS[channel.topic[1:]].decode(message.data)
            count += 1
    return count


def read_by_ourselves(path: Path) -> int:
    """Read and decode every message with the audit's own reader."""
    count = 0
    with Container(path) as container:
        channels = container.contents.channels
        for channel, _, _, body in container.messages():
            DECODERS[channels[channel].topic[1:]].decode(body[PAYLOAD:])
            count += 1
    return count


def over_all(read: Callable[[Path], int], paths: Sequence[Path], workers: int) -> tuple[float, int]:
    """Seconds and messages for all files, in as many processes as the audit uses."""
    began = time.perf_counter()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        count = sum(pool.map(read, paths))
    return time.perf_counter() - began, count


def measure(folder: Path) -> Iterator[Figure]:
    paths = recordings(folder, MACHINE)
    size = sum(path.stat().st_size for path in paths)
    count = os.cpu_count() or 1
    audits, libraries, owns = [], [], []
    for _ in range(3):
        libraries.append(over_all(read_with_library, paths, count)[0])
        owns.append(over_all(read_by_ourselves, paths, count)[0])
        began = time.perf_counter()
        with workers(len(paths), None) as executor:
            found = audit(paths, executor=executor)
        audits.append(time.perf_counter() - began)
        assert found.clean and found.samples == SAMPLES
    library, own = (statistics.median(a / b for a, b in zip(audits, one, strict=True)) for one in (libraries, owns))
    beside = (
        f"{library:.2f} × reading and decoding with the mcap library, {own:.2f} × with our own faster reader "
        f"({count} processes each)"
    )
    what = f"a year audited ({SAMPLES:,} samples, {len(paths)} files, {size / 1e6:.0f} MB)"
    yield spread(what, audits, "s", wanted="under 30 s; 2.5 ×", beside=beside)
    yield told(Figure(what="the same: largest process", found=f"{memory_mb(folder):.0f} MB", wanted="bounded"))


def memory_mb(folder: Path) -> float:
    """Largest process of a `replay`, MB: of that command alone, not of what else this one has started."""
    process = subprocess.Popen(
        [sys.executable, "-m", "compensator", "replay", str(folder)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return usage.ru_maxrss / 1024


def report() -> Iterator[Figure]:
    """Make and audit a year in a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder))
        yield from measure(Path(folder))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        kept = Path(sys.argv[1])
        if not recordings(kept, MACHINE):
            make(kept)
        list(measure(kept))
    else:
        list(report())
