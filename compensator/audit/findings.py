"""What an audit can find, and how it is told."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

#: `altered`, `removed`, `inserted`, `reordered`: a record, attachment, metadata table or file. `truncated`: records at
#: the end are missing, and not because the service was killed. `broken`: values of the chain do not belong together.
#: `damaged`: no MCAP from some byte on. `missing_file`: a recording between two others. `unsigned`, `false_signature`:
#: no seal, or none of the key given. `state`: the state that a file opens with is not the one that the file before
#: ends with. `unreadable`: intact, and yet not what its schema says. `index`: the index of the file does not lead to
#: all that is in it, or to something else.
Kind = Literal[
    "altered",
    "removed",
    "inserted",
    "reordered",
    "truncated",
    "broken",
    "damaged",
    "missing_file",
    "unsigned",
    "false_signature",
    "state",
    "unreadable",
    "index",
]

#: So many findings of one file are kept; the rest is counted.
KEPT = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that is wrong with a recording.

    Parameters
    ----------
    kind : str
        See `Kind`.
    file : str
        Name of the file.
    text : str
        What it is, for people.
    topic : str
        Channel without the slash, or `attachment …`, `metadata …`, `channel …`.
    sequence : int, optional
        Number of the record in the file.
    time_utc_ns : int, optional
        Its time, ns since 1970 UTC.
    """

    kind: Kind
    file: str
    text: str
    topic: str = ""
    sequence: int | None = None
    time_utc_ns: int | None = None

    def line(self) -> str:
        """Return one line for people."""
        where = [f"/{self.topic}" if self.topic and " " not in self.topic else self.topic]
        where.append("" if self.sequence is None else f"record {self.sequence}")
        where.append("" if self.time_utc_ns is None else utc(self.time_utc_ns))
        place = " ".join(part for part in where if part)
        return f"{self.file}: {self.kind}: {place + ': ' if place else ''}{self.text}"

    def as_json(self) -> dict[str, Any]:
        """Return it as it stands in the result of `--json`."""
        return {
            "kind": self.kind,
            "file": self.file,
            "topic": self.topic or None,
            "record": self.sequence,
            "time_utc_ns": self.time_utc_ns,
            "text": self.text,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One field that differs; `None` where it is null or absent."""

    name: str
    recorded: Any
    recomputed: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A message that the engine does not give again.

    Parameters
    ----------
    file : str
        Name of the file.
    topic : str
        `sample`, `estimate`, `offset` or `event`.
    seq : int
        Number of the sample.
    time_utc_ns : int
        Its time, ns since 1970 UTC.
    fields : tuple of Field
        What differs.
    """

    file: str
    topic: str
    seq: int
    time_utc_ns: int
    fields: tuple[Field, ...]

    def lines(self) -> list[str]:
        """Return it for people, field by field."""
        head = f"{self.file}: /{self.topic} of sample {self.seq}, {utc(self.time_utc_ns)}, comes out differently:"
        rows = [f"  {f.name}: recorded {f.recorded!r}, recomputed {f.recomputed!r}" for f in self.fields]
        return [head, *rows]

    def as_json(self) -> dict[str, Any]:
        """Return it as it stands in the result of `--json`."""
        fields = [{"field": f.name, "recorded": f.recorded, "recomputed": f.recomputed} for f in self.fields]
        return {
            "file": self.file,
            "topic": self.topic,
            "seq": self.seq,
            "time_utc_ns": self.time_utc_ns,
            "fields": fields,
        }


class Findings:
    """Findings of one file, the first of them kept."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.kept: list[Finding] = []
        self.count = 0

    def add(
        self, kind: Kind, text: str, *, topic: str = "", sequence: int | None = None, time_utc_ns: int | None = None
    ) -> None:
        """Keep one, or count it where there are many."""
        self.count += 1
        if len(self.kept) < KEPT:
            self.kept.append(
                Finding(kind=kind, file=self.file, text=text, topic=topic, sequence=sequence, time_utc_ns=time_utc_ns)
            )


def utc(time_ns: int) -> str:
    """Return a time as ISO 8601."""
    try:
        return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    except (OverflowError, ValueError, OSError):
        return f"{time_ns} ns"
