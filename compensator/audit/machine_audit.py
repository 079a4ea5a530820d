"""Audits the recordings of a machine together: none is missing or exchanged, and each continues the previous one."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, replace
from itertools import groupby, takewhile
from pathlib import Path
from typing import Any

from compensator.audit.findings import Difference, Fault, Finding, utc
from compensator.audit.recording_audit import audit_recording
from compensator.audit.result import RecordingAudit
from compensator.audit.verdict import has_unchecked, partly, verdict
from compensator.codes import AuditFinding, AuditRemark, RecordingEnd, Remark
from compensator.errors import DataError, UsageError, one_line
from compensator.recording.chain import NOTHING
from compensator.recording.head import read_head
from compensator.recording.naming import named_of, order_of
from compensator.recording.signature import Verifier

#: Number of remarks that the text of an audit has; a year of files may have one each.
REMARKS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Audit:
    """Result of an audit of several recordings.

    Parameters
    ----------
    files : tuple of RecordingAudit
        In the order of their start.
    findings : tuple of Finding
        The first findings of each file, file by file.
    counts, of_files : Counter
        Number of all findings of each kind, and of those that are about the file's place among the others.
    difference : Difference, optional
        The first sample that the replay does not reproduce.
    remarks : tuple of Remark
        Observations that are not findings.
    signed : bool
        Whether signatures were checked against a key.
    restarts : tuple of str
        Files that begin a new chain behind others of their machine: no link shows whether one is missing before them.
    """

    files: tuple[RecordingAudit, ...]
    findings: tuple[Finding, ...]
    counts: Counter[AuditFinding]
    of_files: Counter[AuditFinding]
    difference: Difference | None
    remarks: tuple[Remark, ...]
    signed: bool
    restarts: tuple[str, ...] = ()

    @property
    def findings_count(self) -> int:
        """Number of all findings."""
        return self.counts.total()

    @property
    def samples(self) -> int:
        """Number of samples that were replayed."""
        return sum(file.samples for file in self.files)

    @property
    def decisions(self) -> int:
        """Number of decisions of the loop that were made again."""
        return sum(file.decisions for file in self.files)

    @property
    def differing(self) -> int:
        """Number of samples that the replay does not reproduce."""
        return sum(file.differing for file in self.files)

    @property
    def machines(self) -> str:
        """Names of the machines, as text."""
        return ", ".join(dict.fromkeys(file.machine or "unnamed machine" for file in self.files))

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Times of the first and last sample that were replayed, ns since 1970 UTC; None where there was none."""
        times = [ns for file in self.files if file.samples for ns in (file.first_ns, file.last_ns)]
        return (min(times), max(times)) if times else None

    @property
    def chained(self) -> list[RecordingAudit]:
        """Files with a hash chain."""
        return [file for file in self.files if file.last]

    @property
    def perhaps_emptied(self) -> list[RecordingAudit]:
        """Files without a record at the end of a machine's; no later one shows that they never held any."""
        return _perhaps_emptied(self.files)

    @property
    def clean(self) -> bool:
        """Whether there are no findings and no differences."""
        return not self.findings_count and not self.differing

    def as_json(self) -> dict[str, Any]:
        """Return the result for `--json`."""
        files = [
            {
                "file": f.file,
                "machine": f.machine,
                "end": f.end,
                "samples": f.samples,
                "records": f.records,
                "skipped_samples": f.skipped,
                "differing_samples": f.differing,
                "published_early": f.early,
                "findings": f.findings_count,
                "chained": bool(f.last),
                "last_value": f.last or None,
                "signed_seals": f.signed,
                "model_sha256": f.model or None,
            }
            for f in self.files
        ]
        return {
            "clean": self.clean,
            "signatures_checked": self.signed,
            "samples": self.samples,
            "differing_samples": self.differing,
            "findings_count": self.findings_count,
            "findings": [f.as_json() for f in self.findings],
            "difference": self.difference.as_json() if self.difference else None,
            "remarks": list(self.remarks),
            "remark_codes": [remark.code for remark in self.remarks],
            "files": files,
        }


def audit(
    paths: Sequence[Path],
    *,
    public_key: Path | None = None,
    head: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    executor: Executor | None = None,
    named: Collection[Path] = (),
) -> Audit:
    """Audit recordings.

    What lies among recordings and is none is a finding: it may stand where a recording was, and the others can still be
    audited. A file that somebody has named is his mistake, unless its own name is that of a recording.

    Parameters
    ----------
    paths : sequence of pathlib.Path
        Recordings, in any order.
    public_key : pathlib.Path, optional
        Key with which they must be signed.
    head : pathlib.Path, optional
        Head of the chain, which the machine keeps outside the folder of the recordings (`recording/head.py`).
    progress : callable, optional
        Called with the number of bytes processed and their total.
    executor : Executor, optional
        Audits the files in parallel; without one, this process audits them one after the other.
    named : collection of pathlib.Path
        Those of the paths that were named one by one, not found in a folder.

    Raises
    ------
    DataError
        If none of the files is a recording, or one that was named is none and does not have the name of one.
    UsageError
        If the key or the head cannot be used.
    """
    verifier = Verifier(public_key) if public_key else None
    if head is not None and verifier is None:
        raise UsageError(f"{head}: a head of the chain is checked with the public key, which is not given")
    ends = {end.file: end for end in read_head(head, verifier).ends if end.synced} if head is not None else {}
    heads = {name: frozenset((end.synced,)) for name, end in ends.items()}
    paths = list(dict.fromkeys(paths))
    sizes = {path: path.stat().st_size if path.exists() else 0 for path in paths}
    total = sum(sizes.values())
    done = 0

    def add(size: int) -> None:
        nonlocal done
        done += size
        if progress is not None:
            progress(done, total)

    if executor is not None:
        audits = _side_by_side(executor, paths, public_key, heads, lambda path: add(sizes[path]))
    else:
        audits = [_audited(path, verifier, heads.get(path.name, frozenset()), progress=add) for path in paths]
    whole = [_or_finding(path, one, is_named=path in named) for path, one in zip(paths, audits, strict=True)]
    for one in audits:
        if isinstance(one, DataError) and not any(file.is_recording for file in whole):
            raise one
    return combine(whole, signed=verifier is not None, newest=list(ends)[-1] if ends else "", heads=heads)


def _side_by_side(
    executor: Executor,
    paths: Sequence[Path],
    public_key: Path | None,
    heads: Mapping[str, frozenset[str]],
    done: Callable[[Path], None],
) -> list[RecordingAudit | DataError]:
    """Audit files in parallel: each contains the state at its start, so they are independent."""
    jobs = {executor.submit(_audit_one, path, public_key, heads.get(path.name, frozenset())): path for path in paths}
    for job in as_completed(jobs):
        job.result()
        done(jobs[job])
    return [job.result() for job in jobs]


def _audit_one(path: Path, public_key: Path | None, heads: frozenset[str]) -> RecordingAudit | DataError:
    return _audited(path, Verifier(public_key) if public_key else None, heads)


def _audited(
    path: Path, verifier: Verifier | None, heads: frozenset[str], progress: Callable[[int], None] | None = None
) -> RecordingAudit | DataError:
    """Return the audit of a file, or why it is no recording."""
    try:
        return audit_recording(path, verifier, heads=heads, progress=progress)
    except DataError as error:
        return error


def _or_finding(path: Path, found: RecordingAudit | DataError, *, is_named: bool) -> RecordingAudit:
    """Return the audit of a file; of what stands where a recording may have been, one with that as its finding.

    Raises
    ------
    DataError
        If there is nothing, or a file that was named, that no service wrote and that does not have the name of a
        recording either: this is a mistake, no evidence.
    """
    if isinstance(found, RecordingAudit):
        return found
    if not os.path.lexists(path) or (path.is_file() and is_named and not named_of(path.name)):
        raise found
    words = str(found).removeprefix(f"{path}: ").removeprefix(f"{path.name}: ")
    entry = RecordingAudit(file=path.name, original=path.name, end=AuditFinding.DAMAGED, is_recording=False)
    entry.find(Fault.NO_RECORDING, what=words)
    return entry


def combine(
    audits: Sequence[RecordingAudit], *, signed: bool = False, newest: str = "", heads: Collection[str] = ()
) -> Audit:
    """Combine the audits of single files.

    Parameters
    ----------
    audits : sequence of RecordingAudit
        In any order.
    signed : bool
        Whether seals were checked against a key.
    newest : str
        Name of the newest recording by the head of the machine; empty without a head.
    heads : collection of str
        Names of the recordings whose ends the head states.
    """
    # By the names at their creation, which show the order even if the clock was set back.
    files = sorted(map(_named, audits), key=lambda f: (f.machine, order_of(f.original.removesuffix(".mcap"))))
    series = _Series(files, signed, newest)
    read = [file for file in files if file.is_recording]
    for _, of_machine in groupby(read, key=lambda file: file.machine):
        before, between = None, list[RecordingAudit]()
        for after in of_machine:
            series.check_file(after)
            if after.last and before is not None and after.original == before.original:
                continue  # a copy is a finding, and has no place of its own in the chain
            if after.last:
                series.check_link(before, between, after)
                before, between = after, []
            else:
                between.append(after)
    if read and newest:
        series.check_head(read, newest, heads)
    if not any(file.samples or file.last for file in files):
        series.check_nothing(files)
    own = {name: whole.findings for name, whole in series.own.items()}  # of two files of one name once
    findings = [finding for file in files for finding in (*own.pop(file.file, ()), *file.findings)]
    of_files = sum((one.counts for one in series.own.values()), Counter[AuditFinding]())
    return Audit(
        files=tuple(files),
        findings=tuple(findings),
        counts=sum((file.counts for file in files), of_files),
        of_files=of_files,
        difference=next((file.difference for file in files if file.difference), None),
        remarks=tuple(series.remarks),
        signed=signed,
        restarts=tuple(series.restarts),
    )


def _named(file: RecordingAudit) -> RecordingAudit:
    """Return the file with the machine of its file name if its metadata are lost."""
    return file if file.machine else replace(file, machine=named_of(file.file))


def _started(original: str) -> tuple[str, int]:
    """Return the part of a file's name that shows when it was started; a name that no recorder gives is the oldest."""
    return order_of(original.removesuffix(".mcap").rpartition("_")[2]) if named_of(original) else ("", 0)


def _perhaps_emptied(files: Sequence[RecordingAudit]) -> list[RecordingAudit]:
    """Return the files behind the last record of each machine; `files` are in order."""
    found: list[RecordingAudit] = []
    for _, of_machine in groupby((file for file in files if file.is_recording), key=lambda file: file.machine):
        found += takewhile(lambda file: not file.last, reversed(list(of_machine)))
    return found


class _Series:
    """Checks files one after the other, and the links between them."""

    def __init__(self, files: Sequence[RecordingAudit], signed: bool, newest: str) -> None:
        #: Findings of whole files; they come before those within a file.
        self.own = {file.file: RecordingAudit(file=file.file) for file in files}
        files = [file for file in files if file.is_recording]
        self._names = {file.original: file for file in files}
        #: What continues a file that the recorder gave up, which is then none that a kill has left.
        self._after_failure = {(file.machine, file.previous_file): file for file in files if file.began == "failure"}
        self._emptied = {file.file for file in _perhaps_emptied(files)}
        self._first_of: dict[tuple[str, str], str] = {}
        self._removed = {name for file in files for name in file.removed}
        begun = [file for file in files if file.last] or files
        self._newest = {file.machine: file.file for file in begun}
        #: Only the file that was started last may still be without its next seal; a head states which one that is.
        #: It is of a machine of which something is signed, if anything is: the key is that of one machine.
        of = {file.machine for file in begun if file.proven}
        own = [file for file in begun if file.machine in of] or begun
        self._live = newest or (max(own, key=lambda file: _started(file.original)).file if own else "")
        self._signed = signed
        self.remarks: list[Remark] = []
        self.restarts: list[str] = []

    def _find(self, fault: Fault, file: RecordingAudit, **figures: Any) -> None:
        self.own[file.file].find(fault, **figures)

    def check_file(self, file: RecordingAudit) -> None:
        """Check one file by itself."""
        name, remark = file.file, self.remarks.append
        if file.original != name and named_of(name):
            self._find(Fault.RENAMED, file, original=file.original)
        created = file.machine, file.original
        if created in self._first_of:
            self._find(Fault.COPIED, file, other=self._first_of[created], original=file.original)
        self._first_of.setdefault(created, name)
        if not file.last and file.end in (RecordingEnd.OPEN, RecordingEnd.TORN):
            words = f"{name}: ends before the first record"
            if name in self._emptied:
                words += (
                    f" ({file.size} bytes), and no later file shows that it never held one: a kill as a file begins "
                    "leaves such a one, and so does somebody who empties it"
                )
            remark(Remark(RecordingEnd.TORN, f"{words}."))
            return
        if file.not_replayed:
            remark(Remark(AuditRemark.NOT_REPLAYED, f"{name}: not all samples were replayed: {file.not_replayed}."))
        after = self._after_failure.get(created)
        cause = "the service was killed"
        if after is not None:
            cause = (
                f"the disk did not accept what followed, and the service went on in {after.file}, whose events say why"
            )
        if file.end == RecordingEnd.RECOVERED:
            remark(Remark(RecordingEnd.RECOVERED, f"{name}: {cause}; every complete record was kept."))
        elif file.end in (RecordingEnd.OPEN, RecordingEnd.TORN):
            figures = f"{name}: no end; {'it is still being written, or ' if after is None else ''}{cause}"
            if self._newest[file.machine] == name:
                figures += "; the next file shows whether records are missing, as it contains this file's last value"
            if file.end == RecordingEnd.TORN:
                remark(Remark(RecordingEnd.TORN, f"{figures}. It ends within a group of records."))
            else:
                remark(Remark(RecordingEnd.OPEN, f"{figures}. It ends after a complete group of records."))
        if file.skipped:
            remark(
                Remark(
                    AuditRemark.SAMPLES_MISSING, f"{name}: {file.skipped} sample(s) between others were not recorded."
                )
            )
        if file.early:
            figures = (
                f"{file.early} offset(s) were published before they were on disk, because the disk was slow or failed"
            )
            remark(Remark(AuditRemark.PUBLISHED_EARLY, f"{name}: {figures}."))
        if file.outside:
            remark(Remark(AuditRemark.OUTSIDE_CHAIN, f"{name}: {'; '.join(file.outside)}."))
        self._check_signatures(file)

    def _check_signatures(self, file: RecordingAudit) -> None:
        name, remark = file.file, self.remarks.append
        if self._signed:
            if not file.last:
                self._find(Fault.NOTHING_SIGNED, file)
                return
            if not file.unsigned_behind:
                return
            records, samples, minutes = file.unsigned_behind, file.unsigned_samples, file.unsigned_min
            # A false signature at the end is a finding of its own.
            if not file.sealed_signed and (name != self._live or not file.may_be_live):
                self._find(Fault.NOT_SIGNED, file, records=records, samples=samples, minutes=minutes)
                return
            figures = f"{records} record(s) after the last signature: {samples} sample(s), {minutes:.0f} min"
            remark(Remark(AuditRemark.UNSIGNED_BEHIND, f"{name}: {figures}; no signature proves them."))
        elif file.signed:
            keys = ", ".join(key[:16] for key in sorted(file.keys))
            remark(
                Remark(AuditRemark.SIGNATURE_NOT_CHECKED, f"{name}: signed by {keys}…, not checked (no --public-key).")
            )

    def check_head(self, files: Sequence[RecordingAudit], newest: str, heads: Collection[str]) -> None:
        """Check that the recordings reach what the head of the machine states."""
        there = {file.file for file in files}
        if newest not in there:
            self._find(Fault.NEWEST_MISSING, files[-1], newest=newest)
        for file in files:
            if file.file in heads and not file.at_head:
                self._find(Fault.BEFORE_HEAD, file)

    def check_nothing(self, files: Sequence[RecordingAudit]) -> None:
        """Find that the files prove nothing, where no other finding says so."""
        for file in files:
            if not file.findings_count and not self.own[file.file].findings_count:
                self._find(Fault.NOTHING_PROVEN, file, size=file.size)

    def check_link(
        self, before: RecordingAudit | None, between: Sequence[RecordingAudit], after: RecordingAudit
    ) -> None:
        """Check the link of a file with a chain to the previous one that has one, over files without between them."""
        named = next((file for file in between if file.original == after.previous_file), None)
        if named is not None:
            began = named.end not in (AuditFinding.DAMAGED, AuditFinding.TRUNCATED)  # these are findings of their own
            if began and after.previous != NOTHING.hex():
                self._find(Fault.MORE_WAS_THERE, named, next=after.file)
            elif began and before is not None:
                self._restart(after, f"{named.file} held no record")
        elif before is None:
            self._check_first(after)
        elif after.previous == before.last:
            self._check_state(before, after)
        elif not after.previous_file:
            self._restart(after, "there was no earlier recording")
        else:
            self._explain_break(before, after)

    def _restart(self, file: RecordingAudit, stated: str) -> None:
        self.restarts.append(file.file)
        figures = f"{file.file}: starts a new chain; it states that {stated}."
        self.remarks.append(Remark(AuditRemark.BEGINS_NEW_CHAIN, figures))

    def _explain_break(self, before: RecordingAudit, after: RecordingAudit) -> None:
        named = self._names.get(after.previous_file)
        if named is None:
            lost = "removed by the retention limit" if after.previous_file in self._removed else "missing"
            self._find(Fault.FILE_MISSING, after, previous=after.previous_file, lost=lost, before=before.file)
        elif named.original != before.original:
            self._find(Fault.FILES_REORDERED, after, previous=named.file, before=before.file)
        elif before.end in (RecordingEnd.OPEN, RecordingEnd.TORN, AuditFinding.TRUNCATED):
            self._find(Fault.MORE_WAS_THERE, before, next=after.file)
        elif before.end != AuditFinding.DAMAGED:
            self._find(Fault.FILES_BROKEN, after, previous=before.file)

    def _check_first(self, file: RecordingAudit) -> None:
        if file.previous != NOTHING.hex() or file.previous_file:
            removed = file.previous_file in self._removed
            lost = "which the retention limit removed" if removed else "which was not given"
            self.remarks.append(
                Remark(AuditRemark.BEFORE_NOT_GIVEN, f"{file.file}: continues {file.previous_file}, {lost}.")
            )

    def _check_state(self, before: RecordingAudit, after: RecordingAudit) -> None:
        """Check that within one run a file starts with the state at the end of the previous one."""
        if after.first_seq >= 0 and 0 <= after.first_seq <= before.last_seq:
            self._find(Fault.NUMBERS_REPEATED, after, seq=after.first_seq, previous=before.file)
        whole = not (before.not_replayed or after.not_replayed or before.findings_count or before.differing)
        same_run = after.began == "day" and not after.restarted and after.identity == before.identity
        same_run = same_run and bool(after.state_before) and after.first_seq == before.last_seq + 1
        if whole and same_run and after.state_before != before.state_after:
            self._find(Fault.OTHER_STATE, after, previous=before.file)


def summary(found: Audit) -> str:
    """Return the verdict, and what it rests on, in a few lines of text."""
    sign = "✗" if not found.clean else "⚠" if partly(found) else "✓"
    files, samples = len(found.files), found.samples
    span = ", " + " to ".join(map(utc, found.span_ns)) if found.span_ns else ""
    lines = [f"{sign} {verdict(found)}", f"{samples} samples of {found.machines} in {files} file(s){span}"]
    if not samples:
        lines.append("No sample was replayed.")
    elif not found.differing:
        every = "of the samples that it could replay" if not found.clean or has_unchecked(found) else ""
        words = ["The replay reproduces every estimate and every offset", every]
        decided = f" It makes the {found.decisions} decisions of the loop again, on the same figures."
        lines.append(f"{' '.join(filter(None, words))}, bit for bit.{decided if found.decisions else ''}")
    else:
        lines.append(f"{found.differing} sample(s) differ in the replay. The first of them:")
        lines += found.difference.lines() if found.difference else []
    if found.chained and not found.findings_count:
        records = sum(file.records for file in found.chained)
        between = "between the first and the last of them nothing was changed, removed, inserted or moved"
        if found.restarts:
            chains = len(found.restarts) + len({file.machine for file in found.chained})
            between = (
                f"within each of the {chains} chains nothing was changed, removed, inserted or moved; between them "
                "files may be missing"
            )
        lines.append(f"The hash chain holds over {records} records; {between}.")
        if not found.signed:
            lines.append(
                "Anyone who can write all of these files can compute a new chain; only a signature, checked "
                "with --public-key, excludes this."
            )
    if found.findings_count:
        lines.append(f"{found.findings_count} finding(s):")
        lines += [f"  {finding.line()}" for finding in found.findings]
    lines += [f"remark: {remark}" for remark in _shortened([remark.marked for remark in found.remarks])]
    return "\n".join(map(one_line, lines))  # names in them are those of the files


def _shortened(remarks: Sequence[str]) -> list[str]:
    """Return the first remarks, and how many more there are."""
    kept = list(remarks[:REMARKS])
    if len(remarks) > REMARKS:
        kept.append(f"and {len(remarks) - REMARKS} more (--json lists all)")
    return kept
