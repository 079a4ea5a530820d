"""A year of samples: made by the service's own compensation and recorder, then audited; time, ratio and memory.

`python -m tests.bench.audit [FOLDER]` keeps the recordings in FOLDER and uses them again.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest import mock

import msgspec
from mcap.reader import make_reader

from compensator.audit.series import audit
from compensator.commands.workers import workers
from compensator.container import PAYLOAD, Container
from compensator.messages import MESSAGES
from compensator.recording import recordings
from tests.audit.made import MACHINE, Service

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


def measure(folder: Path) -> None:
    paths = recordings(folder, MACHINE)
    size = sum(path.stat().st_size for path in paths)
    count = os.cpu_count() or 1
    print(f"\na year audited: {len(paths)} files, {size / 1e6:.0f} MB, {count} processes")
    for _ in range(3):
        library, messages = over_all(read_with_library, paths, count)
        own, _ = over_all(read_by_ourselves, paths, count)
        began = time.perf_counter()
        with workers(len(paths), None) as executor:
            found = audit(paths, executor=executor)
        seconds = time.perf_counter() - began
        print(
            f"{found.samples} samples, {messages} messages, clean: {found.clean}; audit {seconds:.1f} s; reading and "
            f"decoding with the library {library:.1f} s (audit / that = {seconds / library:.2f}), with our reader "
            f"{own:.1f} s ({seconds / own:.2f})"
        )
    largest = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(f"largest process: {largest / 1024:.0f} MB")


def measurements() -> None:
    """Make and audit a year in a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder))
        measure(Path(folder))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        kept = Path(sys.argv[1])
        if not recordings(kept, MACHINE):
            make(kept)
        measure(kept)
    else:
        measurements()
