"""The PROBEOPEN file, without LinuxCNC: which lines are new, and of which time."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from compensator.probes.linuxcnc import ProbeFile
from compensator.probes.probe import Probe
from compensator.probes.settings import LinuxCnc

T0_NS = 1_772_445_600_000_000_000


def line(y: float) -> str:
    return f"1.000000 {y:.6f} -5.000000 0.000000 0.000000 0.000000 0.000000 0.000000 0.000000\n"


class Bench:
    def __init__(self, tmp_path: Path, applied_um: float | None = -8.0, **changes: object) -> None:
        self.path = tmp_path / "bore.txt"
        self.settings = replace(
            LinuxCnc(
                file=str(self.path),
                feature="bore",
                nominal=50.0,
                unit="mm",
                sign=-1,
                sign_checked="two offsets",
                includes_offset=True,
            ),
            **changes,  # type: ignore[arg-type]
        )
        self.now_s = 0.0
        self.applied_um = applied_um
        self.probes: list[Probe] = []
        self.reports: list[str] = []
        self.restart()

    def restart(self) -> None:
        self.file = ProbeFile(
            self.settings,
            self.probes.append,
            lambda _: self.applied_um,
            self.reports.append,
            clock=lambda: self.now_s,
            utc_ns=lambda: T0_NS + round(self.now_s * 1e9),
        )
        self.file.poll()

    def write(self, text: str, mode: str = "w", passed_s: float = 0.1) -> None:
        with self.path.open(mode) as file:
            file.write(text)
        at_ns = T0_NS + round(self.now_s * 1e9)
        os.utime(self.path, ns=(at_ns, at_ns))
        self.now_s += passed_s
        self.file.poll()


def test_a_line_becomes_a_probe_of_the_time_of_its_write(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write("")
    bench.now_s += 1.0
    bench.file.poll()
    written_ns = T0_NS + round(bench.now_s * 1e9)
    bench.write(line(49.99), passed_s=0.3)
    assert bench.probes == [
        Probe(
            time_utc_ns=written_ns, measured_um=pytest.approx(2.0), offset_applied_um=-8.0, feature="bore", tool=""
        )  # displaced by 10 µm, offset −8
    ]
    assert not bench.reports


def test_appended_opened_anew_and_the_same_again(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write("")
    bench.write(line(50.001))
    bench.write(line(50.002), "a")
    bench.write("")
    bench.write(line(50.002))  # the same value after it was opened anew: a probe
    bench.write("")
    bench.write(line(50.003))
    assert [round(probe.measured_um + 8.0, 3) for probe in bench.probes] == [-1.0, -2.0, -2.0, -3.0]
    os.utime(bench.path)
    bench.file.poll()
    bench.write(line(50.003))  # the same file again: no probe
    assert len(bench.probes) == 4


@pytest.mark.parametrize("first", ["", line(50.002)[:30]])
def test_a_file_that_was_edited_has_lines_of_any_time(tmp_path: Path, first: str) -> None:
    bench = Bench(tmp_path)
    bench.write("")
    bench.write(line(50.001))
    bench.write(line(50.002), "a")
    if first:  # seen while it is written
        bench.write(first)
    bench.write(line(50.002))
    assert len(bench.probes) == 2 and ["[line_age_unknown]" in report for report in bench.reports] == [True]
    bench.write(line(50.003), "a")
    assert len(bench.probes) == 3 and len(bench.reports) == 1
    bench.path.unlink()
    bench.file.poll()
    bench.write("")
    bench.write(line(50.004))
    assert len(bench.probes) == 4 and len(bench.reports) == 1


def test_a_file_that_was_put_there_has_lines_of_any_time(tmp_path: Path) -> None:
    """A copy has the time of now; whoever touches sees LinuxCNC's empty file first."""
    bench = Bench(tmp_path)
    bench.write(line(50.001))
    bench.path.unlink()
    bench.file.poll()
    bench.write(line(50.002))
    assert not bench.probes and ["[line_age_unknown]" in report for report in bench.reports] == [True, True]


@pytest.mark.parametrize("mode", ["w", "a"])
def test_several_lines_at_once_are_of_any_time(tmp_path: Path, mode: str) -> None:
    bench = Bench(tmp_path)
    bench.write("")
    bench.write(line(50.001))
    if mode == "w":
        bench.write("")
    bench.write(line(50.002) + line(50.003), mode)
    assert len(bench.probes) == 1 and ["[line_age_unknown]" in report for report in bench.reports] == [True, True]


def test_half_a_line_waits(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write("")
    bench.write(line(50.001)[:30])
    assert not bench.probes
    bench.write(line(50.001)[30:], "a")
    assert len(bench.probes) == 1


def test_what_is_there_at_the_start_or_after_a_pause_is_refused(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.write("")
    bench.write(line(50.001))
    bench.restart()
    assert len(bench.probes) == 1 and "[line_age_unknown]" in bench.reports[0]
    bench.write(line(50.002), "a", passed_s=10.0)
    bench.write(line(50.003), "a")
    assert len(bench.probes) == 2 and "[line_age_unknown]" in bench.reports[1]


@pytest.mark.parametrize("written_s", [-60.0, 60.0])
def test_a_file_of_another_time_is_refused(tmp_path: Path, written_s: float) -> None:
    bench = Bench(tmp_path)
    bench.path.write_text(line(50.001))  # copied here with its time, for instance
    at_ns = T0_NS + round(written_s * 1e9)
    os.utime(bench.path, ns=(at_ns, at_ns))
    bench.now_s += 0.1
    bench.file.poll()
    assert not bench.probes and "[line_age_unknown]" in bench.reports[0]


@pytest.mark.parametrize("text", ["", "1 2 3", "x " * 9, "nan " * 9, line(50.0).replace("50.0", "50,0"), line(60.0)])
def test_what_is_no_probe_of_this_feature_is_refused(tmp_path: Path, text: str) -> None:
    bench = Bench(tmp_path)
    bench.write(text.rstrip("\n") + "\n")
    assert not bench.probes and "[line_broken]" in bench.reports[0]


def test_without_a_record_of_the_offset_nothing_is_sent(tmp_path: Path) -> None:
    bench = Bench(tmp_path, applied_um=None)
    bench.write("")
    bench.write(line(50.001))
    assert not bench.probes and "[line_offset_unknown]" in bench.reports[0]


def test_inches(tmp_path: Path) -> None:
    bench = Bench(tmp_path, unit="inch", nominal=2.0)
    bench.write("")
    bench.write(line(2.001))
    assert bench.probes[0].measured_um == pytest.approx(-25.4 - 8.0)


def test_no_content_ends_the_reading(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.path.write_bytes(bytes(range(256)) * 50)
    bench.file.poll()
    bench.path.write_bytes(b"\n" * 2_000_000)
    bench.file.poll()
    bench.path.unlink()
    bench.path.mkdir()
    bench.file.poll()
    bench.path.rmdir()
    bench.file.poll()
    bench.write("")
    bench.write(line(50.001))
    assert len(bench.probes) == 1


def test_the_shipped_cycle_does_not_start_the_spindle_with_the_probe_in_it() -> None:
    """M72 restores the spindle that M70 has saved, so it is stopped before."""
    shipped = Path(__file__).resolve().parents[2] / "deploy/linuxcnc/thermal_probe.ngc"
    blocks = re.sub(r"\([^)]*\)", "", shipped.read_text(encoding="utf-8")).split()
    assert blocks.index("M5") < blocks.index("M70") < blocks.index("M72")
    assert not {"M3", "M4"} & set(blocks)
