"""Atomic writes: under its name a file is complete or missing."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO


@contextmanager
def atomic_write(path: Path) -> Iterator[TextIO]:
    r"""Open a file for text; it replaces the old one once it is complete, and is removed where something fails.

    Parameters
    ----------
    path : pathlib.Path
        Where it is to go; its folder is made. What was there before stays until then. A link stays a link, and what is
        no file (`/dev/null`, a pipe) is written to directly.

    Yields
    ------
    typing.TextIO
        Open for UTF-8 text; line ends are written as they are given.

    Examples
    --------
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_write(Path(folder) / "a.csv") as file:
    ...         _ = file.write("t_s,y_um\n")
    ...     os.listdir(folder)
    ['a.csv']
    """
    path = path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not path.is_file():
        with path.open("w", newline="", encoding="utf-8") as file:
            yield file
        return
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    temporary = Path(name)
    try:
        with os.fdopen(handle, "w", newline="", encoding="utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
