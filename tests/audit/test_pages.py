"""`replay --page`: the auditor's page says what was proven and what was not, and shows both offsets of two models."""

from __future__ import annotations

import html
import math
import re
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from compensator.audit.findings import KEPT
from compensator.audit.other_model import AxisComparison, OtherModel
from compensator.audit.pages import Curves, comparison_page
from compensator.cli import main
from compensator.recording.container import MAGIC
from compensator.recording.framing import CHUNK_INDEX, FOOTER
from compensator.recording.reading import recordings
from compensator.report.history import Spread
from tests.audit.made import MACHINE, Service, other_model
from tests.audit.tampering import Line, rewrite
from tests.audit.test_command import tampered


@pytest.fixture
def rec(tmp_path: Path) -> Path:
    service = Service(tmp_path / "rec").run(90)
    service.recorder.start_new()
    service.run(30).stop()
    return tmp_path / "rec"


def page(capsys: pytest.CaptureFixture[str], code: int, *arguments: str | Path) -> str:
    out = Path(str(arguments[0])).parent / "page.html"
    assert main(["replay", *map(str, arguments), "--page", str(out)]) == code
    assert f"page: {out}" in capsys.readouterr().out
    # Without the classes that align columns.
    return html.unescape(re.sub(r' class="text[ a-z]*"', "", out.read_text(encoding="utf-8")))


def outcomes(text: str) -> dict[str, str]:
    table = text[text.index("What was proven, and what was not") :]
    return dict(re.findall(r'<th scope="row">([^<]+)</th><td>(\S) ', table[: table.index("</table>")]))


def test_what_was_proven_and_what_no_recording_can_prove(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = page(capsys, 0, rec)
    assert '<p class="verdict good">' in text and "Proven: 120 samples in 2 recording(s)" in text
    assert "no signature was checked" in text
    assert list(outcomes(text).values()) == ["✓", "✓", "✓", "✓", "–", "✓", "–", "–"]
    for path in recordings(rec, MACHINE):
        assert text.count(path.name) >= 2
    assert 'href="#word-finished"' in text and "first sample that differs" not in text


def test_a_change_is_shown_field_by_field(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tampered(recordings(rec, MACHINE)[0])
    text = page(capsys, 3, rec)
    assert '<p class="verdict bad">' in text
    assert "Not proven: 1 finding(s) and 1 sample(s) that differ in the replay in 2 recording(s)" in text
    assert '<tr><th scope="row">valid_for_s</th><td>950.0</td><td>150.0</td></tr>' in text
    assert [*outcomes(text).values()][:3] == ["✗", "✗", "✓"]
    assert 'href="#word-altered"' in text


def test_a_file_that_is_missing_is_not_proven(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    service = Service(tmp_path / "rec")
    for _ in range(3):
        service.run(10)
        service.recorder.start_new()
    service.stop()
    recordings(tmp_path / "rec", MACHINE)[1].unlink()
    text = page(capsys, 3, tmp_path / "rec")
    assert [*outcomes(text).values()][:3] == ["✓", "✓", "✗"] and 'href="#word-missing_file"' in text


@pytest.mark.parametrize("which", [0, 1])
def test_a_copy_is_inserted_and_no_missing_file(rec: Path, capsys: pytest.CaptureFixture[str], which: int) -> None:
    shutil.copy(recordings(rec, MACHINE)[which], rec / "copy.mcap")
    text = page(capsys, 3, rec)
    assert [*outcomes(text).values()][1:3] == ["✗", "✓"] and 'href="#word-inserted"' in text
    assert "Not proven: 1 finding(s) in 3" in text and "begins_new_chain" not in text


@pytest.mark.parametrize(("which", "distance"), [("sample", 1), ("chain", 3)])
def test_records_in_another_place_are_no_missing_file(
    rec: Path, capsys: pytest.CaptureFixture[str], which: str, distance: int
) -> None:
    def exchange(lines: list[Line]) -> list[Line]:
        i = [i for i, line in enumerate(lines) if line.topic == which][20]
        lines[i], lines[i + distance] = lines[i + distance], lines[i]
        return lines

    rewrite(recordings(rec, MACHINE)[0], exchange)
    text = page(capsys, 3, rec)
    assert [*outcomes(text).values()][1:3] == ["✗", "✓"] and 'href="#word-reordered"' in text


def test_an_index_is_no_record_however_many_places_of_it_are_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Service(tmp_path / "rec").run(120).stop()
    path = recordings(tmp_path / "rec", MACHINE)[0]
    rewrite(path, chunk_size=600)
    path.write_bytes(with_shifted_chunk_indexes(path.read_bytes()))
    text = page(capsys, 3, tmp_path / "rec")
    count = re.search(r"Not proven: (\d+) finding", text)
    assert count is not None and int(count[1]) > KEPT
    assert [*outcomes(text).values()][1:4] == ["✓", "✓", "✗"]


def with_shifted_chunk_indexes(data: bytes) -> bytes:
    """Move the first time of every chunk in the summary, whose CRC is right again."""
    changed = bytearray(data)
    footer = len(data) - len(MAGIC) - 29
    start = at = struct.unpack_from("<Q", data, footer + 9)[0]
    while data[at] != FOOTER:
        code, length = struct.unpack_from("<BQ", data, at)
        if code == CHUNK_INDEX:
            struct.pack_into("<Q", changed, at + 9, struct.unpack_from("<Q", data, at + 9)[0] + 1)
        at += 9 + length
    struct.pack_into("<I", changed, footer + 25, zlib.crc32(changed[start : footer + 25]))
    return bytes(changed)


def test_a_file_without_an_end_is_said_to_have_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Service(tmp_path / "rec").run(20).kill()
    text = page(capsys, 0, tmp_path / "rec")
    assert [*outcomes(text).values()] == ["✓", "✓", "✓", "–", "–", "✗", "–", "–"]
    assert 'href="#word-open"' in text


def test_both_offsets_of_two_models(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Service(tmp_path / "rec", model=other_model()).run(200).stop()
    text = page(capsys, 0, tmp_path / "rec", "--model", "quill")
    assert "Model “quill” on what “other” recorded" in text and "with “other”, the recorded model." in text
    assert "Offset of both models" in text and "Remaining error: measured deformation + offset" in text
    figures = [line for line in re.findall(r"<desc>(.*?)</desc>", text) if "other (recorded): " in line]
    assert len(figures) == 2
    assert text.index("<svg") < text.index("Before and after")


def test_every_model_that_recorded_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    service = Service(tmp_path / "rec").run(20)
    service.adopt(other_model())
    service.run(20).stop()
    assert "Model “quill” on what “quill, other” recorded" in page(capsys, 0, tmp_path / "rec", "--model", "quill")


def test_a_page_of_another_format_is_refused_before_the_work(rec: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(rec), "--page", "page.doc"]) == 2
    assert "--page page.doc: expected a name that ends in .html, .pdf or .png" in capsys.readouterr().err
    if shutil.which("chromium") is None:
        pytest.skip("chromium is not installed: nothing was printed")
    out = rec.parent / "audit.pdf"
    assert main(["replay", str(rec), "--page", str(out)]) == 0
    assert out.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(("after", "tone"), [(1.0, "good"), (3.0, "bad"), (2.0, "warn"), (math.nan, "warn")])
def test_the_tone_says_which_is_better(after: float, tone: str) -> None:
    before, then = Spread(), Spread()
    if not math.isnan(after):
        before.add(2.0, 1)
        then.add(after, 1)
    found = OtherModel("a", "b", AxisComparison(before, then, before, then, Spread()), 1, [])
    curves = Curves()
    curves.add(60 * 10**9, math.nan, 1.0, math.nan, 2.0)
    made = comparison_page(found, curves)
    assert made.tone == tone
    assert ("Y was not measured" in made.verdict) == math.isnan(after)


def test_curves_of_many_samples_are_those_of_the_samples() -> None:
    curves = Curves()
    for i in range(12_000):
        curves.add(i * 60 * 10**9, 5.0 if i == 7777 else 0.0, float(i % 10), math.nan, 1.0)
    assert (curves.first_s, curves.last_s) == (0.0, 11_999 * 60.0)
    recorded, other = curves.line("", "recorded"), curves.line("", "left other")
    assert (np.nanmin(recorded.y), np.nanmax(recorded.y)) == (0.0, 9.0)
    assert np.isnan(other.y).all() and curves.line("", "left recorded").y.max() == 12.0
