"""A table of the model file, which names file place, key and value in every refusal."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

from compensator.arrays import LARGEST
from compensator.errors import ModelError

#: Largest number of values in a list, and of lists in a list, unless a key has a limit of its own.
LIST_LENGTH = 1000
#: Longest text, and how a message says so; longest sentences for people.
TEXT_LENGTH, WORDS_LENGTH = 300, 10_000
ONE_LINE = f"at most {TEXT_LENGTH} printable characters"


_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


class TomlTable:
    """Typed access to a table of the model file.

    Parameters
    ----------
    where : str
        Place in the file, for messages.
    table : object
        What the file holds there.
    known : sequence of str, optional
        Keys that it may have; any where it is left out.
    most : int
        Largest number of keys.

    Raises
    ------
    ModelError
        If it is no table, or has an unknown key or too many.
    """

    def __init__(
        self, where: str, table: object, known: Sequence[str] | None = None, *, most: int = LIST_LENGTH
    ) -> None:
        if not isinstance(table, Mapping):
            raise ModelError(f"{where}: expected a table, got {shown(table)}")
        if len(table) > most:
            raise ModelError(f"{where}: {len(table)} keys, expected at most {most}")
        self.where = where
        self.table: Mapping[str, Any] = table
        unknown = [key for key in table if known is not None and key not in known]
        if unknown:
            raise ModelError(f"{where}: unknown key {shown(unknown[0])}, expected one of: {', '.join(known or ())}")

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        """Return a finite number between two bounds (inclusive)."""
        value = self.table.get(key)
        if not _is_number(value, low, high):
            raise ModelError(f"{self.where}: {key} = {shown(value)}, expected a number{_bounds(low, high)}")
        return float(value)

    def numbers(
        self,
        key: str,
        low: float = -math.inf,
        high: float = math.inf,
        *,
        length: int | None = None,
        most: int = LIST_LENGTH,
    ) -> tuple[float, ...]:
        """Return a list of finite numbers between two bounds (inclusive)."""
        values: Any = self._bounded(key, most)
        ok = isinstance(values, list) and values and all(_is_number(v, low, high) for v in values)
        if not ok or (length is not None and len(values) != length):
            count = f"{length} " if length else ""
            expected = f"a list of {count}numbers{_bounds(low, high)}"
            raise ModelError(f"{self.where}: {key} = {shown(values)}, expected {expected}")
        return tuple(float(v) for v in values)

    def rows(self, key: str, *, needed: bool = True, empty: bool = False) -> tuple[tuple[float, ...], ...]:
        """Return a list of lists of finite numbers; empty where it is left out and not needed.

        With `empty`, lists without a number may be among them.
        """
        values: Any = self._bounded(key)
        if values is None and not needed:
            return ()
        if not isinstance(values, list) or not values or not all(isinstance(row, list) for row in values):
            raise ModelError(f"{self.where}: {key} = {shown(values)}, expected a list of lists of numbers")
        return tuple(() if empty and not row else TomlTable(self.where, {key: row}).numbers(key) for row in values)

    def words(self, key: str) -> str:
        """Return sentences for people, without control characters."""
        value = self.table.get(key)
        if not isinstance(value, str) or len(value) > WORDS_LENGTH or _CONTROL.search(value):
            expected = f"a string of at most {WORDS_LENGTH} characters without control characters"
            raise ModelError(f"{self.where}: {key} = {shown(value)}, expected {expected}")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of strings."""
        values: Any = self._bounded(key)
        if not isinstance(values, list) or not values or not all(isinstance(value, str) for value in values):
            raise ModelError(f"{self.where}: {key} = {shown(values)}, expected a list of strings")
        return tuple(values)

    def _bounded(self, key: str, most: int = LIST_LENGTH) -> object:
        value = self.table.get(key)
        if isinstance(value, list) and len(value) > most:
            raise ModelError(f"{self.where}: {key} has {len(value)} values, expected at most {most}")
        return value

    def text(self, key: str, choices: Sequence[str] = (), default: str | None = None) -> str:
        """Return a string, one of the choices where there are any."""
        value = self.table.get(key, default)
        if not isinstance(value, str) or (choices and value not in choices):
            expected = "one of: " + ", ".join(choices) if choices else "a string"
            raise ModelError(f"{self.where}: {key} = {shown(value)}, expected {expected}")
        if not is_one_line(value):
            raise ModelError(f"{self.where}: {key} = {shown(value)}, expected {ONE_LINE}")
        return value


def is_one_line(value: str) -> bool:
    """Return whether a text can stand in a message as it is: a name, a unit."""
    return len(value) <= TEXT_LENGTH and value.isprintable()


def shown(value: object) -> str:
    """Return a value as a message quotes it."""
    return "missing" if value is None else repr(value)[:60]


def _is_number(value: object, low: float, high: float) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return -LARGEST < value < LARGEST and low <= value <= high


def _bounds(low: float, high: float) -> str:
    return "" if low == -math.inf and high == math.inf else f" from {low:g} to {high:g}"
