"""Paths of results, checked before any computation, so that a mistyped name costs no computing time.

Input files are never overwritten: a recording is evidence, and a measured table cannot be reproduced.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from compensator.errors import UsageError
from compensator.input_file import resolved

#: Suffixes that are probably mistakes.
_ENDINGS = {".csv", ".html", ".json", ".mcap", ".pdf", ".png", ".toml", ".xlsx"}


def checked_file(path: Path, option: str, *, read: Iterable[Path] = (), ending: str) -> Path:
    """Return the path of a file to be written.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    option : str
        Option that named it, such as `--out`.
    read : iterable of pathlib.Path
        Files that the command reads.
    ending : str
        Ending of such files, `.csv` or `.toml`; other known endings are refused.

    Raises
    ------
    UsageError
        If it is a folder, is read by the command, has another ending, or cannot be written.
    """
    if path.is_dir():
        raise UsageError(f"{option} {path}: is a folder, expected the name of a file in it")
    if resolved(path) in {resolved(one) for one in read}:
        raise UsageError(
            f"{option} {path}: is an input of this command and would be overwritten, expected another name"
        )
    if path.suffix.lower() in _ENDINGS - {ending}:
        raise UsageError(f"{option} {path}: expected a name that ends in {ending}")
    _check_parent(path, option)
    if path.exists() and not os.access(path, os.W_OK):
        raise UsageError(f"{option} {path}: no permission to write it")
    return path


def checked_folder(path: Path, option: str, *, read: Iterable[Path] = (), names: Iterable[str] = ()) -> Path:
    """Return the path of a folder for results; it need not exist.

    Parameters
    ----------
    path, option, read
        As :func:`checked_file`.
    names : iterable of str
        Files that will be written there.

    Raises
    ------
    UsageError
        If it is a file, cannot be written, or contains a file that is read.
    """
    if path.exists() and not path.is_dir():
        raise UsageError(f"{option} {path}: is a file, expected a folder")
    files = [resolved(one) for one in read]
    for name in names:
        if resolved(path / name) in files:
            raise UsageError(f"{option} {path}: its {name} is an input of this command, expected another folder")
    _check_parent(path / "file", option)
    return path


def checked_page(path: Path | None) -> Path | None:
    """Return the path of `--page`, None where it is not given.

    Raises
    ------
    UsageError
        If no page can be written there.
    """
    if path is None:
        return None
    from compensator.report.formats import checked

    return checked(path, option="--page")


def pages_text(page: Path, also: Path | None) -> str:
    """Return a line for each page that was written."""
    return "\n".join(f"page: {path}" for path in (page, also) if path is not None)


def _check_parent(path: Path, option: str) -> None:
    """Refuse a file whose folder does not exist and cannot be made."""
    there = path.absolute().parent
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise UsageError(f"{option} {path}: {there} is a file, expected a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise UsageError(f"{option} {path}: no permission to write in {there}")
