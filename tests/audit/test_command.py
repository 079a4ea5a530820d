"""`compensator replay` as an auditor calls it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.writer import Writer

from compensator.cli import main
from compensator.recording.container import Contents
from compensator.recording.reading import recordings
from tests.audit.made import MACHINE, Service
from tests.audit.tampering import find, lines_of, rewrite


@pytest.fixture
def rec(tmp_path: Path) -> Path:
    Service(tmp_path / "rec").run(30).stop()
    return recordings(tmp_path / "rec", MACHINE)[0]


def tampered(path: Path) -> None:
    at = find(lines_of(path)[0], "offset", 20)
    edited = lines_of(path)[0][at].edited(b'"valid_for_s":150.0', b'"valid_for_s":950.0')
    rewrite(path, lambda lines: [*lines[:at], edited, *lines[at + 1 :]])


def test_a_clean_recording_is_stated_shortly(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(rec)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(("✓ Proven: 30 samples", "⚠ Proven in part: "))
    assert lines[1].startswith("30 samples of vmc-07 in 1 file(s), 2026-01-05T06:00:00Z to 2026-01-05T06:29:00Z")
    assert lines[2] == "The replay reproduces every estimate and every offset, bit for bit."
    assert lines[3].startswith("The hash chain holds over 94 records") and len(lines) == 5


def test_a_difference_is_exit_code_3_and_named_field_by_field(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tampered(rec)
    assert main(["replay", str(rec)]) == 3
    out = capsys.readouterr().out
    assert "/offset of sample 20, 2026-01-05T06:20:00Z, differs:" in out
    assert "  valid_for_s: recorded 950.0, recomputed 150.0" in out
    assert f"{rec.name}: altered: /offset record" in out and "bit for bit" not in out


def test_a_name_in_the_metadata_writes_no_lines_of_its_own(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def named(contents: Contents) -> None:
        contents.run["machine"] = contents.run["file"] = "x\n\x1b[2J\u202e✓ Proven: 1440 samples"

    rewrite(rec, contents=named)
    assert main(["replay", str(rec)]) == 3
    out = capsys.readouterr().out
    assert out.replace("\n", "").isprintable() and "x\\n\\x1b[2J\\u202e✓ Proven" in out
    assert not [line for line in out.splitlines() if line.startswith("✓")]


def test_the_result_as_json(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "--json", str(rec.parent)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["clean"], found["samples"], found["files"][0]["end"]) == (True, 30, "finished")
    tampered(rec)
    assert main(["replay", "--json", str(rec)]) == 3
    found = json.loads(capsys.readouterr().out)
    assert found["findings"][0]["kind"] == "altered" and found["findings"][0]["topic"] == "offset"
    assert found["difference"]["fields"] == [{"field": "valid_for_s", "recorded": 950.0, "recomputed": 150.0}]
    assert main(["replay", "--json", str(rec), "--model", "quill"]) == 0
    assert json.loads(capsys.readouterr().out)["offset_difference_um"]["samples"] == 30


def test_what_cannot_be_read_is_one_line_and_exit_code_2(
    rec: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, random = tmp_path / "day.csv", tmp_path / "random.mcap"
    text.write_text("t_s,t_q_degc\n0,20\n")
    random.write_bytes(bytes(range(256)) * 50)
    no_config = tmp_path / "no-config.mcap"
    no_config.write_bytes(rec.read_bytes())
    rewrite(
        no_config,
        lambda lines: [line for line in lines if line.topic not in ("chain", "seal")],
        contents=lambda contents: contents.attachments.pop("config.toml") and None,
    )  # type: ignore[func-returns-value]
    (tmp_path / "empty").mkdir()
    private = tmp_path / "key.pem"
    private.write_text("-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n")
    for arguments, expected in (
        ([str(text)], "day.csv: not an MCAP file"),
        ([str(random)], "random.mcap: not an MCAP file"),
        ([str(tmp_path / "none.mcap")], "none.mcap: No such file or directory; expected a recording"),
        ([str(tmp_path / "empty")], "empty: no recordings in it"),
        ([str(rec), "--out", "x.csv"], "--out: is for --model"),
        ([str(rec), "--public-key", str(text)], "day.csv: no PEM public key"),
        ([str(rec), "--public-key", str(private)], "key.pem: is a private key"),
        ([str(rec), "--public-key", str(text), "--model", "quill"], "--public-key: is for the audit"),
        ([str(rec), "--model", str(tmp_path / "none.toml")], "none.toml"),
        ([str(no_config), "--model", "quill"], "attachment config.toml is missing"),
    ):
        assert main(["replay", *arguments]) == 2, arguments
        said = capsys.readouterr()
        assert not said.out and said.err.count("\n") == 1 and expected in said.err


def test_an_intact_recording_that_says_nonsense_is_named(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    at = find(lines_of(rec)[0], "sample", 20)
    broken = lines_of(rec)[0][at].edited(b'"mean":', b'"mean":"x",')
    rewrite(rec, lambda lines: [*lines[:at], broken, *lines[at + 1 :]])
    assert main(["replay", str(rec)]) == 3
    out = capsys.readouterr().out
    assert "unreadable: /sample record" in out and "20 samples" in out


def test_a_recording_without_any_trace_of_its_chain_proves_nothing(
    rec: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tampered(rec)

    def bare(contents: Contents) -> None:
        for topic in ("chain", "seal"):
            number = next(n for n, channel in contents.channels.items() if channel.topic == f"/{topic}")
            del contents.channels[number]
        run = contents.metadata["run"]
        for key in [key for key in run if key.startswith("previous")]:
            del run[key]

    rewrite(rec, lambda lines: [line for line in lines if line.topic not in ("chain", "seal")], contents=bare)
    assert main(["replay", str(rec)]) == 3
    assert f"{rec.name}: removed: channel /chain: missing, although the recorder writes it" in capsys.readouterr().out


def test_samples_that_cannot_be_worked_out_again_prove_nothing(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def bare(contents: Contents) -> None:
        del contents.attachments["config.toml"]
        contents.metadata.pop("run")

    rewrite(rec, lambda lines: [line for line in lines if line.topic not in ("chain", "seal")], contents=bare)
    assert main(["replay", str(rec)]) == 3
    assert "unreadable: its samples cannot be replayed: attachment config.toml" in capsys.readouterr().out


def test_empty_files_alone_prove_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As a kill at the first write leaves them, or somebody who empties them."""
    empty = tmp_path / "empty" / "vmc-07_20260105T060000Z.mcap"
    other = empty.with_name("vmc-07_20260106T000000Z.mcap")
    empty.parent.mkdir()
    empty.touch()
    other.touch()
    for arguments in ([str(empty)], [str(empty.parent)]):
        assert main(["replay", "--json", *arguments]) == 3
        found = json.loads(capsys.readouterr().out)
        assert not found["clean"] and {finding["kind"] for finding in found["findings"]} == {"empty"}
    assert main(["replay", str(empty.parent)]) == 3
    assert capsys.readouterr().out.startswith("✗ Not proven: 2 finding(s) in 2 recording(s) with 0 samples.")


def test_a_run_without_samples_proves_its_records(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Service(tmp_path / "rec").run(0).stop()
    assert main(["replay", str(tmp_path / "rec")]) == 0
    out = capsys.readouterr().out
    assert out.startswith("⚠ Proven in part: the records of 1 recording(s) are unchanged; none of them is a sample.")


@pytest.mark.parametrize(
    ("topic", "expected"),
    [("/temperature", "not a recording of the service"), ("/shop/vmc-07/thermal/sample", "a shop's recording")],
)
def test_a_file_that_no_service_wrote_is_no_clean_recording(
    rec: Path, capsys: pytest.CaptureFixture[str], topic: str, expected: str
) -> None:
    foreign = rec.with_name("foreign.mcap")
    with foreign.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        writer.add_message(writer.register_channel(topic, "json", schema), 0, b"{}", 0)
        writer.finish()
    assert main(["replay", str(rec.parent)]) == 3  # somebody has put it there; the others are audited
    said = capsys.readouterr()
    assert f"foreign.mcap: damaged: not read: {expected}" in said.out and "30 samples" in said.out
    for named in ([str(rec), str(foreign)], [str(foreign)]):
        assert main(["replay", *named]) == 2
        said = capsys.readouterr()
        assert not said.out and said.err.count("\n") == 1 and f"foreign.mcap: {expected}" in said.err
    for other in (["replay", str(foreign), "--model", "quill"], ["report", str(foreign), "--out", f"{foreign}.html"]):
        assert main(other) == 2
        assert "foreign.mcap: no samples" in capsys.readouterr().err
