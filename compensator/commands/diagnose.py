"""`compensator diagnose`: from a model and measured data to what the model lacks."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from compensator import __version__
from compensator.commands import Answer
from compensator.commands.identify import read_runs
from compensator.commands.outputs import checked_folder
from compensator.commands.progress import progress_bar
from compensator.commands.workers import workers
from compensator.data.screening import screen_temperatures
from compensator.data.tables import roles_of
from compensator.diagnose.diagnosis import diagnose
from compensator.diagnose.outcome import FOLDS, Diagnosis
from compensator.diagnose.summary import figures, text
from compensator.model.model_file import load_model
from compensator.model.model_writer import write_model
from compensator.report.diagnosis import write_report
from compensator.report.formats import checked

#: What is written into the folder.
FILES = ("model.toml", "diagnosis.json", "report.html")
#: So few values are searched in this process; starting others takes as long.
ALONE = 30_000


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    CompensatorError
        If the data or the model cannot be read, or there is too little.
    """
    given = arguments
    also = checked(given.page, option="--page") if given.page else None
    return diagnose_files(
        given.data, given.model, given.out, columns=given.column, scheduler=given.scheduler, also=also
    )


def diagnose_files(
    data: Sequence[Path],
    model: str | Path,
    out: Path,
    *,
    columns: Sequence[str] = (),
    scheduler: str | None = None,
    also: Path | None = None,
) -> Answer:
    """Diagnose files and write `diagnosis.json`, `model.toml` and `report.html` into a folder."""
    checked_folder(out, "--out", read=(*data, Path(model)), names=FILES)
    base = load_model(model)
    remarks: list[str] = []
    runs = read_runs(data, roles_of(columns), remarks, period_s=base.period_s)
    names = ", ".join(dict.fromkeys(run.name for run in runs))
    screen_temperatures(names, runs, quiet_air=True)
    values = sum(run.t_s.size * (len(run.channels) + 2) for run in runs)
    with progress_bar("searching") as progress, workers(FOLDS if values > ALONE else 1, scheduler) as executor:
        diagnosis = diagnose(base, runs, progress=progress, executor_map=executor.map if executor else map)
    return write(diagnosis, base.sha256, data, out, remarks, also=also)


def write(
    diagnosis: Diagnosis,
    base_sha256: str,
    data: Sequence[Path],
    out: Path,
    remarks: Sequence[str],
    *,
    also: Path | None = None,
) -> Answer:
    """Write what was found."""
    out.mkdir(parents=True, exist_ok=True)
    found = figures(diagnosis)
    provenance = dict(diagnosis.model.provenance) | {
        "diagnosis": {
            "source": f"compensator {__version__} diagnose",
            "base_model_sha256": base_sha256,
            "data": [{"file": p.name, "sha256": hashlib.sha256(p.read_bytes()).hexdigest()} for p in data],
            "verdict": diagnosis.verdict,
            "held_out_rms_um": {"before": diagnosis.before.rms_um, "after": diagnosis.after.rms_um},
        }
    }
    model = write_model(out / "model.toml", dataclasses.replace(diagnosis.model, provenance=provenance))
    (out / "diagnosis.json").write_text(json.dumps(found, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    page = write_report(out / "report.html", diagnosis, model, remarks, also=also)
    files = {"model": str(out / "model.toml"), "model_sha256": model.sha256, "report": str(page)}
    words = [
        text(diagnosis),
        *([f"remarks: {'; '.join(remarks)}"] if remarks else []),
        f"model: {files['model']}\npage: {page}",
    ]
    return Answer({**found, **files}, "\n\n".join(words))
