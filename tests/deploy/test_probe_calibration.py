"""The guide to a calibration with the touch probe: its commands exist and do what it says, in its words."""

import contextlib
import io
import re

import numpy as np
import pytest

from compensator.cli import _parser, main
from compensator.codes import WORDS
from compensator.config import parse_config
from tests.deploy.conftest import ROOT
from tests.deploy.guide import commands
from tests.deploy.test_guide import refusal
from tests.diagnose.scenarios import record

PAGE = ROOT / "deploy/PROBE_CALIBRATION.md"
TEXT = PAGE.read_text(encoding="utf-8")
LINES = commands(TEXT)


def table(path, seed, hours, every):
    """A run of the published machine with a probe every so many minutes, as the guide's table has it."""
    measured, true, _ = record([], seed, hours)
    y, at = np.full(true.size, np.nan), np.arange(every - 1, true.size, every)
    y[at] = true[at] + np.random.default_rng(seed).normal(0.0, 1.5, at.size)
    rows = zip(np.arange(true.size) * 60.0, measured["t_q_degc"], measured["at_degc"], y, strict=True)
    lines = [",".join("" if np.isnan(v) else f"{v:.3f}" for v in row) for row in rows]
    path.write_text("\n".join(["t_s,t_q_degc,at_degc,y_um", *lines]) + "\n", encoding="utf-8")


@pytest.mark.parametrize("words", LINES, ids=" ".join)
def test_every_command_exists_with_its_options(words):
    assert words[0] == "compensator"
    assert refusal(_parser(), words[1:]) == ""


@pytest.mark.usefixtures("without_pictures")
def test_the_cycle_from_probes_to_a_checked_model(tmp_path, monkeypatch, capsys):
    """The guide's own lines, with tables in the place of the recordings of its days."""
    monkeypatch.chdir(tmp_path)
    for name, seed, hours, every in (("day1", 3, 36.0, 10), ("day3", 8, 24.0, 60), ("day4", 9, 24.0, 60)):
        table(tmp_path / f"{name}.csv", seed, hours, every)
    by_name = {line[1]: [w.replace(".mcap", ".csv") for w in line[1:] if w != "day2.mcap"] for line in LINES}
    assert main([w for w in by_name["identify"] if w not in ("--y-std", "1.5")]) == 2
    asked = capsys.readouterr().err
    quoted = re.search(r"`(y_um has 216 .*?) …`", TEXT)
    assert quoted and quoted[1] in asked
    assert main(by_name["identify"]) == 0
    said = capsys.readouterr().out
    rms = float(re.search(r"On held-out blocks of time, .*?: ([\d.]+) µm rms", said)[1])
    assert 0.9 * 1.5 < rms < 1.2 * 1.5
    assert main(by_name["simulate"]) == 0
    assert "residual_um" in (tmp_path / "corrected.csv").read_text().splitlines()[0]
    capsys.readouterr()
    assert main(by_name["diagnose"]) == 0
    assert "could act without being seen" in capsys.readouterr().out
    assert (tmp_path / "diagnosis" / "model.toml").exists()


def test_codes_and_links_of_the_guide_exist():
    assert {
        "probe_mismatch",
        "quiet_ambient",
        "short_record",
        "drifting_mode",
        "twin_modes",
        "no_offset_source",
    } <= set(WORDS)
    for code in re.findall(r"`([a-z]+_[a-z_]+)`", TEXT):
        known = (
            code in WORDS
            or code.endswith(("_um", "_wanted"))
            or code in ("sign_checked", "includes_offset", "applied_file")
        )
        assert known, code
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", TEXT):
        assert (PAGE.parent / link).exists(), link


def test_the_table_of_the_configuration_is_accepted():
    from tests.service.probed import PROBED

    own = "".join(line[4:] for line in TEXT.splitlines(keepends=True) if line.startswith("    "))
    assert own.startswith("[probe]")
    given = PROBED[: PROBED.index(b"[probe]")] + own.encode()
    config = parse_config(given, source="guide")
    assert config.probe is not None and config.probe.std_um == 1.5
    with pytest.raises(Exception, match="nonsense"):
        parse_config(given + b"nonsense = 1\n", source="guide")


def test_a_wrong_option_would_be_noticed():
    with contextlib.redirect_stderr(io.StringIO()):
        assert refusal(_parser(), ["identify", "a.mcap", "--out", "m.toml", "--y-noise", "1.5"])
