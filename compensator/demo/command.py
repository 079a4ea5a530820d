"""`compensator demo`: the closed loop on simulated hardware, or a simulated machine in real time."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from compensator.commands import Answer
from compensator.commands.outputs import checked_page, pages_text
from compensator.demo.calibration import calibrate, paper_case
from compensator.demo.day import run_day
from compensator.demo.figures import shop_day, shown, table_of
from compensator.demo.live import run_live
from compensator.demo.loop import FIRST_MODEL, SECOND_DAY, Loop, close_the_loop
from compensator.demo.machine import MACHINES
from compensator.demo.shop import run_shop_day
from compensator.demo.ten_days import results, ten_days
from compensator.report.demonstration import closed, page_of, verdict
from compensator.report.formats import write
from compensator.report.shop import ShopDay, probe_words, shop_table
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
    also = checked_page(arguments.page)
    if arguments.loop:
        return Answer(*run_ten_days(arguments.out, seed=arguments.seed, also=also))
    return Answer(*run_demo(arguments.out, hours=arguments.hours, seed=arguments.seed, also=also))


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
    days = []
    for name in MACHINES:
        calibrate(out / name, machine=name, seed=seed)
        day = run_day(out / name, machine=name, hours=hours, seed=seed, model="calibration/model.toml")
        days.append(shown(name, day))
    results = {day.name: day.figures for day in days}
    page = out / "report.html"
    table = table_of(results)
    closed_loop = close_the_loop(out / "conduction", hours=hours, seed=seed)
    loop = closed_loop.figures
    shop = _shop(out / "conduction", closed_loop, hours=hours, seed=seed)
    made = page_of(days, table, loop, closed_loop.second_day, shop, paper_case(out / "paper", seed=seed))
    for path in filter(None, (page, also)):
        write(path, made)
    summary = (
        f"Closed loop on the conduction machine, effect drawn by the seed: {loop['drawn']}; found in the recordings of "
        f"the first day: {', '.join(loop['found']) or 'nothing'}.\n"
        f"Second day: {loop['second_day_rms_um']['without']:.2f} µm rms without compensation. {closed(loop)}"
    )
    result = {"machines": results, "loop": loop, "shop": shop.figures, "report": str(page)}
    tables = f"{table.text()}\n\n{verdict(days)}\n{summary}\n\n{shop_table(shop).text()}\n\n{probe_words(shop).text()}"
    return result, f"{tables}\n{pages_text(page, also)}"


def run_ten_days(out: Path, *, seed: int, also: Path | None = None) -> tuple[dict[str, Any], str]:
    """Run ten days of two machines with the loop, and write the page; parameters and result are those of `run_demo`."""
    days = ten_days(out, seed=seed)
    page, made = out / "loop.html", days_page(days)
    for path in filter(None, (page, also)):
        write(path, made)
    text = f"{days_table(days).text()}\n\n{days_verdict(days)}\n{pages_text(page, also)}"
    return {"loop_days": results(days), "report": str(page)}, text


def _shop(folder: Path, loop: Loop, *, hours: float, seed: int) -> ShopDay:
    """Run the second day of the loop as a shop would, with the effect and the first model."""
    day, sent = run_shop_day(
        folder / "shop",
        machine="conduction",
        hours=hours,
        seed=seed + SECOND_DAY,
        model=FIRST_MODEL,
        effects=[loop.effect],
    )
    return shop_day(loop.first_model, day, sent)
