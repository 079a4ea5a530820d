"""Keeps the last offset that was published before it was on disk, and its holds, so that they survive a kill.

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
from collections.abc import Mapping
from pathlib import Path

import msgspec

from compensator.atomic_write import replace_file
from compensator.codes import Reason, Remark, ServiceWarning
from compensator.messages import UNREADABLE, Number, Offset, SampleNumber, TimeNs, number

log = logging.getLogger("compensator")

#: An in-memory file system that every Linux has.
MEMORY = Path("/dev/shm")
_LONGEST = 4096


class CheckpointedOffset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """An offset that was published before it was on disk; the fields are those of `Offset`.

    `further` are the values of further outputs by name, each in its unit; `operator_hold` and `internal_error` say why
    the offset was held until `resume`.
    """

    seq: SampleNumber
    time_utc_ns: TimeNs
    y_offset_um: Number
    further: dict[str, Number] = {}
    operator_hold: bool = False
    internal_error: bool = False


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

    def write(self, offset: Offset, further: Mapping[str, float] | None = None) -> None:
        """Keep an offset that is being published; if that fails the service continues without the checkpoint.

        Parameters
        ----------
        offset : Offset
            The offset of Y.
        further : mapping of str to float, optional
            Values of further outputs by name.
        """
        value = number(offset.y_offset_um)
        if math.isnan(value):
            return
        known = {name: one for name, one in (further or {}).items() if not math.isnan(one)}
        checkpointed = CheckpointedOffset(
            seq=offset.seq,
            time_utc_ns=offset.time_utc_ns,
            y_offset_um=value,
            further=known,
            operator_hold=Reason.OPERATOR_HOLD in offset.reasons,
            internal_error=Reason.INTERNAL_ERROR in offset.reasons,
        )
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

    def read(self, offset_max_um: float, further_max: Mapping[str, float] | None = None) -> CheckpointedOffset | None:
        """Return the offset; None if there is none, another user wrote it, or it is not a possible offset.

        Parameters
        ----------
        offset_max_um : float
            Largest offset, µm.
        further_max : mapping of str to float, optional
            Largest value of each further output by name.
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
            except UNREADABLE as error:
                self._refuse(str(error))
                return None
        if not abs(checkpointed.y_offset_um) <= offset_max_um:
            self._refuse(f"offset {checkpointed.y_offset_um:g} µm, number {checkpointed.seq}")
            return None
        for name, largest in (further_max or {}).items():
            value = checkpointed.further.get(name, 0.0)
            if not abs(value) <= largest:
                self._refuse(f"offset of {name}: {value:g}")
                return None
        return checkpointed

    def _refuse(self, why: str) -> None:
        log.warning("%s", Remark(ServiceWarning.CHECKPOINT_REFUSED, f"{self.path}: ignored: {why}.").marked)
