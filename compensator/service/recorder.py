"""Writes every sample to MCAP so that a kill loses nothing.

One file a day and at each start. The live file is not chunked, and every sample is flushed and synced before
its offset is published. The configuration and the model travel in each file as attachments; the hash of the
file before stands in its metadata.
"""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

import mcap
import msgspec
from mcap.writer import CompressionType, Writer

from compensator import __version__
from compensator.clock import NS
from compensator.messages import MESSAGES, shipped_schema
from compensator.recording import recordings

_TOPICS = ("sample", "estimate", "offset", "event")


class Recorder:
    """Recording of one machine.

    Parameters
    ----------
    folder : pathlib.Path
        Made when it is not there.
    machine : str
        Name of the machine.
    attachments : dict of str to bytes
        Files that travel in each recording, by name; what stands here when a file is opened goes into it.
    """

    def __init__(self, folder: Path, machine: str, attachments: dict[str, bytes]) -> None:
        self._folder = folder
        self._machine = machine
        self.attachments = attachments
        self._file: BinaryIO | None = None
        self._writer: Writer | None = None
        self._channels: dict[str, int] = {}
        self._day = ""
        self._sequence = 0
        self.path: Path | None = None

    def write(self, records: Iterable[tuple[str, bytes]], time_utc_ns: int, *, state: bytes = b"") -> None:
        """Write records and bring them to disk, all of them before it returns.

        Parameters
        ----------
        records : iterable of (str, bytes)
            Topic and JSON.
        time_utc_ns : int
            Time of the records, ns since 1970 UTC.
        state : bytes
            State of the compensation before these records; travels as `state.json` in a file that opens with them.

        Raises
        ------
        OSError
            If the disk does not take them. The file is given up and the next call starts a new one.
        """
        day = datetime.fromtimestamp(time_utc_ns / NS, UTC).strftime("%Y%m%d")
        try:
            if self._writer is None or day != self._day:
                self.close()
                self._open(time_utc_ns, day, state)
            assert self._writer is not None and self._file is not None
            for topic, data in records:
                self._writer.add_message(self._channels[topic], time_utc_ns, data, time_utc_ns, sequence=self._sequence)
                self._sequence += 1
            self._flush()
        except OSError:
            self._give_up()
            raise

    def close(self) -> None:
        """Finish the file; does nothing when there is none."""
        if self._writer is None or self._file is None:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._flush()
        finally:
            self._give_up()

    def start_new(self) -> None:
        """Finish the file, so that the next write opens a new one with the attachments as they are then.

        Raises
        ------
        OSError
            If the disk does not take the end of the file; the file is given up, and the next write opens a new one.
        """
        self.close()

    def _open(self, time_utc_ns: int, day: str, state: bytes) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        previous = recordings(self._folder, self._machine)
        metadata = {
            "machine": self._machine,
            "compensator": __version__,
            "mcap": mcap.__version__,
            "python": platform.python_version(),
            "started_utc_ns": str(time_utc_ns),
            "previous_file": previous[-1].name if previous else "",
            "previous_sha256": _sha256(previous[-1]) if previous else "",
        }
        self._file = self._create(time_utc_ns)
        # Without chunks a message is in the file as soon as it is flushed; the data CRC covers a finished one.
        self._writer = Writer(self._file, use_chunking=False, compression=CompressionType.NONE, enable_data_crcs=True)
        self._writer.start(profile="", library=f"compensator {__version__}")
        for topic in _TOPICS:
            schema = self._writer.register_schema(MESSAGES[topic].__name__, "jsonschema", shipped_schema(topic))
            self._channels[topic] = self._writer.register_channel(
                f"/{topic}", "json", schema, {"machine": self._machine}
            )
        self._writer.add_metadata("run", metadata)
        for name, data in self.attachments.items():
            self._writer.add_attachment(time_utc_ns, time_utc_ns, name, "application/toml", data)
        if state:
            self._writer.add_attachment(time_utc_ns, time_utc_ns, "state.json", "application/json", state)
        self._flush()
        self._day = day
        directory = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(directory)  # the file's name, too, must outlive a power cut
        finally:
            os.close(directory)

    def _create(self, time_utc_ns: int) -> BinaryIO:
        """Create a file that did not exist, named by machine and UTC time."""
        stamp = datetime.fromtimestamp(time_utc_ns / NS, UTC).strftime("%Y%m%dT%H%M%SZ")
        for number in range(1000):
            suffix = f"-{number:03d}" if number else ""
            self.path = self._folder / f"{self._machine}_{stamp}{suffix}.mcap"
            try:
                return self.path.open("xb")
            except FileExistsError:
                continue
        raise OSError(f"{self._folder}: a thousand recordings of {stamp}")

    def _flush(self) -> None:
        assert self._writer is not None and self._file is not None
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())

    def _give_up(self) -> None:
        file, self._file, self._writer = self._file, None, None
        if file is not None:
            try:
                file.close()
            except OSError:
                # Nothing more can be done for this file; what was synced is on disk.
                return


def records_of(messages: Iterable[tuple[str, msgspec.Struct]]) -> list[tuple[str, bytes]]:
    """Encode messages as they are recorded and published."""
    return [(topic, msgspec.json.encode(message)) for topic, message in messages]


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
