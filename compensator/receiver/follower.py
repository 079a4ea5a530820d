"""The receiver's behaviour, without thread, clock or socket.

Only `Follower.advance` moves the applied offset, by at most `offset_rate_max_um_per_min` times the time since the
previous call, which counts for at most `step_max_s`. Therefore a start, a message, a new service, a reconnection, or an
interruption of the program for an hour cannot make the offset jump.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from .errors import ReceiverError
from .message import OffsetMessage, Rejected, parse_offset
from .reasons import Reason, printable
from .restart import CountRestart

#: Part of `valid_for_s` for which the published rate is followed: the rate holds until the next sample, and a message
#: is valid for two to three samples.
RATE_PART = 0.5
#: Closer than this the offset counts as arrived, µm.
ARRIVED_UM = 0.01
#: Largest value of each limit: more is a slip of the pen, and no limit at all.
LARGEST: Mapping[str, float] = {
    "offset_max_um": 5000.0,
    "offset_rate_max_um_per_min": 6000.0,
    "valid_max_s": 10_000.0,
    "step_max_s": 120.0,
    "clock_tolerance_s": 600.0,
}

FollowerState = Literal["starting", "following", "holding", "fading"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of the applied offset; each at most the value in `LARGEST`.

    Parameters
    ----------
    offset_max_um : float
        Largest offset, µm. A message beyond it is dropped.
    offset_rate_max_um_per_min : float
        Largest rate, µm/min.
    valid_max_s : float
        Longest time that a message may be used, regardless of its own validity, s.
    step_max_s : float
        Longest time between two calls of `advance` that counts for the movement, s.
    clock_tolerance_s : float
        Largest time by which a message may be ahead of the wall clock, s.
    """

    offset_max_um: float
    offset_rate_max_um_per_min: float
    valid_max_s: float = 600.0
    step_max_s: float = 1.0
    clock_tolerance_s: float = 5.0

    def __post_init__(self) -> None:
        for name, largest in LARGEST.items():
            value = getattr(self, name)
            if not 0.0 < value <= largest:
                raise ReceiverError(f"{name} = {value}: expected a number above 0, at most {largest:g}")


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
        changing = ("catching_up", "expired")
        return " ".join((Reason(r.code) if r.code in changing else r).marked for r in self.reasons)


@dataclass(slots=True)
class _Held:
    """The newest message, and when it was measured on the monotonic clock."""

    message: OffsetMessage
    measured_s: float
    valid_s: float


@dataclass(slots=True)
class Follower:
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

    machine: str
    limits: Limits
    applied_um: float = 0.0
    last_sequence: int = -1
    alive: bool | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    _held: _Held | None = None
    _rejected: Reason | None = None
    _mode: Literal["follow", "hold", "fade"] = "follow"
    _fade_rate_um_per_min: float = 0.0
    _advanced_s: float | None = None
    _restart: CountRestart = field(default_factory=CountRestart)
    _restarted: Reason | None = None

    def __post_init__(self) -> None:
        self.rebase(self.applied_um)

    # ------------------------------------------------------------------ modes

    def follow(self) -> None:
        """Follow the machine, again after `hold` or `fade`."""
        self._mode = "follow"

    def hold(self) -> None:
        """Freeze the offset at its present value."""
        self._mode = "hold"

    def fade(self, rate_um_per_min: float) -> None:
        """Move the offset to zero, at this rate but never faster than the limit.

        Raises
        ------
        ReceiverError
            Where the rate is not above 0.
        """
        if not (math.isfinite(rate_um_per_min) and rate_um_per_min > 0.0):
            raise ReceiverError(f"fade rate = {rate_um_per_min} µm/min: expected a number above 0")
        self._mode, self._fade_rate_um_per_min = "fade", rate_um_per_min

    def rebase(self, applied_um: float) -> None:
        """Continue from the offset that the control applies, if it differs from the last one.

        Raises
        ------
        ReceiverError
            Where it is not a number within the limits.
        """
        if not (math.isfinite(applied_um) and abs(applied_um) <= self.limits.offset_max_um):
            raise ReceiverError(
                f"applied offset = {applied_um} µm: expected at most offset_max_um = {self.limits.offset_max_um:g}; "
                f"correct the control first"
            )
        self.applied_um = float(applied_um)

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
            accepted = self._check(now_s, message, age_s, asked)
        except Rejected as rejected:
            self._rejected = rejected.reason
            self.dropped[rejected.reason.code] = self.dropped.get(rejected.reason.code, 0) + 1
            return False
        if not accepted:
            return False
        self._restarted = None
        if message.seq < self.last_sequence:
            self._restarted = Reason("count_restarted", f"number {message.seq} after {self.last_sequence}")
        self._restart.clear()
        self._held = _Held(message, now_s - max(age_s or 0.0, 0.0), self._valid_s(message))
        self.last_sequence = message.seq
        self._rejected = None
        return True

    def _valid_s(self, message: OffsetMessage) -> float:
        return min(message.valid_for_s, self.limits.valid_max_s)

    def _check(self, now_s: float, message: OffsetMessage, age_s: float | None, asked: bool) -> bool:
        if message.machine != self.machine:
            raise Rejected(Reason("other_machine", f"{printable(message.machine, 64)}, expected {self.machine}"))
        # The query at the start may return a message twice. After a restart the newest one may be queried again; its
        # age is checked as for any other message.
        again = message.seq == self.last_sequence
        if again and (self._held is not None or not asked):
            if self._held is not None and message == self._held.message:
                return False
            raise Rejected(Reason("replayed", f"number {message.seq} was used before"))
        if message.seq < self.last_sequence:
            if asked:
                return False
            self._check_restart(now_s, message, age_s)
        self._check_value(message, age_s)
        return True

    def _check_restart(self, now_s: float, message: OffsetMessage, age_s: float | None) -> None:
        """Drop a message with a lower number, unless the service evidently counts from there."""
        detail = f"number {message.seq} after {self.last_sequence}"
        if self._held is not None and now_s - self._held.measured_s <= self._held.valid_s:
            raise Rejected(Reason("replayed", detail))
        try:
            self._check_value(message, age_s)
        except Rejected as rejected:
            raise Rejected(Reason("replayed", detail)) from rejected
        if not self._restart.is_shown_by(now_s, message, self._valid_s(message)):
            raise Rejected(Reason("replayed", detail))

    def _check_value(self, message: OffsetMessage, age_s: float | None) -> None:
        if age_s is not None:
            self._check_age(message, age_s)
        if message.y_offset_um is not None and abs(message.y_offset_um) > self.limits.offset_max_um:
            detail = f"{message.y_offset_um:.2f} µm, expected at most {self.limits.offset_max_um:g}"
            raise Rejected(Reason("beyond_limit", detail))

    def _check_age(self, message: OffsetMessage, age_s: float) -> None:
        if not age_s >= -self.limits.clock_tolerance_s:
            raise Rejected(Reason("clock_disagrees", f"{-age_s:.1f} s ahead of the wall clock here"))
        if age_s > self._valid_s(message):
            raise Rejected(Reason("late", f"{age_s:.1f} s old by the wall clock, valid for {message.valid_for_s:g} s"))

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
        elapsed_s = 0.0 if self._advanced_s is None else now_s - self._advanced_s
        self._advanced_s = now_s
        step_s = min(max(elapsed_s, 0.0), self.limits.step_max_s)
        state, target_um, reasons = self._wanted(now_s)
        arrived = False
        if target_um is not None:
            rate = self.limits.offset_rate_max_um_per_min
            if state == "fading":
                rate = min(rate, self._fade_rate_um_per_min)
            self._move(target_um, rate * step_s / 60.0)
            arrived = abs(target_um - self.applied_um) <= ARRIVED_UM
            if state == "fading":
                reasons.append(Reason("faded") if self.applied_um == 0.0 else Reason("fading"))
            elif not arrived:
                reasons.append(Reason("catching_up", f"to {target_um:+.2f} µm"))
        held = self._held
        return Applied(
            offset_um=self.applied_um,
            state=state,
            reasons=tuple(reasons),
            arrived=arrived,
            age_s=None if held is None else max(now_s - held.measured_s, 0.0),
            seq=None if held is None else held.message.seq,
            service_state=None if held is None else held.message.state,
        )

    def _move(self, target_um: float, step_um: float) -> None:
        distance_um = target_um - self.applied_um
        if abs(distance_um) <= step_um:
            self.applied_um = target_um
        else:
            moved = self.applied_um + math.copysign(step_um, distance_um)
            self.applied_um = max(-self.limits.offset_max_um, min(self.limits.offset_max_um, moved))

    def _wanted(self, now_s: float) -> tuple[FollowerState, float | None, list[Reason]]:
        """Return the state, the target of the offset (None: it is held), and the reasons so far."""
        reasons = [reason for reason in (self._rejected, self._restarted) if reason is not None]
        if self.alive is False:
            reasons.append(Reason("service_gone"))
        if self._mode == "fade":
            return "fading", 0.0, reasons
        if self._mode == "hold":
            return "holding", None, [Reason("held_here"), *reasons]
        held = self._held
        if held is None:
            return "starting", None, [Reason("no_message"), *reasons]
        message, age_s = held.message, now_s - held.measured_s
        codes = ", ".join(message.reasons)
        if age_s > held.valid_s:
            return "holding", None, [Reason("expired", f"{age_s:.0f} s old, valid for {held.valid_s:g} s"), *reasons]
        if not message.usable or message.y_offset_um is None:
            return "holding", None, [Reason(f"service_{message.state}", codes), *reasons]
        if message.state == "degraded":
            reasons.append(Reason("service_degraded", codes))
        followed_s = max(0.0, min(age_s, RATE_PART * held.valid_s))
        target_um = message.y_offset_um + message.y_offset_rate_um_per_min * followed_s / 60.0
        largest = self.limits.offset_max_um
        if abs(target_um) > largest:
            target_um = math.copysign(largest, target_um)
            reasons.append(Reason("limit_reached", f"{largest:g} µm"))
        return "following", target_um, reasons

    # ------------------------------------------------------------------ over a restart

    def snapshot(self) -> dict[str, Any]:
        """Return what must survive a restart."""
        return {"machine": self.machine, "last_sequence": self.last_sequence}
