"""The last offset that was published while the disk did not take it, kept where a kill of the service leaves it.

After a kill the service goes on from the last offset on disk. What it published since then, because the disk was full
or hung, would not count, and the offset would leap back by all of it. So that one offset is noted in the computer's
memory, which no disk holds up and a kill does not touch; a reboot or power cut does. Once the disk has everything the
note goes.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import stat
from contextlib import suppress
from pathlib import Path

import msgspec

from compensator.messages import Offset, number
from compensator.reasons import Remark

log = logging.getLogger("compensator")

#: A file system in memory that every Linux has.
MEMORY = Path("/dev/shm")
_LONGEST = 4096


class Early(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An offset that was published before it was on disk.

    Parameters
    ----------
    seq : int
        Its number.
    time_utc_ns : int
        Its time, ns since 1970 UTC.
    y_offset_um : float
        The offset, µm.
    """

    seq: int
    time_utc_ns: int
    y_offset_um: float


class OffsetCheckpoint:
    """The note of one machine.

    Parameters
    ----------
    recordings : pathlib.Path
        Folder of the recordings; with the machine's name it tells one service from another.
    machine : str
        Name of the machine.
    memory : pathlib.Path, optional
        Where the note stands.
    """

    def __init__(self, recordings: Path, machine: str, memory: Path = MEMORY) -> None:
        name = hashlib.sha256(f"{recordings.resolve()}\0{machine}".encode()).hexdigest()[:32]
        self.path = memory / f"compensator-{name}.json"
        self._there = True

    def keep(self, offset: Offset) -> None:
        """Note an offset that is published now; a computer that does not take the note goes on without it."""
        value = number(offset.y_offset_um)
        if math.isnan(value):
            return
        early = Early(seq=offset.seq, time_utc_ns=offset.time_utc_ns, y_offset_um=value)
        part = self.path.with_suffix(".part")
        try:
            part.unlink(missing_ok=True)
            descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(msgspec.json.encode(early))
            part.replace(self.path)
        except OSError as error:
            if self._there:
                caution = Remark("note_not_kept", f"{self.path}: a kill now would lose the offset: {error}.")
                log.warning("%s", caution.marked)
            self._there = False
            with suppress(OSError):
                part.unlink(missing_ok=True)
        else:
            self._there = True

    def forget(self) -> None:
        """Take the note away: the disk has everything."""
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            log.warning("%s", Remark("note_not_removed", f"{self.path}: cannot be removed: {error}.").marked)

    def read(self, offset_max_um: float) -> Early | None:
        """Return the note, None where there is none that this user wrote and a service could have published.

        Parameters
        ----------
        offset_max_um : float
            Largest offset, µm.
        """
        try:
            descriptor = os.open(self.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError:
            return None
        with os.fdopen(descriptor, "rb") as file:
            there = os.fstat(file.fileno())
            # Everybody may write into this folder.
            if not stat.S_ISREG(there.st_mode) or there.st_uid != os.geteuid() or there.st_mode & 0o022:
                self._refused("not written by this service")
                return None
            try:
                early = msgspec.json.decode(file.read(_LONGEST), type=Early)
            except (msgspec.MsgspecError, UnicodeDecodeError) as error:
                self._refused(str(error))
                return None
        if not abs(early.y_offset_um) <= offset_max_um or early.seq < 0:
            self._refused(f"offset {early.y_offset_um:g} µm, number {early.seq}")
            return None
        return early

    def _refused(self, why: str) -> None:
        log.warning("%s", Remark("note_refused", f"{self.path}: does not count: {why}.").marked)
