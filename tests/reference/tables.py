"""Tables of the published machine, each from a fixed seed; values are rounded as a logger would."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from sim_hardware.physics import Duty
from sim_hardware.physics.published import DEFORMATION_POLES, DTF, TDTF, TTF, TTF_POLES, tustin

#: Length of each table, min.
HEAT, DIRECT, EFFECT = 18 * 60, 14 * 60, 13 * 60


def _lag(values: np.ndarray, tau_min: float) -> np.ndarray:
    keep = np.exp(-1.0 / tau_min)
    return lfilter([0.0, 1.0 - keep], [1.0, -keep], values - values[0])


def _day(seed: int, n: int) -> dict[str, np.ndarray]:
    """Return a working day at 60 s: inputs, temperatures and deformation, measured with noise."""
    columns = Duty.working_day(seed, hours=n / 60.0).columns
    day = {name: np.asarray(values)[: n * 6].reshape(n, 6).mean(axis=1) for name, values in columns.items()}
    random = np.random.default_rng([seed, 10])
    heat, at = day["heat_w"], day["ambient_degc"]
    difference = lfilter(*tustin(TTF, TTF_POLES), heat)
    y_dtf = lfilter(*tustin(DTF, DEFORMATION_POLES), heat)
    y = y_dtf + lfilter(*tustin(TDTF, DEFORMATION_POLES), at - at[0])
    for name in ("coolant_degc", "cabinet_degc"):
        day[name] = day[name] + random.normal(0.0, 0.02, n)
    return day | {
        "t_q_degc": at + difference + random.normal(0.0, 0.03, n),
        "at_degc": at + random.normal(0.0, 0.02, n),
        "y_um": y + random.normal(0.0, 0.3, n),
        "y_dtf_um": y_dtf,
    }


def _write(
    path: Path, times: list[str], time: str, columns: dict[str, tuple[np.ndarray, int]], rows: list[int]
) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join([time, *columns]) + "\n")
        for i in rows:
            file.write(",".join([times[i], *(f"{values[i]:.{n}f}" for values, n in columns.values())]) + "\n")


def heat(path: Path) -> None:
    """Write a calibration with a wattmeter."""
    day = _day(501, HEAT)
    columns = {
        "t_q_degc": (day["t_q_degc"], 3),
        "at_degc": (day["at_degc"], 3),
        "y_um": (day["y_um"], 2),
        "heat_w": (day["heat_w"], 1),
    }
    _write(path, [str(60 * i) for i in range(HEAT)], "t_s", columns, list(range(HEAT)))


def direct(path: Path) -> None:
    """Write a calibration without one: clock times, other names, a short gap, a long one, two rows exchanged."""
    day = _day(502, DIRECT)
    start = datetime(2026, 1, 5, 6, tzinfo=UTC).timestamp()
    times = [datetime.fromtimestamp(start + 60 * i, UTC).strftime("%Y-%m-%dT%H:%M:%SZ") for i in range(DIRECT)]
    columns = {"spindle": (day["t_q_degc"], 3), "air": (day["at_degc"], 3), "y_um": (day["y_um"], 2)}
    rows = [i for i in range(DIRECT) if not (150 <= i < 153 or 300 <= i < 400)]
    rows[200], rows[201] = rows[201], rows[200]
    _write(path, times, "time_utc", columns, rows)


def effect(path: Path) -> None:
    """Write a day on which the coolant acts on Y, which no model knows, and the DTF depends on the fan."""
    day = _day(503, EFFECT)
    y = day["y_um"] + 3.0 * _lag(day["coolant_degc"], 31.0) + 0.05 * day["y_dtf_um"] * day["fan_rpm"] / 1000.0
    columns = {"t_q_degc": (day["t_q_degc"], 3), "at_degc": (day["at_degc"], 3), "y_um": (y, 2)}
    columns |= {
        "coolant_degc": (day["coolant_degc"], 2),
        "spindle_rpm": (day["spindle_rpm"], 0),
        "fan_rpm": (day["fan_rpm"], 0),
        "cabinet_degc": (day["cabinet_degc"], 2),
    }
    _write(path, [str(60 * i) for i in range(EFFECT)], "t_s", columns, list(range(EFFECT)))


TABLES = {"heat.csv": heat, "direct.csv": direct, "effect.csv": effect}
