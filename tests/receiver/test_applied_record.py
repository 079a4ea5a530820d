"""The record of the applied offset: what it shows at a time, and that it shows nothing where nothing is known."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from compensator.receiver import applied_record
from compensator.receiver.applied_record import EVERY_S, GAP_S, AppliedRecord, applied_at
from compensator.receiver.settings import write_file

S = 1_000_000_000


def recorded(path: Path, values: list[tuple[float, float | None]]) -> AppliedRecord:
    record = AppliedRecord(path)
    for at_s, offset_um in values:
        record.append(round(at_s * S), offset_um)
    return record


def at(path: Path, at_s: float) -> float | None:
    return applied_at(path, round(at_s * S))


def test_between_two_values(tmp_path: Path) -> None:
    path = tmp_path / "applied.txt"
    recorded(path, [(100, 1.0), (102, 1.0), (104, 3.0)])
    assert at(path, 101) == 1.0 and at(path, 103) == pytest.approx(2.0) and at(path, 104) == 3.0
    assert at(path, 99.9) is None


def test_after_the_last_value_for_a_moment(tmp_path: Path) -> None:
    path = tmp_path / "applied.txt"
    recorded(path, [(100, 1.0)])
    assert at(path, 100 + 2 * EVERY_S) == 1.0 and at(path, 100.1 + 2 * EVERY_S) is None


def test_a_gap_and_an_unknown_offset_are_not_bridged(tmp_path: Path) -> None:
    path = tmp_path / "applied.txt"
    recorded(path, [(100, 1.0), (101 + GAP_S, 1.0), (200, 5.0), (201, None), (203, 5.0)])
    assert at(path, 100 + GAP_S / 2) is None and at(path, 150) is None
    assert at(path, 200.5) == 5.0 and at(path, 202) is None and at(path, 203) == 5.0
    assert at(path, 100.5) == 1.0


def test_little_is_written_and_no_change_is_missed(tmp_path: Path) -> None:
    path = tmp_path / "applied.txt"
    ramp = [(100 + step / 100, 0.13 * step / 100) for step in range(60_00)]  # 8 µm/min, 100 calls a second
    recorded(path, ramp)
    lines = path.read_text().splitlines()
    assert 200 < len(lines) < 600
    for at_s, offset_um in ramp[::97]:
        found = at(path, at_s)
        assert found is not None and found == pytest.approx(offset_um, abs=0.03)
    recorded(tmp_path / "still.txt", [(step / 100, 1.0) for step in range(60_00)])
    assert len((tmp_path / "still.txt").read_text().splitlines()) <= 60 / EVERY_S + 1


def test_damage_and_other_content(tmp_path: Path) -> None:
    path = tmp_path / "applied.txt"
    recorded(path, [(100, 1.0), (102, 2.0)])
    with path.open("ab") as file:
        file.write(b"\x00\xff\n103000000000 nan\n103000000000\n104000000000 2.")  # a power cut in the line
    assert at(path, 101) == pytest.approx(1.5) and at(path, 104) == 2.0
    assert at(tmp_path / "none.txt", 100) is None


def test_it_stays_small_and_keeps_what_was_just_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(applied_record, "LONGEST", 500)
    path = tmp_path / "applied.txt"
    record = AppliedRecord(path)
    for step in range(200):
        record.append(step * S, float(step))
        assert path.stat().st_size < 600 and at(path, step - 1) == (step - 1 if step else None)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_clock_set_back(tmp_path: Path) -> None:
    path = tmp_path / "applied.txt"
    recorded(path, [(100, 1.0), (102, 1.0), (50, 7.0), (52, 7.0)])
    assert at(path, 51) == 7.0


def test_after_a_clock_set_back_no_value_is_mixed_of_two_clocks(tmp_path: Path) -> None:
    path = tmp_path / "applied.txt"
    record = recorded(path, [(second, 0.0) for second in range(100, 140, 2)])
    for at_s in (121, 123, 125):
        record.append(at_s * S, 50.0)
    assert [at(path, tenth / 10) for tenth in range(1210, 1251)] == [50.0] * 41
    assert at(path, 120.5) is None  # 0 by the one clock, unknown by the other
    assert at(path, 119) == 0.0 and at(path, 135) is None


def test_a_pipe_in_the_place_of_the_file_never_blocks_the_loop_of_the_control(tmp_path: Path) -> None:
    os.mkfifo(path := tmp_path / "applied.txt")
    caller = threading.Thread(target=lambda: refused.append(tries(path)), daemon=True)
    refused: list[bool] = []
    caller.start()
    caller.join(5.0)
    try:
        assert refused == [True]
        os.mkfifo(part := tmp_path / "state.json.part")
        with pytest.raises(OSError):
            write_file(part, "{}")
        with pytest.raises(OSError, match="not a regular file"):
            write_file(Path("/dev/null"), "{}")
    finally:
        os.close(os.open(path, os.O_RDWR))  # where it waits for a reader, it has one now


def tries(path: Path) -> bool:
    try:
        AppliedRecord(path).append(S, 1.0)
    except OSError:
        return True
    return False
