"""A day of three axes and two tilts beside one of Y alone: time of a sample, size of the recording, audit."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from compensator.audit.machine_audit import audit
from compensator.messages import encode
from compensator.recording.reading import messages
from compensator.service.compensation import Compensation, model_of
from compensator.service.daemon import Daemon
from tests.audit.made import CONFIG
from tests.bench.figures import Figure, spread
from tests.service.several import AXES, SENSORS, TILT, SeveralAxes, config_text, model_text

SAMPLES = 1440
#: A second tilt, of the probes of the first in another plane.
SECOND = TILT.replace("[axis.a]", "[axis.b]").replace('"low", "high"', '"x", "high"')
MACHINES = {
    "Y alone": (CONFIG + SENSORS.encode(), model_text("y")),
    "X, Y, Z and two tilts": (config_text(AXES, TILT, SECOND), model_text("y", "x", "z", "low", "high")),
}


def decided(machine: SeveralAxes) -> list[float]:
    """Decide every recorded sample again, with its state and all its messages; return the processor time of each, s."""
    config = machine.config
    running = Compensation(config, model_of(config, machine.configured, source="bench"))
    taken = []
    for path in machine.recordings:
        for sample in messages(path, ("sample",)):
            began = time.process_time()
            running.frozen()
            outcome = running.process(sample)
            for message in (outcome.sample, outcome.estimate, outcome.offset, *outcome.further):
                encode(message)
            taken.append(time.process_time() - began)
    return taken


@contextmanager
def samples_timed() -> Iterator[list[float]]:
    """Note the processor time of every sample in the service, from the last poll until it is published, s."""
    whole, found = Daemon._sample, list[float]()

    async def timed(daemon: Daemon, label_ns: int) -> None:
        began = time.process_time()
        await whole(daemon, label_ns)
        found.append(time.process_time() - began)

    Daemon._sample = timed  # type: ignore[method-assign]
    try:
        yield found
    finally:
        Daemon._sample = whole  # type: ignore[method-assign]


def day(name: str) -> tuple[float, ...]:
    """Return the figures of a day, in the order of `ASKED`."""
    with tempfile.TemporaryDirectory() as folder:
        machine = SeveralAxes(Path(folder), *MACHINES[name], noise=True)
        with samples_timed() as seconds:
            machine.run(SAMPLES)
        assert machine.daemon is not None
        latency = float(np.median(machine.daemon.latency_s)) * 1e3
        size = sum(path.stat().st_size for path in machine.recordings) / 1e6
        began = time.process_time()
        found = audit(machine.recordings)
        audited = time.process_time() - began
        assert found.clean
        decide = statistics.median(decided(machine)) * 1e6
        return latency, float(np.mean(seconds)) * 1e3, decide, size, audited


#: Name, unit and aim of each figure.
ASKED = (
    ("end of the last poll to all offsets published, sample on disk first", "ms", "at most 1.5 ×"),
    ("processor time of a sample, recorded and published", "ms", "at most 1.5 ×"),
    ("processor time to decide it, with its state and messages", "µs", ""),
    ("size of a day's recording", "MB", "at most 2 ×"),
    ("processor time of its audit", "s", ""),
)


def report() -> list[Figure]:
    """Measure both days by turns, three times."""
    return list(figures())


def figures(runs: int = 3) -> Iterator[Figure]:
    """Measure both days by turns."""
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in MACHINES}
    for _ in range(runs):
        for name in MACHINES:
            found[name].append(day(name))
    alone, several = found.values()
    for column, (what, unit, wanted) in enumerate(ASKED):
        values, beside = ([run[column] for run in runs_of] for runs_of in (several, alone))
        ratio = statistics.median(a / b for a, b in zip(values, beside, strict=True))
        yield spread(
            f"X, Y, Z and two tilts: {what}",
            values,
            unit,
            wanted=wanted,
            beside=f"{ratio:.2f} × that of Y alone, {statistics.median(beside):.3g} {unit}",
        )
