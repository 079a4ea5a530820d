"""A day of the demo as a shop runs it: no displacement sensor, a touch probe each hour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.report.page import Cell, CodeLink, Figure, Line, Marks, Section, Table, Words

_CASES = {
    "without": "no compensation",
    "probe": "probe alone, last value held",
    "model": "model alone",
    "model_and_probe": "model and probe",
}
_TIME, _ERROR = "time, h", "error in Y, µm"


@dataclass(frozen=True, slots=True, kw_only=True)
class ShopDay:
    """A day as a shop runs it.

    Parameters
    ----------
    figures : dict
        Errors in each case; `probe_std_um`, the standard deviation of the probe; `probes`: for each the time in h, the
        measured value, a chip on the feature, why it was asked for, and the verdict.
    errors : dict of str to numpy.ndarray
        `t_h`, and the error in Y in each case, µm.
    """

    figures: Mapping[str, Any]
    errors: Mapping[str, Vector]


def shop_table(day: ShopDay) -> Table:
    """Return the table of errors."""
    without = day.figures["without"]["rms_um"]
    rows = [
        [
            words,
            f"{day.figures[key]['rms_um']:.2f}",
            f"{day.figures[key]['peak_to_peak_um']:.2f}",
            f"{100.0 * day.figures[key]['rms_um'] / without:.1f}",
        ]
        for key, words in _CASES.items()
    ]
    return Table(
        title="Errors in Y without displacement sensor, with a touch probe each hour",
        head=["conduction machine with the undeclared effect", "rms µm", "peak to peak µm", "left %"],
        rows=rows,
        note="Whole second day, first model, rms about the zero. Probe alone: the same probes, each held until "
        "the next. Left: rms as a share of that without compensation.",
    )


def probe_words(day: ShopDay) -> Words:
    """Return how many probes there were, which of them were refused, and which the service asked for."""
    probes = day.figures["probes"]
    refused = sum(not probe["taken"] for probe in probes)
    lines: list[Cell] = [f"{len(probes)} probes with a noise of {day.figures['probe_std_um']:g} µm; {refused} refused."]
    lines += [_remark(one) for one in probes if one["code"] or one["chip_um"] or one["asked_because"]]
    return Words(title="Probes", lines=lines)


def _remark(probe: Mapping[str, Any]) -> Cell:
    parts: list[str | CodeLink] = [f"{probe['time_h']:.2f} h: "]
    if probe["asked_because"]:
        parts += ["asked for by the service ", CodeLink(probe["asked_because"]), "; "]
    if probe["chip_um"]:
        parts.append(f"a chip of {probe['chip_um']:.0f} µm lay on the feature; ")
    parts.append(probe["text"])
    if probe["code"]:
        parts += [" ", CodeLink(probe["code"])]
    return tuple(parts)


def shop_section(day: ShopDay) -> Section:
    """Return the section of the page."""
    t = day.errors["t_h"]
    lines = {key: Line(words, t, day.errors[key]) for key, words in _CASES.items()}
    return Section(
        title="As a shop runs it: no displacement sensor, a touch probe each hour",
        blocks=[
            Figure(
                title="Second day, error in Y without model",
                x_label=_TIME,
                y_label=_ERROR,
                lines=(lines["without"], lines["probe"]),
                height=2.6,
            ),
            Figure(
                title="Second day, error in Y with the first model",
                x_label=_TIME,
                y_label=_ERROR,
                lines=(lines["model"], lines["model_and_probe"]),
                marks=_marks(day),
                note="A probe shows the error that model and probe leave, with its noise. A correction stays until the "
                "next probe: where the effect changes in between, the error may be larger than with the model alone.",
            ),
            probe_words(day),
            shop_table(day),
        ],
    )


def _marks(day: ShopDay) -> tuple[Marks, ...]:
    marks: tuple[tuple[str, bool, Any], ...] = (("probe taken", True, "o"), ("probe refused", False, "x"))
    found = []
    for name, taken, marker in marks:
        probes = [probe for probe in day.figures["probes"] if probe["taken"] is taken]
        x, y = (np.array([probe[key] for probe in probes]) for key in ("time_h", "measured_um"))
        if probes:
            found.append(Marks(name, x, y, marker=marker))
    return tuple(found)
