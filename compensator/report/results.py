"""The pages that demo, identify and diagnose wrote to a folder, and an overview that links to them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import quote

from compensator.report.page import Block, Cell, Link, Page, Table, Tone


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """A page of the compensator.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    title, verdict, tone : str
        Read from it.
    """

    path: Path
    title: str
    verdict: str
    tone: Tone


class _Parser(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tone: Tone | None = None
        self.words = {"h1": "", "verdict": ""}
        self._in = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        kinds = (dict(attrs).get("class") or "").split()
        if tag == "h1":
            self._in = "h1"
        elif tag == "p" and kinds[:1] == ["verdict"]:
            self._in = "verdict"
            self.tone = next((tone for tone in ("good", "warn", "bad") if tone in kinds), "good")
        elif tag == "b" and self._in == "verdict":
            self._in = "sign"

    def handle_endtag(self, tag: str) -> None:
        if tag == "b" and self._in == "sign":
            self._in = "verdict"
        elif tag in ("h1", "p"):
            self._in = ""

    def handle_data(self, data: str) -> None:
        if self._in in self.words:
            self.words[self._in] += data


def pages_in(folder: Path) -> list[Found]:
    """Return the pages of a folder and its subfolders, the uppermost first.

    Parameters
    ----------
    folder : pathlib.Path
        Where to look; other HTML files are ignored.
    """
    found = []
    for path in sorted(folder.rglob("report.html"), key=lambda path: (len(path.parts), path)):
        parser = _Parser()
        parser.feed(path.read_text(encoding="utf-8", errors="replace"))
        if parser.tone is not None:
            words = parser.words
            found.append(Found(path=path, title=words["h1"], verdict=words["verdict"], tone=parser.tone))
    return found


def overview(folder: Path, pages: Sequence[Found], *, beside: Path) -> Page:
    """Make a page that links to others and lists folders of recordings.

    Parameters
    ----------
    folder : pathlib.Path
        The folder of the results.
    pages : sequence of Found
        The pages, the most important first.
    beside : pathlib.Path
        Folder of the overview itself: links are relative to it.
    """

    def link(path: Path) -> Link:
        return Link(str(path.relative_to(folder)), quote(Path(os.path.relpath(path, beside)).as_posix()))

    first = pages[0]
    rows: list[list[Cell]] = [[link(page.path), page.title, page.verdict] for page in pages]
    blocks: list[Block] = [Table(title="Pages", head=["page", "subject", "result"], rows=rows)]
    folders = sorted({path.parent for path in folder.rglob("*.mcap")})
    if folders:
        blocks.append(
            Table(
                title="Recordings",
                head=["folder", "files"],
                rows=[[str(path.relative_to(folder)), str(len(list(path.glob("*.mcap"))))] for path in folders],
                note="compensator report FOLDER makes a page of one.",
            )
        )
    return Page(title=f"{folder.resolve().name}: {first.title}", verdict=first.verdict, tone=first.tone, blocks=blocks)
