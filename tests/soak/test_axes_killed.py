"""The real service of X, Y with a slope, Z and a tilt feeds a receiver; kill −9 and restart: no jump, no axis alone."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

from compensator.audit.machine_audit import audit
from compensator.receiver import AppliedAxes, AxesReceiver, AxesSettings, ControlState, load_any
from compensator.recording.reading import recordings
from tests.ports import free_port
from tests.receiver.wire import router, until
from tests.soak.axes_site import PERIOD_S, RATES, Axes, AxesSite, levers

AT_MM, TOOL_MM = 500.0, 220.0
READ = ControlState(tool_length_mm=TOOL_MM, positions_mm={"y": AT_MM})
LEVERS = levers(AT_MM, TOOL_MM)
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

        def is_far() -> bool:
            """Return whether the followed sample has moved so far that a new beginning would be seen as a jump."""
            values = heard.whole.get(polled[-1][1].seq or -1, {})
            return all(abs(values.get(name) or 0.0) > 3.0 * rate * PERIOD_S / 60.0 for name, rate in RATES.items())

        def follows(samples: int) -> None:
            """Poll as a control does until so many samples more are followed."""
            before = {applied.seq for _, applied in polled}

            def there() -> bool:
                polled.append((time.monotonic(), receiver.poll(READ)))
                return len({one.seq for _, one in polled} - before - {None}) >= samples and is_far()

            until(there, lambda: polled[-1][1].text)

        starts = []
        for _ in range(2):
            with site.service():  # ends with kill −9
                follows(8)
                starts.append(polled[-1][1].seq)
        final = polled[-1][1]
        assert final.seq is not None
        heard.wait(lambda: len(heard.samples.get(final.seq, ())) == 4, "all axes of the last sample")  # type: ignore[arg-type]
        # Where the devices answer late, the first samples of all have no value yet.
        values = dict(itertools.dropwhile(lambda one: None in one[1].values(), heard.whole.items()))

    # The service: all axes have one number, no value jumps, and none begins anew.
    torn = [seq for seq in heard.samples if seq not in heard.whole]
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
    assert {applied.seq for _, applied in polled} - {None} <= set(heard.whole)
    for (before_s, before), (after_s, after) in itertools.pairwise(polled):
        assert len({(one.state, one.seq) for one in after.axes.values()}) == 1, after.text
        assert "incomplete" not in {reason.code for reason in after.reasons}
        seconds = after_s - before_s + 2.0 * PERIOD_S
        if before.seq is not None and after.seq != before.seq:
            seconds += heard.whole[after.seq]["time_s"] - heard.whole[before.seq]["time_s"]  # type: ignore[index]
        for axis, its in LEVERS.items():
            rate = sum(lever * RATES[name] for name, lever in its.items())
            moved = after.axes[axis].offset_um - before.axes[axis].offset_um
            assert abs(moved) <= rate * seconds / 60.0, (axis, before.text, after.text)
    for axis, its in LEVERS.items():
        wanted = sum(lever * last[name] for name, lever in its.items())
        ahead = sum(lever * RATES[name] for name, lever in its.items()) * 2.0 * PERIOD_S / 60.0
        assert abs(final.axes[axis].offset_um - wanted) <= ahead, (axis, final.text, wanted)
    assert len(recordings(site.recordings, "vmc-07")) == 2
    assert audit(recordings(site.recordings, "vmc-07")).clean
