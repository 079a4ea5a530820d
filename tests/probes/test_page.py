"""The page for users: its macros print on simulated controls what the bridge reads, its examples are read."""

from __future__ import annotations

import datetime
import re
import subprocess
from pathlib import Path

import pytest

from compensator.codes import ProbeSourceRemark
from compensator.probes.dprnt import CHECK_UM, parse
from compensator.probes.settings import load_probes
from compensator.probes.table import COLUMNS, columns, row
from sim_hardware.wire.printing import Maker, formatted

PAGE = Path(__file__).resolve().parents[2] / "deploy/probes/README.md"
TEXT = PAGE.read_text(encoding="utf-8")
MACROS = dict(re.findall(r"<!-- macro (\w+) -->\n```\n(.*?)```", TEXT, flags=re.DOTALL))


@pytest.mark.parametrize("maker", ["fanuc", "fanuc-no-blanks", "haas", "mitsubishi"])
@pytest.mark.parametrize("reading_mm", [0.0032, -0.0123, 0.0, 0.5])
def test_each_makers_macro_prints_a_line_that_is_read(maker: Maker, reading_mm: float) -> None:
    macro = MACROS[maker.partition("-")[0]]
    (block,) = re.findall(r"DPRNT\[(.*)\]\n", macro)
    assert macro.index("POPEN") < macro.index("DPRNT") < macro.index("PCLOS")
    assert re.search(r"IF ?\[#1 ?EQ ?#0\] ?GOTO99", macro) and "N99" in macro  # a vacant reading prints nothing
    date = 260302.0 if maker == "haas" else 20260302.0
    um = reading_mm * 1000.0
    found = parse(formatted(maker, block, {101: um, 102: -um, 9: 1.0, 20: 99.0, 3011: date, 3012: 505.0}))
    assert found is not None
    assert found.reading_um == pytest.approx(um) and (found.feature, found.tool) == ("1", "99")
    assert found.printed_at == datetime.datetime(2026, 3, 2, 0, 5, 5)
    with_offset = block.replace("*F#9", "*OMM#103[35]*F#9")
    line = formatted(maker, with_offset, {101: um, 102: -um, 103: -0.0123, 9: 1, 20: 99, 3011: date, 3012: 0})
    found = parse(line)
    assert found is not None and found.offset_um == pytest.approx(-12.3)


@pytest.mark.parametrize("maker", ["fanuc", "fanuc-no-blanks", "haas", "mitsubishi"])
def test_the_line_of_a_calibration_has_the_offset_0(maker: Maker) -> None:
    (block,) = re.findall(r"<!-- macro without offset -->\n```\nDPRNT\[(.*)\]\n```", TEXT)
    found = parse(formatted(maker, block, {101: 3.2, 102: -3.2, 9: 1.0, 20: 99.0, 3011: 20260302.0, 3012: 505.0}))
    assert found is not None and (found.offset_um, found.reading_um) == (0.0, 3.2)


def test_the_check_of_a_line_is_as_sharp_as_the_page_states() -> None:
    (stated,) = re.findall(r"changes the value by more than ([\d.]+) µm", TEXT)
    assert float(stated) == CHECK_UM


def test_the_line_of_the_page_is_read() -> None:
    (line,) = re.findall(r"^TPROBE .*$", TEXT, flags=re.MULTILINE)
    found = parse(line)
    assert found is not None and (found.reading_um, found.offset_um, found.stopped_s) == (3.2, -12.3, 20.0)


def test_the_lines_of_the_table_are_read() -> None:
    header, line = re.findall(r"^(time_utc,.*|2026-.*)$", TEXT, flags=re.MULTILINE)
    names = columns(header)
    assert set(names) == set(COLUMNS) - {"time_utc_ns", "axis"}
    assert row(names, line).measured_um == 3.2


def test_the_shell_writes_a_file_that_is_read(tmp_path: Path) -> None:
    (script,) = re.findall(r"In a shell:\n```\n(.*?)```", TEXT, flags=re.DOTALL)
    script = script.replace("/srv/probes/vmc-07", str(tmp_path))
    for _ in range(2):
        subprocess.run(["bash", "-euc", script], check=True)
    (file,) = tmp_path.iterdir()
    header, *lines = file.read_text(encoding="utf-8").splitlines()
    assert [row(columns(header), line).feature for line in lines] == ["sphere-1", "sphere-1"]


def test_the_settings_of_the_page_are_valid(tmp_path: Path) -> None:
    (settings,) = re.findall(r"```toml\n(.*?)```", TEXT, flags=re.DOTALL)
    (tmp_path / "probes.toml").write_text(settings, encoding="utf-8")
    assert len(load_probes(tmp_path / "probes.toml").folders) == 1


def test_links_lead_somewhere() -> None:
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", TEXT):
        assert (PAGE.parent / link).exists(), link
    headings = {
        re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.*)$", TEXT, re.MULTILINE)
    }
    assert set(re.findall(r"\]\(#([^)]+)\)", TEXT)) <= headings


def test_every_code_has_words() -> None:
    assert all(code.meaning.endswith(".") and code.action.endswith(".") for code in ProbeSourceRemark)
