"""`compensator diagnose`: find what a model lacks, from measured data."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from compensator.api.diagnosis import FILES, DiagnosisResult, diagnose
from compensator.api.files import models_of
from compensator.commands import Answer
from compensator.commands.outputs import pages_text
from compensator.commands.progress_bar import progress_bar
from compensator.commands.workers import workers
from compensator.data.axes import AxisLike
from compensator.data.measurement import measurements
from compensator.data.table import roles_of
from compensator.diagnose.fitting.prediction import FOLDS

#: Values up to which a search runs in this process; starting others takes as long.
ALONE = 30_000


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    given = arguments
    return diagnose_files(
        given.data,
        given.model,
        given.out,
        columns=roles_of(given.column),
        axis=given.axis,
        y_std_um=given.y_std,
        scheduler=given.scheduler,
        fit_until_h=given.fit_until,
        validate=given.validate,
        keep_paths=given.keep_paths,
        all_data=given.all_data,
        also=given.page,
    )


def diagnose_files(
    data: Sequence[Path],
    model: str | Path,
    out: Path,
    *,
    columns: Mapping[str, str] | None = None,
    axis: AxisLike = None,
    y_std_um: float | None = None,
    scheduler: str | None = None,
    fit_until_h: float | None = None,
    validate: Sequence[Path] = (),
    keep_paths: bool = False,
    all_data: bool = False,
    also: Path | None = None,
) -> Answer:
    """Diagnose files and write `diagnosis.json`, `model.toml`, `report.html` and `series.csv` into a folder."""
    bases = models_of(model)
    period_s = next(iter(bases.values())).period_s
    measured = measurements(data, "data", columns)
    values = sum(one.hours * 3600.0 / period_s * len(one.table.columns) for one in measured)
    with progress_bar("searching") as progress, workers(FOLDS if values > ALONE else 1, scheduler) as executor:
        found = diagnose(
            bases,
            measured,
            columns=columns,
            axis=axis,
            y_std_um=y_std_um,
            fit_until_h=fit_until_h,
            validate=validate,
            keep_paths=keep_paths,
            all_data=all_data,
            progress=progress,
            executor=executor,
        )
    found.save_all(out, also=also, series=True)
    model_file, page, curves = out / FILES[0], out / FILES[2], out / FILES[3]
    results = [found] if isinstance(found, DiagnosisResult) else list(found.values())
    if len(results) > 1:
        curves = curves.with_stem(f"{curves.stem}-AXIS")
    paths = {"model": str(model_file), "model_sha256": found.sha256, "report": str(page), "series": str(curves)}
    added = any(one.diagnosis.model is not one.diagnosis.evidence.model for one in results)
    unchanged = "" if added else " (the given model: nothing was added to it)"
    text = f"{found.summary()}\n\nmodel: {model_file}{unchanged}\ncurves: {curves}\n{pages_text(page, also)}"
    return Answer(found.to_dict() | paths, text)
