"""The axes of a machine: their names, their columns, and texts for each.

Everything is computed for one axis at a time, which formulas, columns and texts call Y. Data of another axis are handed
over with its column in place of `y_um`; columns and texts that come back are renamed here, in one place.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from compensator.codes import Remark
from compensator.errors import CompensatorError

#: Axes of a control; the deformation of each is in the column of `column_of`.
AXES = ("x", "y", "z")
#: The axis that formulas, columns and texts are written for.
FIRST = "y"
#: What the name of an axis may be; names other than those of a control are of single probes.
NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")
#: Stays as it is in every text: an option of the Python functions.
_OPTION = "y_std_um in Python"
#: What is written for Y in texts and columns.
_OF_FIRST = r"\by(?=_(?:[a-z]+_)*um(?:_|\b))|\bresidual_um\b|\bY\b"
_Any = TypeVar("_Any")


def column_of(axis: str) -> str:
    """Return the column of an axis' deformation.

    Examples
    --------
    >>> column_of("z")
    'z_um'
    """
    return f"{axis}_um"


#: Columns of the deformation of the axes of a control.
COLUMNS = tuple(map(column_of, AXES))


def label_of(axis: str) -> str:
    """Return the name of an axis in a text: a capital letter, or the name of a probe.

    Examples
    --------
    >>> label_of("z"), label_of("ch1")
    ('Z', 'ch1')
    """
    return axis.upper() if axis in AXES else axis


@dataclass(frozen=True, slots=True)
class AxisWords:
    """Columns and texts of one axis, made from those that are written for Y.

    Parameters
    ----------
    axis : str
        The axis.
    kept : frozenset of str
        Names of the user, such as those of files, channels and models, which stay as they are. A name that is nothing
        but Y cannot: the text means the axis nearly everywhere.

    Examples
    --------
    >>> AxisWords("z")("No y_um in run-Y.csv: nothing measures Y."), AxisWords("z")({"y_pred_um": 1.0})
    ('No z_um in run-Z.csv: nothing measures Z.', {'z_pred_um': 1.0})
    >>> AxisWords("z", frozenset({"run-Y.csv"}))("No y_um in run-Y.csv: nothing measures Y.")
    'No z_um in run-Y.csv: nothing measures Z.'
    >>> AxisWords("y")("No y_um in run-Y.csv")
    'No y_um in run-Y.csv'
    """

    axis: str = FIRST
    kept: frozenset[str] = frozenset()

    def __call__(self, value: _Any) -> _Any:
        """Return a text, or anything that contains texts, for this axis."""
        return value if self.axis == FIRST else self._renamed(value, self._pattern())

    def table(self, columns: Mapping[str, _Any]) -> dict[str, _Any]:
        """Return the columns of a table by their names for this axis; time and heat are those of the machine."""
        return {self(name): values for name, values in columns.items()}

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Raise errors with the texts of this axis."""
        try:
            yield
        except CompensatorError as error:
            text = self(str(error))
            if text == str(error):
                raise
            raise type(error)(text) from error

    def _pattern(self) -> re.Pattern[str]:
        changed = (name for name in self.kept if name != FIRST.upper() and re.search(_OF_FIRST, name))
        names = "|".join(map(re.escape, sorted({_OPTION, *changed}, key=len, reverse=True)))
        # Whole names only: a channel y_scale_um does not keep y_scale_um_2. What is of the axis already stays, too: the
        # columns of an axis y_slope begin as those of Y.
        return re.compile(rf"(?P<kept>(?<!\w)(?:{names})(?!\w)|\b{re.escape(self.axis)}(?=_))|{_OF_FIRST}")

    def _in_words(self, match: re.Match[str]) -> str:
        found = match[0]
        if match["kept"]:
            return found
        if found == "Y":
            return label_of(self.axis)
        return self.axis if found == "y" else f"{self.axis}_{found}"

    def _renamed(self, value: Any, pattern: re.Pattern[str]) -> Any:
        if type(value) is str:
            return pattern.sub(self._in_words, value)
        if isinstance(value, Remark):
            return value.worded(pattern.sub(self._in_words, value))
        if isinstance(value, Mapping):
            return {self._renamed(k, pattern): self._renamed(v, pattern) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            parts = [self._renamed(one, pattern) for one in value]
            return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = [field.name for field in dataclasses.fields(value) if field.init]
            changed = {name: self._renamed(getattr(value, name), pattern) for name in fields}
            return dataclasses.replace(value, **changed)
        return value
