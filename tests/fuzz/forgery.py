"""Recordings changed by somebody who can write their folder, drawn from a seed, and what an audit may then believe.

The forger knows the format and computes chains that fit, but has neither the key nor the head. Whether he is found is
not stated for each attack: it follows from what he has changed. An audit that finds nothing must not have been
deceived about a record that a signature or the head covers.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import struct
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

from compensator.audit.machine_audit import Audit, audit
from compensator.errors import DataError
from compensator.recording.container import LARGEST, MAGIC
from compensator.recording.framing import ATTACHMENT, CHUNK, DATA_END, HEADER, MESSAGE_INDEX, METADATA, SCHEMA
from compensator.recording.reading import last_value, recordings
from compensator.recording.signature import Signer
from tests.audit.attacks import rechained, unsigned_seals, without_seals
from tests.audit.made import MACHINE, MINUTE_NS, Service
from tests.audit.tampering import Line, lines_of, rewrite, with_new_values
from tests.audit.test_signatures import write_key
from tests.fuzz.mutation import mutated

#: Minutes that the recorded service ran each time; it was stopped, and then killed, once right after an hourly seal.
RUNS = (65, 20, 61, 70)
HOUR_MIN = 60
TIME = re.compile(rb'"time_utc_ns":(\d+),')
#: Attacks after which no other can read a file, in this order.
_LAST = ("begun", "emptied", "large")
_NONE_LEFT = "no file with a record is left"


def records(path: Path) -> list[Line]:
    """The records of a file, without its chain and without the seal of a recovered end."""
    lines = [line for line in lines_of(path)[0] if line.topic != "chain"]
    if lines and lines[-1].topic == "seal" and b'"reason":"recovered"' in lines[-1].data:
        lines.pop()
    return lines


@dataclass
class Originals:
    """Recordings of a machine with a key and a head; the newest one has no end.

    Parameters
    ----------
    folder : pathlib.Path
        Holds `rec`, the key pair and the head.
    """

    folder: Path

    def __post_init__(self) -> None:
        self.private, self.public = write_key(self.folder, "machine", 7)
        seq = 0
        for i, minutes in enumerate(RUNS):
            service = self.start(self.folder, seq).run(minutes)
            service.kill() if i else service.stop()
            seq += minutes
        self.next_seq = seq
        self.records = {path.name: records(path) for path in recordings(self.folder / "rec", MACHINE)}
        self.names = list(self.records)

    def start(self, folder: Path, seq: int) -> Service:
        """Start the service, with the key and the head of a folder."""
        return Service(folder / "rec", seq=seq, signer=Signer(self.private), head=folder / "vmc-07.head.json")

    def signed(self, name: str, there: list[Line]) -> int:
        """Number of records of a file that signatures cover.

        Without the head the newest file may have been cut off before a seal; then those that are left count.
        """
        if name != self.names[-1]:
            return len(self.records[name])
        seals = [i for i, line in enumerate(there) if line.topic == "seal" and b'"signature":""' not in line.data]
        return 1 + max(seals, default=-1)

    def written(self, name: str) -> int:
        """Number of records of a file that are on disk by the head: all but the last group of the newest file."""
        lines = self.records[name]
        last = lines[-1].time_ns if name == self.names[-1] else -1
        return sum(line.time_ns != last for line in lines)


def deceived(originals: Originals, folder: Path, *, head: bool) -> str:
    """Return which record an audit without findings would be wrong about; empty if about none.

    Parameters
    ----------
    originals : Originals
        What was recorded.
    folder : pathlib.Path
        Holds the changed recordings.
    head : bool
        Whether the head was known, to the audit or to the service at its next start.
    """
    there = {path.name: path for path in recordings(folder / "rec", MACHINE)}
    for name, path in there.items():
        if path.stat().st_size > LARGEST:
            return f"{name}: {path.stat().st_size} bytes, which no service writes"
    kept = [name for name in originals.names if name in there and there[name].stat().st_size]
    if not kept:
        return _NONE_LEFT if head else ""
    first, last = originals.names.index(kept[0]), originals.names.index(kept[-1])
    if kept != originals.names[first : last + 1]:
        return f"between {kept[0]} and {kept[-1]} a file is missing"
    if head and kept[-1] != originals.names[-1]:
        return "the newest file is missing"
    for name in kept:
        found: list[Line] = []
        with suppress(DataError):
            found = records(there[name])
        count = originals.written(name) if head else originals.signed(name, found)
        if found[:count] != originals.records[name][:count]:
            return f"{name}: one of the first {count} records"
    for name in kept:
        data = there[name].read_bytes()
        if data.endswith(b"\0") and data.rstrip(b"\0").endswith(MAGIC):
            return f"{name}: zeros behind its end"
    if older := _older(there[kept[-1]]):
        return f"{kept[-1]}: {older}"
    return next((f"{path.name}: {twice} in two places" for path in there.values() if (twice := _twice(path))), "")


def _older(path: Path) -> str:
    """Return by what the end of the newest file that no signature covers is older than an hour; empty if it is not."""
    lines: list[Line] = []
    with suppress(DataError):
        lines = lines_of(path)[0]
    seals = [i for i, line in enumerate(lines) if line.topic == "seal" and b'"signature":""' not in line.data]
    start = max(seals, default=0)
    behind = lines[start:]
    for topic in ("sample", "offset"):
        if (count := sum(line.topic == topic for line in behind)) > 2 * HOUR_MIN:
            return f"{count} of {topic} behind its last signature"
    ends, late = [i for i, line in enumerate(behind) if line.topic == "chain"], 0
    for i, end in pairwise([0, *ends]):
        times = [line.time_ns for line in behind[i:end] if line.topic != "chain"]
        own = [TIME.search(line.data) for line in behind[i:end] if line.topic in ("sample", "estimate", "offset")]
        times += [int(one[1]) for one in own if one is not None]
        late += any(abs(time_ns - lines[start].time_ns) >= HOUR_MIN * 60e9 for time_ns in times)
    return f"{late} groups of an hour and more after its last signature" if late > 1 else ""


def _twice(path: Path) -> str:
    """Return what else than messages and their index is more than once in a file."""
    data, seen = path.read_bytes(), set[bytes]()
    for code, at, length in parts(data):
        if code in (CHUNK, DATA_END):
            break
        named = b"" if code == HEADER else data[at + 9 : at + length]
        key = bytes([code]) + named
        if code in (HEADER, SCHEMA, METADATA, ATTACHMENT) and key in seen:
            return f"a record of kind {code}"
        seen.add(key)
    return ""


def parts(data: bytes) -> list[tuple[int, int, int]]:
    """Kind, place and length with its head of each record of a file, as far as it is one."""
    at, found = len(MAGIC), []
    while at + 9 <= len(data) and data.startswith(MAGIC):
        code, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            break
        found.append((code, at, 9 + length))
        at += 9 + length
    return found


# ---------------------------------------------------------------------- what a forger does


def _edit(rng: random.Random, lines: list[Line]) -> list[Line]:
    """One to three records changed, removed, repeated or exchanged."""
    lines = list(lines)
    for _ in range(rng.randrange(1, 4)):
        places = [i for i, line in enumerate(lines) if line.topic not in ("chain", "seal")]
        if len(places) < 2:
            return lines
        # Often near the end, where the signatures are few.
        i = rng.choice(places[-9:] if rng.random() < 0.3 else places)
        way = rng.randrange(5)
        if way < 2:
            digits = [at for at, byte in enumerate(lines[i].data) if 49 <= byte <= 56]
            at = rng.choice(digits)
            data = lines[i].data[:at] + bytes((lines[i].data[at] + 1,)) + lines[i].data[at + 1 :]
            lines[i] = replace(lines[i], data=data)
        elif way == 2:
            lines[i] = replace(lines[i], data=mutated(rng.randrange(2**32), lines[i].data))
        elif way == 3:
            del lines[i]
        else:
            lines.insert(i, lines[rng.choice(places)])
    return lines


def _kept_seals(lines: list[Line]) -> list[Line]:
    return lines


def _cut(rng: random.Random, lines: list[Line]) -> list[Line]:
    ends = [i for i, line in enumerate(lines) if line.topic == "chain"]
    return lines[: rng.choice(ends) + 1]


def _rewritten(rng: random.Random, paths: list[Path]) -> None:
    """Change one file and make its chain, and perhaps those after it, anew."""
    which = rng.randrange(len(paths))
    seals: Callable[[list[Line]], list[Line]] = rng.choice((_kept_seals, without_seals, unsigned_seals))
    first = rng.choice((partial(_edit, rng), partial(_cut, rng), _kept_seals))
    form = rng.randrange(4)
    before: bytes | None = None
    for path in paths[which : which + 1 if rng.random() < 0.3 else None]:

        def change(lines: list[Line], first: Callable[[list[Line]], list[Line]] = first) -> list[Line]:
            return seals(first(lines))

        if form == 0:
            contents = lines_of(path)[1]
            if before is not None:
                contents.run["previous_chain"] = before.hex()
            rewrite(path, lambda lines, c=contents, edit=change: with_new_values(edit(lines), c))  # type: ignore[misc]
        else:
            cut = rng.randrange(1, 400) if form == 3 else 0
            rechained(path, change, before=before, finished=form == 1, cut=cut)
        before, first = last_value(path), _kept_seals


def _bytes(rng: random.Random, paths: list[Path]) -> None:
    """Change bytes of one file without knowing the format."""
    path = rng.choice(paths)
    data = bytearray(path.read_bytes())
    early = rng.randrange(min(len(data), 6000))
    way = rng.randrange(5)
    if way == 0:
        data[early] ^= 1 << rng.randrange(8)
    elif way == 1:
        del data[rng.randrange(len(data)) :]
    elif way == 2:
        at = rng.randrange(len(data))
        data[at : at + rng.randrange(1, 200)] = b""
    elif way == 3:
        data[early : early + 40] = rng.randbytes(40)
    else:
        data = bytearray(mutated(rng.randrange(2**32), bytes(data)))
    path.write_bytes(data)


def _removed(rng: random.Random, paths: list[Path]) -> None:
    for path in rng.sample(paths, rng.randrange(1, len(paths) + 1)):
        path.unlink()


def _exchanged(rng: random.Random, paths: list[Path]) -> None:
    one, other = rng.sample(paths, 2)
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)


def _inserted(rng: random.Random, paths: list[Path]) -> None:
    """Copy a file to a later time, and perhaps let it continue from the newest one."""
    copy = paths[-1].with_name(f"{MACHINE}_20260105T{rng.randrange(9, 24):02d}0000Z.mcap")
    shutil.copy(rng.choice(paths), copy)
    if rng.random() < 0.7:
        rechained(copy, rng.choice((without_seals, unsigned_seals)), before=last_value(paths[-1]))


def _emptied(rng: random.Random, paths: list[Path]) -> None:
    """Put a file without a record where one is or was, as a kill before its first sync leaves one."""
    path = rng.choice(paths)
    if path.exists():
        path = path.with_name(path.name.replace("Z", f"Z-{rng.randrange(1, 9):03d}", 1))
    path.touch()


def _seal(rng: random.Random, paths: list[Path]) -> None:
    """Change of the last seal that remains what its signature does not cover, and perhaps remove those after it."""
    path = rng.choice((paths[-1], rng.choice(paths)))
    later = rng.choice((-60, 1, 30, 60, 1440)) * 60 * 10**9
    texts = (b',"note":"approved"}', b" }", b',"reason":"stop"}')
    way, text, removed = rng.randrange(3), rng.choice(texts), rng.random() < 0.7

    def change(lines: list[Line]) -> list[Line]:
        seals = [i for i, line in enumerate(lines) if line.topic == "seal"]
        if removed and len(seals) > 1:
            last = seals.pop()
            lines = [*lines[:last], *lines[last + 2 :]]
        if not seals:
            return lines
        seal = lines[seals[-1]]
        if way < 2:
            seal = replace(seal, time_ns=seal.time_ns + later)
        if way > 0:
            seal = replace(seal, data=seal.data[:-1] + text)
        return [*lines[: seals[-1]], seal, *lines[seals[-1] + 1 :]]

    rechained(path, change, finished=rng.random() < 0.3, cut=rng.choice((0, 0, 100)))


def _added(rng: random.Random, paths: list[Path]) -> None:
    """Put records that are no messages where none belong: copies of those at the start, or an index."""
    path = rng.choice((paths[-1], rng.choice(paths)))
    data = path.read_bytes()
    there = parts(data)
    copied = [one for one in there if one[0] in (HEADER, SCHEMA, METADATA, ATTACHMENT)]
    if not copied:
        return
    _, at, length = rng.choice((copied[0], rng.choice(copied)))
    extra = data[at : at + length]
    if rng.random() < 0.2:
        body = struct.pack("<HI", 1, 16) + rng.randbytes(16)
        extra += struct.pack("<BQ", MESSAGE_INDEX, len(body)) + body
    where = rng.choice(there)[1]
    path.write_bytes(data[:where] + extra * rng.choice((1, 1, 50)) + data[where:])


def _lengthened(rng: random.Random, paths: list[Path]) -> None:
    """Put records behind the end that nobody has signed: of one kind or all, dated as the forger likes."""
    of = rng.choice((("offset",), ("event",), ("sample", "estimate", "offset")))
    count = rng.choice((1, 3, 20, 70, 130, 300))
    apart_ns, ahead_ns, logged = (
        rng.choice((0, 1, MINUTE_NS)),
        rng.choice((0, 50, 43_200, -43_200)) * MINUTE_NS,
        rng.random(),
    )

    def longer(lines: list[Line]) -> list[Line]:
        copied = [next(line for line in reversed(lines) if line.topic == topic) for topic in of]
        made, last_ns = list(lines), lines[-1].time_ns
        for i in range(count):
            own_ns = last_ns + ahead_ns + (i + 1) * apart_ns
            time_ns = own_ns if logged < 0.5 else last_ns
            for line in copied:
                dated = TIME.sub(b'"time_utc_ns":%d,' % own_ns, line.data, count=1)
                made.append(replace(line, time_ns=time_ns, data=dated))
            made.append(replace(lines[-1], time_ns=time_ns))
        return made

    rechained(paths[-1], longer)


def _zeros(rng: random.Random, paths: list[Path]) -> None:
    """Put zeros behind a file."""
    with rng.choice(paths).open("ab") as file:
        file.write(bytes(rng.choice((1, 63, 64, 5000, 200_000))))


def _large(rng: random.Random, paths: list[Path]) -> None:
    """A file of zeros, or zeros behind a recording, which take no space on the disk."""
    size = rng.choice((LARGEST + 1, 4 * 10**9, 10**11))
    if rng.random() < 0.5:
        os.truncate(rng.choice(paths), size)
    else:
        path = paths[0].with_name(f"{MACHINE}_{rng.choice((2025, 2027))}0101T000000Z.mcap")
        path.write_bytes(rng.choice((MAGIC, b"")))
        os.truncate(path, size)


def _begun(rng: random.Random, paths: list[Path]) -> None:
    """Overwrite the beginning of a file, or put one there that has nothing of a recording but its name."""
    path = rng.choice((paths[-1], rng.choice(paths)))
    length = rng.choice((1, 4, 7, 8, 100, 4096))
    other = rng.choice((bytes(length), rng.randbytes(length), b"0,20.5\n" * length))[:length]
    if rng.random() < 0.3:
        path.with_name(f"{MACHINE}_20270101T000000Z.mcap").write_bytes(other)
    else:
        path.write_bytes(other + path.read_bytes()[length:])


ATTACKS: dict[str, Callable[[random.Random, list[Path]], None]] = {
    "rewritten": _rewritten,
    "rewritten again": _rewritten,
    "bytes": _bytes,
    "removed": _removed,
    "exchanged": _exchanged,
    "inserted": _inserted,
    "emptied": _emptied,
    "seal": _seal,
    "added": _added,
    "lengthened": _lengthened,
    "lengthened again": _lengthened,
    "zeros": _zeros,
    "large": _large,
    "begun": _begun,
}


@dataclass(frozen=True)
class Tried:
    """What came of one or two attacks: their kinds, whether they were found, and about what somebody was deceived."""

    kind: str
    found: bool
    deceived: str


def attacked(originals: Originals, folder: Path, seed: int) -> Tried:
    """Draw an attack; audit with the key, with the head, and again after the service has started.

    Parameters
    ----------
    originals : Originals
        What was recorded; copied.
    folder : pathlib.Path
        An empty folder.
    seed : int
        Of the attack.
    """
    rng = random.Random(seed)
    shutil.copytree(originals.folder / "rec", folder / "rec")
    shutil.copy(originals.folder / "vmc-07.head.json", folder)
    kinds = rng.sample(list(ATTACKS), 2 if rng.random() < 0.5 else 1)
    # What is read by an attack must hold records, and be no larger than they are.
    kinds.sort(key=lambda kind: _LAST.index(kind) if kind in _LAST else -1)
    before, tried = recordings(folder / "rec", MACHINE), list[str]()
    for one in kinds:
        paths = before if one == "emptied" else recordings(folder / "rec", MACHINE)
        if len(paths) > 1:
            # A file may hold no record any more.
            with suppress(DataError, IndexError) if tried else nullcontext():
                ATTACKS[one](rng, paths)
                tried.append(one)
    kind, found = " + ".join(tried), list[bool]()
    for head in (False, True):
        verdict = _verdict(originals, folder, head=head)
        found.append(verdict is None or not verdict.clean)
        if not found[-1] and (wrong := deceived(originals, folder, head=head)):
            return Tried(kind, False, f"{'with' if head else 'without'} the head: {wrong}")
    originals.start(folder, originals.next_seq).run(3).stop()
    verdict = _verdict(originals, folder, head=False)
    found.append(verdict is None or not verdict.clean)
    if verdict is not None and verdict.clean:
        wrong = deceived(originals, folder, head=True)
        # Where all files are gone, the new one names the newest of them; they may be in an archive.
        named = wrong == _NONE_LEFT and originals.names[-1] in " ".join(verdict.remarks)
        if wrong and not named:
            return Tried(kind, False, f"after a restart: {wrong}")
    return Tried(kind, all(found), "")


def _verdict(originals: Originals, folder: Path, *, head: bool) -> Audit | None:
    """Audit the folder; None if it is refused in one line, which it is not beside a file that nobody has changed."""
    paths = recordings(folder / "rec", MACHINE)
    known = folder / "vmc-07.head.json" if head else None
    try:
        return audit(paths, public_key=originals.public, head=known) if paths else None
    except DataError as error:
        assert "\n" not in str(error)
        kept = [path for path in paths if path.name in originals.names and path.stat().st_size < LARGEST]
        assert not any(path.read_bytes() == (originals.folder / "rec" / path.name).read_bytes() for path in kept)
        return None
