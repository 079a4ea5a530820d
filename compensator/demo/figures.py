"""Figures of a simulated day, against the true deformation of the simulated machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.clock import NS
from compensator.demo.day import START_NS, Day
from compensator.demo.machine import TOUCH_STD_UM
from compensator.demo.shop import SentProbe
from compensator.display import Table
from compensator.messages import number
from compensator.model.simulation import scores
from compensator.report.demonstration import MachineDay
from compensator.report.shop import ShopDay


def errors_of(day: Day) -> dict[str, Vector]:
    """Return the error in Y without compensation, with the offset held, and with its rate followed, µm."""
    t = day.truth["t_s"]
    y = day.truth["y_um"]
    offsets = [(o.offset.time_utc_ns - START_NS) / NS for o in day.outcomes]
    start = int(np.searchsorted(t, offsets[0]))
    t, y = t[start:], y[start:] - y[start]
    index = np.clip(np.searchsorted(offsets, t, side="right") - 1, 0, None)
    value = np.array([number(o.offset.y_offset_um) for o in day.outcomes])[index]
    rate = np.array([number(o.offset.y_offset_rate_um_per_min) for o in day.outcomes])[index]
    return {
        "t_h": t / 3600.0,
        "without": y,
        "held": y + value,
        "followed": y + value + rate * (t - np.array(offsets)[index]) / 60.0,
    }


def figures_of(day: Day, errors: Mapping[str, Vector]) -> dict[str, Any]:
    """Return errors without and with compensation, fit, and the other figures of a day."""
    estimate = [outcome.estimate for outcome in day.outcomes]
    fit = scores(np.array([number(e.y_um) for e in estimate]), np.array([number(e.y_pred_um) for e in estimate]))
    remaining = errors["followed"]
    part: dict[str, Any] = {name: _spread(errors[name]) for name in ("without", "held", "followed")}
    part |= {
        "samples": len(day.outcomes),
        "received": len(day.received),
        "seconds": round(day.seconds, 1),
        "fit_pct": fit.fit_pct,
        "removed_pct": 100.0 * (1.0 - float(np.std(remaining)) / float(np.std(errors["without"]))),
        "states": {s: sum(o.offset.state == s for o in day.outcomes) for s in {o.offset.state for o in day.outcomes}},
    }
    return part


def _spread(error_um: Vector) -> dict[str, float]:
    return {"rms_um": float(np.sqrt(np.mean(error_um**2))), "peak_to_peak_um": float(np.ptp(error_um))}


def shop_day(alone: Day, probed: Day, sent: Sequence[SentProbe]) -> ShopDay:
    """Return the content of the page for a day as a shop runs it.

    Parameters
    ----------
    alone, probed : Day
        The same day by the model alone, and by model and probe.
    sent : sequence of SentProbe
        The probes, as they were measured.
    """
    records = [record for outcome in probed.outcomes for record in outcome.probes]
    before, errors = errors_of(alone), errors_of(probed)
    times_h = [(record.time_utc_ns - START_NS) / NS / 3600.0 for record in records]
    # A shop without a model sets the offset to what the last probe showed; before the first one it has none.
    shown_um = np.array([0.0, *(number(record.deformation_um) for record in records)])
    errors = {
        "t_h": errors["t_h"],
        "without": errors["without"],
        "probe": errors["without"] - shown_um[np.searchsorted(times_h, errors["t_h"], side="right")],
        "model": before["followed"],
        "model_and_probe": errors["followed"],
    }
    figures: dict[str, Any] = {name: _spread(values) for name, values in errors.items() if name != "t_h"}
    figures["probe_std_um"] = TOUCH_STD_UM
    by_time = {probe.time_utc_ns: probe for probe in sent}
    figures["probes"] = [
        {
            "time_h": time_h,
            "measured_um": number(record.measured_um),
            "chip_um": by_time[record.time_utc_ns].chip_um,
            "asked_because": by_time[record.time_utc_ns].asked_because,
            "taken": record.taken,
            "code": record.code,
            "text": record.text,
        }
        for time_h, record in zip(times_h, records, strict=True)
    ]
    return ShopDay(figures=figures, errors=errors)


def shown(name: str, day: Day) -> MachineDay:
    """Return the content of the page for a day."""
    hours = [(o.estimate.time_utc_ns - START_NS) / NS / 3600 for o in day.outcomes]
    heat = [number(o.estimate.heat_w) for o in day.outcomes]
    errors = errors_of(day)
    return MachineDay(
        name=name,
        figures=figures_of(day, errors),
        errors=errors,
        heat=(day.truth["t_s"] / 3600.0, day.truth["heat_w"], np.array(hours), np.array(heat)),
    )


def table_of(results: Mapping[str, Any]) -> Table:
    """Return the table of errors of all machines."""
    cases = {"without": "no compensation", "held": "offset held 60 s", "followed": "rate followed"}
    rows = []
    for machine, figures in results.items():
        for key, words in cases.items():
            first = key == "without"
            rows.append(
                [
                    machine if first else "",
                    words,
                    f"{figures[key]['rms_um']:.2f}",
                    f"{figures[key]['peak_to_peak_um']:.2f}",
                    f"{figures['fit_pct']:.1f}" if key == "followed" else "",
                    str(figures["samples"]) if first else "",
                    f"{figures['seconds']:.1f}" if first else "",
                ]
            )
    return Table(
        title="Errors in Y",
        head=["simulated machine", "", "rms µm", "peak to peak µm", "fit %", "samples", "seconds"],
        rows=rows,
        note="Fit: of measured and predicted deformation, 100 · (1 − ‖y − ŷ‖ / ‖y − mean y‖).",
    )
