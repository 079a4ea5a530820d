"""The last day of a machine as received: one point per minute."""

from __future__ import annotations

import math
from statistics import median
from typing import Any

from compensator.clock import NS
from compensator.messages import EstimateMessage, Offset, Sample

#: Length of the history and of one point, ns.
SPAN_NS = 24 * 3600 * NS
STEP_NS = 60 * NS
#: Values of a point from the estimate and from the offset.
_ESTIMATE = ("heat_w", "y_dtf_um", "y_tdtf_um", "y_base_um", "y_pred_um", "residual_um")
_OFFSET = ("y_offset_um", "y_offset_std_um", "state")
#: Columns of the history in addition to time and effects.
COLUMNS = (*_OFFSET, "reasons", *_ESTIMATE, "t_q_degc", "at_degc")


class History:
    """Points of the last day; messages may arrive in any order.

    The newest sample of a minute is its point. The values of one sample come in several messages with the same number.
    A value that did not arrive is None.
    """

    def __init__(self) -> None:
        self._points: dict[int, dict[str, Any]] = {}

    def __len__(self) -> int:
        return len(self._points)

    def add(self, message: Sample | EstimateMessage | Offset) -> None:
        """Add a message."""
        bucket = message.time_utc_ns // STEP_NS
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
            point["reasons"] = " ".join(message.reasons)

    def prune(self, now_ns: int) -> None:
        """Remove points older than a day."""
        oldest = (now_ns - SPAN_NS) // STEP_NS
        for bucket in [bucket for bucket in self._points if bucket < oldest]:
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
        found["effects"] = [[_short(value) for value in point.get("effects", ())] for point in points]
        return found


def usable(sample: Sample, name: str) -> float | None:
    """Return the mean of a channel; None if it is missing or refused."""
    channel = sample.channels.get(name)
    return channel.mean if channel is not None and channel.quality == "good" else None


def _short(value: Any) -> Any:
    """Round to the digits that a figure can show."""
    return round(value, 4) if isinstance(value, float) else value
