"""Writes every sample to MCAP so that a kill loses nothing.

A new file is started every day, at each start, and where one is full. The live file is not chunked; every sample is
synced to disk before its offset is published. The configuration, the model and the state of the compensation are
attached to each file. A hash chain covers everything (`recording/chain.py`) and continues from file to file; if a key
is configured, it is signed every hour and at the end. `recording/finishing.py` compacts finished files.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mcap

from compensator import __version__
from compensator.atomic_write import sync_folder
from compensator.events import RecordingCode, RecordingData
from compensator.recording import chain
from compensator.recording.container import Attachment
from compensator.recording.finishing import Finisher, Retention, is_full
from compensator.recording.head import HeadKeeper, previous_end
from compensator.recording.live_file import TOPICS, RecordingFile
from compensator.recording.naming import day_of, names, order_of
from compensator.recording.numbering import first_sequence
from compensator.recording.reading import recordings
from compensator.recording.signature import Signer


class McapRecorder:
    """Recording of one machine.

    Parameters
    ----------
    folder : pathlib.Path
        Created if it does not exist.
    machine : str
        Name of the machine.
    attachments : dict of str to bytes
        Files to attach to each recording, by name.
    retention : Retention, optional
        Retention limits; by default everything is kept.
    signer : Signer, optional
        Signs the chain.
    head : pathlib.Path, optional
        File outside the folder in which the head of the chain is kept (`recording/head.py`); needs a signer. Without
        it the end of a file that a kill has left is not signed afterwards.
    topics : sequence of str
        Topics of its files.
    axes : sequence of str
        Axes of the machine; empty where it has Y alone.
    """

    def __init__(
        self,
        folder: Path,
        machine: str,
        attachments: dict[str, bytes],
        *,
        retention: Retention | None = None,
        signer: Signer | None = None,
        head: Path | None = None,
        topics: Sequence[str] = TOPICS,
        axes: Sequence[str] = (),
    ) -> None:
        self._folder = folder
        self._machine = machine
        self.attachments = attachments
        self._signer = signer
        self._topics, self._axes = topics, axes
        self._keeper = HeadKeeper(head, machine, signer) if head is not None and signer is not None else None
        accepted = self._keeper.accepted if self._keeper is not None else None
        self._finisher = Finisher(folder, machine, retention or Retention(), signer, accepted=accepted)
        #: Why the head was not written last time; empty if it was.
        self._unkept = ""
        self._live: RecordingFile | None = None
        self._day = ""
        #: A file that was given up and could not be cut, and the size that was synced.
        self._uncut: tuple[Path, int] | None = None
        #: Why the next file is opened, and name and last chain value of the previous file if known.
        self._reason, self._last_name, self._last = "start", "", b""
        self.path: Path | None = None

    def first_sequence(self, utc_ns: int, period_s: float) -> int:
        """Return the number of the first sample; remark if one in the folder cannot be a number of this machine.

        Parameters
        ----------
        utc_ns : int
            Now, ns since 1970 UTC.
        period_s : float
            Length of a sample, s.
        """

        def remark(file: str, text: str) -> None:
            self._finisher.remark(f"{file}: {text}", RecordingData(code=RecordingCode.NOT_AS_WRITTEN, file=file))

        return first_sequence(self._folder, self._machine, utc_ns, period_s, keeper=self._keeper, remark=remark)

    def write(
        self,
        records: Iterable[tuple[str, bytes]],
        time_utc_ns: int,
        *,
        state: bytes | Callable[[], bytes] = b"",
        opening: Mapping[str, bytes] | None = None,
        sync: bool = True,
    ) -> None:
        """Write records and sync them to disk before returning.

        Parameters
        ----------
        records : iterable of (str, bytes)
            Topic and JSON.
        time_utc_ns : int
            Time of the records, ns since 1970 UTC.
        state : bytes or callable
            State of the compensation before these records, or what encodes it; attached as `state.json` if they start
            a new file.
        opening : mapping of str to bytes, optional
            More that is attached then, by name.
        sync : bool
            If false, they are synced together with the next records.

        Raises
        ------
        OSError
            If writing fails. The file is truncated to the last sync and abandoned, and the next call starts a new file.
        """
        day = day_of(time_utc_ns)
        try:
            if self._live is None or day != self._day or self._live.is_full:
                self._finish("day")
                self._open(
                    time_utc_ns, day, {"state.json": state() if callable(state) else state} | dict(opening or {})
                )
            assert self._live is not None
            self._live.append(records, time_utc_ns)
            # The clock may be set back, too.
            if self._signer is not None and abs(time_utc_ns - self._live.sealed_ns) >= chain.SEAL_EVERY_NS:
                self._live.seal("hour", time_utc_ns, self._signer)
            if sync:
                self._keep_head(self._live)
                self._live.sync()
        except BaseException as error:
            self._give_up()
            if is_full(error):
                self._finisher.make_room(time_utc_ns)
            raise

    def close(self) -> None:
        """Finish the file, if there is one, and wait until it is compacted."""
        try:
            self._finish("stop")
        finally:
            self._finisher.wait()

    def start_new(self, attachments: Mapping[str, bytes] | None = None) -> None:
        """Finish the file, so that the next write starts a new one.

        Parameters
        ----------
        attachments : mapping of str to bytes, optional
            Attachments that replace those of the same name from now on.

        Raises
        ------
        OSError
            If the end of the file cannot be written; the file is abandoned, and the next write starts a new one.
        """
        self.attachments = {**self.attachments, **(attachments or {})}
        self._finish("new")

    def remarks(self) -> list[tuple[str, dict[str, Any]]]:
        """Return text and data of events about finished files since the last call."""
        return self._finisher.remarks()

    def _finish(self, reason: str) -> None:
        live = self._live
        if live is None:
            return
        try:
            live.seal(reason, live.time_ns, self._signer)
            self._keep_head(live)
            live.finish()
            self._keep_head(live)
        except OSError:
            self._give_up()
            raise
        self._live, self._reason, self._last, self._last_name = None, reason, live.head, live.path.name
        self._finisher.enqueue(live.path, live.time_ns)

    def _give_up(self) -> None:
        """Abandon the file in its state after the last sync."""
        live, self._live = self._live, None
        self._reason = "failure"
        # Read from the file when the next one opens: only the file shows what it contains.
        self._last = b""
        if live is None:
            return
        if not live.give_up():
            self._uncut = live.path, live.synced
        elif self._keeper is not None and not live.synced:
            self._keeper.forget(live.path.name)

    def _open(self, time_utc_ns: int, day: str, opening: Mapping[str, bytes]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        if self._uncut is not None:
            # The records after the last sync are written again.
            path, size = self._uncut
            if path.exists() and path.stat().st_size > size:
                os.truncate(path, size)
            if not size:
                path.unlink(missing_ok=True)
            self._uncut = None
        previous = recordings(self._folder, self._machine)
        # What is newest in the folder need not be what this recorder has written.
        name, before = (self._last_name, self._last) if self._last else self._read_end()
        known = [*previous[-1:], *([self._folder / name] if name else [])]
        newest = max(known, key=lambda path: order_of(path.stem), default=None)
        paths = names(self._folder, self._machine, time_utc_ns, newest)
        live = self._live = RecordingFile(
            paths, self._machine, before or chain.NOTHING, time_utc_ns, self._topics, self._axes
        )
        self.path = live.path
        metadata = {
            "machine": self._machine,
            "file": self.path.name,
            "compensator": __version__,
            "mcap": mcap.__version__,
            "python": platform.python_version(),
            "started_utc_ns": str(time_utc_ns),
            "began": self._reason,
            "previous_file": name,
            "previous_chain": before.hex(),
        }
        attachments = [
            _attached(name, data, time_utc_ns) for name, data in (*self.attachments.items(), *opening.items()) if data
        ]
        live.begin(metadata, attachments)
        self._keep_head(live)
        live.sync()
        self._day = day
        sync_folder(self._folder)
        if self._reason in ("start", "failure"):
            # A kill leaves unfinished files: at a start it may be any of them, after a failure the last.
            for path in previous if self._reason == "start" else previous[-1:]:
                self._finisher.enqueue(path, time_utc_ns)

    def _read_end(self) -> tuple[str, bytes]:
        """Return name and last value of the previous file; remark if it is not as it was written."""
        keeper = self._keeper
        if keeper is not None and keeper.unusable:
            self._finisher.remark(keeper.unusable, RecordingData(code=RecordingCode.HEAD_NOT_KEPT))
            keeper.unusable = ""
        end = previous_end(self._folder, self._machine, keeper)
        if end.differs:
            data = RecordingData(code=RecordingCode.NOT_AS_WRITTEN, file=end.file)
            text = f"{end.file}: {end.differs}; it was changed since it was written, or the head was not kept"
            self._finisher.remark(text, data)
        return end.file, end.value

    def _keep_head(self, live: RecordingFile) -> None:
        """Note what the next sync writes; the recording does not depend on it."""
        if self._keeper is None:
            return
        try:
            self._keeper.expect(live.path.name, live.synced_value, live.pending, live.time_ns)
            self._unkept = ""
        except OSError as error:
            why = error.strerror or type(error).__name__
            if why != self._unkept:  # a failing disk is tried again with every sample
                text = f"{self._keeper.path}: {why}; the end that a kill leaves would not be signed"
                self._finisher.remark(text, RecordingData(code=RecordingCode.HEAD_NOT_KEPT))
            self._unkept = why


def _attached(name: str, data: bytes, time_ns: int) -> Attachment:
    media_type = f"application/{name.rpartition('.')[2]}"
    return Attachment(name, media_type, time_ns, time_ns, data)
