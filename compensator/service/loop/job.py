"""What the service and the process of its diagnosis hand each other: files in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from compensator.atomic_write import replace_file
from compensator.data.probed import zeros_ns
from compensator.errors import DataError
from compensator.input_file import RESULT_BYTES, read_file
from compensator.messages import UNREADABLE, Event, Offset, Probe, Sample
from compensator.recording.reading import files_since, messages, recordings

#: Files in the folder of a diagnosis: the job with the calibrated model; and the result, written last.
JOB, CALIBRATED, RESULT = "job.json", "calibrated.toml", "result.json"


class Job(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is diagnosed, within which limits.

    Parameters
    ----------
    recordings, machine : str
        Folder of the recordings and name of the machine.
    from_utc_ns, to_utc_ns : int
        Time that is diagnosed, ns since 1970 UTC.
    probe_std_um : float or None
        Standard deviation of one probe, µm.
    memory_mb, time_limit_min : float
        Limits of memory and computing time.
    parent : int
        Process that it ends with.
    """

    recordings: str
    machine: str
    from_utc_ns: int
    to_utc_ns: int
    probe_std_um: float | None
    memory_mb: float
    time_limit_min: float
    parent: int


class Result(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What came out; see `weighing.Diagnosed`. The model is in a file of its own."""

    verdict: str
    effects: list[str] = []
    text: str = ""
    needs: str = ""
    y_moved_utc_ns: int = 0

    def write(self, path: Path) -> None:
        """Write it atomically."""
        replace_file(path, msgspec.json.encode(self))


def read_job(path: Path) -> Job:
    """Read a job.

    Raises
    ------
    DataError
        If it is none.
    """
    try:
        return msgspec.json.decode(read_file(path, RESULT_BYTES), type=Job)
    except (OSError, *UNREADABLE) as error:
        raise DataError(f"{path}: {error}") from error


@dataclass(frozen=True, slots=True)
class JobRecord:
    """What a job is made on.

    Parameters
    ----------
    rows : list of (Sample, Offset or None)
        Samples with their offsets.
    probes : list of Probe
        Probes.
    zeros_ns : list of int
        Times of the samples with which a zero was set, ns since 1970 UTC.
    """

    rows: list[tuple[Sample, Offset | None]]
    probes: list[Probe]
    zeros_ns: list[int]


def read_record(job: Job) -> JobRecord:
    """Return the record of a job; of a damaged recording what comes before the damage."""
    samples: dict[int, Sample] = {}
    offsets: dict[int, Offset] = {}
    probes, events = list[Probe](), list[Event]()
    for path in files_since(recordings(Path(job.recordings), job.machine), job.from_utc_ns):
        for message in _usable_messages(path):
            if isinstance(message, Event):
                events.append(message)
            elif not job.from_utc_ns < message.time_utc_ns <= job.to_utc_ns:
                continue
            elif isinstance(message, Sample):
                samples[message.seq] = message
            elif isinstance(message, Offset):
                offsets[message.seq] = message
            else:
                probes.append(message)
    rows = [(samples[seq], offsets.get(seq)) for seq in sorted(samples)]
    ends_ns = {seq: sample.time_utc_ns for seq, sample in samples.items()}
    zeros = [at for at in sorted(zeros_ns(events, ends_ns)) if job.from_utc_ns < at <= job.to_utc_ns]
    return JobRecord(rows=rows, probes=probes, zeros_ns=zeros)


def _usable_messages(path: Path) -> Iterator[Any]:
    with suppress(DataError):
        yield from messages(path, ("sample", "offset", "probe", "event"))
