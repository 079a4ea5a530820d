"""Reading an `[[effect]]` table with its bounds, where it is used."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from compensator.errors import ModelError


class Table:
    """The table of one effect, which names itself when a key is wrong.

    Parameters
    ----------
    kind : str
        Kind of the effect, for messages.
    table : mapping
        Its keys.
    known : sequence of str
        Keys that it may have, beside `std`, `explanation` and `form`.
    """

    def __init__(self, kind: str, table: Mapping[str, Any], known: Sequence[str]) -> None:
        self.kind, self.table = kind, table
        for key in table:
            if key not in (*known, "std", "explanation", "form"):
                raise ModelError(f"effect {kind}: unknown key {key!r}, expected one of: {', '.join(known)}")

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        """Return a finite number between two bounds."""
        value = self.table.get(key)
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not good or not low <= value <= high:  # type: ignore[operator]
            raise ModelError(f"effect {self.kind}: {key} = {value!r}, expected a number from {low:g} to {high:g}")
        return float(value)  # type: ignore[arg-type]

    def numbers(self, key: str, low: float = -math.inf, high: float = math.inf) -> tuple[float, ...]:
        """Return a list of finite numbers between two bounds."""
        values = self.table.get(key)
        if not isinstance(values, list) or not values:
            raise ModelError(f"effect {self.kind}: {key} = {values!r}, expected a list of numbers")
        return tuple(Table(self.kind, {"form": "", key: v}, (key,)).number(key, low, high) for v in values)

    def text(self, key: str, choices: Sequence[str] = ()) -> str:
        """Return a text, one of the choices where there are any."""
        value = self.table.get(key)
        if not isinstance(value, str) or not value or (choices and value not in choices):
            expected = "one of: " + ", ".join(choices) if choices else "a text"
            raise ModelError(f"effect {self.kind}: {key} = {value!r}, expected {expected}")
        return value
