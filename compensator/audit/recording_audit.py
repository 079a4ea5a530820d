"""Audits one recording: its container, its hash chain, and its samples by replay."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import msgspec

from compensator.audit.chain_check import ChainCheck
from compensator.audit.findings import Fault
from compensator.audit.replay_check import ReplayCheck
from compensator.audit.result import RecordingAudit
from compensator.codes import AuditFinding, RecordingEnd
from compensator.errors import CompensatorError, DataError
from compensator.messages import UNREADABLE
from compensator.recording.container import Container, Contents, Damaged, Torn
from compensator.recording.naming import named_of
from compensator.recording.reading import RawRecord, groups_of
from compensator.recording.signature import Verifier

#: Groups between two calls of `progress`.
_STEP = 500
_MESSAGE, _CHUNK, _ATTACHMENT, _METADATA = b"\x05", b"\x06", b"\x09", b"\x0c"
#: Bytes of a message before its payload.
_MESSAGE_HEAD = 31


def audit_recording(
    path: Path,
    verifier: Verifier | None = None,
    *,
    heads: frozenset[str] = frozenset(),
    progress: Callable[[int], None] | None = None,
) -> RecordingAudit:
    """Audit one file.

    Parameters
    ----------
    path : pathlib.Path
        A recording.
    verifier : Verifier, optional
        Public key of the machine.
    heads : frozenset of str
        Values that the signed head of the machine states for this file, hexadecimal.
    progress : callable, optional
        Called at intervals with the number of bytes processed since the last call.

    Raises
    ------
    DataError
        If the file is not a recording.
    """
    with Container(path) as container:
        return _Audit(path, container, verifier, heads, progress).run()


class _Audit:
    def __init__(
        self,
        path: Path,
        container: Container,
        verifier: Verifier | None,
        heads: frozenset[str],
        progress: Callable[[int], None] | None,
    ) -> None:
        self._result = RecordingAudit(file=path.name, size=path.stat().st_size)
        self._container, self._contents = container, container.contents
        self._verifier, self._heads, self._progress = verifier, heads, progress
        self._chain: ChainCheck | None = None
        self._replay: ReplayCheck | None = None
        #: Records after the last complete group.
        self._rest: list[RawRecord] = []
        self._position = 0

    def run(self) -> RecordingAudit:
        error: Damaged | None = None
        try:
            self._read()
        except Damaged as damage:
            error = damage
        except DataError:
            if not (named_of(self._result.file) or self._container.is_beheaded()):
                raise
            error = Damaged(self._container.path, 0, "the first bytes are not those of an MCAP file")
        if not self._contents.channels and error is None:
            raise DataError(f"{self._result.file}: no channels, expected a recording")
        self._refuse_others()
        chain, replay = self._begin(), self._replay
        if chain.head:
            chain.add_rest(self._rest)
        self._classify(error, chain)
        for where, what in self._container.index.faults:
            self._result.find(Fault.INDEX, topic=where, what=what)
        self._result.counts[AuditFinding.INDEX] += self._container.index.count - len(self._container.index.faults)
        self._result.outside = self._container.outside()
        if chain.head:
            chain.finish()
        if replay is not None:
            replay.finish()
            self._result.state_after = hashlib.sha256(replay.compensation.state()).hexdigest()
        if self._progress is not None:
            self._progress(self._result.size - self._position)
        return self._result

    # ------------------------------------------------------------------ reading

    def _read(self) -> None:
        """Check group by group; the records after the last complete group stay in `_rest`."""
        for number, (records, message, whole) in enumerate(groups_of(self._container)):
            if not whole:
                self._rest = records
                continue
            chain = self._begin()
            if message is not None:
                chain.check(records, message)
            self._replay_group(records)
            if number % _STEP == 0 and self._progress is not None:
                position = self._container.position
                self._progress(position - self._position)
                self._position = position

    def _begin(self) -> ChainCheck:
        """Start the checks once the start of the file has been read."""
        if self._chain is None:
            contents, result = self._contents, self._result
            run = contents.run
            result.original, result.machine = run.get("file", result.file), run.get("machine", "")
            result.began, result.previous_file = run.get("began", ""), run.get("previous_file", "")
            identity = hashlib.sha256()
            for name in ("config.toml", "model.toml"):
                part = contents.attachments.get(name)
                identity.update(hashlib.sha256(part.data if part else b"").digest())
            result.identity = identity.hexdigest()
            state = contents.attachments.get("state.json")
            result.state_before = hashlib.sha256(state.data).hexdigest() if state else ""
            self._chain = ChainCheck(contents, result, self._verifier, self._heads)
            try:
                self._replay = ReplayCheck(contents, result)
                result.period_s = self._replay.compensation.model.period_s
            except CompensatorError as error:
                result.not_replayed = str(error)
        return self._chain

    def _replay_group(self, records: list[RawRecord]) -> None:
        if self._replay is None or self._result.not_replayed or not records:
            return
        try:
            self._replay.check(records)
        except DataError as error:
            self._result.find(Fault.UNREADABLE, what=self._without_name(error))
            # Without this message, all following messages would differ.
            self._result.not_replayed = f"not replayed from here on: {error}"

    def _without_name(self, error: DataError | str) -> str:
        return str(error).removeprefix(f"{self._result.file}: ")

    def _refuse_others(self) -> None:
        """Refuse a file not written by a machine's service: changes to it cannot be detected."""
        contents, file = self._contents, self._result.file
        topics = {channel.topic for channel in contents.channels.values()}
        if contents.metadata or contents.attachments or not topics or topics & {"/sample", "/offset", "/chain"}:
            return
        if any("/thermal/" in topic for topic in topics):
            raise DataError(
                f"{file}: a shop's recording, which has no hash chain; expected recordings of the machines' services"
            )
        there = ", ".join(sorted(topics))[:80]
        raise DataError(f"{file}: not a recording of the service: expected /sample, /offset and /chain, got {there}")

    # ------------------------------------------------------------------ the end

    def _classify(self, error: Damaged | None, chain: ChainCheck) -> None:
        """Set how the file ends; an end left by a kill is not a finding."""
        result, rest = self._result, self._rest
        if not chain.head and self._contents.messages:
            result.find(Fault.NO_CHAIN, topic="channel /chain")
        if self._replay is None and self._contents.messages:
            result.find(Fault.NOT_REPLAYED, what=self._without_name(result.not_replayed))
        if error is None:
            result.end = RecordingEnd.RECOVERED if result.seal == RecordingEnd.RECOVERED else RecordingEnd.FINISHED
            if chain.head and rest:
                result.find(Fault.BEHIND_CHAIN, rest[0], count=len(rest))
            elif chain.head and not result.seal:
                result.find(Fault.NO_SEAL, topic="seal")
            return
        fault = not_left_by_a_kill(error, self._contents)
        if fault is not None:
            result.end = fault.kind
            result.find(fault, offset=error.offset, what=error.text)
        elif result.seal:
            result.end = RecordingEnd.FINISHED
        else:
            torn = isinstance(error, Torn) and error.rest
            result.end = RecordingEnd.TORN if rest or torn or error.offset < result.size else RecordingEnd.OPEN


def not_left_by_a_kill(error: Damaged, contents: Contents) -> Fault | None:
    """Return what was done to a file that cannot be read any further; None if a kill, or one being written, ends so."""
    if not isinstance(error, Torn):
        return Fault.DAMAGED
    if _was_compact(error, contents):
        return Fault.CUT_OFF
    return Fault.LENGTH_CHANGED if _covers_others(error.rest) else None


def _was_compact(torn: Torn, contents: Contents) -> bool:
    """Return whether the file had been finished: only then metadata and attachments come before the channels."""
    if contents.channels:
        return contents.chunked
    begun = bool(contents.metadata or contents.attachments)
    return begun or torn.rest[:1] in (_ATTACHMENT, _METADATA, _CHUNK)


def _covers_others(rest: bytes) -> bool:
    """Distinguish a changed length from a torn end, after which no complete message follows."""
    if rest.count(b'{"schema":') > 1 or len(rest) >= 2**20:
        return True
    try:
        msgspec.json.decode(rest[_MESSAGE_HEAD:])
    except UNREADABLE:
        return False
    return rest[:1] == _MESSAGE
