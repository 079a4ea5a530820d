"""Sensors exchanged or drifting: raised in time, the right one named, nothing raised on a healthy machine."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compensator.config import parse_config
from compensator.errors import ConfigError
from compensator.messages import encode, number
from compensator.service.compensation import Compensation, Outcome
from compensator.service.plausibility import BLOCK_SAMPLES, PlausibilityCheck, PlausibilityState, SensorEvidence
from compensator.service.state import decode_state
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.service.records import QUILL, sample
from tests.service.simulated import TABLE, config
from tests.service.wired import WiredMachine, workshop

LIMITS = {"t_q_below_at_after_min": 15.0, "false_alarm_days": 365.0, "residual_std_um": 0.3}
#: No device is silent here, and a busy computer must not look like one that is.
WIRED: dict[str, Any] = {"plausibility": LIMITS, "timeout_s": 1.0, "is_patient": True}
CHANNELS = [*TABLE["channel"][:3], {"name": "heat_w", "device": "module", "input": 4}]
WATCHED = {"t_q_below_at_max_k": 2.0, "suspect_jumps": True, "jump_min_k": 1.0}
Change = Callable[[int, dict[str, float]], None]


def checked(*, guards: dict[str, Any] = TABLE["guards"], channel: Any = CHANNELS, **limits: Any) -> Any:
    return config(channel=channel, plausibility={**LIMITS, **limits}, loss={"predict_for_min": 60.0}, guards=guards)


@pytest.fixture(scope="module")
def day() -> dict[str, np.ndarray]:
    """Three working days of the published machine, as its sensors give them."""
    duty = Duty.working_day(1, hours=72.0)
    sensors = usual_sensors(duty.extra_names, heat_known=True)
    return World(PublishedQuill(), duty, sensors, 1).record(60.0)


def outcomes_of(
    day: dict[str, np.ndarray],
    samples: int,
    change: Change = lambda i, v: None,
    conf: Any = None,
    act: Callable[[int, Compensation], None] = lambda i, c: None,
) -> list[Outcome]:
    compensation = Compensation(conf or checked(), QUILL)
    outcomes = []
    for i in range(samples):
        values = {channel["name"]: float(day[channel["name"]][i]) for channel in CHANNELS}
        change(i, values)
        act(i, compensation)
        outcomes.append(compensation.process(sample(i, values)))
    return outcomes


def told(outcomes: list[Outcome]) -> list[tuple[int, str]]:
    return [(i, text) for i, o in enumerate(outcomes) for kind, text, _ in o.notes if kind == "plausibility"]


def first_at(outcomes: list[Outcome], reason: str) -> int:
    return next((i for i, o in enumerate(outcomes) if any(r.startswith(reason) for r in o.offset.reasons)), -1)


def largest_step(outcomes: list[Outcome]) -> float:
    return float(np.max(np.abs(np.diff([number(o.offset.y_offset_um) for o in outcomes]))))


# ---------------------------------------------------------------------- drift

BEGIN = 400


@pytest.mark.parametrize(
    ("channel", "per_h", "within_min"),
    [
        ("t_q_degc", 0.5, 70),
        ("t_q_degc", -1.0, 60),
        ("t_q_degc", 2.0, 50),
        ("at_degc", 0.5, 70),
        ("at_degc", 2.0, 60),
        ("y_um", 5.0, 60),
        ("y_um", -2.0, 90),
    ],
)
def test_a_drift_is_raised_and_the_right_sensor_is_among_the_suspects(
    day: dict[str, np.ndarray], channel: str, per_h: float, within_min: int
) -> None:
    def drift(i: int, values: dict[str, float]) -> None:
        values[channel] += per_h * max(i - BEGIN, 0) / 60.0

    outcomes = outcomes_of(day, BEGIN + 300, drift, checked(sensor_must_fit=True))
    raised = first_at(outcomes, "implausible")
    assert BEGIN < raised <= BEGIN + within_min
    standing = outcomes[raised:]
    assert all(f"implausible:{channel}" in o.offset.reasons for o in standing)
    assert {o.offset.state for o in standing} <= {"degraded", "hold", "fault"}
    # The offset goes on, and says how wrong it may be.
    last = outcomes[-1]
    assert number(last.offset.y_offset_std_um) > 0.7 * abs(number(last.estimate.residual_um))
    assert number(last.estimate.y_std_um) < number(last.offset.y_offset_std_um)
    assert largest_step(outcomes) <= 8.0 + 1e-9
    # Once there is enough of it, the text names it with about its size.
    name = {"t_q_degc": "T_Q drifts", "at_degc": "AT drifts", "y_um": "measured Y drifts"}[channel]
    assert any(name in text for _, text in told(outcomes))


@pytest.mark.parametrize(("channel", "size"), [("y_um", 3.0), ("t_q_degc", 1.0), ("at_degc", -1.0)])
def test_a_jump_names_one_sensor_and_is_forgotten_when_it_goes(
    day: dict[str, np.ndarray], channel: str, size: float
) -> None:
    def jump(i: int, values: dict[str, float]) -> None:
        values[channel] += size if BEGIN <= i < BEGIN + 120 else 0.0

    outcomes = outcomes_of(day, BEGIN + 300, jump, checked(sensor_must_fit=True))
    raised = first_at(outcomes, "implausible")
    assert BEGIN < raised < BEGIN + 80
    assert outcomes[BEGIN + 118].offset.reasons == [f"implausible:{channel}"]
    if channel == "y_um":  # what a wrong temperature did stays in the model for hours
        assert outcomes[-1].offset.state == "ok"
        assert told(outcomes)[-1][1] == "measured and predicted Y agree again"


def test_a_joint_that_sticks_accuses_no_sensor(day: dict[str, np.ndarray]) -> None:
    """Play of 6.5 µm, which the model lacks: the best of shapes that all fail names no healthy sensor."""

    def named(outcomes: list[Outcome]) -> list[set[str]]:
        return [{r for r in o.offset.reasons if r.startswith("implausible:")} for o in outcomes]

    def run(*, must_fit: bool) -> list[Outcome]:
        stuck = [250.0]

        def play(i: int, values: dict[str, float]) -> None:
            y = values["y_um"]
            stuck.append(min(max(stuck[-1], y - 6.5), y + 6.5))
            values["y_um"] = stuck[-1]

        return outcomes_of(day, 720, play, checked(sensor_must_fit=must_fit))

    outcomes, before = run(must_fit=True), run(must_fit=False)
    raised = first_at(outcomes, "implausible")
    assert 0 < raised == first_at(before, "implausible")
    # A first slip looks like a sensor that jumped; once it has slipped back, it is the model.
    clear = raised + 60
    assert set.union(*named(outcomes)[clear:]) == {"implausible:model"}
    assert any("no fault of a sensor explains this" in text for _, text in told(outcomes))
    assert any(len(names) > 1 for names in named(before)[clear:])
    # Only names differ: offset and stated deviation are the same.
    assert [o.offset.y_offset_std_um for o in outcomes] == [o.offset.y_offset_std_um for o in before]


def test_a_couple_that_came_off_does_not_accuse_the_model_alone(day: dict[str, np.ndarray]) -> None:
    """T_Q tends to AT: neither a drift nor a jump, but a sensor explains most of it."""

    def off(i: int, values: dict[str, float]) -> None:
        if i >= BEGIN:
            share = math.exp(-(i - BEGIN) / 10.0)
            values["t_q_degc"] = values["at_degc"] + 0.5 + share * (values["t_q_degc"] - values["at_degc"])

    outcomes = outcomes_of(day, BEGIN + 120, off, checked(sensor_must_fit=True))
    raised = first_at(outcomes, "implausible")
    assert BEGIN < raised < BEGIN + 60
    assert all(set(o.offset.reasons) - {"implausible:model"} for o in outcomes[raised:])


def test_a_probe_that_measures_another_axis_is_told_from_drift(day: dict[str, np.ndarray]) -> None:
    def exchanged(i: int, values: dict[str, float]) -> None:
        values["y_um"] *= 0.4

    outcomes = outcomes_of(day, 600, exchanged)
    assert 0 < first_at(outcomes, "implausible") < 200
    assert any("0.4" in text and "times the prediction" in text for _, text in told(outcomes))


def test_three_days_of_a_healthy_machine_raise_nothing(day: dict[str, np.ndarray]) -> None:
    outcomes = outcomes_of(day, 3 * 1440 - 1)
    assert told(outcomes) == []
    assert np.std([number(o.estimate.residual_um) for o in outcomes]) < 0.3


def test_a_large_residual_holds_where_the_configuration_says_so(day: dict[str, np.ndarray]) -> None:
    def drift(i: int, values: dict[str, float]) -> None:
        values["t_q_degc"] += 2.0 * max(i - BEGIN, 0) / 60.0

    outcomes = outcomes_of(day, BEGIN + 300, drift, checked(residual_hold_um=8.0))
    held = first_at(outcomes, "residual_too_large")
    assert BEGIN < held < BEGIN + 120
    assert all(o.offset.state == "hold" for o in outcomes[held:])
    assert len({o.offset.y_offset_um for o in outcomes[held:]}) == 1


@pytest.mark.parametrize("missing", ["a sample after the other", "a pause"])
def test_an_alarm_does_not_end_because_y_is_missing(missing: str) -> None:
    check = PlausibilityCheck(checked(residual_hold_um=8.0), QUILL)

    def residual(um: float, samples: int) -> None:
        for _ in range(samples):
            check.update(
                SensorEvidence(below_k=0.0, apart_k=0.0, rest=0.0, residual_um=um, std_um=2.3, predicted_um=40.0)
            )

    residual(0.0, 300)
    residual(25.0, 120)
    assert check.too_large
    if missing == "a pause":
        check.pass_time(3000)
    else:
        residual(math.nan, 1500)  # longer than the window of the blocks
    assert check.too_large and check.error_um == 25.0
    residual(1.0, 60)
    assert not check.too_large


def test_a_zero_begins_anew(day: dict[str, np.ndarray]) -> None:
    def jump(i: int, values: dict[str, float]) -> None:
        values["y_um"] += 3.0 if i >= BEGIN else 0.0

    def zero(i: int, compensation: Compensation) -> None:
        if i == BEGIN + 100:
            compensation.zero("warm")

    outcomes = outcomes_of(day, BEGIN + 400, jump, act=zero)
    assert first_at(outcomes, "implausible") > 0
    assert first_at(outcomes[BEGIN + 100 :], "implausible") == -1
    assert outcomes[-1].offset.state == "ok"


def test_false_alarms_come_as_rarely_as_stated() -> None:
    """Residuals that hang together just as the check takes them to: the mean time between alarms is the stated one."""
    stated = 5.0
    check = PlausibilityCheck(checked(false_alarm_days=stated), QUILL)
    check._isolation.fits = lambda blocks: ([], True)  # type: ignore[method-assign,assignment]
    random = np.random.default_rng(5)
    blocks = 60_000
    keep, z, alarms = check._keep, 0.0, 0
    std = check.residual_std_um
    for e in (math.sqrt(1.0 - keep * keep) * random.normal(size=blocks)).tolist():
        z = keep * z + e
        check.state.sums, check.state.used = ((BLOCK_SAMPLES - 1) * z * std, (BLOCK_SAMPLES - 1) * std**2, 0.0), 9
        check.state.samples = BLOCK_SAMPLES - 1
        check._check_residual(
            SensorEvidence(
                below_k=0.0, apart_k=0.0, rest=0.0, residual_um=z * std, std_um=QUILL.y_std_um, predicted_um=0.0
            )
        )
        if check.reasons:
            alarms += 1
            check.state = PlausibilityState(z=z)
    expected = blocks * BLOCK_SAMPLES / 1440.0 / stated
    assert 0.5 * expected < alarms < 1.6 * expected


# ---------------------------------------------------------------------- T_Q and AT


def test_exchanged_at_the_start_is_seen_once_heat_has_come_and_latched(day: dict[str, np.ndarray]) -> None:
    def exchanged(i: int, values: dict[str, float]) -> None:
        if i < 300:
            values["t_q_degc"], values["at_degc"] = values["at_degc"], values["t_q_degc"]
        values["y_um"] = math.nan  # no probe in production

    def look(i: int, compensation: Compensation) -> None:
        if i == 320:
            compensation.resume()

    outcomes = outcomes_of(day, 700, exchanged, act=look)
    below = np.flatnonzero(day["t_q_degc"][:700] - day["at_degc"][:700] > 2.0)[0]
    assert first_at(outcomes, "t_q_at_exchanged") == below + 14
    bad = outcomes[below + 14 : 320]
    assert all(o.offset.state == "fault" and "t_q_at_exchanged" in o.offset.reasons for o in bad)
    assert len({o.offset.y_offset_um for o in bad}) == 1 and not math.isnan(number(bad[0].offset.y_offset_um))
    # Somebody has looked: what the machine had stored is not known, and that is said.
    assert all("cold_start" in o.offset.reasons for o in outcomes[330:])
    assert number(outcomes[330].offset.y_offset_std_um) > 4.0 * QUILL.y_std_um
    assert largest_step(outcomes) <= 8.0 + 1e-9


@pytest.mark.parametrize(
    ("suspect_jumps", "stop", "after"), [(True, 720, 15), (True, 2, 7), (False, 720, 5), (False, 2, 5)]
)
def test_minutes_below_at_are_not_added_up_over_a_night(suspect_jumps: bool, stop: int, after: int) -> None:
    """T_Q is below AT for 10 of 15 min, the service is stopped, and it is below AT again; a stop costs its time.

    Without `suspect_jumps` it costs none: so it was in 0.1.0, whose recordings are replayed to the bit.
    """
    guards = {"t_q_below_at_max_k": 2.0, "suspect_jumps": suspect_jumps}
    compensation, outcomes = Compensation(checked(guards=guards), QUILL), list[Outcome]()
    values = {"t_q_degc": 20.0, "y_um": math.nan, "heat_w": 0.0}
    for i in range(10):
        compensation.process(sample(i, values | {"at_degc": 23.0 + 0.01 * i}))
    compensation.pause(stop)
    for i in range(20):
        outcomes.append(compensation.process(sample(10 + stop + i, values | {"at_degc": 23.1 - 0.01 * i})))
    assert first_at(outcomes, "t_q_at_exchanged") == after - 1


@pytest.mark.parametrize("has_y", [True, False])
def test_measured_y_ends_an_exchange_that_is_over(day: dict[str, np.ndarray], has_y: bool) -> None:
    """It began unnoticed, on the cold machine; without Y, and while the wires are not right, a person has to say so."""
    begin, end = 1, 330

    def exchanged(i: int, values: dict[str, float]) -> None:
        if begin <= i < end:
            values["t_q_degc"], values["at_degc"] = values["at_degc"], values["t_q_degc"]
        values["y_um"] = values["y_um"] if has_y else math.nan

    outcomes = outcomes_of(day, 600, exchanged, checked(guards=WATCHED))
    reasons = [set(o.offset.reasons) for o in outcomes]
    noticed = first_at(outcomes, "t_q_at_exchanged")
    assert 0 < noticed < end - 60
    assert all("t_q_at_exchanged" in one for one in reasons[noticed:end])
    assert all("t_q_at_exchanged" in one for one in reasons[end:]) is not has_y
    if has_y:
        over = next(i for i in range(end, 600) if "t_q_at_exchanged" not in reasons[i])
        assert over < end + 120 and not any("t_q_at_exchanged" in one for one in reasons[over:])
        left_um = [number(o.offset.y_offset_um) + float(day["y_um"][i]) for i, o in enumerate(outcomes)]
        assert max(map(abs, left_um[over + 20 :])) < 5.0


@pytest.mark.parametrize(("t_q_degc", "is_exchange"), [(-5.0, False), (12.0, True)])
def test_what_neither_channel_can_read_is_no_exchange(
    day: dict[str, np.ndarray], t_q_degc: float, is_exchange: bool
) -> None:
    """A module that fails while it says that it is well; 12 °C, too little for T_Q, is what AT may read."""
    channels = [c | {"range": [15.0, 80.0]} if c["name"] == "t_q_degc" else c for c in CHANNELS]

    def fails(i: int, values: dict[str, float]) -> None:
        values["y_um"] = math.nan
        values["t_q_degc"] = t_q_degc if 200 <= i < 260 else values["t_q_degc"]

    outcomes = outcomes_of(day, 320, fails, checked(guards=WATCHED, channel=channels))
    assert first_at(outcomes, "t_q_at_exchanged") == (214 if is_exchange else -1)
    assert outcomes[-1].offset.state == ("fault" if is_exchange else "degraded")


def test_a_couple_that_is_apart_at_rest_is_said(day: dict[str, np.ndarray]) -> None:
    rest = {"channel": "heat_w", "at_most": 1.0, "after_min": 240.0, "t_q_at_max_k": 0.8}

    def night(bias_k: float) -> Change:
        def change(i: int, values: dict[str, float]) -> None:
            values |= {"heat_w": 90.0 if 60 <= i < 200 else 0.0, "at_degc": 20.0 + 0.01 * math.sin(i)}
            values |= {"t_q_degc": 20.0 + 20.0 * (heated[i] if i < len(heated) else 0.0), "y_um": math.nan}
            values["t_q_degc"] += bias_k if i > 150 else 0.0

        return change

    assert QUILL.ttf is not None
    heat = np.where((np.arange(900) >= 60) & (np.arange(900) < 200), 1.0, 0.0)
    heated = QUILL.ttf.sampled.response(heat)
    heated = (heated / np.max(heated)).tolist()
    good = outcomes_of(day, 900, night(0.0), checked(rest=rest))
    assert first_at(good, "t_q_at_apart") == -1
    apart = outcomes_of(day, 900, night(1.5), checked(rest=rest))
    raised = first_at(apart, "t_q_at_apart")
    assert raised == 200 + 240 - 1
    assert apart[-1].offset.state == "degraded" and "suspects: T_Q, AT" in told(apart)[-1][1]


RESTS = {"channel": "heat_w", "at_most": 1.0, "after_min": 120.0, "t_q_at_max_k": 1.0}


def test_hours_in_which_nothing_shows_rest_are_no_rest(day: dict[str, np.ndarray]) -> None:
    """The machine rests for 4 h, works for 2 h, of which nothing is known, and stops, hot."""
    begin, stop = 240, 360

    def change(i: int, values: dict[str, float]) -> None:
        hot_k = 12.0 * min(max(i - begin, 0), stop - begin) / (stop - begin)
        values |= {"at_degc": 20.0 + 0.01 * math.sin(i), "t_q_degc": 20.0 + hot_k + 0.01 * math.cos(i)}
        values |= {"heat_w": math.nan if begin <= i < stop else 0.0, "y_um": math.nan}

    outcomes = outcomes_of(day, 500, change, checked(rest=RESTS, guards=WATCHED))
    assert first_at(outcomes, "t_q_at_apart") == stop + 120 - 1


def test_a_line_that_loses_one_sample_in_twenty_shows_rest(day: dict[str, np.ndarray]) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        apart_k = 1.5 if i >= 5 else 0.0
        values |= {"at_degc": 20.0 + 0.01 * math.sin(i), "t_q_degc": 20.0 + apart_k + 0.01 * math.cos(i)}
        values |= {"heat_w": math.nan if i % 20 == 10 else 0.0, "y_um": math.nan}

    outcomes = outcomes_of(day, 200, change, checked(rest=RESTS, guards=WATCHED))
    assert 120 < first_at(outcomes, "t_q_at_apart") < 160


# ---------------------------------------------------------------------- state, configuration


def test_the_state_goes_on_to_the_bit_and_old_states_are_taken(day: dict[str, np.ndarray]) -> None:
    def drift(i: int, values: dict[str, float]) -> None:
        values["t_q_degc"] += 1.0 * max(i - 100, 0) / 60.0
        if 200 < i < 230:
            values["y_um"] = math.nan

    rest = {"channel": "heat_w", "at_most": 1.0, "after_min": 10.0, "t_q_at_max_k": 0.1}
    conf = checked(rest=rest)
    whole = Compensation(conf, QUILL)
    state = whole.state()
    for i in range(360):
        values = {channel["name"]: float(day[channel["name"]][i]) for channel in CHANNELS}
        drift(i, values)
        restored = Compensation(conf, QUILL)
        restored.restore(state)
        if i == 280:
            for one in (whole, restored):
                one.pause(33)
        outcome, again = whole.process(sample(i, values)), restored.process(sample(i, values))
        assert encode(again.offset) == encode(outcome.offset) and again.notes == outcome.notes
        state = whole.state()
        assert restored.state() == state
    assert whole.plausibility.reasons
    old = json.loads(state)
    del old["plausibility"]
    restored.restore(json.dumps(old).encode())
    assert restored.plausibility.reasons == []
    # Where nothing is checked the state is what it was before there was this check.
    assert b"plausibility" not in Compensation(config(), QUILL).state()
    assert decode_state(Compensation(config(), QUILL).state()).plausibility is None


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("[plausibility]\nfalse_alarm_days = 0.0", "plausibility.false_alarm_days = 0.0"),
        ("[plausibility]\nresidual_correlation_min = 5.0", "plausibility.residual_correlation_min = 5.0"),
        ("[plausibility]\nsurprise = 1", "surprise"),
        (
            '[plausibility.rest]\nchannel = "heat_w"\nat_most = 1.0\nafter_min = 60.0\nt_q_at_max_k = 1.0',
            "plausibility.rest.channel = 'heat_w': no such channel",
        ),
        ('[plausibility.rest]\nchannel = "at_degc"', "at_most"),
    ],
)
def test_bad_limits_get_one_line(table: str, expected: str) -> None:
    base = """
    guards = {t_q_below_at_max_k = 2.0}
    loss = {predict_for_min = 10.0}
    zero = {rest_rate_um_per_min = 0.2}
    line = []
    device = [{name = "m"}]
    machine = {name = "vmc-07"}
    model = {file = "quill"}
    recording = {folder = "rec"}
    zenoh = {prefix = "shop"}
    limits = {offset_max_um = 1.0, offset_rate_max_um_per_min = 1.0, validity = {t_q_degc = [0, 1], at_degc = [0, 1]}}
    channel = [
      {name = "t_q_degc", device = "m", input = 0, range = [0, 1], rate_max_per_min = 1.0, stuck_after_min = 1.0},
      {name = "at_degc", device = "m", input = 1, range = [0, 1], rate_max_per_min = 1.0, stuck_after_min = 1.0}]
    """
    parse_config(base.encode(), source="machine.toml")
    with pytest.raises(ConfigError) as error:
        parse_config(f"{base}\n{table}\n".encode(), source="machine.toml")
    assert expected in str(error.value) and "\n" not in str(error.value)


def test_what_is_off_is_said() -> None:
    off = PlausibilityCheck(config(), QUILL)
    assert not off.is_on
    assert off.describe().count(" off ") == 3
    without_probe = config(channel=CHANNELS[:2], plausibility=LIMITS)
    assert "residual off (Y is not measured)" in PlausibilityCheck(without_probe, QUILL).describe()
    on = PlausibilityCheck(checked(), QUILL).describe()
    assert "residual of 0.3 µm, one false alarm in 365 days" in on and "after 15 min" in on


# ---------------------------------------------------------------------- over the wire


def wired_world() -> World:
    duty = Duty.working_day(1, hours=24.0)
    return World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)


async def test_wires_exchanged_at_the_start_over_the_wire(tmp_path: Path) -> None:
    world = wired_world()
    swapped = {"t_q_degc": world.source("at_degc"), "at_degc": world.source("t_q_degc")}
    with workshop() as (rack, receiver):
        machine = WiredMachine(rack, tmp_path, world, receiver=receiver, sources=swapped, layout="one line", **WIRED)
        await machine.run(120)
    raised = next(o for o in machine.offsets if "t_q_at_exchanged" in o.reasons)
    assert raised.state == "fault" and machine.offsets[-1].state == "fault"
    assert machine.offsets[-1].y_offset_um == raised.y_offset_um is not None
    assert "suspects: T_Q, AT" in " ".join(event.text for event in machine.events("plausibility"))


async def test_wires_exchanged_on_a_hot_machine_over_the_wire(tmp_path: Path) -> None:
    world = wired_world()
    with workshop() as (rack, receiver):
        machine = WiredMachine(rack, tmp_path, world, receiver=receiver, **WIRED)

        def exchange(outcome: Outcome) -> None:
            if len(machine.outcomes) == 150:
                sources = machine.sources
                sources["t_q_degc"], sources["at_degc"] = sources["at_degc"], sources["t_q_degc"]

        machine.after = exchange
        await machine.run(260)
    after = machine.offsets[150:]
    assert after[0].state == "degraded"  # neither is used from the first sample on
    assert {o.state for o in after[40:]} == {"fault"}
    steps = [abs(number(b.y_offset_um) - number(a.y_offset_um)) for a, b in itertools.pairwise(machine.offsets)]
    assert max(steps) <= 8.0 + 1e-9


@pytest.mark.parametrize(
    ("channel", "per_h", "within_min"), [("t_q_degc", 0.5, 100), ("t_q_degc", 1.0, 70), ("at_degc", 2.0, 60)]
)
async def test_a_drift_over_the_wire(tmp_path: Path, channel: str, per_h: float, within_min: int) -> None:
    world = wired_world()
    straight = world.source(channel)
    begin_s = 120 * 60.0
    drifting = {channel: lambda: straight() + per_h * max(world.t_s - begin_s, 0.0) / 3600.0}
    with workshop() as (rack, receiver):
        machine = WiredMachine(rack, tmp_path, world, receiver=receiver, sources=drifting, **WIRED)
        await machine.run(120 + within_min)
    raised = next(i for i, o in enumerate(machine.offsets) if any(r.startswith("implausible") for r in o.reasons))
    assert raised >= 120
    assert f"implausible:{channel}" in machine.offsets[raised].reasons
    assert machine.offsets[raised].state == "degraded"
    assert "stated" in machine.events("plausibility")[0].text
