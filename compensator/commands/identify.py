"""`compensator identify`: fit a model to measured runs; write the model file and its page."""

from __future__ import annotations

import argparse
from pathlib import Path

from compensator.api.identification import identify
from compensator.api.identification_result import IdentificationResult
from compensator.api.identified_axes import IdentifiedAxes
from compensator.commands import Answer
from compensator.commands.outputs import pages_text
from compensator.commands.progress_bar import progress_bar
from compensator.data.table import roles_of
from compensator.errors import UsageError
from compensator.model.model_file import BUILT_IN
from compensator.report.results import calibration_page


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    given = arguments
    if str(given.out) in BUILT_IN:
        raise UsageError(f"--out {given.out}: is the name of the published model, expected a name that ends in .toml")
    with progress_bar("fitting") as progress:
        found = identify(
            given.data,
            validate=given.validate,
            etve=given.etve,
            columns=roles_of(given.column),
            axis=given.axis,
            name=given.name or given.out.stem,
            kind=given.kind,
            method=given.method,
            tdtf=given.tdtf,
            etve_end_h=given.etve_end_h,
            ttf=given.ttf,
            order=given.order,
            drive=given.drive,
            folds=given.folds,
            fit_until_h=given.fit_until,
            y_std_um=given.y_std,
            reference=given.reference,
            progress=progress,
        )
    return write(found, given.out, also=given.page)


def write(found: IdentificationResult | IdentifiedAxes, out: Path, *, also: Path | None = None) -> Answer:
    """Write the model file, and beside it the page, named after it: several models may be in one folder."""
    out.parent.mkdir(parents=True, exist_ok=True)
    found.save(out)
    page = found.write_page(calibration_page(out), also=also)
    files = {"model": str(out), "model_sha256": found.sha256, "report": str(page)}
    return Answer(files | found.to_dict(), f"{found.summary()}\n\nmodel: {out}\n{pages_text(page, also)}")
