"""Keeps the last offset that was published before it was on disk, so that it survives a kill of the service.

After a kill the service continues from the last offset on disk. If the disk was full or hung, later offsets are missing
there, and the offset would jump back. The last published offset is therefore kept in a file in memory, which survives a
kill, but not a reboot or a power cut. Once everything is on disk, the checkpoint is removed.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import stat
from pathlib import Path

import msgspec

from compensator.atomic_write import replace_file
from compensator.codes import Remark, ServiceWarning
from compensator.messages import Offset, number

log = logging.getLogger("compensator")

#: An in-memory file system that every Linux has.
MEMORY = Path("/dev/shm")
_LONGEST = 4096


class CheckpointedOffset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An offset that was published before it was on disk; the fields are those of `Offset`."""

    seq: int
    time_utc_ns: int
    y_offset_um: float


class OffsetCheckpoint:
    """The checkpoint of one machine.

    Parameters
    ----------
    recordings : pathlib.Path
        Folder of the recordings; together with the machine's name it identifies the service.
    machine : str
        Name of the machine.
    memory : pathlib.Path, optional
        Folder of the file.
    """

    def __init__(self, recordings: Path, machine: str, memory: Path = MEMORY) -> None:
        name = hashlib.sha256(f"{recordings.resolve()}\0{machine}".encode()).hexdigest()[:32]
        self.path = memory / f"compensator-{name}.json"
        self._written = True

    def write(self, offset: Offset) -> None:
        """Keep an offset that is being published; if that fails the service continues without the checkpoint."""
        value = number(offset.y_offset_um)
        if math.isnan(value):
            return
        checkpointed = CheckpointedOffset(seq=offset.seq, time_utc_ns=offset.time_utc_ns, y_offset_um=value)
        try:
            replace_file(self.path, msgspec.json.encode(checkpointed), mode=0o600, sync=False)
        except OSError as error:
            if self._written:
                figures = f"{self.path}: a kill now would lose the offset: {error}."
                log.warning("%s", Remark(ServiceWarning.CHECKPOINT_NOT_KEPT, figures).marked)
            self._written = False
        else:
            self._written = True

    def remove(self) -> None:
        """Remove the checkpoint: everything is on disk."""
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            figures = f"{self.path}: cannot be removed: {error}."
            log.warning("%s", Remark(ServiceWarning.CHECKPOINT_NOT_REMOVED, figures).marked)

    def read(self, offset_max_um: float) -> CheckpointedOffset | None:
        """Return the offset; None if there is none, another user wrote it, or it is not a possible offset.

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
            status = os.fstat(file.fileno())
            # Every user may write into this folder.
            if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o022:
                self._refuse("not written by this service")
                return None
            try:
                checkpointed = msgspec.json.decode(file.read(_LONGEST), type=CheckpointedOffset)
            except (msgspec.MsgspecError, UnicodeDecodeError) as error:
                self._refuse(str(error))
                return None
        if not abs(checkpointed.y_offset_um) <= offset_max_um or checkpointed.seq < 0:
            self._refuse(f"offset {checkpointed.y_offset_um:g} µm, number {checkpointed.seq}")
            return None
        return checkpointed

    def _refuse(self, why: str) -> None:
        log.warning("%s", Remark(ServiceWarning.CHECKPOINT_REFUSED, f"{self.path}: ignored: {why}.").marked)
