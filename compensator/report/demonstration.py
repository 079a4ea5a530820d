"""The page of the demo: a simulated day with and without compensation, and the loop closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from compensator.arrays import Vector
from compensator.report.page import Block, Cell, Details, Figure, Line, Link, Page, Section, Table

#: What a machine is called in a sentence.
_KINDS = {"conduction": "heat-conduction machine", "published": "machine of the published equations"}
_TIME = "time, h"


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineDay:
    """One machine's simulated day.

    Parameters
    ----------
    name : str
        Of the machine.
    figures : dict
        Errors without compensation, with the offset held, and with its rate followed.
    errors : dict of str to numpy.ndarray
        `t_h`, and `without` and `followed`, µm.
    heat : tuple of numpy.ndarray
        Time in h and heat in W: the machine's own, and as estimated.
    """

    name: str
    figures: Mapping[str, Any]
    errors: Mapping[str, Vector]
    heat: tuple[Vector, Vector, Vector, Vector]


def page_of(
    days: Sequence[MachineDay],
    table: Sequence[Sequence[str]],
    loop: Mapping[str, Any],
    second_day: Mapping[str, tuple[Vector, Vector]],
    paper: Mapping[str, Any],
) -> Page:
    """Make the page.

    Parameters
    ----------
    days : sequence of MachineDay
        One for each machine.
    table : sequence of sequence of str
        Errors of all of them, the first row being the head.
    loop : dict
        What was drawn, found and left.
    second_day : dict of str to (numpy.ndarray, numpy.ndarray)
        Time in h and error in µm of the second day, by what compensated it.
    paper : dict
        The paper's own case as `identify` gave it.
    """
    blocks: list[Block] = [_error(day) for day in days]
    blocks += [
        Table(
            title="Errors in Y",
            head=table[0],
            rows=table[1:],
            note="Fit: of measured and predicted deformation, 100 · (1 − ‖y − ŷ‖ / ‖y − mean y‖).",
        ),
        _loop(loop, second_day),
        _pages(days),
        Details(title="Heat, as it was and as it was estimated", blocks=[_heat(day) for day in days]),
        Details(title="The paper's own case, beside what is printed", blocks=[_beside_the_print(paper)]),
    ]
    return Page(title="A simulated day, compensated", verdict=f"{verdict(days)} {closed(loop)}", blocks=blocks)


def verdict(days: Sequence[MachineDay]) -> str:
    """Return one sentence: how much of the error is left."""
    hours = max(float(day.errors["t_h"][-1]) for day in days)
    parts = [
        f"{day.figures['without']['peak_to_peak_um']:.0f} µm become "
        f"{day.figures['followed']['peak_to_peak_um']:.1f} µm ({_KINDS.get(day.name, day.name)})"
        for day in days
    ]
    return f"Thermal error in Y over {hours:.0f} simulated hours, peak to peak: {', '.join(parts)}."


def closed(loop: Mapping[str, Any]) -> str:
    """Return one sentence: what closing the loop has brought.

    Parameters
    ----------
    loop : dict
        What was drawn, found and left.
    """
    rms = loop["second_day_rms_um"]
    left = f"An effect that the calibration never saw leaves {rms['first']:.2f} µm rms"
    if loop["adopted"]:
        return f"{left}; with what the diagnosis found in the recordings, {rms['extended']:.2f}."
    return (
        f"{left}; what the diagnosis found in the recordings ({', '.join(loop['found']) or 'nothing'}) cannot run in "
        "the service, or does not hold on blocks of time that it did not see, so the model was left as it was."
    )


def _error(day: MachineDay) -> Figure:
    t, figures = day.errors["t_h"], day.figures
    return Figure(
        title=f"{day.name}: thermal error with and without compensation",
        x_label=_TIME,
        y_label="error in Y, µm",
        lines=(Line("without", t, day.errors["without"]), Line("with", t, day.errors["followed"])),
        note=f"{figures['without']['rms_um']:.1f} µm rms without, {figures['followed']['rms_um']:.2f} with, as the "
        "simulated machine itself knows it.",
    )


def _heat(day: MachineDay) -> Figure:
    t, true, at, estimated = day.heat
    return Figure(
        title=f"{day.name}: heat",
        x_label=_TIME,
        y_label="heat, W",
        lines=(Line("true", t, true), Line("estimated from T_Q and AT", at, estimated)),
    )


def _loop(loop: Mapping[str, Any], second_day: Mapping[str, tuple[Vector, Vector]]) -> Section:
    rms = loop["second_day_rms_um"]
    names = {"without": "without compensation", "first": "first model", "extended": "extended model"}
    rows = [[words, f"{rms[key]:.2f}"] for key, words in names.items()]
    lines = tuple(Line(names[key], *second_day[key]) for key in ("first", "extended"))
    taken = (
        f"The running service took the extended model over; judged from {loop['adopted_after_h']:.1f} h on."
        if loop["adopted"]
        else "The model was left as it was: both days are the same."
    )
    return Section(
        title="The loop closed: an effect the calibration never saw, on a second day with another duty",
        blocks=[
            Figure(
                title="Second day, error in Y with each model",
                x_label=_TIME,
                y_label="error in Y, µm",
                lines=lines,
                height=2.6,
                note=f"{rms['first']:.2f} µm rms with the first model, {rms['extended']:.2f} with the extended one.",
            ),
            Table(
                head=["conduction machine", "rms µm"],
                rows=rows,
                note=f"Found in the recordings of the first day: {', '.join(loop['found']) or 'nothing'} "
                f"({str(loop['verdict']).replace('_', ' ')}). Drawn by the seed and not passed on: {loop['drawn']}. "
                + taken,
            ),
        ],
    )


def _pages(days: Sequence[MachineDay]) -> Table:
    rows: list[list[Cell]] = [
        [
            Link(f"{day.name}/calibration/report.html", f"{day.name}/calibration/report.html"),
            f"how the model of the {_KINDS.get(day.name, day.name)} was made",
        ]
        for day in days
    ]
    rows.append([Link("conduction/diagnosis/report.html", "conduction/diagnosis/report.html"), "what the model lacked"])
    rows.append([Link("paper/report.html", "paper/report.html"), "the paper's own case"])
    return Table(title="Pages of this demo", head=["page", "about"], rows=rows)


def _beside_the_print(paper: Mapping[str, Any]) -> Table:
    rows = [
        [f"{r['path']}: {r['figure']}", f"{r['found']:.4g}", f"{r['std']:.2g}", f"{r['reference']:.4g}"]
        for r in paper["comparison"]
    ]
    return Table(
        head=["path and figure", "identified", "standard error", "printed"],
        rows=rows,
        note="Identified from a run with 1 % measuring error. One step of 90 W in quiet air: the TTF comes back, the "
        "slow part of DTF and TDTF only within its errors.",
    )
