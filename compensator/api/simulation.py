"""`tc.simulate`: a model in free run over measured data."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compensator.api.files import ModelLike, model_of
from compensator.arrays import Vector
from compensator.atomic_write import atomic_write
from compensator.blas import one_thread
from compensator.codes import Reason, Remark, SampleQuality
from compensator.data.measurement import measurements
from compensator.data.record import Record, require
from compensator.data.screening import DEAD_SAMPLES, check_scale
from compensator.display import html_table
from compensator.model.simulation import COLUMNS, Scores, csv_rows, scores
from compensator.model.simulation import simulate as run_free
from compensator.model.thermal_model import ThermalModel

if TYPE_CHECKING:
    from compensator.api.plotting import Plot


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class SimulationResult(Mapping[str, Vector]):
    """Columns of a free run by name, as `compensator simulate` writes them.

    Parameters
    ----------
    columns : dict of str to numpy.ndarray, shape (n,)
        `t_s`, `heat_w`, `y_pred_um`, `y_std_um`, the share of each path; `y_um`, `residual_um` where Y was measured.
    records : int
        Number of stretches without a long gap.
    remarks : tuple of Remark
        What had to be corrected in the data, and what makes the prediction doubtful.
    scores : Scores or None
        Fit, rms and peak to peak of the residual, where Y was measured.
    """

    columns: dict[str, Vector]
    records: int
    remarks: tuple[Remark, ...]
    scores: Scores | None

    def __getitem__(self, name: str) -> Vector:
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def to_dict(self) -> dict[str, Any]:
        """Return the figures, as `compensator simulate --json` prints them."""
        found: dict[str, Any] = {"samples": int(self["t_s"].size), "records": self.records}
        if self.scores is not None:
            found |= {name: getattr(self.scores, name) for name in ("fit_pct", "rms_um", "peak_to_peak_um")}
        return found

    def summary(self) -> str:
        """Return what `compensator simulate` prints."""
        words = f"{self['t_s'].size} samples in {self.records} record(s)"
        if self.scores is not None:
            words += f"\nfit {self.scores.fit_pct:.2f} %, residual {self.scores.rms_um:.3f} µm rms"
            words += f", {self.scores.peak_to_peak_um:.2f} µm peak to peak"
        return words

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the columns as CSV.

        Raises
        ------
        OSError
            If it cannot be written there.
        """
        with atomic_write(Path(path)) as file:
            csv.writer(file, lineterminator="\n").writerows(csv_rows(self.columns))
        return Path(path)

    def plot(self) -> Plot:
        """Draw measured and predicted deformation, and the residual."""
        from compensator.api.plotting import stacked

        hours = self["t_s"] / 3600.0
        curves = [("predicted", hours, self["y_pred_um"])]
        if self.scores is None:
            return stacked([("Y, µm", curves)])[0]
        curves.insert(0, ("measured", hours, self["y_um"]))
        residual = [("measured − predicted", hours, self["residual_um"])]
        return stacked([("Y, µm", curves), ("residual, µm", residual)])[0]

    def __repr__(self) -> str:
        return f"{self.summary()}\ncolumns: {', '.join(self)}"

    def _repr_html_(self) -> str:
        rows = [[line] for line in (*self.summary().splitlines(), *(remark.marked for remark in self.remarks))]
        return html_table([", ".join(self)], rows)


@one_thread
def simulate(model: ModelLike, data: Any, *, columns: Mapping[str, str] | None = None) -> Any:
    """Run a model over measured data; Y, where it is measured, is never fed back.

    Parameters
    ----------
    model : ThermalModel, path or name
        What to run.
    data : path, DataFrame, mapping of str to array_like, Measurement, or list of those
        With T_Q and AT; see `compensator.read`.
    columns : mapping of str to str, optional
        Column name for each role that has another name.

    Returns
    -------
    SimulationResult or SimulationFrame
        One row for each sample of the model; a DataFrame where a DataFrame came in. Both have `summary()`, `scores`,
        `remarks` and `save(path)`.

    Raises
    ------
    CompensatorError
        If model or data cannot be read.
    """
    what = model_of(model)
    measured = measurements(data, "data", columns, needed=True)
    remarks: list[Remark] = []
    parts = []
    for one in measured:
        gridded = one.at_period(what.period_s)
        remarks += gridded.remarks
        for record in gridded.records:
            require(one.name, record, ("t_q_degc", "at_degc"))
            remarks += doubts(one.name, what, record)
            parts.append(run_free(what, record, source=one.name))
    result = SimulationResult(
        columns={name: _joined(parts, name) for name in COLUMNS if any(name in part for part in parts)},
        records=len(parts),
        remarks=tuple(remarks),
        scores=_scores(parts),
    )
    if not any(one.in_frame for one in measured):
        return result
    from compensator.api.simulation_frame import SimulationFrame

    start = measured[0].table.start_utc_s if len(measured) == 1 else None
    begin = start and start + float(measured[0].table.t_s.min())
    return SimulationFrame.of(result, begin, local=all(one.local_time for one in measured))


def _joined(parts: list[dict[str, Vector]], name: str) -> Vector:
    return np.concatenate([part.get(name, np.full(part["t_s"].size, np.nan)) for part in parts])


def _scores(parts: list[dict[str, Vector]]) -> Scores | None:
    if not any("y_um" in part for part in parts):
        return None
    return scores(_joined(parts, "y_um"), _joined(parts, "y_pred_um"))


def doubts(source: str, model: ThermalModel, record: Record) -> list[Remark]:
    """Return what makes a prediction from these temperatures doubtful.

    Parameters
    ----------
    source : str
        Name of the data.
    model : ThermalModel
        What is run.
    record : Record
        What it is run over.

    Raises
    ------
    DataError
        If a temperature is in kelvin, or below absolute zero.
    """
    found = []
    for name in ("t_q_degc", "at_degc"):
        values = record.columns[name]
        known = values[~np.isnan(values)]
        check_scale(source, name, values)
        if name == "t_q_degc" and known.size >= DEAD_SAMPLES and np.ptp(known) == 0.0:
            found.append(Remark(SampleQuality.STUCK, f"{source}: {name} = {known[0]:g} in every row."))
        low, high = model.validity.get(name, (-np.inf, np.inf))
        outside = int(np.sum((known < low) | (known > high)))
        if outside:
            words = f"{source}: {name} lies outside {low:g} to {high:g} °C in {outside} of {known.size} samples."
            found.append(Remark(Reason.OUTSIDE_VALIDITY, words))
    return found
