"""PDF and PNG: printed by an installed browser, complete or not at all."""

from __future__ import annotations

import os
import re
import shutil
import stat
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from compensator.cli import main
from compensator.errors import CompensatorError
from compensator.report import formats
from compensator.report.formats import write
from compensator.report.page import Details, Figure, Line, Page, Table, Words

X = np.linspace(0.0, 24.0, 500)
PAGE = Page(
    title="vmc-07: 2026-01-05",
    verdict="The correction followed the machine.",
    blocks=[
        Figure(title="Offset", x_label="time, h", y_label="Y, µm", lines=(Line("offset", X, np.sin(X)),)),
        Table(title="Minutes by state", head=["state", "min"], rows=[[f"state {i}", f"{i}.5"] for i in range(90)]),
        Details(title="Files", blocks=[Words(title="Remarks", lines=["folded on a screen"])]),
    ],
)
chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")


def fake_browser(folder: Path, script: str) -> Path:
    """Install a browser that does as the script says; `$out` is where it is to print to."""
    path = folder / "bin" / "chromium"
    path.parent.mkdir()
    find = 'for a in "$@"; do case $a in --print-to-pdf=*|--screenshot=*) out=${a#*=};; esac; done'
    path.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > {folder}/arguments\n{find}\n{script}\n', encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path.parent


def objects(pdf: bytes) -> dict[bytes, bytes]:
    """The bodies of all objects by number, streams inflated."""
    found = {}
    for number, body in re.findall(rb"(\d+) 0 obj\n(.*?)\nendobj", pdf, re.S):
        head, marker, stream = body.partition(b"stream\n")
        if marker and b"/FlateDecode" in head:
            body = head + zlib.decompressobj().decompress(stream)
        found[number] = body
    return found


def words(pdf: bytes) -> str:
    """The text of a PDF, by the fonts' own tables from glyphs to letters."""
    found = objects(pdf)
    fonts = {}
    for name, number in set(re.findall(rb"/(F\d+) (\d+) 0 R", pdf)):
        table = found[re.search(rb"/ToUnicode (\d+) 0 R", found[number])[1]]
        codes = dict(re.findall(rb"<(\w{4})> <(\w{4,})>\n", table))
        for a, b, first in re.findall(rb"<(\w{4})> <(\w{4})> <(\w{4})>", table):
            for i in range(int(b, 16) - int(a, 16) + 1):
                codes[b"%04X" % (int(a, 16) + i)] = b"%04X" % (int(first, 16) + i)
        fonts[name] = codes
    text, codes = [], {}
    for body in found.values():
        for font, shown in re.findall(rb"/(F\d+) [\d.]+ Tf|<(\w+)> Tj|", body):
            codes = fonts.get(font, codes)
            for i in range(0, len(shown), 4):
                text.append(bytes.fromhex(codes.get(shown[i : i + 4].upper(), b"0020").decode()).decode("utf-16-be"))
    return "".join(text)


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("printed") / "page.pdf"
    return write(path, PAGE)


@chromium
def test_a_pdf_has_every_word_of_the_page_and_numbered_a4_sheets(printed: Path) -> None:
    data = printed.read_bytes()
    assert data.startswith(b"%PDF-1.") and data.rstrip().endswith(b"%%EOF")
    sheets = len(re.findall(rb"/Type /Page\b", data))
    assert sheets >= 3
    boxes = {tuple(map(float, box.split())) for box in re.findall(rb"/MediaBox \[([^\]]*)\]", data)}
    assert len(boxes) == 1 and boxes.pop() == pytest.approx((0.0, 0.0, 595.0, 842.0), abs=1.0)
    text = words(data).replace(" ", "")
    for expected in (PAGE.title, "✓Passed", PAGE.verdict, "time, h", "state 0", "state 89", "folded on a screen"):
        assert expected.replace(" ", "") in text, expected
    # The head of a table is repeated on each sheet.
    assert text.count("statemin") >= 2


@chromium
def test_nothing_is_left_beside_it(printed: Path) -> None:
    assert [path.name for path in printed.parent.iterdir()] == ["page.pdf"]
    assert printed.stat().st_mode & 0o777 == 0o644


@chromium
def test_a_png_shows_title_verdict_and_first_figure_on_white(tmp_path: Path) -> None:
    picture = imread(write(tmp_path / "page.png", PAGE))
    assert picture.shape[1] == 2000 and 800 < picture.shape[0] < 2000
    assert picture[0, 0, :3] == pytest.approx(1.0) and picture[-1, -1, :3] == pytest.approx(1.0)
    # Each colour as one number: rows are compared far more slowly.
    assert len(np.unique(np.rint(255.0 * picture).astype(int) @ 256 ** np.arange(picture.shape[2]))) > 50
    # Cropped below the figure.
    assert (picture[-100:] != picture[-1, -1]).any()


@chromium
def test_commands_print(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "results").mkdir()
    write(tmp_path / "results" / "report.html", PAGE)
    assert main(["report", str(tmp_path / "results"), "--out", str(tmp_path / "all.pdf")]) == 0
    assert (tmp_path / "all.pdf").read_bytes().startswith(b"%PDF-")
    assert str(tmp_path / "all.pdf") in capsys.readouterr().out


def test_without_a_browser_one_line_says_how_to_print(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("page.pdf", "page.png"):
        assert main(["diagnose", "none.csv", "--model", "quill", "--out", "d", "--page", str(tmp_path / name)]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"{name}: no browser found" in error and ".html" in error
        with pytest.raises(CompensatorError, match="no browser found"):
            write(tmp_path / name, PAGE)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo cannot open display; exit 1", "cannot open display"),
        ('echo "%PD" > "$out"', "could not print the page"),
        ('echo "<html>" > "$out"', "could not print the page"),
        ("exit 0", "no reason given"),
    ],
)
def test_a_browser_that_fails_leaves_what_was_there(
    script: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", f"{fake_browser(tmp_path, script)}:{os.environ['PATH']}")
    out = tmp_path / "out" / "page.pdf"
    out.parent.mkdir()
    out.write_bytes(b"before")
    with pytest.raises(CompensatorError, match=said):
        write(out, PAGE)
    assert out.read_bytes() == b"before" and list(out.parent.iterdir()) == [out]


@pytest.fixture
def slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    script = f"sleep 60 & echo $! > {tmp_path}/helper; wait"
    monkeypatch.setenv("PATH", f"{fake_browser(tmp_path, script)}:{os.environ['PATH']}")
    monkeypatch.setattr(formats, "TIMEOUT_S", 1.0)
    yield tmp_path / "helper"


def test_a_browser_that_hangs_is_ended_with_its_helpers(slow: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.pdf"
    with pytest.raises(CompensatorError, match="within 1 s"):
        write(out, PAGE)
    assert not out.exists() and not list(tmp_path.glob("*printing*"))
    helper = Path("/proc") / slow.read_text().strip() / "stat"
    for _ in range(100):
        # A zombie that nobody waits for is ended, too.
        if not helper.exists() or helper.read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("a helper of the browser still runs")


@pytest.mark.parametrize("uid", [0, 1000])
def test_the_browser_gets_one_local_file_and_no_network(
    uid: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", f"{fake_browser(tmp_path, 'exit 1')}:{os.environ['PATH']}")
    monkeypatch.setattr(formats.os, "geteuid", lambda: uid)
    with pytest.raises(CompensatorError):
        write(tmp_path / "page.pdf", PAGE)
    given = (tmp_path / "arguments").read_text().splitlines()
    assert [word for word in given if "://" in word] == [given[-1]] and given[-1].startswith("file://")
    profile = next(word for word in given if word.startswith("--user-data-dir="))
    assert "page-printing-" in profile and Path(given[-1].removeprefix("file://")).parent.name in profile
    assert "--host-resolver-rules=MAP * ~NOTFOUND" in given and "--no-proxy-server" in given
    # Without its sandbox only where the browser would not start with it.
    assert ("--no-sandbox" in given) == (uid == 0)
