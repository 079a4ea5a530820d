"""A day of the demo as a shop runs it: no displacement sensor, a touch probe each hour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.report.page import Figure, Line, Marks, Section, Table

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
        note="Whole second day, first model. Probe alone: the same probes, each held until the next. "
        "Left: rms, of no compensation.",
    )


def probed(day: ShopDay) -> str:
    """Return in sentences how many probes there were, and which were refused and asked for."""
    probes = day.figures["probes"]
    refused = [probe for probe in probes if not probe["taken"]]
    asked = [probe for probe in probes if probe["asked_because"]]
    words = [f"{len(probes)} probes; refused: {_list([_refused(probe) for probe in refused])}."]
    words += [
        f"At {probe['time_h']:.2f} h the service wanted another one ({probe['asked_because']}), which was "
        f"{'taken' if probe['taken'] else 'refused'}."
        for probe in asked
    ]
    missed = [probe for probe in probes if probe["chip_um"] and probe["taken"]]
    words += [f"The chip at {probe['time_h']:.2f} h was not recognised." for probe in missed]
    return " ".join(words)


def _refused(probe: Mapping[str, Any]) -> str:
    why = f", a chip of {probe['chip_um']:.0f} µm" if probe["chip_um"] else ""
    return f"{probe['time_h']:.2f} h ({probe['code']}{why})"


def _list(words: list[str]) -> str:
    return ", ".join(words) or "none"


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
                note=f"A probe shows this error with a noise of {day.figures['probe_std_um']:g} µm. {probed(day)}",
            ),
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
