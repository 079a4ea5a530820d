"""A watched folder of CSV files: each line is sent once, with its own time, over restarts and rewritten files."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from compensator.clock import Clock, SystemClock, duration
from compensator.codes import ProbeSourceRemark
from compensator.errors import UsageError
from compensator.input_file import read_file
from compensator.probes.handled import Handled
from compensator.probes.probe import Probe
from compensator.probes.reports import Report, lost, not_sent
from compensator.probes.sender import Outcome, pause
from compensator.probes.settings import Folder, convention
from compensator.probes.table import BadLine, NoFeature, Row, columns, row

#: Longest file, bytes; 100 000 lines.
LONGEST = 10_000_000
#: A line farther ahead of this computer's clock than this waits until the clock is set forward by more than this, ns.
AHEAD_NS = 5_000_000_000
#: So many lines and files are read before the other sources have their turn.
READ_AT_ONCE = 200


class _Signature(NamedTuple):
    """A file's content has not changed while this has not."""

    inode: int
    size: int
    mtime_ns: int


@dataclass(slots=True)
class _Ahead:
    """A line that was ahead of the clock here.

    Parameters
    ----------
    path : pathlib.Path
        Its file.
    time_utc_ns : int
        Its time.
    set_to_ns : int
        Wall clock less monotonic clock when it was found, or last so far ahead.
    """

    path: Path
    time_utc_ns: int
    set_to_ns: int

    def is_due(self, clock: Clock) -> bool:
        """Return whether the clock was set since, so that the line was right, and has reached it.

        That time has passed does not make it right: written with a wrong clock, it would be sent as touched just now.
        """
        utc_ns = clock.utc_ns()
        set_to_ns = utc_ns - clock.monotonic_ns()
        if set_to_ns - self.set_to_ns <= AHEAD_NS:
            return False
        if self.time_utc_ns - utc_ns > AHEAD_NS:
            self.set_to_ns = set_to_ns
        return self.time_utc_ns <= utc_ns


class WatchedFolder:
    """Looks into a folder.

    Parameters
    ----------
    settings : Folder
        The folder.
    handled : Handled
        Which lines were handled; shared by all folders.
    submit : callable
        Called with each probe, the name of its file, and a function to call with the outcome.
    applied_at : callable
        Returns the offset that the control had at a time, µm, or None; for lines without it.
    send_within_s : float
        A line older than this is not sent, s.
    has_room : callable, optional
        Returns whether another probe can be submitted now; lines wait in their file until then.
    report : callable
        Called with a line for each line that is not sent.
    clock : Clock, optional
        That of this computer.
    """

    def __init__(
        self,
        settings: Folder,
        handled: Handled,
        submit: Callable[[Probe, str, Callable[[Outcome], None]], None],
        applied_at: Callable[[int], float | None],
        report: Report,
        *,
        send_within_s: float,
        has_room: Callable[[], bool] = lambda: True,
        clock: Clock | None = None,
    ) -> None:
        self._settings = settings
        self._handled = handled
        self._submit = submit
        self._applied_at = applied_at
        self._report = report
        self._send_within_ns = round(send_within_s * 1e9)
        self._has_room = has_room
        self._clock = clock or SystemClock()
        self._to_read: dict[Path, None] = {}
        self._reading: Iterator[None] = iter(())
        self._seen: dict[Path, _Signature] = {}
        self._read: dict[Path, _Signature] = {}
        #: By identity; they count as handled, so that none is sent by another start, which cannot know of the clock.
        self._ahead: dict[str, _Ahead] = {}
        self._pending: dict[str, str] = {}
        self._reported: set[tuple[Path, str]] = set()

    async def run(self, stop: asyncio.Event) -> None:
        """Look until `stop` is set."""
        while not stop.is_set():
            going_on = self.poll()
            while going_on and not stop.is_set():
                await asyncio.sleep(0)
                going_on = self.read_on()
            await pause(stop, self._settings.poll_s)

    def poll(self) -> bool:
        """Look once; a file is read when it is the same as at the call before, so that no write is under way.

        Returns
        -------
        bool
            Whether there is more to read at once, by `read_on`.
        """
        self.keep()
        found = dict(self._files())
        oldest_ns = self._clock.utc_ns() - self._send_within_ns
        self._ahead = {identity: one for identity, one in self._ahead.items() if one.time_utc_ns >= oldest_ns}
        for ahead in self._ahead.values():
            if ahead.is_due(self._clock):
                self._read.pop(ahead.path, None)
        for path, signature in found.items():
            if self._read.get(path) != signature and self._seen.get(path) == signature:
                self._read[path] = signature
                self._to_read[path] = None
        self._seen = found
        self._read = {path: signature for path, signature in self._read.items() if path in found}
        going_on = self.read_on()
        self.keep()
        return going_on

    def read_on(self) -> bool:
        """Read at most `READ_AT_ONCE` lines and files, as far as there is room; return whether to go on at once."""
        for _ in range(READ_AT_ONCE):
            if not self._has_room():
                return False
            try:
                next(self._reading)
            except StopIteration:
                if not self._to_read:
                    return False
                path = next(iter(self._to_read))
                del self._to_read[path]
                self._reading = self._read_file(path)
        return True

    def keep(self) -> None:
        """Keep on disk which lines were handled."""
        try:
            self._handled.write(self._clock.utc_ns())
        except (OSError, UsageError) as error:
            self._trouble(Path(self._settings.path), error)

    def _files(self) -> Iterator[tuple[Path, _Signature]]:
        folder = Path(self._settings.path)
        try:
            paths = sorted(folder.glob(self._settings.pattern))
            if not folder.is_dir():
                raise FileNotFoundError(2, "no such folder")
        except (OSError, ValueError) as error:  # of a pattern
            self._trouble(folder, error)
            return
        for path in paths:
            try:
                status = path.stat()
            except OSError:
                continue  # removed meanwhile
            if path.is_file():
                yield path, _Signature(status.st_ino, status.st_size, status.st_mtime_ns)

    def _read_file(self, path: Path) -> Iterator[None]:
        """Handle the lines of a file, one with each step."""
        try:
            content = read_file(path, LONGEST)
        except OSError as error:
            self._read.pop(path, None)
            self._trouble(path, error)
            return
        text = content.decode("utf-8", "surrogateescape").replace("\r\n", "\n").replace("\r", "\n")
        *lines, rest = text.split("\n")
        if rest:
            self._refuse(path, ProbeSourceRemark.LINE_INCOMPLETE, rest, "no line end")
        if not lines:
            return
        try:
            names = columns(lines[0])
        except BadLine as bad:
            self._refuse(path, ProbeSourceRemark.ROW_BROKEN, lines[0], str(bad))
            return
        old = 0
        for line in lines[1:]:
            old += self._handle(path, names, line)
            yield
        if old:
            why = f"{old} line(s) older than {duration(self._send_within_ns / 1e9)}"
            self._refuse(path, ProbeSourceRemark.PROBE_NOT_SENT, "", why)
        if any(one.path == path for one in self._ahead.values()):
            why = "line(s) ahead of this computer's clock, not sent before it is set"
            self._refuse(path, ProbeSourceRemark.LINE_AHEAD, "", why)

    def _handle(self, path: Path, names: list[str], text: str) -> bool:
        """Submit a line that is new; return whether it was not because it is too old."""
        if not text.strip():
            return False
        try:
            line = row(names, text)
        except (BadLine, ValueError, ArithmeticError) as bad:  # No content of a file may end the program.
            code = ProbeSourceRemark.NO_FEATURE if isinstance(bad, NoFeature) else ProbeSourceRemark.ROW_BROKEN
            self._refuse(path, code, text, str(bad))
            return False
        before = self._handled.values(line.identity) or self._pending.get(line.identity)
        if before is not None:
            if before != line.values:
                self._refuse(path, ProbeSourceRemark.LINE_CHANGED, text, "sent before with other values")
                return False
            ahead = self._ahead.get(line.identity)
            if ahead is None or not ahead.is_due(self._clock):
                return False
            del self._ahead[line.identity]
        utc_ns = self._clock.utc_ns()
        if utc_ns - line.time_utc_ns > self._send_within_ns:
            return True
        if line.time_utc_ns - utc_ns > AHEAD_NS:
            # As until NTP has set the clock here after a boot: the service would refuse the probe for good.
            self._ahead[line.identity] = _Ahead(path, line.time_utc_ns, utc_ns - self._clock.monotonic_ns())
            self._handled.add(line)
            return False
        offset_um = line.offset_applied_um
        if offset_um is None:
            offset_um = self._applied_at(line.time_utc_ns)
        if offset_um is None:
            why = "no offset_applied_um, and no record of the offset at this time"
            self._refuse(path, ProbeSourceRemark.LINE_OFFSET_UNKNOWN, text, why)
            return False
        self._pending[line.identity] = line.values
        self._submit(self._probe(line, offset_um), path.name, lambda _: self._done(line))
        return False

    def _probe(self, line: Row, offset_um: float) -> Probe:
        return Probe(
            time_utc_ns=line.time_utc_ns,
            measured_um=convention(self._settings).measured_um(line.measured_um, offset_um),
            offset_applied_um=offset_um,
            feature=line.feature,
            tool=line.tool,
            std_um=line.std_um,
            stopped_s=line.stopped_s,
        )

    def _done(self, line: Row) -> None:
        """Note a line as handled; the next look keeps it."""
        self._handled.add(line)
        self._pending.pop(line.identity, None)

    def _trouble(self, path: Path, error: OSError | UsageError | ValueError) -> None:
        self._once(path, lost(path, getattr(error, "strerror", None) or error))

    def _refuse(self, path: Path, code: ProbeSourceRemark, text: str, why: str) -> None:
        self._once(path, not_sent(code, path, text.strip() or None, why))

    def _once(self, path: Path, words: str) -> None:
        """Report once what every look would find again."""
        if (path, words) not in self._reported:
            if len(self._reported) > 10_000:
                self._reported.clear()
            self._reported.add((path, words))
            self._report(words)
