"""Audits the recordings of a machine together: none missing, none exchanged, each going on where the last one ended."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from compensator.audit.findings import Difference, Finding, Kind, utc
from compensator.audit.recording_audit import RecordingAudit, audit_recording
from compensator.reasons import Remark
from compensator.recording.chain import NOTHING
from compensator.recording.signature import Verifier

_NAME = re.compile(r"^(?P<machine>.+)_\d{8}T\d{6}Z(-\d{3})?\.mcap$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Audit:
    """Verdict over a number of recordings.

    Parameters
    ----------
    files : tuple of RecordingAudit
        In the order in which they were begun.
    findings : tuple of Finding
        What is wrong, file by file, the first of each file.
    findings_count : int
        How many there are.
    difference : Difference, optional
        The first sample that comes out differently.
    remarks : tuple of Remark
        What is worth knowing and not wrong.
    signed : bool
        Whether signatures were checked against a key.
    """

    files: tuple[RecordingAudit, ...]
    findings: tuple[Finding, ...]
    findings_count: int
    difference: Difference | None
    remarks: tuple[Remark, ...]
    signed: bool

    @property
    def samples(self) -> int:
        """Number of samples worked out again."""
        return sum(file.samples for file in self.files)

    @property
    def differing(self) -> int:
        """Number of samples that come out differently."""
        return sum(file.differing for file in self.files)

    @property
    def clean(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings_count and not self.differing

    def as_json(self) -> dict[str, Any]:
        """Return it as it stands in the result of `--json`."""
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
    progress: Callable[[int, int], None] | None = None,
    executor: Executor | None = None,
) -> Audit:
    """Audit recordings.

    Parameters
    ----------
    paths : sequence of pathlib.Path
        Recordings, in any order.
    public_key : pathlib.Path, optional
        Key that they must be signed with.
    progress : callable, optional
        Called with the number of bytes worked off, and of all.
    executor : Executor, optional
        Who audits the files; this process, one after the other, where there is none.

    Raises
    ------
    DataError
        If one of them is no recording.
    UsageError
        If the key cannot be used.
    """
    verifier = Verifier(public_key) if public_key else None
    paths = list(dict.fromkeys(paths))
    sizes = {path: path.stat().st_size if path.exists() else 0 for path in paths}
    whole = sum(sizes.values())
    done = 0

    def add(size: int) -> None:
        nonlocal done
        done += size
        if progress is not None:
            progress(done, whole)

    if executor is not None:
        audits = _side_by_side(executor, paths, public_key, lambda path: add(sizes[path]))
    else:
        audits = [audit_recording(path, verifier, progress=add) for path in paths]
    return judge(audits, signed=verifier is not None)


def _side_by_side(
    executor: Executor, paths: Sequence[Path], public_key: Path | None, done: Callable[[Path], None]
) -> list[RecordingAudit]:
    """Audit files side by side: each carries the state that it begins with, so none waits for another."""
    jobs = {executor.submit(_audit_one, path, public_key): path for path in paths}
    for job in as_completed(jobs):
        job.result()
        done(jobs[job])
    return [job.result() for job in jobs]


def _audit_one(path: Path, public_key: Path | None) -> RecordingAudit:
    return audit_recording(path, Verifier(public_key) if public_key else None)


def judge(audits: Sequence[RecordingAudit], *, signed: bool = False) -> Audit:
    """Put the audits of single files together.

    Parameters
    ----------
    audits : sequence of RecordingAudit
        In any order.
    signed : bool
        Whether seals were checked against a key.
    """
    # By the names that they were begun with: these tell the order, also where the clock was set back.
    files = sorted(map(_named, audits), key=lambda f: (f.machine, f.original.removesuffix(".mcap")))
    judged = _Judge(files, signed)
    for before, after in zip([None, *files[:-1]], files, strict=True):
        judged.file(after)
        judged.joint(before if before is not None and before.machine == after.machine else None, after)
    findings = [finding for file in files for finding in (*judged.own.get(file.file, ()), *file.findings)]
    count = sum(len(own) for own in judged.own.values()) + sum(file.findings_count for file in files)
    first = next((file.difference for file in files if file.difference), None)
    return Audit(
        files=tuple(files),
        findings=tuple(findings),
        findings_count=count,
        difference=first,
        remarks=tuple(judged.remarks),
        signed=signed,
    )


def _named(file: RecordingAudit) -> RecordingAudit:
    """Return the file with the machine of its name where nothing is left of it in it."""
    name = _NAME.match(file.file)
    return file if name is None or file.machine else replace(file, machine=name["machine"])


class _Judge:
    """Looks at files one after the other, and at what joins them."""

    def __init__(self, files: Sequence[RecordingAudit], signed: bool) -> None:
        self._names = {file.original: file for file in files}
        self._removed = {name for file in files for name in file.removed}
        self._newest = {file.machine: file.file for file in files}
        self._signed = signed
        self.own: dict[str, list[Finding]] = {}
        self.remarks: list[Remark] = []

    def _find(self, kind: Kind, file: RecordingAudit, text: str) -> None:
        self.own.setdefault(file.file, []).append(Finding(kind=kind, file=file.file, text=text))

    def file(self, file: RecordingAudit) -> None:
        """Look at one file by itself."""
        if file.original != file.file and _NAME.match(file.file):
            self._find("reordered", file, f"its name is that of another file: it was begun as {file.original}")
        if file.not_worked_out:
            self.remarks.append(
                Remark("not_worked_out", f"{file.file}: not all samples were worked out again: {file.not_worked_out}.")
            )
        if not file.last and file.end in ("open", "torn"):
            self.remarks.append(Remark("torn", f"{file.file}: torn before anything was recorded."))
            return
        if file.end == "recovered":
            self.remarks.append(
                Remark("recovered", f"{file.file}: the service was ended hard; every whole record was kept.")
            )
        elif file.end in ("open", "torn"):
            what = "within a group of records" if file.end == "torn" else "behind a whole group of records"
            newest = self._newest[file.machine] == file.file
            known = (
                "; that no more was there cannot be known until the next file names its last value" if newest else ""
            )
            text = f"{file.file}: has no end, {what}: still being written, or ended hard{known}."
            self.remarks.append(Remark("torn", text) if file.end == "torn" else Remark("open", text))
        if file.skipped:
            self.remarks.append(
                Remark("samples_missing", f"{file.file}: {file.skipped} sample(s) between others were not recorded.")
            )
        if file.early:
            text = f"{file.early} offset(s) were published before they were on disk, which was slow or failed"
            self.remarks.append(Remark("published_early", f"{file.file}: {text}."))
        self._seals(file)

    def _seals(self, file: RecordingAudit) -> None:
        if self._signed:
            if file.end in ("finished", "recovered") and file.last and not file.sealed_signed:
                self._find("unsigned", file, "its end is not signed")
            elif not file.last:
                self._find("unsigned", file, "has no hash chain, so nothing is signed")
            elif file.unsigned_behind:
                self.remarks.append(
                    Remark(
                        "unsigned_behind", f"{file.file}: {file.unsigned_behind} record(s) behind the last signature."
                    )
                )
        elif file.signed:
            keys = ", ".join(key[:16] for key in file.keys)
            self.remarks.append(
                Remark("signature_not_checked", f"{file.file}: signed by {keys}…, not checked (no --public-key).")
            )

    def joint(self, before: RecordingAudit | None, after: RecordingAudit) -> None:
        """Look at what joins a file to the one before it."""
        if not after.last:
            return
        if before is None:
            self._first(after)
            return
        if not before.last:
            if (
                before.end in ("open", "torn")
                and after.previous_file == before.file
                and after.previous != NOTHING.hex()
            ):
                self._find("truncated", before, f"{after.file} goes on from records that are not there")
            return
        if after.previous == before.last:
            self._state(before, after)
            return
        if not after.previous_file:
            self.remarks.append(
                Remark(
                    "begins_new_chain",
                    f"{after.file}: begins a new chain; it says that no recording was there before it.",
                )
            )
            return
        named = self._names.get(after.previous_file)
        if named is None:
            lost = "removed by the limit of what is kept" if after.previous_file in self._removed else "missing"
            self._find(
                "missing_file",
                after,
                f"{after.previous_file}, which it goes on from, is {lost}; it stood behind {before.file}",
            )
        elif named.original != before.original:
            self._find("reordered", after, f"goes on from {named.file}, and {before.file} stands between")
        elif before.end == "damaged":
            return
        elif before.end in ("open", "torn", "truncated"):
            self._find("truncated", before, f"{after.file} goes on from more than is there: its end was cut off")
        else:
            self._find(
                "broken", after, f"does not go on from the last value of {before.file}: one of them was rewritten"
            )

    def _first(self, file: RecordingAudit) -> None:
        if file.previous != NOTHING.hex() or file.previous_file:
            lost = (
                "which the limit of what is kept removed" if file.previous_file in self._removed else "not given here"
            )
            self.remarks.append(Remark("before_not_given", f"{file.file}: begins after {file.previous_file}, {lost}."))

    def _state(self, before: RecordingAudit, after: RecordingAudit) -> None:
        """In one run, the state that a file opens with is that which the file before ended with."""
        if after.first_seq >= 0 and 0 <= after.first_seq <= before.last_seq:
            self._find("broken", after, f"sample numbers from {after.first_seq} on stand in {before.file}, too")
        whole = not (before.not_worked_out or after.not_worked_out or before.findings_count or before.differing)
        same_run = after.began == "day" and not after.restarted and after.identity == before.identity
        same_run = same_run and bool(after.state_before) and after.first_seq == before.last_seq + 1
        if whole and same_run and after.state_before != before.state_after:
            self._find("state", after, f"opens with another state than {before.file} ends with")


def summary(found: Audit) -> str:
    """Return the verdict in a few lines for people."""
    files, samples = len(found.files), found.samples
    machines = ", ".join(dict.fromkeys(file.machine or "unnamed machine" for file in found.files))
    times = [ns for file in found.files if file.samples for ns in (file.first_ns, file.last_ns)]
    span = f", {utc(min(times))} to {utc(max(times))}" if times else ""
    lines = [f"{samples} samples of {machines} in {files} file(s){span}"]
    if not samples:
        lines.append("No sample was worked out again.")
    elif not found.differing:
        lines.append("Every estimate and every offset comes out again, bit for bit.")
    else:
        lines.append(f"{found.differing} sample(s) come out differently. The first of them:")
        lines += found.difference.lines() if found.difference else []
    chained = [file for file in found.files if file.last]
    if chained and not found.findings_count:
        records = sum(file.records for file in chained)
        lines.append(f"The hash chain holds over {records} records; nothing was changed, removed, inserted or moved.")
        if not found.signed:
            lines.append(
                "Who could write all of these files could compute the chain anew: only a signature, checked "
                "with --public-key, excludes that."
            )
    if found.findings_count:
        lines.append(f"{found.findings_count} finding(s):")
        lines += [f"  {finding.line()}" for finding in found.findings]
    lines += [f"remark: {remark}" for remark in _shortened([remark.marked for remark in found.remarks])]
    return "\n".join(lines)


def _shortened(remarks: Sequence[str], most: int = 20) -> list[str]:
    """Return the first remarks; a year of files may have one each."""
    kept = list(remarks[:most])
    if len(remarks) > most:
        kept.append(f"and {len(remarks) - most} more (--json has all)")
    return kept
