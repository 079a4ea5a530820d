"""`compensator loop`: the loop over the recordings of a shop, a folder for each machine."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from compensator.commands import Answer
from compensator.commands.progress_bar import progress_bar
from compensator.commands.workers import in_parallel
from compensator.errors import DataError

if TYPE_CHECKING:
    from compensator.api.shop import MachineLoop
    from compensator.report.fleet import FleetRow


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    DataError
        If a folder is none, or no machine's recordings can be used.
    """
    from compensator.api.shop import loop_of_machine

    folders = _folders(arguments.folder)
    if arguments.scheduler is not None:
        # Workers may run in other folders, so paths must be absolute.
        folders = [folder.resolve() for folder in folders]
    jobs = [partial(loop_of_machine, folder, arguments.policy) for folder in folders]
    with progress_bar("machines") as progress:
        found: list[MachineLoop] = in_parallel(jobs, progress, scheduler=arguments.scheduler)
    if all(one.error for one in found):
        raise DataError(found[0].error)
    return _answer(found, arguments.page)


def _folders(given: Sequence[Path]) -> list[Path]:
    """Return the folder of each machine: those given, or, where one has no recordings itself, those in it that have."""
    found = []
    for folder in given:
        if not folder.is_dir():
            raise DataError(f"{folder}: no folder, expected one with the recordings of a machine")
        found += _with_recordings(folder) or [folder]
    return list(dict.fromkeys(found))


def _with_recordings(folder: Path) -> list[Path]:
    """Return a folder if it has recordings, or else those in it that have."""
    if any(folder.glob("*.mcap")):
        return [folder]
    below = sorted(one for one in folder.iterdir() if one.is_dir() and not one.is_symlink())
    return [found for one in below for found in _with_recordings(one)]


def _answer(found: Sequence[MachineLoop], page: Path | None) -> Answer:
    from compensator.report.fleet import fleet_page, fleet_table, fleet_verdict

    rows = [_row(one) for one in found]
    result = {"machines": [one.as_json() for one in found]}
    text = f"{fleet_table(rows).text()}\n\n{fleet_verdict(rows)}"
    if page is None:
        return Answer(result, text)
    from compensator.report.formats import write

    write(page, fleet_page(rows))
    return Answer(result | {"report": str(page)}, f"{text}\npage: {page}")


def _row(one: MachineLoop) -> FleetRow:
    from compensator.report.fleet import FleetRow

    if one.error:
        return FleetRow(name=one.folder, needs=f"check its recordings: {one.error}", is_bad=True)
    now = "–" if one.now_um is None else f"{one.now_um:.1f}"
    error = now if one.first_um is None else f"{one.first_um:.1f} → {now}"
    measured = {"sensor": "", "probe": " (probes)", "": ""}[one.measured_by]
    cut = f", {len(one.cut)} file(s) without their end: {', '.join(one.cut)}" if one.cut else ""
    return FleetRow(
        name=one.machine,
        span=f"{one.from_utc[:10]} to {one.to_utc[:10]}, {'its own loop' if one.is_recorded else 'computed now'}{cut}",
        error=f"{error}{measured}",
        found=", ".join(one.found) or "nothing",
        proposed=", ".join(one.proposed),
        adopted=": ".join(filter(None, (str(one.adopted), ", ".join(one.effects)))),
        gone_back=str(one.gone_back),
        needs=one.needs,
        steps=[f"{at}: {text}" for at, text in one.steps],
    )
