"""Cells of a text table as spreadsheets write them: encodings, and decimal commas."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from compensator.errors import DataError

_WITH_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")
_WITH_POINT = re.compile(r"[+-]?(\d+\.\d*|\.\d+)([eE][+-]?\d+)?")
#: Control characters that no text table has; a binary file has them.
_BINARY = re.compile(rb"[\x00-\x08\x0e-\x1f\x7f]")


def text_of(path: Path, data: bytes) -> str:
    """Return the text of a table: UTF-8, or Windows-1252 as older spreadsheets write it.

    Raises
    ------
    DataError
        If it is neither.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if not _BINARY.search(data):
            try:
                return data.decode("cp1252")
            except UnicodeDecodeError:
                pass
        raise DataError(
            f"{path}: not UTF-8 text ({error.reason} at byte {error.start}), expected a table: CSV in UTF-8"
        ) from error


def with_points(
    name: str, columns: Mapping[str, np.ndarray[Any, Any]], rows: Sequence[int]
) -> dict[str, np.ndarray[Any, Any]]:
    """Return columns of cells with decimal points where the table has decimal commas.

    In such a table a point separates thousands, so a number with a point is refused: 1.234 may be 1234.

    Parameters
    ----------
    name : str
        Name of the table, for messages.
    columns : mapping of str to numpy.ndarray
        Cells as text.
    rows : sequence of int
        Number of each row, for messages.

    Raises
    ------
    DataError
        If a number has a point in a table with decimal commas.

    Examples
    --------
    >>> with_points("t", {"y_um": np.array(["1,5", "2"], dtype=object)}, [2, 3])
    {'y_um': array(['1.5', '2'], dtype=object)}
    """
    if not any(_WITH_COMMA.fullmatch(cell.strip()) for cells in columns.values() for cell in cells):
        return dict(columns)
    found = {}
    for column, cells in columns.items():
        for i, cell in enumerate(cells):
            if _WITH_POINT.fullmatch(cell.strip()):
                raise DataError(
                    f"{name}: row {rows[i]}: {column} = {cell.strip()!r} in a table with decimal commas: thousands, "
                    "or a decimal? expected one of the two in the whole table"
                )
        found[column] = np.array(
            [cell.replace(",", ".") if _WITH_COMMA.fullmatch(cell.strip()) else cell for cell in cells], dtype=object
        )
    return found
