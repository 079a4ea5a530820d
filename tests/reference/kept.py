"""Reading the reference: recordings by the MCAP library, everything else by the command line.

Nothing here imports the package but its command line, so that it outlives what is moved about inside.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import math
import shutil
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, DataEnd, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from compensator.cli import main

KEPT = Path(__file__).parent / "v0_1_0"
#: Words for people, which may change, and what names a place on this computer or the version.
WORDS = ("text", "remarks", "warnings", "explanation", "how_to_tell_apart", "held_out", "held_out_text", "source")
PLACES = ("out", "model", "report", "page")
#: Hashes of a file that carries the version.
VARYING = ("model_sha256",)


# ---------------------------------------------------------------------- commands


def call(*arguments: object) -> tuple[int, Any]:
    """Run a command with `--json` and return its exit code and its result."""
    told = io.StringIO()
    # From the folder of the reference: what is written holds no path of this computer.
    with contextlib.chdir(KEPT), contextlib.redirect_stdout(told), contextlib.redirect_stderr(io.StringIO()):
        code = main([str(a) for a in (*arguments, "--json")])
    printed = told.getvalue().strip()
    return code, json.loads(printed) if printed else None


def bare(value: Any, without: Sequence[str] = (*WORDS, *PLACES)) -> Any:
    """Return a result without words and paths."""
    if isinstance(value, dict):
        return {key: bare(item, without) for key, item in value.items() if key not in without}
    return [bare(item, without) for item in value] if isinstance(value, list) else value


def differences(wanted: Any, found: Any, rel: float = 0.0, at: str = "") -> list[str]:
    """Return where a result is another one; what it says in addition is no difference.

    Numbers of a list are compared against the largest of them.
    """
    if isinstance(wanted, dict):
        if not isinstance(found, dict):
            return [f"{at}: {found!r}, expected a table"]
        missing = [f"{at}.{key}: missing" for key in wanted if key not in found]
        return missing + [d for k in wanted if k in found for d in differences(wanted[k], found[k], rel, f"{at}.{k}")]
    if isinstance(wanted, list):
        if not isinstance(found, list) or len(found) != len(wanted):
            return [f"{at}: {found!r}, expected {wanted!r}"]
        if wanted and all(map(_is_number, [*wanted, *found])):
            scale = max(map(abs, wanted))
            bad = [i for i, (a, b) in enumerate(zip(wanted, found, strict=True)) if not _near(a, b, rel, scale)]
            return [f"{at}[{i}]: {found[i]!r}, expected {wanted[i]!r}" for i in bad]
        pairs = enumerate(zip(wanted, found, strict=True))
        return [d for i, (a, b) in pairs for d in differences(a, b, rel, f"{at}[{i}]")]
    if _is_number(wanted) and _is_number(found):
        return [] if _near(wanted, found, rel, abs(wanted)) else [f"{at}: {found!r}, expected {wanted!r}"]
    return [] if wanted == found else [f"{at}: {found!r}, expected {wanted!r}"]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _near(wanted: float, found: float, rel: float, scale: float) -> bool:
    return wanted == found or abs(wanted - found) <= rel * scale or (math.isnan(wanted) and math.isnan(found))


# ---------------------------------------------------------------------- recordings


def records_of(path: Path) -> list[Any]:
    """Return the records of a file in order, up to where it ends or is torn."""
    records: list[Any] = []
    with path.open("rb") as file, contextlib.suppress(McapError, EOFError):
        for record in StreamReader(file, record_size_limit=None).records:
            if isinstance(record, DataEnd):
                break
            records.append(record)
    return records


@dataclass(frozen=True)
class Said:
    """What recordings say, by reading them."""

    offsets: list[bytes]
    states: dict[str, int]
    reasons: list[str]
    events: list[str]
    topics: dict[str, int]

    def as_json(self) -> dict[str, Any]:
        """Return it as it is kept."""
        return {
            "offsets": len(self.offsets),
            "offsets_sha256": sha256_of(self.offsets),
            "states": self.states,
            "reasons": self.reasons,
            "events": self.events,
            "messages": self.topics,
        }


def sha256_of(payloads: Sequence[bytes]) -> str:
    """Return the hash over payloads, one a line."""
    return hashlib.sha256(b"\n".join(payloads)).hexdigest()


def said(folder: Path) -> Said:
    """Read all recordings of a folder in the order of their names."""
    offsets: list[bytes] = []
    states: dict[str, int] = {}
    reasons, events, topics = set(), set(), {}
    for path in sorted(folder.glob("*.mcap"), key=lambda file: file.stem):
        records = records_of(path)
        channels = {record.id: record.topic for record in records if isinstance(record, Channel)}
        for message in (record for record in records if isinstance(record, Message)):
            topic = channels[message.channel_id]
            topics[topic] = topics.get(topic, 0) + 1
            if topic == "/offset":
                offset = json.loads(message.data)
                offsets.append(message.data)
                states[offset["state"]] = states.get(offset["state"], 0) + 1
                reasons.update(offset["reasons"])
            elif topic == "/event":
                events.add(json.loads(message.data)["kind"])
    return Said(offsets, dict(sorted(states.items())), sorted(reasons), sorted(events), dict(sorted(topics.items())))


def replay(folder: Path, *options: object) -> dict[str, Any]:
    """Audit a folder and return exit code and result without words; findings stand in a fixed order."""
    code, result = call("replay", folder, *options)
    result = bare(result)
    if result is None:  # refused in one line
        return {"exit": code, "result": None}
    result["findings"].sort(key=lambda finding: json.dumps(finding, sort_keys=True))
    return {"exit": code, "result": result}


# ---------------------------------------------------------------------- tampering


def edited(path: Path, topic: str, which: int, old: bytes, new: bytes) -> None:
    """Write a file again with one byte of one payload changed; everything else stays, checksums fit."""
    assert sum(a != b for a, b in zip(old, new, strict=True)) == 1

    def edit(messages: list[Message], channels: dict[int, str]) -> list[Message]:
        at = [i for i, message in enumerate(messages) if channels[message.channel_id] == topic][which]
        assert old in messages[at].data
        messages[at].data = messages[at].data.replace(old, new, 1)
        return messages

    _rewrite(path, edit)


def without(path: Path, topic: str, which: int) -> None:
    """Write a file again without one record."""

    def edit(messages: list[Message], channels: dict[int, str]) -> list[Message]:
        at = [i for i, message in enumerate(messages) if channels[message.channel_id] == topic][which]
        return messages[:at] + messages[at + 1 :]

    _rewrite(path, edit)


def _rewrite(path: Path, edit: Callable[[list[Message], dict[int, str]], list[Message]]) -> None:
    records = records_of(path)
    channels = {record.id: record.topic for record in records if isinstance(record, Channel)}
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
        ids: dict[int, int] = {}
        numbers: dict[int, int] = {}
        for record in records:
            if isinstance(record, Header):
                writer.start(profile=record.profile, library=record.library)
            elif isinstance(record, Schema) and record.id not in ids:
                ids[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in numbers:
                schema, metadata = ids[record.schema_id], record.metadata
                numbers[record.id] = writer.register_channel(record.topic, record.message_encoding, schema, metadata)
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Attachment):
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        for one in edit([record for record in records if isinstance(record, Message)], channels):
            writer.add_message(numbers[one.channel_id], one.log_time, one.data, one.publish_time, one.sequence)
        writer.finish()


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"), key=lambda file: file.stem)


def _one_byte_of_the_file(folder: Path) -> None:
    path = _files(folder)[0]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def _exchanged(folder: Path) -> None:
    first, second, *_ = _files(folder)
    data = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(data)


def _cut(folder: Path) -> None:
    path = _files(folder)[0]
    path.write_bytes(path.read_bytes()[:-101])


#: Name, scene that it is made of, what is done.
TAMPERED: tuple[tuple[str, str, Callable[[Path], None]], ...] = (
    (
        "byte_of_a_payload",
        "plain",
        lambda folder: edited(_files(folder)[0], "/offset", 100, b'"valid_for_s":150.0', b'"valid_for_s":950.0'),
    ),
    (
        "byte_of_a_raw_value",
        "plain",
        lambda folder: edited(_files(folder)[0], "/sample", 5, b'"at_degc":{"mean":19', b'"at_degc":{"mean":18'),
    ),
    (
        "byte_of_an_estimate",
        "effects",
        lambda folder: edited(_files(folder)[1], "/estimate", 3, b'"heat_w":', b'"heat_x":'),
    ),
    ("byte_of_the_file", "commands", _one_byte_of_the_file),
    ("removed_record", "restarts", lambda folder: without(_files(folder)[1], "/sample", 5)),
    ("removed_file", "series", lambda folder: _files(folder)[1].unlink()),
    ("exchanged_files", "series", _exchanged),
    ("end_cut_off", "restarts", _cut),
)


@contextlib.contextmanager
def tampered(name: str, scratch: Path) -> Iterator[Path]:
    """Give a folder with recordings that somebody has changed."""
    scene, act = next((scene, act) for one, scene, act in TAMPERED if one == name)
    folder = scratch / name
    shutil.copytree(KEPT / "recordings" / scene, folder)
    act(folder)
    yield folder
    shutil.rmtree(folder)


# ---------------------------------------------------------------------- tables

#: Sampled rows that are kept of a table.
EVERY = 90
#: Scenes that are exported, and arguments of the other commands by name, seen from the folder of the reference.
EXPORTS = ("plain", "losses", "effects", "killed", "trouble")
SIMULATED: dict[str, tuple[str, ...]] = {
    "quill": ("tables/effect.csv", "--model", "quill"),
    "effects": ("tables/effect.csv", "--model", "models/effects.toml"),
    "inverse": ("tables/heat.csv", "--model", "models/inverse.toml"),
    "direct": (
        "tables/direct.csv",
        "--model",
        "models/direct.toml",
        *("--column", "t_q_degc=spindle"),
        *("--column", "at_degc=air"),
    ),
    "identified_heat": ("tables/effect.csv", "--model", "identify/heat.toml"),
    "identified_direct": ("tables/heat.csv", "--model", "identify/direct.toml"),
    "diagnosed_quill": ("tables/effect.csv", "--model", "diagnose/quill.toml"),
    "diagnosed_identified": ("tables/effect.csv", "--model", "diagnose/identified.toml"),
    "recording": ("recordings/effects/vmc-07_20260105T060100Z.mcap", "--model", "models/effects.toml"),
}
IDENTIFIED: dict[str, tuple[str, ...]] = {
    "heat": ("tables/heat.csv", "--order", "3", "3", "3", "--fit-until", "14", "--name", "heat"),
    "direct": (
        "tables/direct.csv",
        *("--column", "t_q_degc=spindle"),
        *("--column", "at_degc=air"),
        *("--name", "direct"),
    ),
}
DIAGNOSED: dict[str, tuple[str, ...]] = {
    "quill": ("tables/effect.csv", "--model", "quill"),
    "identified": ("tables/effect.csv", "--model", "identify/heat.toml"),
    "recording": ("recordings/plain/vmc-07_20260105T060100Z.mcap", "--model", "quill"),
}
#: Recordings run through another model: scene, model.
COMPARED: dict[str, tuple[str, str]] = {"same": ("plain", "quill"), "stronger": ("limits", "models/stronger.toml")}


def columns_of(path: Path) -> dict[str, list[str]]:
    """Read a CSV by columns, cells as they stand."""
    with path.open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    return {name: [row[i] for row in rows] for i, name in enumerate(header)}


def hashes_of(path: Path) -> dict[str, str]:
    """Return the hash of each column, cells one a line."""
    return {name: sha256_of([cell.encode() for cell in cells]) for name, cells in columns_of(path).items()}


def sampled(path: Path) -> dict[str, Any]:
    """Return of each numeric column its sampled rows and its root mean square; None where a cell is empty."""
    result = {}
    for name, cells in columns_of(path).items():
        try:
            values = [float(cell) if cell else None for cell in cells]
        except ValueError:
            continue
        known = [value for value in values if value is not None]
        rms = math.sqrt(math.fsum(v * v for v in known) / len(known)) if known else None
        result[name] = {"rows": len(values), "known": len(known), "rms": rms, "sampled": values[::EVERY]}
    return result


def identified(name: str, out: Path) -> tuple[int, Any]:
    """Run `identify` and return exit code and result; the model is `out`."""
    code, result = call("identify", *IDENTIFIED[name], "--out", out)
    return code, bare(result, (*WORDS, *PLACES, *VARYING))


def diagnosed(name: str, out: Path) -> tuple[int, Any]:
    """Run `diagnose` and return exit code and result; `diagnosis.json` and the model are in `out`."""
    code, result = call("diagnose", *DIAGNOSED[name], "--out", out)
    return code, bare(result, (*WORDS, *PLACES, *VARYING))


def simulated(name: str, out: Path) -> dict[str, Any]:
    """Run `simulate` and return exit code, result and the table."""
    code, result = call("simulate", *SIMULATED[name], "--out", out)
    return {"exit": code, "result": bare(result), "columns": sampled(out)}


def compared(name: str, out: Path) -> dict[str, Any]:
    """Run recordings through another model and return exit code, result and the table."""
    scene, model = COMPARED[name]
    code, result = call("replay", KEPT / "recordings" / scene, "--model", model, "--out", out)
    return {"exit": code, "result": bare(result), "columns": sampled(out)}


def exported(scene: str, out: Path) -> dict[str, Any]:
    """Run `export` and return exit code, result and the hash of each column."""
    code, result = call("export", *_files(KEPT / "recordings" / scene), "--out", out)
    return {"exit": code, "result": bare(result), "columns": hashes_of(out)}


def model_table(path: Path) -> dict[str, Any]:
    """Return a model file as a table: what it computes with, without words and without where it comes from."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    table.pop("provenance", None)
    for part in table["paths"].values():
        if "covariance" in part:
            part["covariance"] = [value for row in part["covariance"] for value in row]
    for effect in table.get("effect", []):
        effect.pop("explanation", None)
    return table
