"""A record of the offset that the control had, on disk: what a probe needs that was read while the offset acted."""

from __future__ import annotations

import bisect
import math
from pathlib import Path

from .settings import read_file, write_file
from .values import finite

#: A value is written when it has changed by this, µm, and at least this often, s.
STEP_UM, EVERY_S = 0.02, 2.0
#: Shortest time between two lines, s.
SHORTEST_S = 0.1
#: Between two values further apart than this the offset is not known, s.
GAP_S = 10.0
#: Length at which the file is moved aside, bytes.
LONGEST = 2_000_000


class AppliedRecord:
    """Writes the record: a line `time_utc_ns offset_um` for each value, `-` where the offset was not known.

    Parameters
    ----------
    path : pathlib.Path
        The file; its predecessor is kept as `NAME.1`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last: tuple[int, float | None] | None = None

    def append(self, time_utc_ns: int, offset_um: float | None) -> None:
        """Write the offset that the control has now; most calls write nothing.

        Parameters
        ----------
        time_utc_ns : int
            Wall clock, ns since 1970 UTC.
        offset_um : float or None
            What was read back from the control, µm; None if it could not be read.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        offset_um = finite(offset_um)
        if self._last is not None and not self._is_due(time_utc_ns, offset_um):
            return
        if self._path.exists() and self._path.stat().st_size > LONGEST:
            self._path.replace(self._path.with_name(self._path.name + ".1"))
        write_file(self._path, f"{time_utc_ns} {'-' if offset_um is None else f'{offset_um:.3f}'}\n", append=True)
        self._last = (time_utc_ns, offset_um)

    def _is_due(self, time_utc_ns: int, offset_um: float | None) -> bool:
        assert self._last is not None
        before_ns, before_um = self._last
        passed_s = (time_utc_ns - before_ns) / 1e9
        if passed_s < 0.0 or passed_s >= EVERY_S or (offset_um is None) != (before_um is None):
            return True
        if offset_um is None or before_um is None or passed_s < SHORTEST_S:
            return False
        return abs(offset_um - before_um) >= STEP_UM


def applied_at(path: Path, time_utc_ns: int) -> float | None:
    """Return the offset that the control had at a time, µm; None if the record does not show it.

    Parameters
    ----------
    path : pathlib.Path
        The file that `AppliedRecord` writes.
    time_utc_ns : int
        Time, ns since 1970 UTC.
    """
    values = _of_last_clock([*_values(path.with_name(path.name + ".1")), *_values(path)])
    after = bisect.bisect_right(values, time_utc_ns, key=lambda value: value[0])
    if after == 0:
        return None
    from_ns, from_um = values[after - 1]
    if from_um is None:
        return None
    if after == len(values) or values[after][1] is None or values[after][0] - from_ns > GAP_S * 1e9:
        # Nothing later yet; a gap that begins here is bridged no further than the line before it.
        return from_um if time_utc_ns - from_ns <= 2.0 * EVERY_S * 1e9 else None
    to_ns, to_um = values[after]
    assert to_um is not None
    return from_um + (to_um - from_um) * (time_utc_ns - from_ns) / max(to_ns - from_ns, 1)


def _of_last_clock(lines: list[tuple[int, float | None]]) -> list[tuple[int, float | None]]:
    """Return the values in the order of their times: what was written before the clock was set back is replaced.

    Mixed, two values that follow each other might be of two clocks, and what is between them was never applied.
    """
    values: list[tuple[int, float | None]] = []
    for line in lines:
        if values and line[0] < values[-1][0]:
            while values and line[0] <= values[-1][0]:
                values.pop()
            if values:
                values.append((values[-1][0], None))  # from here to the line the offset is not known
        values.append(line)
    return values


def _values(path: Path) -> list[tuple[int, float | None]]:
    """Read the lines; half a line, as after a power cut, is left out."""
    try:
        lines = read_file(path, 2 * LONGEST).split(b"\n")[:-1]
    except OSError:
        return []
    values: list[tuple[int, float | None]] = []
    for line in lines:
        time, _, offset = line.partition(b" ")
        try:
            value = None if offset == b"-" else float(offset)
            if value is None or math.isfinite(value):
                values.append((int(time), value))
        except ValueError:
            continue
    return values
