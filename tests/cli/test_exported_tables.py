"""A recording as a table is DATA like the recording itself: what was measured, nothing that the service made of it."""

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from compensator.cli import main
from compensator.config import parse_config
from compensator.data.measurement import read
from compensator.data.table import EXPORTED, is_taken
from compensator.recording.reading import read_messages
from tests.audit.made import CONFIG as MADE
from tests.audit.made import MACHINE, Service, other_model


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    service = Service(tmp_path_factory.mktemp("made") / "rec", model=other_model())
    service.run(30).stop()
    return next(service.folder.glob("*.mcap"))


def test_an_exported_recording_holds_the_same_measurements(recording: Path, tmp_path: Path) -> None:
    table = tmp_path / "day.csv"
    assert main(["export", str(recording), "--out", str(table)]) == 0
    assert set(EXPORTED) < set(table.read_text(encoding="utf-8").splitlines()[0].split(","))
    (wanted,), (found,) = (read(path).at_period(60.0).records for path in (recording, table))
    assert wanted.columns.keys() == found.columns.keys() and "heat_w" not in found.columns
    for name, values in wanted.columns.items():
        np.testing.assert_array_equal(found.columns[name], values)
    assert [one.code for one in read(table).at_period(60.0).remarks] == ["estimates_left_out"]


def test_every_column_that_is_no_channel_is_refused_as_the_name_of_one(recording: Path, tmp_path: Path) -> None:
    table = tmp_path / "day.csv"
    assert main(["export", str(recording), "--out", str(table)]) == 0
    columns = set(table.read_text(encoding="utf-8").splitlines()[0].split(","))
    channels = {channel.name for channel in parse_config(MADE, source="test").channel}
    assert channels < columns and not [name for name in channels if is_taken(name, channels)]
    # A channel `heat_w` is the measured heat, which has a column of its own.
    assert {name for name in columns - channels if not is_taken(name, channels)} == {"heat_w"}


def test_a_heat_that_was_measured_is_the_known_heat(tmp_path: Path) -> None:
    table = tmp_path / "day.csv"
    head = "t_s,t_q_degc,at_degc,heat_measured_w,heat_w,y_pred_um,y_offset_um"
    table.write_text(f"{head}\n0,20,20,80,79.2,0,0\n60,21,20,81,79.9,1,-1\n")
    assert read(table).at_period(60.0).records[0].columns["heat_w"].tolist() == [80.0, 81.0]


def test_several_recordings_are_one_table_in_the_order_of_their_samples(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Service(tmp_path / "rec").run(20).stop()
    Service(tmp_path / "rec", seq=20).run(10).stop()
    first, second = sorted((tmp_path / "rec").glob("*.mcap"))
    out = tmp_path / "both.csv"
    assert main(["export", str(second), str(first), "--out", str(out)]) == 0
    rows = [line.split(",") for line in out.read_text(encoding="utf-8").splitlines()]
    t_s, seq = (rows[0].index(name) for name in ("t_s", "seq"))
    assert [float(row[t_s]) for row in rows[1:]] == [60.0 * i for i in range(30)]
    numbers = [int(row[seq]) for row in rows[1:]]
    assert numbers == list(range(numbers[0], numbers[0] + 30))
    capsys.readouterr()
    for words, expected in (
        ([first, first], "no samples in it that the files before it have not"),
        ([first, other_machine(second, tmp_path / "other.mcap")], "expected recordings of one machine"),
        ([second, tmp_path / "other.mcap"], "expected recordings of one machine"),  # with the same numbers
    ):
        assert main(["export", *map(str, words), "--out", str(tmp_path / "none.csv")]) == 2
        assert expected in capsys.readouterr().err and not (tmp_path / "none.csv").exists()


def other_machine(recording: Path, path: Path) -> Path:
    """The samples of a recording, as another machine's."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/sample", "json", 0)
        for record in read_messages(recording, ("sample",)):
            data = record.data.replace(MACHINE.encode(), b"vmc-99")
            writer.add_message(channel, 0, data, 0)
        writer.finish()
    return path
