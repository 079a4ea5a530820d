"""The real service of several axes, its Zenoh messages, and the bridge to a PLC: one chain."""

from __future__ import annotations

import asyncio
import itertools
from functools import partial
from pathlib import Path

from tests.bridge.plc import Plc
from tests.bridge.test_axes import bridging, written
from tests.bridge.test_opcua import until
from tests.ports import free_port
from tests.receiver.wire import router
from tests.soak.axes_site import FREE, PERIOD_S, RATES, Axes, AxesSite, levers
from tests.soak.site import end

TOOL_MM = 220.0
#: The bridge writes the offset of Y for 200 mm, and with the sign of the control.
AT_MM, SIGN_OF_Y = 200.0, -1.0
#: A value in the PLC is this near to what a sample asks for; from one sample to the next each moves further.
NEAR_UM, NEAR_UM_PER_M = 0.01, 0.002
STATES = {"following": 1, "holding": 2}


async def test_what_the_service_publishes_is_what_the_plc_holds(tmp_path: Path) -> None:
    zenoh, plc, said = free_port(), Plc(free_port()), []  # type: tuple[int, Plc, list[str]]
    endpoint = f"tcp/127.0.0.1:{zenoh}"
    with (
        router(zenoh),
        Axes("shop/vmc-07", mode="client", connect__endpoints=[endpoint], connect__timeout_ms=10_000) as heard,
        AxesSite(tmp_path, dict.fromkeys(RATES, FREE), connect=[endpoint], period_s=PERIOD_S) as site,
    ):

        async def state() -> str:
            value = await plc.state.read_value()
            return next((name for name, number in STATES.items() if number == value), "")

        async def moved(far_um: float) -> bool:
            """Z is on its way and so far, and the others with it."""
            return abs(await plc.z.read_value() * 1e3) > far_um and await state() == "following"

        async def holds() -> bool:
            return await state() == "holding" and "[expired]" in said[-1]

        async with plc, bridging(written(tmp_path, plc.endpoint, zenoh), said):
            await plc.tool_mm.write_value(TOOL_MM, plc.kind)
            apart_um: list[float] = []
            for far_um in (1.5, 3.0):
                process = site.start()
                try:
                    await until(partial(moved, far_um), lambda: f"the PLC follows: {said[-3:]}")
                finally:
                    end(process)  # kill −9
                await until(holds, "the PLC holds")
                seq = heard.newest()
                validity_s = heard.samples[seq]["y"]["valid_for_s"]
                wanted = heard.wanted_um(seq, levers(AT_MM, TOOL_MM), validity_s / 2.0)
                slope = heard.wanted_um(seq, {"y": {"y_slope_um_per_m": 1.0}}, validity_s / 2.0)["y"]
                # All of one sample: the newest that came, which is followed for half of its validity.
                held = await plc.um(), await plc.z.read_value() * 1e3, await plc.slope.read_value() * 1e6
                assert abs(held[0] - SIGN_OF_Y * wanted["y"]) < NEAR_UM, (held, wanted)
                assert abs(held[1] - wanted["z"]) < NEAR_UM, (held, wanted)
                earlier = max(number for number in heard.whole if number < seq)
                before = heard.wanted_um(earlier, levers(AT_MM, TOOL_MM), validity_s / 2.0)
                apart_um += [abs(before[axis] - wanted[axis]) for axis in "yz"]
                assert abs(held[2] - SIGN_OF_Y * slope) < NEAR_UM_PER_M, (held, slope)
                await asyncio.sleep(2 * PERIOD_S)
                assert (await plc.um(), await plc.z.read_value() * 1e3) == held[:2], "it stands"
        assert max(apart_um) > 2.0 * NEAR_UM, "another sample would be seen"
        # From sample to sample Y goes by some tenths of a µm, to about ten; no kill and no new start is a step.
        assert max(abs(b - a) * 1e3 for a, b in itertools.pairwise(plc.values)) < 3.0, plc.values
