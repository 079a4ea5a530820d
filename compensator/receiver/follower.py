"""The receiver's behaviour, without thread, clock or socket.

Only `Follower.advance` moves the applied offset, by at most `offset_rate_max_um_per_min` times the time since the
previous call, which counts for at most `step_max_s`. Therefore a start, a message, a new service, a reconnection, or an
interruption of the program for an hour cannot make the offset jump.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from .errors import ReceiverError
from .gate import Gate
from .limits import Limits
from .message import OffsetMessage, Rejected, parse_offset
from .modes import ARRIVED_UM, FollowerState, Modes, followed_s, moved
from .reasons import Reason, steady
from .values import finite, shown


@dataclass(frozen=True, slots=True, kw_only=True)
class Applied:
    """The offset to apply now, and why.

    Parameters
    ----------
    offset_um : float
        To be added to the commanded Y, µm.
    state : str
        `starting`: no usable message yet, the offset stays; `following`; `holding`; `fading`: to zero, on demand.
    reasons : tuple of Reason
        Why it does not follow, or remarks while it follows; `Reason.text` gives the text.
    arrived : bool
        Whether the offset has reached its target; false while it holds.
    age_s : float or None
        Age of the newest message of this machine, s.
    seq : int or None
        Its number.
    service_state : str or None
        Its state.
    """

    offset_um: float
    state: FollowerState
    reasons: tuple[Reason, ...]
    arrived: bool
    age_s: float | None
    seq: int | None
    service_state: str | None

    @property
    def text(self) -> str:
        """Return offset, state and reasons as one line of text."""
        why = " ".join(reason.marked for reason in self.reasons)
        return f"{self.offset_um:+.2f} µm, {self.state}" + (f": {why}" if why else "")

    @property
    def steady_reasons(self) -> str:
        """Return the reasons without the figures that change at every call, for logs that report changes only."""
        return steady(self.reasons)


class Follower(Modes[OffsetMessage]):
    """Follows one machine's offset.

    Parameters
    ----------
    machine : str
        Machine whose offset is followed; messages of other machines are dropped.
    limits : Limits
        Limits of the offset.
    applied_um : float
        Offset applied by the control at the start, µm; it moves from there.
    last_sequence : int
        Highest number used before a restart; −1 if unknown.

    Raises
    ------
    ReceiverError
        If the offset applied by the control is not a number within the limits: it must be corrected first.

    Examples
    --------
    >>> follower = Follower("vmc-07", Limits(offset_max_um=100.0, offset_rate_max_um_per_min=6.0), applied_um=2.0)
    >>> follower.advance(0.0).state
    'starting'
    >>> follower.receive(0.0, b'{"schema": 1, "machine": "vmc-07", "seq": 5, "time_utc_ns": 1, "valid_for_s": 150.0, '
    ...     b'"y_offset_um": -12.0, "y_offset_rate_um_per_min": 0.0, "y_offset_std_um": 0.4, "state": "ok", '
    ...     b'"reasons": [], "model_sha256": ""}')
    True
    >>> print(follower.advance(1.0).text)  # 6 µm/min: 0.1 µm in a second
    +1.90 µm, following: The offset is still moving to its value at the permitted rate. (to -12.00 µm) [catching_up]
    """

    def __init__(self, machine: str, limits: Limits, applied_um: float = 0.0, last_sequence: int = -1) -> None:
        super().__init__(Gate(machine, limits, self._check_size, last_sequence))
        self.limits = limits
        self.applied_um = 0.0
        self.rebase(applied_um)

    def rebase(self, applied_um: float) -> None:
        """Continue from the offset that the control applies, if it differs from the last one.

        Raises
        ------
        ReceiverError
            Where it is not a number within the limits.
        """
        number, most = finite(applied_um), self.limits.offset_max_um
        # A control that holds 32 bits, or adds up steps, has the limit itself a little beyond it.
        if number is None or abs(number) > most + ARRIVED_UM:
            raise ReceiverError(
                f"applied offset = {shown(applied_um)} µm: expected at most offset_max_um = {most:g}; "
                f"correct the control first"
            )
        self.applied_um = max(-most, min(most, number))

    # ------------------------------------------------------------------ messages

    def receive(
        self,
        now_s: float,
        payload: bytes,
        *,
        age_s: float | None = None,
        utc_ns: Callable[[], int] | None = None,
        asked: bool = False,
    ) -> bool:
        """Accept a message, or drop it with a reason; no payload raises an error.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        payload : bytes
            Payload as received.
        age_s : float, optional
            Wall clock minus the message's time, s, if it is to be checked; otherwise the message counts as measured
            now. After this only the monotonic clock is used, so setting the wall clock later has no effect.
        utc_ns : callable, optional
            Instead of `age_s`, the wall clock, ns since 1970 UTC.
        asked : bool
            Whether it is the answer to a query, which is not a replay even if a newer message arrived first.

        Returns
        -------
        bool
            Whether it is now the newest message.
        """
        try:
            message = parse_offset(payload)
            if utc_ns is not None:
                age_s = (utc_ns() - message.time_utc_ns) / 1e9
            return self._gate.accept(now_s, message, age_s, asked=asked)
        except Rejected as rejected:
            self._gate.reject(rejected.reason)
            return False

    def _check_size(self, message: OffsetMessage) -> None:
        if message.y_offset_um is not None and abs(message.y_offset_um) > self.limits.offset_max_um:
            detail = f"{message.y_offset_um:.2f} µm, expected at most {self.limits.offset_max_um:g}"
            raise Rejected(Reason("beyond_limit", detail))

    # ------------------------------------------------------------------ the applied offset

    def advance(self, now_s: float, payload: bytes | None = None) -> Applied:
        """Advance in time and return the offset to apply; only this method moves the offset.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s. A clock that moves backwards counts as stopped.
        payload : bytes, optional
            A message that has just arrived.
        """
        if payload is not None:
            self.receive(now_s, payload)
        step_s = self._step_s(now_s)
        state, target_um, reasons = self._wanted(now_s)
        arrived = False
        if target_um is not None:
            rate = self.limits.offset_rate_max_um_per_min
            if state == "fading":
                rate = min(rate, self._fade_rate_um_per_min)
            self.applied_um = moved(self.applied_um, target_um, rate * step_s / 60.0, self.limits.offset_max_um)
            arrived = abs(target_um - self.applied_um) <= ARRIVED_UM
            if state == "fading":
                reasons.append(Reason("faded") if self.applied_um == 0.0 else Reason("fading"))
            elif not arrived:
                reasons.append(Reason("catching_up", f"to {target_um:+.2f} µm"))
        held = self._gate.held
        return Applied(
            offset_um=self.applied_um,
            state=state,
            reasons=tuple(reasons),
            arrived=arrived,
            age_s=None if held is None else max(now_s - held.measured_s, 0.0),
            seq=None if held is None else held.message.seq,
            service_state=None if held is None else held.message.state,
        )

    def _wanted(self, now_s: float) -> tuple[FollowerState, float | None, list[Reason]]:
        """Return the state, the target of the offset (None: it is held), and the reasons so far."""
        state, held, reasons = self._state(now_s)
        if held is None:
            return state, 0.0 if state == "fading" else None, reasons
        message = held.message
        codes = ", ".join(message.reasons)
        if not message.usable or message.y_offset_um is None:
            return "holding", None, [Reason(f"service_{message.state}", codes), *reasons]
        if message.state == "degraded":
            reasons.append(Reason("service_degraded", codes))
        reasons.extend(message.unused)
        target_um = message.y_offset_um + message.y_offset_rate_um_per_min * followed_s(now_s, held) / 60.0
        largest = self.limits.offset_max_um
        if abs(target_um) > largest:
            target_um = math.copysign(largest, target_um)
            reasons.append(Reason("limit_reached", f"{largest:g} µm"))
        return state, target_um, reasons
