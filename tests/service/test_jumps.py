"""A jump of T_Q or AT: not believed until something speaks for it, and undone once it is mended."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

import compensator.model
from compensator.cli import main
from compensator.config import parse_config
from compensator.errors import ConfigError
from compensator.messages import EstimateMessage, encode, number
from compensator.model.model_file import parse_model
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome
from compensator.service.state import decode_state
from compensator.service.status import Zero
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from sim_hardware.physics.duty import GRID_S
from tests.audit.test_signatures import write_key
from tests.service.jumping import (
    BEGIN,
    CHANNELS,
    END,
    GUARDS,
    Change,
    biased,
    events,
    offsets,
    readings,
    run,
    settings,
    undisturbed,
    working_day,
    zero_at,
)
from tests.service.records import QUILL, direct, sample
from tests.service.simulated import config

CHECKED = {"false_alarm_days": 30.0}


@pytest.fixture(scope="module")
def day() -> dict[str, np.ndarray]:
    return working_day()


@pytest.mark.parametrize(
    ("channel", "size"), [("t_q_degc", 8.0), ("t_q_degc", -8.0), ("t_q_degc", 3.5), ("at_degc", -5.0)]
)
def test_a_jump_is_never_ok_and_its_mend_makes_the_offset_right_at_once(
    day: dict[str, np.ndarray], channel: str, size: float
) -> None:
    outcomes = run(day, biased(channel, size))
    wrong = np.abs(offsets(outcomes) - undisturbed()) > 3.0
    assert not any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes))
    during = outcomes[BEGIN + 4 : END]
    assert all(f"suspect_channel:{channel}" in o.offset.reasons for o in during)
    assert {o.sample.channels[channel].quality for o in during} == {"suspect"}
    # Held after loss.predict_for_min (10), and until then with a deviation that grows.
    stds = [number(o.offset.y_offset_std_um) for o in during]
    assert stds[6] > stds[0] and outcomes[BEGIN + 20].offset.state == "hold"
    # Back: what happened meanwhile is known, although the gap is three times longer than what is interpolated.
    assert not np.any(wrong[END + 12 :])
    assert {o.offset.state for o in outcomes[END + 20 :]} == {"ok"}
    assert events(outcomes, "accepted") == [END + 2]
    assert np.max(np.abs(np.diff(offsets(outcomes)))) <= 20.0 + 1e-9


@pytest.mark.parametrize(("channel", "size"), [("at_degc", 8.0), ("at_degc", -7.0), ("t_q_degc", 9.0)])
@pytest.mark.parametrize("part", [0.18, 0.3])
def test_a_couple_that_is_pushed_in_halfway_is_never_ok_while_it_is_wrong(
    day: dict[str, np.ndarray], channel: str, size: float, part: float
) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        values[channel] += size if BEGIN <= i < END else part * size * (i >= END)

    outcomes = run(day, change)
    wrong = np.abs(offsets(outcomes) - undisturbed()) > 5.0
    assert not any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes))
    assert events(outcomes, "jumped") == [BEGIN, END + 2][: 2 if part < 0.2 else 1]
    assert outcomes[END + 30].offset.state == "hold" and not events(outcomes, "accepted")


@pytest.mark.parametrize(("size", "samples"), [(1.6, 1), (-1.6, 1), (5.0, 3), (-5.0, 3)])
@pytest.mark.parametrize("end", [BEGIN + 30, END])
def test_air_that_moves_while_t_q_does_not_is_used_and_its_deviation_says_so(
    day: dict[str, np.ndarray], size: float, samples: int, end: int
) -> None:
    """Within the permitted rate it is a door, which T_Q of a heavy machine follows late, or the sensor."""

    def change(i: int, values: dict[str, float]) -> None:
        if BEGIN <= i < end:
            values["at_degc"] += size * min((i - BEGIN + 1) / samples, 1.0)

    outcomes = run(day, change)
    apart = np.abs(offsets(outcomes) - undisturbed())
    during = outcomes[BEGIN:end]
    assert all("unconfirmed_channel:at_degc" in o.offset.reasons for o in during)
    assert not any("suspect_channel:at_degc" in o.offset.reasons for o in during)
    stds = np.array([number(o.offset.y_offset_std_um) for o in outcomes])
    # A T_Q far below AT is held for some minutes; the offset then comes back at its permitted rate.
    is_told = np.array([o.offset.state != "hold" and "rate_limited" not in o.offset.reasons for o in outcomes])
    assert np.all((apart < 1.6 * stds)[BEGIN + 6 : end] | ~is_told[BEGIN + 6 : end]) and sum(is_told[BEGIN:end]) > 10
    assert not np.any(apart[end + 12 :] > 5.0) and outcomes[-1].offset.state == "ok"
    if samples == 1:  # it may have been air: degraded for as long as that would matter
        assert outcomes[end + 3].offset.state == "degraded"


@pytest.mark.parametrize("samples", [1, 2, 3])
@pytest.mark.parametrize("size", [1.7, -1.7])
def test_a_door_that_closes_slowly_is_closed(day: dict[str, np.ndarray], size: float, samples: int) -> None:
    def door(i: int, values: dict[str, float]) -> None:
        values["at_degc"] += size * min(max((END + samples - 1 - i) / samples, 0.0), 1.0) * (i >= BEGIN)

    outcomes = run(day, door)
    assert "unconfirmed_channel:at_degc" in outcomes[END - 1].offset.reasons
    assert {o.offset.state for o in outcomes[END + 90 :]} == {"ok"}
    assert not any("suspect_channel:at_degc" in o.offset.reasons for o in outcomes)


def both_jump(i: int, values: dict[str, float]) -> None:
    values["t_q_degc"] += 8.0 if BEGIN <= i < END else 0.0
    values["at_degc"] = math.nan if BEGIN + 20 <= i < BEGIN + 32 else values["at_degc"] - 4.0 * (i >= BEGIN + 32)


def twice(i: int, values: dict[str, float]) -> None:
    values["t_q_degc"] += {BEGIN: 4.0, BEGIN + 1: 12.0, BEGIN + 2: 12.0}.get(i, 0.0)


def one_after_the_other(i: int, values: dict[str, float]) -> None:
    values["t_q_degc"] += 4.0 if i >= BEGIN else 0.0
    values["at_degc"] -= 6.0 if i > BEGIN else 0.0


def again_after_a_return(i: int, values: dict[str, float]) -> None:
    values["at_degc"] += 1.7 if BEGIN <= i < BEGIN + 20 or i >= BEGIN + 25 else 0.0


def step_by_step(i: int, values: dict[str, float]) -> None:
    values["at_degc"] += 1.6 * ((i >= BEGIN) + (i >= BEGIN + 40)) if i < BEGIN + 150 else 0.0


def t_q_beside_at(i: int, values: dict[str, float]) -> None:
    values["at_degc"] += 1.6 if BEGIN <= i < BEGIN + 200 else 0.0
    values["t_q_degc"] += 4.5 if i >= BEGIN + 30 else 0.0


def at_steps_while_t_q_is_suspect(i: int, values: dict[str, float]) -> None:
    values["t_q_degc"] += 8.0 if BEGIN <= i < BEGIN + 90 else 0.0
    values["at_degc"] += 1.6 if BEGIN + 30 <= i < BEGIN + 160 else 0.0


def at_goes_on_to_be_wrong(i: int, values: dict[str, float]) -> None:
    values["t_q_degc"] += 8.0 if BEGIN <= i < BEGIN + 90 else 0.0
    values["at_degc"] -= 1.6 if i >= BEGIN + 30 else 0.0


def t_q_steps_while_at_is_suspect(i: int, values: dict[str, float]) -> None:
    values["at_degc"] += 5.0 if BEGIN <= i < BEGIN + 90 else 0.0
    values["t_q_degc"] -= 4.0 if BEGIN + 30 <= i < BEGIN + 160 else 0.0


@pytest.mark.parametrize(
    ("change", "ends"),
    [
        (at_steps_while_t_q_is_suspect, "ok"),
        (at_goes_on_to_be_wrong, "degraded"),
        (t_q_steps_while_at_is_suspect, "ok"),
        (both_jump, "degraded"),
        (twice, "ok"),
        (one_after_the_other, "hold"),
        (again_after_a_return, "degraded"),
        (step_by_step, "ok"),
        (t_q_beside_at, "hold"),
    ],
)
def test_a_jump_beside_another_one_is_never_ok_while_it_is_wrong(
    day: dict[str, np.ndarray], change: Change, ends: str
) -> None:
    outcomes = run(day, change)
    wrong = np.abs(offsets(outcomes) - undisturbed()) > 5.0
    assert not any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes[: BEGIN + 300]) if i > BEGIN + 1)
    assert outcomes[BEGIN + 250].offset.state == ends


def test_a_door_while_t_q_is_suspect_neither_holds_the_offset_nor_keeps_t_q_from_its_return() -> None:
    """T_Q follows the air in this model, also with another zero."""
    duty = Duty.working_day(5, hours=14.0)
    minutes = np.arange(len(duty.columns["ambient_degc"])) * GRID_S / 60.0
    is_open = (minutes >= BEGIN + 30) & (minutes < BEGIN + 70)
    air = duty.columns["ambient_degc"] - 1.8 * is_open
    duty = Duty(duty.duration_s, **(duty.columns | {"ambient_degc": air}))
    day = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 5).record(60.0)
    outcomes = run(day, biased("t_q_degc", 8.0, BEGIN, BEGIN + 50))
    apart = np.abs(offsets(outcomes) - offsets(run(day)))
    assert not any("suspect_channel:at_degc" in o.offset.reasons for o in outcomes)
    assert events(outcomes, "accepted")[0] == BEGIN + 52
    assert np.max(apart[BEGIN + 62 :]) < 1.0
    assert {o.offset.state for o in outcomes[BEGIN + 120 :]} == {"ok"}


def test_a_new_zero_counts_for_both_channels_that_are_suspect(day: dict[str, np.ndarray]) -> None:
    """AT jumps by its rate, and T_Q beside it within its own: both have another zero from the zero on."""

    def change(i: int, values: dict[str, float]) -> None:
        values["at_degc"] -= 5.0 if i >= BEGIN else 0.0
        values["t_q_degc"] += 4.0 if i >= BEGIN + 30 else 0.0

    def zero(i: int, compensation: Compensation) -> None:
        if i == END:
            assert {f"suspect_channel:{name}" for name in ("t_q_degc", "at_degc")} <= reasons
            compensation.zero("warm")

    reasons = {r for o in run(day, change)[END - 1 : END] for r in o.offset.reasons}
    outcomes = run(day, change, zero)
    assert np.max(np.abs(offsets(outcomes) - undisturbed(zero=END))[END + 30 : END + 120]) < 1.0
    assert {o.offset.state for o in outcomes[END + 30 : END + 120]} == {"ok"}


@pytest.mark.parametrize(
    ("channel", "size", "unseen"),
    [("at_degc", 1.6, 0), ("at_degc", -2.4, 5), ("t_q_degc", 6.0, 8)],
)
def test_a_zero_on_a_warm_machine_is_right_whichever_answer_of_an_unconfirmed_channel_was(
    day: dict[str, np.ndarray], channel: str, size: float, unseen: int
) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        values[channel] += size if BEGIN <= i < END else 0.0
        if BEGIN - unseen <= i < BEGIN:
            values[channel] = math.nan

    outcomes = run(day, change, zero_at(BEGIN + 60))
    stds = np.array([number(o.offset.y_offset_std_um) for o in outcomes])
    assert f"unconfirmed_channel:{channel}" in outcomes[BEGIN + 60].offset.reasons
    # What both answers differ by is counted from the zero.
    apart = np.abs(offsets(outcomes) - undisturbed(zero=BEGIN + 60))
    assert stds[BEGIN + 59] > 10.0 and stds[BEGIN + 60] < 2.5
    assert np.all(apart[BEGIN + 66 : END] < 2.0 * stds[BEGIN + 66 : END])
    assert np.max(apart[BEGIN:END]) > 5.0 and np.max(apart[END + 12 : END + 200]) < 1.0


def test_a_jump_that_is_only_watched_is_so_after_a_zero_on_a_warm_machine(day: dict[str, np.ndarray]) -> None:
    outcomes = run(day, biased("t_q_degc", 4.0), zero_at(BEGIN + 1))
    assert events(outcomes, "jumped") == [BEGIN + 1]
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[BEGIN + 2 : END])


def test_resume_after_a_door_believes_what_the_air_has_done(day: dict[str, np.ndarray]) -> None:
    """T_Q has spoken against it; once AT has returned, the engine that has not believed it was used."""
    door = biased("at_degc", 1.7, END - 60, END)
    outcomes = run(day, door, lambda i, c: c.resume() if i == END + 5 else None)
    believed = offsets(run(day, door, suspect_jumps=False, jump_min_k=None))
    assert "unconfirmed_channel:at_degc" in outcomes[END + 4].offset.reasons
    assert abs(number(outcomes[END + 4].offset.y_offset_um) - believed[END + 4]) > 1.0
    assert outcomes[END + 6].offset.state == "ok"
    assert np.all(np.abs(offsets(outcomes) - believed)[END + 6 : END + 60] < 0.1)


def test_what_is_left_of_a_jump_that_was_within_the_permitted_rate_is_not_believed(day: dict[str, np.ndarray]) -> None:
    """Where AT may change by 20 K/min, only T_Q, which does not follow, shows the jump."""
    channels = [c | {"rate_max_per_min": 20.0} if c["name"] == "at_degc" else c for c in CHANNELS]

    def change(i: int, values: dict[str, float]) -> None:
        values["at_degc"] += 8.0 if BEGIN <= i < END else 1.5 * (i >= END)

    outcomes = run(day, change, channel=channels)
    wrong = np.abs(offsets(outcomes) - undisturbed()) > 5.0
    assert not any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes))


@pytest.mark.parametrize("samples", [1, 5])
@pytest.mark.parametrize("size", [0.6, 0.9])
def test_a_change_below_the_smallest_jump_is_none(day: dict[str, np.ndarray], size: float, samples: int) -> None:
    """What is expected of AT is too uncertain to show the return from so small a jump: it would be held for good."""
    channels = [c | {"rate_max_per_min": 0.5} if c["name"] == "at_degc" else c for c in CHANNELS]
    outcomes = run(day, biased("at_degc", size, end=BEGIN + samples), channel=channels)
    assert {o.offset.state for o in outcomes} == {"ok"}
    assert np.max(np.abs(offsets(outcomes) - undisturbed())) < 2.5
    # A larger one still is.
    larger = run(day, biased("at_degc", 1.2, end=BEGIN + samples), channel=channels)
    assert events(larger, "jumped") == [BEGIN]


@functools.cache
def short_samples(period_s: float, hours: float) -> tuple[ThermalModel, dict[str, np.ndarray]]:
    """The published machine with a model of shorter samples, and a morning of it."""
    text = (Path(compensator.model.__file__).parent / "quill.toml").read_text(encoding="utf-8")
    less = math.sqrt(period_s / 60.0)
    for before, after in (
        ("sample_period_s = 60.0", f"sample_period_s = {period_s}"),
        ("heat_walk_std_w = 4.0", f"heat_walk_std_w = {4.0 * less}"),
        ("at_walk_std_k = 0.1", f"at_walk_std_k = {0.1 * less}"),
    ):
        assert before in text
        text = text.replace(before, after)
    duty = Duty.working_day(3, hours=hours)
    record = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 3).record(period_s)
    return parse_model(text.encode(), source="short"), record


def short_run(period_s: float, hours: float, change: Change = lambda i, v: None) -> list[Outcome]:
    model, columns = short_samples(period_s, hours)
    found, outcomes = Compensation(settings(), model), []
    for i in range(len(columns["t_s"])):
        values = readings(columns, i) | {"y_um": math.nan}
        change(i, values)
        outcomes.append(found.process(msgspec.structs.replace(sample(i, values), period_s=period_s)))
    return outcomes


def test_samples_of_seconds_make_no_jump_of_noise_and_of_heat_that_is_switched() -> None:
    """In 5 s the usual rates permit T_Q 0.4 and AT 0.2 K."""
    outcomes = short_run(5.0, 2.0)
    assert {o.offset.state for o in outcomes} == {"ok"}
    assert events(short_run(5.0, 2.0, biased("t_q_degc", 4.0, begin=600, end=1200)), "jumped") == [600]


def test_samples_of_seconds_make_no_loose_contact_of_heat_that_is_switched() -> None:
    """T_Q follows its temperature, 5 K off: a loose contact would be used again once it rests, and still wrong."""
    outcomes = short_run(5.0, 2.0, biased("t_q_degc", 5.0, begin=480, end=960))
    assert events(outcomes, "jumped") == [480]
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[480:960])
    assert events(outcomes, "accepted") == [962]


def test_a_pause_is_no_sample_of_a_return(day: dict[str, np.ndarray]) -> None:
    outcomes = run(day, biased("t_q_degc", 8.0), lambda i, c: c.pause(2) if i == END + 2 else None)
    assert events(outcomes, "accepted") == [END + 4]


@pytest.mark.parametrize("size", [-5.0, 6.0])
def test_resume_after_a_stop_in_which_a_channel_was_mended_is_right_at_once(
    day: dict[str, np.ndarray], size: float
) -> None:
    """Nobody saw it return, so it is held without: only a person knows that it was mended."""
    compensation, outcomes = Compensation(settings(), QUILL), []
    stopped = range(330, 360)
    for i in range(450):
        if i in stopped:
            continue
        if i == stopped.stop:
            compensation.pause(len(stopped))
        if i == stopped.stop + 60:
            compensation.resume()
        values = readings(day, i) | {"y_um": math.nan}
        values["t_q_degc"] += size if BEGIN <= i < stopped.start else 0.0
        outcomes.append(compensation.process(sample(i, values)))
    asked = stopped.stop + 60 - len(stopped)
    assert {o.offset.state for o in outcomes[stopped.start : asked]} == {"hold"}
    wrong_um = np.abs(offsets(outcomes)[asked + 5 :] - undisturbed()[stopped.stop + 65 : 450])
    assert np.max(wrong_um) < 5.0 and outcomes[-1].offset.state == "ok"


@pytest.mark.parametrize("size", [8.0, -8.0])
def test_a_jump_that_takes_three_samples_is_one_jump(day: dict[str, np.ndarray], size: float) -> None:
    """Each step is within the permitted rate; less the first step alone, the rest would be heat."""

    def change(i: int, values: dict[str, float]) -> None:
        if BEGIN <= i < END:
            values["t_q_degc"] += size * min((i - BEGIN + 1) / 3.0, 1.0)

    outcomes = run(day, change)
    wrong = np.abs(offsets(outcomes) - undisturbed()) > 5.0
    # Noticed in the sample after its end.
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[BEGIN + 3 : END])
    assert {round(data["shift_k"]) for o in outcomes for _, _, data in o.notes if data.get("code") == "jumped"} == {
        size
    }
    assert not np.any(wrong[END + 12 :]) and outcomes[-1].offset.state == "ok"


def hidden(change: Change, channel: str, gap: int) -> Change:
    """The couple is open until the jump: what it shows then could also be heat, or the air, that has changed."""

    def changed(i: int, values: dict[str, float]) -> None:
        change(i, values)
        if BEGIN - gap <= i < BEGIN:
            values[channel] = math.nan

    return changed


HIDDEN = pytest.mark.parametrize(
    ("gap", "channel", "size"),
    [(3, "at_degc", -2.0), (12, "t_q_degc", 8.0), (40, "t_q_degc", -4.0), (12, "at_degc", -5.0), (40, "at_degc", 5.0)],
)


@HIDDEN
def test_a_jump_that_nobody_saw_is_never_ok_and_its_deviation_says_so(
    day: dict[str, np.ndarray], gap: int, channel: str, size: float
) -> None:
    healthy = run(day, hidden(lambda i, v: None, channel, gap))
    assert {o.offset.state for o in healthy[BEGIN + 10 :]} == {"ok"}
    outcomes = run(day, hidden(biased(channel, size, end=10_000), channel, gap))
    wrong = np.abs(offsets(outcomes) - offsets(healthy))
    assert wrong[BEGIN:].max() > 10.0
    for i in range(BEGIN, len(outcomes)):
        offset = outcomes[i].offset
        assert wrong[i] < 5.0 or offset.state != "ok"
        if offset.state != "fault" and "rate_limited" not in offset.reasons:
            assert wrong[i] < 3.0 * number(offset.y_offset_std_um)
    assert events(outcomes, "unconfirmed") == [BEGIN]


@HIDDEN
def test_measured_y_ends_the_belief_in_a_jump_that_nobody_saw(
    day: dict[str, np.ndarray], gap: int, channel: str, size: float
) -> None:
    outcomes = run(day, hidden(biased(channel, size, end=10_000), channel, gap), y=True)
    refuted = events(outcomes, "jumped")
    assert refuted and BEGIN <= refuted[0] < BEGIN + 60
    assert all(f"suspect_channel:{channel}" in o.offset.reasons for o in outcomes[refuted[0] :])


def test_a_pause_can_hide_a_jump_as_well(day: dict[str, np.ndarray]) -> None:
    def act(i: int, compensation: Compensation) -> None:
        if i == BEGIN:
            compensation.pause(20)

    kept = {name: np.delete(values, slice(BEGIN, BEGIN + 20)) for name, values in day.items()}
    healthy, outcomes = run(kept, act=act), run(kept, biased("t_q_degc", 8.0, end=10_000), act)
    wrong = np.abs(offsets(outcomes) - offsets(healthy)) > 5.0
    assert wrong.any() and not any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes))


def test_a_hidden_jump_that_is_mended_is_undone(day: dict[str, np.ndarray]) -> None:
    healthy = offsets(run(day, hidden(lambda i, v: None, "t_q_degc", 12)))
    outcomes = run(day, hidden(biased("t_q_degc", 8.0), "t_q_degc", 12))
    wrong = np.abs(offsets(outcomes) - healthy) > 5.0
    assert not any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes))
    assert not np.any(wrong[END + 12 :]) and {o.offset.state for o in outcomes[END + 20 :]} == {"ok"}


def test_resume_and_a_zero_at_rest_confirm_a_channel_and_a_zero_on_a_warm_machine_does_not(
    day: dict[str, np.ndarray],
) -> None:
    ask: dict[str, Callable[[Compensation], None]] = {
        "resume": lambda c: c.resume(),
        "rest": lambda c: c.zero("rest"),
        "warm": lambda c: c.zero("warm"),
    }
    jump = hidden(biased("t_q_degc", 8.0, end=10_000), "t_q_degc", 12)
    for name, order in ask.items():
        outcomes = run(day, jump, lambda i, c, order=order: order(c) if i == BEGIN + 30 else None)
        after = {reason for o in outcomes[BEGIN + 60 : BEGIN + 70] for reason in o.offset.reasons}
        assert after == ({"unconfirmed_channel:t_q_degc"} if name == "warm" else set()), name


def test_an_unconfirmed_channel_stays_so_over_a_restart(day: dict[str, np.ndarray]) -> None:
    jump = hidden(biased("t_q_degc", 8.0, end=10_000), "t_q_degc", 12)
    compensations = [Compensation(settings(), QUILL)]

    def again(i: int, values: dict[str, float]) -> None:
        jump(i, values)

    through = run(day, jump)[: BEGIN + 40]
    for i in range(BEGIN + 40):
        values = readings(day, i)
        again(i, values)
        values["y_um"] = math.nan
        if i in (BEGIN - 5, BEGIN + 1, BEGIN + 20):
            restored = Compensation(settings(), QUILL)
            restored.restore(compensations[-1].state())
            compensations.append(restored)
        assert compensations[-1].process(sample(i, values)).offset == through[i].offset


def test_without_the_key_the_permitted_change_grows_as_ever(day: dict[str, np.ndarray]) -> None:
    outcomes = run(day, biased("t_q_degc", 8.0), suspect_jumps=False, jump_min_k=None)
    assert outcomes[BEGIN].sample.channels["t_q_degc"].quality == "too_fast"
    assert outcomes[BEGIN + 1].sample.channels["t_q_degc"].quality == "good"
    assert b'"jumps"' not in Compensation(settings(suspect_jumps=False, jump_min_k=None), QUILL).state()


def test_an_open_contact_before_it_hides_no_jump(day: dict[str, np.ndarray]) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        if BEGIN <= i < END:
            values["t_q_degc"] = math.nan if i < BEGIN + 5 else values["t_q_degc"] - 9.0

    outcomes = run(day, change)
    assert not any(o.offset.state == "ok" for o in outcomes[BEGIN:END])
    assert {o.offset.state for o in outcomes[END + 30 :]} == {"ok"}


def test_switched_heat_and_doors_raise_nothing_even_after_a_loss() -> None:
    minutes = np.arange(600)
    heat = np.where((minutes // 7) % 2 == 1, 90.0, 0.0)  # bursts of 7 min
    heat[300:] = np.where((minutes[300:] // 50) % 2 == 1, 90.0, 0.0)
    at = 20.0 - np.where((minutes > 200) & (minutes < 210), 1.0 - np.exp(-(minutes - 200) / 3.0), 0.0)
    assert QUILL.ttf is not None
    noise = 0.02 * np.random.default_rng(1).normal(size=(2, 600))
    t_q = at + QUILL.ttf.sampled.response(heat) + noise[0]
    day = {"t_s": minutes, "t_q_degc": t_q, "at_degc": at + noise[1], "y_um": minutes * 0.0}

    def lost(i: int, values: dict[str, float]) -> None:
        if 345 <= i < 360:  # the heat is switched on in the gap
            values["t_q_degc"] = math.nan

    def act(i: int, compensation: Compensation) -> None:
        if i == 380:
            compensation.resume()

    outcomes = run(day, lost, act)
    assert events(outcomes, "jumped") == []
    # Whether heat has come or the sensor has another zero is asked, and the offset goes on.
    assert {reason for o in outcomes[370:380] for reason in o.offset.reasons} == {"unconfirmed_channel:t_q_degc"}
    assert {o.offset.state for o in outcomes[380:]} == {"ok"}


def test_measured_y_decides_for_a_channel_that_was_right() -> None:
    """The permitted change is too narrow for this machine: what jumps is the heat, and Y shows it."""

    assert QUILL.ttf is not None
    n = 500
    heat = np.where(np.arange(n) >= BEGIN, 110.0, 0.0)
    right = {
        "t_s": np.arange(n),
        "t_q_degc": 20.0 + QUILL.ttf.sampled.response(heat),
        "at_degc": np.full(n, 20.0),
        "y_um": QUILL.dtf.sampled.response(heat),
    }
    narrow = [channel | ({"rate_max_per_min": 1.0} if channel["name"] == "t_q_degc" else {}) for channel in CHANNELS]
    conf = config(channel=narrow, guards=GUARDS, plausibility={"residual_std_um": 0.3})
    compensation, outcomes = Compensation(conf, QUILL), []
    for i in range(n):
        outcomes.append(
            compensation.process(sample(i, {name: float(right[name][i]) for name in ("t_q_degc", "at_degc", "y_um")}))
        )
    assert events(outcomes, "jumped")[0] == BEGIN
    accepted = events(outcomes, "accepted")
    assert accepted and accepted[0] <= BEGIN + 30
    error = [number(o.estimate.residual_um) for o in outcomes[accepted[0] + 1 :]]
    assert np.max(np.abs(error)) < 3.0


@pytest.mark.parametrize("how", ["resume", "zero"])
def test_an_operator_decides(day: dict[str, np.ndarray], how: str) -> None:
    """`resume` believes the value; a zero on the warm machine keeps the state and gives the sensor another zero."""

    def act(i: int, compensation: Compensation) -> None:
        if i == BEGIN + 60:
            compensation.resume() if how == "resume" else compensation.zero("warm")

    outcomes = run(day, biased("t_q_degc", 6.0, end=10_000), act)
    assert outcomes[BEGIN + 59].offset.state == "hold"
    assert {o.offset.state for o in outcomes[BEGIN + 90 :]} == {"ok"}
    grown = offsets(outcomes)[-1] - offsets(outcomes)[BEGIN + 100]
    right = undisturbed()[-1] - undisturbed()[BEGIN + 100]
    if how == "zero":
        assert abs(grown - right) < 1.5
    else:
        assert abs(offsets(outcomes)[-1] - undisturbed()[-1]) > 10.0  # 6 K too warm, as the operator said


def test_another_zero_of_a_sensor_is_recorded_and_known_to_what_begins_from_the_record(
    day: dict[str, np.ndarray],
) -> None:
    """What acts by the temperature itself needs the shift; without it, it would act on one that is off by 6 K."""

    def act(i: int, compensation: Compensation) -> None:
        if i == BEGIN + 60:
            compensation.zero("warm")
        zeros.append(compensation.status.zero)

    zeros: list[Zero | None] = []
    outcomes = run(day, biased("t_q_degc", 6.0, end=10_000), act)
    assert b"shift_k" not in encode(outcomes[BEGIN].estimate)
    last = outcomes[-1].estimate
    assert last.t_q_shift_k == pytest.approx(6.0, abs=0.2) and b"at_shift_k" not in encode(last)
    recorded = Zero.of_estimate(msgspec.json.decode(encode(last), type=EstimateMessage))
    assert zeros[-1] is not None and recorded.equals(zeros[-1])
    begun = Compensation(settings(), QUILL)
    begun.begin(recorded)
    zero = begun.status.zero
    assert zero is not None and zero.t_q_shift_k == last.t_q_shift_k


def test_check_names_the_guards_and_a_head_that_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    private, _ = write_key(tmp_path, "machine", 7)
    private.chmod(0o600)
    text = (
        (Path(__file__).parents[2] / "deploy/machine.example.toml")
        .read_text(encoding="utf-8")
        .replace("/var/lib/compensator/", "")
    )
    path = tmp_path / "machine.toml"
    signed = f'keep_days = 730\nsigning_key = "{private.name}"\nhead = "{tmp_path}/none/head.json"'
    path.write_text(text.replace("keep_days = 730", signed), encoding="utf-8")
    assert main(["check", "--config", str(path)]) == 0
    shown = capsys.readouterr()
    assert "beyond rate_max_per_min, and from 1 K on" in shown.out and "[head_not_writable]" in shown.err
    (tmp_path / "none").mkdir()
    path.write_text(path.read_text().replace("jump_min_k = 1.0", ""), encoding="utf-8")
    assert main(["check", "--config", str(path)]) == 0
    shown = capsys.readouterr()
    assert "(no guards.jump_min_k)" in shown.out and "head_not_writable" not in shown.err
    path.write_text(path.read_text().replace("suspect_jumps = true", ""), encoding="utf-8")
    assert main(["check", "--config", str(path)]) == 0
    assert "jumps of T_Q and AT off (no guards.suspect_jumps)" in capsys.readouterr().out


def test_two_probes_speak_for_it_and_one_does_not(day: dict[str, np.ndarray]) -> None:
    compensation = Compensation(settings(), QUILL)
    for i in range(BEGIN + 9):
        values = readings(day, i) | {"y_um": math.nan}
        values["t_q_degc"] += 8.0 if i >= BEGIN else 0.0
        compensation.process(sample(i, values))
    watch = compensation._jumps
    assert watch.suspects == ("t_q_degc",)
    believing = watch.state.believing
    assert believing is not None and believing.estimate is not None
    believed = believing.estimate.y_um
    watch.receive_probe(0.0, 1.0, believed - 60.0, 0.0)  # fits neither
    watch.receive_probe(believed, 1.0, 0.0, 0.0)
    assert compensation.process(sample(i, values)).sample.channels["t_q_degc"].quality == "suspect"
    assert watch.suspects == ("t_q_degc",)
    watch.receive_probe(believed, 1.0, 0.0, 0.0)
    outcome = compensation.process(sample(i + 1, values))
    assert any(data.get("code") == "accepted" for _, _, data in outcome.notes) and watch.suspects == ()


@pytest.mark.parametrize("again_k", [9.0, -6.0])
def test_a_channel_that_does_not_return_is_not_used_as_it_was_however_little_is_known(
    day: dict[str, np.ndarray], again_k: float
) -> None:
    """What is expected without the channel is soon as uncertain as its jump is large."""

    def change(i: int, values: dict[str, float]) -> None:
        values["t_q_degc"] += math.nan if 290 <= i < 300 else 3.0 * (i >= 300) + again_k * (i >= 360)

    outcomes = run(day, change)
    assert "unconfirmed_channel:t_q_degc" in outcomes[359].offset.reasons
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[361:END])


def with_t_q_unconfirmed(day: dict[str, np.ndarray]) -> tuple[Compensation, dict[str, float]]:
    """A compensation without Y whose T_Q reads 3 K more after samples without it, and the last values."""
    compensation = Compensation(settings(), QUILL)
    for i in range(BEGIN + 9):
        values = readings(day, i) | {"y_um": math.nan}
        values["t_q_degc"] += math.nan if BEGIN - 20 <= i < BEGIN else 3.0 * (i >= BEGIN)
        compensation.process(sample(i, values))
    return compensation, values


def test_one_probe_refutes_no_channel(day: dict[str, np.ndarray]) -> None:
    """It may have met a chip."""
    compensation, values = with_t_q_unconfirmed(day)
    watch = compensation._jumps
    for number_of_probes in (1, 2):
        assert watch.unconfirmed == ("t_q_degc",)
        shifted = watch.state.shifted
        assert shifted is not None and shifted.estimate is not None
        watch.receive_probe(shifted.estimate.y_um, 0.1, 0.0, 0.0)
        compensation.process(sample(BEGIN + 8 + number_of_probes, values))
    assert watch.suspects == ("t_q_degc",)


def test_probes_of_which_none_decides_confirm_a_channel_together(day: dict[str, np.ndarray]) -> None:
    compensation, values = with_t_q_unconfirmed(day)
    watch = compensation._jumps
    believing, shifted = watch.state.believing, watch.state.shifted
    assert believing is not None and believing.estimate is not None
    assert shifted is not None and shifted.estimate is not None
    std_um = abs(believing.estimate.y_um - shifted.estimate.y_um) / 3.7
    for number_of_probes in (1, 2):
        assert watch.unconfirmed == ("t_q_degc",)
        watch.receive_probe(believing.estimate.y_um, std_um, 0.0, 0.0)
        assert watch.state.probes_for == 0
        outcome = compensation.process(sample(BEGIN + 8 + number_of_probes, values))
    assert watch.unconfirmed == () and any("probes agree" in text for _, text, _ in outcome.notes)


def test_a_loose_contact_must_be_back_for_longer_each_time(day: dict[str, np.ndarray]) -> None:
    def loose(i: int, values: dict[str, float]) -> None:
        if BEGIN <= i < END and (i // 8) % 2 == 0:
            values["at_degc"] += 6.0

    outcomes = run(day, loose)
    backs = [i for i in events(outcomes, "accepted") if i < END]
    assert len(backs) < (END - BEGIN) // 16 // 2
    wrong = np.abs(offsets(outcomes) - undisturbed()) > 5.0
    assert not any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes))


def loose(channel: str, size: float, begin: int, end: int) -> Change:
    """A contact that finds another level, or the right one, every few samples."""
    random, kept = np.random.default_rng(7), {"by": size}

    def change(i: int, values: dict[str, float]) -> None:
        if begin < i < end and random.random() < 0.2:
            kept["by"] = size * float(random.choice([0.0, 0.7, 1.0, 1.3]))
        values[channel] += kept["by"] if begin <= i < end else 0.0

    return change


@pytest.mark.parametrize(
    ("channel", "size"), [("t_q_degc", 9.0), ("t_q_degc", -9.0), ("at_degc", 5.0), ("at_degc", -5.0)]
)
def test_a_loose_contact_that_comes_to_rest_is_used_again_and_unconfirmed(
    day: dict[str, np.ndarray], channel: str, size: float
) -> None:
    begin, end = 200, 400
    apart = np.abs(undisturbed() - offsets(outcomes := run(day, loose(channel, size, begin, end))))
    states = np.array([str(o.offset.state) for o in outcomes])
    assert not np.any((apart > 5.0) & (states == "ok"))
    # It must have been at rest for as long as it would have to be back.
    used = [i for i in events(outcomes, "unconfirmed") if i >= end]
    assert used and used[0] - end <= 30
    reasons = outcomes[used[0] + 1].offset.reasons
    assert f"unconfirmed_channel:{channel}" in reasons and not any("suspect" in one for one in reasons)
    # Right within an hour: what was lost is interpolated.
    assert apart[end + 60 :].max() < 3.0
    resumed = run(day, loose(channel, size, begin, end), lambda i, c: c.resume() if i == end + 60 else None)
    assert resumed[-1].offset.state == "ok"


@pytest.mark.parametrize("size", [9.0, -9.0])
@pytest.mark.parametrize("again", [1, 6])
def test_a_loose_contact_that_was_used_for_hours_and_jumps_again_keeps_what_it_showed(
    day: dict[str, np.ndarray], size: float, again: int
) -> None:
    """One bad sample, or a few: that says nothing about the hours before it."""
    at_first, later = loose("t_q_degc", size, 100, 200), 600

    def change(i: int, values: dict[str, float]) -> None:
        at_first(i, values)
        values["t_q_degc"] += size if later <= i < later + again else 0.0

    def missing(i: int, values: dict[str, float]) -> None:
        values["t_q_degc"] = math.nan if later <= i < later + again + 30 else values["t_q_degc"]

    outcomes = run(day, change)
    states = np.array([str(o.offset.state) for o in outcomes])
    assert set(states[240:later]) == {"degraded"}
    assert "suspect_channel:t_q_degc" in outcomes[later + 1].offset.reasons and "ok" not in states[later:]
    # As without it for the time in which it is suspect.
    assert np.max(np.abs(offsets(outcomes) - offsets(run(day, missing)))[300:]) < 3.0
    assert "unconfirmed_channel:t_q_degc" in outcomes[later + again + 31].offset.reasons


@pytest.mark.parametrize("size", [5.0, -5.0])
def test_a_deviation_contains_what_a_wrong_rest_did_after_a_further_jump_too(
    day: dict[str, np.ndarray], size: float
) -> None:
    """Until something decides: the rest may have been at a wrong level."""
    at_first, mend = loose("t_q_degc", size, 200, 300), 420

    def change(i: int, values: dict[str, float]) -> None:
        at_first(i, values)
        values["t_q_degc"] += size if 300 <= i < mend else 0.0

    outcomes = run(day, change)
    apart = np.abs(offsets(outcomes) - undisturbed())
    used = [i for i in events(outcomes, "unconfirmed") if 230 <= i < mend]
    assert used and apart[mend - 1] > 10.0
    assert "ok" not in {o.offset.state for o in outcomes[used[0] :]}
    stds = [number(o.offset.y_offset_std_um) for o in outcomes[mend - 1 : mend + 10]]
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[mend : mend + 10])
    assert min(stds) > 0.7 * stds[0]


@pytest.mark.parametrize("size", [8.0, -8.0])
def test_a_loose_contact_of_the_air_that_rests_where_no_air_can_be_is_not_used(
    day: dict[str, np.ndarray], size: float
) -> None:
    """And where it then comes near its level for some samples, that is no return."""
    jumps = (0.0, 1.0, 0.6, 1.0, 0.7, 1.0, 0.0, 1.3)

    def change(i: int, values: dict[str, float]) -> None:
        if 200 <= i < 600:
            by = jumps[(i - 200) // 2] if i < 212 else 1.0
            values["at_degc"] += size * (0.15 if i >= 300 and (i // 6) % 2 == 0 else by)

    outcomes = run(day, change)
    apart = np.abs(offsets(outcomes) - undisturbed())
    states = [str(o.offset.state) for o in outcomes]
    assert set(states[230:600]) == {"hold"} and not any(i < 600 for i in events(outcomes, "unconfirmed"))
    assert not any(far > 5.0 and state == "ok" for far, state in zip(apart, states, strict=True))


def test_a_loose_contact_that_jumps_across_missing_samples_is_not_at_rest(day: dict[str, np.ndarray]) -> None:
    jumps = (0.0, 1.0, 0.6, 1.0, 0.7, 1.0)

    def change(i: int, values: dict[str, float]) -> None:
        if 200 <= i < 212:
            values["at_degc"] += 6.0 * jumps[(i - 200) // 2]
        elif 212 <= i < 500:
            values["at_degc"] += 1.9 * ((i // 4) % 2) - 0.95
            if i % 2:
                values["at_degc"] = math.nan

    assert not [i for i in events(run(day, change), "unconfirmed") if i < 500]


def test_a_direct_model_keeps_a_suspect_until_an_operator_decides(day: dict[str, np.ndarray]) -> None:
    outcomes = run(day, biased("t_q_degc", 8.0), model=direct("kalman"))
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[BEGIN:END])


@pytest.mark.parametrize("is_beside", [False, True])
@pytest.mark.parametrize(
    ("channel", "size", "left"), [("t_q_degc", -3.5, 0.0), ("at_degc", 1.6, 0.0), ("at_degc", 8.0, 1.4)]
)
def test_the_state_goes_on_to_the_bit(
    day: dict[str, np.ndarray], channel: str, size: float, left: float, is_beside: bool
) -> None:
    conf = settings()
    whole, state = Compensation(conf, QUILL), b""

    def change(i: int, values: dict[str, float]) -> None:
        values[channel] += size if 250 <= i < 330 else left * (i >= 330)

    for i in range(200, 360):
        values = readings(day, i)
        change(i, values)
        if is_beside:
            values["at_degc" if channel == "t_q_degc" else "t_q_degc"] -= 1.6 if 270 <= i < 345 else 0.0
        if 300 < i < 304:
            values["at_degc"] = math.nan
        if i < 245:
            whole.process(sample(i, values))
            continue
        state = state or whole.state()
        restored = Compensation(conf, QUILL)
        restored.restore(state)
        if i == 310:
            for one in (whole, restored):
                one.pause(20)
        if i == 298:
            for one in (whole, restored):
                one.zero("warm")
        outcome, again = whole.process(sample(i, values)), restored.process(sample(i, values))
        assert encode(again.offset) == encode(outcome.offset) and again.notes == outcome.notes
        state = whole.state()
        assert restored.state() == state
    assert decode_state(state).jumps is not None


def test_a_threshold_needs_its_key() -> None:
    table = (
        "[guards]\nt_q_below_at_max_k = 2.0\njump_min_k = 1.0\n"
        "[loss]\npredict_for_min = 1.0\n[zero]\nrest_rate_um_per_min = 1.0\n"
        "[machine]\nname = 'a'\n[model]\nfile = 'quill'\n[recording]\nfolder = 'r'\n[zenoh]\nprefix = 's'\n"
        "[limits]\noffset_max_um = 1.0\noffset_rate_max_um_per_min = 1.0\n"
        "validity = {t_q_degc = [0, 1], at_degc = [0, 1]}\n"
    )
    channels = "line = []\ndevice = [{name = 'm'}]\nchannel = [" + ",".join(
        f"{{name = '{name}', device = 'm', input = 0, range = [0, 1], rate_max_per_min = 1.0, stuck_after_min = 1.0}}"
        for name in ("t_q_degc", "at_degc")
    )
    with pytest.raises(ConfigError, match=r"guards.jump_min_k = 1: expected guards.suspect_jumps = true"):
        parse_config(f"{channels}]\n{table}".encode(), source="machine.toml")
