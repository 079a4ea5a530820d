"""A self-contained HTML page: verdict first, then the pictures that carry it, then the table.

Pictures are drawn by matplotlib as SVG; their colours are replaced by CSS variables, so that one page serves a
light and a dark screen and paper.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure as Canvas

#: Drawn colour → CSS variable. Line colours are from the Okabe–Ito set, told apart by the colour-blind.
_COLOURS = {
    "#010101": "--ink",
    "#020202": "--grid",
    "#030303": "--line-0",
    "#040404": "--line-1",
    "#050505": "--line-2",
}
_DASHES = ("-", "--", ":")
#: More points than this do not fit on a screen.
_POINTS = 1500


@dataclass(frozen=True, slots=True)
class Line:
    """A curve with its name."""

    name: str
    x: npt.NDArray[np.float64]
    y: npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A picture with units on both axes."""

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """A page: title, verdict, table with a header row, pictures."""

    title: str
    verdict: str
    table: Sequence[Sequence[str]]
    figures: Sequence[Figure]


_STYLE = """
:root { --paper: #ffffff; --ink: #1c1c1c; --grid: #d0d0d0; --line-0: #d55e00; --line-1: #0072b2; --line-2: #009e73; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #16181c; --ink: #e8e8e8; --grid: #44484f; --line-0: #f0903c; --line-1: #6cb8ee; --line-2: #3fc79a; }
}
@media print {
  :root { --paper: #ffffff; --ink: #000000; --grid: #d0d0d0; --line-0: #d55e00; --line-1: #0072b2; --line-2: #009e73; }
}
body { background: var(--paper); color: var(--ink); font: 16px/1.5 system-ui, sans-serif; margin: 0 auto;
  max-width: 60rem; padding: 1rem; }
h1 { font-size: 1.5rem; } .verdict { font-size: 1.2rem; font-weight: 600; }
figure { margin: 1.5rem 0; } figcaption { font-weight: 600; } svg { width: 100%; height: auto; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; }
th, td { padding: .25rem .75rem; text-align: right; border-bottom: 1px solid var(--grid); white-space: nowrap; }
th:first-child, td:first-child, td:nth-child(2) { text-align: left; }
"""


def write_page(path: Path, page: Page) -> None:
    """Write a page.

    Parameters
    ----------
    path : pathlib.Path
        The HTML file.
    page : Page
        What stands on it.
    """
    head, *rows = page.table
    table = "".join(f'<th scope="col">{html.escape(cell)}</th>' for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    figures = "".join(
        f"<figure><figcaption>{html.escape(f.title)}</figcaption>{_svg(f)}</figure>" for f in page.figures
    )
    title = html.escape(page.title)
    text = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head><body>'
        f'<main><h1>{title}</h1><p class="verdict">{html.escape(page.verdict)}</p>'
        f'<div class="scroll"><table><thead><tr>{table}</tr></thead><tbody>{body}</tbody></table></div>{figures}</main>'
        "</body></html>"
    )
    path.write_text(text, encoding="utf-8")


def _svg(figure: Figure) -> str:
    style: dict[Any, Any] = {
        "svg.fonttype": "none", "svg.hashsalt": figure.title, "font.family": "sans-serif", "font.size": 10,
        "text.color": "#010101", "axes.labelcolor": "#010101", "axes.edgecolor": "#010101",
        "xtick.color": "#010101", "ytick.color": "#010101", "grid.color": "#020202", "figure.facecolor": "none",
        "axes.facecolor": "none", "legend.framealpha": 0.0,
    }  # fmt: skip
    with mpl.rc_context(style):
        canvas = Canvas(figsize=(9, 3.4), layout="constrained")
        axes = canvas.subplots()
        for i, line in enumerate(figure.lines):
            step = max(1, line.x.size // _POINTS)
            axes.plot(line.x[::step], line.y[::step], _DASHES[i % 3], color=list(_COLOURS)[2 + i % 3],
                      label=line.name, linewidth=1.5)  # fmt: skip
        axes.set_xlabel(figure.x_label)
        axes.set_ylabel(figure.y_label)
        axes.grid(visible=True)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)
        buffer = io.StringIO()
        canvas.savefig(buffer, format="svg", metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    for colour, variable in _COLOURS.items():
        svg = svg.replace(colour, f"var({variable})")
    # Two pictures on one page must not share identifiers.
    prefix = re.sub(r"\W+", "-", figure.title.lower())
    svg = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{prefix}-", svg)
    return svg.replace("<svg ", f'<svg role="img" aria-label="{html.escape(figure.title)}" ', 1)
