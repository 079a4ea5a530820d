"""`compensator identify`: from measured runs to a model file and the page beside it."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compensator import __version__
from compensator.commands import Answer
from compensator.commands.outputs import checked_file
from compensator.commands.progress import progress_bar
from compensator.data.record import Data, require
from compensator.data.runs import SHORTEST_RUN, Run, runs_of
from compensator.data.screening import screen_temperatures
from compensator.data.tables import load_data, load_recordings, roles_of
from compensator.errors import DataError, UsageError
from compensator.identify.calibration import Calibration, calibrate
from compensator.identify.comparison import Row, compare
from compensator.identify.criticism import Criticism, criticise
from compensator.identify.settings import Settings
from compensator.identify.summary import figures, text
from compensator.model.model_file import BUILT_IN, load_model
from compensator.model.model_writer import write_model
from compensator.model.thermal_model import ThermalModel

log = logging.getLogger("compensator")

#: Sample period of the models made, s: the service's.
PERIOD_S = 60.0
_NEEDED = ("t_q_degc", "at_degc", "y_um")


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What is to be made of which files.

    Parameters
    ----------
    data, etve, validate : sequence of pathlib.Path
        Files of the fit, of the test without heat source, and those that only judge.
    out : pathlib.Path
        The model file.
    name : str
        Name of the model.
    settings : Settings
        Kind, method, orders.
    columns : sequence of str
        `ROLE=NAME` pairs.
    fit_until_h : float, optional
        Fit up to this hour.
    reference : str, optional
        A model to put the coefficients beside.
    page : pathlib.Path, optional
        Another file that the page goes into, such as a PDF.
    """

    data: Sequence[Path]
    out: Path
    name: str
    settings: Settings
    etve: Sequence[Path] = ()
    validate: Sequence[Path] = ()
    columns: Sequence[str] = ()
    fit_until_h: float | None = None
    reference: str | None = None
    page: Path | None = None

    def __post_init__(self) -> None:
        taken = {path.resolve() for path in (*self.data, *self.etve)}
        for path in self.validate:
            if path.resolve() in taken:
                raise UsageError(f"--validate {path}: takes part in the fit, expected a run that does not")
        if str(self.out) in BUILT_IN:
            raise UsageError(f"--out {self.out}: is the name of the published model, expected one that ends in .toml")
        checked_file(self.out, "--out", read=(*self.data, *self.etve, *self.validate), ending=".toml")


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    CompensatorError
        If the data or the settings allow no model.
    """
    given = arguments
    settings = Settings(
        kind=given.kind,
        method=given.method,
        ttf=tuple(given.ttf),
        order=tuple(given.order) if given.order else None,
        drive=given.drive,
        given_tdtf=tuple(given.tdtf) if given.tdtf else None,
        etve_end_h=given.etve_end_h,
        folds=given.folds,
    )
    request = Request(
        data=given.data,
        out=given.out,
        name=given.name or given.out.stem,
        settings=settings,
        etve=given.etve,
        validate=given.validate,
        columns=given.column,
        fit_until_h=given.fit_until,
        reference=given.reference,
        page=_checked(given.page),
    )
    return identify(request)


def identify(request: Request) -> Answer:
    """Make a model of files, write it and its page.

    Raises
    ------
    CompensatorError
        If the data or the settings allow no model.
    """
    roles = roles_of(request.columns)
    remarks: list[str] = []
    runs = read_runs(request.data, roles, remarks)
    etve, validation = (read_runs(paths, roles, remarks) for paths in (request.etve, request.validate))
    for run in validation:
        screen_temperatures(run.name, [run], quiet_air=True)
    with progress_bar("fitting") as progress:
        calibration = calibrate(
            runs,
            request.settings,
            period_s=PERIOD_S,
            name=request.name,
            etve=etve,
            validation=validation,
            fit_until_s=None if request.fit_until_h is None else request.fit_until_h * 3600.0,
            provenance=provenance(request),
            remarks=remarks,
            progress=progress,
        )
    return write(calibration, criticise(calibration), request.out, reference=request.reference, also=request.page)


def _checked(page: Path | None) -> Path | None:
    if page is None:
        return None
    from compensator.report.formats import checked

    return checked(page, option="--page")


def write(
    calibration: Calibration, criticism: Criticism, out: Path, *, reference: str | None = None, also: Path | None = None
) -> Answer:
    """Write the model file and the page beside it."""
    from compensator.report.identification import write_report

    model = write_model(out, finished(calibration, criticism))
    rows: Sequence[Row] = compare(model, load_model(reference)) if reference else ()
    page = write_report(out.parent / "report.html", calibration, criticism, model, rows, also=also)
    result = {"model": str(out), "model_sha256": model.sha256, "report": str(page)} | figures(calibration, criticism)
    if rows:
        result["comparison"] = [
            {"path": r.path, "figure": r.figure, "found": r.found, "std": r.std, "reference": r.reference} for r in rows
        ]
    return Answer(result, f"{text(calibration, criticism)}\n\nmodel: {out}\npage: {page}")


def finished(calibration: Calibration, criticism: Criticism) -> ThermalModel:
    """Return the model with what was found about it in its provenance."""
    found = figures(calibration, criticism)
    kept = {key: found[key] for key in ("method", "parts", "warnings", "remarks", "ttf") if key in found}
    return dataclasses.replace(calibration.model, provenance=dict(calibration.model.provenance) | kept)


def read_runs(
    paths: Sequence[Path], roles: Mapping[str, str], remarks: list[str], *, period_s: float = PERIOD_S
) -> list[Run]:
    """Read tables and recordings into runs; what had to be put right is added to the remarks."""
    recordings = [path for path in paths if path.suffix == ".mcap"]
    tables = [(path, load_data(path, period_s, roles)) for path in paths if path.suffix != ".mcap"]
    if recordings:
        tables.append((recordings[0], load_recordings(recordings, period_s, roles)))
    runs = []
    for path, data in tables:
        remarks += data.remarks
        for record in data.records:
            require(path, record, _NEEDED)
            for one, said in runs_of(path.name, record):
                runs.append(one)
                remarks += said
    if not runs and tables:
        raise DataError(_without_runs(*tables[0], period_s))
    return runs


def _without_runs(path: Path, data: Data, period_s: float) -> str:
    """Say why a file holds nothing to work with."""
    size = sum(record.t_s.size for record in data.records)
    for name in ("t_q_degc", "at_degc", "heat_w"):
        missing = sum(int(np.isnan(r.columns[name]).sum()) for r in data.records if name in r.columns)
        if missing > size // 2:
            return f"{path}: {name} is missing in {missing} of {size} samples, expected it in most of them"
    return (
        f"{path}: {size * period_s / 60.0:.0f} min of data in {len(data.records)} part(s), expected at least one of "
        f"{SHORTEST_RUN * period_s / 60.0:.0f} min without a long gap, and 120 min in all for a model"
    )


def provenance(request: Request) -> dict[str, Any]:
    """Return where the model comes from: every file with its hash, and what was asked for."""
    settings = {
        field.name: getattr(request.settings, field.name)
        for field in dataclasses.fields(request.settings)
        if getattr(request.settings, field.name) is not None
    }
    if request.fit_until_h is not None:
        settings["fit_until_h"] = request.fit_until_h
    groups = (("fit", request.data), ("etve", request.etve), ("validation", request.validate))
    files = [
        {"role": role, "file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        for role, paths in groups
        for path in paths
    ]
    asked = {**settings, "columns": list(request.columns)}
    return {"source": f"compensator {__version__} identify", "data": files, "asked": asked}
