"""Notation of numbers for people: a true minus sign, and a dash for a missing value."""

from __future__ import annotations

import math


def signed(value: float | None, digits: int = 2) -> str:
    """Format a number with its sign.

    Examples
    --------
    >>> signed(1.234), signed(-0.5), signed(None), signed(math.nan)
    ('+1.23', '−0.50', '–', '–')
    """
    return _formatted(value, f"+z.{digits}f")


def plain(value: float | None, digits: int = 2) -> str:
    """Format a number; only a negative one has a sign.

    Examples
    --------
    >>> plain(-0.004), plain(-0.5)
    ('0.00', '−0.50')
    """
    return _formatted(value, f"z.{digits}f")


def _formatted(value: float | None, form: str) -> str:
    return "–" if value is None or math.isnan(value) else format(value, form).replace("-", "−")
