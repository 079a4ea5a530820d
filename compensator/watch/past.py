"""The last day before the watch started, from the recordings of a machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from compensator.errors import DataError
from compensator.messages import Candidate, EstimateMessage, Event, Offset, Sample
from compensator.recording.reading import messages, recordings
from compensator.watch.history import AHEAD_NS, SPAN_NS

_TOPICS = ("sample", "estimate", "offset", "candidate", "event")


def last_day(
    folder: Path, machine: str, now_ns: int
) -> Iterator[Sample | EstimateMessage | Offset | Candidate | Event]:
    """Yield the messages of the last day in a machine's recordings; unreadable files are skipped.

    The file that is being written is read up to its present end. Messages ahead of now by more than `AHEAD_NS` are left
    out: they would be shown as of now.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the recordings.
    machine : str
        Name of the machine.
    now_ns : int
        Now, ns since 1970 UTC.
    """
    since_ns = now_ns - SPAN_NS
    for path in recordings(folder, machine):
        with suppress(DataError, OSError):
            for message in messages(path, _TOPICS, since_ns=since_ns):
                if message.time_utc_ns <= now_ns + AHEAD_NS:
                    yield message
