"""Settings of the sources: what is accepted, and one line for what is not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from compensator.cli import main
from compensator.errors import ConfigError
from compensator.probes.settings import load_probes

EXAMPLE = Path(__file__).resolve().parents[2] / "deploy/probes/probes.example.toml"
GOOD = """
[probes]
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:7447"]
send_within_s = 900.0
state_file = "probes-state.json"
[[folder]]
path = "in"
sign = 1
sign_checked = "2026-03-02, two offsets, J. Novak"
[[dprnt]]
address = "192.168.214.10:5062"
sign = -1
sign_checked = "2026-03-02, two offsets, J. Novak"
[[dprnt]]
port = "/dev/ttyUSB0"
bits = "7E"
sign = 1
sign_checked = "2026-03-02, two offsets, J. Novak"
[[linuxcnc]]
file = "bore.txt"
feature = "bore"
nominal = 50.0
unit = "mm"
sign = -1
includes_offset = true
sign_checked = "2026-03-02, two offsets, J. Novak"
"""


def test_all_sources_with_absolute_paths(tmp_path: Path) -> None:
    path = tmp_path / "probes.toml"
    path.write_text(GOOD)
    settings = load_probes(path)
    assert settings.folders[0].path == str(tmp_path / "in")
    assert settings.service.state_file == str(tmp_path / "probes-state.json") and settings.service.applied_file == ""
    assert [dprnt.name for dprnt in settings.dprnt] == ["192.168.214.10:5062", "/dev/ttyUSB0"]
    assert settings.linuxcnc[0].file == str(tmp_path / "bore.txt") and settings.linuxcnc[0].includes_offset


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("[probes]", "[probe]", "probes: missing"),
        ("[[folder]]", "[[folders]]", "folders: unknown table"),
        ("[[folder]]", "[folder]", "folder: expected tables [[folder]]"),
        ("send_within_s = 900.0", "", "probes.send_within_s: missing"),
        ("send_within_s = 900.0", "send_within_s = 1e6", "probes.send_within_s = 1000000.0: expected 10 to 86400"),
        ("send_within_s", "send_in_s", "probes.send_in_s: unknown key"),
        ("connect =", "connects =", "probes.connects: unknown key"),
        ('connect = ["tcp/127.0.0.1:7447"]', "", "probes.connect = []: expected addresses"),
        ('state_file = "probes-state.json"', "", "probes.state_file: missing"),
        ('"probes-state.json"', '"probes.toml"', "probes.toml': is the file with these settings, expected a file"),
        ('path = "in"', "", "folder.path: missing"),
        ('path = "in"', 'path = "in"\npattern = "a/*.csv"', "folder.pattern"),
        ('path = "in"', 'path = "in"\npattern = "**.csv"', "folder.pattern"),
        ('path = "in"', 'path = "in"\npattern = "."', "folder.pattern"),
        ("sign = 1\nsign_checked", "sign_checked", "missing; determine the sign on this machine by probing"),
        ("sign = -1\nsign_checked", "sign_checked", "dprnt.sign: missing; determine the sign"),
        ("sign = -1\nsign_checked", "sign = -2\nsign_checked", "dprnt.sign = -2: expected 1 or -1"),
        ('"2026-03-02, two offsets, J. Novak"', '" "', "folder.sign_checked = ' ': expected who"),
        (
            '"2026-03-02, two offsets, J. Novak"',
            '"date, who, how"',
            "folder.sign_checked = 'date, who, how': expected who",
        ),
        ('address = "192.168.214.10:5062"', "", "dprnt.address = '': expected either address or port"),
        (':5062"', '"', "dprnt.address = '192.168.214.10': expected HOST:PORT"),
        (':5062"', ':99999"', "expected HOST:PORT"),
        ('bits = "7E"', 'bits = "7O"', "dprnt.bits = '7O': expected 8N or 7E"),
        ('bits = "7E"', 'zone = "Mars/Base"', "dprnt.zone = 'Mars/Base': expected a time zone"),
        ('bits = "7E"', "clock_tolerance_s = 3600.0", "dprnt.clock_tolerance_s = 3600.0: expected 1 to 60"),
        ('unit = "mm"', 'unit = "um"', "linuxcnc.unit = 'um': expected one of mm, inch"),
        ("includes_offset = true", "", "linuxcnc.includes_offset: missing"),
        ('feature = "bore"', 'feature = ""', "linuxcnc.feature = '': expected a name"),
        ("nominal = 50.0", "", "linuxcnc.nominal: missing"),
    ],
)
def test_it_does_not_start_like_this(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, expected: str
) -> None:
    path = tmp_path / "probes.toml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new, 1))
    assert main(["bridge", "probes", "--config", str(path), "--check"]) == 2
    error = capsys.readouterr().err
    assert expected in error and str(path) in error and error.count("\n") == 1


@pytest.mark.parametrize(("old", "new"), [('"shop/vmc-07"', '"shop/**"'), ('"tcp/127.0.0.1:7447"', '"127.0.0.1"')])
def test_what_zenoh_does_not_take_is_an_error_of_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str
) -> None:
    path = tmp_path / "probes.toml"
    path.write_text(GOOD.replace(old, new))
    assert main(["bridge", "probes", "--config", str(path), "--check"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_check_opens_nothing_and_names_the_sources(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "probes.toml"
    path.write_text(GOOD)
    assert main(["bridge", "probes", "--config", str(path), "--check", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["prefix"] == "shop/vmc-07" and len(answer["sources"]) == 4
    assert list(tmp_path.iterdir()) == [path]


def test_check_warns_of_sources_that_may_have_no_offset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "probes.toml"
    path.write_text(GOOD)
    assert main(["bridge", "probes", "--config", str(path), "--check"]) == 0
    said = capsys.readouterr().err
    assert (
        said.count("[no_offset_source]") == 4 and "bore.txt: no probes.applied_file: its lines have no offset" in said
    )
    path.write_text(GOOD.replace("send_within_s", 'applied_file = "applied.txt"\nsend_within_s'))
    assert main(["bridge", "probes", "--config", str(path), "--check"]) == 0
    assert "no_offset_source" not in capsys.readouterr().err


def test_the_example_can_be_loaded_once_its_signs_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="sign_checked = 'date, who, how'"):
        load_probes(EXAMPLE)
    path = tmp_path / "probes.toml"
    path.write_text(EXAMPLE.read_text(encoding="utf-8").replace("date, who, how", "2026-03-02, two offsets, J. Novak"))
    settings = load_probes(path)
    assert settings.folders and settings.dprnt and settings.linuxcnc
