"""The axes that data have, and the data of one axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np

from compensator.axes import AXES, FIRST, NAME, AxisWords, column_of
from compensator.data.measurement import Measurement
from compensator.data.table import EXPORTED
from compensator.errors import DataError, UsageError

#: Columns whose names are written for Y, also where a table has them.
_OURS = frozenset({column_of(FIRST), "y_free_um", *EXPORTED})
AxisLike: TypeAlias = "str | Sequence[str] | None"
"""Axes asked for: one, several, or None for all that there are."""


def asked_axes(axis: AxisLike) -> tuple[str, ...]:
    """Return the axes asked for, by their names; empty where none is.

    Raises
    ------
    UsageError
        If a name cannot be one, or comes twice.

    Examples
    --------
    >>> asked_axes("z"), asked_axes(["ch1", "ch2"]), asked_axes(None)
    (('z',), ('ch1', 'ch2'), ())
    """
    is_one = isinstance(axis, str) or not isinstance(axis, Iterable)  # a number is no name of an axis, and said so
    asked: tuple[Any, ...] = () if axis is None else (axis,) if is_one else tuple(axis)
    for name in asked:
        if not isinstance(name, str) or NAME.fullmatch(name) is None or name.endswith("_um"):
            raise UsageError(f"--axis {name}: expected the name of an axis, such as z, or ch1 for the column ch1_um")
        if asked.count(name) > 1:
            raise UsageError(f"--axis {name}: given {asked.count(name)} times, expected each axis once")
    return asked


def axes_in(data: Sequence[Measurement], axis: AxisLike = None) -> tuple[str, ...]:
    """Return the axes that data have, or those of them that are asked for.

    Parameters
    ----------
    data : sequence of Measurement
        Measured data.
    axis : str or sequence of str, optional
        Names of axes, or of single probes: `z` is the column `z_um`, `ch1` the column `ch1_um`. By default every axis
        of a control whose column moves; Y where there is none.

    Raises
    ------
    DataError
        If no data have the column of an axis that is asked for.
    UsageError
        As `asked_axes`.
    """
    asked = asked_axes(axis)
    if not asked:
        return tuple(name for name in AXES if any(_moves(one, name) for one in data)) or (FIRST,)
    for name in asked:
        column = column_of(name)
        if data and not any(column in one.table.columns for one in data):
            has = ", ".join(data[0].table.columns)
            named = f". Name it with --column {column}=NAME" if name in AXES else ""
            raise DataError(f"{data[0].name}: no column {column} for --axis {name}; it has: {has}{named}")
    return asked


def of_axis(data: Sequence[Measurement], axis: str) -> list[Measurement]:
    """Return the data in which an axis was measured, with its deformation in place of `y_um`.

    Data of Y are returned as they are. The columns of other axes stay: a displacement is never taken for a cause.
    """
    if axis == FIRST:
        return list(data)
    return [_as_first(one, axis) for one in data if column_of(axis) in one.table.columns]


def with_axis(data: Sequence[Measurement], axis: str) -> list[Measurement]:
    """Return all data for an axis: as `of_axis`, and without a deformation where it was not measured."""
    return [one if axis == FIRST else _as_first(one, axis) for one in data]


def words_of(axis: str, *data: Sequence[Measurement], models: Iterable[str] = ()) -> AxisWords:
    """Return the texts of an axis, in which names of the user stay as they are.

    Parameters
    ----------
    axis : str
        The axis.
    *data : sequence of Measurement
        Their names and those of their channels stay, but for columns that this package writes itself.
    models : iterable of str
        Names of models, which stay too.
    """
    every = [one for several in data for one in several]
    kept = {name for one in every for name in (one.name, one.label)}
    channels = {name for one in every for name in (*one.table.columns, *one.roles.values())}
    return AxisWords(axis, frozenset(kept | (channels - _OURS) | set(models)))


def _as_first(one: Measurement, axis: str) -> Measurement:
    own, first = column_of(axis), column_of(FIRST)
    columns = {name: values for name, values in one.table.columns.items() if name not in (own, first)}
    if own in one.table.columns:
        columns[first] = one.table.columns[own]
    return dataclasses.replace(one, table=dataclasses.replace(one.table, columns=columns, zeros_s=()))


def _moves(one: Measurement, axis: str) -> bool:
    values = one.table.columns.get(column_of(axis))
    known = np.zeros(0) if values is None else values[~np.isnan(values)]
    # A dead Y is refused by name; a column of another axis that is always 0 belongs to an axis without a probe.
    return known.size > 0 and (axis == FIRST or float(np.ptp(known)) > 0.0)
