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


def or_null(value: float) -> float | None:
    """Return a number for JSON, to 0.1 nm where it is in µm; None for a missing value.

    Examples
    --------
    >>> or_null(1.23456), or_null(math.nan)
    (1.2346, None)
    """
    return None if math.isnan(value) else round(value, 4)


def _formatted(value: float | None, form: str) -> str:
    return "–" if value is None or math.isnan(value) else format(value, form).replace("-", "−")
