"""The command line as one types and reads it: completion, slips, and text that wraps at words."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest

from compensator.cli import main
from compensator.commands.catalog import COMMANDS
from compensator.commands.wrapping import styled, wrapped
from compensator.display import Table


def usage(capfd: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main([*words])
    assert ended.value.code == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("simulat", "run.csv"), "did you mean simulate?"),
        (("diagnose", "a", "--model", "quill", "--out", "d", "--fit-untl", "3"), "did you mean --fit-until?"),
        (("compare", "a", "--modle", "quill"), "did you mean --model?"),
        (("adopt", "--polcy"), "lists all options"),
        (("loop", "a", "--policy", "adpt"), "did you mean adopt?"),
    ],
)
def test_a_slip_is_answered_with_what_was_meant(
    capfd: pytest.CaptureFixture[str], words: tuple[str, ...], meant: str
) -> None:
    assert meant in usage(capfd, *words)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_sentences_wrap_at_words_and_tables_stay(width: int) -> None:
    sentence = "- " + "The offset follows the model of the machine. " * 6
    table = "model            " + "  12.34" * 20
    channel = "range = [0.0, 16000.0]  # seen: 0 to 8000 and this is a long remark behind it that nobody wraps at all"
    lines = wrapped(f"{sentence}\n{table}\n{channel}", width).split("\n")
    assert table in lines and channel in lines
    prose = [line for line in lines if line not in (table, channel)]
    assert max(map(len, prose)) <= width and all(line.startswith("  ") for line in prose[1:])
    assert " ".join(" ".join(prose).split()) == sentence.strip()


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_table_is_folded_where_it_is_too_wide_and_loses_nothing(width: int) -> None:
    head = ["data", "rms about the zero, µm", "rms about the mean, µm", "mean absolute, µm", "peak to peak, µm"]
    rows = [["run of a day.csv", "7.26", "6.10", "", "23.0"], ["other.csv", "1.2", "1.1", "0.9", "4.4"]]
    text = Table(title="Error in free run", head=head, rows=rows).text()
    shown = wrapped(text, width)
    assert (shown == text) == (width == 120)
    assert max(map(len, shown.split("\n"))) <= width
    if width < 120:
        first = shown.split("other.csv")[0]
        assert "run of a day.csv\n" in first and "mean absolute" not in first, "an empty cell is no value"
        assert all(
            re.search(rf"{re.escape(a)} +{re.escape(b)}$", first, re.M)
            for a, b in zip(head[1:], rows[0][1:], strict=True)
            if b
        )


def test_a_table_of_two_columns_wraps_its_second() -> None:
    rows = [["model", "quill"], ["what", "a sentence of words that is longer than the terminal is wide"]]
    lines = wrapped(Table(head=["", ""], rows=rows).text(), 40).split("\n")
    assert lines[:2] == ["model", "  quill"] and lines[2] == "what" and max(map(len, lines)) <= 40


def test_the_overview_of_commands_fits_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for columns in (66, 80):
        monkeypatch.setenv("COLUMNS", str(columns))
        with pytest.raises(SystemExit):
            main(["--help"])
        text = capsys.readouterr().out
        assert max(map(len, text.splitlines())) <= columns
        assert "identify   fit a model to measured runs\n" in text and "completion print" in text


def test_the_style_changes_no_letter_and_marks_the_verdict() -> None:
    text = "✓ Proven: 3 samples.\n\nErrors of\nall\ndata  rms\na      1\n\nWarnings:\n- one\npage: a.html"
    found = styled(text)
    assert found.plain == text
    marked = {found.plain[span.start : span.end]: span.style for span in found.spans}
    assert marked["✓ Proven: 3 samples."] == "bold green" and marked["Errors of"] == marked["all"] == "bold"
    assert marked["Warnings:"] == "yellow" and marked["page: a.html"] == "dim" and "data  rms" not in marked


def test_the_first_sentence_is_the_result_and_bold() -> None:
    found = styled("Smallest error: quill,\n3 µm.\nA sentence.\n\nA remark.\n- a line of a list")
    assert [found.plain[span.start : span.end] for span in found.spans] == ["Smallest error: quill,", "3 µm."]


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["dia"], {"diagnose"}),
        (["diagnose", "--fit"], {"--fit-until"}),
        (["watch", "--b"], {"--bind"}),
        (
            ["compare", "run.csv", "--"],
            {"--model", "--page", "--from", "--out", "--column", "--axis", "--json", "--debug", "--help"},
        ),
    ],
)
def test_bash_completes(capfd: pytest.CaptureFixture[str], words: list[str], found: set[str]) -> None:
    assert main(["completion", "bash"]) == 0
    script = capfd.readouterr().out
    line = " ".join(f"'{word}'" for word in ["compensator", *words])
    asked = f'COMP_WORDS=({line}); COMP_CWORD={len(words)}; _compensator; echo "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "-c", f"{script}\n{asked}"], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == found and done.stderr == ""


def test_every_shell_knows_every_command(capfd: pytest.CaptureFixture[str]) -> None:
    for shell in ("bash", "zsh", "fish"):
        assert main(["completion", shell]) == 0
        script = capfd.readouterr().out
        assert all(command.name in script for command in COMMANDS), shell
