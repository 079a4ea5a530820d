"""`compensator identify`: from measured runs to a model file and the page beside it."""

from __future__ import annotations

import argparse
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
from compensator.tables import load_data, require

log = logging.getLogger("compensator")

#: Sample period of the models made, s: the service's.
PERIOD_S = 60.0
_NEEDED = ("t_q_degc", "at_degc", "y_um")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("data", type=Path, nargs="+", metavar="DATA", help="CSV, or a recording; one or several")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="MODEL", help="the model file; report.html beside it"
    )
    parser.add_argument("--column", action="append", default=[], metavar="ROLE=NAME",
                        help="role of a column of another name, such as t_q_degc=t5_degc")  # fmt: skip
    parser.add_argument("--name", help="name of the model (default: that of the file)")
    parser.add_argument("--kind", choices=("auto", "heat", "direct"), default="auto",
                        help="with a TTF, or from T_Q - AT straight to y (default: heat where heat_w is known)")  # fmt: skip
    parser.add_argument("--method", choices=("I", "II", "III", "IV"), default="IV",
                        help="TDTF given (I), from a whole ETVE (II), from its end (III), with the DTF at once (IV)")  # fmt: skip
    parser.add_argument("--tdtf", type=float, nargs=2, metavar=("UM_PER_K", "MIN"),
                        help="method I: gain and time constant of the first-order TDTF")  # fmt: skip
    parser.add_argument("--etve", type=Path, action="append", default=[], metavar="DATA",
                        help="methods II and III: a run without any heat source")  # fmt: skip
    parser.add_argument("--etve-end-h", type=float, default=6.0, metavar="H", help="method III: length of the end (6)")
    parser.add_argument("--ttf", type=int, nargs=3, default=(2, 2, 0), metavar=("NB", "NF", "NK"),
                        help="structure of the TTF (2 2 0)")  # fmt: skip
    parser.add_argument("--order", type=int, nargs=3, metavar=("NF", "NB_DTF", "NB_TDTF"),
                        help="structure of DTF and TDTF (default: chosen on held-out folds)")  # fmt: skip
    parser.add_argument("--drive", choices=("ttf", "known"), default="ttf",
                        help="heat that the DTF is fitted with: from T_Q as in the service, or the known one")  # fmt: skip
    parser.add_argument("--folds", type=int, default=5, help="blocks of time held out in turn (5)")
    parser.add_argument("--fit-until", type=float, metavar="H", help="fit up to this hour, judge on the rest")
    parser.add_argument("--validate", type=Path, action="append", default=[], metavar="DATA",
                        help="a run that only judges; may be repeated")  # fmt: skip
    parser.add_argument("--reference", metavar="MODEL", help="another model to put the coefficients beside")


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


def finished(calibration: Calibration, criticism: Criticism) -> Any:
    """Return the model with what was found about it in its provenance."""
    import dataclasses

    found = figures(calibration, criticism)
    kept = {
        key: found[key] for key in ("method", "parts", "folds_rms_um", "warnings", "remarks", "ttf") if key in found
    }
    return dataclasses.replace(calibration.model, provenance={**calibration.model.provenance, **kept})


def roles_of(pairs: Sequence[str]) -> dict[str, str]:
    """Take `--column ROLE=NAME` apart.

    Raises
    ------
    UsageError
        If one of them is no such pair.
    """
    roles = {}
    for pair in pairs:
        role, equals, name = pair.partition("=")
        if not equals or not role or not name:
            raise UsageError(f"--column {pair}: expected ROLE=NAME, such as t_q_degc=t5_degc")
        roles[role] = name
    return roles


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
