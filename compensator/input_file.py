"""Files of a user, read within limits: regular files only, no larger than expected, every refusal one line."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import stat
import tomllib
from io import BufferedReader
from pathlib import Path
from typing import Any

from compensator.errors import UsageError

#: Largest configuration, model, key, certificate or result, bytes: many times what any of them needs.
SETTINGS_BYTES, MODEL_BYTES, KEY_BYTES, RESULT_BYTES = 1_000_000, 1_000_000, 100_000, 10_000_000
#: Deepest key of a TOML file; the time to read one grows with the square of it.
KEY_PARTS = 32
# A part ends with its line at the latest, and what holds no keys is passed over whole: a scan never goes back.
_PART = rb"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\[^\n])*+"?|'[^'\n]*+'?)"""
_DEEP_KEY = rb"(?P<deep>" + _PART + rb"(?:[ \t]*+\.[ \t]*+" + _PART + rb"){%d})" % KEY_PARTS
_NO_KEY = rb"""\#[^\n]*+|\"{3}(?:[^"\\]|\\.|"(?!""))*+(?:\"{3,5})?|'{3}(?:[^']|'(?!''))*+(?:'{3,5})?"""
_LEXEME = re.compile(_NO_KEY + rb"|" + _DEEP_KEY + rb"|" + _PART, re.DOTALL)


def open_file(path: Path) -> BufferedReader:
    """Open a regular file for reading.

    Parameters
    ----------
    path : pathlib.Path
        The file, or a link to it.

    Raises
    ------
    OSError
        If there is no such file, or it is a folder, a device or a pipe, which may have no end.
    """
    try:
        # A pipe would wait for its writer.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except ValueError as error:
        raise OSError(errno.EINVAL, "not the name of a file", str(path)) from error
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "not a regular file", str(path))


def read_file(path: Path, most: int) -> bytes:
    """Return the bytes of a regular file.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    most : int
        Largest size, bytes.

    Raises
    ------
    OSError
        As `open_file`, or if it is larger.

    Examples
    --------
    >>> read_file(Path("/dev/zero"), 1000)
    Traceback (most recent call last):
    OSError: [Errno 22] not a regular file: '/dev/zero'
    """
    with open_file(path) as file:
        check_size(path, os.fstat(file.fileno()).st_size, most)
        data = file.read(most + 1) or b""  # None: /proc/kmsg says it is a file, and would wait
    check_size(path, len(data), most)
    return data


def check_size(path: Path, size: int, most: int) -> None:
    """Refuse a size, bytes, that is too large.

    Raises
    ------
    OSError
        If it is.
    """
    if size > most:
        raise OSError(errno.EFBIG, f"larger than {most} bytes", str(path))


def sha256_of_file(path: Path) -> str:
    """Return the hash of a regular file of any size.

    Raises
    ------
    OSError
        As `open_file`.
    """
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def parse_toml(data: bytes) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises
    ------
    ValueError
        If it is no TOML in UTF-8, or its keys are too deep; the message is one line.

    Examples
    --------
    >>> parse_toml(b"a.b = 1")
    {'a': {'b': 1}}
    """
    if any(lexeme["deep"] for lexeme in _LEXEME.finditer(data)):
        raise ValueError(f"a key of more than {KEY_PARTS} parts")
    try:
        return tomllib.loads(data.decode("utf-8-sig"))  # editors on Windows begin a file with a mark
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def resolved(path: Path) -> Path:
    """Return the absolute path without links; where it does not exist, as far as it does.

    Raises
    ------
    UsageError
        For a loop of links, or what cannot be a path.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: a loop
        why = "a loop of symbolic links" if isinstance(error, RuntimeError) else str(error)
        raise UsageError(f"{str(path)!r}: {why}, expected the path of a file") from error
