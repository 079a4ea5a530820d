"""Which lines of folders were handled, kept over a restart."""

from __future__ import annotations

import json
from pathlib import Path

from compensator.atomic_write import atomic_write
from compensator.errors import ConfigError
from compensator.input_file import read_file
from compensator.probes.table import Row

#: Longest state file, bytes.
STATE_BYTES = 50_000_000


class Handled:
    """Which lines were handled, kept over a restart.

    Parameters
    ----------
    path : pathlib.Path
        State file.
    keep_s : float
        Lines older than this are forgotten, s.

    Raises
    ------
    ConfigError
        If the file is there and cannot be read: lines might be sent twice.
    """

    def __init__(self, path: Path, keep_s: float) -> None:
        self._path = path
        self._keep_ns = round(keep_s * 1e9)
        self._lines: dict[str, str] = {}
        if not path.parent.is_dir():
            raise ConfigError(f"{path}: no such folder for the state of folders")
        try:
            kept = json.loads(read_file(path, STATE_BYTES))["handled"] if path.exists() else {}
            if not all(isinstance(part, str) for pair in kept.items() for part in pair):
                raise TypeError("expected texts")
            for identity in kept:
                _time_utc_ns(identity)
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise ConfigError(f"{path}: {error}; expected the state of folders; delete it to begin anew") from error
        self._lines.update(kept)
        self._changed = False

    def values(self, identity: str) -> str | None:
        """Return the values with which a line was handled; None if it was not."""
        return self._lines.get(identity)

    def add(self, line: Row) -> None:
        """Note that a line was handled; `write` keeps it."""
        self._lines[line.identity] = line.values
        self._changed = True

    def write(self, now_utc_ns: int) -> None:
        """Keep on disk what was added; a line that a crash loses is sent again, and the service refuses it as known.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        if not self._changed:
            return
        oldest = now_utc_ns - self._keep_ns
        self._lines = {key: value for key, value in self._lines.items() if _is_kept(key, oldest)}
        with atomic_write(self._path) as file:
            json.dump({"handled": self._lines}, file)
        self._changed = False


def _is_kept(identity: str, oldest_ns: int) -> bool:
    """Return whether a line is kept; one that could not be read again would end the next start."""
    try:
        return _time_utc_ns(identity) >= oldest_ns
    except ValueError:
        return False


def _time_utc_ns(identity: str) -> int:
    text = identity.partition(" ")[0]
    if not (text.isascii() and text.isdigit() and len(text) <= 19):
        raise ValueError(f"{identity[:40]!r}, expected a time and a feature")
    return int(text)
