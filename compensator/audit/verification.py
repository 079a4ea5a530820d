"""Follows the hash chain of one file and names what breaks it.

The rule is short (`recording/chain.py`): compute the values, make the `/chain` message that must follow, compare its
bytes. Only where they differ is it asked what happened: a record that fits no more to the value before it was altered,
one that the chain lists and the file has not was removed, one that the file has and the chain does not list was
inserted, one that stands elsewhere was moved.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import NamedTuple

import msgspec

from compensator.audit.findings import Finding, Findings
from compensator.messages import SCHEMA, Chain, ChainLink, Seal, encode
from compensator.recording import chain
from compensator.recording.container import PAYLOAD, Contents
from compensator.recording.signature import Verifier

_sha256 = hashlib.sha256


class _Prefixes(dict[str, bytes]):
    """What stands before the body of a record of each topic; an unknown one comes from a channel that was altered."""

    def __missing__(self, topic: str) -> bytes:
        self[topic] = topic.encode() + b"\0"
        return self[topic]


_PREFIX = _Prefixes()
_DECODER = msgspec.json.Decoder(Chain)


class Record(NamedTuple):
    """A message with its topic."""

    topic: str
    sequence: int
    time_ns: int
    body: bytes


@dataclass(slots=True)
class Seals:
    """Seals of a file.

    Parameters
    ----------
    last : str
        Reason of the seal that is the last record, empty where another record stands behind it.
    signed, false : int
        Number of seals with a signature, and of those that are not of the key given.
    last_signed : bool
        Whether the last record is a signed seal.
    keys : set of str
        Public keys that stand in the seals.
    behind : int
        Number of records behind the last signed seal.
    """

    last: str
    signed: int
    false: int
    last_signed: bool
    keys: set[str]
    behind: int


class ChainCheck:
    """Checks the hash chain of one file.

    Parameters
    ----------
    contents : Contents
        What the file opens with.
    findings : Findings
        Where what is wrong goes.
    verifier : Verifier, optional
        Public key of the machine.
    """

    def __init__(self, contents: Contents, findings: Findings, verifier: Verifier | None) -> None:
        self._contents, self._findings, self._verifier = contents, findings, verifier
        self.seals = Seals("", 0, 0, False, set(), 0)
        #: Value at the last record, and before a seal of a torn end that was finished afterwards.
        self.head = b""
        self._before_last = b""
        #: Value that the chain of this file claims to go on from.
        self.previous = chain.NOTHING
        self.records = 0
        self._next = 0
        self._machine = msgspec.json.encode(contents.metadata.get("run", {}).get("machine", "")).decode()
        self._gaps: dict[int, tuple[int, int]] = {}
        self._suspect: tuple[int, bytes] | None = None

    @property
    def handed_on(self) -> bytes:
        """Value that the next file goes on from."""
        return self._before_last if self.seals.last == "recovered" else self.head

    def group(self, records: list[Record], sequence: int, time_ns: int, body: bytes) -> None:
        """Check the records since the last `/chain` message, and that message.

        Parameters
        ----------
        records : list of Record
            The records, in the order of the file.
        sequence, time_ns : int
            Number and time of the message.
        body : bytes
            Its body.
        """
        if not self.head:
            self._open(sequence, time_ns, body)
            if not records:
                self._next = sequence + 1
                return
        value, number, entries = self.head, self._next, []
        whole = True
        for topic, its_number, its_time, its_body in records:
            before = value
            value = _sha256(b"%b%b%b" % (value, _PREFIX[topic], its_body)).digest()
            entries.append(f'{{"topic":"{topic}","sequence":{its_number},"sha256":"{value.hex()}"}}')
            whole = whole and its_number == number and its_time == time_ns
            number += 1
            if topic == "seal":
                self._before_last = before
                self._seal(before, its_number, its_time, its_body)
            else:
                self.seals.last, self.seals.last_signed = "", False
                self.seals.behind += 1
        self.records += len(records)
        expected = (
            f'{{"schema":{SCHEMA},"machine":{self._machine},"time_utc_ns":{time_ns},"before":"{self.head.hex()}",'
            f'"parts":[],"records":[{",".join(entries)}]}}'
        )
        whole = whole and number == sequence and body[4:12] == body[12:PAYLOAD]
        if whole and body[PAYLOAD:] == expected.encode():
            self.head, self._next = value, number + 1
            return
        self._explain(records, value, sequence, time_ns, body)

    def rest(self, records: list[Record]) -> None:
        """Take the records behind the last `/chain` message: the file ends within a group."""
        for record in records:
            self.head = chain.link(self.head, record.topic, record.body)
            self.seals.last, self.seals.last_signed = "", False
        self.records += len(records)
        self.seals.behind += len(records)

    def finish(self) -> None:
        """Say what can only be said at the end."""
        for first, (last, time_ns) in sorted(self._gaps.items()):
            self._findings.add(
                "removed", f"{_numbers(first, last)} missing before it", sequence=last + 1, time_utc_ns=time_ns
            )
        self._pair_up()
        for text in self._contents.late:
            name, _, what = text.partition(": ")
            self._findings.add("altered" if "CRC" in what else "inserted", what, topic=name)

    # ------------------------------------------------------------------ opening

    def _open(self, sequence: int, time_ns: int, body: bytes) -> None:
        """Check what the file opens with; name the part that is not what it was."""
        found = {part.name: part.sha256 for part in chain.parts_of(self._contents)}
        try:
            message = _DECODER.decode(body[PAYLOAD:])
            self.previous = bytes.fromhex(message.before)
        except (msgspec.MsgspecError, UnicodeDecodeError, ValueError):
            self._findings.add(
                "altered", "the first message of the chain cannot be read", topic="chain", sequence=sequence
            )
            self.head = chain.opening(self.previous, chain.parts_of(self._contents))
            return
        stated = {part.name: part.sha256 for part in message.parts}
        if sequence != 0 or message.records or not stated:
            self._findings.add("removed", "the first message of the chain is missing", topic="chain", sequence=0)
            self.head, self._next = self.previous, message.records[0].sequence if message.records else sequence
            return
        for name in sorted(stated.keys() | found.keys()):
            if name not in found:
                self._findings.add("removed", "the recording began with it, and it is not there", topic=name)
            elif name not in stated:
                self._findings.add("inserted", "the recording did not begin with it", topic=name)
            elif stated[name] != found[name]:
                self._findings.add("altered", "not what the recording began with", topic=name)
        if list(stated) != list(found) and stated == found:
            self._findings.add("reordered", "attachments or metadata stand in another order", topic="chain", sequence=0)
        try:
            self.head = chain.opening(self.previous, message.parts)
        except ValueError:
            self._findings.add("altered", "a hash that is none", topic="chain", sequence=sequence)
            self.head = chain.opening(self.previous, chain.parts_of(self._contents))
        machine = self._contents.metadata.get("run", {}).get("machine", "")
        expected = Chain(
            schema=SCHEMA, machine=machine, time_utc_ns=time_ns, before=message.before, parts=message.parts, records=[]
        )
        if body[PAYLOAD:] != encode(expected) or body[4:12] != body[12:PAYLOAD]:
            self._findings.add(
                "altered",
                "says something else than follows from the file",
                topic="chain",
                sequence=sequence,
                time_utc_ns=time_ns,
            )
        stated_before = self._contents.metadata.get("run", {}).get("previous_chain", "")
        if (stated_before or chain.NOTHING.hex()) != message.before:
            self._findings.add(
                "altered",
                "names another last value of the file before than the metadata",
                topic="chain",
                sequence=sequence,
            )

    # ------------------------------------------------------------------ what happened

    def _explain(self, records: list[Record], computed: bytes, sequence: int, time_ns: int, body: bytes) -> None:
        """Name what makes a group differ from its `/chain` message, and go on behind it."""
        try:
            message = _DECODER.decode(body[PAYLOAD:])
            before = bytes.fromhex(message.before)
            values = [bytes.fromhex(entry.sha256) for entry in message.records]
        except (msgspec.MsgspecError, UnicodeDecodeError, ValueError):
            self._findings.add("altered", "cannot be read", topic="chain", sequence=sequence, time_utc_ns=time_ns)
            self.head, self._next = computed, sequence + 1
            return
        count = self._findings.count
        if self._suspect is not None:
            index, value = self._suspect
            if before == value and index < len(self._findings.kept):
                old = self._findings.kept[index]
                self._findings.kept[index] = replace(
                    old,
                    topic="chain",
                    text=f"its value of /{old.topic} record {old.sequence} is not that of the record",
                )
                self.head = value
                count -= 1
            self._suspect = None
        first = message.records[0].sequence if message.records else sequence
        moved = self._place(records, first, sequence, time_ns)
        self._unlisted(records, message.records, before, time_ns)
        self._listed(records, message.records, time_ns)
        self._values(records, message.records, before, values, sequence, time_ns)
        if self._findings.count == count and before != self.head and not moved:
            self._findings.add(
                "broken",
                "the values up to here and from here on do not belong together: one side was rewritten",
                topic="chain",
                sequence=sequence,
                time_utc_ns=time_ns,
            )
        elif self._findings.count == count and not moved:
            self._findings.add(
                "altered",
                "says something else than follows from the records",
                topic="chain",
                sequence=sequence,
                time_utc_ns=time_ns,
            )
        if sequence >= self._next:
            self.head, self._next = (values[-1] if values else before), sequence + 1

    def _place(self, records: list[Record], first: int, sequence: int, time_ns: int) -> bool:
        """Tell whether whole groups are missing before this one, or whether it stands in the wrong place."""
        present = {record.sequence for record in records}
        if first > self._next and not present & set(range(self._next, first)):
            self._gaps[self._next] = (first - 1, time_ns)
            return True
        if first >= self._next:
            return False
        for start, (last, gap_time) in list(self._gaps.items()):
            if start <= first and sequence <= last:
                del self._gaps[start]
                if start < first:
                    self._gaps[start] = (first - 1, gap_time)
                if sequence < last:
                    self._gaps[sequence + 1] = (last, gap_time)
                self._findings.add(
                    "reordered",
                    f"{_numbers(first, sequence)} standing behind later ones",
                    sequence=first,
                    time_utc_ns=time_ns,
                )
                return True
        self._findings.add(
            "inserted", f"{_numbers(first, sequence)} standing there again", sequence=first, time_utc_ns=time_ns
        )
        return True

    def _unlisted(self, records: list[Record], listed: list[ChainLink], before: bytes, time_ns: int) -> None:
        """Name records that the chain does not list."""
        numbers = {entry.sequence for entry in listed}
        unlisted = [record for record in records if record.sequence not in numbers]
        value = self.head
        prefix = 0
        for record in records:
            if record.sequence in numbers:
                break
            value, prefix = chain.link(value, record.topic, record.body), prefix + 1
        if prefix and value == before:
            self._findings.add(
                "removed",
                "the message of the chain is missing",
                topic="chain",
                sequence=records[prefix - 1].sequence + 1,
                time_utc_ns=records[prefix - 1].time_ns,
            )
            self.head = value
            unlisted = unlisted[prefix:]
        seen: set[int] = set()
        for record in records:
            if record in unlisted or record.sequence in seen:
                self._findings.add(
                    "inserted",
                    "the chain does not list it",
                    topic=record.topic,
                    sequence=record.sequence,
                    time_utc_ns=record.time_ns,
                )
            seen.add(record.sequence)

    def _listed(self, records: list[Record], listed: list[ChainLink], time_ns: int) -> None:
        """Name records that are listed and not there, or stand in another order."""
        present = [record.sequence for record in records]
        for entry in listed:
            if entry.sequence not in present:
                self._findings.add(
                    "removed",
                    "the chain lists it, it is not there",
                    topic=entry.topic,
                    sequence=entry.sequence,
                    time_utc_ns=time_ns,
                )
        numbers = [entry.sequence for entry in listed if entry.sequence in present]
        order = [number for number in dict.fromkeys(present) if number in numbers]
        for wanted, found in zip(numbers, order, strict=False):
            if wanted != found:
                record = next(record for record in records if record.sequence == found)
                self._findings.add(
                    "reordered",
                    f"stands where record {wanted} stood",
                    topic=record.topic,
                    sequence=found,
                    time_utc_ns=record.time_ns,
                )
                return

    def _values(
        self,
        records: list[Record],
        listed: list[ChainLink],
        before: bytes,
        values: list[bytes],
        sequence: int,
        time_ns: int,
    ) -> None:
        """Name records whose value is not the one stated."""
        there = {record.sequence: record for record in reversed(records)}
        last = len(listed) - 1
        for i, entry in enumerate(listed):
            record = there.get(entry.sequence)
            stated_before = values[i - 1] if i else before
            if record is None:
                continue
            value = chain.link(stated_before, record.topic, record.body)
            if value == values[i] and record.topic == entry.topic:
                continue
            after = there.get(listed[i + 1].sequence) if i < last else None
            if after is not None and chain.link(value, after.topic, after.body) == values[i + 1]:
                self._findings.add(
                    "altered",
                    f"its value of /{record.topic} record {record.sequence} is not that of the record",
                    topic="chain",
                    sequence=sequence,
                    time_utc_ns=time_ns,
                )
                continue
            if i and after is not None and chain.link(values[i], after.topic, after.body) != values[i + 1]:
                pass  # The one behind is named by itself.
            self._findings.add(
                "altered",
                "does not fit to its value in the chain",
                topic=record.topic,
                sequence=record.sequence,
                time_utc_ns=record.time_ns,
            )
            if i == last:
                self._suspect = (len(self._findings.kept) - 1, value)

    def _pair_up(self) -> None:
        """Turn a record that is missing here and too many there into one that was moved."""
        kept = self._findings.kept
        removed = {(f.topic, f.sequence): f for f in kept if f.kind == "removed" and f.topic}
        moved: list[Finding] = []
        for finding in kept:
            twin = removed.get((finding.topic, finding.sequence))
            if finding.kind == "inserted" and twin is not None:
                moved.append(twin)
                kept[kept.index(finding)] = replace(
                    finding, kind="reordered", text="stands in another place than it did"
                )
        for finding in moved:
            kept.remove(finding)
        self._findings.count -= len(moved)

    # ------------------------------------------------------------------ seals

    def _seal(self, before: bytes, sequence: int, time_ns: int, body: bytes) -> None:
        seals = self.seals
        try:
            seal = msgspec.json.decode(body[PAYLOAD:], type=Seal)
        except (msgspec.MsgspecError, UnicodeDecodeError):
            self._findings.add("altered", "cannot be read", topic="seal", sequence=sequence, time_utc_ns=time_ns)
            return
        seals.last = "" if seal.reason == "hour" else seal.reason
        if (seal.sha256, seal.sequence) != (before.hex(), sequence - 1):
            self._findings.add(
                "altered", "does not seal what stands before it", topic="seal", sequence=sequence, time_utc_ns=time_ns
            )
        seals.last_signed = bool(seal.signature)
        if not seal.signature:
            seals.behind += 1
            return
        seals.signed += 1
        seals.keys.add(seal.public_key)
        if self._verifier is not None and not self._verifier.holds(seal):
            seals.false += 1
            self._findings.add(
                "false_signature", "not signed by the key given", topic="seal", sequence=sequence, time_utc_ns=time_ns
            )
        else:
            seals.behind = 0


def _numbers(first: int, last: int) -> str:
    return f"record {first} is" if first == last else f"records {first} to {last} are"
