"""Measured data at the model's sample period."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from compensator.arrays import Vector
from compensator.codes import Remark
from compensator.errors import DataError

#: Temperatures that no model runs without.
TEMPERATURES = ("t_q_degc", "at_degc")
#: A gap of up to this many model samples stays inside a record; the engine bridges it.
SHORT_GAP_SAMPLES = 60


@dataclass(frozen=True, slots=True)
class SampledRecord:
    """A measured run at the model's sample period.

    Parameters
    ----------
    t_s : numpy.ndarray, shape (n,)
        Time of each sample from the start of the data, s, evenly spaced.
    columns : dict of str to numpy.ndarray, shape (n,)
        Channels by name; NaN where missing.
    row_s : float
        Usual time between the rows that the samples are made from, s; NaN where it is not known.
    """

    t_s: Vector
    columns: dict[str, Vector]
    row_s: float = math.nan


@dataclass(frozen=True, slots=True)
class SampledData:
    """Records at a sample period, with remarks on how they were made.

    Parameters
    ----------
    records : tuple of SampledRecord
        In order of time; a long gap starts a new one.
    remarks : tuple of Remark
        Corrections: gaps, rows out of order.
    """

    records: tuple[SampledRecord, ...]
    remarks: tuple[Remark, ...]


def require(name: str, record: SampledRecord, columns: Sequence[str], *, why: str = "") -> None:
    """Refuse a record that lacks a column.

    Raises
    ------
    DataError
        Naming data and column.
    """
    for column in columns:
        if column not in record.columns:
            raise DataError(
                f"{name}: no column {column}{why}; it has: {', '.join(record.columns)}. "
                f"Name it with --column {column}=NAME"
            )
