"""The receiver of several axes: the Zenoh client around `AxesFollower`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import zenoh

from .applied_record import AppliedRecord
from .axes_applied import NOTHING_READ, AppliedAxes, ControlState
from .axes_follower import AxesFollower
from .axes_settings import AxesSettings
from .client import ANSWER_TIMEOUT_S, Client, answered, bytes_of, monotonic_s, waiting
from .modes import Modes
from .sample import Sample
from .tool_length import ToolLength
from .values import finite


class AxesReceiver(Client):
    """Receives the offsets of several axes. Use it as a context manager, and call `poll` in your loop.

    Parameters
    ----------
    settings : AxesSettings
        Machine, addresses and limits.
    applied_um : mapping of str to float
        Offsets applied by the control at the start, µm; an axis that is not named starts at 0.
    step_max_s : float
        Longest time between two calls of `poll` that counts for the movement, s. Messages after a longer pause are used
        only if they are fresh by the wall clock.
    clock, utc_ns : callable, optional
        Monotonic clock, s, and wall clock, ns.

    Attributes
    ----------
    follower : AxesFollower
        Has `follow`, `hold`, `fade` and `rebase`.

    Raises
    ------
    ReceiverError
        Where the settings, the Zenoh configuration or the state file cannot be used.
    """

    def __init__(
        self,
        settings: AxesSettings,
        *,
        applied_um: Mapping[str, float] | None = None,
        step_max_s: float = 1.0,
        clock: Callable[[], float] = monotonic_s,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        source = settings.source
        # One subscription for all axes keeps the order in which they were published.
        latest = tuple(f"{axis}/offset" for axis in settings.axes)
        super().__init__(source, "*/offset", latest, clock=clock, utc_ns=utc_ns)
        self._records = _records(settings)
        self._signs = {axis: limits.sign for axis, limits in settings.linear.items()}
        self.follower = AxesFollower(
            source.machine,
            settings.axes,
            settings.tool,
            source.acceptance(step_max_s=step_max_s),
            applied_um,
            self._last_sequence(),
        )
        from_zenoh = settings.has_tilt and settings.tool is not None and settings.tool.length_from == "zenoh"
        self._length = ToolLength(source.machine) if from_zenoh else None
        self._lengths: Any = None
        self._length_answers: list[Any] = []

    @property
    def _modes(self) -> Modes[Sample]:
        return self.follower

    def poll(self, control: ControlState = NOTHING_READ) -> AppliedAxes:
        """Process new messages, advance in time, and return the offsets to apply.

        It waits for no message; with `state_file` it waits for the disk after each sample that is accepted.

        Parameters
        ----------
        control : ControlState
            What the control shows now: length of the tool and positions, as far as angles and slopes are applied.
        """
        now_s = self._receive_all()
        if self._length is not None:
            self._receive_lengths(now_s, self._length)
            control = replace(control, tool_length_mm=self._length.at(now_s))
        applied = self.follower.advance(now_s, control)
        more = self._remarks + (() if self._length is None else self._length.reasons)
        axes = {axis: replace(one, reasons=one.reasons + more) for axis, one in applied.axes.items()}
        return replace(applied, axes=axes, reasons=applied.reasons + more)

    def _accept(self, now_s: float, sample: Any, utc_ns: Callable[[], int] | None, *, asked: bool) -> bool:
        axis = str(sample.key_expr).removesuffix("/offset").rpartition("/")[2]
        if axis not in self.follower.axes:
            return False
        payload = bytes_of(sample) if sample.kind == zenoh.SampleKind.PUT else b""
        return self.follower.receive(now_s, axis, payload, utc_ns=utc_ns, asked=asked)

    def record(self, applied_um: Mapping[str, float | None]) -> None:
        """Record what the control has applied now, for probes; only with `applied_file`.

        Parameters
        ----------
        applied_um : mapping of str to (float or None)
            What was read back from the control or written to it, µm; None if it is not known. It is recorded in the
            direction in which the service measures, for Y in `applied_file`, for another axis in a file beside it.
        """
        for axis, record in self._records.items():
            um = finite(applied_um.get(axis))
            self._append(record, None if um is None else self._signs[axis] * um)

    # ------------------------------------------------------------------ the length of the tool

    def _declare(self, session: Any) -> None:
        super()._declare(session)
        if self._length is not None:
            key, ring = self._key("tool_length"), zenoh.handlers.RingChannel
            self._lengths = session.declare_subscriber(key, ring(32))
            handler: Any = zenoh.handlers.FifoChannel(32)
            self._length_answers.append(session.get(key, handler, timeout=ANSWER_TIMEOUT_S))

    def _receive_lengths(self, now_s: float, length: ToolLength) -> None:
        for sample in answered(self._length_answers):
            length.receive(now_s, bytes_of(sample), utc_ns=self._utc_ns, asked=True)
        if self._lengths is not None:
            utc_ns = self._utc_ns if self._paused or self._source.check_clock else None
            for sample in waiting(self._lengths):
                payload = bytes_of(sample) if sample.kind == zenoh.SampleKind.PUT else b""
                length.receive(now_s, payload, utc_ns=utc_ns)


def _records(settings: AxesSettings) -> dict[str, AppliedRecord]:
    """Return a record for each axis: Y has the file of the settings, as where it is alone."""
    if not settings.source.applied_file:
        return {}
    path = Path(settings.source.applied_file)
    files = {axis: path.with_name(f"{path.stem}-{axis}{path.suffix}") for axis in settings.linear}
    if "y" in files:
        files["y"] = path
    return {axis: AppliedRecord(file) for axis, file in files.items()}
