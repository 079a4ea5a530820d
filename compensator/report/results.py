"""The pages that demo, identify and diagnose wrote to a folder, and an overview that links to them."""

from __future__ import annotations

import html
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast
from urllib.parse import quote

from compensator.report.page import Block, Cell, Link, Page, Table, Tone

#: Title, tone and verdict of a page, as `page.html_of` writes them.
_HEAD = re.compile(r'<h1>([^<]*)</h1><p class="verdict (good|warn|bad)"><b>[^<]*</b>([^<]*)</p>')


@dataclass(frozen=True, slots=True, kw_only=True)
class PageFile:
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


def pages_in(folder: Path) -> list[PageFile]:
    """Return the pages of a folder and its subfolders, the uppermost first.

    Parameters
    ----------
    folder : pathlib.Path
        Where to look; other HTML files are ignored.
    """
    found = []
    for path in sorted(folder.rglob("report.html"), key=lambda path: (len(path.parts), path)):
        head = _HEAD.search(path.read_text(encoding="utf-8", errors="replace"))
        if head is not None:
            title, tone, verdict = map(html.unescape, head.groups())
            found.append(PageFile(path=path, title=title, verdict=verdict, tone=cast(Tone, tone)))
    return found


def overview(folder: Path, pages: Sequence[PageFile], *, relative_to: Path) -> Page:
    """Make a page that links to others and lists folders of recordings.

    Parameters
    ----------
    folder : pathlib.Path
        The folder of the results.
    pages : sequence of PageFile
        The pages, the most important first.
    relative_to : pathlib.Path
        Folder of the overview itself: links are relative to it.
    """

    def link(path: Path) -> Link:
        return Link(str(path.relative_to(folder)), quote(Path(os.path.relpath(path, relative_to)).as_posix()))

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
