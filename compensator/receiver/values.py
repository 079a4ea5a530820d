"""Values that a program hands over: numbers, or anything else, which is refused."""

from __future__ import annotations

import math
from numbers import Real

from .reasons import printable


def finite(value: object) -> float | None:
    """Return a finite number as a float; None for anything else.

    Examples
    --------
    >>> finite(3), finite("3"), finite(None), finite(float("nan")), finite(True), finite(10**400)
    (3.0, None, None, None, None, None)
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def shown(value: object) -> str:
    """Return a value as a reason or an error quotes it; what has no short text is named by its type.

    Examples
    --------
    >>> shown("3"), shown(-0.5), shown(50), shown([3])
    ("'3'", '-0.5', '50', 'list')
    """
    if isinstance(value, str):
        return printable(repr(value), 40)
    number = finite(value)
    return type(value).__name__ if number is None and not isinstance(value, float) else f"{value}"
