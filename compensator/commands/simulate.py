"""`compensator simulate`: a model over measured data."""

from __future__ import annotations

import argparse
import csv
import logging
from pathlib import Path
from typing import Any

import numpy as np

from compensator.atomic_write import whole_file
from compensator.commands import Answer
from compensator.commands.outputs import checked_file
from compensator.data.record import Record, require
from compensator.data.screening import DEAD_SAMPLES, check_scale
from compensator.data.tables import load_data, roles_of
from compensator.model.model_file import load_model
from compensator.model.simulation import csv_rows, scores, simulate
from compensator.model.thermal_model import ThermalModel
from compensator.reasons import Remark

log = logging.getLogger("compensator")

COLUMNS = ("t_s", "heat_w", "y_pred_um", "residual_um", "y_um", "y_dtf_um", "y_tdtf_um", "y_std_um")


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    CompensatorError
        If the data or the model cannot be read.
    """
    out = checked_file(arguments.out, "--out", read=(arguments.data, Path(arguments.model)), ending=".csv")
    model = load_model(arguments.model)
    data = load_data(arguments.data, model.period_s, roles_of(arguments.column))
    for remark in data.remarks:
        log.warning("%s", remark.marked)
    for record in data.records:
        require(arguments.data, record, ("t_q_degc", "at_degc"))
        for remark in doubts(str(arguments.data), model, record):
            log.warning("%s", remark.marked)
    parts = [simulate(model, record, source=str(arguments.data)) for record in data.records]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    with whole_file(out) as file:
        csv.writer(file, lineterminator="\n").writerows(csv_rows(columns, COLUMNS))
    result: dict[str, Any] = {
        "samples": int(columns["t_s"].size),
        "records": len(parts),
        "out": str(out),
    }
    text = f"{result['samples']} samples in {len(parts)} record(s) → {out}"
    if "y_um" in columns:
        score = scores(columns["y_um"], columns["y_pred_um"])
        result |= {"fit_pct": score.fit_pct, "rms_um": score.rms_um, "peak_to_peak_um": score.peak_to_peak_um}
        text += f"\nfit {score.fit_pct:.2f} %, residual {score.rms_um:.3f} µm rms"
        text += f", {score.peak_to_peak_um:.2f} µm peak to peak"
    return Answer(result, text)


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
            found.append(Remark("stuck", f"{source}: {name} = {known[0]:g} in every row."))
        low, high = model.validity.get(name, (-np.inf, np.inf))
        outside = int(np.sum((known < low) | (known > high)))
        if outside:
            said = f"{source}: {name} lies outside {low:g} to {high:g} °C in {outside} of {known.size} samples."
            found.append(Remark("outside_validity", said))
    return found
