"""The last day of a machine as far as it was seen: one point a minute."""

from __future__ import annotations

import math
from statistics import median
from typing import Any

from compensator.clock import NS
from compensator.messages import EstimateMessage, Offset, Sample

#: Length of what is kept and of what one point stands for, ns.
SPAN_NS = 24 * 3600 * NS
STEP_NS = 60 * NS
#: What a point has of the estimate and of the offset.
_ESTIMATE = ("heat_w", "y_dtf_um", "y_tdtf_um", "y_base_um", "y_pred_um", "residual_um")
_OFFSET = ("y_offset_um", "y_offset_std_um", "state")
#: Names of a point's values beside its time, number and effects.
COLUMNS = (*_OFFSET, "reasons", *_ESTIMATE, "t_q_degc", "at_degc")


class History:
    """Points of the last day, whatever order the messages come in.

    The newest sample of a minute is its point; one of a faster model that was followed by another in the same minute
    is left out. Values of one sample come in several messages and belong together by its number. A value that did not
    arrive is None.
    """

    def __init__(self) -> None:
        self._points: dict[int, dict[str, Any]] = {}

    def __len__(self) -> int:
        return len(self._points)

    def add(self, message: Sample | EstimateMessage | Offset) -> None:
        """Take one message in."""
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
        """Forget what is older than a day."""
        oldest = (now_ns - SPAN_NS) // STEP_NS
        for bucket in [bucket for bucket in self._points if bucket < oldest]:
            del self._points[bucket]

    def misfit(self, now_ns: int, minutes: int) -> tuple[float, float, int]:
        """Return how far measured and predicted Y are apart, what the service states, and of how many points that is.

        Parameters
        ----------
        now_ns : int
            Now, ns since 1970 UTC.
        minutes : int
            How far to look back, min.

        Returns
        -------
        (float, float, int)
            Medians of |residual| and of the offset's standard deviation, µm; NaN without any point that has both.
        """
        last = now_ns // STEP_NS
        points = [self._points[bucket] for bucket in range(last - minutes, last + 1) if bucket in self._points]
        pairs = [(point.get("residual_um"), point.get("y_offset_std_um")) for point in points]
        both = [(abs(residual), std) for residual, std in pairs if residual is not None and std is not None]
        if not both:
            return math.nan, math.nan, 0
        return median(residual for residual, _ in both), median(std for _, std in both), len(both)

    def columns(self, since_ns: int = 0) -> dict[str, list[Any]]:
        """Return the points from a time on, column by column.

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
    """Return the mean of a channel, None where it is missing or was refused."""
    channel = sample.channels.get(name)
    return channel.mean if channel is not None and channel.quality == "good" else None


def _short(value: Any) -> Any:
    """Leave out digits that no picture shows."""
    return round(value, 4) if isinstance(value, float) else value
