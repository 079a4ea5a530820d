"""What a command reads is never written over, whatever it is called; pages replace pages and nothing else."""

from __future__ import annotations

import argparse
import fcntl
import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from compensator.cli import main
from compensator.commands.catalog import COMMANDS
from compensator.commands.outputs import Reads, Writes
from compensator.report.formats import check_replaced, write
from compensator.report.page import Page

#: Options and arguments with a value that names no file.
NO_FILES = {
    *("--column", "--axis", "--name", "--machine", "--prefix", "code"),
    *("--scheduler", "--connect", "--bind", "--foxglove-origin"),
}
#: What each command reads and writes; OUT is to be a name of IN.
CALLS = [
    "simulate IN --model quill --out OUT.csv",
    "simulate run.csv --model IN --out OUT.csv",
    "compare IN --model quill --out OUT.csv",
    "compare run.csv --model IN --page OUT.html",
    "compare run.csv IN --model quill --model m.toml --page OUT.png",
    "identify IN --out OUT.toml",
    "identify run.csv --etve IN --out OUT.toml",
    "identify run.csv --validate IN --out OUT.toml",
    "identify run.csv --reference IN --out OUT.toml",
    "identify run.csv --reference IN --out m.toml --page OUT.html",
    "identify IN --out OUT.toml --page OUT.html",
    "diagnose IN --model quill --out d --page OUT.html",
    "diagnose run.csv --model quill --validate IN --out d --page OUT.html",
    "replay IN --page OUT.html",
    "replay day.mcap --public-key IN --page OUT.html",
    "replay day.mcap --public-key run.csv --head IN --page OUT.html",
    "replay IN --model quill --out OUT.csv",
    "replay day.mcap --model IN --out OUT.csv",
    "report IN --out OUT.html",
    "export IN --out OUT.csv",
]
NAMES: dict[str, Callable[[Path, Path], None]] = {
    "itself": lambda file, name: shutil.copy(file, name),
    "a link": lambda file, name: name.symlink_to(file.name),
    "another name": lambda file, name: name.hardlink_to(file),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Files, none of which is read before the names of what is written have been checked."""
    monkeypatch.chdir(tmp_path)
    for name in ("run.csv", "m.toml", "day.mcap"):
        (tmp_path / name).write_text(f"the only copy of {name}")
    # PDF and PNG are printed.
    browser = tmp_path / "bin" / "chromium"
    browser.parent.mkdir()
    browser.write_text("#!/bin/sh\n")
    browser.chmod(0o755)
    monkeypatch.setenv("PATH", f"{browser.parent}:{os.environ['PATH']}")
    return tmp_path


def there() -> dict[Path, tuple[int, int]]:
    """Every file with what changes when it is written or replaced."""
    return {path: (path.lstat().st_ino, path.lstat().st_mtime_ns) for path in Path.cwd().rglob("*")}


def refused(capsys: pytest.CaptureFixture[str], words: list[str], *expected: str) -> None:
    before = there()
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1, captured.err
    for one in expected:
        assert one in captured.err
    assert there() == before


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("call", CALLS)
def test_what_is_read_is_not_written_over(
    folder: Path, capsys: pytest.CaptureFixture[str], call: str, name: str
) -> None:
    out = next(word for word in reversed(call.split()) if word.startswith("OUT."))
    given = f"input{out.removeprefix('OUT')}" if name == "itself" else "input.mcap"
    (folder / given).write_text("evidence")
    if name != "itself":
        NAMES[name](folder / given, folder / out)
    words = [given if word == "IN" or (name == "itself" and word == out) else word for word in call.split()]
    refused(capsys, words, "is an input of this command and would be overwritten")
    assert (folder / given).read_text() == "evidence"


@pytest.mark.parametrize("call", ["report . --out z.html", "loop . --page z.html", "export . --out z.csv"])
@pytest.mark.parametrize("place", ["day.mcap", "machine/day.mcap"])
def test_a_recording_in_a_folder_is_not_written_over(
    folder: Path, capsys: pytest.CaptureFixture[str], call: str, place: str
) -> None:
    (folder / place).parent.mkdir(exist_ok=True)
    (folder / place).write_text("evidence")
    (folder / call.split()[-1]).symlink_to(place)
    refused(capsys, call.split(), "is an input of this command and would be overwritten")


@pytest.mark.parametrize(
    ("call", "given"),
    [
        ("identify run.csv --out n.toml --reference n-calibration.html", "n-calibration.html"),
        ("diagnose d/series.csv --model quill --out d", "d/series.csv"),
        ("diagnose d/series-z.csv --model quill --out d", "d/series-z.csv"),
        ("diagnose run.csv --model d/model.toml --out d", "d/model.toml"),
        ("diagnose run.csv --model quill --validate d/diagnosis.json --out d", "d/diagnosis.json"),
    ],
)
def test_names_that_a_command_gives_itself_are_checked_too(
    folder: Path, capsys: pytest.CaptureFixture[str], call: str, given: str
) -> None:
    (folder / given).parent.mkdir(exist_ok=True)
    (folder / given).write_text("evidence")
    refused(capsys, call.split(), f"{given}: is an input of this command and would be overwritten")


@pytest.mark.parametrize(
    ("call", "page"),
    [
        ("compare run.csv --model quill --page z.html", "z.html"),
        ("compare run.csv --model quill --page z.pdf", "z.pdf"),
        ("compare run.csv --model quill --page z.png", "z.png"),
        ("identify run.csv --out n.toml", "n-calibration.html"),
        ("diagnose run.csv --model quill --out d", "d/report.html"),
        ("demo --out d", "d/report.html"),
        ("report day.mcap", "day-report.html"),
        ("report .", "{name}-report.html"),
    ],
)
def test_a_page_replaces_pages_and_nothing_else(
    folder: Path, capsys: pytest.CaptureFixture[str], call: str, page: str
) -> None:
    other = folder / page.format(name=folder.name)
    other.parent.mkdir(exist_ok=True)
    other.write_text('<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Mine</title></head></html>')
    refused(capsys, call.split(), f"{other.name}: exists and is no page of this program, expected another name")


def test_a_page_is_written_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "results").mkdir()
    write(folder / "results" / "report.html", Page(title="day", verdict="good"))
    (folder / "all.html").write_text("")  # as mktemp makes it
    (folder / "linked.html").symlink_to("all.html")
    for out in ("all.html", "all.html", "linked.html"):
        assert main(["report", "results", "--out", out]) == 0
    assert "results" in (folder / "all.html").read_text() and (folder / "linked.html").is_symlink()


@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
@pytest.mark.parametrize("ending", [".html", ".pdf", ".png"])
def test_a_page_says_near_its_beginning_that_it_is_one(tmp_path: Path, ending: str) -> None:
    check_replaced(write(tmp_path / f"page{ending}", Page(title="Größe " * 30, verdict="good")), option="--page")


@pytest.mark.parametrize("name", ["model.toml", "diagnosis.json", "series.csv"])
def test_a_diagnosis_replaces_what_a_diagnosis_wrote(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """A folder of calibrations may have a `model.toml`, which nobody named."""
    (folder / "d").mkdir()
    (folder / "d" / name).write_text("mine")
    call = ["diagnose", "run.csv", "--model", "quill", "--out", "d"]
    refused(capsys, call, f"--out d: has {name}, which no diagnosis wrote")
    # What an interrupted one has left, and a page: it goes on to read run.csv.
    for own, content in (("diagnosis.json", b'{"verdict": "adequate"}'), ("report.html", b"")):
        (folder / "d" / own).write_bytes(content)
        assert main(call) == 2 and "no diagnosis wrote" not in capsys.readouterr().err
        (folder / "d" / own).unlink()
        (folder / "d" / name).write_text("mine")


def bind(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name)


SPECIAL: dict[str, Callable[[Path], None]] = {
    "pipe": os.mkfifo,
    "socket": bind,
    "device": lambda path: path.symlink_to("/dev/null"),
}


def test_a_table_goes_to_a_pipe_that_is_read_and_to_nowhere(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "".join(f"{60 * i},{20 + 0.1 * i},20\n" for i in range(60))
    (folder / "run.csv").write_text(f"t_s,t_q_degc,at_degc\n{rows}")
    call = ["simulate", "run.csv", "--model", "quill", "--out"]
    assert main([*call, "o.csv"]) == main([*call, "/dev/null"]) == 0
    os.mkfifo("pipe")
    read = os.open("pipe", os.O_RDONLY | os.O_NONBLOCK)
    fcntl.fcntl(read, fcntl.F_SETPIPE_SZ, 2**20)
    assert main([*call, "pipe"]) == 0
    assert os.read(read, 2**20).decode() == Path("o.csv").read_text(encoding="utf-8")
    os.close(read)
    capsys.readouterr()
    refused(capsys, [*call, "pipe"], "not a regular file")


WRITING = [
    ("simulate absent.csv --model quill --out o.csv", "o.csv"),
    ("identify absent.csv --out n.toml", "n.toml"),
    ("identify absent.csv --out n.toml", "n-calibration.html"),
    ("export absent.mcap --out o.csv", "o.csv"),
    ("replay absent.mcap --model quill --out o.csv", "o.csv"),
    ("replay absent.mcap --page o.html", "o.html"),
    ("diagnose absent.csv --model quill --out d", "d/diagnosis.json"),
    ("report absent.mcap --out o.png", "o.png"),
]


@pytest.mark.parametrize(
    ("call", "out", "what"),
    [
        (call, out, what)
        for call, out in WRITING
        for what in SPECIAL
        if not (what == "device" and out.endswith(".csv"))  # a table may go there
    ],
)
def test_what_is_no_file_is_refused_before_the_work(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, call: str, out: str, what: str
) -> None:
    (folder / out).parent.mkdir(exist_ok=True)
    with monkeypatch.context() as short:  # the path of a socket is to be short
        short.chdir((folder / out).parent)
        SPECIAL[what](folder / out)
    refused(capsys, call.split(), f"{out}: ", "not a regular file, expected the name of a file")


@pytest.mark.parametrize(("call", "out"), WRITING)
def test_a_link_into_nowhere_is_refused_before_the_work(
    folder: Path, capsys: pytest.CaptureFixture[str], call: str, out: str
) -> None:
    (folder / out).parent.mkdir(exist_ok=True)
    (folder / out).symlink_to("nowhere/file")
    refused(capsys, call.split(), f"{out}: ", "a link into a folder that is not there")


@pytest.mark.parametrize("out", [".", "/", ".."])
def test_a_folder_is_no_file(folder: Path, capsys: pytest.CaptureFixture[str], out: str) -> None:
    refused(capsys, ["identify", "run.csv", "--out", out], "is a folder, expected the name of a file in it")


def test_two_results_are_two_files(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "o.csv").symlink_to("o.html")
    refused(
        capsys,
        ["compare", "run.csv", "--model", "quill", "--out", "o.csv", "--page", "o.html"],
        "is what --out names, too",
    )


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_argument_says_whether_it_names_what_is_read_or_written(command) -> None:  # type: ignore[no-untyped-def]
    parser = argparse.ArgumentParser()
    command.describe(parser)
    for action in parser._actions:
        name = max(action.option_strings, key=len, default=action.dest)
        is_word = action.nargs != 0 and action.choices is None and action.type in (None, str, Path)
        assert not is_word or name in NO_FILES, f"{name}: expected the type Reads or Writes"
        assert name not in NO_FILES or not isinstance(action.type, (Reads, Writes))
