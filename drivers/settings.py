"""Converts configuration tables to settings, with a one-line error for each mistake."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import msgspec

from drivers.errors import DriverConfigError

SettingsT = TypeVar("SettingsT", bound=msgspec.Struct)

Name = Annotated[str, msgspec.Meta(min_length=1)]

_AT = re.compile(r"^(?P<what>.*?)(?: - at `\$\.?(?P<path>[^`]*)`)?$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Where:
    """Place of a table in the configuration, for messages.

    Parameters
    ----------
    source : str
        Name of the file that holds the tables.
    table : str
        The table as text, such as `devices[1] "spindle-thermocouples"`.
    """

    source: str
    table: str

    def inside(self, part: str) -> Where:
        """Make the place of a table inside this one."""
        return Where(source=self.source, table=f"{self.table} {part}")

    def error(self, message: str) -> DriverConfigError:
        """Make the error that names this place."""
        return DriverConfigError(self.source, f"{self.table}: {message}")

    def wrong(self, key: str, value: object, expected: str) -> DriverConfigError:
        """Make the error for one key: its value and what was expected."""
        return self.error(f"key '{key}' is {value!r}, expected {expected}")


def settings(table: object, kind: type[SettingsT], where: Where) -> SettingsT:
    """Convert a table into settings.

    Parameters
    ----------
    table : object
        Table of the configuration; anything but a mapping is an error.
    kind : type
        Class of the settings. Nested tables are converted by a second call, so that messages name their
        place.
    where : Where
        For messages.

    Raises
    ------
    DriverConfigError
        A key is unknown, missing, of the wrong type or out of its bounds.
    """
    if not isinstance(table, Mapping):
        raise where.error(f"is {table!r}, expected a table")
    fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    for key in table:
        if key not in fields:
            raise where.error(f"key {key!r} is not known (known: {', '.join(fields)})")
    for key, field in fields.items():
        if field.required and key not in table:
            raise where.error(f"key '{key}' is missing")
    try:
        return msgspec.convert(dict(table), kind)
    except msgspec.ValidationError as error:
        raise _in_words(error, table, where) from None


def _in_words(error: msgspec.ValidationError, table: Mapping[str, Any], where: Where) -> DriverConfigError:
    """Convert an error of msgspec to one with key, value and expected value."""
    found = _AT.match(str(error))
    if found is None or not found["path"]:
        return where.error(str(error))
    path = found["path"]
    key = re.split(r"[.\[]", path, maxsplit=1)[0]
    what = found["what"].replace("`", "")
    if what.startswith("Expected "):
        what = what.removeprefix("Expected ")
    return where.wrong(path, table.get(key), what)


def one_of(choices: Mapping[str, object] | tuple[str, ...]) -> str:
    """Return choices as text: `one of K, J, T`."""
    return f"one of {', '.join(choices)}"
