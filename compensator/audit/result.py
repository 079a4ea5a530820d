"""Result of the audit of one file, filled in by the checks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

from compensator.audit.findings import KEPT, Difference, Fault, Finding
from compensator.clock import NS
from compensator.codes import AuditFinding, RecordingEnd
from compensator.recording.chain import SEAL_EVERY_NS
from compensator.recording.reading import RawRecord


@dataclass(slots=True, kw_only=True)
class RecordingAudit:
    """Result of the audit of one file.

    Parameters
    ----------
    file : str
        Name.
    size : int
        Bytes.
    original, machine, began, previous_file : str
        From its metadata: the name at its creation, the machine, why it was created, the previous file.
    previous, last : str
        Value of the hash chain from which it continues, and its last value; empty if it has no chain.
    end : RecordingEnd or AuditFinding
        How it ends: with or without an end, or truncated or damaged.
    is_recording : bool
        Whether it could be opened and is a recording of the service; if not, it has no place in the series.
    findings, counts : list of Finding, Counter
        The first findings, and the number of all findings of each kind.
    records : int
        Records in the chain.
    signed, unsigned_behind, unsigned_samples, unsigned_most : int
        Signed seals; after the last of them that is valid records, samples, and those of the kind that is computed in a
        sample of which there are most.
    proven : bool
        Whether a seal is valid.
    unsigned_min : float
        Time from what a valid seal or the head covers, or from the start of the file, to the record that is furthest
        from it, min.
    overdue : bool
        Whether a seal was due in that time, or a time is not that of its group: no recorder goes on so.
    at_head : bool
        Whether its chain contains a value that the machine's head states.
    outside : list of str
        Changes to bytes that the hash chain does not cover, as text.
    keys : set of str
        Public keys in the seals.
    seal, sealed_signed : str, bool
        Reason of the seal that is the last record, empty if there is none, and whether it has a signature, valid or
        not.
    period_s : float
        Sample period, s; 0 if its samples could not be replayed.
    samples, skipped : int
        Samples that were replayed, and samples between them that were not recorded.
    first_seq, last_seq, first_ns, last_ns : int
        Numbers and times of the first and last sample.
    restarted : bool
        Whether the service started with this file.
    differing, difference : int, Difference or None
        Samples that the replay does not reproduce, and the first of them.
    decisions : int
        Decisions of the loop that were made again in the replay, and compared.
    early_seqs : set of int
        Samples whose offset was published before it was on disk.
    removed : list of str
        Recordings that, by its events, the retention limit removed.
    not_replayed : str
        Why its samples could not be replayed; empty if they were.
    identity, model : str
        Hash of configuration and model together, and hash of the model.
    state_before, state_after : str
        Hash of the state at its start, empty if there is none, and of the state after its last sample.
    """

    file: str
    size: int = 0
    original: str = ""
    machine: str = ""
    began: str = ""
    previous_file: str = ""
    previous: str = ""
    last: str = ""
    end: RecordingEnd | AuditFinding = RecordingEnd.FINISHED
    is_recording: bool = True
    findings: list[Finding] = field(default_factory=list)
    counts: Counter[AuditFinding] = field(default_factory=Counter)
    records: int = 0
    signed: int = 0
    proven: bool = False
    unsigned_behind: int = 0
    unsigned_samples: int = 0
    unsigned_most: int = 0
    unsigned_min: float = 0.0
    overdue: bool = False
    at_head: bool = False
    outside: list[str] = field(default_factory=list)
    keys: set[str] = field(default_factory=set)
    seal: str = ""
    sealed_signed: bool = False
    period_s: float = 0.0
    samples: int = 0
    skipped: int = 0
    first_seq: int = -1
    last_seq: int = -1
    first_ns: int = 0
    last_ns: int = 0
    restarted: bool = False
    differing: int = 0
    difference: Difference | None = None
    decisions: int = 0
    early_seqs: set[int] = field(default_factory=set)
    removed: list[str] = field(default_factory=list)
    not_replayed: str = ""
    identity: str = ""
    model: str = ""
    state_before: str = ""
    state_after: str = ""

    @property
    def findings_count(self) -> int:
        """Number of all findings."""
        return self.counts.total()

    @property
    def may_be_live(self) -> bool:
        """Whether it ends as a file may that is being written: without its end, and before the next seal is due.

        The number of samples and of offsets is bounded as well, because times can be rewritten; it is not bounded to
        one interval, because the clock may have been set back.
        """
        unsigned_ns = self.unsigned_most * self.period_s * NS
        recent = not self.overdue and unsigned_ns <= 2 * SEAL_EVERY_NS
        return recent and self.end in (RecordingEnd.OPEN, RecordingEnd.TORN)

    @property
    def early(self) -> int:
        """Number of offsets that were published before they were on disk."""
        return len(self.early_seqs)

    def find(
        self,
        fault: Fault,
        at: RawRecord | None = None,
        *,
        topic: str = "",
        sequence: int | None = None,
        time_utc_ns: int | None = None,
        **figures: Any,
    ) -> None:
        """Add a finding; beyond a maximum, findings are only counted.

        Parameters
        ----------
        fault : Fault
            The fault.
        at : RawRecord, optional
            The record with the fault.
        topic, sequence, time_utc_ns
            Place of the fault if it is not in a single record.
        **figures
            Figures for the sentence of the fault.
        """
        if at is not None:
            topic, sequence, time_utc_ns = at.topic, at.sequence, at.log_time_ns
        self.counts[fault.kind] += 1
        if len(self.findings) < KEPT:
            self.findings.append(
                Finding(
                    kind=fault.kind,
                    file=self.file,
                    text=fault.sentence.format(**figures),
                    topic=topic,
                    sequence=sequence,
                    time_utc_ns=time_utc_ns,
                )
            )

    def pair_moved(self) -> None:
        """Combine a record missing in one place and inserted in another into one that was moved."""
        missing = {(f.topic, f.sequence) for f in self.findings if f.kind == AuditFinding.REMOVED and f.topic}
        moved = set()
        for i, finding in enumerate(self.findings):
            place = (finding.topic, finding.sequence)
            if finding.kind == AuditFinding.INSERTED and place in missing:
                self.findings[i] = replace(finding, kind=Fault.MOVED.kind, text=Fault.MOVED.sentence)
                self.counts.update({finding.kind: -1, Fault.MOVED.kind: 1})
                moved.add(place)
        kept = [f for f in self.findings if f.kind != AuditFinding.REMOVED or (f.topic, f.sequence) not in moved]
        self.counts[AuditFinding.REMOVED] -= len(self.findings) - len(kept)
        self.findings = kept
