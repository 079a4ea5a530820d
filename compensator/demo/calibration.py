"""Calibrations of the demo's machines and of the paper's case."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from compensator.api.identification import identify
from compensator.api.identification_result import IdentificationResult
from compensator.arrays import Vector
from compensator.commands.identify import write
from compensator.demo.machine import MACHINES
from compensator.identify.coefficients import Row
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors

PERIOD_S = 60.0
CALIBRATION_H = 36.0
CALIBRATION_SEED = 1000
#: Readings per minute of the calibration's logger.
READINGS = 60
#: Full scale of the paper's calibration, K and µm.
PAPER_K, PAPER_UM = 22.6, 116.0


def calibrate(folder: Path, *, machine: str, seed: int) -> None:
    """Calibrate a simulated machine from a run of 36 h with measured heat.

    Parameters
    ----------
    folder : pathlib.Path
        Folder for `calibration/` with the run, `model.toml` and the page.
    machine : str
        `conduction` or `published`.
    seed : int
        Seed of the demo; the calibration has its own duty cycle.
    """
    folder.mkdir(parents=True, exist_ok=True)
    duty = Duty.working_day(CALIBRATION_SEED + seed, hours=CALIBRATION_H)
    sensors = usual_sensors(duty.extra_names, heat_known=True)
    table = folder / "calibration" / "run.csv"
    write_table(table, World(MACHINES[machine](), duty, sensors, CALIBRATION_SEED + seed).record(PERIOD_S))
    write(identify(table, name=f"sim-{machine}"), table.parent / "model.toml")


def paper_case(folder: Path, *, seed: int) -> Sequence[Row]:
    """Repeat the paper's calibration on its published equations and compare the result with the printed coefficients.

    90 W for six of twelve hours; 95 % of the readings within 1 % of full scale, as stated in the paper.

    Parameters
    ----------
    folder : pathlib.Path
        Folder for the run, the model and the page.
    seed : int
        Seed of the noise.

    Returns
    -------
    sequence of Row
        Each coefficient, compared with the printed one.
    """
    duty = Duty.paper_calibration(seed)
    per_reading = np.sqrt(READINGS) * 0.01 / 1.96
    sensors = usual_sensors(
        temperature_noise_k=PAPER_K / np.sqrt(2.0) * per_reading, y_noise_um=PAPER_UM * per_reading, heat_known=True
    )
    table = folder / "run.csv"
    write_table(table, World(PublishedQuill(), duty, sensors, seed).record(PERIOD_S))
    found = identify(table, name="paper", order=(3, 3, 2), drive="known", reference="quill")
    assert isinstance(found, IdentificationResult)
    write(found, folder / "model.toml")
    return found.comparison


def write_table(path: Path, columns: Mapping[str, Vector]) -> None:
    """Write a recording as CSV; a missing value is an empty cell."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        rows = zip(*columns.values(), strict=True)
        writer.writerows(["" if np.isnan(v) else repr(round(float(v), 6)) for v in row] for row in rows)
