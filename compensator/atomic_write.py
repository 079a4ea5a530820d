"""Atomic file writes."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from compensator.errors import UsageError
from compensator.input_file import resolved

#: The disk, a quota or the largest file is full, or nobody reads the pipe any more.
_OF_WRITES = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EPIPE)


@contextmanager
def atomic_write(path: Path, *, may_stream: bool = False) -> Iterator[TextIO]:
    r"""Open a text file that replaces the target when it is complete; after an error it is removed.

    Parameters
    ----------
    path : pathlib.Path
        The file; its folder must exist. An existing file remains until it is replaced. A link remains a link.
    may_stream : bool
        Whether what `is_stream` is written to as it is.

    Yields
    ------
    typing.TextIO
        Open for UTF-8 text; line ends are written unchanged, what is no UTF-8 in the name of a file escaped.

    Raises
    ------
    UsageError
        If the folder does not exist.
    OSError
        If the target is another device, pipe or folder, or the disk is full; it is kept, and the error names it.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_write(Path(folder) / "a.csv") as file:
    ...         _ = file.write("t_s,y_um\n")
    ...     os.listdir(folder)
    ['a.csv']
    """
    if may_stream and is_stream(path):
        with _naming(path), path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
            yield file
        return
    path = resolved(path)
    require_folder(path)
    _require_regular(path)
    with (
        _replacement(path, 0o600) as descriptor,
        os.fdopen(descriptor, "w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        yield file
        file.flush()
        os.fsync(descriptor)
        # With a restrictive umask of root, the service could not read its own model.
        os.fchmod(descriptor, 0o644)


def is_stream(path: Path) -> bool:
    """Return whether a path is a character device such as `/dev/null`, or a pipe that somebody reads.

    `/dev/stdout` is one or the other; writing to a pipe without a reader would wait for one.
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISFIFO(mode):
            os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))
    except (OSError, ValueError):
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)


def require_folder(path: Path) -> None:
    """Refuse a path whose folder does not exist.

    Raises
    ------
    UsageError
        If the folder does not exist; the error names the path.
    """
    if not path.absolute().parent.is_dir():
        raise UsageError(f"{path}: no such folder")


def _require_regular(path: Path) -> None:
    """Refuse to replace a device, a pipe or a folder."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def replace_file(
    path: Path, data: bytes, *, mode: int = 0o666, sync: bool = True, owner: tuple[int, int] | None = None
) -> None:
    """Replace a file; a link is replaced, not followed.

    Parameters
    ----------
    path : pathlib.Path
        The file; its folder must exist.
    data : bytes
        Its contents.
    mode : int
        Its permissions, before the umask.
    sync : bool
        Whether to sync the file and its name to disk, so that a power cut leaves the old file or the new one.
    owner : (int, int), optional
        User and group to whom root gives it; it then has the permissions `mode` whatever the umask.

    Raises
    ------
    OSError
        If it cannot be written, or is a device, a pipe or a folder; what is there is kept.
    """
    if not path.is_symlink():
        _require_regular(path)
    with _replacement(path, mode) as descriptor, os.fdopen(descriptor, "wb") as file:
        file.write(data)
        if owner is not None:
            os.fchown(descriptor, *owner)
            os.fchmod(descriptor, mode)
        if sync:
            file.flush()
            os.fsync(descriptor)
    if sync:
        sync_folder(path.parent)


def make_folder(folder: Path) -> tuple[int, int] | None:
    """Make a folder and those above it that do not exist.

    Returns
    -------
    (int, int) or None
        Where root writes into it, user and group to whom it belongs: those of the lowest folder that was there, to whom
        new ones are given. A service that is not root's could not go on with what is root's.

    Raises
    ------
    OSError
        If it cannot be made.
    """
    if os.geteuid() != 0:
        folder.mkdir(parents=True, exist_ok=True)
        return None
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    found = (missing[-1].parent if missing else folder).stat()
    for one in reversed(missing):
        one.mkdir()
        descriptor = os.open(one, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            os.fchown(descriptor, found.st_uid, found.st_gid)
            os.fchmod(descriptor, 0o755)
        finally:
            os.close(descriptor)
    return found.st_uid, found.st_gid


def sync_folder(folder: Path) -> None:
    """Sync the names in a folder to disk, so that a new file's name survives a power cut.

    Raises
    ------
    OSError
        If the sync fails.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Let an error that only a write gives name its file; what is read meanwhile has others."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in _OF_WRITES:
            error.filename = str(path)
        raise


@contextmanager
def _replacement(path: Path, mode: int) -> Iterator[int]:
    """Open a new file in the same folder; at the end it replaces the target, after an error it is removed."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(temporary, flags, mode)
    except OSError as error:
        error.filename = str(path)  # nobody knows the other name
        raise
    try:
        with _naming(path):
            yield descriptor
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
