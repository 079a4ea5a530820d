"""The file that LinuxCNC writes between `(PROBEOPEN …)` and `(PROBECLOSE)`: nine numbers for each probe.

The numbers are X Y Z A B C U V W in the program's coordinates and unit. They carry neither time nor feature: the time
is that of the write, and each feature has a file of its own.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from pathlib import Path

from compensator.codes import ProbeSourceRemark
from compensator.input_file import read_file
from compensator.probes.probe import Probe
from compensator.probes.reports import Report, lost, not_sent
from compensator.probes.sender import pause
from compensator.probes.settings import UNITS_UM, LinuxCnc, convention
from compensator.receiver.client import monotonic_s

NUMBERS = 9
#: Column of the axis, Y.
COLUMN = 1
#: A file this long is not one of ours, bytes.
LONGEST = 1_000_000


class ProbeFile:
    """Follows one file.

    Parameters
    ----------
    settings : LinuxCnc
        File, feature and where it belongs.
    submit : callable
        Called with each probe.
    applied_at : callable
        Returns the offset that the control had at a time, µm, or None.
    report : callable
        Called with a line for each line that is not used.
    clock, utc_ns : callable, optional
        Monotonic clock, s, and wall clock, ns.
    """

    def __init__(
        self,
        settings: LinuxCnc,
        submit: Callable[[Probe], None],
        applied_at: Callable[[int], float | None],
        report: Report,
        *,
        clock: Callable[[], float] = monotonic_s,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._settings = settings
        self._path = Path(settings.file)
        self._submit = submit
        self._applied_at = applied_at
        self._report = report
        self._clock, self._utc_ns = clock, utc_ns
        #: Whole lines at the last poll; None while the file is absent.
        self._known: bytes | None = None
        self._polled_s: float | None = None
        self._trouble = ""

    async def run(self, stop: asyncio.Event) -> None:
        """Follow it until `stop` is set."""
        while not stop.is_set():
            self.poll()
            await pause(stop, self._settings.poll_s)

    def poll(self) -> None:
        """Read the lines that are new since the last call."""
        now_s = self._clock()
        late = self._polled_s is None or now_s - self._polled_s > self._settings.pause_s
        self._polled_s = now_s
        try:
            content = self._content()
        except FileNotFoundError:
            self._known = None
            return
        if content is None:
            return
        # Opened anew it is empty until the probe touches, which takes longer than a poll. The same content again is
        # therefore no new probe, and another one that was never empty may have lines of any time: somebody edited it,
        # or put it here. So may several lines at once: nobody touches twice within a poll.
        known = self._known
        begin = len(known) if known and content.startswith(known) else 0
        lines = content[begin:].split(b"\n")[:-1]
        late = late or (begin == 0 and known != b"") or len(lines) > 1
        self._known = content
        for line in lines:
            self._handle(line.decode("ascii", "replace"), late)

    def _content(self) -> bytes | None:
        """Return the whole lines of the file; None if it cannot be read, or holds no more than half a line.

        Raises
        ------
        FileNotFoundError
            If it is absent.
        """
        try:
            content = read_file(self._path, LONGEST)
        except FileNotFoundError:
            raise
        except OSError as error:
            why = error.strerror or str(error)
            if why != self._trouble:
                self._trouble = why
                self._report(lost(self._path, why))
            return None
        self._trouble = ""
        return content[: content.rfind(b"\n") + 1] if not content or b"\n" in content else None

    def _handle(self, line: str, late: bool) -> None:
        settings, now_utc_ns = self._settings, self._utc_ns()
        try:
            numbers = [float(word) for word in line.split()]
        except ValueError:
            numbers = []
        if len(numbers) != NUMBERS or not all(map(math.isfinite, numbers)):
            self._refuse(ProbeSourceRemark.LINE_BROKEN, line, f"expected {NUMBERS} numbers")
            return
        reading_um = (numbers[COLUMN] - settings.nominal) * UNITS_UM[settings.unit]
        if abs(reading_um) > settings.within_um:
            why = f"{reading_um:+.1f} µm from {settings.nominal:g}, expected at most {settings.within_um:g}"
            self._refuse(ProbeSourceRemark.LINE_BROKEN, line, why)
            return
        written_ns = self._written_ns()
        if late or not 0 <= now_utc_ns - written_ns <= settings.pause_s * 1e9:
            self._refuse(ProbeSourceRemark.LINE_AGE_UNKNOWN, line, "not read as it was written")
            return
        offset_um = self._applied_at(written_ns)
        if offset_um is None:
            self._refuse(ProbeSourceRemark.LINE_OFFSET_UNKNOWN, line, "no record of the offset at this time")
            return
        self._submit(
            Probe(
                time_utc_ns=written_ns,
                measured_um=convention(settings).measured_um(reading_um, offset_um),
                offset_applied_um=offset_um,
                feature=settings.feature,
                tool=settings.tool,
            )
        )

    def _written_ns(self) -> int:
        try:
            return self._path.stat().st_mtime_ns
        except OSError:
            return 0

    def _refuse(self, code: ProbeSourceRemark, line: str, why: str) -> None:
        self._report(not_sent(code, self._path, line, why))
