"""Follows the hash chain of one file and reports what breaks it.

The check (`recording/chain.py`): compute the values and the expected `/chain` message, and compare its bytes. Only if
they differ is the cause determined: a record that does not match its value was altered, one that the chain lists and
the file lacks was removed, one that the file has and the chain does not list was inserted, and one in another place
was moved.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from dataclasses import replace

import msgspec

from compensator.audit.findings import Fault
from compensator.audit.result import RecordingAudit
from compensator.codes import RecordingEnd
from compensator.messages import SCHEMA, UNREADABLE, Chain, ChainLink, Seal, encode
from compensator.recording import chain
from compensator.recording.container import PAYLOAD, Contents, Flaw
from compensator.recording.reading import RawRecord
from compensator.recording.signature import Verifier

_sha256 = hashlib.sha256
_DECODER = msgspec.json.Decoder(Chain)
_TIME = re.compile(rb'"time_utc_ns":(\d{1,19}),')
#: What is computed in a sample: at most one of each in its group, with the time of the sample.
_OF_SAMPLES = frozenset(("sample", "estimate", "candidate", "offset", "offsets"))
#: A message of the chain: or its hashes are no hexadecimal numbers.
_UNREADABLE = (*UNREADABLE, ValueError)


class _Prefixes(dict[str, bytes]):
    """The prefix of the hashed bytes of each topic; an unknown topic comes from a channel that was altered."""

    def __missing__(self, topic: str) -> bytes:
        self[topic] = topic.encode() + b"\0"
        return self[topic]


_PREFIX = _Prefixes()


class ChainCheck:
    """Checks the hash chain of one file.

    Parameters
    ----------
    contents : Contents
        Configuration, model, state and metadata at the start of the file.
    result : RecordingAudit
        Result to which records, seals and findings are added.
    verifier : Verifier, optional
        Public key of the machine.
    heads : frozenset of str
        Values that the signed head of the machine states for this file, hexadecimal.
    """

    def __init__(
        self,
        contents: Contents,
        result: RecordingAudit,
        verifier: Verifier | None,
        heads: frozenset[str] = frozenset(),
    ) -> None:
        self._contents, self._result, self._verifier = contents, result, verifier
        self._heads = frozenset(map(bytes.fromhex, heads))
        #: Time of the last valid signature or of the start of the file; whether the next group must be a seal, and
        #: whether this one must.
        self._signed_ns, self._due, self._is_late = 0, False, False
        #: Records since then, by topic.
        self._behind = Counter[str]()
        #: Times of the last record that a signature or the head covers, and of the last record.
        self._covered_ns = self._last_ns = 0
        #: Value at the last record, and before a seal of a torn end that was finished afterwards.
        self.head = b""
        self._before_last = b""
        #: Value from which the chain of this file states that it continues.
        self.previous = chain.NOTHING
        self._next = 0
        self._run = contents.run
        self._machine = msgspec.json.encode(self._run.get("machine", "")).decode()
        self._gaps: dict[int, tuple[int, int]] = {}
        self._suspect: tuple[int, bytes] | None = None

    def check(self, records: list[RawRecord], message: RawRecord) -> None:
        """Check the records since the last `/chain` message, and that message.

        Parameters
        ----------
        records : list of RawRecord
            The records, in the order of the file.
        message : RawRecord
            The message after them.
        """
        _, sequence, time_ns, body = message
        if not self.head:
            self._signed_ns = self._covered_ns = self._last_ns = time_ns
            self._open(message)
            self._compare_head(self.head)
            if not records:
                self._next = sequence + 1
                return
        result, value, number, entries = self._result, self.head, self._next, []
        self._is_late = self._due
        if result.seal and not records:
            result.find(Fault.BEHIND_SEAL, message)
        whole = True
        for topic, its_number, its_time, its_body in records:
            before = value
            value = _sha256(b"%b%b%b" % (value, _PREFIX[topic], its_body)).digest()
            entries.append(f'{{"topic":"{topic}","sequence":{its_number},"sha256":"{value.hex()}"}}')
            whole = whole and its_number == number and its_time == time_ns
            number += 1
            if topic == "seal":
                self._before_last = before
                self._seal(before, RawRecord(topic, its_number, its_time, its_body))
            else:
                result.seal, result.sealed_signed = "", False
                self._add_unsigned(topic, its_time, its_body)
        result.records += len(records)
        self._compare_head(value)
        expected = (
            f'{{"schema":{SCHEMA},"machine":{self._machine},"time_utc_ns":{time_ns},"before":"{self.head.hex()}",'
            f'"parts":[],"records":[{",".join(entries)}]}}'
        )
        whole = whole and number == sequence and body[4:12] == body[12:PAYLOAD]
        if whole and body[PAYLOAD:] == expected.encode():
            self.head, self._next = value, number + 1
            return
        self._explain(records, value, message)

    def add_rest(self, records: list[RawRecord]) -> None:
        """Count the records after the last `/chain` message: the file ends within a group."""
        result = self._result
        for i, record in enumerate(records):
            # A seal that is due begins its group; whether it is signed was not looked at.
            self._is_late = self._due and not (i == 0 and record.topic == "seal")
            self.head = chain.link(self.head, record.topic, record.body)
            result.seal, result.sealed_signed = "", False
            self._add_unsigned(record.topic, record.log_time_ns, record.body)
            self._compare_head(self.head)
        result.records += len(records)

    def finish(self) -> None:
        """Add the results that are known only at the end."""
        result = self._result
        for first, (last, time_ns) in sorted(self._gaps.items()):
            numbers = _numbers(first, last)
            result.find(Fault.RECORDS_MISSING, sequence=last + 1, time_utc_ns=time_ns, numbers=numbers)
        result.pair_moved()
        for name, flaw in self._contents.flaws:
            result.find(Fault.PART_CRC if flaw is Flaw.WRONG_CRC else Fault.PART_LATE, topic=name, what=flaw.value)
        result.previous = self.previous.hex()
        result.last = (self._before_last if result.seal == RecordingEnd.RECOVERED else self.head).hex()

    # ------------------------------------------------------------------ opening

    def _open(self, message: RawRecord) -> None:
        """Check the start of the file; report the part that was changed."""
        result, sequence = self._result, message.sequence
        parts = chain.parts_of(self._contents)
        try:
            stated = _DECODER.decode(message.data)
            self.previous = bytes.fromhex(stated.before)
        except _UNREADABLE:
            result.find(Fault.OPENING_UNREADABLE, topic="chain", sequence=sequence)
            self.head = chain.opening(self.previous, parts)
            return
        if sequence != 0 or stated.records or not stated.parts:
            result.find(Fault.OPENING_MISSING, topic="chain", sequence=0)
            self.head, self._next = self.previous, stated.records[0].sequence if stated.records else sequence
            return
        self._compare_parts({p.name: p.sha256 for p in stated.parts}, {p.name: p.sha256 for p in parts})
        try:
            self.head = chain.opening(self.previous, stated.parts)
        except ValueError:
            result.find(Fault.NO_HASH, topic="chain", sequence=sequence)
            self.head = chain.opening(self.previous, parts)
        expected = Chain(
            schema=SCHEMA,
            machine=self._run.get("machine", ""),
            time_utc_ns=message.log_time_ns,
            before=stated.before,
            parts=stated.parts,
            records=[],
        )
        if message.data != encode(expected) or message.body[4:12] != message.body[12:PAYLOAD]:
            result.find(Fault.OPENING_CHANGED, message)
        if (self._run.get("previous_chain", "") or chain.NOTHING.hex()) != stated.before:
            result.find(Fault.OTHER_PREVIOUS, topic="chain", sequence=sequence)

    def _compare_parts(self, stated: dict[str, str], found: dict[str, str]) -> None:
        for name in sorted(stated.keys() | found.keys()):
            if name not in found:
                self._result.find(Fault.PART_MISSING, topic=name)
            elif name not in stated:
                self._result.find(Fault.PART_ADDED, topic=name)
            elif stated[name] != found[name]:
                self._result.find(Fault.PART_CHANGED, topic=name)
        if list(stated) != list(found) and stated == found:
            self._result.find(Fault.PARTS_REORDERED, topic="chain", sequence=0)

    # ------------------------------------------------------------------ causes

    def _explain(self, records: list[RawRecord], computed: bytes, message: RawRecord) -> None:
        """Report why a group differs from its `/chain` message, and continue after it."""
        result, sequence = self._result, message.sequence
        try:
            stated = _DECODER.decode(message.data)
            before = bytes.fromhex(stated.before)
            values = [bytes.fromhex(entry.sha256) for entry in stated.records]
        except _UNREADABLE:
            result.find(Fault.UNREADABLE_MESSAGE, message)
            self.head, self._next = computed, sequence + 1
            return
        count = result.findings_count - self._clear_suspect(before)
        moved = self._place(records, stated.records[0].sequence if stated.records else sequence, message)
        self._find_unlisted(records, stated.records, before)
        self._find_missing(records, stated.records, message)
        self._find_changed(records, stated.records, [before, *values], message)
        if result.findings_count == count and not moved:
            result.find(Fault.VALUES_BROKEN if before != self.head else Fault.MESSAGE_CHANGED, message)
        if sequence >= self._next:
            self.head, self._next = (values[-1] if values else before), sequence + 1

    def _clear_suspect(self, before: bytes) -> bool:
        """Return whether the last record of the previous group is intact and its value in the chain was altered."""
        suspect, self._suspect = self._suspect, None
        findings = self._result.findings
        if suspect is None or suspect[1] != before or suspect[0] >= len(findings):
            return False
        index, self.head = suspect
        old = findings[index]
        text = Fault.VALUE_CHANGED.sentence.format(name=f"/{old.topic} record {old.sequence}")
        findings[index] = replace(old, topic="chain", text=text)
        return True

    def _place(self, records: list[RawRecord], first: int, message: RawRecord) -> bool:
        """Return whether whole groups are missing before this one, or whether it is in the wrong place."""
        sequence, time_ns = message.sequence, message.log_time_ns
        present = {record.sequence for record in records}
        if first > self._next and not any(self._next <= number < first for number in present):
            self._gaps[self._next] = (first - 1, time_ns)
            return True
        if first >= self._next:
            return False
        fault = Fault.RECORDS_REPEATED
        for start, (last, gap_time) in list(self._gaps.items()):
            if start <= first and sequence <= last:
                del self._gaps[start]
                if start < first:
                    self._gaps[start] = (first - 1, gap_time)
                if sequence < last:
                    self._gaps[sequence + 1] = (last, gap_time)
                fault = Fault.RECORDS_MOVED
                break
        self._result.find(fault, sequence=first, time_utc_ns=time_ns, numbers=_numbers(first, sequence))
        return True

    def _find_unlisted(self, records: list[RawRecord], listed: list[ChainLink], before: bytes) -> None:
        """Report records that the chain does not list."""
        numbers = {entry.sequence for entry in listed}
        value = self.head
        prefix = 0
        for record in records:
            if record.sequence in numbers:
                break
            value, prefix = chain.link(value, record.topic, record.body), prefix + 1
        whole_group = bool(prefix) and value == before
        if whole_group:
            last = records[prefix - 1]
            self._result.find(
                Fault.MESSAGE_MISSING, topic="chain", sequence=last.sequence + 1, time_utc_ns=last.log_time_ns
            )
            self.head = value
        seen: set[int] = set()
        for i, record in enumerate(records):
            is_explained = whole_group and i < prefix
            if (record.sequence not in numbers and not is_explained) or record.sequence in seen:
                self._result.find(Fault.NOT_LISTED, record)
            seen.add(record.sequence)

    def _find_missing(self, records: list[RawRecord], listed: list[ChainLink], message: RawRecord) -> None:
        """Report records that are listed but missing, or in another order."""
        there = {record.sequence: record for record in reversed(records)}
        for entry in listed:
            if entry.sequence not in there:
                self._result.find(
                    Fault.LISTED_MISSING,
                    topic=entry.topic,
                    sequence=entry.sequence,
                    time_utc_ns=message.log_time_ns,
                )
        stated = [entry.sequence for entry in listed if entry.sequence in there]
        numbers = set(stated)
        order = [number for number in dict.fromkeys(record.sequence for record in records) if number in numbers]
        for wanted, found in zip(stated, order, strict=False):
            if wanted != found:
                self._result.find(Fault.EXCHANGED, there[found], record=wanted)
                return

    def _find_changed(
        self, records: list[RawRecord], listed: list[ChainLink], values: list[bytes], message: RawRecord
    ) -> None:
        """Report records whose value differs from the stated one; `values` begins with the value before the first."""
        there = {record.sequence: record for record in reversed(records)}
        last = len(listed) - 1
        for i, entry in enumerate(listed):
            record = there.get(entry.sequence)
            if record is None:
                continue
            value = chain.link(values[i], record.topic, record.body)
            if value == values[i + 1] and record.topic == entry.topic:
                continue
            after = there.get(listed[i + 1].sequence) if i < last else None
            if after is not None and chain.link(value, after.topic, after.body) == values[i + 2]:
                self._result.find(Fault.VALUE_CHANGED, message, name=f"/{record.topic} record {record.sequence}")
                continue
            self._result.find(Fault.RECORD_CHANGED, record)
            if i == last:
                self._suspect = (len(self._result.findings) - 1, value)

    # ------------------------------------------------------------------ seals

    def _seal(self, before: bytes, record: RawRecord) -> None:
        result = self._result
        try:
            seal = msgspec.json.decode(record.data, type=Seal)
        except UNREADABLE:
            result.find(Fault.UNREADABLE_MESSAGE, record)
            return
        result.seal = "" if seal.reason == "hour" else seal.reason
        if (seal.sha256, seal.sequence) != (before.hex(), record.sequence - 1):
            result.find(Fault.SEAL_CHANGED, record)
        elif record.body != chain.body_of(record.sequence, seal.time_utc_ns, encode(seal)):
            # A signature is over what was decoded; nothing signs the record itself where it is the last one.
            result.find(Fault.SEAL_NOT_WHOLE, record)
        if not seal.signature:
            result.sealed_signed = False
            self._add_unsigned(record.topic, record.log_time_ns, record.body)
            return
        result.signed += 1
        result.keys.add(seal.public_key)
        result.sealed_signed = True
        if self._verifier is not None and not self._verifier.holds(seal):
            result.find(Fault.FALSE_SIGNATURE, record)
            self._add_unsigned(record.topic, record.log_time_ns, record.body)
        elif (seal.sha256, seal.sequence) == (before.hex(), record.sequence - 1):
            result.proven = True
            self._covered(seal.time_utc_ns)

    def _add_unsigned(self, topic: str, time_ns: int, body: bytes) -> None:
        """Count a record that no signature covers yet.

        What is computed in a sample has the time of its group: without a signature either can be rewritten, so both
        count. A probe or an event states a time that others may have set, and counts by that of its group.
        """
        result = self._result
        result.unsigned_behind += 1
        if topic in _OF_SAMPLES:
            self._behind[topic] += 1
            result.unsigned_samples, result.unsigned_most = self._behind["sample"], max(self._behind.values())
            own = _TIME.search(body)
            if own is not None and int(own[1]) != time_ns:
                result.overdue = True
                time_ns = max(time_ns, int(own[1]), key=lambda ns: abs(ns - self._signed_ns))
        age_ns, self._last_ns = abs(time_ns - self._signed_ns), time_ns
        result.unsigned_min = max(result.unsigned_min, abs(time_ns - self._covered_ns) / 60e9)
        # After the group with which a seal is due the recorder writes nothing before that seal, which it signs.
        result.overdue = result.overdue or self._is_late
        self._due = self._due or age_ns >= chain.SEAL_EVERY_NS

    def _covered(self, time_ns: int) -> None:
        """Note that everything up to here is signed."""
        result = self._result
        result.unsigned_behind = result.unsigned_samples = result.unsigned_most = 0
        self._behind.clear()
        result.unsigned_min, result.overdue = 0.0, False
        self._signed_ns = self._covered_ns = time_ns
        self._due = self._is_late = False

    def _compare_head(self, value: bytes) -> None:
        """Note whether the machine's head states this value: then it covers everything up to here."""
        if value in self._heads:
            self._result.at_head = True
            covered_ns = self._last_ns
            self._covered(self._signed_ns)
            self._covered_ns = covered_ns


def _numbers(first: int, last: int) -> str:
    return f"record {first} is" if first == last else f"records {first} to {last} are"
