"""A receiver of several axes to which strangers send whatever they like, on a virtual clock and without a wire."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from compensator.receiver import (
    AppliedAxes,
    AxesReceiver,
    AxesSettings,
    AxisLimits,
    ControlState,
    TiltLimits,
    ToolLimits,
)
from compensator.receiver.settings import Source
from tests.fuzz.attacked_receiver import MAX_UM, PERIOD_S, RATE, WITHIN_S, Channel, Result
from tests.fuzz.payloads import payload
from tests.receiver.offsets import MACHINE, T0_NS, axis_offset, slope

TRAVEL_MM, SPEED = 500.0, 200.0
LIMITS: dict[str, Any] = {
    "y": AxisLimits(
        offset_max_um=MAX_UM,
        offset_rate_max_um_per_min=RATE,
        slope_max_um_per_m=60.0,
        position_min_mm=0.0,
        position_max_mm=TRAVEL_MM,
        position_speed_max_mm_per_s=SPEED,
    ),
    "z": AxisLimits(offset_max_um=MAX_UM, offset_rate_max_um_per_min=RATE),
    "a": TiltLimits(offset_max_urad=100.0),
}


class AxisChannel(Channel):
    """What Zenoh hands over of a key with the axis in it."""

    def put_axis(self, axis: str, data: bytes) -> None:
        self.put(data)
        self.items[-1].key_expr = f"shop/vmc-07/thermal/{axis}/offset"

    def reply_axis(self, axis: str, data: bytes) -> None:
        self.put_axis(axis, data)
        self.items.append(SimpleNamespace(ok=self.items.pop()))


class AxesAttack:
    """One receiver of Y with a slope, Z and a tilt, its clock, and the payloads."""

    def __init__(self, rng: random.Random, folder: Path, *, check_clock: bool) -> None:
        self.rng, self.now_s, self.seq, self.result = rng, 0.0, 1000, Result()
        source = Source(
            machine=MACHINE,
            prefix="shop/vmc-07",
            connect=("tcp/127.0.0.1:1",),
            check_clock=check_clock,
            state_file=str(folder / "state.json"),
        )
        tool = ToolLimits(length_min_mm=20.0, length_max_mm=400.0, length_from="zenoh")
        self.settings = AxesSettings(source=source, axes=LIMITS, tool=tool)
        self.position_mm: Any = 100.0
        self.used_seq: int | None = None
        self.located_s = 0.0
        self.begin({"y": rng.uniform(-MAX_UM, MAX_UM), "z": 0.0})

    def begin(self, applied_um: dict[str, float]) -> None:
        """Start the receiver, again with the state that it saved."""
        self.receiver = AxesReceiver(
            self.settings, applied_um=applied_um, clock=lambda: self.now_s, utc_ns=lambda: self.utc_ns
        )
        self.applied_um, self.slope = applied_um, 0.0
        wired: Any = self.receiver
        wired._session = SimpleNamespace(close=lambda: None)
        self.offsets, self.statuses, self.answers, self.lengths = AxisChannel(), Channel(), AxisChannel(), Channel()
        wired._offsets, wired._statuses, wired._tokens = self.offsets, self.statuses, Channel()
        wired._answers, wired._status_answers, wired._lengths = [self.answers], [Channel()], self.lengths

    @property
    def utc_ns(self) -> int:
        return T0_NS + round(self.now_s * 1e9)

    def poll(self, after_s: float) -> AppliedAxes:
        """Go on in time; nothing may jump, and all that is shown can be shown."""
        self.now_s += after_s
        applied = self.receiver.poll(ControlState(positions_mm={"y": self.position_mm}))
        self.result.used += applied.seq is not None and applied.seq != self.used_seq
        self.used_seq = applied.seq
        passed_s, y = min(after_s, 1.0), applied.axes["y"]
        steepest = max(abs(y.slope_um_per_m), abs(self.slope)) / 1000.0
        own_um = steepest * SPEED * (min(self.now_s - self.located_s, 1.0) + 0.05)
        for axis, most_um in (("y", own_um), ("z", 0.0)):
            one = applied.axes[axis]
            moved = abs(one.offset_um - self.applied_um[axis])
            assert moved <= RATE / 60.0 * passed_s + most_um + 1e-9, (axis, moved, applied)
            assert all(abs(um) <= MAX_UM + 1e-9 for um in (one.offset_um, *one.ends_um))
            assert one.reasons or one.state not in ("starting", "holding")
        assert len((applied.text + applied.steady_reasons).encode()) < 100_000
        if isinstance(self.position_mm, float) and math.isfinite(self.position_mm):
            self.located_s = self.now_s
        self.applied_um, self.slope = {axis: one.offset_um for axis, one in applied.axes.items()}, y.slope_um_per_m
        return applied

    def send(self) -> None:
        """Send one hostile payload somewhere."""
        axis = self.rng.choice("yza")
        data = payload(self.rng, self.utc_ns, axis)
        self.result.payloads += 1
        if (way := self.rng.randrange(8)) == 0:
            self.lengths.put(data)
        elif way == 1:
            self.answers.reply_axis(axis, data)
        else:
            self.offsets.put_axis(axis, data)

    def send_sample(self) -> None:
        """Send a forged sample that is complete, of any values near the limits."""
        draw = self.rng.uniform
        self.result.payloads += 3
        head = {"time_utc_ns": self.utc_ns, "valid_for_s": self.rng.choice((1.0, 150.0, 1e12))}
        seq = self.rng.choice((self.seq + 1, self.rng.randrange(200), 10**11))
        for axis, most in (("y", MAX_UM), ("z", MAX_UM), ("a", 105.0)):
            state = self.rng.choice(("ok", "ok", "ok", "ok", "degraded", "hold"))
            line = slope(draw(-65.0, 65.0), draw(0.0, TRAVEL_MM), draw(-1e3, 1e3)) if axis == "y" else {}
            own = {"reference_mm": draw(-500.0, 500.0), "acts_on": self.rng.choice("yz")} if axis == "a" else {}
            changes: Any = {**line, **own, **head, "state": state, "rate": draw(-1e3, 1e3)}
            self.offsets.put_axis(axis, axis_offset(axis, seq, draw(-0.8, 0.8) * most, axes="yza", **changes))

    def run(self, payloads: int) -> Result:
        """Attack, restart now and then, then let an honest service go on."""
        for _ in range(payloads):
            for _ in range(self.rng.choice((1, 1, 2, 40))):
                self.send()
            if self.rng.randrange(3) == 0:
                self.send_sample()
            places = (self.rng.uniform(0.0, TRAVEL_MM), self.rng.uniform(-1e9, 1e9), math.nan, math.inf, None, 100.0)
            self.position_mm = self.rng.choice((*places, "100", [100.0], 10**400))
            self.poll(self.rng.choice((0.0, 0.1, 0.5, 20.0, 61.0, 700.0)))
            if self.rng.randrange(10) == 0:
                self.honest()
            if self.rng.randrange(30) == 0:
                self.begin(self.applied_um)
        for channel in (self.offsets, self.statuses, self.answers, self.lengths):
            channel.items.clear()
        self.recover()
        self.result.dropped = sum(self.receiver.follower.dropped.values())
        return self.result

    def honest(self) -> None:
        """Publish as service and control do: 7 µm at 100 mm, 20 µm/m, 10 µrad for a tool of 200 mm, and Z at −3."""
        self.seq += 1
        for axis, um, changes in (("y", 7.0, slope(20.0, 100.0)), ("z", -3.0, {}), ("a", 10.0, {})):
            data = axis_offset(axis, self.seq, um, axes="yza", **{**changes, "time_utc_ns": self.utc_ns})
            self.offsets.put_axis(axis, data)
        length = {"schema": 1, "machine": MACHINE, "time_utc_ns": self.utc_ns, "valid_for_s": 600.0}
        self.lengths.put(json.dumps({**length, "tool_length_mm": 200.0}).encode())

    def recover(self) -> None:
        """An honest service is followed again, in time and to its values."""
        applied, began_s = None, self.now_s
        self.position_mm = 150.0
        while applied is None or not (applied.state == "following" and applied.seq == self.seq):
            assert self.now_s - began_s <= WITHIN_S, (applied, self.seq)
            self.honest()
            applied = self.poll(0.0)
            self.result.restarted += "count_restarted" in {reason.code for reason in applied.reasons}
            for _ in range(60):
                applied = self.poll(PERIOD_S / 60.0)
        for _ in range(3):
            self.honest()
            for _ in range(60):
                applied = self.poll(PERIOD_S / 60.0)
        assert applied.arrived and not applied.reasons, applied.text
        assert abs(applied.axes["y"].offset_um - 9.0) < 0.011 and abs(applied.axes["z"].offset_um + 3.0) < 0.011
