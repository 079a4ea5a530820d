"""The receiver of one axis: the Zenoh client around `Follower`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import zenoh

from .applied_record import AppliedRecord
from .client import Client, bytes_of, monotonic_s
from .follower import Applied, Follower
from .message import OffsetMessage
from .modes import Modes
from .settings import Settings


class Receiver(Client):
    """Receives the offset of one machine. Use it as a context manager, and call `poll` in your loop.

    Parameters
    ----------
    settings : Settings
        Machine, addresses and limits.
    applied_um : float
        Offset applied by the control at the start, µm.
    step_max_s : float
        Longest time between two calls of `poll` that counts for the movement, s. Messages after a longer pause are used
        only if they are fresh by the wall clock.
    clock, utc_ns : callable, optional
        Monotonic clock, s, and wall clock, ns.

    Attributes
    ----------
    follower : Follower
        Has `follow`, `hold`, `fade` and `rebase`.

    Raises
    ------
    ReceiverError
        Where the settings, the Zenoh configuration or the state file cannot be used.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        applied_um: float = 0.0,
        step_max_s: float = 1.0,
        clock: Callable[[], float] = monotonic_s,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        super().__init__(settings, "y/offset", ("y/offset",), clock=clock, utc_ns=utc_ns)
        self._record = AppliedRecord(Path(settings.applied_file)) if settings.applied_file else None
        self.follower = Follower(
            settings.machine, settings.limits(step_max_s=step_max_s), applied_um, self._last_sequence()
        )

    @property
    def _modes(self) -> Modes[OffsetMessage]:
        return self.follower

    def poll(self) -> Applied:
        """Process new messages, advance in time, and return the offset to apply.

        It waits for no message; with `state_file` it waits for the disk after each one that is accepted.
        """
        applied = self.follower.advance(self._receive_all())
        return replace(applied, reasons=applied.reasons + self._remarks)

    def _accept(self, now_s: float, sample: Any, utc_ns: Callable[[], int] | None, *, asked: bool) -> bool:
        payload = bytes_of(sample) if sample.kind == zenoh.SampleKind.PUT else b""
        return self.follower.receive(now_s, payload, utc_ns=utc_ns, asked=asked)

    def record(self, applied_um: float | None) -> None:
        """Record what the control has applied now, for probes; only with `applied_file`.

        Parameters
        ----------
        applied_um : float or None
            What was read back from the control or written to it, µm; None if it is not known.
        """
        if self._record is not None:
            self._append(self._record, applied_um)
