"""A control that prints lines: which of its lines become probes, with which time and which offset."""

from __future__ import annotations

import datetime
import zoneinfo
from collections.abc import Callable
from typing import cast

from compensator.clock import duration
from compensator.codes import ProbeSourceRemark
from compensator.probes.dprnt import Printed, Unusable, parse
from compensator.probes.lines import Bits, Line, Lines
from compensator.probes.probe import Probe
from compensator.probes.reports import SHOWN, Report, not_sent
from compensator.probes.settings import Dprnt, convention

#: Largest number of lines of others that are reported; the port may have another use.
_FOREIGN = 5
#: After so many unusable lines in a row only each so many is reported: a wrong baud rate makes several a second.
_REFUSED, _EACH = 20, 1000


class PrintedProbes:
    """Turns what arrives from a control into probes; no socket, no clock.

    Parameters
    ----------
    settings : Dprnt
        The control.
    submit : callable
        Called with each probe.
    applied_at : callable
        Returns the offset that the control had at a time, µm, or None; for lines without it.
    report : callable
        Called with a line for each line that is not used.
    """

    def __init__(
        self,
        settings: Dprnt,
        submit: Callable[[Probe], None],
        applied_at: Callable[[int], float | None],
        report: Report,
    ) -> None:
        self._settings = settings
        self._submit = submit
        self._applied_at = applied_at
        self._report = report
        self._zone = zoneinfo.ZoneInfo(settings.zone)
        self._foreign = 0
        self._refused = 0
        self._lines = Lines(cast(Bits, settings.bits))

    def disconnected(self) -> None:
        """Report the rest of a connection that has ended."""
        rest = self._lines.lost()
        if rest is not None:
            self._refuse(ProbeSourceRemark.LINE_BROKEN, rest.text, rest.broken)

    def receive(self, data: bytes, now_s: float, now_utc_ns: int, *, late: bool) -> None:
        """Handle bytes.

        Parameters
        ----------
        data : bytes
            As received.
        now_s, now_utc_ns : float and int
            Monotonic clock, s, and wall clock, ns, when they were read.
        late : bool
            Whether they may have been waiting for an unknown time.
        """
        for line in self._lines.feed(data, now_s, late=late):
            self._handle(line, now_utc_ns)

    def _handle(self, line: Line, now_utc_ns: int) -> None:
        if line.broken:
            self._refuse(ProbeSourceRemark.LINE_BROKEN, line.text, line.broken)
            return
        try:
            printed = parse(line.text)
        except Unusable as unusable:
            self._refuse(ProbeSourceRemark.LINE_BROKEN, line.text, str(unusable))
            return
        if printed is None:
            self._note_foreign(line.text)
        elif line.late:
            self._refuse(ProbeSourceRemark.LINE_AGE_UNKNOWN, line.text, "not read as it arrived")
        elif not (printed.feature or self._settings.feature):
            self._refuse(ProbeSourceRemark.NO_FEATURE, line.text, "no F, and no feature in the settings")
        else:
            self._probe(printed, line.text, now_utc_ns)

    def _probe(self, printed: Printed, text: str, now_utc_ns: int) -> None:
        settings = self._settings
        time_utc_ns = now_utc_ns - round((settings.delay_s + printed.age_s) * 1e9)
        if printed.printed_at is not None:
            printed_ns = self._utc_ns(printed.printed_at, now_utc_ns)
            difference_s = (now_utc_ns - printed_ns) / 1e9
            if abs(difference_s) > settings.clock_tolerance_s:
                order = "before" if difference_s > 0.0 else "after"
                why = f"printed {duration(abs(difference_s))} {order} its arrival by the control's clock"
                self._refuse(ProbeSourceRemark.LINE_CLOCK_DISAGREES, text, why)
                return
            time_utc_ns = printed_ns - round(printed.age_s * 1e9)
        offset_um = printed.offset_um
        if offset_um is None:
            offset_um = self._applied_at(time_utc_ns)
        if offset_um is None:
            self._refuse(ProbeSourceRemark.LINE_OFFSET_UNKNOWN, text, "no O, and no record of the offset at this time")
            return
        self._refused = 0
        measured_um = convention(settings).measured_um(printed.reading_um, offset_um)
        self._submit(
            Probe(
                time_utc_ns=time_utc_ns,
                measured_um=measured_um,
                offset_applied_um=offset_um,
                feature=printed.feature or settings.feature,
                tool=printed.tool,
                stopped_s=printed.stopped_s,
            )
        )

    def _utc_ns(self, at: datetime.datetime, now_utc_ns: int) -> int:
        """Return the printed time; of the hour that comes twice at the end of summer time, the one that is nearer."""
        both = [int(at.replace(tzinfo=self._zone, fold=fold).timestamp()) * 1_000_000_000 for fold in (0, 1)]
        return min(both, key=lambda time_utc_ns: abs(now_utc_ns - time_utc_ns))

    def _note_foreign(self, text: str) -> None:
        self._foreign += 1
        if self._foreign <= _FOREIGN:
            end = "; further ones are not reported" if self._foreign == _FOREIGN else ""
            self._report(f"{self._settings.name}: not a probe: {text[:SHOWN]!r}{end}")

    def _refuse(self, code: ProbeSourceRemark, text: str, why: str) -> None:
        self._refused += 1
        if self._refused > _REFUSED and self._refused % _EACH:
            return
        count = f" ({self._refused} in a row)" if self._refused >= _REFUSED else ""
        self._report(not_sent(code, self._settings.name, text, why, count=count))
