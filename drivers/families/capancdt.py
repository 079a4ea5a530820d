"""Micro-Epsilon capaNCDT 6200: capacitive displacement over Ethernet, as a stream.

A reading is the mean of all values since the last one, with extremes and count. Input 0 is the
controller's channel 1. The converter stops at its ends: a single value there makes the reading under or over
range, as a mean with clipped values in it is wrong by an unknown amount.

Source: capaNCDT 6200 operating instructions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import msgspec

from drivers.families.base import DeviceSettings, Family
from drivers.families.inputs import check_input, input_tables
from drivers.lines.capancdt_link import CapancdtLink
from drivers.protocols.capancdt import MOST_CHANNELS, Channel, micrometres
from drivers.protocols.capancdt_sums import Sums
from drivers.reading import Quality, Reading
from drivers.settings import Where, settings


class CapancdtSettings(DeviceSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a controller.

    Parameters
    ----------
    window_s : float
        Measurements older than this are left out of a mean, s, so that a reading after a pause is current.
    """

    window_s: Annotated[float, msgspec.Meta(ge=0.05, le=600.0)] = 10.0


class CapancdtInput(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One channel.

    Parameters
    ----------
    input : int
        0 is the controller's channel 1.
    """

    input: Annotated[int, msgspec.Meta(ge=0)]


class Capancdt:
    """A capaNCDT 6200 controller."""

    def __init__(self, config: CapancdtSettings, link: CapancdtLink, where: Where) -> None:
        channels: dict[int, None] = {}
        for table, spot in input_tables(config, where):
            given = settings(table, CapancdtInput, spot)
            check_input(given.input, channels, MOST_CHANNELS, config.model, spot)
            channels[given.input] = None
        self._config = config
        self._units = dict.fromkeys(channels, "um")
        self._link = link
        link.join(config.name, tuple(channels))

    @property
    def name(self) -> str:
        """Name of the device in the configuration."""
        return self._config.name

    @property
    def units(self) -> Mapping[int, str]:
        """Unit of each configured input."""
        return self._units

    @property
    def lost_frames(self) -> int:
        """Frames missing since the start, by the controller's counter."""
        return self._link.lost_frames

    async def read(self) -> Mapping[int, Reading]:
        """Read the mean of every configured channel since the last call.

        Raises
        ------
        DriverError
            Naming the device, when nothing new came within `timeout_s` (twice as long at the first call).
        """
        collected = await self._link.collect(self._config.window_s)
        return {number: _reading(channel, parts) for number, (channel, parts) in collected.items()}

    async def close(self) -> None:
        """Close both connections and end the background task."""
        await self._link.close()


def _reading(channel: Channel, parts: Sequence[Sums]) -> Reading:
    """Combine the parts."""
    count = sum(part.count for part in parts)
    over = sum(part.over for part in parts)
    under = sum(part.under for part in parts)
    if over:
        return Reading.bad(Quality.OVER, f"{over} of {count} values at the top of {channel.range_um:g} µm")
    if under:
        return Reading.bad(Quality.UNDER, f"{under} of {count} values at 0 of {channel.range_um:g} µm")
    return Reading(
        value=micrometres(sum(part.total for part in parts) / count, channel.range_um),
        quality=Quality.GOOD,
        minimum=micrometres(min(part.minimum for part in parts), channel.range_um),
        maximum=micrometres(max(part.maximum for part in parts), channel.range_um),
        count=count,
    )


MODELS = {"capancdt-6200": Family(protocols=("capancdt",), kind=CapancdtSettings, make=Capancdt)}
