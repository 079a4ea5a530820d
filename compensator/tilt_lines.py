"""Lines of a configuration for tilts that pairs of probes measure, to be pasted into it."""

from __future__ import annotations

import json
from collections.abc import Iterable

from compensator.config_axes import TILTS


def tilt_lines(pairs: Iterable[tuple[str, str, float]], *, against: Iterable[tuple[str, str]] = ()) -> str:
    """Return an `[axis.a]` or `[axis.b]` table for each pair of probes, at most two.

    Heights, distance, reference and limits do not show in the data: a configuration in which they are not filled in is
    refused.

    Parameters
    ----------
    pairs : iterable of (str, str, float)
        Names of both probes, and how far they moved apart, µm.
    against : iterable of (str, str)
        Pairs whose probes move against each other.

    Examples
    --------
    >>> print(tilt_lines([("ch1", "ch2", 12.34)]))
    [axis.a]  # a acts on Y, b on X; acts_on = "z" for another axis
    probes = ["ch1", "ch2"]  # the lower one first
    distance_mm = "FILL IN"  # between the two
    reference_mm = "FILL IN"  # length of the tool for which the offset of that axis holds
    offset_max_urad = "FILL IN"  # seen: 12.3 µm, that is 1000 × as much / distance_mm in µrad
    offset_rate_max_urad_per_min = "FILL IN"
    """
    opposed = set(against)
    tables = []
    for name, (first, second, apart_um) in zip(TILTS, pairs, strict=False):
        lines = [
            f'[axis.{name}]  # a acts on Y, b on X; acts_on = "z" for another axis',
            f"probes = {json.dumps([first, second])}  # the lower one first",
            'distance_mm = "FILL IN"  # between the two',
            'reference_mm = "FILL IN"  # length of the tool for which the offset of that axis holds',
            f'offset_max_urad = "FILL IN"  # seen: {apart_um:.1f} µm, that is 1000 × as much / distance_mm in µrad',
            'offset_rate_max_urad_per_min = "FILL IN"',
        ]
        if (first, second) in opposed:
            lines.insert(2, "# They move against each other: first make sure that both count in the same sense.")
        tables.append("\n".join(lines))
    return "\n\n".join(tables)
