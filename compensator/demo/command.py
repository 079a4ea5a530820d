"""`compensator demo`: the closed loop on simulated hardware, or a simulated machine in real time."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from compensator.commands import Answer
from compensator.commands.outputs import pages_text
from compensator.commands.progress_bar import progress_bar
from compensator.commands.workers import in_parallel
from compensator.demo.calibration import calibrate, paper_case
from compensator.demo.day import run_day
from compensator.demo.figures import shop_day, shown, table_of
from compensator.demo.live import run_live
from compensator.demo.loop import FIRST_MODEL, SECOND_DAY, close_the_loop, effect_of, figures_of_loop, second_day
from compensator.demo.machine import MACHINES
from compensator.demo.shop import run_shop_day
from compensator.demo.ten_days import results, ten_days
from compensator.report.demonstration import MachineDay, closed, page_of, verdict
from compensator.report.formats import write
from compensator.report.shop import probe_words, shop_table
from compensator.report.ten_days import days_page, days_table, days_verdict


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command `demo`.

    Raises
    ------
    CompensatorError
        If the page cannot be written in that format, or the simulated machine cannot start.
    """
    with _warnings_only():
        return _run(arguments)


@contextmanager
def _warnings_only() -> Iterator[None]:
    """Log warnings only: connections of viewers are not reported."""
    log = logging.getLogger("compensator")
    before = log.level
    log.setLevel(logging.WARNING)
    try:
        yield
    finally:
        log.setLevel(before)


def _run(arguments: argparse.Namespace) -> Answer:
    if arguments.live:
        recordings = run_live(arguments.out, hours=arguments.hours, seed=arguments.seed, port=arguments.port)
        text = f"stopped; to check the recordings: compensator replay {recordings}, compensator report {recordings}"
        return Answer({"recordings": str(recordings)}, text)
    if arguments.loop:
        return Answer(*run_ten_days(arguments.out, seed=arguments.seed, also=arguments.page))
    return Answer(*run_demo(arguments.out, hours=arguments.hours, seed=arguments.seed, also=arguments.page))


def run_demo(out: Path, *, hours: float, seed: int, also: Path | None = None) -> tuple[dict[str, Any], str]:
    """Run the demo and write its results.

    Parameters
    ----------
    out : pathlib.Path
        Folder for a configuration, recordings and `report.html` of each machine.
    hours : float
        Length of the simulated run, h.
    seed : int
        Seed of the simulated day.
    also : pathlib.Path, optional
        Another file for the page, such as a PDF.

    Returns
    -------
    (dict, str)
        Figures, and the table as text.
    """
    machine, days_of = out / "conduction", partial(_day_of_machine, out, hours=hours, seed=seed)
    shop = partial(run_shop_day, machine="conduction", model=FIRST_MODEL, effects=[effect_of(seed, hours)])
    with progress_bar("two simulated machines") as progress:
        for name in MACHINES:
            calibrate(out / name, machine=name, seed=seed)
        # Each day has devices, service and receiver of its own.
        jobs: list[Callable[[], Any]] = [
            partial(close_the_loop, machine, hours=hours, seed=seed),
            partial(shop, machine / "shop", hours=hours, seed=seed + SECOND_DAY),
            partial(second_day, machine, "first", hours=hours, seed=seed),
            *(partial(days_of, name) for name in MACHINES),
            partial(paper_case, out / "paper", seed=seed),
        ]
        adopted, (probed, sent), first, *days, paper = in_parallel(jobs, progress)
    results = {day.name: day.figures for day in days}
    table = table_of(results)
    loop, curves = figures_of_loop(adopted, first, effect_of(seed, hours))
    shopped = shop_day(first, probed, sent)
    page = out / "report.html"
    made = page_of(days, table, loop, curves, shopped, paper)
    for path in filter(None, (page, also)):
        write(path, made)
    summary = (
        f"Closed loop on the conduction machine, effect drawn by the seed: {loop['drawn']}; found in the recordings of "
        f"the first day: {', '.join(loop['found']) or 'nothing'}.\n"
        f"Second day: {loop['second_day_rms_um']['without']:.2f} µm rms without compensation. {closed(loop)}"
    )
    result = {"machines": results, "loop": loop, "shop": shopped.figures, "report": str(page)}
    tables = (
        f"{table.text()}\n\n{verdict(days)}\n{summary}\n\n{shop_table(shopped).text()}\n\n{probe_words(shopped).text()}"
    )
    return result, f"{tables}\n{pages_text(page, also)}"


def run_ten_days(out: Path, *, seed: int, also: Path | None = None) -> tuple[dict[str, Any], str]:
    """Run ten days of two machines with the loop, and write the page; parameters and result are those of `run_demo`."""
    days = ten_days(out, seed=seed)
    page, made = out / "loop.html", days_page(days)
    for path in filter(None, (page, also)):
        write(path, made)
    text = f"{days_table(days).text()}\n\n{days_verdict(days)}\n{pages_text(page, also)}"
    return {"loop_days": results(days), "report": str(page)}, text


def _day_of_machine(out: Path, name: str, *, hours: float, seed: int) -> MachineDay:
    """Run a day of a machine without an effect."""
    return shown(name, run_day(out / name, machine=name, hours=hours, seed=seed, model="calibration/model.toml"))
