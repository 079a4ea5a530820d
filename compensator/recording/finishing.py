"""Makes finished recordings compact, and removes the oldest ones where a limit is set.

A live file is written so that a kill loses nothing, which costs size and an index. Once nobody writes to it any more
it is copied, message by message, into a file with chunks, compression, CRCs and an index; the copy is read back with
the library's own reader, compared, and only then takes the live file's place. A kill at any time leaves one whole
file under the name. All of this runs on a thread of its own that lets samples go first.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from compensator import __version__
from compensator.clock import NS
from compensator.errors import DataError
from compensator.messages import encode
from compensator.recording import chain
from compensator.recording.container import PAYLOAD, Container, Damaged, Message, Torn
from compensator.recording.live_file import sync_folder
from compensator.recording.reading import end_of_chain, recordings
from compensator.recording.signature import Signer

log = logging.getLogger("compensator")

#: Number of messages after which the thread lets others go first.
TURN = 64
_PART = ".mcap.part"


@dataclass(frozen=True, slots=True, kw_only=True)
class Retention:
    """How much is kept.

    Parameters
    ----------
    keep_days : float, optional
        Finished recordings that began longer ago are removed.
    keep_mb : float, optional
        The oldest finished recordings are removed while all of them take more, MB (10⁶ bytes).
    """

    keep_days: float | None = None
    keep_mb: float | None = None


class Finisher:
    """Takes files that nobody writes to any more.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the recordings.
    machine : str
        Name of the machine.
    retention : Retention
        How much is kept.
    signer : Signer, optional
        Signs what is recovered.
    """

    def __init__(self, folder: Path, machine: str, retention: Retention, signer: Signer | None) -> None:
        self._folder, self._machine, self._retention, self._signer = folder, machine, retention, signer
        self._lock = threading.Lock()
        self._jobs: deque[tuple[Path | None, int]] = deque()
        #: What the disk did not let be made compact; tried again with the next file.
        self._refused: list[Path] = []
        #: Why the last removal failed, empty where none did.
        self._unremoved = ""
        self._thread: threading.Thread | None = None
        self._remarks: list[tuple[str, dict[str, Any]]] = []

    def put(self, path: Path, now_ns: int) -> None:
        """Have a file made compact in the background.

        Parameters
        ----------
        path : pathlib.Path
            A recording with a hash chain; anything else is left alone.
        now_ns : int
            Now, ns since 1970 UTC, for the retention.
        """
        with self._lock:
            jobs = [*(refused for refused in self._refused if refused != path), path]
            self._refused = []
            self._begin([(job, now_ns) for job in jobs])

    def make_room(self, now_ns: int) -> None:
        """Have what is beyond the retention removed in the background: the disk does not take the recording.

        Parameters
        ----------
        now_ns : int
            Now, ns since 1970 UTC.
        """
        with self._lock:
            if not self._jobs:
                self._begin([(None, now_ns)])

    def _begin(self, jobs: Sequence[tuple[Path | None, int]]) -> None:
        self._jobs.extend(jobs)
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="finish recordings")
            self._thread.start()

    def wait(self) -> None:
        """Wait until nothing is left to do."""
        thread = self._thread
        if thread is not None:
            thread.join()

    def remarks(self) -> list[tuple[str, dict[str, Any]]]:
        """Return what happened since the last call: text and data."""
        with self._lock:
            remarks, self._remarks = self._remarks, []
        return remarks

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._jobs:
                    self._thread = None
                    return
                path, now_ns = self._jobs.popleft()
            error = self._compacted(path) if path is not None else None
            # Also where the disk is too full for the copy: this is what makes room for it.
            if self._remove_oldest(now_ns) and path is not None and isinstance(error, OSError):
                error = self._compacted(path)
                self._remove_oldest(now_ns)
            if error is not None and path is not None and path.exists():
                self._say(f"{path.name}: could not be made compact and stays as it is: {error}", {"file": path.name})
                if isinstance(error, OSError):
                    with self._lock:
                        self._refused.append(path)

    def _compacted(self, path: Path) -> Exception | None:
        """Make a file compact; return why it could not be."""
        try:
            said = compact(path, self._signer, patient=True)
        except (OSError, McapError, DataError) as error:
            return error
        if said:
            self._say(f"{path.name}: {said}", {"file": path.name})
        return None

    def _say(self, text: str, data: dict[str, Any]) -> None:
        log.info("%s", text)
        with self._lock:
            self._remarks = [*self._remarks[-99:], (text, data)]

    def _remove_oldest(self, now_ns: int) -> bool:
        """Remove what is beyond the retention, and tell whether something was.

        The newest two stay: the one that is being written, and the finished one that the next start needs.
        """
        limits = self._retention
        if limits.keep_days is None and limits.keep_mb is None:
            return False
        paths = recordings(self._folder, self._machine)
        oldest_ns = -1 if limits.keep_days is None else now_ns - int(limits.keep_days * 86_400) * NS
        removed = []
        try:
            sizes = {path: path.stat().st_size for path in paths}
            for path in paths[:-2]:
                too_much = limits.keep_mb is not None and sum(sizes.values()) > limits.keep_mb * 1e6
                if not too_much and _began_ns(path, self._machine) >= oldest_ns:
                    break
                path.unlink()
                removed.append((path.name, sizes.pop(path)))
        except OSError as error:
            if str(error) != self._unremoved:  # a disk that takes nothing is asked every minute
                self._say(f"what is beyond the limit of what is kept could not be removed: {error}", {})
            self._unremoved = str(error)
        if removed:
            size = sum(size for _, size in removed)
            names = [name for name, _ in removed]
            text = f"{len(names)} recording(s) removed by the limit of what is kept, up to {names[-1]}"
            self._say(text, {"removed": names, "bytes": size})
        return bool(removed)


def _began_ns(path: Path, machine: str) -> int:
    """Return the time in a recording's name."""
    stamp = path.name[len(machine) + 1 :][:16]
    return int(datetime.strptime(stamp, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC).timestamp()) * NS


def compact(path: Path, signer: Signer | None = None, *, patient: bool = False) -> str:
    """Rewrite a recording that nobody writes to with chunks, compression, CRCs and index.

    A torn end is finished: its whole records get their place in a `/chain` message, and a seal says `recovered`.

    Parameters
    ----------
    path : pathlib.Path
        A recording; one that is compact, has no hash chain or is being written is left alone.
    signer : Signer, optional
        Signs the seal of a recovered end.
    patient : bool
        Whether to let other threads go first.

    Returns
    -------
    str
        What was recovered, in words; empty where the file was whole.

    Raises
    ------
    OSError
        If the disk does not take the copy; the file stays as it is.
    DataError
        If the copy does not read back as what was copied, or the file is damaged; it stays as it is.
    """
    part = path.with_name(path.name.removesuffix(".mcap") + _PART)
    part.unlink(missing_ok=True)
    with path.open("rb") as live:
        try:
            fcntl.flock(live, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return ""
        if _is_compact(path):
            return ""
        end = end_of_chain(path)
        if end is None or end.chunked:
            return ""
        try:
            with part.open("xb") as file:
                said, expected = _copy(path, file, signer, patient)
                file.flush()
                os.fsync(file.fileno())
            if _digest(part, patient) != expected:
                raise DataError(f"{part}: does not read back as what was written")
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    sync_folder(path.parent)
    return said


def _is_compact(path: Path) -> bool:
    with Container(path) as container:
        try:
            for _ in container.messages():
                return container.contents.chunked
        except Damaged:
            return container.contents.chunked
    return False


def _copy(path: Path, file: BinaryIO, signer: Signer | None, patient: bool) -> tuple[str, str]:
    """Copy a recording; return what was recovered and the hash of everything that was written."""
    writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
    said = ""
    with Container(path) as container:
        copied = _Copied(container, writer)
        try:
            for number, message in enumerate(container.messages()):
                copied.add(message)
                if patient and number % TURN == 0:
                    time.sleep(0.0005)
        except Damaged as error:
            # Behind a torn end nothing can be read; what an audit finds damaged must stay as it was found.
            if not isinstance(error, Torn):
                raise
            said = "its torn end was cut off" if error.offset < path.stat().st_size else ""
        if not copied.sealed:
            said = (said or "it had no end") + "; " + copied.recover(signer)
    writer.finish()  # type: ignore[no-untyped-call]
    return said, copied.digest.hexdigest()


class _Copied:
    """The copy as it grows, with its chain and a hash over all messages."""

    def __init__(self, container: Container, writer: Writer) -> None:
        self._contents, self._writer = container.contents, writer
        self._began = False
        self._chain = chain.ChainWriter("", chain.NOTHING)
        self._topics: dict[int, str] = {}
        self._last: Message | None = None
        self.digest = hashlib.sha256()
        self.sealed = False

    def add(self, message: Message) -> None:
        """Take one message over."""
        if not self._began:
            self._begin(message)
        topic = self._topics[message.channel]
        if topic == "chain":
            self._chain.listed()
        else:
            self._chain.add(topic, message.body)
        self.sealed = topic == "seal" or (self.sealed and topic == "chain")
        self._put(message.channel, message.sequence, message.log_time_ns, message.body)
        self._last = message

    def recover(self, signer: Signer | None) -> str:
        """Finish a torn end; return how many records had no place in the chain yet."""
        if self._last is None:
            raise DataError("nothing whole in it, expected at least one record")
        time_ns, unlisted = self._last.log_time_ns, len(self._chain.links)
        numbers = {topic: number for number, topic in self._topics.items()}
        sequence = self._last.sequence
        if unlisted:
            sequence += 1
            self._made(numbers["chain"], sequence, time_ns, self._chain.message(time_ns))
        seal = chain.seal(self._chain.machine, time_ns, "recovered", sequence, self._chain.head)
        data = encode(signer.sign(seal) if signer else seal)
        self._chain.add("seal", chain.body_of(sequence + 1, time_ns, data))
        self._made(numbers["seal"], sequence + 1, time_ns, data)
        self._made(numbers["chain"], sequence + 2, time_ns, self._chain.message(time_ns))
        return f"{unlisted} whole record(s) behind the last complete group were kept"

    def _begin(self, first: Message) -> None:
        contents, writer = self._contents, self._writer
        self._began = True
        writer.start(profile="", library=contents.library or f"compensator {__version__}")
        for number, channel in contents.channels.items():
            schema = writer.register_schema(channel.schema_name, channel.schema_encoding, channel.schema)
            if number != writer.register_channel(channel.topic, channel.encoding, schema, channel.metadata):
                raise DataError(f"channel {number} {channel.topic}: expected the numbers that the recorder gives")
            self._topics[number] = channel.topic.lstrip("/")
        for name, table in contents.metadata.items():
            writer.add_metadata(name, table)
        for part in contents.attachments.values():
            writer.add_attachment(part.create_time_ns, part.log_time_ns, part.name, part.media_type, part.data)
        run = contents.metadata.get("run", {})
        before = bytes.fromhex(run.get("previous_chain", "")) or chain.NOTHING
        self._chain = chain.ChainWriter(run.get("machine", ""), before)
        parts = chain.parts_of(contents)
        self._chain.begin(parts, first.log_time_ns)
        for known in parts:
            self.digest.update(f"{known.name} {known.sha256}\n".encode())

    def _made(self, channel: int, sequence: int, time_ns: int, data: bytes) -> None:
        self._put(channel, sequence, time_ns, chain.body_of(sequence, time_ns, data))

    def _put(self, channel: int, sequence: int, time_ns: int, body: bytes) -> None:
        publish_ns = int.from_bytes(body[12:PAYLOAD], "little")
        self._writer.add_message(channel, time_ns, body[PAYLOAD:], publish_ns, sequence=sequence)
        self.digest.update(channel.to_bytes(2, "little") + body)


def _digest(path: Path, patient: bool) -> str:
    """Read a compact file with the library's seeking reader; return the hash of everything in it."""
    digest = hashlib.sha256()
    with Container(path) as container:
        for _ in container.messages():
            break
        for part in chain.parts_of(container.contents):
            digest.update(f"{part.name} {part.sha256}\n".encode())
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for number, (_, _, message) in enumerate(reader.iter_messages(log_time_order=False)):
            head = chain.body_of(message.sequence, message.log_time, b"")[:12]
            body = head + message.publish_time.to_bytes(8, "little") + message.data
            digest.update(message.channel_id.to_bytes(2, "little") + body)
            if patient and number % TURN == 0:
                time.sleep(0.0005)
        summary = reader.get_summary()
    if summary is None or not summary.chunk_indexes or summary.statistics is None:
        raise DataError(f"{path}: has no index")
    return digest.hexdigest()
