"""A day as a shop runs it, made up, for pages: a chip is refused and another probe asked for."""

from __future__ import annotations

from typing import Any

import numpy as np

from compensator.report.shop import ShopDay

_T_H = np.arange(240) / 60.0


def _probe(time_h: float, measured_um: float, **changes: Any) -> dict[str, Any]:
    usual = {"chip_um": 0.0, "asked_because": "", "taken": True, "code": "", "text": "probe taken"}
    return {"time_h": time_h, "measured_um": measured_um, **usual, **changes}


SHOP_DAY = ShopDay(
    figures={
        "without": {"rms_um": 40.0, "peak_to_peak_um": 90.0},
        "probe": {"rms_um": 20.0, "peak_to_peak_um": 70.0},
        "model": {"rms_um": 6.0, "peak_to_peak_um": 20.0},
        "model_and_probe": {"rms_um": 3.0, "peak_to_peak_um": 12.0},
        "probe_std_um": 1.5,
        "probes": [
            _probe(1.0, 2.0),
            _probe(2.0, 21.5, chip_um=20.0, taken=False, code="probe_outlier", text="probe refused"),
            _probe(2.07, 1.0, asked_because="probe_outlier"),
        ],
    },
    errors={
        "t_h": _T_H,
        "without": 45.0 * np.sin(_T_H),
        "probe": 30.0 * np.sin(3.0 * _T_H),
        "model": 8.0 * np.sin(_T_H),
        "model_and_probe": 3.0 * np.sin(5.0 * _T_H),
    },
)
