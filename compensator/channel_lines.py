"""Lines of a configuration for the channels that a model needs, to be pasted into it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

#: Names that a channel may have, as in `config.Channel`.
_NAME = re.compile(r"[a-z][a-z0-9_]{0,62}")


def channel_lines(names: Iterable[str], ranges: Mapping[str, tuple[float, float]] | None = None) -> str:
    """Return a `[[channel]]` table for each name; device and input are left to whoever wires the sensor.

    Parameters
    ----------
    names : iterable of str
        Channels.
    ranges : mapping of str to (float, float), optional
        Lowest and highest value that was seen; the plausible range proposed is wider by as much to each side.

    Examples
    --------
    >>> print(channel_lines(["coolant_degc"], {"coolant_degc": (18.0, 24.0)}))
    [[channel]]
    name = "coolant_degc"
    device = "DEVICE"
    input = 0
    range = [12.0, 30.0]  # seen: 18 to 24
    """
    tables = []
    for name in names:
        lines = ["[[channel]]", f'name = "{name}"', 'device = "DEVICE"', "input = 0"]
        if ranges is not None and name in ranges:
            low, high = ranges[name]
            # A speed or a flow that is never negative stays so.
            least = 0.0 if low >= 0.0 and not name.endswith("_degc") else 2.0 * low - high
            lines.append(
                f"range = [{max(2.0 * low - high, least):.1f}, {2.0 * high - low:.1f}]  # seen: {low:g} to {high:g}"
            )
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def unusable_names(names: Iterable[str]) -> list[str]:
    """Return the names that no channel of a service can have.

    Examples
    --------
    >>> unusable_names(["coolant_degc", "Coolant T"])
    ['Coolant T']
    """
    return [name for name in names if not _NAME.fullmatch(name)]
