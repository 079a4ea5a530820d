"""The pages of `replay`: what an audit proved and did not prove, and what another model would have done."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from compensator import __version__
from compensator.audit.findings import Difference, utc
from compensator.audit.machine_audit import Audit
from compensator.audit.other_model import OtherModel, worst_utc
from compensator.audit.result import RecordingAudit
from compensator.audit.verdict import partly, verdict
from compensator.axes import label_of
from compensator.codes import AuditFinding, RecordingEnd
from compensator.recording.chain import NOTHING
from compensator.report.envelope import Envelope, line_of
from compensator.report.history import Spread
from compensator.report.page import (
    Block,
    Cell,
    CodeLink,
    Details,
    Figure,
    Line,
    Page,
    Section,
    Strip,
    Table,
    Tone,
    Words,
    sentence_of,
)

_TIME = "time, UTC"
#: Number of files and findings shown at once; more are folded.
_ROWS = 20
#: Remarks that are shown; a year of files may have one each.
_REMARKS = 40
#: Number of values that are added to a curve at once.
_TOGETHER = 5000
_ENDS_WHOLE = (RecordingEnd.FINISHED, RecordingEnd.RECOVERED)
#: Kinds of findings that are about a statement of their own, or about none; the others are by their place.
_APART = (
    AuditFinding.UNSIGNED,
    AuditFinding.FALSE_SIGNATURE,
    AuditFinding.TRUNCATED,
    AuditFinding.INDEX,
    AuditFinding.EMPTY,
)


# ---------------------------------------------------------------------------- audit


def audit_page(found: Audit) -> Page:
    """Make the page of an audit.

    Parameters
    ----------
    found : Audit
        Result of the audit.
    """
    blocks: list[Block] = [*_timeline(found), _proven(found)]
    if found.difference is not None:
        blocks.append(_difference(found.difference))
    if found.findings:
        blocks.append(_findings(found))
    blocks.append(_files(found.files))
    if found.remarks:
        lines = [sentence_of(remark) for remark in found.remarks[:_REMARKS]]
        if len(found.remarks) > _REMARKS:
            lines.append(f"And {len(found.remarks) - _REMARKS} more; replay --json lists all.")
        blocks.append(Words(title="Remarks", lines=lines))
    blocks.append(_hashes(found))
    title = f"Audit: {found.machines}{_span(found)}"
    data = tuple(file.file for file in found.files)
    return Page(title=title, verdict=verdict(found), blocks=blocks, tone=_tone(found), data=data)


def _tone(found: Audit) -> Tone:
    return "bad" if not found.clean else "warn" if partly(found) else "good"


def _span(found: Audit) -> str:
    if found.span_ns is None:
        return ""
    first, last = (utc(ns)[:16].replace("T", " ") for ns in found.span_ns)
    return f", {first} to {last} UTC"


def _timeline(found: Audit) -> list[Block]:
    """Show the proven intervals; intervals without samples are omitted."""
    files = [file for file in found.files if file.first_ns]
    if not files:
        return []
    wrong = {finding.file for finding in found.findings} | {file.file for file in files if file.differing}
    times = [f.time_utc_ns for f in found.findings if f.time_utc_ns] + [
        file.difference.time_utc_ns for file in files if file.difference
    ]
    spans = {
        words: [(file.first_ns * 1e-9, file.last_ns * 1e-9) for file in files if (file.file in wrong) == is_wrong]
        for words, is_wrong in (("file without findings", False), ("file with findings", True))
    }
    spans["findings"] = [(t * 1e-9, t * 1e-9) for t in times]
    strips = [Strip(words, tuple(spans[words]), line) for words, line in zip(spans, (1, 0, 3), strict=True)]
    first, last = min(file.first_ns for file in files), max(file.last_ns for file in files)
    note = f"{len(spans['file without findings'])} of {len(files)} file(s) with samples have no findings."
    return [
        Figure(
            title="Findings over time",
            x_label=_TIME,
            y_label="outcome",
            clock=True,
            note=note,
            height=1.0 + 0.3 * sum(map(bool, spans.values())),
            strips=tuple(strip for strip in strips if strip.spans),
            x_limits=(first * 1e-9 - 60.0, last * 1e-9 + 60.0),
        ),
    ]


def _proven(found: Audit) -> Table:
    yes, no, open_ = "✓ proven", "✗ not proven", "– not checked"
    chained = found.chained
    records = sum(file.records for file in chained)
    kinds = found.counts
    # A copy is inserted; no file is missing for it.
    of_files = sum(count for kind, count in found.of_files.items() if kind not in (*_APART, AuditFinding.INSERTED))
    of_records = sum(count for kind, count in kinds.items() if kind not in _APART) - of_files
    ends = [file.file for file in found.files if file.end not in _ENDS_WHOLE]
    whole = bool(chained) and len(chained) == len(found.files)
    worked_out = bool(found.samples) and not any(file.not_replayed for file in found.files)
    not_signed = kinds[AuditFinding.UNSIGNED] + kinds[AuditFinding.FALSE_SIGNATURE]
    cut, index = kinds[AuditFinding.TRUNCATED], kinds[AuditFinding.INDEX]
    rows = [
        [
            "Every estimate and every offset is the one that this program computes from the samples",
            no if found.differing else yes if worked_out else open_,
            f"{found.samples} samples replayed, bit for bit; {found.differing} differ",
        ],
        [
            "No record was changed, removed, inserted or moved",
            no if of_records else yes if whole else open_,
            f"hash chain over {records} records in {len(chained)} of {len(found.files)} file(s)",
        ],
        [
            "No file is missing between the first and the last",
            no if of_files else yes if whole and not found.restarts else open_,
            f"a new chain begins with {_few(found.restarts)}"
            if found.restarts
            else "each chain starts with the last value of the previous file",
        ],
        [
            "Readers that seek find exactly the records of the file",
            no if index else yes if whole and not ends else open_,
            "index and summary of each file compared with its records",
        ],
        [
            "The recordings were not completely rewritten from some point on",
            (no if not_signed else yes) if found.signed else open_,
            "signatures checked with the given key"
            if found.signed
            else "only a signature can exclude this: --public-key, and [recording] signing_key on the machine",
        ],
        [
            "Nothing was cut off after the last record",
            no if cut or ends else yes if whole else open_,
            f"no end: {_few(ends)}" if ends else "every file has its end",
        ],
        ["The recordings before the first file are intact", open_, "they were not given"],
        ["The sensors measured correctly", open_, "a recording cannot show this"],
    ]
    return Table(title="What was proven, and what was not", head=["statement", "outcome", "how"], rows=rows)


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (" …" if len(names) > 3 else "")


def _difference(difference: Difference) -> Table:
    return Table(
        title="The first sample that differs, field by field",
        head=["field", "recorded", "replayed"],
        rows=[[field.name, _shown(field.recorded), _shown(field.recomputed)] for field in difference.fields],
        note=f"{difference.file}: /{difference.topic} of sample {difference.seq}, {utc(difference.time_utc_ns)}.",
    )


def _shown(value: object) -> str:
    return "null" if value is None else str(value)


def _findings(found: Audit) -> Block:
    more = found.findings_count - len(found.findings)
    note = f"And {more} more: only the first findings of each file are listed." if more else ""
    head = ["file", "kind", "what", "where"]
    rows: list[list[Cell]] = [[one.file, CodeLink(one.kind), one.text, one.place] for one in found.findings]
    return _folded("Findings", head, rows, note)


def _files(files: Sequence[RecordingAudit]) -> Block:
    rows: list[list[Cell]] = [
        [
            file.file,
            CodeLink(file.end),
            str(file.samples),
            str(file.records),
            str(file.findings_count),
            str(file.differing),
            f"{file.signed} seal(s)" if file.signed else "–",
        ]
        for file in files
    ]
    head = ["file", "end", "samples", "records", "findings", "differ", "signed"]
    return _folded("File by file", head, rows, "The values of the hash chain are in the folded table below.")


def _hashes(found: Audit) -> Details:
    rows: list[list[Cell]] = [
        [
            file.file,
            "starts here" if file.previous == NOTHING.hex() else file.previous or "–",
            file.last or "–",
            file.model or "–",
        ]
        for file in found.files
    ]
    keys = sorted({key for file in found.files for key in file.keys})
    blocks: list[Block] = [Table(head=["file", "chain continues from", "chain ends with", "model, SHA-256"], rows=rows)]
    if keys:
        blocks.append(Table(head=["public keys in the seals"], rows=[[key] for key in keys]))
    blocks.append(Words(title="Made by", lines=[f"quill-compensator {__version__}, compensator replay"]))
    return Details(title="Hashes, keys, program", blocks=blocks)


def _folded(title: str, head: Sequence[str], rows: Sequence[Sequence[Cell]], note: str) -> Block:
    if len(rows) <= _ROWS:
        return Table(title=title, head=head, rows=rows, note=note)
    shown = Table(head=head, rows=rows[:_ROWS], note=note)
    rest = Details(title=f"The other {len(rows) - _ROWS}", blocks=[Table(head=head, rows=rows[_ROWS:])])
    return Section(title=title, blocks=[shown, rest])


# ---------------------------------------------------------------------------- another model


class Curves:
    """Both models' offsets and remaining errors, over any length of time in bounded memory."""

    def __init__(self) -> None:
        self.curves = {name: Envelope() for name in ("recorded", "other", "left recorded", "left other")}
        self._rows: list[tuple[float, ...]] = []
        self.first_s, self.last_s = math.inf, -math.inf

    def add(self, time_ns: int, y: float, recorded: float, other_y: float, other: float) -> None:
        """Add a sample: measured deformation and offset of each, µm."""
        t = time_ns * 1e-9
        self.first_s, self.last_s = min(self.first_s, t), max(self.last_s, t)
        self._rows.append((t, recorded, other, y + recorded, other_y + other))
        if len(self._rows) >= _TOGETHER:
            self._flush()

    def line(self, name: str, curve: str) -> Line:
        """Return a curve to draw."""
        self._flush()
        return line_of(name, self.curves[curve])

    def _flush(self) -> None:
        if self._rows:
            t, *values = np.array(self._rows, dtype=np.float64).T
            for curve, y in zip(self.curves.values(), values, strict=True):
                curve.add(t, y)
            self._rows = []


def comparison_page(found: OtherModel, curves: Curves) -> Page:
    """Make the page that compares another model with the recorded one.

    Parameters
    ----------
    found : OtherModel
        The figures.
    curves : Curves
        Both offsets.
    """
    recorded, other = f"{found.recorded} (recorded)", found.other
    ends = (curves.first_s, curves.last_s)
    offsets = Figure(
        title="Offset of both models",
        x_label=_TIME,
        y_label="Y offset, µm",
        clock=True,
        x_limits=ends,
        lines=(curves.line(recorded, "recorded"), curves.line(other, "other")),
        note=f"They differ by {_um(found.own.offsets.rms)} µm rms, at most {_um(abs(found.own.offsets.peak))} µm.",
    )
    blocks: list[Block] = [offsets]
    if found.own.left_before.samples:
        left = (curves.line(recorded, "left recorded"), curves.line(other, "left other"))
        blocks.append(
            Figure(
                title="Remaining error: measured deformation + offset",
                x_label=_TIME,
                y_label="Y, µm",
                clock=True,
                x_limits=ends,
                lines=left,
                height=2.8,
            )
        )
    blocks.append(_before_and_after(found))
    if found.remarks:
        blocks.append(Words(title="Remarks", lines=[sentence_of(one) for one in found.remarks]))
    words, tone = _better(found)
    return Page(
        title=f"Model “{found.other}” on what “{found.recorded}” recorded", verdict=words, blocks=blocks, tone=tone
    )


def _better(found: OtherModel) -> tuple[str, Tone]:
    before, after = found.own.left_before.rms, found.own.left_after.rms
    if not found.own.left_before.samples:
        return (
            f"Y was not measured, so it is unknown which model is better: the offset of “{found.other}” differs by "
            f"{_um(found.own.offsets.rms)} µm rms, at most {_um(abs(found.own.offsets.peak))} µm.",
            "warn",
        )
    words = (
        f"With “{found.other}”, the remaining error in Y would have been {_um(after)} µm rms instead of "
        f"{_um(before)} with “{found.recorded}”, the recorded model."
    )
    tones: list[Tone] = ["good" if after < before else "bad" if after > before else "warn"]
    for axis, one in found.axes.items():
        after, before = one.left_after.rms, one.left_before.rms
        words += f" {label_of(axis)}: {_um(after)} instead of {_um(before)} µm rms."
        tones.append("warn" if after > before and tones[0] != "bad" else tones[0])
    if found.only_y:
        words += f" Compared on Y alone: {found.only_y}."
    return words, tones[0] if tones.count(tones[0]) == len(tones) else "warn"


def _before_and_after(found: OtherModel) -> Table:
    def row(name: str, spread: Spread) -> list[Cell]:
        worst = worst_utc(spread) if spread.samples else "–"
        return [name, _um(spread.rms), _um(abs(spread.peak)), str(spread.samples), worst]

    return Table(
        title="Before and after",
        head=["", "rms µm", "largest µm", "samples", "largest at"],
        rows=[row(name, spread) for name, spread in found.rows().items()],
        note="Residual: measured − predicted. Every recorded sample was run through the service's compensation "
        "with the other model, including limits and lost samples.",
    )


def _um(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2f}"
