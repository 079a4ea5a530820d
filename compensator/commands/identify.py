"""`compensator identify`: from measured runs to a model file and the page beside it."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from compensator import __version__
from compensator.errors import UsageError
from compensator.identify.calibration import Calibration, calibrate
from compensator.identify.comparison import Row, compare
from compensator.identify.criticism import Criticism, criticise
from compensator.identify.runs import Run, runs_of
from compensator.identify.settings import Settings
from compensator.identify.summary import figures, text
from compensator.model.model_file import load_model
from compensator.model.model_writer import write_model
from compensator.model.thermal_model import ThermalModel
from compensator.tables import load_data, require, roles_of

log = logging.getLogger("compensator")

#: Sample period of the models made, s: the service's.
PERIOD_S = 60.0
_NEEDED = ("t_q_degc", "at_degc", "y_um")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Run the command; return its result and its text.

    Raises
    ------
    CompensatorError
        If the data or the settings allow no model.
    """
    settings = Settings(
        kind=arguments.kind, method=arguments.method, ttf=tuple(arguments.ttf),
        order=tuple(arguments.order) if arguments.order else None, drive=arguments.drive,
        given_tdtf=tuple(arguments.tdtf) if arguments.tdtf else None, etve_end_h=arguments.etve_end_h,
        folds=arguments.folds,
    )  # fmt: skip
    taken = {path.resolve() for path in (*arguments.data, *arguments.etve)}
    for path in arguments.validate:
        if path.resolve() in taken:
            raise UsageError(f"--validate {path}: takes part in the fit, expected a run that does not")
    roles = roles_of(arguments.column)
    remarks: list[str] = []
    runs = read_runs(arguments.data, roles, remarks)
    etve, validation = (read_runs(paths, roles, remarks) for paths in (arguments.etve, arguments.validate))
    with progress("fitting") as told:
        calibration = calibrate(
            runs, settings, period_s=PERIOD_S, name=arguments.name or arguments.out.stem, etve=etve,
            validation=validation, fit_until_s=None if arguments.fit_until is None else arguments.fit_until * 3600.0,
            provenance=provenance(arguments), remarks=remarks, told=told,
        )  # fmt: skip
    criticism = criticise(calibration)
    return write(calibration, criticism, arguments.out, reference=arguments.reference)


def write(
    calibration: Calibration, criticism: Criticism, out: Path, *, reference: str | None = None
) -> tuple[dict[str, Any], str]:
    """Write the model file and the page beside it; return the result and its text."""
    from compensator.report.identification import write_report

    model = write_model(out, finished(calibration, criticism))
    rows: Sequence[Row] = compare(model, load_model(reference)) if reference else ()
    page = write_report(out.parent / "report.html", calibration, criticism, model, rows)
    result = {"model": str(out), "model_sha256": model.sha256, "report": str(page)} | figures(calibration, criticism)
    if rows:
        result["comparison"] = [
            {"path": r.path, "figure": r.figure, "found": r.found, "std": r.std, "reference": r.reference} for r in rows
        ]
    return result, f"{text(calibration, criticism)}\n\nmodel: {out}\npage: {page}"


def finished(calibration: Calibration, criticism: Criticism) -> ThermalModel:
    """Return the model with what was found about it in its provenance."""
    found = figures(calibration, criticism)
    kept = {
        key: found[key] for key in ("method", "parts", "folds_rms_um", "warnings", "remarks", "ttf") if key in found
    }
    return dataclasses.replace(calibration.model, provenance=dict(calibration.model.provenance) | kept)


def read_runs(paths: Sequence[Path], roles: Mapping[str, str], remarks: list[str]) -> list[Run]:
    """Read tables and recordings into runs; what had to be put right is added to the remarks."""
    runs = []
    for path in paths:
        data = load_data(path, PERIOD_S, roles)
        remarks += data.remarks
        for record in data.records:
            require(path, record, _NEEDED)
            for one, said in runs_of(path.name, record):
                runs.append(one)
                remarks += said
    return runs


def provenance(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return where the model comes from: every file with its hash, and what was asked for."""
    asked = {
        "kind": arguments.kind, "method": arguments.method, "ttf": list(arguments.ttf), "drive": arguments.drive,
        "folds": arguments.folds, "columns": list(arguments.column),
    }  # fmt: skip
    for key in ("order", "tdtf", "fit_until"):
        if getattr(arguments, key) is not None:
            asked[key] = getattr(arguments, key)
    groups = (("fit", arguments.data), ("etve", arguments.etve), ("validation", arguments.validate))
    files = [
        {"role": role, "file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        for role, paths in groups
        for path in paths
    ]
    return {"source": f"compensator {__version__} identify", "data": files, "asked": asked}


@contextmanager
def progress(words: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar on a terminal; yield what it is told with: steps done, of how many."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task(words, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
