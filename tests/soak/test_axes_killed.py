"""The real service of X, Y with a slope, Z and a tilt feeds a receiver; kill −9 and restart: no jump, no axis alone."""

from __future__ import annotations

import itertools
import json
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from compensator.audit.series import audit
from compensator.receiver import AppliedAxes, AxesReceiver, AxesSettings, ControlState, load_any
from compensator.recording.reading import recordings
from sim_hardware.wire import IcpDas, ModbusTcpServer
from tests.receiver.wire import free_port, router, until
from tests.service.several import model_text
from tests.soak.site import Receiver, Site

PERIOD_S = 0.25
LIMITS = "offset_max_um = 200.0\noffset_rate_max_um_per_min = 12.0\n"
#: Largest rate of each published value, in its unit, per min: so slow that every value is on its way all the time.
RATES = {"x_offset_um": 0.1, "y_offset_um": 4.0, "z_offset_um": 1.0, "a_offset_urad": 2.0, "y_slope_um_per_m": 1.0}
TABLES = f"""
[axis.x]
offset_max_um = 60.0
offset_rate_max_um_per_min = {RATES["x_offset_um"]}
[axis.y]
offset_max_um = 200.0
offset_rate_max_um_per_min = {RATES["y_offset_um"]}
[axis.y.slope]
slope_max_um_per_m = 120.0
slope_rate_max_um_per_m_per_min = {RATES["y_slope_um_per_m"]}
reference_mm = 300.0
[axis.z]
offset_max_um = 150.0
offset_rate_max_um_per_min = {RATES["z_offset_um"]}
[axis.a]
probes = ["low", "high"]
distance_mm = 200.0
reference_mm = 120.0
offset_max_urad = 400.0
offset_rate_max_urad_per_min = {RATES["a_offset_urad"]}
"""
AT_MM, TOOL_MM = 500.0, 220.0
READ = ControlState(tool_length_mm=TOOL_MM, positions_mm={"y": AT_MM})
#: What moves the tool along each axis: values with their levers.
LEVERS = {
    "x": {"x_offset_um": 1.0},
    "y": {
        "y_offset_um": 1.0,
        "y_slope_um_per_m": (AT_MM - 300.0) / 1000.0,
        "a_offset_urad": (TOOL_MM - 120.0) / 1000.0,
    },
    "z": {"z_offset_um": 1.0},
}
#: Moves faster than the service, so that it hides no jump of it.
RECEIVER = """
[receiver]
machine = "vmc-07"
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:7447"]
state_file = "state.json"
[axis.x]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6000.0
[axis.y]
offset_max_um = 300.0
offset_rate_max_um_per_min = 6000.0
slope_max_um_per_m = 200.0
position_min_mm = 0.0
position_max_mm = 600.0
position_speed_max_mm_per_s = 600.0
[axis.z]
offset_max_um = 200.0
offset_rate_max_um_per_min = 6000.0
[axis.a]
offset_max_urad = 500.0
[tool]
length_min_mm = 20.0
length_max_mm = 400.0
"""


class AxesSite(Site):
    """A machine whose service has several axes, and whose temperatures rise."""

    def __init__(self, folder: Path, **options: Any) -> None:
        super().__init__(folder, **options)
        began = time.monotonic()

        def rise(rate_k_per_s: float) -> float:
            return rate_k_per_s * min(time.monotonic() - began, 15.0)

        sources = {0: lambda: 22.0 + rise(1.0), 1: lambda: 21.0 + rise(0.3)}
        self._server = ModbusTcpServer({1: IcpDas("et-7018z", ranges="T", sources=sources)})

    def __enter__(self) -> Site:
        super().__enter__()
        model = model_text("y", "x", "z", "low", "high", "y_slope").decode()
        assert "sample_period_s = 60.0" in model
        self.model.write_text(model.replace("sample_period_s = 60.0", f"sample_period_s = {PERIOD_S}"))
        return self

    def text(self) -> str:
        text = super().text()
        assert LIMITS in text
        return text.replace(LIMITS, "") + TABLES


class Axes(Receiver):
    """Notes the messages of every axis, by the number of their sample."""

    def __enter__(self) -> Axes:
        super().__enter__()
        self.samples: dict[int, dict[str, Any]] = defaultdict(dict)
        self.session.declare_subscriber(f"{self.prefix}/thermal/*/offset", self._axis)
        return self

    def _axis(self, sample: Any) -> None:
        message = json.loads(sample.payload.to_bytes())
        with self._came:
            self.samples[message["seq"]][message["axis"]] = message
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


def test_after_a_kill_every_axis_goes_on_from_where_it_was(tmp_path: Path) -> None:
    port = free_port()
    path = tmp_path / "receiver.toml"
    path.write_text(RECEIVER.replace("7447", str(port)), encoding="utf-8")
    settings, _ = load_any(path)
    assert isinstance(settings, AxesSettings)
    endpoint = f"tcp/127.0.0.1:{port}"
    polled: list[tuple[float, AppliedAxes]] = []
    with (
        router(port),
        Axes("shop/vmc-07", mode="client", connect__endpoints=[endpoint], connect__timeout_ms=10_000) as heard,
        AxesSite(tmp_path, connect=[endpoint], period_s=PERIOD_S) as site,
        AxesReceiver(settings) as receiver,
    ):

        def follows(samples: int) -> None:
            """Poll as a control does until so many samples more are followed."""
            before = {applied.seq for _, applied in polled}

            def there() -> bool:
                polled.append((time.monotonic(), receiver.poll(READ)))
                return len({one.seq for _, one in polled} - before - {None}) >= samples

            until(there, lambda: polled[-1][1].text)

        starts = []
        for _ in range(2):
            with site.service():  # ends with kill −9
                follows(8)
                starts.append(polled[-1][1].seq)
        final = polled[-1][1]
        assert final.seq is not None
        heard.wait(lambda: len(heard.samples.get(final.seq, ())) == 4, "all axes of the last sample")  # type: ignore[arg-type]
        values = heard.whole

    # The service: all axes have one number, no value jumps, and none begins anew.
    torn = [seq for seq in heard.samples if seq not in values]
    assert all(any(0 <= seq - before <= 2 for before in starts) for seq in torn), "torn by the kill alone"
    for (seq, one), (after_seq, other) in itertools.pairwise(values.items()):
        # What the killed service decided last may be on disk and not have come here.
        steps = 2.0 if seq <= starts[0] + 2 and after_seq > starts[0] else 1.0
        for name, rate in RATES.items():
            assert abs(other[name] - one[name]) <= steps * rate * PERIOD_S / 60.0 + 1e-9, (name, seq, after_seq)
    for name, rate in RATES.items():
        assert abs(values[starts[0]][name]) > 3.0 * rate * PERIOD_S / 60.0, "a new beginning would be seen"
    last = values[final.seq]

    # The receiver: all axes together, of a whole sample, and each at most as fast as the service.
    assert {applied.seq for _, applied in polled} - {None} <= set(values)
    for (before_s, before), (after_s, after) in itertools.pairwise(polled):
        assert len({(one.state, one.seq) for one in after.axes.values()}) == 1, after.text
        assert "incomplete" not in {reason.code for reason in after.reasons}
        seconds = after_s - before_s + 2.0 * PERIOD_S
        if before.seq is not None and after.seq != before.seq:
            seconds += values[after.seq]["time_s"] - values[before.seq]["time_s"]  # type: ignore[index]
        for axis, levers in LEVERS.items():
            rate = sum(lever * RATES[name] for name, lever in levers.items())
            moved = after.axes[axis].offset_um - before.axes[axis].offset_um
            assert abs(moved) <= rate * seconds / 60.0, (axis, before.text, after.text)
    for axis, levers in LEVERS.items():
        wanted = sum(lever * last[name] for name, lever in levers.items())
        ahead = sum(lever * RATES[name] for name, lever in levers.items()) * 2.0 * PERIOD_S / 60.0
        assert abs(final.axes[axis].offset_um - wanted) <= ahead, (axis, final.text, wanted)
    assert len(recordings(site.recordings, "vmc-07")) == 2
    assert audit(recordings(site.recordings, "vmc-07")).clean
