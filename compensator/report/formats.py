"""A page as the file that was asked for: HTML, PDF, or a PNG of what it says first."""

from __future__ import annotations

from pathlib import Path

from compensator.errors import UsageError
from compensator.report.page import Page, write_page

SUFFIXES = (".html", ".pdf", ".png")


def checked(path: Path, *, option: str) -> Path:
    """Return the path of a page; say before any work is done that it cannot be one.

    Parameters
    ----------
    path : pathlib.Path
        Where the page is to go.
    option : str
        What gave it.

    Raises
    ------
    UsageError
        If its ending is none of `SUFFIXES`, or its folder is not there.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{option} {path}: expected a name that ends in .html, .pdf or .png")
    if not path.parent.is_dir():
        raise UsageError(f"{option} {path}: no such folder")
    return path


def write(path: Path, page: Page) -> Path:
    """Write a page in the format that its name asks for.

    Parameters
    ----------
    path : pathlib.Path
        The file; `.html`, `.pdf` or `.png`.
    page : Page
        What stands on it.
    """
    if path.suffix.lower() == ".html":
        return write_page(path, page)
    from compensator.report.paper import write_pdf, write_png

    return (write_pdf if path.suffix.lower() == ".pdf" else write_png)(path, page)
