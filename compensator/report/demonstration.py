"""The page of the demo: a simulated day with and without compensation, and the closed loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from compensator.arrays import Vector
from compensator.identify.coefficients import Row as Comparison
from compensator.identify.summary import comparison_table
from compensator.report.page import Block, Cell, Details, Figure, Line, Link, Page, Section, Table
from compensator.report.shop import ShopDay, shop_section

#: Names of the machines in text.
_KINDS = {"conduction": "heat-conduction machine", "published": "machine of the published equations"}
_TIME = "time, h"


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineDay:
    """One machine's simulated day.

    Parameters
    ----------
    name : str
        Name of the machine.
    figures : dict
        Errors without compensation, with the offset held, and with its rate followed.
    errors : dict of str to numpy.ndarray
        `t_h`, and `without` and `followed`, µm.
    heat : tuple of numpy.ndarray
        Time in h and heat in W: true, then estimated.
    """

    name: str
    figures: Mapping[str, Any]
    errors: Mapping[str, Vector]
    heat: tuple[Vector, Vector, Vector, Vector]


def page_of(
    days: Sequence[MachineDay],
    table: Table,
    loop: Mapping[str, Any],
    second_day: Mapping[str, tuple[Vector, Vector]],
    shop: ShopDay,
    paper: Sequence[Comparison],
) -> Page:
    """Make the page.

    Parameters
    ----------
    days : sequence of MachineDay
        One for each machine.
    table : Table
        Errors of all machines.
    loop : dict
        Effect drawn, effects found, remaining errors.
    second_day : dict of str to (numpy.ndarray, numpy.ndarray)
        Time in h and error in µm of the second day, by model.
    shop : ShopDay
        The second day without displacement sensor, with a touch probe.
    paper : sequence of Comparison
        Coefficients of the paper's case, compared with the printed ones.
    """
    blocks: list[Block] = [_error(day) for day in days]
    blocks += [
        table,
        _loop(loop, second_day),
        shop_section(shop),
        _pages(days),
        Details(title="Heat, true and estimated", blocks=[_heat(day) for day in days]),
        Details(title="The paper's case, compared with the printed coefficients", blocks=[_comparison(paper)]),
    ]
    return Page(title="A simulated day, compensated", verdict=f"{verdict(days)} {closed(loop)}", blocks=blocks)


def verdict(days: Sequence[MachineDay]) -> str:
    """Return the result of the days in one sentence."""
    hours = max(float(day.errors["t_h"][-1]) for day in days)
    parts = [
        f"from {day.figures['without']['peak_to_peak_um']:.0f} to "
        f"{day.figures['followed']['peak_to_peak_um']:.1f} µm ({_KINDS.get(day.name, day.name)})"
        for day in days
    ]
    return f"Thermal error in Y over {hours:.0f} simulated hours, peak to peak, reduced {', '.join(parts)}."


def closed(loop: Mapping[str, Any]) -> str:
    """Return the result of the closed loop in one sentence.

    Parameters
    ----------
    loop : dict
        Effect drawn, effects found, remaining errors.
    """
    rms = loop["second_day_rms_um"]
    left = f"An effect absent from the calibration leaves {rms['first']:.2f} µm rms"
    if loop["offset_changes"]:
        return f"{left}; with the effects that the diagnosis found in the recordings, {rms['extended']:.2f}."
    return (
        f"{left}; the effects that the diagnosis found in the recordings ({', '.join(loop['found']) or 'none'}) are "
        "not deployable or do not reduce the error on held-out blocks, so the "
        f"{'model changes its standard deviation only' if loop['adopted'] else 'model was not changed'}."
    )


def _error(day: MachineDay) -> Figure:
    t, figures = day.errors["t_h"], day.figures
    return Figure(
        title=f"{day.name}: thermal error with and without compensation",
        x_label=_TIME,
        y_label="error in Y, µm",
        lines=(Line("without", t, day.errors["without"]), Line("with", t, day.errors["followed"])),
        note=f"{figures['without']['rms_um']:.1f} µm rms without, {figures['followed']['rms_um']:.2f} with, against "
        "the true deformation of the simulated machine.",
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
    adopted = (
        f"The running service adopted the extended model; errors from {loop['adopted_after_h']:.1f} h on."
        if loop["adopted"]
        else "The model was not changed: both days are the same."
    )
    return Section(
        title="Closed loop: an effect absent from the calibration, on a second day with another duty cycle",
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
                f"({str(loop['verdict']).replace('_', ' ')}). Effect drawn by the seed: {loop['drawn']}. {adopted}",
            ),
        ],
    )


def _pages(days: Sequence[MachineDay]) -> Table:
    rows: list[list[Cell]] = [
        [
            Link(f"{day.name}/calibration/model-calibration.html", f"{day.name}/calibration/model-calibration.html"),
            f"calibration of the {_KINDS.get(day.name, day.name)}",
        ]
        for day in days
    ]
    rows.append(
        [
            Link("conduction/diagnosis/report.html", "conduction/diagnosis/report.html"),
            "diagnosis of the conduction machine",
        ]
    )
    paper = "paper/model-calibration.html"
    rows.append([Link(paper, paper), "calibration of the paper's case"])
    return Table(title="Pages of this demo", head=["page", "subject"], rows=rows)


def _comparison(paper: Sequence[Comparison]) -> Table:
    return dataclasses.replace(
        comparison_table(paper),
        title="",
        note="Identified from a run with 1 % measurement error and one step of 90 W in still air: the TTF is "
        "recovered, the slow part of DTF and TDTF only within its standard errors.",
    )
