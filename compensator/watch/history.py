"""The last day of a machine as received: one point per minute."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

from msgspec import UnsetType

from compensator.clock import HOUR_NS, NS
from compensator.messages import Candidate, EstimateMessage, Offset, Sample, Status

#: Length of the history and of one point, ns.
SPAN_NS = 24 * HOUR_NS
STEP_NS = 60 * NS
#: A point farther ahead of the watch's clock than this is dropped, ns: clocks differ by seconds or minutes, and points
#: ahead would never be older than a day.
AHEAD_NS = 300 * NS
#: Most characters of the reasons of a point; what a stranger publishes is kept for a day.
LONGEST_REASONS = 2000
#: Shortest pause that separates two intervals in the same state, s.
LEAST_PAUSE_S = 150.0
#: Values of a point from the estimate and from the offset.
_ESTIMATE = ("heat_w", "y_dtf_um", "y_tdtf_um", "y_base_um", "y_pred_um", "residual_um")
_OFFSET = ("y_offset_um", "y_offset_std_um", "state")
#: Columns of the history in addition to time and effects.
COLUMNS = (*_OFFSET, "reasons", *_ESTIMATE, "t_q_degc", "at_degc")


class StateInterval(NamedTuple):
    """An interval in one state with the same reasons.

    Parameters
    ----------
    begin_s, end_s : float
        Its first point and the end of its last, s since 1970.
    state : str
        State of the service.
    reasons : str
        Codes, separated by spaces.
    """

    begin_s: float
    end_s: float
    state: str
    reasons: str


class MachineHistory:
    """Points of the last day; messages may arrive in any order.

    The newest sample of a minute is its point. The values of one sample come in several messages with the same number.
    A value that did not arrive is None. No point is older than a day or farther ahead than `AHEAD_NS`, so their number
    is limited.
    """

    def __init__(self) -> None:
        self._points: dict[int, dict[str, Any]] = {}
        #: Minute of the last `prune`: within one no point becomes too old.
        self._pruned = -1

    def __len__(self) -> int:
        return len(self._points)

    def add(self, message: Sample | EstimateMessage | Offset, now_ns: int) -> None:
        """Add a message, and remove points that are no longer of the last day.

        Parameters
        ----------
        message : Sample, EstimateMessage or Offset
            A message of any time.
        now_ns : int
            The clock of the watch, ns since 1970 UTC.
        """
        self.prune(now_ns)
        bucket = message.time_utc_ns // STEP_NS
        if not _is_of_the_day(bucket, now_ns):
            return
        point = self._points.get(bucket)
        if point is None or message.seq > point["seq"]:
            point = self._points[bucket] = {"seq": message.seq, "time_utc_ns": message.time_utc_ns}
        elif message.seq < point["seq"]:
            return
        if isinstance(message, Sample):
            for name in ("t_q_degc", "at_degc"):
                point[name] = usable(message, name)
        elif isinstance(message, EstimateMessage):
            point |= {name: getattr(message, name) for name in _ESTIMATE}
            point["effects"] = message.y_effects_um
        else:
            point |= {name: getattr(message, name) for name in _OFFSET}
            point["reasons"] = " ".join(message.reasons)[:LONGEST_REASONS]

    def add_candidate(self, status: Status) -> None:
        """Add the prediction of the model in shadow, which comes with the status of a sample."""
        point = self._points.get(status.time_utc_ns // STEP_NS)
        if not isinstance(status.loop, UnsetType) and point is not None and point["seq"] == status.seq:
            point["candidate_um"] = status.loop.y_pred_um

    def add_recorded_candidate(self, message: Candidate) -> None:
        """Add a recorded prediction of a model in shadow: of several the last candidate, as a status has it."""
        point = self._points.get(message.time_utc_ns // STEP_NS)
        if point is None or point["seq"] != message.seq:
            return
        if message.role == "candidate" or "candidate_um" not in point:
            point["candidate_um"] = message.y_pred_um

    def prune(self, now_ns: int) -> None:
        """Remove points older than a day, and those ahead, which remain if the clock was set back."""
        if now_ns // STEP_NS == self._pruned:
            return
        self._pruned = now_ns // STEP_NS
        for bucket in [bucket for bucket in self._points if not _is_of_the_day(bucket, now_ns)]:
            del self._points[bucket]

    def misfit(self, now_ns: int, minutes: int) -> tuple[float, float, int]:
        """Return the medians of |residual| and of the stated standard deviation over the last minutes.

        Parameters
        ----------
        now_ns : int
            Now, ns since 1970 UTC.
        minutes : int
            Length of the interval, min.

        Returns
        -------
        (float, float, int)
            Both medians, µm (NaN without any point that has both values), and the number of such points.
        """
        last = now_ns // STEP_NS
        points = [self._points[bucket] for bucket in range(last - minutes, last + 1) if bucket in self._points]
        pairs = [(point.get("residual_um"), point.get("y_offset_std_um")) for point in points]
        both = [(abs(residual), std) for residual, std in pairs if residual is not None and std is not None]
        if not both:
            return math.nan, math.nan, 0
        return median(residual for residual, _ in both), median(std for _, std in both), len(both)

    def columns(self, since_ns: int = 0) -> dict[str, list[Any]]:
        """Return the points since a time, by columns.

        Parameters
        ----------
        since_ns : int
            ns since 1970 UTC.

        Returns
        -------
        dict of str to list
            `t_s` (s since 1970 UTC), `COLUMNS`, and `effects`, a list for each point.
        """
        first = since_ns // STEP_NS
        points = [self._points[bucket] for bucket in sorted(self._points) if bucket >= first]
        found: dict[str, list[Any]] = {"t_s": [round(point["time_utc_ns"] / NS, 3) for point in points]}
        for name in COLUMNS:
            found[name] = [_short(point.get(name)) for point in points]
        if any("candidate_um" in point for point in self._points.values()):
            found["candidate_um"] = [_short(point.get("candidate_um")) for point in points]
        found["effects"] = [[_short(value) for value in point.get("effects", ())] for point in points]
        return found


def state_intervals(history: Mapping[str, Sequence[Any]], valid_for_s: float | None) -> list[StateInterval]:
    """Return the intervals of a history, the newest first.

    Parameters
    ----------
    history : mapping of str to sequence
        Columns as in `MachineHistory`.
    valid_for_s : float, optional
        Validity of an offset, s: a longer pause separates two intervals.

    Examples
    --------
    >>> day = {"t_s": [0.0, 60.0, 120.0], "state": ["ok", "ok", "hold"], "reasons": ["", "", "operator_hold"]}
    >>> [(interval.state, interval.end_s - interval.begin_s) for interval in state_intervals(day, 150.0)]
    [('hold', 60.0), ('ok', 120.0)]
    """
    found: list[StateInterval] = []
    step_s = STEP_NS / NS
    pause_s = max(LEAST_PAUSE_S, valid_for_s or 0.0)
    columns = (history.get(name, ()) for name in ("t_s", "state", "reasons"))
    for t, state, reasons in zip(*columns, strict=True):
        last = found[-1] if found else None
        if state is None:
            continue
        if last is not None and last[2:] == (state, reasons or "") and t - last.end_s + step_s < pause_s:
            found[-1] = last._replace(end_s=t + step_s)
        else:
            found.append(StateInterval(t, t + step_s, state, reasons or ""))
    return found[::-1]


def _is_of_the_day(bucket: int, now_ns: int) -> bool:
    return (now_ns - SPAN_NS) // STEP_NS <= bucket <= (now_ns + AHEAD_NS) // STEP_NS


def usable(sample: Sample, name: str) -> float | None:
    """Return the mean of a channel; None if it is missing or its quality is not good."""
    channel = sample.channels.get(name)
    return channel.mean if channel is not None and channel.is_good else None


def _short(value: Any) -> Any:
    """Round to the digits that a figure shows."""
    return round(value, 4) if isinstance(value, float) else value
