"""Sends probes one after the other, in order; what cannot be sent is retried with its own time, and then given up."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Literal, NamedTuple

from compensator.clock import duration
from compensator.codes import ProbeCode, ProbeSourceRemark, Remark
from compensator.errors import one_line
from compensator.probes.probe import NotSent, Probe, ProbeSink
from compensator.probes.reports import Report

log = logging.getLogger("compensator")

#: What became of a probe.
Outcome = Literal["sent", "refused", "given up"]
#: Largest number of probes that wait; a source that floods must not fill the memory.
WAITING = 200


class _Waiting(NamedTuple):
    probe: Probe
    source: str
    done: Callable[[Outcome], None]


class ProbeQueue:
    """Sends what the sources submit.

    Parameters
    ----------
    sink : ProbeSink
        Where probes go; called on a separate thread, one at a time.
    send_within_s : float
        A probe older than this is not sent any more, s.
    retry_s : float
        Pause after an attempt without answer, s.
    report : callable, optional
        Called with a line for each probe that was sent or not; the log by default.
    utc_ns : callable, optional
        Wall clock, ns.
    """

    def __init__(
        self,
        sink: ProbeSink,
        *,
        send_within_s: float,
        retry_s: float = 5.0,
        report: Report = log.info,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._sink = sink
        self.send_within_s = send_within_s
        self._retry_s = retry_s
        # The service's reply and the name of a file are a stranger's words.
        self._report: Report = lambda text: report(one_line(text))
        self._utc_ns = utc_ns
        self._waiting: deque[_Waiting] = deque()
        self._changed = asyncio.Event()
        self._trouble = ""

    def submit(self, probe: Probe, source: str, done: Callable[[Outcome], None] = lambda _: None) -> None:
        """Send a probe as soon as possible.

        Parameters
        ----------
        probe : Probe
            The measured value.
        source : str
            Its source, for the log.
        done : callable, optional
            Called with the outcome; not called for what is still waiting when the sender ends.
        """
        if len(self._waiting) >= WAITING:
            self._give_up(self._waiting.popleft(), f"{WAITING} probes are waiting")
        self._waiting.append(_Waiting(probe, source, done))
        self._changed.set()

    def has_room(self) -> bool:
        """Return whether a source that can wait may submit; half of the places is for those that cannot."""
        return len(self._waiting) < WAITING // 2

    async def run(self, stop: asyncio.Event) -> None:
        """Send until `stop` is set; reports what is then still waiting."""
        while not stop.is_set():
            self._changed.clear()
            if self._waiting and not await self._send_first():
                await pause(stop, self._retry_s)
            elif not self._waiting:
                await _either(stop, self._changed)
        for waiting in self._waiting:
            self._report(f"{waiting.source}: not sent before the end: {waiting.probe.text}")

    async def _send_first(self) -> bool:
        """Send the first probe, or give it up; return whether to go on at once."""
        first = self._waiting[0]
        age_s = (self._utc_ns() - first.probe.time_utc_ns) / 1e9
        if age_s > self.send_within_s:
            self._waiting.popleft()
            self._give_up(first, f"{duration(age_s)} old, sent within {duration(self.send_within_s)}")
            return True
        try:
            reply = await asyncio.to_thread(self._sink.send, first.probe)
        except NotSent as error:
            if str(error) != self._trouble:
                self._trouble = str(error)
                self._report(f"{first.source}: {error}; retrying")
            return False
        if reply.code == ProbeCode.TOO_MANY:
            # More than the service uses with one sample: the next sample makes room.
            if reply.text != self._trouble:
                self._trouble = reply.text
                self._report(f"{first.source}: {reply.text} [{reply.code}]; retrying")
            return False
        self._trouble = ""
        if self._waiting and self._waiting[0] is first:  # else it was given up meanwhile
            self._waiting.popleft()
        outcome: Outcome = "sent" if reply.ok else "refused"
        code = f" [{reply.code}]" if reply.code else ""
        self._report(f"{first.source}: {outcome}: {first.probe.text}: {reply.text}{code}")
        first.done(outcome)
        return True

    def _give_up(self, waiting: _Waiting, why: str) -> None:
        figures = f"{waiting.source}: given up: {waiting.probe.text}: {why}."
        self._report(Remark(ProbeSourceRemark.PROBE_NOT_SENT, figures).marked)
        waiting.done("given up")


async def pause(stop: asyncio.Event, seconds: float) -> None:
    """Wait, at most until `stop` is set."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(stop.wait(), seconds)


async def _either(*events: asyncio.Event) -> None:
    waits = [asyncio.ensure_future(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
        await asyncio.gather(*waits, return_exceptions=True)
