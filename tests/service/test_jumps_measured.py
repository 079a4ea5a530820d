"""A channel that has jumped, with measured Y: what was wrong before the jump, and what is too small to decide."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from compensator.errors import DataError
from compensator.messages import number
from compensator.model.effects import effect_from
from compensator.model.engine import Engine
from compensator.model.thermal_model import Path, ThermalModel
from compensator.model.transfer_function import TransferFunction
from compensator.service.compensation import Compensation, Outcome
from compensator.service.loop.trust import was_wrong
from compensator.service.state import decode_state, frozen_state
from tests.service.jumping import Change, offsets, readings, run, settings, steps, undisturbed, working_day
from tests.service.records import QUILL, direct, sample


@pytest.fixture(scope="module")
def day() -> dict[str, np.ndarray]:
    return working_day()


def sticks(begin: int, end: int) -> Change:
    """T_Q keeps its value."""
    kept: list[float] = []

    def change(i: int, values: dict[str, float]) -> None:
        if begin <= i < end:
            kept.append(values["t_q_degc"])
            values["t_q_degc"] = kept[0]

    return change


@pytest.mark.parametrize(("begin", "end"), [(300, 360), (400, 450)])
def test_measured_y_speaks_for_a_mended_channel_though_it_was_wrong_before_it_jumped(
    day: dict[str, np.ndarray], begin: int, end: int
) -> None:
    """The mend is the jump: against the level of Y before it the mended channel is the wrong one."""
    outcomes = run(day, sticks(begin, end), y=True)
    assert "suspect_channel:t_q_degc" in outcomes[end + 2].offset.reasons
    wrong = np.abs(offsets(outcomes) - undisturbed(y=True)) > 5.0
    assert not wrong[end + 90 :].any()
    assert outcomes[end + 180].offset.state == "ok"


def drifts(channel: str, k_per_h: float, begin: int, end: int) -> Change:
    """A couple that drifts until somebody mends it."""

    def change(i: int, values: dict[str, float]) -> None:
        values[channel] += k_per_h * (i - begin) / 60.0 if begin <= i < end else 0.0

    return change


@pytest.mark.parametrize(
    ("channel", "k_per_h", "end"), [("t_q_degc", 1.5, 420), ("t_q_degc", -1.0, 480), ("at_degc", 1.2, 400)]
)
def test_after_a_drift_is_mended_the_offset_is_right_within_an_hour(
    day: dict[str, np.ndarray], channel: str, k_per_h: float, end: int
) -> None:
    """What it has shown for hours is in the state: measured Y, not time, puts that right."""
    outcomes = followed(day, drifts(channel, k_per_h, 180, end), residual_std_um=0.3, false_alarm_days=30.0)
    assert f"suspect_channel:{channel}" in outcomes[end + 1].offset.reasons
    wrong = np.abs(offsets(outcomes) - undisturbed(y=True))
    assert np.max(wrong[end : end + 5]) > 5.0 and np.max(wrong[end + 60 :]) < 5.0
    assert any("measured Y shows that it was wrong" in note.text for o in outcomes for note in o.notes)
    assert any(was_wrong(outcome) for outcome in outcomes)


@functools.cache
def curved(form: str, change: float) -> tuple[ThermalModel, dict[str, np.ndarray], np.ndarray]:
    """A model with a curve, the day of a machine that is as it says, and the offsets where nothing is wrong."""
    curve = effect_from("nonlinear", {"path": "DTF", "form": form, "change": change})
    model, day = dataclasses.replace(QUILL, effects=(curve,), y_std_um=0.5), working_day()
    columns = day | {"y_um": np.array([number(o.estimate.y_pred_um) for o in run(day, model=model)])}
    return model, columns, offsets(run(columns, model=model, y=True))


@pytest.mark.parametrize("form", ["square", "odd square", "cube"])
@pytest.mark.parametrize("change", [-0.6, 1.0, 3.0])
@pytest.mark.parametrize("channel", ["t_q_degc", "at_degc"])
def test_a_curve_of_the_model_does_not_lead_a_hindsight_astray(form: str, change: float, channel: str) -> None:
    """Y corrects the state of three engines, one of them without T_Q: a curve amplifies each correction."""
    model, columns, right = curved(form, change)
    mend = 420
    outcomes = followed(
        columns, drifts(channel, 1.5, 180, mend), model=model, residual_std_um=0.5, false_alarm_days=30.0
    )
    wrong = np.abs(offsets(outcomes) - right)
    assert np.all(np.isfinite(wrong[1:]))
    late = [i for i, o in enumerate(outcomes) if i > mend + 60 and o.offset.state == "ok" and wrong[i] > 5.0]
    assert not late


@pytest.mark.parametrize("size", [4.0, -4.0, 9.0])
@pytest.mark.parametrize("channel", ["t_q_degc", "at_degc"])
def test_a_channel_that_is_wrong_from_its_jump_on_was_not_wrong_before(
    day: dict[str, np.ndarray], channel: str, size: float
) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        values[channel] += size if i >= 300 else 0.0

    outcomes = followed(day, change, false_alarm_days=30.0)
    assert all(f"suspect_channel:{channel}" in o.offset.reasons for o in outcomes[301:])


@pytest.mark.parametrize(("size", "y_wrong_um"), [(3.0, 12.0), (3.0, 30.0), (-4.0, -12.0)])
def test_some_wrong_values_of_y_after_a_jump_make_no_hindsight_of_it(
    day: dict[str, np.ndarray], size: float, y_wrong_um: float
) -> None:
    """A chip for 4 min moves Y the way a channel would that was wrong before its jump."""

    def change(i: int, values: dict[str, float]) -> None:
        values["t_q_degc"] += size if 300 <= i < 390 else 0.0
        values["y_um"] += y_wrong_um if 304 <= i < 308 else 0.0

    outcomes = followed(day, change, residual_std_um=0.3, false_alarm_days=30.0)
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[301:390])
    assert outcomes[400].offset.state == "ok"


@pytest.mark.parametrize(
    ("begin", "at_k", "end", "loose_from", "t_q_k", "on"),
    [
        (251, 4.0, 328, 244, 5.0, {4, 8, 10, 13, 14}),
        (282, 3.0, 368, 280, 3.75, {0, 4, 6, 7, 9, 13, 14}),
        (491, 3.0, 544, 488, 3.0, {4, 6, 8, 11, 12}),
    ],
)
def test_the_model_confirms_nothing_that_measured_y_contradicts(
    day: dict[str, np.ndarray], begin: int, at_k: float, end: int, loose_from: int, t_q_k: float, on: set[int]
) -> None:
    """AT jumps while T_Q is a loose contact, `on` in some blocks of three samples: together they look like heat."""

    def change(i: int, values: dict[str, float]) -> None:
        values["at_degc"] += at_k if begin <= i < end else 0.0
        values["t_q_degc"] += t_q_k if (i - loose_from) // 3 in on else 0.0

    outcomes = followed(day, change, residual_std_um=0.3, false_alarm_days=30.0)
    wrong = np.abs(offsets(outcomes) - undisturbed(y=True)) > 5.0
    assert not any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes))
    assert all("suspect_channel:at_degc" in o.offset.reasons for o in outcomes[begin + 1 : end])
    assert not wrong[end + 60 :].any()


def test_what_y_has_shown_since_a_jump_survives_a_restart(day: dict[str, np.ndarray]) -> None:
    change = drifts("t_q_degc", 1.5, 180, 420)
    conf = settings({"false_alarm_days": 30.0})
    whole, parts = Compensation(conf, QUILL), Compensation(conf, QUILL)
    for i in range(500):
        values = readings(day, i)
        change(i, values)
        if i in (422, 425):
            again = Compensation(conf, QUILL)
            again.restore(parts.state())
            parts = again
        assert parts.process(sample(i, values)) == whole.process(sample(i, values))
    assert parts.state() == whole.state() and decode_state(whole.state()).jumps is not None


@pytest.mark.parametrize("jumps_k", [{}, {"y_um": 3.0}, {"t_q_degc": 1.0, "heat_w": 2.0}])
def test_a_hindsight_of_no_temperature_is_refused(day: dict[str, np.ndarray], jumps_k: dict[str, float]) -> None:
    compensation = Compensation(settings({"false_alarm_days": 30.0}), QUILL)
    change = drifts("t_q_degc", 1.5, 180, 420)
    for i in range(424):
        values = readings(day, i)
        change(i, values)
        compensation.process(sample(i, values))
    state = decode_state(compensation.state())
    assert state.jumps is not None and state.jumps.hindsight is not None
    state.jumps.hindsight.jumps_k = jumps_k
    with pytest.raises(DataError, match="hindsight"):
        Compensation(settings({"false_alarm_days": 30.0}), QUILL).restore(frozen_state(state)())


@pytest.mark.parametrize(("begin", "end"), [(300, 360), (400, 450)])
def test_a_mended_channel_is_used_again_where_y_has_more_noise_than_the_model_errs(
    day: dict[str, np.ndarray], begin: int, end: int
) -> None:
    """The model states 0.06 µm, a value of Y has 0.3: what agrees with Y all the time must not be held for hours."""
    rng = np.random.default_rng(7)
    noise = rng.normal(0.0, 0.3, len(day["t_s"]))
    fault = sticks(begin, end)

    def change(i: int, values: dict[str, float]) -> None:
        fault(i, values)
        values["y_um"] += float(noise[i])

    outcomes = followed(day, change, residual_std_um=0.06, false_alarm_days=30.0, sensor_must_fit=True)
    assert any("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[begin:])
    wrong = np.abs(offsets(outcomes) - undisturbed(y=True)) > 5.0
    assert not wrong[end + 90 :].any() and not any(o.offset.state == "hold" for o in outcomes[end + 90 :])


def followed(
    day: dict[str, np.ndarray],
    change: Change,
    *,
    restart: int | None = None,
    residual_std_um: float = 2.3,
    model: ThermalModel = QUILL,
    **checks: float,
) -> list[Outcome]:
    """Run with a Y whose deviation hides a small jump, or with another one; perhaps with a restart."""
    conf = settings({"residual_std_um": residual_std_um, **checks})
    compensation, outcomes = Compensation(conf, model), []
    for i in range(len(day["t_s"])):
        if i == restart:
            state = compensation.state()
            assert decode_state(state).jumps.y_fits > 0  # type: ignore[union-attr]
            compensation = Compensation(conf, QUILL)
            compensation.restore(state)
        values = readings(day, i)
        change(i, values)
        outcomes.append(compensation.process(sample(i, values)))
    return outcomes


@pytest.mark.parametrize(("size", "left"), [(8.0, 1.2), (6.0, 1.1)])
def test_the_offset_is_not_held_for_a_jump_that_is_too_small_for_measured_y_to_tell(
    day: dict[str, np.ndarray], size: float, left: float
) -> None:
    """It is used in doubt, and stays in doubt: where heat is switched it may seem to be back for a sample."""
    change = steps((300, "t_q_degc", size), (360, "t_q_degc", left))
    outcomes = followed(day, change)
    assert "unconfirmed_channel:t_q_degc" in outcomes[420].offset.reasons
    assert sum(o.offset.state == "hold" for o in outcomes[360:]) < 150
    assert not any(o.offset.state == "ok" for o in outcomes[300:])
    again = followed(day, change, restart=390)
    assert [o.offset for o in again] == [o.offset for o in outcomes]


def test_beside_a_model_that_was_wrong_before_a_jump_it_is_not_believed_by_chance(day: dict[str, np.ndarray]) -> None:
    """Y goes on to agree with the channel less its jump, by the level before: that it once comes by is no evidence."""

    def change(i: int, values: dict[str, float]) -> None:
        values["y_um"] += 12.0 * min(max(i - 120, 0) / 120.0, 1.0)
        values["t_q_degc"] += 4.0 if i >= 300 else 0.0

    outcomes = run(day, change, y=True)
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[301:420])


#: The first sample after a restart.
RESTARTED = 203


def heated_while_stopped(
    *, spike: tuple[str, int] | None = None, std_um: float = 1.0, y_wrong_um: float = 0.0
) -> list[Outcome]:
    """A heating begins within a pause of three samples; T_Q and AT are right, but for one value, the spike.

    Y may be wrong from 20 samples later on.
    """
    function = TransferFunction(numerator=(320.0, 5.0), denominator=(64.0, 1.0), unit="um/K")
    base = direct("kalman")
    estimator = dataclasses.replace(base.estimator, drive_walk_std=0.05, t_q_noise_std_k=0.03)
    model = dataclasses.replace(base, dtf=Path.from_continuous(function, 60.0), estimator=estimator)
    minutes, at = np.arange(480), np.full(480, 20.0)
    t_q = at + np.where(minutes < RESTARTED - 4, 0.0, 6.0 * -np.expm1((RESTARTED - 4 - minutes) / 10.0))
    engine = Engine(model)
    engine.set_reference(20.0, 20.0)
    deformed = np.array([estimate.y_um for estimate in engine.run(t_q, at)])
    random = np.random.default_rng(4)
    noise = random.normal(0.0, [[0.02], [0.02], [0.5]], (3, 480))
    compensation, outcomes = Compensation(settings({"residual_std_um": std_um}), model), []
    for i in minutes.tolist():
        if RESTARTED - 3 <= i < RESTARTED:
            continue
        if i == RESTARTED:
            compensation.pause(3)
        read = dict(
            zip(("t_q_degc", "at_degc", "y_um"), (noise[:, i] + (t_q[i], at[i], deformed[i])).tolist(), strict=True)
        )
        read["y_um"] += y_wrong_um * (i >= RESTARTED + 20)
        if spike is not None and i == spike[1]:
            read[spike[0]] -= 12.0
        outcomes.append(compensation.process(sample(i, read)))
    return outcomes


@pytest.mark.parametrize(("std_um", "within"), [(1.0, 15), (3.0, 180)])
def test_a_heating_that_begins_while_the_service_restarts_is_no_jump_where_measured_y_shows_it(
    std_um: float, within: int
) -> None:
    """A switched heat is unexpected for both engines; Y confirms T_Q, however little each of its values says."""
    outcomes = heated_while_stopped(std_um=std_um)
    assert "unconfirmed_channel:t_q_degc" in outcomes[RESTARTED - 3].offset.reasons
    assert not any("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes)
    assert outcomes[RESTARTED - 3 + within].offset.state == "ok"


def test_a_value_of_y_with_which_neither_agrees_confirms_nothing() -> None:
    outcomes = heated_while_stopped(std_um=3.0, y_wrong_um=12.0)
    assert all("unconfirmed_channel:t_q_degc" in o.offset.reasons for o in outcomes[RESTARTED - 3 :])


def test_where_y_contradicts_it_a_channel_is_not_used_again_as_it_was() -> None:
    """It may have been wrong all the time: then Y shows that in hindsight, while the channel is suspect."""
    outcomes = heated_while_stopped(std_um=3.0, y_wrong_um=12.0, spike=("at_degc", 280))
    asked = [o.offset.reasons for o in outcomes[280 - 3 :]]
    assert all("suspect_channel:t_q_degc" in reasons for reasons in asked[:20])


@pytest.mark.parametrize("channel", ["t_q_degc", "at_degc"])
def test_one_wrong_value_leaves_an_unconfirmed_channel_as_it_was(channel: str) -> None:
    """It is back to what it has shown while it was used, though not to what the doubt about it expects."""
    whole, outcomes = (heated_while_stopped(spike=spike, std_um=3.0) for spike in (None, (channel, 280)))
    at = 280 - 3
    for o in (whole[at], outcomes[at - 1], outcomes[at + 8]):
        assert "unconfirmed_channel:t_q_degc" in o.offset.reasons
    assert "suspect_channel:t_q_degc" in outcomes[at].offset.reasons
    apart = offsets(outcomes) - offsets(whole)
    assert np.max(np.abs(apart[at + 8 :])) < 0.5


@pytest.mark.parametrize(("wrong_k", "gap", "level_um"), [(3.0, 40, 12.0), (0.0, 40, 6.0), (0.0, 40, -6.0)])
def test_a_level_that_is_raised_while_a_channel_is_in_question_is_that_of_measured_y_from_then_on(
    day: dict[str, np.ndarray], wrong_k: float, gap: int, level_um: float
) -> None:
    """Y stands off since an effect began, and the loop adopts what explains it, two samples after T_Q has returned."""

    def change(i: int, values: dict[str, float]) -> None:
        values["y_um"] += level_um if i >= 150 else 0.0
        values["t_q_degc"] += np.nan if 300 <= i < 300 + gap else wrong_k if i >= 300 + gap else 0.0

    def raised(i: int, compensation: Compensation) -> None:
        if i == 300 + gap + 2:
            compensation.raise_level(level_um)

    outcomes = run(day, change, raised, y=True)
    assert "unconfirmed_channel:t_q_degc" in outcomes[300 + gap + 10].offset.reasons
    after = [outcome.offset.state for outcome in outcomes[300 + gap + 60 :]]
    assert all(state != "ok" for state in after) if wrong_k else "ok" in after[:10]
