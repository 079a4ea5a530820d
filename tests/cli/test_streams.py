"""Standard streams that are closed, full, read by nobody or in another encoding; errors of one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from compensator.cli import main
from compensator.recording.reading import recordings
from tests.audit.made import MACHINE, Service


@pytest.fixture(scope="module")
def rec(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rec")
    Service(folder).run(5).stop()
    return recordings(folder, MACHINE)[0]


def ended(command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a shell's line, in which `compensator` is the command."""
    line = command.replace("compensator", f"{sys.executable} -m compensator")
    done = subprocess.run(
        ["/bin/sh", "-c", line], env=os.environ | environment, capture_output=True, timeout=60, check=False
    )
    out, err = (text.decode(environment.get("PYTHONIOENCODING", "utf-8")) for text in (done.stdout, done.stderr))
    return subprocess.CompletedProcess(line, done.returncode, out, err)


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", "<&- >&- 2>&-"])
def test_a_closed_stream_changes_no_exit_code(rec: Path, closed: str) -> None:
    done = ended(f"compensator replay {rec} {closed}")
    assert (done.returncode, done.stderr) == (0, "")
    done = ended(f"compensator replay {rec}.missing {closed}")
    assert done.returncode == 2 and "Traceback" not in done.stderr


@pytest.mark.parametrize("to", ["| cat", "> {out}"])
def test_a_table_that_goes_to_standard_output_has_nothing_else_in_it(rec: Path, to: str, tmp_path: Path) -> None:
    table, out = tmp_path / "table.csv", tmp_path / "out.csv"
    plain = ended(f"compensator export {rec} --out {table}")
    assert plain.stdout.startswith("5 samples") and plain.stderr == ""
    for option in ("", " --json"):
        done = ended(f"compensator export {rec} --out /dev/stdout{option} {to.format(out=out)}")
        assert (out.read_text() if out.exists() else done.stdout) == table.read_text()
        assert done.stderr.count("\n") == 1 and "5" in done.stderr
    done = ended(f"compensator export {rec} --out /dev/null > /dev/null")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("option", ["", "--json"])
def test_a_result_that_cannot_be_written_is_a_failure_in_one_line(rec: Path, option: str) -> None:
    done = ended(f"compensator replay {rec} {option} > /dev/full")
    assert done.returncode == 1
    assert done.stderr == "compensator: standard output: No space left on device\n"
    for words in ("--help", "replay --help", "--version"):
        done = ended(f"compensator {words} > /dev/full")
        assert (done.returncode, done.stderr) == (1, "compensator: standard output: No space left on device\n")
    done = ended(f"compensator export {rec} --out /dev/full")
    assert (done.returncode, done.stderr) == (1, "compensator: /dev/full: No space left on device\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_an_audit_that_found_a_difference_says_so_even_where_it_cannot_be_written(rec: Path, tmp_path: Path) -> None:
    changed = tmp_path / rec.name
    changed.write_bytes(rec.read_bytes().replace(b'"ok"', b'"OK"'))
    done = ended(f"compensator replay {changed} > /dev/full")
    assert (done.returncode, done.stderr) == (3, "compensator: standard output: No space left on device\n")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_every_text_can_be_written_in_every_encoding(rec: Path, encoding: str) -> None:
    name = rec.with_name(os.fsdecode(b"caf\xe9.mcap"))  # no UTF-8
    name.write_bytes(rec.read_bytes())
    for command in ("export", "report"):
        out = f"{rec.parent}/$(printf 'caf\\351').{'csv' if command == 'export' else 'html'}"
        done = ended(f"compensator {command} {rec.parent}/caf?.mcap --out {out}", PYTHONIOENCODING=encoding)
        assert (done.returncode, done.stderr) == (0, "") and "caf\\udce9" in done.stdout
    done = ended(f"compensator replay {name.parent}/caf?.mcap", PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr) == (0, "") and "Proven: 5 samples" in done.stdout
    name.unlink()


def test_an_error_cites_what_it_read_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "machine.toml"
    config.write_text('"\\u001b[2J\\nvalid" = 1\n')
    assert main(["check", "--config", str(config)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.strip().isprintable() and "\\x1b[2J\\nvalid" in said
