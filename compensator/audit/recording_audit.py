"""Audits one recording: its container, its hash chain, and its samples worked out again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from compensator.audit.findings import Difference, Finding, Findings
from compensator.audit.recomputation import Recomputation
from compensator.audit.verification import ChainCheck, Record
from compensator.errors import CompensatorError, DataError
from compensator.recording.container import Container, Damaged, Torn
from compensator.recording.signature import Verifier

#: `finished`: with its end. `recovered`: torn, and finished at the next start. `open`: no end, all groups whole: it is
#: being written, or the service was killed, or the end was cut off. `torn`: the same within a group. `truncated`: a
#: finished file of which the end is missing. `damaged`: no MCAP from some byte on.
End = Literal["finished", "recovered", "open", "torn", "truncated", "damaged"]

#: Messages between two calls of `progress`.
_STEP = 2000
_MESSAGE, _CHUNK, _ATTACHMENT, _METADATA = b"\x05", b"\x06", b"\x09", b"\x0c"
#: Bytes of a message before its payload.
_MESSAGE_HEAD = 31


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingAudit:
    """What the audit of one file gave.

    Parameters
    ----------
    file : str
        Name.
    original, machine, began, previous_file : str
        As its metadata say: the name that it was begun with, the machine, why it began, the file before.
    previous, last : str
        Value of the hash chain that it goes on from, and the one it hands on; empty where it has no chain.
    end : str
        See `End`.
    records, samples, skipped : int
        Records in the chain, samples worked out again, and samples between them that nobody recorded.
    first_seq, last_seq, first_ns, last_ns : int
        Numbers and times of the first and last sample.
    restarted : bool
        Whether the service started with this file.
    differing : int
        Samples that come out differently.
    difference : Difference, optional
        The first of them.
    findings : tuple of Finding
        What is wrong with the file, the first of them.
    findings_count : int
        How many there are.
    signed, unsigned_behind : int
        Signed seals, and records behind the last of them.
    keys : tuple of str
        Public keys in the seals.
    sealed_signed : bool
        Whether its last record is a signed seal.
    identity : str
        Hash over configuration and model.
    state_before, state_after : str
        Hash of the state that it opens with, empty where there is none, and of the state after its last sample.
    not_worked_out : str
        Why its samples could not be worked out again; empty where they were.
    model : str
        SHA-256 of the model.
    removed : tuple of str
        Recordings that its events say were removed by the limit of what is kept.
    early : int
        Offsets that were published before they were on disk.
    size : int
        Bytes.
    """

    file: str
    original: str = ""
    machine: str = ""
    began: str = ""
    previous_file: str = ""
    previous: str = ""
    last: str = ""
    end: End = "finished"
    records: int = 0
    samples: int = 0
    skipped: int = 0
    first_seq: int = -1
    last_seq: int = -1
    first_ns: int = 0
    last_ns: int = 0
    restarted: bool = False
    differing: int = 0
    difference: Difference | None = None
    findings: tuple[Finding, ...] = ()
    findings_count: int = 0
    signed: int = 0
    unsigned_behind: int = 0
    keys: tuple[str, ...] = ()
    sealed_signed: bool = False
    identity: str = ""
    state_before: str = ""
    state_after: str = ""
    not_worked_out: str = ""
    model: str = ""
    removed: tuple[str, ...] = ()
    early: int = 0
    size: int = 0


def audit_recording(
    path: Path, verifier: Verifier | None = None, *, progress: Callable[[int], None] | None = None
) -> RecordingAudit:
    """Audit one file.

    Parameters
    ----------
    path : pathlib.Path
        A recording.
    verifier : Verifier, optional
        Public key of the machine.
    progress : callable, optional
        Called now and then with the number of bytes worked off since the last call.

    Raises
    ------
    DataError
        If it is no recording; one line that says where and why.
    """
    with Container(path) as container:
        return _Audit(path, container, verifier, progress).run()


class _Audit:
    def __init__(
        self, path: Path, container: Container, verifier: Verifier | None, progress: Callable[[int], None] | None
    ) -> None:
        self._name, self._size = path.name, path.stat().st_size
        self._container = container
        self._contents = container.contents
        self._verifier, self._progress = verifier, progress
        self._findings = Findings(path.name)
        self._check: ChainCheck | None = None
        self._work: Recomputation | None = None
        self._why_not = ""
        self._rest: list[Record] = []
        self._end: End = "finished"
        self._position = 0

    def run(self) -> RecordingAudit:
        error: Damaged | None = None
        try:
            self._read()
        except Damaged as damage:
            error = damage
        if not self._contents.channels and not isinstance(error, Torn):
            raise error or DataError(f"{self._name}: no channels in it, expected a recording")
        self._check_ours()
        self._begin()
        assert self._check is not None
        chained = bool(self._check.head)
        if chained:
            self._check.rest(self._rest)
        self._classify(error)
        self._index()
        if chained:
            self._check.finish()
        if self._work is not None:
            self._work.finish()
        if self._progress is not None:
            self._progress(self._size - self._position)
        return self._result()

    # ------------------------------------------------------------------ reading

    def _read(self) -> None:
        """Hand on group by group; what stands behind the last whole group stays in `_rest`."""
        contents = self._contents
        topics: dict[int, str] = {}
        records = self._rest
        chained = None
        step = 0
        for channel, sequence, time_ns, body in self._container.messages():
            topic = topics.get(channel)
            if topic is None:
                topic = topics[channel] = contents.channels[channel].topic.lstrip("/")
            if chained is None:
                chained = self._begin()
            if topic == "chain" and chained:
                assert self._check is not None
                self._check.group(records, sequence, time_ns, body)
                self._again(records)
                records.clear()
            else:
                records.append(Record(topic, sequence, time_ns, body))
                if topic == "offset" and not chained:
                    self._again(records)
                    records.clear()
            step += 1
            if step == _STEP:
                step = 0
                self._tell()

    def _begin(self) -> bool:
        """Start the checks at the first message; tell whether the file has a chain."""
        if self._check is None:
            self._check = ChainCheck(self._contents, self._findings, self._verifier)
            try:
                self._work = Recomputation(self._contents, self._name)
            except CompensatorError as error:
                self._why_not = str(error)
        return "/chain" in {channel.topic for channel in self._contents.channels.values()}

    def _again(self, records: list[Record]) -> None:
        if self._work is None or self._why_not or not records:
            return
        try:
            self._work.group(records)
        except DataError as error:
            self._findings.add("unreadable", self._bare(str(error)))
            # Without this message all that follows would come out differently.
            self._why_not = f"not worked out from here on: {error}"

    def _bare(self, text: str) -> str:
        return text.removeprefix(f"{self._name}: ")

    def _check_ours(self) -> None:
        """Refuse a file that no machine's service wrote; nobody can say of it that it was changed."""
        contents = self._contents
        topics = {channel.topic for channel in contents.channels.values()}
        if contents.metadata or contents.attachments or not topics or topics & {"/sample", "/offset", "/chain"}:
            return
        if any("/thermal/" in topic for topic in topics):
            raise DataError(f"{self._name}: a shop's recording, which has no hash chain; expected the machines' own")
        there = ", ".join(sorted(topics))[:80]
        raise DataError(
            f"{self._name}: no recording of this service: expected /sample, /offset and /chain, got {there}"
        )

    def _tell(self) -> None:
        if self._progress is not None:
            position = self._container.position
            self._progress(position - self._position)
            self._position = position

    # ------------------------------------------------------------------ the end

    def _classify(self, error: Damaged | None) -> None:
        """Say how the file ends: what a kill leaves is told from what it cannot leave."""
        assert self._check is not None
        sealed, unlisted = self._check.seals.last, len(self._rest)
        if not self._check.head and self._contents.messages:
            text = "the recorder writes it, and it is not there: nothing shows that the file is as it was written"
            self._findings.add("removed", text, topic="channel /chain")
        if self._work is None and self._contents.messages:
            self._findings.add("unreadable", f"its samples cannot be worked out again: {self._bare(self._why_not)}")
        if error is None:
            self._end = "recovered" if sealed == "recovered" else "finished"
            if self._check.head and unlisted:
                self._findings.add(
                    "inserted",
                    f"{unlisted} record(s) behind the last message of the chain",
                    topic=self._rest[0].topic,
                    sequence=self._rest[0].sequence,
                    time_utc_ns=self._rest[0].time_ns,
                )
            elif self._check.head and not sealed:
                self._findings.add(
                    "removed", "the file has its end, and not the seal that stands before it", topic="seal"
                )
        elif not isinstance(error, Torn):
            self._end = "damaged"
            self._findings.add("damaged", f"byte {error.offset}: {error.text}")
        elif self._was_compact(error):
            self._end = "truncated"
            self._findings.add("truncated", f"a finished file that ends at byte {error.offset}; its end is missing")
        elif _covers_others(error.rest):
            self._end = "damaged"
            text = "a record whose length leads beyond the end of the file, and what stands there is whole"
            self._findings.add("damaged", f"byte {error.offset}: {text}")
        elif sealed:
            self._end = "finished"
        else:
            self._end = "torn" if unlisted or error.rest or error.offset < self._size else "open"

    def _index(self) -> None:
        """Say where the index would lead readers that seek past what is there, or elsewhere."""
        index = self._container.index
        for where, what in index.faults:
            self._findings.add("index", what, topic=where)
        self._findings.count += index.count - len(index.faults)

    def _was_compact(self, torn: Torn) -> bool:
        """Tell whether the file had been finished: only then metadata and attachments stand before the channels."""
        contents = self._contents
        if contents.channels:
            return contents.chunked
        begun = bool(contents.metadata or contents.attachments)
        return begun or torn.rest[:1] in (_ATTACHMENT, _METADATA, _CHUNK)

    def _result(self) -> RecordingAudit:
        check, work, contents = self._check, self._work, self._contents
        assert check is not None
        run = contents.metadata.get("run", {})
        state = contents.attachments.get("state.json")
        identity = hashlib.sha256()
        for name in ("config.toml", "model.toml"):
            part = contents.attachments.get(name)
            identity.update(hashlib.sha256(part.data if part else b"").digest())
        return RecordingAudit(
            file=self._name,
            original=run.get("file", self._name),
            machine=run.get("machine", ""),
            began=run.get("began", ""),
            previous_file=run.get("previous_file", ""),
            previous=check.previous.hex() if check.head else "",
            last=check.handed_on.hex(),
            end=self._end,
            records=check.records,
            samples=work.samples if work else 0,
            skipped=work.skipped if work else 0,
            first_seq=work.first_seq if work else -1,
            last_seq=work.last_seq if work else -1,
            first_ns=work.first_ns if work else 0,
            last_ns=work.last_ns if work else 0,
            restarted=work.restarted if work else False,
            differing=work.differing if work else 0,
            difference=work.first if work else None,
            findings=tuple(self._findings.kept),
            findings_count=self._findings.count,
            signed=check.seals.signed,
            unsigned_behind=check.seals.behind,
            keys=tuple(sorted(check.seals.keys)),
            sealed_signed=check.seals.last_signed,
            identity=identity.hexdigest(),
            state_before=hashlib.sha256(state.data).hexdigest() if state else "",
            state_after=hashlib.sha256(work.compensation.state()).hexdigest() if work else "",
            not_worked_out=self._why_not,
            model=work.compensation.model.sha256 if work else "",
            removed=tuple(work.removed) if work else (),
            early=len(work.early) if work else 0,
            size=self._size,
        )


def _covers_others(rest: bytes) -> bool:
    """Tell a length that was changed from a torn end: there, the one message behind it is not whole."""
    if rest.count(b'{"schema":') > 1 or len(rest) >= 2**20:
        return True
    try:
        msgspec.json.decode(rest[_MESSAGE_HEAD:])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False
    return rest[:1] == _MESSAGE


def recorded_groups(container: Container) -> Iterator[list[Record]]:
    """Yield the records of a recording group by group, as far as it can be read.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    records: list[Record] = []
    topics: dict[int, str] = {}
    with suppress(Damaged):
        for channel, sequence, time_ns, body in container.messages():
            topic = topics.get(channel)
            if topic is None:
                topic = topics[channel] = container.contents.channels[channel].topic.lstrip("/")
            if topic == "chain":
                continue
            records.append(Record(topic, sequence, time_ns, body))
            if topic == "offset":
                yield records
                records = []
