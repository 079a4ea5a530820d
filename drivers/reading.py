"""Readings with a quality, and the interface of every device."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol


class Quality(enum.StrEnum):
    """Quality of a single reading."""

    GOOD = "good"
    OPEN = "open_circuit"
    OVER = "over_range"
    UNDER = "under_range"
    STALE = "stale"
    INVALID = "invalid"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One reading of one input.

    Parameters
    ----------
    value : float
        In the input's unit; NaN unless the quality is good.
    quality : Quality
        Quality of the value.
    minimum, maximum : float
        Extremes of the readings averaged in `value` (a streaming device returns many at once).
    count : int
        Number of readings averaged in `value`; 0 if there are none.
    detail : str
        Short explanation if the quality is not good.
    """

    value: float
    quality: Quality
    minimum: float
    maximum: float
    count: int
    detail: str = ""

    @classmethod
    def good(cls, value: float) -> Reading:
        """Make a single good reading."""
        return cls(value=value, quality=Quality.GOOD, minimum=value, maximum=value, count=1)

    @classmethod
    def bad(cls, quality: Quality, detail: str) -> Reading:
        """Make a reading without a value."""
        nan = float("nan")
        return cls(value=nan, quality=quality, minimum=nan, maximum=nan, count=0, detail=detail)


class Device(Protocol):
    """Interface of a device for the service."""

    @property
    def name(self) -> str:
        """Name of the device in the configuration."""

    @property
    def units(self) -> Mapping[int, str]:
        """Unit of each configured input: `degc`, `um`, `v`, `rpm`, …."""

    async def read(self) -> Mapping[int, Reading]:
        """Read every configured input once.

        Connects when needed, and again after a loss. Returns or raises within the line's time limit.

        Raises
        ------
        DriverError
            If no input could be read; the error names the device.
        """

    async def close(self) -> None:
        """Release port, socket and threads. May be called twice."""
