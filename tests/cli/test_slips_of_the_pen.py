"""Slips of the pen on the command line: one line that says what to do, and nothing that was read is written over."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest

from compensator.atomic_write import atomic_write, replace_file
from compensator.cli import main

HEADER = "t_s,t_q_degc,at_degc,y_um,heat_w\n"


def table(path: Path, minutes: int = 200) -> Path:
    rng = np.random.default_rng(0)
    rows = (f"{60 * i},{20 + i % 7 + rng.normal():.4f},{20 + rng.normal():.4f},{i % 5},{i % 2}" for i in range(minutes))
    path.write_text(HEADER + "\n".join(rows) + "\n")
    return path


def refused(capsys: pytest.CaptureFixture[str], words: list[str], *expected: str) -> None:
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    for one in expected:
        assert one in captured.err


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"PK\x03\x04rest", "workbook"),
        (b"\xd0\xcf\x11\xe0rest", "XLS"),
        (b"\x89MCAP0\r\n", "name it FILE.mcap"),
        (HEADER.encode("utf-16"), "UTF-16"),
        (b"\x1f\x8brest", "gzip"),
        (b"\x7fELF\xff", "expected a table"),
        (b"", "empty"),
        (
            b"t_s;t_q_degc;at_degc\n0;20,1;20,1\n60;20.1;20,2\n",
            "row 3: t_q_degc = '20.1' in a table with decimal commas",
        ),
        (
            b"t_s,t_q_degc,at_degc,oil\n" + b"".join(b"%d,2,2,3\n" % i for i in range(0, 900, 60)) + b"960,2,2,#NV\n",
            "row 17: oil = '#NV'",
        ),
        (b"t_s,at_degc,at_degc\n0,1,2\n", "'at_degc' twice"),
        (b"t_s,t_q_degc,at_degc\n0,20,20\n60000,21,20\n120000,21,20\n", "in seconds?"),
    ],
)
def test_a_file_that_is_no_table_says_what_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, expected: str
) -> None:
    (tmp_path / "run.csv").write_bytes(content)
    out = tmp_path / "out.csv"
    refused(capsys, ["simulate", str(tmp_path / "run.csv"), "--model", "quill", "--out", str(out)], "run.csv", expected)
    assert not out.exists()


def test_what_is_read_is_never_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, model = table(tmp_path / "run.csv"), tmp_path / "model.toml"
    model.write_text("the only copy")
    recording = tmp_path / "day.mcap"
    recording.write_bytes(b"evidence")
    there = "would be overwritten"
    refused(capsys, ["simulate", str(run), "--model", "quill", "--out", str(run)], there)
    refused(capsys, ["simulate", str(run), "--model", str(model), "--out", str(model)], there)
    refused(capsys, ["export", str(recording), "--out", str(recording)], there)
    refused(capsys, ["export", str(tmp_path / "other.mcap"), "--out", str(recording)], "expected a name that ends in")
    refused(capsys, ["replay", str(recording), "--model", "quill", "--out", str(recording)], there)
    refused(capsys, ["identify", str(run), "--out", str(run)], there)
    refused(capsys, ["identify", str(recording), "--validate", str(model), "--out", str(model)], there)
    refused(capsys, ["diagnose", str(run), "--model", str(model), "--out", str(tmp_path)], there)
    assert (model.read_text(), recording.read_bytes()) == ("the only copy", b"evidence")
    assert run.read_text().startswith(HEADER)


def test_where_nothing_can_be_written_is_said_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The data is not there either: what is said first shows what was looked at first.
    run, file, folder = str(tmp_path / "absent.csv"), tmp_path / "file", tmp_path / "folder"
    file.write_text("")
    folder.mkdir()
    refused(capsys, ["simulate", run, "--model", "quill", "--out", str(folder)], "is a folder")
    refused(capsys, ["simulate", run, "--model", "quill", "--out", str(file / "o.csv")], "is a file, expected a folder")
    refused(capsys, ["export", run, "--out", str(folder)], "is a folder")
    refused(capsys, ["identify", run, "--out", str(folder)], "is a folder")
    refused(capsys, ["identify", run, "--out", str(tmp_path / "model.csv")], "ends in .toml")
    refused(capsys, ["identify", run, "--out", "quill"], "published model")
    refused(capsys, ["diagnose", run, "--model", "quill", "--out", str(file)], "is a file, expected a folder")


def test_a_command_makes_the_folder_of_its_table(tmp_path: Path) -> None:
    out = tmp_path / "new" / "folder" / "o.csv"
    assert main(["simulate", str(table(tmp_path / "run.csv")), "--model", "quill", "--out", str(out)]) == 0
    assert out.exists()


def test_a_folder_without_permission(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Whoever runs the tests may be allowed everything.
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != tmp_path)
    words = ["simulate", str(tmp_path / "run.csv"), "--model", "quill", "--out", str(tmp_path / "new" / "o.csv")]
    refused(capsys, words, f"no permission to write in {tmp_path}")


def test_data_without_anything_to_work_with_names_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short, out = table(tmp_path / "short.csv", 20), str(tmp_path / "new" / "m.toml")
    refused(capsys, ["identify", str(short), "--out", out], "short.csv: 20 min of data")
    refused(capsys, ["diagnose", str(short), "--model", "quill", "--out", str(tmp_path / "d")], "short.csv: 20 min")
    some = table(tmp_path / "some.csv", 45)
    refused(capsys, ["diagnose", str(some), "--model", "quill", "--out", str(tmp_path / "d")], "some.csv: 45 samples")
    lines = table(tmp_path / "without.csv").read_text().splitlines()
    without = [lines[0], *(",".join([row.split(",")[0], "", *row.split(",")[2:]]) for row in lines[1:])]
    (tmp_path / "without.csv").write_text("\n".join(without))
    refused(capsys, ["identify", str(tmp_path / "without.csv"), "--out", out], "t_q_degc is missing in 200 of 200")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["short.csv", "some.csv", "without.csv"]


@pytest.mark.parametrize("command", ["diagnose", "identify"])
def test_a_dead_sensor_makes_no_finding_and_judges_no_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    run, dead = table(tmp_path / "run.csv"), tmp_path / "dead.csv"
    rows = [row.split(",") for row in run.read_text().splitlines()]
    dead.write_text("\n".join(",".join([row[0], "20.0" if i else row[1], *row[2:]]) for i, row in enumerate(rows)))
    words = {
        "diagnose": ["diagnose", str(dead), "--model", "quill", "--out", str(tmp_path / "d")],
        "identify": ["identify", str(run), "--validate", str(dead), "--out", str(tmp_path / "m.toml")],
    }
    refused(capsys, words[command], "dead.csv: t_q_degc = 20 in every row: a dead sensor")


@pytest.mark.parametrize(
    ("factor", "words"), [("0.0", "y_um = 0 in every row: a dead probe"), ("0.001", "millimetres?")]
)
def test_a_deformation_that_is_none_makes_no_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], factor: str, words: str
) -> None:
    rows = [row.split(",") for row in table(tmp_path / "run.csv").read_text().splitlines()]
    at = rows[0].index("y_um")
    for row in rows[1:]:
        row[at] = str(float(row[at]) * float(factor))
    spoilt = tmp_path / "spoilt.csv"
    spoilt.write_text("\n".join(map(",".join, rows)))
    refused(capsys, ["diagnose", str(spoilt), "--model", "quill", "--out", str(tmp_path / "d")], words)


def test_an_error_of_the_system_is_told_without_its_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / "o.csv"))

    monkeypatch.setattr("compensator.commands.export.export", full)
    assert main(["export", str(tmp_path / "day.mcap"), "--out", str(tmp_path / "o.csv")]) == 1
    assert capsys.readouterr().err == f"compensator: {tmp_path / 'o.csv'}: No space left on device\n"


def test_what_fails_half_way_leaves_no_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, out = tmp_path / "day.mcap", tmp_path / "both.csv"
    recording.write_text("no recording")
    words = ["replay", str(recording), "--model", "quill", "--out", str(out)]
    refused(capsys, words, "day.mcap: not an MCAP file, expected a recording")
    assert [path.name for path in tmp_path.iterdir()] == ["day.mcap"]


def test_simulate_says_where_temperatures_cannot_be_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.csv"

    def run(t_q: str) -> list[str]:
        rows = (f"{60 * i},{t_q.format(20 + i / 10)},20.0" for i in range(90))
        (tmp_path / "run.csv").write_text("t_s,t_q_degc,at_degc\n" + "\n".join(rows) + "\n")
        return ["simulate", str(tmp_path / "run.csv"), "--model", "quill", "--out", str(out)]

    refused(capsys, run("293"), "run.csv: t_q_degc runs from 293.0 to 293.0: kelvin?")
    refused(capsys, run("-9999"), "t_q_degc = -9999, 90 sample(s) like it: a fault's code?")
    assert not out.exists()
    for text, code in (("20.0", "[stuck]"), ("68.{0:.0f}", "[outside_validity]"), ("{0:.2f}", "")):
        assert main(run(text)) == 0
        said = capsys.readouterr().err
        assert said.count("\n") == bool(code) and code in said


def test_what_is_no_file_is_not_written_to_and_a_link_stays_one(tmp_path: Path) -> None:
    """Or `/dev/null`, written to by root, would leave the computer without it, and a pipe would wait for its reader."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="not a regular file"), atomic_write(pipe):
        pytest.fail("nothing is to be computed for it")
    with pytest.raises(OSError, match="not a regular file"):  # the head of a chain, for one
        replace_file(pipe, b"")
    assert stat.S_ISFIFO(pipe.stat().st_mode) and list(tmp_path.iterdir()) == [pipe]
    kept, link = tmp_path / "kept.csv", tmp_path / "link.csv"
    kept.write_text("before\n")
    link.symlink_to(kept)
    with atomic_write(link) as file:
        file.write("after\n")
    assert link.is_symlink() and kept.read_text() == "after\n"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ('at_utc = "2:00"', "loop.at_utc = '2:00': expected such as 02:00 or 14:30"),
        ("record_h = 2", "loop.record_h = 2: expected at least 6 and at most 336"),
        ("every_h = 5", "loop.every_h = 5: expected one of: 4, 6, 8, 12, 24"),
        ('shadow_h = "a day"', "loop.shadow_h = 'a day': Expected `float`, got `str`"),
    ],
)
def test_a_value_that_cannot_be_says_what_can(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], line: str, expected: str
) -> None:
    example = Path(__file__).parents[2] / "deploy/machine.example.toml"
    path = tmp_path / "machine.toml"
    path.write_text(f"{example.read_text(encoding='utf-8')}\n[loop]\n{line}\n", encoding="utf-8")
    refused(capsys, ["check", "--config", str(path)], expected)
