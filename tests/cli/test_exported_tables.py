"""A recording as a table is DATA like the recording itself: what was measured, nothing that the service made of it."""

from pathlib import Path

import numpy as np
import pytest

from compensator.cli import main
from compensator.tables import EXPORTED, load_data
from tests.audit.made import Service, other_model


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    service = Service(tmp_path_factory.mktemp("made") / "rec", model=other_model())
    service.run(30).stop()
    return next(service.folder.glob("*.mcap"))


def test_an_exported_recording_holds_the_same_measurements(recording: Path, tmp_path: Path) -> None:
    table = tmp_path / "day.csv"
    assert main(["export", str(recording), "--out", str(table)]) == 0
    assert set(EXPORTED) < set(table.read_text(encoding="utf-8").splitlines()[0].split(","))
    (wanted,), (found,) = (load_data(path, 60.0).records for path in (recording, table))
    assert wanted.columns.keys() == found.columns.keys() and "heat_w" not in found.columns
    for name, values in wanted.columns.items():
        np.testing.assert_array_equal(found.columns[name], values)
    assert [one.code for one in load_data(table, 60.0).remarks] == ["estimates_left_out"]


def test_a_heat_that_was_measured_is_the_known_heat(tmp_path: Path) -> None:
    table = tmp_path / "day.csv"
    head = "t_s,t_q_degc,at_degc,heat_measured_w,heat_w,y_pred_um,y_offset_um"
    table.write_text(f"{head}\n0,20,20,80,79.2,0,0\n60,21,20,81,79.9,1,-1\n")
    assert load_data(table, 60.0).records[0].columns["heat_w"].tolist() == [80.0, 81.0]
