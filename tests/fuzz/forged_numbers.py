"""Recordings with numbers drawn from a seed, in messages, events and states; their chain fits."""

from __future__ import annotations

import functools
import random
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import msgspec

from compensator.clock import NS
from compensator.config import LoadedConfig, parse_config
from compensator.errors import CompensatorError
from compensator.messages import OFFSET_MAX, SEQ_MAX, TIME_MAX_NS
from compensator.model.model_file import parse_model
from compensator.recording.recorder import McapRecorder
from compensator.service.transfer.restart import resume
from tests.audit.attacks import rechained
from tests.audit.made import CONFIG, MACHINE, QUILL, Service, other_model, readings
from tests.audit.tampering import Line, lines_of
from tests.fuzz.payloads import number
from tests.service.records import sample
from tests.service.simulated import START_NS

NAME = f"{MACHINE}_20260105T060000Z.mcap"
#: Minutes on record; the service starts again some minutes later.
MINUTES = 60
NOW_NS = START_NS + 65 * 60 * NS
#: Numbers at and beyond the bounds of a recording.
_EDGES = (
    SEQ_MAX,
    SEQ_MAX + 1,
    TIME_MAX_NS,
    TIME_MAX_NS + 1,
    -1,
    0,
    10**400,
    "1e30",
    "-1e30",
    "1.1e30",
    "1e308",
    "1e-308",
)
_NUMBER = re.compile(rb"(?<=[:,\[])-?\d+(?:\.\d+)?(?:e-?\d+)?(?=[,}\]])")
_NAMED = re.compile(rb'"(?:seq|time_utc_ns|period_s|valid_for_s)":(-?[\d.]+)')
_FREE = b'"data":{"missing":%b,"minutes":%b,"bridged":true,"y_std_um":%b,"published_early":%b}'


@functools.cache
def _recorded() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        service = Service(Path(folder))
        service.note("restart", "a pause", {})
        service.run(MINUTES // 2)
        service.command("hold")
        service.run(MINUTES // 2).stop()
        (path,) = Path(folder).glob("*.mcap")
        return path.read_bytes()


def drawn(rng: random.Random) -> bytes:
    """Return a number as JSON, or nearly so."""
    return str(rng.choice(_EDGES)).encode() if rng.random() < 0.7 else number(rng).encode()


def _changed(rng: random.Random, data: bytes) -> bytes:
    """Replace one to three numbers of a message or a state, those that every message has more often."""
    if b'"data":{}' in data and rng.random() < 0.7:
        return data.replace(b'"data":{}', _FREE % tuple(drawn(rng) for _ in range(4)))
    for _ in range(rng.choice((1, 1, 2, 3))):
        named = [place.span(1) for place in _NAMED.finditer(data)]
        spans = named if named and rng.random() < 0.5 else [place.span() for place in _NUMBER.finditer(data)]
        first, last = rng.choice(spans)
        data = data[:first] + drawn(rng) + data[last:]
    return data


def forged(rng: random.Random, path: Path) -> None:
    """Write a recording with some numbers changed; it is finished, or what a kill leaves.

    Parameters
    ----------
    rng : random.Random
        Where the numbers come from.
    path : pathlib.Path
        The file.
    """
    path.write_bytes(_recorded())
    state = rng.random() < 0.2

    def edit(lines: list[Line]) -> list[Line]:
        lines = list(lines)
        places = [i for i, line in enumerate(lines) if line.topic not in ("chain", "seal")]
        for _ in range(0 if state else rng.choice((1, 1, 2, 5))):
            # Often the last ones, from which a service goes on, or the first, which are events.
            i = rng.choice(rng.choice((places, places[-4:], places[:4])))
            lines[i] = replace(lines[i], data=_changed(rng, lines[i].data))
        return lines

    if state:
        _, contents = lines_of(path)
        part = contents.attachments["state.json"]
        changed = replace(part, data=_changed(rng, part.data))
        rechained(path, edit, parts={"state.json": changed}, finished=rng.random() < 0.5)
    else:
        rechained(path, edit, finished=rng.random() < 0.5)


def start(rng: random.Random, folder: Path) -> None:
    """Start a service on the recordings of a folder, as far as they decide about it, and take some samples.

    Whatever is on record, it starts, and with a number that receivers accept and from which enough are left.
    """
    data = CONFIG.replace(b"offset_max_um = 200.0", b"offset_max_um = 150.0") if rng.random() < 0.3 else CONFIG
    model = other_model() if rng.random() < 0.3 else QUILL
    loaded = LoadedConfig(config=parse_config(data, source="made"), path=folder / "machine.toml", data=data)
    resumed = resume(loaded, parse_model(model, source="made"))
    recorder = McapRecorder(folder / "rec", MACHINE, {"config.toml": data, "model.toml": model})
    seq = recorder.first_sequence(NOW_NS, 60.0)
    assert 0 <= seq <= SEQ_MAX // 2, seq
    for note in resumed.notes:
        assert "\n" not in note.text and len(note.text) < 1000, note.text[:1500]
    compensation = resumed.compensation
    last_ns = compensation.status.time_utc_ns
    if last_ns:
        compensation.pause(round((NOW_NS - last_ns) / (60 * NS)) - 1 if last_ns < NOW_NS else None)
    for i, values in enumerate(readings(3, MINUTES + 5)):
        raw = msgspec.structs.replace(sample(seq + i, values), time_utc_ns=NOW_NS + i * 60 * NS)
        offset = compensation.process(raw).offset
        assert offset.y_offset_um is None or not abs(offset.y_offset_um) > OFFSET_MAX
        recorder.write([("offset", msgspec.json.encode(offset))], raw.time_utc_ns, state=compensation.state())
    recorder.close()


def attempt_start(rng: random.Random, folder: Path) -> None:
    """Forge the newest recording, and start the service twice; errors of one line are none here."""
    (folder / "rec").mkdir()
    forged(rng, folder / "rec" / NAME)
    try:
        for _ in range(2):
            start(rng, folder)
    except CompensatorError as error:
        raise AssertionError(f"the service does not start: {error}") from error
