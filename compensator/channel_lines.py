"""Lines of a configuration for the channels that a model needs, to be pasted into it."""

from __future__ import annotations

import json
import math
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
        lines = ["[[channel]]", f"name = {json.dumps(name, ensure_ascii=False)}", 'device = "DEVICE"', "input = 0"]
        if ranges is not None and name in ranges:
            low, high = ranges[name]
            # A speed or a flow that is never negative, its noise aside, stays so.
            span = max(high - low, 1e-9)
            least = min(low, 0.0) if low >= -0.01 * span and not name.endswith("_degc") else low - span
            digits = max(1, 1 - math.floor(math.log10(span)))
            step = 10.0**-digits
            ends = [math.floor(max(low - span, least) / step) * step, math.ceil((high + span) / step) * step]
            shown = ", ".join(f"{end + 0.0:.{digits}f}" for end in ends)
            lines.append(f"range = [{shown}]  # seen: {low:g} to {high:g}")
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
