"""Writes every sample to MCAP so that a kill loses nothing.

One file a day and at each start. The live file is not chunked, and every sample is brought to disk with one sync
before its offset is published. The configuration, the model and the state of the compensation travel in each file as
attachments. A hash chain runs over everything (`recording/chain.py`) and from file to file; where a key is configured
it is signed every hour and at the end. A finished file is rewritten compact by `recording/finishing.py`.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import mcap

from compensator import __version__
from compensator.clock import NS
from compensator.messages import MESSAGES, encode, shipped_schema
from compensator.recording import chain
from compensator.recording.container import Attachment, Channel, Contents
from compensator.recording.finishing import Finisher, Retention
from compensator.recording.live_file import LiveFile, Opening, sync_folder
from compensator.recording.reading import last_value, recordings
from compensator.recording.signature import Signer

#: Topics of a recording; `chain` and `seal` come from the recorder itself.
TOPICS = ("sample", "estimate", "offset", "event", "seal", "chain")
#: How often the chain is signed within a file.
SEAL_EVERY_NS = 3600 * NS


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
    retention : Retention, optional
        How much is kept; everything where nothing is said.
    signer : Signer, optional
        Signs the chain.
    """

    def __init__(
        self,
        folder: Path,
        machine: str,
        attachments: dict[str, bytes],
        *,
        retention: Retention | None = None,
        signer: Signer | None = None,
    ) -> None:
        self._folder = folder
        self._machine = machine
        self.attachments = attachments
        self._signer = signer
        self._finisher = Finisher(folder, machine, retention or Retention(), signer)
        self._live: _Live | None = None
        self._day = ""
        #: A file that was given up with more in it than was synced, and how long it may be.
        self._uncut: tuple[Path, int] | None = None
        #: Why the next file begins, and the last value of the file before it where that is known.
        self._reason, self._last = "start", b""
        self.path: Path | None = None

    def write(
        self, records: Iterable[tuple[str, bytes]], time_utc_ns: int, *, state: bytes = b"", sync: bool = True
    ) -> None:
        """Write records and bring them to disk, all of them before it returns.

        Parameters
        ----------
        records : iterable of (str, bytes)
            Topic and JSON.
        time_utc_ns : int
            Time of the records, ns since 1970 UTC.
        state : bytes
            State of the compensation before these records; travels as `state.json` in a file that opens with them.

        sync : bool
            Without it they come to disk together with the next ones.

        Raises
        ------
        OSError
            If they cannot be written. What was written since the last sync is cut off again, the file is given up,
            and the next call starts a new one.
        """
        day = datetime.fromtimestamp(time_utc_ns / NS, UTC).strftime("%Y%m%d")
        try:
            if self._live is None or day != self._day:
                self._finish("day")
                self._open(time_utc_ns, day, state)
            assert self._live is not None
            self._live.add(records, time_utc_ns)
            if self._signer is not None and time_utc_ns - self._live.sealed_ns >= SEAL_EVERY_NS:
                self._live.seal("hour", time_utc_ns, self._signer)
            if sync:
                self._live.sync()
        except BaseException as error:
            self._give_up()
            if isinstance(error, OSError):
                self._finisher.make_room(time_utc_ns)
            raise

    def close(self) -> None:
        """Finish the file and wait until it is compact; does nothing when there is none."""
        try:
            self._finish("stop")
        finally:
            self._finisher.wait()

    def start_new(self) -> None:
        """Finish the file, so that the next write opens a new one with the attachments as they are then.

        Raises
        ------
        OSError
            If the end of the file cannot be written; the file is given up, and the next write opens a new one.
        """
        self._finish("new")

    def remarks(self) -> list[tuple[str, dict[str, Any]]]:
        """Return what happened to finished files since the last call: text and data of events."""
        return self._finisher.remarks()

    # ------------------------------------------------------------------ beginning and end of a file

    def _finish(self, reason: str) -> None:
        live = self._live
        if live is None:
            return
        try:
            live.seal(reason, live.time_ns, self._signer)
            live.finish()
        except OSError:
            self._give_up()
            raise
        self._live, self._reason, self._last = None, reason, live.head
        self._finisher.enqueue(live.path, live.time_ns)

    def _give_up(self) -> None:
        """Leave the file as it was after the last sync; what was written since then was not whole."""
        live, self._live = self._live, None
        self._reason = "failure"
        # Read from the file when the next one opens: only it knows what it took.
        self._last = b""
        if live is not None and not live.give_up():
            self._uncut = live.path, live.synced

    def _open(self, time_utc_ns: int, day: str, state: bytes) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        if self._uncut is not None:
            # What it holds beyond that is written again.
            path, size = self._uncut
            if path.exists() and path.stat().st_size > size:
                os.truncate(path, size)
            if not size:
                path.unlink(missing_ok=True)
            self._uncut = None
        previous = recordings(self._folder, self._machine)
        before = self._last
        if previous and not before:
            before = last_value(previous[-1])
        names = self._names(time_utc_ns, previous[-1] if previous else None)
        live = self._live = _Live(names, self._machine, before or chain.NOTHING, time_utc_ns)
        self.path = live.path
        metadata = {
            "machine": self._machine,
            "file": self.path.name,
            "compensator": __version__,
            "mcap": mcap.__version__,
            "python": platform.python_version(),
            "started_utc_ns": str(time_utc_ns),
            "began": self._reason,
            "previous_file": previous[-1].name if previous else "",
            "previous_chain": before.hex(),
        }
        attachments = [
            _attached(name, "application/toml", data, time_utc_ns) for name, data in self.attachments.items()
        ]
        if state:
            attachments.append(_attached("state.json", "application/json", state, time_utc_ns))
        live.begin(metadata, attachments)
        live.sync()
        self._day = day
        sync_folder(self._folder)
        if self._reason in ("start", "failure"):
            # A kill leaves files that are not finished: at a start any of them, after a failure the last.
            for path in previous if self._reason == "start" else previous[-1:]:
                self._finisher.enqueue(path, time_utc_ns)

    def _names(self, time_utc_ns: int, newest: Path | None) -> Iterator[Path]:
        """Yield names for a new file by machine and UTC time."""
        stamp = datetime.fromtimestamp(time_utc_ns / NS, UTC).strftime("%Y%m%dT%H%M%SZ")
        number = 0
        if newest is not None:
            # Names show the order in which files were begun, also where the clock was set back between them.
            last, _, suffix = newest.stem.removeprefix(f"{self._machine}_").partition("-")
            if last >= stamp:
                stamp, number = last, int(suffix or 0) + 1
        for count in range(number, number + 1000):
            ending = f"-{count:03d}" if count else ""
            yield self._folder / f"{self._machine}_{stamp}{ending}.mcap"


class _Live(LiveFile):
    """The file that is being written, with its chain."""

    def __init__(self, paths: Iterable[Path], machine: str, before: bytes, time_ns: int) -> None:
        super().__init__(paths)
        self.time_ns = self.sealed_ns = time_ns
        self._machine = machine
        self._channels: dict[str, int] = {}
        self._sequence = 0
        self._chain = chain.ChainWriter(machine, before)

    @property
    def head(self) -> bytes:
        """Value of the chain at the last record."""
        return self._chain.head

    def begin(self, metadata: dict[str, str], attachments: list[Attachment]) -> None:
        """Write what the file opens with."""
        contents = Contents(metadata={"run": metadata}, attachments={part.name: part for part in attachments})
        for number, topic in enumerate(TOPICS, 1):
            about, kind, schema = {"machine": self._machine}, MESSAGES[topic].__name__, shipped_schema(topic)
            contents.channels[number] = Channel(f"/{topic}", "json", about, kind, "jsonschema", schema)
        opening = Opening(self.writer)
        opening.write(contents)
        self._channels = {topic: number for number, topic in opening.topics.items()}
        self._write("chain", self._chain.begin(chain.parts_of(contents), self.time_ns))

    def add(self, records: Iterable[tuple[str, bytes]], time_ns: int) -> None:
        """Write a group of records and the values of the chain."""
        self.time_ns = time_ns
        for topic, data in records:
            self._chain.add(topic, chain.body_of(self._sequence, time_ns, data))
            self._write(topic, data)
        self._write("chain", self._chain.message(time_ns))

    def seal(self, reason: str, time_ns: int, signer: Signer | None) -> None:
        """Write a seal, signed where there is a key."""
        message = chain.seal(self._machine, time_ns, reason, self._sequence - 1, self.head)
        if signer is not None:
            message = signer.sign(message)
        self.sealed_ns = time_ns
        self.add([("seal", encode(message))], time_ns)

    def _write(self, topic: str, data: bytes) -> None:
        self.writer.add_message(self._channels[topic], self.time_ns, data, self.time_ns, sequence=self._sequence)
        self._sequence += 1


def _attached(name: str, media_type: str, data: bytes, time_ns: int) -> Attachment:
    return Attachment(name, media_type, time_ns, time_ns, data)
