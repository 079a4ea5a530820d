"""Compacts finished recordings, and removes the oldest ones if a retention limit is set.

All of this runs on a separate thread that yields to samples.
"""

from __future__ import annotations

import errno
import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import Writer

from compensator.clock import NS
from compensator.codes import RecordingEnd
from compensator.errors import DataError
from compensator.events import RecordingCode, RecordingData
from compensator.messages import UNREADABLE, Seal, encode
from compensator.recording import chain
from compensator.recording.compaction import Copy, rewrite
from compensator.recording.container import PAYLOAD, Contents, Message
from compensator.recording.naming import began_ns
from compensator.recording.reading import has_begun, recordings
from compensator.recording.signature import Signer

log = logging.getLogger("compensator")

_DAY_NS = 86_400 * NS
#: A clock that is this much later than the recording before, days, is believed once it has gone on for as long.
CONFIRMED_DAYS = 7
#: So many such jumps are left out: more are a machine that is used now and then.
MOST_JUMPS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Retention:
    """Retention limits.

    Parameters
    ----------
    keep_days : float, optional
        Finished recordings older than this are removed.
    keep_mb : float, optional
        The oldest finished recordings are removed while their total size exceeds this, MB (10⁶ bytes).
    """

    keep_days: float | None = None
    keep_mb: float | None = None


class Finisher:
    """Compacts finished files and removes the oldest ones.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the recordings.
    machine : str
        Name of the machine.
    retention : Retention
        Retention limits.
    signer : Signer, optional
        Signs the seal of a recovered end.
    accepted : callable, optional
        For the name of a file the values of the chain, hexadecimal, with which it may end that nobody changed; the
        seal of another recovered end is not signed. By default none is.
    compacted : callable, optional
        Compacts one file and returns a remark, or an empty text; by default `compact`.
    """

    def __init__(
        self,
        folder: Path,
        machine: str,
        retention: Retention,
        signer: Signer | None,
        *,
        accepted: Callable[[str], frozenset[str]] | None = None,
        compacted: Callable[[Path], str] | None = None,
    ) -> None:
        self._folder, self._machine, self._retention = folder, machine, retention
        values = accepted or (lambda name: frozenset())
        self._compact = compacted or (lambda path: compact(path, signer, accepted=values(path.name), yielding=True))
        self._lock = threading.Lock()
        self._jobs: deque[tuple[Path | None, int]] = deque()
        #: Files that could not be compacted because of the disk; retried with the next file.
        self._refused: list[Path] = []
        #: Why the last removal failed; empty if it did not.
        self._unremoved = ""
        self._thread: threading.Thread | None = None
        self._remarks: list[tuple[str, dict[str, Any]]] = []

    def enqueue(self, path: Path, now_ns: int) -> None:
        """Queue a file to be compacted in the background.

        Parameters
        ----------
        path : pathlib.Path
            A recording with a hash chain; other files are skipped.
        now_ns : int
            Now, ns since 1970 UTC, for the retention.
        """
        with self._lock:
            jobs = [*(refused for refused in self._refused if refused != path), path]
            self._refused = []
            self._begin([(job, now_ns) for job in jobs])

    def make_room(self, now_ns: int) -> None:
        """Remove files beyond the retention limit in the background, because the disk is full.

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
        """Wait until all jobs are done."""
        thread = self._thread
        if thread is not None:
            thread.join()

    def remarks(self) -> list[tuple[str, dict[str, Any]]]:
        """Return the remarks since the last call: text and data."""
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
            # Also if the disk is too full for the copy: the removal makes room for it.
            needs_room = path is None or is_full(error)
            if self._remove_oldest(now_ns, needs_room=needs_room) and path is not None and isinstance(error, OSError):
                error = self._compacted(path)
                self._remove_oldest(now_ns, needs_room=is_full(error))
            if error is not None and path is not None and path.exists():
                text = f"{path.name}: could not be compacted and remains unchanged: {error}"
                self.remark(text, RecordingData(code=RecordingCode.NOT_COMPACTED, file=path.name))
                if isinstance(error, OSError):
                    with self._lock:
                        self._refused.append(path)

    def _compacted(self, path: Path) -> Exception | None:
        """Compact a file; return the error if that failed."""
        try:
            recovered = self._compact(path)
        except (OSError, DataError) as error:
            return error
        if recovered:
            self.remark(f"{path.name}: {recovered}", RecordingData(code=RecordingCode.RECOVERED, file=path.name))
        return None

    def remark(self, text: str, data: RecordingData) -> None:
        """Add a remark, and log it."""
        log.info("%s", text)
        with self._lock:
            self._remarks = [*self._remarks[-99:], (text, data.table())]

    def _first_needed(self, paths: Sequence[Path]) -> int:
        """Return the place of the second newest file that holds a chain; others are no end from which one continues."""
        needed = 2
        for place in range(len(paths) - 1, -1, -1):
            with suppress(DataError):
                needed -= has_begun(paths[place])
            if not needed:
                return place
        return 0

    def _began(self, paths: Sequence[Path], now_ns: int) -> dict[Path, int]:
        """Return when each recording began, ns since 1970 UTC: by its name, unless that is more than a day ahead.

        After a start with the clock ahead the names of all later ones are ahead, too, as names are in order. Such a
        one was not begun after it was last changed, nor after the next one was begun.
        """
        began, following = {}, now_ns
        for path in reversed(paths):
            began[path] = began_ns(path, self._machine)
            if began[path] > now_ns + _DAY_NS:
                with suppress(OSError):  # removed meanwhile
                    began[path] = min(path.stat().st_mtime_ns, following)
            following = min(following, began[path])
        return began

    def _remove_oldest(self, now_ns: int, *, needs_room: bool) -> bool:
        """Remove files beyond the retention limit; return whether a file was removed.

        The newest two with a chain are kept: the one that is being written, and the finished one that the next start
        needs. Unless the disk is full, no clock that is ahead makes files old (`confirmed_ns`).
        """
        limits = self._retention
        if limits.keep_days is None and limits.keep_mb is None:
            return False
        paths = recordings(self._folder, self._machine)
        began = self._began(paths, now_ns)
        today_ns = now_ns if needs_room else confirmed_ns(list(began.values()), now_ns)
        oldest_ns = -1 if limits.keep_days is None else today_ns - int(limits.keep_days * _DAY_NS)
        removed = []
        try:
            sizes = {path: path.stat().st_size for path in paths}
            for path in paths[: self._first_needed(paths)]:
                too_much = limits.keep_mb is not None and sum(sizes.values()) > limits.keep_mb * 1e6
                if not too_much and began[path] >= oldest_ns:
                    break
                path.unlink()
                removed.append((path.name, sizes.pop(path)))
        except OSError as error:
            if str(error) != self._unremoved:  # a failing disk is retried every minute
                text = f"recordings beyond the retention limit could not be removed: {error}"
                self.remark(text, RecordingData(code=RecordingCode.NOT_REMOVED))
            self._unremoved = str(error)
        if removed:
            size = sum(size for _, size in removed)
            names = [name for name, _ in removed]
            text = f"{len(names)} recording(s) removed by the retention limit, up to {names[-1]}"
            self.remark(text, RecordingData(code=RecordingCode.REMOVED, removed=names, bytes=size))
        return bool(removed)


def confirmed_ns(began: Sequence[int], now_ns: int) -> int:
    """Return the time by which recordings are old: now, or a day after the last one before an unconfirmed jump.

    Parameters
    ----------
    began : sequence of int
        When each recording began, ns since 1970 UTC.
    now_ns : int
        Now, ns since 1970 UTC.

    Examples
    --------
    >>> day = 86_400 * 10**9
    >>> [confirmed_ns([1 * day, 2 * day, 900 * day], now * day) // day for now in (900, 906, 907)]
    [3, 3, 907]

    A machine that is used each tenth day: no time is ever confirmed, and the last jumps are left out.

    >>> confirmed_ns([10 * i * day for i in range(40)], 390 * day) // day
    361
    """
    begins, limit_ns = sorted(began), CONFIRMED_DAYS * _DAY_NS
    end_ns, jumps = now_ns, 0
    for before, after in zip(reversed(begins[:-1]), reversed(begins[1:]), strict=True):
        if end_ns - after >= limit_ns or jumps == MOST_JUMPS:
            break
        if after - before >= limit_ns:
            end_ns, jumps = before + _DAY_NS, jumps + 1
    return min(end_ns, now_ns)


def is_full(error: BaseException | None) -> bool:
    """Return whether an error says that the disk is full."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def compact(
    path: Path,
    signer: Signer | None = None,
    *,
    accepted: frozenset[str] = frozenset(),
    yielding: bool = False,
) -> str:
    """Replace a machine's live recording by a compact copy.

    A torn end is finished: its complete records are listed in a `/chain` message, followed by a seal `recovered`.

    Parameters
    ----------
    path : pathlib.Path
        A recording; a file that is compact, has no hash chain or is being written is skipped.
    signer : Signer, optional
        Signs the seal of a recovered end.
    accepted : frozenset of str
        Values of the chain, hexadecimal, at which a recovered end is signed. Any other end may have been changed since
        it was written: its seal remains without a signature for good.
    yielding : bool
        Whether to yield to other threads.

    Returns
    -------
    str
        What was recovered, as text; empty if the file was complete.

    Raises
    ------
    OSError, DataError
        As by `rewrite`; the file is not changed.
    """
    copy_of = partial(_ChainedCopy, signer=signer, accepted=accepted)
    copy = rewrite(path, copy_of, yielding=yielding, chained=True)
    if not isinstance(copy, _ChainedCopy) or copy.recovered is None:
        return "its torn end was cut off" if copy is not None and copy.torn else ""
    end = "its torn end was cut off" if copy.torn else "it had no end"
    unsigned = "; what follows its last signature remains unsigned" if copy.unsigned else ""
    return f"{end}; {copy.recovered} complete record(s) after the last complete group were kept{unsigned}"


class _ChainedCopy(Copy):
    """The copy of a machine's recording, with its chain; a torn end is finished."""

    def __init__(self, contents: Contents, writer: Writer, *, signer: Signer | None, accepted: frozenset[str]) -> None:
        super().__init__(contents, writer)
        self._signer, self._accepted = signer, accepted
        #: Whether there is a key, but the recovered end was not signed.
        self.unsigned = False
        self._chain: chain.ChainWriter | None = None
        self._last: Message | None = None
        #: Whether the last record is the seal of an end, which one of an hour is not, and whether the chain lists it.
        self._sealed = self._ended = False
        #: Records that were not yet in the chain; None if the file was complete.
        self.recovered: int | None = None

    def add(self, message: Message) -> None:
        """Copy one message and follow the chain."""
        super().add(message)
        if self._chain is None:
            run = self.contents.run
            before = bytes.fromhex(run.get("previous_chain", "")) or chain.NOTHING
            self._chain = chain.ChainWriter(run.get("machine", ""), before)
            self._chain.begin(chain.parts_of(self.contents), message.log_time_ns)
        topic = self.topics[message.channel]
        if topic == "chain":
            self._chain.listed()
        else:
            self._chain.add(topic, message.body)
        self._ended = self._sealed and topic == "chain"
        self._sealed = self._ended or (topic == "seal" and not _is_of_hour(message))
        self._last = message

    def finish(self) -> None:
        """Finish a torn end, and write the end of the file."""
        if self._chain is None or self._last is None:
            raise DataError("no complete record, expected at least one")
        if not self._ended:
            self.recovered = len(self._chain.links)
            if self.recovered:
                self._append("chain", self._chain.message(self._last.log_time_ns))
        if not self._ended:
            time_ns, sequence = self._last.log_time_ns, self._last.sequence
            seal = chain.seal(self._chain.machine, time_ns, RecordingEnd.RECOVERED, sequence, self._chain.head)
            signer = self._signer if seal.sha256 in self._accepted else None
            self.unsigned = self._signer is not None and signer is None
            self._append("seal", encode(signer.sign(seal) if signer else seal))
            self._append("chain", self._chain.message(time_ns))
        super().finish()

    def _append(self, topic: str, data: bytes) -> None:
        """Add a message after the last one."""
        assert self._last is not None
        channel = next((number for number, name in self.topics.items() if name == topic), None)
        if channel is None:
            raise DataError(f"no channel /{topic}, expected the channels of the recorder")
        sequence, time_ns = self._last.sequence + 1, self._last.log_time_ns
        self.add(Message(channel, sequence, time_ns, chain.body_of(sequence, time_ns, data)))


def _is_of_hour(message: Message) -> bool:
    """Return whether a seal is one of those within a file."""
    try:
        return msgspec.json.decode(message.body[PAYLOAD:], type=Seal).reason == "hour"
    except UNREADABLE:
        return False
