"""`replay --model`: the figures against arithmetic of their own."""

from __future__ import annotations

import csv
import dataclasses
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from compensator.audit.other_model import COLUMNS, compare
from compensator.clock import NS
from compensator.config import parse_config
from compensator.errors import DataError
from compensator.messages import EstimateMessage, Offset, Sample, number
from compensator.model.effects import effect_from
from compensator.model.model_file import parse_model
from compensator.recording.reading import read_messages, recordings
from compensator.service.compensation import Compensation
from tests.audit.made import CONFIG, MACHINE, MINUTE_NS, QUILL, Service, other_model, readings
from tests.audit.tampering import rewrite
from tests.service.simulated import START_NS

EVENING_NS = START_NS + 17 * 60 * MINUTE_NS
OTHER = parse_model(other_model(), source="test")


def recorded(folder: Path, topic: str, kind: type) -> list:  # type: ignore[type-arg]
    return [
        msgspec.json.decode(record.data, type=kind)
        for path in recordings(folder, MACHINE)
        for record in read_messages(path, (topic,))
    ]


def test_the_figures_are_those_of_a_plain_loop(tmp_path: Path) -> None:
    """Two files, commands in between; y is not measured all the time."""
    service = Service(tmp_path, start_ns=EVENING_NS).run(50)
    service.command("hold")
    service.run(5)
    service.command("resume")
    for values in readings(15, service.seq):
        service.take({**values, "y_um": math.nan})
    service.run(50).stop()
    rows: list[list[object]] = []
    found = compare(recordings(tmp_path, MACHINE)[::-1], OTHER, row=lambda row: rows.append(list(row)))

    compensation = Compensation(parse_config(CONFIG, source="test"), OTHER)
    estimates, offsets = recorded(tmp_path, "estimate", EstimateMessage), recorded(tmp_path, "offset", Offset)
    outcomes = []
    for i, sample in enumerate(recorded(tmp_path, "sample", Sample)):
        if i == 50:
            compensation.hold()
        if i == 55:
            compensation.resume()
        outcomes.append(compensation.process(sample))
    before = np.array([number(e.residual_um) for e in estimates])
    after = np.array([number(o.estimate.residual_um) for o in outcomes])
    was = np.array([number(o.y_offset_um) for o in offsets])
    would = np.array([number(o.offset.y_offset_um) for o in outcomes])
    y = np.array([number(e.y_um) for e in estimates])
    measured = ~np.isnan(y)
    assert measured.sum() == 105 == found.own.residual_before.samples == found.own.residual_after.samples
    assert found.samples == 120 == found.own.offsets.samples
    for spread, values in (
        (found.own.residual_before, before[measured]),
        (found.own.residual_after, after[measured]),
        (found.own.offsets, would - was),
        (found.own.left_before, (y + was)[measured]),
        (found.own.left_after, (y + would)[measured]),
    ):
        assert spread.rms == pytest.approx(math.sqrt(np.mean(values**2)), rel=1e-12)
        assert spread.peak == values[np.argmax(np.abs(values))]
    assert round(found.own.offsets.at_s * NS) == offsets[int(np.argmax(np.abs(would - was)))].time_utc_ns
    assert found.own.offsets.rms > 0.2
    assert [row[1] for row in rows] == list(range(120)) and len(rows[0]) == len(COLUMNS)
    assert [row[6] for row in rows] == [repr(float(value)) for value in would]
    assert rows[60][2] == "" and rows[60][4] == ""  # what is missing is empty
    text = found.text()
    assert text.startswith("120 samples; 105 of them have a residual with both models\n")
    assert f"{found.own.residual_after.rms:.3f}" in text and "other" in text and "quill (recorded)" in text


def test_the_recorded_model_itself_makes_no_difference(tmp_path: Path) -> None:
    Service(tmp_path, start_ns=EVENING_NS).run(100).stop()
    found = compare(recordings(tmp_path, MACHINE), parse_model(QUILL, source="test"))
    assert found.own.offsets.peak == 0.0 and found.own.residual_before == found.own.residual_after and not found.remarks


def test_a_recording_that_begins_on_a_running_machine_is_remarked(tmp_path: Path) -> None:
    Service(tmp_path, start_ns=EVENING_NS).run(100).stop()
    second = recordings(tmp_path, MACHINE)[1]
    found = compare([second], OTHER)
    assert found.samples == 40 and "starts while the machine is running" in found.remarks[0]


def test_a_time_without_samples_is_a_pause(tmp_path: Path) -> None:
    service = Service(tmp_path).run(30)
    for values in readings(10, service.seq):
        service.take(values, lost=True)
    service.run(30).stop()
    found = compare(recordings(tmp_path, MACHINE), OTHER)
    compensation = Compensation(parse_config(CONFIG, source="test"), OTHER)
    for i, sample in enumerate(recorded(tmp_path, "sample", Sample)):
        if i == 30:
            compensation.pause(10)
        last = compensation.process(sample)
    first_peak = abs(found.own.residual_after.peak)
    assert found.samples == 60 and math.isfinite(first_peak)
    rows: list[list[object]] = []
    compare(recordings(tmp_path, MACHINE), OTHER, row=lambda row: rows.append(list(row)))
    assert rows[-1][6] == repr(number(last.offset.y_offset_um))


def test_a_model_that_needs_another_channel_is_refused(tmp_path: Path) -> None:
    Service(tmp_path).run(5).stop()
    table = {"channel": "jacket_degc", "curve": "linear", "tau_min": [10.0], "gain": [1.0], "delay_min": 0.0}
    model = dataclasses.replace(OTHER, effects=(effect_from("input", table),))
    with pytest.raises(DataError, match="jacket_degc"):
        compare(recordings(tmp_path, MACHINE), model)


def test_recordings_of_two_machines_are_not_mixed(tmp_path: Path) -> None:
    Service(tmp_path).run(5).stop()
    from compensator.recording.recorder import McapRecorder

    other = McapRecorder(tmp_path, "lathe-1", {"config.toml": CONFIG, "model.toml": QUILL})
    other.write([("event", b"{}")], START_NS)
    other.close()
    with pytest.raises(DataError, match="lathe-1, vmc-07"):
        compare(list(tmp_path.glob("*.mcap")), OTHER)


def halved(data: bytes) -> bytes:
    return data[: len(data) // 2]


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


@pytest.mark.parametrize("harm", [halved, flipped])
def test_a_file_of_which_only_a_part_can_be_read_is_remarked(tmp_path: Path, harm: Callable[[bytes], bytes]) -> None:
    Service(tmp_path).run(300).stop()
    path = recordings(tmp_path, MACHINE)[0]
    rewrite(path, chunk_size=20_000)  # before it was one chunk, all or nothing
    assert not compare([path], OTHER).remarks
    path.write_bytes(harm(path.read_bytes()))
    found = compare([path], OTHER)
    assert 0 < found.samples < 300 and [remark.code for remark in found.remarks] == ["not_read"]
    assert f"{path.name}: only a part could be read, {found.samples} samples." in found.text()


@pytest.mark.parametrize("cut", [0, 10])
def test_what_a_kill_leaves_is_no_part(tmp_path: Path, cut: int) -> None:
    Service(tmp_path).run(30).kill()
    path = recordings(tmp_path, MACHINE)[0]
    path.write_bytes(path.read_bytes()[: -cut or None])
    assert not compare([path], OTHER).remarks


def test_no_recording_counts_twice(tmp_path: Path) -> None:
    Service(tmp_path).run(5).stop()
    path = recordings(tmp_path, MACHINE)[0]
    copied = tmp_path / "backup of monday.mcap"
    shutil.copy(path, copied)
    with pytest.raises(DataError, match=f"{copied}: a copy of {path}"):
        compare([path, copied], OTHER)


def test_the_table_is_csv(tmp_path: Path) -> None:
    from compensator.cli import main

    Service(tmp_path / "rec").run(20).stop()
    model, out = tmp_path / "other.toml", tmp_path / "both.csv"
    model.write_bytes(other_model())
    assert main(["replay", str(tmp_path / "rec"), "--model", str(model), "--out", str(out)]) == 0
    with out.open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 20 and tuple(table[0]) == COLUMNS
    assert table[0]["time_utc"] == "2026-01-05T06:00:00Z" and float(table[5]["other_y_offset_um"])
