"""The verdict of an audit in one sentence, for terminal and page."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from compensator.audit.machine_audit import Audit


def verdict(found: Audit) -> str:
    """Return the verdict in one sentence, with the number of samples and files."""
    files = f"{len(found.files)} recording(s)"
    if not found.clean:
        wrong = []
        if found.findings_count:
            wrong.append(f"{found.findings_count} finding(s)")
        if found.differing:
            wrong.append(f"{found.differing} sample(s) that differ in the replay")
        return f"Not proven: {' and '.join(wrong)} in {files} with {found.samples} samples."
    if partly(found):
        emptied = len(found.perhaps_emptied)
        unknown = f"; {emptied} of them without a record, which may have been removed" if emptied else ""
        if not found.samples:
            return f"Proven in part: the records of {files} are unchanged; none of them is a sample{unknown}."
        if not unknown and found.restarts:
            unknown = f"; before {found.restarts[0]}, which begins a new chain, files may be missing"
        unknown = unknown or "; see what was not checked"
        return f"Proven in part: the replay reproduces {found.samples} samples of {files}{unknown}."
    words = f"Proven: {found.samples} samples in {files} are unchanged, and the replay reproduces every offset"
    if not found.signed:
        return words + "; no signature was checked."
    behind = sum(file.unsigned_samples for file in found.files)
    return words + ", signed with the given key" + (f" but for the last {behind} of them." if behind else ".")


def partly(found: Audit) -> bool:
    """Return whether a part could not be checked."""
    return has_unchecked(found) or bool(found.restarts)


def has_unchecked(found: Audit) -> bool:
    """Return whether a part of what is in the files could not be checked; between them some may be missing besides."""
    return not found.samples or any(not file.last or file.not_replayed for file in found.files)
