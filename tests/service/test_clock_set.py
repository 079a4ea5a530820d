"""The system clock set forward and back by an hour, as receivers on the wire see it: they go on following."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from compensator.audit.machine_audit import audit, summary
from compensator.clock import NS, VirtualClock
from compensator.config import Zenoh, parse_config
from compensator.messages import number
from compensator.model.model_file import parse_model
from compensator.receiver import Receiver, Settings
from compensator.recording.reading import recordings
from compensator.recording.recorder import McapRecorder
from compensator.service.compensation import Compensation, Outcome
from compensator.service.daemon import Daemon
from compensator.service.publisher import Publisher
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.audit.made import CONFIG, MACHINE, QUILL
from tests.ports import free_port
from tests.receiver.wire import until
from tests.service.simulated import CHANNELS, START_NS, FakeDevice
from tests.soak.site import Receiver as Heard

RATE_UM_PER_MIN = 8.0
SAMPLES, FORWARD, BACK = 48, 16, 32
HOUR_NS = 3600 * NS
#: A control looks so long after each sample: one that looked before the message was there has its step behind it, s.
LATER_S = 15.0


class Shop:
    """A service on a virtual clock, a router that notes everything, and two controls that follow.

    One control has a clock of its own, which nobody sets; the other runs on the same computer as the service and
    compares each message's time with its clock.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        duty = Duty.working_day(3, hours=24)
        self.world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 3)
        self.clock = VirtualClock(START_NS, self._advance)
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.router = Heard("shop/vmc-07", mode="router", listen__endpoints=[endpoint])
        config = parse_config(CONFIG, source="test")
        self.publisher = Publisher(
            Zenoh(prefix="shop/vmc-07", mode="client", connect=[endpoint]), lambda *asked: self.daemon.command(*asked)
        )
        self.daemon = Daemon(
            config=config,
            compensation=Compensation(config, parse_model(QUILL, source="test")),
            devices={"module": FakeDevice([self.world.source(name) for name in CHANNELS])},
            recorder=McapRecorder(folder, MACHINE, {"config.toml": CONFIG, "model.toml": QUILL}),
            publish=self.publisher.publish,
            clock=self.clock,
            first_sequence=0,
        )
        elsewhere, here = (
            Settings(
                machine=MACHINE,
                prefix="shop/vmc-07",
                connect=(endpoint,),
                offset_max_um=200.0,
                offset_rate_max_um_per_min=2.0 * RATE_UM_PER_MIN,
                check_clock=check,
            )
            for check in (False, True)
        )
        self.later_s = 0.0
        seconds = {"step_max_s": 90.0, "clock": lambda: self.clock.monotonic_ns() / NS + self.later_s}
        self.controls = [
            Receiver(elsewhere, **seconds, utc_ns=lambda: START_NS + self.clock.monotonic_ns()),  # type: ignore[arg-type]
            Receiver(here, **seconds, utc_ns=self.clock.utc_ns),  # type: ignore[arg-type]
        ]
        #: What each control applied after each sample.
        self.applied: list[list[float]] = [[], []]
        self.walls: list[int] = []
        self._set_by_s, self._at_end = 0.0, False

    async def _advance(self, t_s: float) -> None:
        self.world.advance_to(t_s)

    async def run(self) -> None:
        with self.router, self.publisher, self.controls[0], self.controls[1]:
            for control in self.controls:
                until(lambda control=control: control.poll() and control.connected, "connected")  # type: ignore[misc]
            await self.daemon.run(samples=SAMPLES, on_sample=self._step, on_poll=self._set)

    def _set(self) -> None:
        """Set the clock within a sample, after its first poll."""
        if not self._at_end:
            self.clock.set_wall_clock(self._set_by_s)
            self._set_by_s = 0.0
        self._at_end = False

    def _step(self, outcome: Outcome) -> None:
        seq = outcome.offset.seq
        self.router.wait(lambda: len(self.router.offsets) > seq, f"offset {seq}")
        self.walls.append(self.clock.utc_ns())
        for control, applied in zip(self.controls, self.applied, strict=True):
            # The first one after the clock was set still has a time of before, and is too old, or too new, for whoever
            # compares; it is the only one.
            dropped = control is self.controls[1] and seq in (FORWARD, BACK)
            until(lambda c=control, d=dropped: c.poll().seq == seq or (d and c.follower.dropped), f"{seq}")  # type: ignore[misc]
            self.later_s = LATER_S
            now = control.poll()
            self.later_s = 0.0
            assert now.state == "following", (seq, now.text)
            applied.append(now.offset_um)
        if seq + 1 in (FORWARD, BACK):
            self._set_by_s, self._at_end = (3600.0 if seq + 1 == FORWARD else -3600.0), True


@pytest.mark.timeout(120)
async def test_set_by_an_hour_the_receivers_go_on_following(tmp_path: Path) -> None:
    shop = Shop(tmp_path)
    await shop.run()
    offsets = shop.router.messages
    assert [message["seq"] for message in offsets] == list(range(SAMPLES))
    # The time is that of the wall clock, and of the clock of before in the one sample during which it was set.
    times = [message["time_utc_ns"] for message in offsets]
    other = [i for i, (time, wall) in enumerate(zip(times, shop.walls, strict=True)) if time != wall]
    assert other == [FORWARD, BACK]
    steps = [after - before for before, after in itertools.pairwise(times)]
    assert [i for i, step in enumerate(steps) if step != 60 * NS] == [FORWARD, BACK]
    assert (steps[FORWARD], steps[BACK]) == (60 * NS + HOUR_NS, 60 * NS - HOUR_NS)
    said = [event for event in shop.router.events if event["kind"] == "clock"]
    assert [event["data"]["seconds"] for event in said] == [3600.0, -3600.0]
    assert all("the wall clock was set by" in event["text"] for event in said)
    values = [message["y_offset_um"] for message in offsets]
    assert all(message["state"] == "ok" for message in offsets[1:])
    assert all(abs(b - a) <= RATE_UM_PER_MIN + 1e-9 for a, b in itertools.pairwise(values))
    moving = [b != a for a, b in itertools.pairwise(values)]
    assert all(moving[FORWARD - 2 : FORWARD + 3]) and all(moving[BACK - 2 : BACK + 3])  # it does not stop either
    wanted = [m["y_offset_um"] + m["y_offset_rate_um_per_min"] * LATER_S / 60.0 for m in offsets]
    for applied in shop.applied:  # both are where the service wants them, but for the growth of one minute
        assert max(abs(a - b) for a, b in zip(applied[3:], wanted[3:], strict=True)) < 1.0
    assert [control.follower.dropped for control in shop.controls] == [{}, {"late": 1, "clock_disagrees": 1}]
    found = audit(recordings(tmp_path, MACHINE))
    assert found.clean and found.samples == SAMPLES, summary(found)
    assert found.files[0].skipped == 0 and number(values[-1]) != 0.0
