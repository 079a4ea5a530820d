"""A watched folder: each line once, with its own time, whatever is done to the files."""

from __future__ import annotations

import datetime
import json
import os
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.errors import ConfigError
from compensator.probes.folder import READ_AT_ONCE, WatchedFolder
from compensator.probes.handled import Handled
from compensator.probes.probe import Probe
from compensator.probes.sender import Outcome
from compensator.probes.settings import Folder
from compensator.probes.table import BadLine, NoFeature, columns, row
from tests.probes.helpers import touch_um

HEADER = "time_utc,measured_um,offset_applied_um,feature,tool,std_um,stopped_s\n"
T0 = datetime.datetime(2026, 3, 2, 10, 0, tzinfo=datetime.UTC)
T0_NS = int(T0.timestamp()) * 1_000_000_000


def line(minute: float, measured_um: float = 3.2, offset: str = "-12.3") -> str:
    at = T0 + datetime.timedelta(minutes=minute)
    return f"{at:%Y-%m-%dT%H:%M:%S}Z,{measured_um},{offset},sphere-1,probe,1.5,20\n"


class Bench:
    """A folder with what becomes of its lines; `restart` begins anew with what is on disk."""

    def __init__(self, tmp_path: Path, applied_um: float | None = None) -> None:
        self.folder = tmp_path / "in"
        self.folder.mkdir(exist_ok=True)
        self.state = tmp_path / "state.json"
        self.probes: list[Probe] = []
        self.reports: list[str] = []
        self.waiting: list[Callable[[Outcome], None]] = []
        self.answers = True
        self.minute, self.set_by_min = 2.0, 0.0  # of the wall clock, and by how much it was set
        self.applied_um = applied_um
        self.sign, self.includes_offset, self.pattern = 1, False, "*.csv"
        self.restart()

    def restart(self) -> None:
        self.watched = WatchedFolder(
            Folder(
                path=str(self.folder),
                pattern=self.pattern,
                sign=self.sign,
                sign_checked="simulated",
                includes_offset=self.includes_offset,
            ),
            Handled(self.state, 90000.0),
            self._submit,
            lambda _: self.applied_um,
            self.reports.append,
            send_within_s=900.0,
            clock=Mock(utc_ns=lambda: T0_NS + self._ns(), monotonic_ns=lambda: self._ns(-self.set_by_min)),
        )

    def set_clock(self, minute: float) -> None:
        self.set_by_min += minute - self.minute
        self.minute = minute
        self.look()

    def _ns(self, since_min: float = 0.0) -> int:
        return round((self.minute + since_min) * 60e9)

    def _submit(self, probe: Probe, source: str, done: Callable[[Outcome], None]) -> None:
        assert source.endswith(".csv")
        self.probes.append(probe)
        if self.answers:
            done("sent")
        else:
            self.waiting.append(done)

    def write(self, text: str, name: str = "a.csv") -> None:
        (self.folder / name).write_text(text, encoding="utf-8")
        self.look()

    def look(self) -> None:
        for _ in range(3):
            self.watched.poll()

    @property
    def minutes(self) -> list[float]:
        return [(probe.time_utc_ns - T0_NS) / 60e9 for probe in self.probes]


def test_a_line_becomes_a_probe_with_its_own_time(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(1.5))
    assert bench.probes == [
        Probe(
            time_utc_ns=T0_NS + 90_000_000_000,
            measured_um=3.2,
            offset_applied_um=-12.3,
            feature="sphere-1",
            tool="probe",
            std_um=1.5,
            stopped_s=20.0,
        )
    ]
    assert not bench.reports


def test_a_line_ahead_of_the_clock_waits_until_the_clock_is_set(tmp_path: Path) -> None:
    """The service would refuse it as of the future, and what was handled is not sent again."""
    bench = Bench(tmp_path)
    bench.minute = -30.0
    bench.write(HEADER + line(1.0) + line(1.5) + line(2.05) + line(300.0))
    assert not bench.probes and ["[line_ahead]" in report for report in bench.reports] == [True]
    bench.set_clock(2.0)
    bench.look()
    assert bench.minutes == [1.0, 1.5] and len(bench.reports) == 1
    bench.minute = 2.06  # what is a little ahead of the clock that was set is sent when its time comes
    bench.look()
    assert bench.minutes == [1.0, 1.5, 2.05]
    bench.minute = 300.5  # and what is far ahead of it, never
    bench.look()
    bench.write(HEADER + line(1.0) + line(300.0) + line(300.2))
    assert bench.minutes == [1.0, 1.5, 2.05, 300.2]


@pytest.mark.parametrize("restarted", [False, True])
def test_a_line_with_a_wrong_clock_is_not_sent_because_its_time_has_passed(tmp_path: Path, restarted: bool) -> None:
    """It would be a touch of two hours ago that counts as one of now."""
    bench = Bench(tmp_path)
    bench.write(HEADER + line(122.0))
    assert "[line_ahead]" in bench.reports[0]
    if restarted:
        bench.restart()
    bench.minute = 122.5
    bench.write(HEADER + line(122.0) + line(122.2))
    bench.restart()
    bench.look()
    assert bench.minutes == [122.2] and len(bench.reports) == 1


def test_a_file_whose_lines_wait_is_not_read_before_they_are_due(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(300.0))
    read = Mock()
    monkeypatch.setattr("compensator.probes.folder.read_file", read)
    bench.look()
    assert not read.called


def test_a_line_a_little_ahead_is_sent(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(2.05))
    assert bench.minutes == [2.05] and not bench.reports


def test_a_pattern_that_python_does_not_take_is_said_once_and_ends_nothing(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.pattern = "**.csv"
    bench.restart()
    bench.write(HEADER + line(1.5))
    assert not bench.probes and len(bench.reports) == 1 and "[source_lost]" in bench.reports[0]


def test_each_line_once_over_appending_rewriting_copies_and_restarts(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(0))
    bench.write(HEADER + line(0) + line(1))  # rewritten with one more
    bench.write(HEADER + line(1) + line(0))  # sorted otherwise
    bench.write(HEADER + line(0) + line(1), "copy.csv")
    bench.restart()
    bench.look()
    os.utime(bench.folder / "a.csv")
    bench.look()
    bench.write(HEADER + line(0) + line(0) + line(2))
    assert bench.minutes == [0, 1, 2] and not bench.reports


def test_a_file_is_read_when_nothing_is_writing_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    path = bench.folder / "a.csv"
    path.write_text(HEADER + line(0))
    for _ in range(4):  # grows between two looks
        bench.watched.poll()
        path.write_text(path.read_text() + line(1)[:-10])
    assert not bench.probes


def test_half_a_line_waits_for_its_end(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(0) + "2026-03-02T10:01:00Z,3.2,-1")
    assert bench.minutes == [0] and "[line_incomplete]" in bench.reports[0]
    bench.write(HEADER + line(0) + "2026-03-02T10:01:00Z,3.2,-12.3,sphere-1,,,\n")
    assert bench.minutes == [0, 1] and bench.probes[1].offset_applied_um == -12.3 and len(bench.reports) == 1


def test_a_changed_line_is_reported_and_not_sent(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(0))
    for _ in range(2):
        bench.write(HEADER + line(0, measured_um=5.0))
        bench.restart()
        bench.look()
    assert len(bench.probes) == 1 and "[line_changed]" in bench.reports[0]


def test_old_lines_are_counted_and_not_sent(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.minute = 60.0
    bench.write(HEADER + "".join(line(minute) for minute in range(50)))
    assert bench.minutes == [45, 46, 47, 48, 49]
    assert len(bench.reports) == 1 and "45 line(s) older than 15 min" in bench.reports[0]


def test_what_was_not_answered_yet_is_sent_again_after_a_restart_only(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.answers = False
    bench.write(HEADER + line(0))
    bench.write(HEADER + line(0) + line(1))
    assert bench.minutes == [0, 1]
    bench.waiting[0]("sent")
    bench.look()
    bench.restart()
    bench.look()
    assert bench.minutes == [0, 1, 1]


def test_the_offset_from_the_receivers_record(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(0, offset=""))
    assert not bench.probes and "[line_offset_unknown]" in bench.reports[0]
    bench = Bench(tmp_path, applied_um=4.0)
    bench.write(HEADER + line(1, offset=""), "b.csv")
    assert bench.probes[-1].offset_applied_um == 4.0


@pytest.mark.parametrize("includes_offset", [False, True])
def test_the_deformation_comes_out_by_geometry(tmp_path: Path, includes_offset: bool) -> None:
    bench = Bench(tmp_path)
    bench.sign, bench.includes_offset = -1, includes_offset
    bench.restart()
    bench.write(HEADER + line(0, touch_um(y_um=15.0, offset_um=-12.3, includes_offset=includes_offset)))
    assert bench.probes[0].measured_um - bench.probes[0].offset_applied_um == pytest.approx(15.0)


def test_folders_and_files_that_are_not_there(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.folder.rmdir()
    bench.look()
    assert len(bench.reports) == 1 and "[source_lost]" in bench.reports[0]
    bench.folder.mkdir()
    (bench.folder / "sub.csv").mkdir()
    (bench.folder / "gone.csv").symlink_to(tmp_path / "nowhere")
    bench.write(HEADER + line(0))
    assert bench.minutes == [0]


def test_a_state_that_cannot_be_read_stops_the_start(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    for text in ("{", "[]", '{"handled": 3}', '{"handled": {"a": 1}}', '{"handled": {"x": "y"}}', "[" * 100000):
        bench.state.write_text(text)
        with pytest.raises(ConfigError, match=r"state\.json"):
            bench.restart()


def test_the_state_forgets_what_is_too_old_to_be_sent(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(0))
    bench.minute = 60.0 * 48
    bench.write(HEADER + line(60.0 * 48 - 1))
    assert len(json.loads(bench.state.read_text())["handled"]) == 1


@pytest.mark.parametrize(
    ("header", "why"),
    [
        ("time_utc,measured_um,offset_applied_um", "no column feature"),
        ("time_utc,feature", "no column measured_um"),
        ("measured_um,feature", "either a column time_utc"),
        ("time_utc,time_utc_ns,measured_um,feature", "either a column time_utc"),
        ("time_utc,measured_mm,feature", "column 'measured_mm', expected"),
        ("time_utc;measured_um;feature", "expected some of"),
        ("time_utc,measured_um,measured_um,feature", "occurs twice"),
    ],
)
def test_a_header_that_is_not_understood_is_refused_whole(tmp_path: Path, header: str, why: str) -> None:
    bench = Bench(tmp_path)
    bench.write(f"{header}\n{line(0)}")
    assert not bench.probes and why in bench.reports[0] and len(bench.reports) == 1


NAMES = columns("\ufefftime_utc, axis,measured_um,offset_applied_um,std_um,feature,tool,stopped_s")
GOOD = "2026-03-02T10:00:00Z,y,3.2,-12.3,1.5,sphere-1,probe,20"


def test_an_axis_that_is_not_given_is_y() -> None:
    assert row(NAMES, GOOD.replace(",y,", ",,")) == row(NAMES, GOOD)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (",20", "", "7 values, expected 8"),
        (",20", ",20,", "9 values, expected 8"),
        ("3.2", "", "measured_um is empty"),
        ("3.2", "nan", "expected a number"),
        ("3.2", "inf", "expected a number"),
        ("3.2", "1_0", "expected a number"),
        ("3.2", '"3,2"', "expected a number"),
        ("3.2", "99999", "expected a number from -10000 to 10000"),
        ("1.5", "0", "std_um"),
        ("1.5", "-1", "std_um"),
        (",20", ",-1", "stopped_s"),
        (",y,", ",z,", "axis = 'z'"),
        ("sphere-1", "", "feature is empty"),
        ("sphere-1", "a\x07", "printable"),
        ("sphere-1", "a" * 65, "at most 64"),
        ("10:00:00Z", "10:00:00", "no zone"),
        ("10:00:00Z", "25:00:00Z", "time_utc"),
        ("2026", "1926", "after 1970"),
        ("2026-03-02T10:00:00Z", "0001-01-01T00:00:00+23:59", "after 1970"),
        ("2026-03-02T10:00:00Z", "", "time_utc"),
        ("2026-03-02T10:00:00Z", "2262-04-11T23:47:16.854776Z", "at most 2262"),
    ],
)
def test_a_value_that_cannot_be_used(old: str, new: str, why: str) -> None:
    assert row(NAMES, GOOD).time_utc_ns == T0_NS and old in GOOD
    with pytest.raises(BadLine, match=why):
        row(NAMES, GOOD.replace(old, new, 1))


def test_a_file_without_a_header_row_is_told_apart_from_a_wrong_column() -> None:
    with pytest.raises(BadLine, match="no header row"):
        columns(GOOD)
    with pytest.raises(BadLine, match="column 'measured_mm'"):
        columns(HEADER.replace("measured_um", "measured_mm"))
    with pytest.raises(NoFeature):
        row(NAMES, GOOD.replace("sphere-1", ""))


@pytest.mark.parametrize("digits", ["0" * 19 + "1" + "9" * 4400, "0" + "1763680000000000000" + "99999", "9" * 19, "0"])
def test_a_time_of_too_many_digits_is_refused_in_one_line(tmp_path: Path, digits: str) -> None:
    bench = Bench(tmp_path)
    bench.write(f"time_utc_ns,measured_um,offset_applied_um,feature\n{digits},1,0,a\n{T0_NS},1,0,a\n")
    assert bench.minutes == [0] and len(bench.reports) == 1
    assert "[row_broken]" in bench.reports[0] and len(bench.reports[0]) < 500 and "\n" not in bench.reports[0]


def test_the_name_of_a_file_writes_no_line_of_its_own(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write("none", "a\n\x1b[2Jb.csv")
    assert len(bench.reports) == 1 and bench.reports[0].isprintable() and r"a\n\x1b[2Jb.csv" in bench.reports[0]


def test_a_mistyped_year_is_refused_once_and_ends_nothing(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write(HEADER + line(0).replace("2026", "3026") + line(1))
    bench.restart()
    bench.look()
    assert bench.minutes == [1] and "[row_broken]" in bench.reports[0]
    assert bench.reports == bench.reports[:1] * 2  # once each start
    assert list(json.loads(bench.state.read_text())["handled"]) == [f"{T0_NS + 60 * 10**9} sphere-1"]


def test_no_line_makes_the_state_unreadable(tmp_path: Path) -> None:
    handled = Handled(tmp_path / "state.json", 900.0)
    good = row(NAMES, GOOD)
    handled.add(good)
    handled.add(good._replace(time_utc_ns=10**19))
    handled.write(T0_NS)
    again = Handled(tmp_path / "state.json", 900.0)
    assert again.values(good.identity) == good.values


def test_a_long_file_is_read_as_there_is_room_and_the_state_written_once_a_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writes: list[int] = []
    write = Handled.write

    def counted(handled: Handled, now_utc_ns: int) -> None:
        writes.append(handled._changed)
        write(handled, now_utc_ns)

    monkeypatch.setattr(Handled, "write", counted)
    bench = Bench(tmp_path)
    room, bench.minute = [100], 120.0
    monkeypatch.setattr(bench.watched, "_send_within_ns", 7200 * 10**9)
    monkeypatch.setattr(bench.watched, "_has_room", lambda: len(bench.probes) < room[0])
    (bench.folder / "a.csv").write_text(HEADER + "".join(line(k / 1000.0) for k in range(0, 120000, 60)))
    bench.look()
    assert len(bench.probes) == 100 and sum(writes) == 1
    room[0] = 10**6
    before = len(bench.probes)
    assert bench.watched.poll() and len(bench.probes) - before <= READ_AT_ONCE
    while bench.watched.read_on():
        pass
    assert len(bench.probes) == 2000 and len(set(bench.minutes)) == 2000 and not bench.reports
    bench.watched.keep()
    bench.restart()
    bench.look()
    assert len(bench.probes) == 2000


@settings(max_examples=100, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=80), st.just(line(0).encode()), st.just(HEADER.encode())), max_size=6))
def test_no_content_ends_the_watching(pieces: list[bytes]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        (bench.folder / "a.csv").write_bytes(b"".join(pieces))
        bench.look()
        assert {probe.measured_um for probe in bench.probes} <= {3.2}
        bench.write(HEADER + line(1), "b.csv")
        assert bench.minutes[-1] == 1
