"""The reconciling of the HAL component against a model of LinuxCNC's external offset, without LinuxCNC."""

from __future__ import annotations

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.linuxcnc.reconcile import NUDGE_S, SETTLE_S, STEP_MAX_S, AxisView, Reconciler

SCALE_UM, SLEW, LOOP_S = 0.01, 20.0, 0.01


class Axis:
    """What LinuxCNC does with counts, a servo period at a time: it adds up changes and loses those that come amiss."""

    def __init__(self, counts: int = 0) -> None:
        self.pin = self.register = counts
        self.request_um = self.eoffset_um = 0.0
        self.on = self.enable = True
        self.clear = self.truncated = False
        self.linked = True
        self.ratio = 0.1

    @property
    def ready(self) -> bool:
        return self.on and self.enable and not self.clear

    def switch(self, on: bool) -> None:
        if on and not self.on:
            self.request_um = self.eoffset_um = 0.0
        self.on = on

    def period(self) -> None:
        delta, self.register = self.pin - self.register, self.pin
        if self.ready and delta:
            self.request_um += delta * SCALE_UM
            self.truncated = False
        if self.on and self.clear:
            self.request_um = 0.0
        if self.on and not self.truncated and (self.enable or self.clear):
            way = self.request_um - self.eoffset_um
            self.eoffset_um += max(-self.ratio, min(self.ratio, way))

    def view(self) -> AxisView:
        return AxisView(
            counts=self.pin,
            scale_um=SCALE_UM,
            request_um=self.request_um,
            eoffset_um=self.eoffset_um,
            acts=self.on and not self.clear,
            ready=self.ready,
            limited=False,
        )


class Loop:
    def __init__(self, counts: int = 0) -> None:
        self.axis, self.reconciler = Axis(counts), Reconciler(counts, SLEW)
        self.now_s = 0.0
        self.requests = [0.0]

    def run(self, seconds: float, wanted_um: float, loop_s: float = LOOP_S) -> None:
        for _ in range(round(seconds / loop_s)):
            counts = self.reconciler.step(self.now_s, wanted_um, self.axis.view())
            if self.axis.linked:
                self.axis.pin = counts
            for _ in range(round(loop_s * 1000)):
                self.axis.period()
            self.now_s += loop_s
            self.requests.append(self.axis.request_um)

    def at(self, um: float) -> bool:
        return abs(self.axis.eoffset_um - um) <= SCALE_UM


def test_moves_at_the_slew_from_whatever_counts_it_finds() -> None:
    loop = Loop(counts=108_960)
    loop.run(SETTLE_S, 5.0)
    assert loop.axis.pin == 108_960 and loop.axis.request_um == 0.0
    loop.run(1.0, 5.0)
    assert loop.at(5.0) and loop.axis.pin == 108_960 + 500
    steps = [b - a for a, b in itertools.pairwise(loop.requests)]
    assert max(steps) <= SLEW * STEP_MAX_S + SCALE_UM and sum(s > 0 for s in steps) > 20


def test_off_clear_and_disable_lose_nothing() -> None:
    loop = Loop()
    loop.run(1.0, 5.0)
    loop.axis.switch(False)
    loop.run(1.0, -3.0)
    counts = loop.axis.pin
    loop.axis.switch(True)
    assert loop.axis.pin == counts  # nothing was piled up
    loop.run(1.0, -3.0)
    assert loop.at(-3.0)
    loop.axis.clear = True
    loop.run(1.0, -3.0)
    assert loop.axis.eoffset_um == 0.0
    loop.axis.clear = False
    loop.run(1.0, -3.0)
    assert loop.at(-3.0)
    loop.axis.enable = False
    loop.run(1.0, 4.0)
    assert loop.at(-3.0)
    loop.axis.enable = True
    loop.run(1.0, 4.0)
    assert loop.at(4.0) and not loop.reconciler.trouble


def test_a_pin_that_is_not_linked_carries_what_the_axis_has() -> None:
    loop = Loop(counts=100)
    loop.axis.linked = False
    loop.axis.pin = loop.axis.register = 7_000_000  # somebody else wrote
    loop.run(5.0, 50.0)
    assert loop.reconciler.counts == 7_000_000 and "link it" in loop.reconciler.trouble
    loop.axis.linked = True
    before = len(loop.requests)
    loop.run(4.0, 50.0)
    assert loop.at(50.0) and not loop.reconciler.trouble
    assert max(b - a for a, b in itertools.pairwise(loop.requests[before:])) <= SLEW * STEP_MAX_S + SCALE_UM


def test_a_request_that_does_not_follow_gets_a_count_a_second_and_no_pile() -> None:
    loop = Loop()
    loop.run(1.0, 0.0)
    loop.axis.period = lambda: None  # type: ignore[method-assign]
    loop.run(30.0, 50.0)
    assert "does not follow the counts" in loop.reconciler.trouble
    assert abs(loop.axis.pin) * SCALE_UM < 4 * SLEW * STEP_MAX_S + 31 * SCALE_UM


def test_a_forgotten_move_is_nudged_and_an_axis_that_never_moves_is_said() -> None:
    loop = Loop()
    loop.run(1.0, 5.0)
    loop.axis.eoffset_um, loop.axis.truncated = 3.0, True
    loop.run(NUDGE_S - 0.1, 5.0)
    assert loop.axis.eoffset_um == 3.0
    loop.run(1.0, 5.0)
    assert loop.at(5.0) and not loop.reconciler.trouble
    loop.axis.ratio = 0.0
    loop.run(3 * NUDGE_S, 8.0)
    assert "OFFSET_AV_RATIO" in loop.reconciler.trouble and loop.axis.request_um < 8.1
    loop.axis.ratio = 0.1
    loop.run(1.0, 8.0)
    assert loop.at(8.0) and not loop.reconciler.trouble


def test_a_loop_that_stood_still_takes_no_long_step() -> None:
    loop = Loop()
    loop.run(1.0, 0.0)
    loop.now_s += 60.0
    loop.run(0.01, 50.0)
    loop.run(0.01, 50.0)
    assert loop.axis.request_um <= 2 * (SLEW * STEP_MAX_S + SCALE_UM)


events = st.sampled_from(["off", "on", "clear", "release", "disable", "enable", "truncate", "unlink", "link", ""])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(events, st.floats(-30.0, 30.0), st.floats(0.01, 0.6)), max_size=25))
def test_whatever_happens_it_arrives_and_no_step_is_longer_than_the_slew(steps: list[tuple[str, float, float]]) -> None:
    loop = Loop()
    for event, wanted_um, seconds in [*steps, *((e, 3.0, 0.1) for e in ("on", "release", "enable", "link"))]:
        axis = loop.axis
        if event in ("off", "on"):
            axis.switch(event == "on")
        elif event in ("clear", "release"):
            axis.clear = event == "clear"
        elif event in ("disable", "enable"):
            axis.enable = event == "enable"
        elif event in ("unlink", "link"):
            axis.linked = event == "link"
            axis.pin = loop.reconciler.counts if axis.linked else axis.pin  # what `net` does
        axis.truncated |= event == "truncate"
        before_um = axis.request_um
        loop.requests = [before_um]
        loop.run(seconds, wanted_um)
        for a, b in itertools.pairwise(loop.requests):
            assert abs(b - a) <= SLEW * STEP_MAX_S + 2 * SCALE_UM or b == 0.0
    loop.run(10.0, 3.0)
    assert loop.at(3.0) and not loop.reconciler.trouble
