"""Decides when an offset is published: after its sample is on disk, unless the disk is too slow.

An offset that cannot wait any longer is published with the reason `recording_late` or `recording_failed`. Events report
when the disk stops accepting the recording and when it accepts it again.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence

from compensator.clock import Clock
from compensator.codes import Reason, Remark, ServiceWarning
from compensator.events import EventKind, RecordingCode, RecordingData
from compensator.messages import AnyOffset, Offset, Probe, degraded, encode
from compensator.messages_axes import AxisOffset, further_values
from compensator.service.disk_writer import DiskWriter, Entry, Saved
from compensator.service.event_log import EventLog
from compensator.service.offset_checkpoint import OffsetCheckpoint

log = logging.getLogger("compensator")

#: Texts of the events when the disk refuses the recording, accepts it too late, and accepts it again.
DISK_FAILED = "the disk does not accept the recording"
DISK_LATE = "the disk accepts the recording too late"
DISK_BACK = "the disk accepts the recording again"
#: Interval of the log's warnings that the stopping service waits for the disk, s.
CLOSING_S = 10.0


class Journal:
    """Records samples with their events and monitors whether the disk keeps up.

    Parameters
    ----------
    events : EventLog
        Events that are recorded with the next sample.
    writer : DiskWriter
        Writes them to disk.
    clock : Clock
        For waiting.
    limit_s : float
        How long the sampling loop waits for the disk, s.
    patience_s : float
        How long an offset waits for the disk while polling continues, s; it does not wait if the previous one was late.
    checkpoint : OffsetCheckpoint, optional
        Keeps an offset that is published before it is on disk.
    """

    def __init__(
        self,
        events: EventLog,
        writer: DiskWriter,
        clock: Clock,
        *,
        limit_s: float,
        patience_s: float,
        checkpoint: OffsetCheckpoint | None = None,
    ) -> None:
        self._events = events
        self._writer = writer
        self._clock = clock
        self._limit_s = limit_s
        self._patience_s = patience_s
        self._checkpoint = checkpoint
        #: For the next sample: whether it opens a new file, and the new model.
        self._new_file, self._model = False, None  # type: tuple[bool, bytes | None]
        #: Reason with which the last offset was published, and the last error of the disk.
        self._reason, self._error = "", None  # type: tuple[str, BaseException | None]
        #: Once it is closed, what is not on disk; empty if everything is.
        self.unfinished = ""

    def start_new_file(self, model: bytes | None = None) -> None:
        """Open a new file with the next sample; attach another model if one is given."""
        self._new_file = True
        self._model = model if model is not None else self._model

    def enqueue(
        self,
        time_utc_ns: int,
        state: Saved,
        *,
        sample: bytes = b"",
        estimate: bytes = b"",
        candidates: Sequence[bytes] = (),
        opening: Mapping[str, bytes] | None = None,
        probes: Sequence[Probe] = (),
        offset: Offset | None = None,
        further: Sequence[AxisOffset] = (),
    ) -> Entry:
        """Queue a sample with the events since the previous one.

        `state` is that of the compensation before the sample, or what encodes it, `opening` what else a file that
        starts with it begins with; `sample`, `estimate` and `candidates` are JSON, empty if there is none.
        """
        entry = Entry(
            time_utc_ns=time_utc_ns,
            state=state,
            events=self._events.drain(),
            sample=sample,
            estimate=estimate,
            candidates=candidates,
            opening=opening or {},
            probes=[encode(probe) for probe in probes],
            offset=offset,
            further=further,
            new_file=self._new_file,
            model=self._model,
        )
        self._new_file, self._model = False, None
        self._writer.enqueue(entry)
        return entry

    async def wait_briefly(self, entry: Entry) -> bool:
        """Wait while polling is paused; return whether waiting longer would be useless."""
        await self._clock.settle([entry.attempt], self._limit_s)
        return entry.attempt.done() or bool(self._reason)

    async def wait_patiently(self, entry: Entry) -> None:
        """Wait longer while polling continues."""
        await self._clock.settle([entry.attempt], self._patience_s)

    def resolve(self, entry: Entry) -> dict[str, Offset]:
        """Return the offset of each axis to be published now, by name.

        If the disk has not accepted them yet, or refused them, they carry the reason; the sample waits and is written
        in its order.
        """
        in_flight = self._writer.release(entry)
        self._note_disk(entry.reason, in_flight, entry.attempt.exception() if entry.attempt.done() else None)
        for text, data in self._writer.remarks():
            self._events.note(EventKind.RECORDING, text, data)
        if self._checkpoint is not None and not entry.reason:
            self._checkpoint.remove()
        elif self._checkpoint is not None and entry.offset is not None:
            named = [one for one in (*entry.further, entry.offset) if isinstance(one, AxisOffset)]
            self._checkpoint.write(entry.offset, further_values(named))
        return entry.offsets()

    async def record(
        self,
        time_utc_ns: int,
        state: bytes,
        *,
        opening: Mapping[str, bytes] | None = None,
        probes: Sequence[Probe] = (),
        offset: Offset | None = None,
        further: Sequence[AxisOffset] = (),
    ) -> dict[str, Offset]:
        """Write the queued events, probes and offsets without a sample to disk.

        Returns
        -------
        dict of str to Offset
            Offset of each axis to be published, by name.
        """
        entry = self.enqueue(time_utc_ns, state, opening=opening, probes=probes, offset=offset, further=further)
        await self.wait_briefly(entry)
        return self.resolve(entry)

    def expected(self, offset: AnyOffset) -> AnyOffset:
        """Return the offset as it will be published if the disk behaves as with the previous sample."""
        return degraded(offset, self._reason) if self._reason else offset

    def _note_disk(self, reason: str, in_flight: bool, error: BaseException | None) -> None:
        """Note once when the disk stops accepting the recording, and once when it accepts it again."""
        early = {"published_early": self._events.sequence, "reason": reason} if in_flight else {}
        code = RecordingCode.DISK_LATE if reason == Reason.RECORDING_LATE else RecordingCode.DISK_FAILED
        data = {"code": code, **early}
        if reason and (reason != self._reason or in_flight):
            if error is not None and not isinstance(error, OSError):
                log.error("internal error", exc_info=error)
                self._events.note(
                    EventKind.RECORDING, f"{DISK_FAILED}: internal error: {type(error).__name__}: {error}", data
                )
            elif reason == Reason.RECORDING_FAILED:
                self._events.note(EventKind.RECORDING, f"{DISK_FAILED}: {error or self._error}", data)
            else:
                self._events.note(
                    EventKind.RECORDING, f"{DISK_LATE}: not within {self._limit_s + self._patience_s:g} s", data
                )
        elif self._reason and not reason:
            lost = self._writer.count_dropped()
            text = f"{DISK_BACK}; " + (f"{lost} sample(s) were not recorded" if lost else "nothing was lost")
            self._events.note(EventKind.RECORDING, text, RecordingData(code=RecordingCode.DISK_BACK, lost=lost).table())
        self._reason, self._error = reason, error or self._error

    async def close(self, state: bytes, opening: Mapping[str, bytes] | None = None) -> None:
        """Note that the service ends, and finish the recording without a time limit."""
        self._events.note(EventKind.STOP, "the service ends")
        await self.record(self._clock.utc_ns(), state, opening=opening)
        closing = self._writer.close()
        while not (await asyncio.wait([closing], timeout=CLOSING_S))[0]:
            figures = f"The disk has not accepted the rest of the recording for {CLOSING_S:g} s."
            log.warning("%s", Remark(ServiceWarning.DISK_FINISHING, figures).marked)
        missing = []
        if lost := self._writer.waiting + self._writer.count_dropped():
            missing.append(f"{lost} sample(s) could not be written to disk")
            log.error("%s", missing[-1])
        error = closing.exception()
        if isinstance(error, OSError):
            data = RecordingData(code=RecordingCode.NOT_FINISHED)
            missing.append(f"the recording could not be finished: {error}")
            self._events.note(EventKind.RECORDING, missing[-1], data.table())
        self.unfinished = "; ".join(missing)
        if error is not None and not isinstance(error, OSError):
            raise error
