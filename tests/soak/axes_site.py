"""The real service of X, Y with a slope, Z and a tilt as a process of its own, and what it publishes."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sim_hardware.wire import IcpDas, ModbusTcpServer
from tests.service.several import model_text
from tests.soak.site import Receiver, Site

PERIOD_S = 0.25
LIMITS = "offset_max_um = 200.0\noffset_rate_max_um_per_min = 12.0\n"
#: Where the offset of Y holds, mm: the position of its slope, the tool of its tilt.
REFERENCE_MM, GAUGE_MM = 300.0, 120.0
#: So fast that every value goes where the model says.
FREE = 300.0
#: Largest rate of each published value, in its unit, per min: so slow that every value is on its way all the time.
RATES = {"x_offset_um": 0.1, "y_offset_um": 4.0, "z_offset_um": 1.0, "a_offset_urad": 2.0, "y_slope_um_per_m": 1.0}


def tables(rates: Mapping[str, float]) -> str:
    """Tables of the axes with these rates."""
    return f"""
[axis.x]
offset_max_um = 60.0
offset_rate_max_um_per_min = {rates["x_offset_um"]}
[axis.y]
offset_max_um = 200.0
offset_rate_max_um_per_min = {rates["y_offset_um"]}
[axis.y.slope]
slope_max_um_per_m = 120.0
slope_rate_max_um_per_m_per_min = {rates["y_slope_um_per_m"]}
reference_mm = {REFERENCE_MM}
[axis.z]
offset_max_um = 150.0
offset_rate_max_um_per_min = {rates["z_offset_um"]}
[axis.a]
probes = ["low", "high"]
distance_mm = 200.0
reference_mm = {GAUGE_MM}
offset_max_urad = 400.0
offset_rate_max_urad_per_min = {rates["a_offset_urad"]}
"""


def levers(position_mm: float, tool_mm: float) -> dict[str, dict[str, float]]:
    """What moves the tool along each axis: published values with their levers, at a position of Y with a tool."""
    return {
        "x": {"x_offset_um": 1.0},
        "y": {
            "y_offset_um": 1.0,
            "y_slope_um_per_m": (position_mm - REFERENCE_MM) / 1000.0,
            "a_offset_urad": (tool_mm - GAUGE_MM) / 1000.0,
        },
        "z": {"z_offset_um": 1.0},
    }


class AxesSite(Site):
    """A machine whose service has several axes, and whose temperatures rise."""

    def __init__(self, folder: Path, rates: Mapping[str, float] = RATES, **options: Any) -> None:
        super().__init__(folder, **options)
        self.rates = rates
        first_read: list[float] = []

        def rise(rate_k_per_s: float) -> float:
            # From the first reading on, which the service counts from: it may start late on a busy computer.
            if not first_read:
                first_read.append(time.monotonic())
            return rate_k_per_s * min(time.monotonic() - first_read[0], 15.0)

        sources = {0: lambda: 22.0 + rise(1.0), 1: lambda: 21.0 + rise(0.3)}
        self._server = ModbusTcpServer({1: IcpDas("et-7018z", ranges="T", sources=sources)})

    def __enter__(self) -> Site:
        super().__enter__()
        model = model_text("y", "x", "z", "low", "high", "y_slope").decode()
        # A day in seconds: what warms up that fast takes more heat than the machine has.
        fast = {"sample_period_s = 60.0": f"sample_period_s = {PERIOD_S}", "[-20.0, 120.0]": "[-9e4, 9e4]"}
        for old, new in fast.items():
            assert old in model
            model = model.replace(old, new)
        self.model.write_text(model)
        return self

    def text(self) -> str:
        text = super().text()
        assert LIMITS in text
        return text.replace(LIMITS, "") + tables(self.rates)


class Axes(Receiver):
    """Notes the messages of every axis, by the number of their sample."""

    def __enter__(self) -> Axes:
        super().__enter__()
        self.samples: dict[int, dict[str, Any]] = defaultdict(dict)
        self.came_s: dict[int, float] = {}
        self.session.declare_subscriber(f"{self.prefix}/thermal/*/offset", self._axis)
        return self

    def _axis(self, sample: Any) -> None:
        message = json.loads(sample.payload.to_bytes())
        with self._came:
            self.samples[message["seq"]][message["axis"]] = message
            self.came_s[message["seq"]] = time.monotonic()
            self._came.notify_all()

    @property
    def whole(self) -> dict[int, dict[str, float]]:
        """Values of the samples of which every axis has come, with their time, s."""
        found = {}
        for seq, axes in sorted(self.samples.items()):
            if set(axes) == set("xyza"):
                values = {name: value for one in axes.values() for name, value in one.items() if name in RATES}
                found[seq] = values | {"time_s": axes["y"]["time_utc_ns"] / 1e9}
        return found

    def newest(self) -> int:
        """Number of the newest sample of which every axis has come; −1 before the first."""
        return max(self.whole, default=-1)

    def wanted_um(self, seq: int, levers: Mapping[str, Mapping[str, float]], after_s: float) -> dict[str, float]:
        """What a sample asks of each axis so long after it came: its values go on at their rates, see `levers`."""
        said = {name: value for one in self.samples[seq].values() for name, value in one.items()}

        def at(name: str) -> float:
            rate = name.replace("_offset_", "_offset_rate_").replace("_slope_", "_slope_rate_") + "_per_min"
            return float(said[name] + said[rate] * after_s / 60.0)

        return {axis: sum(lever * at(name) for name, lever in its.items()) for axis, its in levers.items()}
