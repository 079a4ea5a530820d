"""Where results go, looked at before any work is done: minutes of fitting must not end in a slip of the pen.

What was read is never written over: a recording is evidence, and a table that somebody measured cannot be made again.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from compensator.errors import UsageError

#: Endings of files that somebody might name here by mistake.
_ENDINGS = {".csv", ".html", ".json", ".mcap", ".pdf", ".png", ".toml", ".xlsx"}


def checked_file(path: Path, option: str, *, read: Iterable[Path] = (), ending: str) -> Path:
    """Return the path of a file that is to be written.

    Parameters
    ----------
    path : pathlib.Path
        Where it is to go.
    option : str
        What gave it, such as `--out`.
    read : iterable of pathlib.Path
        Files that the command reads.
    ending : str
        How names of such files end, `.csv` or `.toml`; another of the project's own is refused.

    Raises
    ------
    UsageError
        If it is a folder, one of the files that are read, of another kind by its name, or cannot be written.
    """
    if path.is_dir():
        raise UsageError(f"{option} {path}: is a folder, expected the name of a file in it")
    if path.resolve() in {one.resolve() for one in read}:
        raise UsageError(f"{option} {path}: is read by this command, expected another name; it would be written over")
    if path.suffix.lower() in _ENDINGS - {ending}:
        raise UsageError(f"{option} {path}: expected a name that ends in {ending}")
    _check_parent(path, option)
    if path.exists() and not os.access(path, os.W_OK):
        raise UsageError(f"{option} {path}: no permission to write it")
    return path


def checked_folder(path: Path, option: str, *, read: Iterable[Path] = (), names: Iterable[str] = ()) -> Path:
    """Return the path of a folder that is to be written to; it need not be there.

    Parameters
    ----------
    path, option, read
        As :func:`checked_file`.
    names : iterable of str
        Files that are written in it.

    Raises
    ------
    UsageError
        If it is a file, cannot be written, or a file in it is one of those that are read.
    """
    if path.exists() and not path.is_dir():
        raise UsageError(f"{option} {path}: is a file, expected a folder")
    files = [one.resolve() for one in read]
    for name in names:
        if (path / name).resolve() in files:
            raise UsageError(f"{option} {path}: its {name} is read by this command, expected another folder")
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


def _check_parent(path: Path, option: str) -> None:
    """Refuse a file whose folder is neither there nor can be made."""
    there = path.absolute().parent
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise UsageError(f"{option} {path}: {there} is a file, expected a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise UsageError(f"{option} {path}: no permission to write in {there}")
