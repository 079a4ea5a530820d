"""What somebody does who can write the folder of the recordings, but has neither the key nor the head."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import msgspec

from compensator.messages import Chain, Seal, encode
from compensator.recording import chain
from compensator.recording.container import Attachment, Contents
from compensator.recording.live_file import RecordingFile
from compensator.recording.reading import last_value
from tests.audit.tampering import Line, find, lines_of


def edited_offset(lines: list[Line]) -> list[Line]:
    """One offset changed, far from the start; lines without samples are unchanged."""
    count = sum(line.topic == "offset" for line in lines)
    if not count:
        return lines
    at = find(lines, "offset", count // 2)
    return [*lines[:at], lines[at].edited(b'"valid_for_s":150.0', b'"valid_for_s":950.0'), *lines[at + 1 :]]


def without_seals(lines: list[Line]) -> list[Line]:
    """All seals removed, as if no hour had passed."""
    return [line for line in lines if line.topic != "seal"]


def unsigned_seals(lines: list[Line]) -> list[Line]:
    """All seals kept, without their signatures."""
    kept = []
    for line in lines:
        if line.topic == "seal":
            seal = msgspec.structs.replace(msgspec.json.decode(line.data, type=Seal), public_key="", signature="")
            line = replace(line, data=encode(seal))
        kept.append(line)
    return kept


def rechained(
    path: Path,
    edit: Callable[[list[Line]], list[Line]],
    *,
    before: bytes | None = None,
    finished: bool = False,
    cut: int = 0,
    parts: Mapping[str, Attachment] | None = None,
    machine: str = "",
) -> None:
    """Write a recording again as the recorder writes a live one, with a chain that fits.

    Parameters
    ----------
    path : pathlib.Path
        The recording.
    edit : callable
        Changes its messages.
    before : bytes, optional
        Value from which its chain continues; by default the one from which it continued.
    finished : bool
        Whether it gets its end.
    cut : int
        Bytes to remove from its end, so that it is torn.
    parts : mapping of str to Attachment, optional
        Attachments in the place of its own.
    machine : str
        Another machine, whose file it is made.
    """
    lines, contents = lines_of(path)
    if machine:
        contents.run.update(machine=machine, file=path.name)
    contents.attachments.update(parts or {})
    made = _grouped(edit(lines), contents, before)
    path.unlink()
    machine = contents.run["machine"]
    topics = [channel.topic[1:] for channel in contents.channels.values()]
    axes = ["y"] if "offsets" in topics else []  # its messages are those of several axes
    live = RecordingFile([path], machine, made[0], lines[0].time_ns, topics, axes)
    live.begin(contents.run, list(contents.attachments.values()))
    for group in made[1]:
        live.append([(line.topic, line.data) for line in group], group[0].time_ns)
    live.sync()
    if finished:
        live.finish()
    else:
        live.give_up()
    if cut:
        path.write_bytes(path.read_bytes()[:-cut])


def _grouped(lines: list[Line], contents: Contents, before: bytes | None) -> tuple[bytes, list[list[Line]]]:
    first = msgspec.json.decode(lines[0].data, type=Chain)
    value = bytes.fromhex(first.before) if before is None else before
    contents.run["previous_chain"] = value.hex() if value != chain.NOTHING else ""
    groups: list[list[Line]] = [[]]
    for line in lines[1:]:
        if line.topic == "chain":
            groups.append([])
        else:
            groups[-1].append(line)
    # A seal names the value before it, which is another one now; without its signature it can be made anew.
    head = chain.opening(value, chain.parts_of(contents))
    sequence = 1
    made = []
    for group in filter(None, groups):
        kept = []
        for line in group:
            if line.topic == "seal" and b'"signature":""' in line.data:
                seal = msgspec.json.decode(line.data, type=Seal)
                data = encode(msgspec.structs.replace(seal, sha256=head.hex(), sequence=sequence - 1))
                line = replace(line, data=data)
            head = chain.link(head, line.topic, chain.body_of(sequence, group[0].time_ns, line.data))
            sequence += 1
            kept.append(line)
        sequence += 1
        made.append(kept)
    return value, made


def rechained_all(paths: list[Path], edit: Callable[[list[Line]], list[Line]], *, finished: bool = False) -> None:
    """Change every file, and let each continue from the one before it."""
    before = None
    for path in paths:
        rechained(path, edit, before=before, finished=finished)
        before = last_value(path)
