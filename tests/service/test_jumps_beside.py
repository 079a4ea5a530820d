"""A jump of one channel while the other one has jumped, and zeros while either answer may be right."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.config import Probe
from compensator.errors import DataError
from compensator.messages import Offset, ProbeRequest, encode, number
from compensator.service.compensation import Compensation, Outcome
from compensator.service.probing import ReceivedProbe
from compensator.service.transfer.shadow import Shadow
from compensator.service.transfer.warm_up import Successor
from tests.service.jumping import (
    BEGIN,
    CHANNELS,
    END,
    Change,
    events,
    is_wrong_in_ok,
    offsets,
    readings,
    run,
    settings,
    steps,
    undisturbed,
    working_day,
    zero_at,
)
from tests.service.records import QUILL, sample

Steps = list[tuple[int, str, float]]


@pytest.fixture(scope="module")
def day() -> dict[str, np.ndarray]:
    return working_day()


def test_at_that_is_back_before_t_q_leaves_t_q_in_question(day: dict[str, np.ndarray]) -> None:
    """AT comes back little by little, to where it was held; T_Q has jumped meanwhile, and stays."""

    def change(i: int, values: dict[str, float]) -> None:
        if i >= BEGIN:
            values["at_degc"] += 6.0 if i == BEGIN else max(6.0 - 0.2 * (i - BEGIN), 2.0) if i < BEGIN + 20 else 0.0
        values["t_q_degc"] -= 4.5 if i >= BEGIN + 10 else 0.0

    outcomes = run(day, change)
    assert not is_wrong_in_ok(outcomes)
    asked = {"suspect_channel:t_q_degc", "unconfirmed_channel:t_q_degc"}
    assert all(asked & set(o.offset.reasons) for o in outcomes[BEGIN + 20 :])


def test_a_loose_t_q_that_rests_does_not_end_the_question_of_at(day: dict[str, np.ndarray]) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        if BEGIN <= i < BEGIN + 40:
            values["t_q_degc"] += 9.0 if i < BEGIN + 10 else 9.0 * (-1) ** i
        values["at_degc"] -= 1.6 if i >= BEGIN + 2 else 0.0

    outcomes = run(day, change)
    assert "unconfirmed_channel:at_degc" in outcomes[BEGIN + 10].offset.reasons
    asked = {"suspect_channel:at_degc", "unconfirmed_channel:at_degc"}
    assert all(asked & set(o.offset.reasons) for o in outcomes[BEGIN + 10 :])


@pytest.mark.parametrize("at", [BEGIN + 15, BEGIN + 20, BEGIN + 30])
def test_at_that_steps_while_t_q_is_loose_is_asked_about_once_t_q_is_right(day: dict[str, np.ndarray], at: int) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        values["t_q_degc"] += 8.0 if BEGIN <= i < BEGIN + 40 and ((i - BEGIN) // 2) % 2 == 0 else 0.0
        values["at_degc"] += 1.6 if at <= i < BEGIN + 200 else 0.0

    outcomes = run(day, change)
    assert not is_wrong_in_ok(outcomes)
    assert outcomes[BEGIN + 280].offset.state == "ok"


def test_at_that_wobbles_while_it_is_pushed_in_is_no_air(day: dict[str, np.ndarray]) -> None:
    """It is back for two samples and rests elsewhere: air goes back little by little."""
    outcomes = run(day, steps((BEGIN, "at_degc", 4.5), (BEGIN + 10, "at_degc", 0.0), (BEGIN + 12, "at_degc", 1.7)))
    assert not is_wrong_in_ok(outcomes)
    assert not events(outcomes, "accepted")


def probed(truth_um: float, offset: Offset) -> ReceivedProbe:
    """A probe at the last sample, without an error."""
    applied_um = number(offset.y_offset_um)
    request = ProbeRequest(
        schema=1,
        time_utc_ns=offset.time_utc_ns,
        axis="y",
        measured_um=truth_um + applied_um,
        offset_applied_um=applied_um,
    )
    return ReceivedProbe(request=request, received_utc_ns=offset.time_utc_ns)


def little_by_little(i: int) -> float:
    """AT is warm air that goes, K."""
    since = i - BEGIN
    return 0.0 if not 0 <= since < 20 else 6.0 if since == 0 else max(6.0 - 0.2 * since, 2.0)


@pytest.mark.parametrize("after", [21, 22, 24])
def test_a_zero_as_air_is_gone_gives_at_no_other_zero(day: dict[str, np.ndarray], after: int) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        values["at_degc"] += little_by_little(i)

    outcomes = run(day, change, zero_at(BEGIN + after))
    assert not is_wrong_in_ok(outcomes, zero=BEGIN + after)
    assert np.max(np.abs(offsets(outcomes) - undisturbed(zero=BEGIN + after))[BEGIN + 60 : BEGIN + 150]) < 2.0


def test_a_zero_as_the_channel_beside_comes_back_gives_it_no_other_zero(day: dict[str, np.ndarray]) -> None:
    change = steps((BEGIN, "t_q_degc", 8.0), (BEGIN + 10, "at_degc", 6.0), (BEGIN + 40, "at_degc", 0.0))
    outcomes = run(day, change, zero_at(BEGIN + 41))
    assert np.max(np.abs(offsets(outcomes) - undisturbed(zero=BEGIN + 41))[BEGIN + 60 : BEGIN + 150]) < 2.0


@pytest.mark.parametrize("later", [-1, 0, 1])
def test_a_jump_that_nobody_saw_is_asked_about_also_in_the_sample_of_another_one(
    day: dict[str, np.ndarray], later: int
) -> None:
    change = steps(
        (BEGIN - 6, "at_degc", math.nan),
        (BEGIN, "at_degc", 2.6),
        (BEGIN + later, "t_q_degc", 8.0),
        (BEGIN + 60, "t_q_degc", 0.0),
    )
    outcomes = run(day, change)
    assert not is_wrong_in_ok(outcomes)
    asked = {"suspect_channel:at_degc", "unconfirmed_channel:at_degc"}
    assert all(asked & set(o.offset.reasons) for o in outcomes[BEGIN + 2 :])


def test_a_zero_that_waited_for_the_end_of_a_jump_counts_for_both_engines_beside(day: dict[str, np.ndarray]) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        values["at_degc"] += little_by_little(i)
        if BEGIN - 3 <= i < BEGIN + 8:
            values["t_q_degc"] = math.nan
        values["t_q_degc"] -= 4.5 if i >= BEGIN + 8 else 0.0

    compensation = Compensation(settings(), QUILL)
    zeros = []
    for i in range(BEGIN + 60):
        values = readings(day, i) | {"y_um": math.nan}
        change(i, values)
        if i == BEGIN - 2:
            compensation.zero("warm")
        outcome = compensation.process(sample(i, values))
        zeros += [i for kind, *_ in outcome.notes if kind == "zero"]
        if zeros[-1] > BEGIN and compensation._jumps.state.believing is not None:
            state = compensation._jumps.state
            assert state.zero_in_use is not None and state.believing.at_zero is not None
            assert state.shifted is not None and state.shifted.at_zero is not None
    assert zeros[-1] > BEGIN


def test_the_level_of_y_is_forgotten_with_a_jump_that_has_seen_a_zero(day: dict[str, np.ndarray]) -> None:
    def act(i: int, compensation: Compensation) -> None:
        if i == BEGIN + 8:
            compensation.zero("warm")
        if i == BEGIN + 10:
            compensation.resume()
        if i == BEGIN + 12:
            levels.append(compensation._jumps.state.level_um)

    levels: list[float] = []
    run(day, steps((BEGIN, "at_degc", -1.8)), act, y=True)
    healthy = Compensation(settings(), QUILL)
    for i in range(BEGIN):
        healthy.process(sample(i, {name: float(day[name][i]) for name in ("t_q_degc", "at_degc", "y_um")}))
    # Y − prediction, not Y: the wrong AT of ten minutes is in the prediction.
    assert abs(levels[0] - healthy._jumps.state.level_um) < 20.0 < abs(float(day["y_um"][BEGIN + 8]))


def test_jumps_of_one_channel_make_no_loose_contact_of_the_other(day: dict[str, np.ndarray]) -> None:
    change = steps(
        *[
            (BEGIN + at, "t_q_degc", size)
            for at, size in ((-100, 8.0), (-90, 0.0), (-70, 8.0), (-60, 0.0), (0, 8.0), (6, 0.0))
        ],
        (BEGIN + 1, "at_degc", math.nan),
        (BEGIN + 4, "at_degc", -4.0),
    )
    outcomes = run(day, change)
    assert not is_wrong_in_ok(outcomes)
    assert not [
        n.text for o in outcomes for n in o.notes if "AT" in n.text and "at rest" in n.text and n.kind == "plausibility"
    ]


@pytest.mark.parametrize("size", [1.8, -1.8])
def test_probes_that_are_right_never_confirm_a_sensor_that_is_wrong(day: dict[str, np.ndarray], size: float) -> None:
    """The first probes are taken into the correction, which then hides the fault from the next ones."""
    probe = Probe(std_um=1.0, measured_max_um=200.0, largest_um=40.0, tolerance_um=3.0)
    compensation = Compensation(msgspec.structs.replace(settings(), probe=probe), QUILL)
    outcome, reasons = None, dict[int, list[str]]()
    for i in range(END):
        values = readings(day, i)
        truth_um = values["y_um"] - float(day["y_um"][0])
        values["y_um"] = math.nan
        values["at_degc"] += size if i >= BEGIN else 0.0
        if outcome is not None and i in range(BEGIN + 25, BEGIN + 66, 10):
            compensation.receive_probes([probed(truth_um, outcome.offset)])
        outcome = compensation.process(sample(i, values))
        reasons[i] = list(map(str, outcome.offset.reasons))
        assert not any("confirmed: probes" in note.text for note in outcome.notes)
    asked = {"suspect_channel:at_degc", "unconfirmed_channel:at_degc"}
    assert all(asked & set(reasons[i]) for i in range(BEGIN + 2, END))
    assert "suspect_channel:at_degc" in reasons[BEGIN + 50]


def probed_day(
    day: dict[str, np.ndarray],
    probes: dict[int, float],
    *,
    rate_max: float = 5.0,
    least_k: float = 1.0,
    fault_k: float = 0.0,
) -> list[Outcome]:
    """Run a day without measured Y: probes by sample with what each is wrong by, T_Q off by a fault from BEGIN on."""
    probe = Probe(std_um=1.0, measured_max_um=200.0, largest_um=40.0, tolerance_um=3.0)
    channels = [c | {"rate_max_per_min": rate_max} if c["name"] == "t_q_degc" else c for c in CHANNELS]
    guarded = msgspec.structs.replace(settings(channel=channels, jump_min_k=least_k), probe=probe)
    compensation = Compensation(guarded, QUILL)
    outcomes: list[Outcome] = []
    last = None
    for i in range(END):
        values = readings(day, i)
        truth_um = values["y_um"] - float(day["y_um"][0])
        values["y_um"] = math.nan
        values["t_q_degc"] += fault_k if i >= BEGIN else 0.0
        if i in probes:
            last = probed(truth_um + probes[i], outcomes[-1].offset)
        if i in probes or i - 1 in probes:  # each arrives twice
            assert last is not None
            compensation.receive_probes([last])
        outcomes.append(compensation.process(sample(i, values)))
    return outcomes


def test_probes_while_the_offset_is_held_end_the_doubt_of_a_channel_that_is_right(day: dict[str, np.ndarray]) -> None:
    """T_Q heats faster than permitted, so it is suspected; the offset is held, and 80 µm wrong by then."""
    hourly = {30: 0.0, 90: 0.0, 150: 0.0, 210: 0.0}
    outcomes = probed_day(day, hourly, rate_max=0.5, least_k=0.5)
    states = [o.offset.state for o in outcomes]
    assert states[60] == states[150] == "hold", states[60:152]
    assert [p.code for o in outcomes[90:160] for p in o.probes] == 2 * ["probe_during_hold", "probe_duplicate"]
    assert {o.offset.state for o in outcomes[155:260]} == {"degraded"}
    wrong_um = np.abs(offsets(outcomes) - undisturbed()[:END])
    assert np.max(wrong_um[100:140]) > 40.0 and np.max(wrong_um[160:260]) < 5.0
    # One that has met a chip is not one of two.
    chip = probed_day(day, hourly | {90: 15.0}, rate_max=0.5, least_k=0.5)
    assert chip[155].offset.state == "hold" and chip[215].offset.state == "degraded"


@pytest.mark.parametrize("fault_k", [6.0, -6.0, 2.5])
def test_probes_while_the_offset_is_held_speak_against_a_sensor_that_is_wrong(
    day: dict[str, np.ndarray], fault_k: float
) -> None:
    hourly = dict.fromkeys(range(60, END, 60), 0.0)
    outcomes = probed_day(day, hourly, fault_k=fault_k)
    assert [p.code for o in outcomes for p in o.probes].count("probe_during_hold") >= 2
    assert all("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[BEGIN + 2 :])


def again(compensation: Compensation) -> Compensation:
    """Return what goes on from the state of a compensation."""
    restored = Compensation(compensation._config, compensation.model)
    restored.restore(compensation.state())
    return restored


def test_what_probes_during_a_hold_have_shown_reaches_other_models(day: dict[str, np.ndarray]) -> None:
    """In shadow, and without the probes as `adopt` warms up; T_Q is doubted there, too, and right."""
    hourly = {30: 0.0, 90: 0.0, 150: 0.0, 210: 0.0}
    outcomes = probed_day(day, hourly, rate_max=0.5, least_k=0.5)
    probe = Probe(std_um=1.0, measured_max_um=200.0, largest_um=40.0, tolerance_um=3.0)
    channels = [c | {"rate_max_per_min": 0.5} if c["name"] == "t_q_degc" else c for c in CHANNELS]
    conf = msgspec.structs.replace(settings(channel=channels, jump_min_k=0.5), probe=probe)
    shadow, warmed = (Shadow(Compensation(conf, QUILL), b"") for _ in range(2))
    followed = []
    for outcome in outcomes:
        if outcome.sample.seq == 120:
            warmed.compensation = again(warmed.compensation)  # a file begins
        followed.append((shadow.process(outcome)[1], warmed.process(msgspec.structs.replace(outcome, probes=()))[1]))
    for others in zip(*followed, strict=True):
        assert others[140].offset.state == "hold"
        assert {o.offset.state for o in others[155:260]} == {"degraded"}
        assert all("unconfirmed_channel:t_q_degc" in o.offset.reasons for o in others[155:260])
        assert np.max(np.abs(offsets(list(others)) - undisturbed()[:END])[160:260]) < 5.0


def test_a_resume_while_a_model_is_prepared_reaches_it(day: dict[str, np.ndarray]) -> None:
    present, other = (Compensation(settings(), QUILL) for _ in range(2))
    successor = Successor(compensation=other)
    for i in range(BEGIN + 40):
        values = readings(day, i) | {"y_um": math.nan}
        values["t_q_degc"] += 3.0 if i >= BEGIN else 0.0
        if i == BEGIN + 20:
            present.resume()
        successor.follow(present.process(sample(i, values)))
        if i == BEGIN + 19:
            assert present._jumps.suspects == other._jumps.suspects == ("t_q_degc",)
    assert present._jumps.suspects == other._jumps.suspects == ()
    assert other.status.target_um == pytest.approx(present.status.target_um, abs=0.5)


@pytest.mark.parametrize("often", [1, 2])
def test_a_channel_that_returns_is_not_believed_because_the_model_in_force_uses_it(
    day: dict[str, np.ndarray], often: int
) -> None:
    """The other model has seen it jump more often, and waits for longer; what T_Q showed was wrong."""
    present, shadow = Compensation(settings(), QUILL), Shadow(Compensation(settings(), QUILL), b"")
    outcomes, followed = [], []
    for i in range(len(undisturbed())):
        values = readings(day, i) | {"y_um": math.nan}
        values["t_q_degc"] += 8.0 if BEGIN <= i < BEGIN + 40 else 0.0
        outcomes.append(present.process(sample(i, values)))
        followed.append(shadow.process(outcomes[-1])[1])
        if i == BEGIN + 2:
            shadow.compensation._jumps._jump.state.again = {"t_q_degc": often}
    assert outcomes[BEGIN + 43].offset.state == "ok"
    assert "suspect_channel:t_q_degc" in followed[BEGIN + 43].offset.reasons
    assert not is_wrong_in_ok(followed)


def test_a_doubt_that_the_model_in_force_never_had_stays(day: dict[str, np.ndarray]) -> None:
    compensation = Compensation(settings(), QUILL)
    for i in range(BEGIN + 20):
        values = readings(day, i) | {"y_um": math.nan}
        values["t_q_degc"] += 3.0 if i >= BEGIN else 0.0
        compensation.process(sample(i, values))
        compensation.believe_as_in_force([])
    assert compensation._jumps.suspects == ("t_q_degc",)


@pytest.mark.parametrize("samples", [1, 2])
def test_a_zero_as_t_q_comes_back_gives_it_no_other_zero(day: dict[str, np.ndarray], samples: int) -> None:
    outcomes = run(day, steps((BEGIN, "t_q_degc", 8.0), (END, "t_q_degc", 0.0)), zero_at(END + samples))
    assert np.max(np.abs(offsets(outcomes) - undisturbed(zero=END + samples))[END + 15 : END + 150]) < 1.0
    assert {o.offset.state for o in outcomes[END + 15 : END + 150]} == {"ok"}


@pytest.mark.parametrize("size", [8.0, -8.0])
def test_a_rest_at_a_wrong_level_states_what_an_engine_without_t_q_does_not_know(
    day: dict[str, np.ndarray], size: float
) -> None:
    """Both answers come to the same by chance while both are wrong."""
    times = [(BEGIN + 60 * i + j, "t_q_degc", size * (j == 0)) for i in range(2) for j in (0, 20)]
    outcomes = run(day, steps(*times, (BEGIN + 120, "t_q_degc", size)))
    apart = np.abs(offsets(outcomes) - undisturbed())
    stds = np.array([number(o.offset.y_offset_std_um) for o in outcomes])
    told = np.array(
        [o.offset.state == "degraded" and "rate_limited" not in o.offset.reasons for o in outcomes], dtype=bool
    )
    told[: BEGIN + 135] = False
    assert np.any(told)
    assert np.all(apart[told] < 4.0 * stds[told])


def test_a_warm_zero_gives_t_q_another_zero_and_leaves_at_in_question(day: dict[str, np.ndarray]) -> None:
    change = steps((BEGIN, "t_q_degc", 8.0), (BEGIN + 30, "at_degc", -1.6), (END + 30, "at_degc", 0.0))
    outcomes = run(day, change, zero_at(BEGIN + 80))
    assert not is_wrong_in_ok(outcomes, zero=BEGIN + 80)
    after = outcomes[BEGIN + 85 : END + 30]
    assert all("unconfirmed_channel:at_degc" in o.offset.reasons for o in after)
    assert not any("suspect_channel:t_q_degc" in o.offset.reasons for o in after)
    assert np.max(np.abs(offsets(outcomes) - undisturbed(zero=BEGIN + 80))[END + 45 : END + 145]) < 1.5


@pytest.mark.parametrize("t_q", [4.5, -4.0])
def test_what_is_refuted_beside_is_undone_in_the_compensation(day: dict[str, np.ndarray], t_q: float) -> None:
    """T_Q beside a wrong AT looks like heat at first; once it is refuted that heat is gone."""
    outcomes = run(day, steps((BEGIN, "at_degc", 5.0), (BEGIN + 3, "t_q_degc", t_q)))
    suspect = next(i for i, o in enumerate(outcomes) if "suspect_channel:t_q_degc" in o.offset.reasons)
    assert suspect <= BEGIN + 5
    apart = np.abs(offsets(outcomes) - undisturbed())
    assert np.max(apart[suspect + 2 : BEGIN + 12]) < 3.0


def test_measured_y_decides_after_a_warm_zero_as_before_it(day: dict[str, np.ndarray]) -> None:
    outcomes = run(day, steps((BEGIN, "at_degc", -1.8)), zero_at(BEGIN + 5), y=True)
    assert "unconfirmed_channel:at_degc" in outcomes[BEGIN + 4].offset.reasons
    decided = events(outcomes, "jumped")[0]
    assert decided < BEGIN + 60
    apart = np.abs(offsets(outcomes) - offsets(run(day, act=zero_at(BEGIN + 5), y=True)))
    assert apart[decided - 1] > 5.0 and apart[decided + 5] < 3.0


def test_a_zero_is_what_the_compensation_estimated_also_after_a_long_gap(day: dict[str, np.ndarray]) -> None:
    """Its engine bridges fewer samples than the two of the watch."""

    def change(i: int, values: dict[str, float]) -> None:
        if BEGIN - 8 <= i < BEGIN or BEGIN + 10 <= i < BEGIN + 100:
            values["t_q_degc"] = math.nan
        values["t_q_degc"] += 6.0 if BEGIN <= i < END else 0.0

    outcomes = run(day, change, zero_at(BEGIN + 106))
    assert "unconfirmed_channel:t_q_degc" in outcomes[BEGIN + 106].offset.reasons
    assert number(outcomes[BEGIN + 106].estimate.y_pred_um) == pytest.approx(0.0, abs=0.3)
    assert np.max(np.abs(offsets(outcomes) - undisturbed(zero=BEGIN + 106))[END + 20 : END + 120]) < 1.5


DRAWN = 6


def drawn_steps(seed: int) -> tuple[Change, Callable[[int, Compensation], None]]:
    """Steps of both channels, gaps, zeros, pauses and resumes."""
    rng = np.random.default_rng([seed, 10])
    found: Steps = []
    for name in ("t_q_degc", "at_degc"):
        for begin in sorted(rng.integers(20, 230, size=6).tolist()):
            found.append((begin, name, float(rng.choice([0.0, 0.0, math.nan, *rng.uniform(-9.0, 9.0, size=3)]))))
    acts = {int(i): str(rng.choice(["warm", "warm", "pause", "resume", "rest"])) for i in rng.integers(40, 250, size=4)}

    def act(i: int, compensation: Compensation) -> None:
        match acts.get(i):
            case "warm" | "rest" as mode:
                compensation.zero(mode)
            case "pause":
                compensation.pause(3)
            case "resume":
                compensation.resume()

    return steps(*sorted(found)), act


@pytest.mark.parametrize("seed", range(DRAWN))
def test_whatever_happens_the_state_goes_on_to_the_bit(day: dict[str, np.ndarray], seed: int) -> None:
    conf = settings()
    whole, (change, act) = Compensation(conf, QUILL), drawn_steps(seed)
    last, state = math.nan, whole.state()
    for i in range(260):
        values = readings(day, 200 + i)
        change(i, values)
        if seed % 2:
            values["y_um"] = math.nan
        restored = Compensation(conf, QUILL)
        restored.restore(state)
        act(i, whole)
        act(i, restored)
        outcome, again = whole.process(sample(i, values)), restored.process(sample(i, values))
        assert encode(again.offset) == encode(outcome.offset) and again.notes == outcome.notes, i
        state = whole.state()
        assert restored.state() == state, i
        offset = number(outcome.offset.y_offset_um)
        assert not abs(offset - last) > 20.0 + 1e-9
        last = offset


def test_the_deviation_is_the_same_after_a_restart_while_the_second_channel_is_suspect_again(
    day: dict[str, np.ndarray],
) -> None:
    change = steps(
        (BEGIN, "at_degc", 5.0),
        *[(BEGIN + 30 + 2 * i, "t_q_degc", k) for i, k in enumerate((-4.5, -7.0, -4.5, -8.0, -5.0, -7.5, -4.5))],
        (BEGIN + 160, "t_q_degc", -8.0),
    )

    def restarted(i: int, compensation: Compensation) -> None:
        if BEGIN < i < BEGIN + 240:
            compensation.restore(compensation.state())

    live, again = run(day, change), run(day, change, restarted)
    assert [encode(o.offset) for o in live] == [encode(o.offset) for o in again]


def broken(state: bytes, path: tuple[str | int, ...], value: Any) -> bytes:
    table = json.loads(state)
    inner = table
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return json.dumps(table).encode()


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("jumps", "beside", "believing", "engine", "observer", "x"), None),
        (("jumps", "phase"), "none"),
        (("jumps", "beside", "jumps"), {"y_um": {"size_k": 1.0, "std_k": 1.0, "first_k": 1.0}}),
        (("memory", "estimate", "outputs"), [{"value": 1.0, "std": 1.0, "rate_per_min": 0.0}]),
        (("jumps", "shifted", "estimate", "outputs"), [{"value": 1.0, "std": 1.0, "rate_per_min": 0.0}]),
        (("jumps", "shifted", "engine", "reference", "t_q_degc"), "nan"),
        (("jumps", "beside", "believing", "engine", "observer", "p", 0), -5.0),
        (("jumps", "ratio"), "nan"),
        (("jumps", "again"), {"t_q_degc": -4}),
        (("jumps", "last"), {}),
    ],
)
def test_a_broken_state_is_refused_and_changes_nothing(
    day: dict[str, np.ndarray], path: tuple[str | int, ...], value: Any
) -> None:
    compensation = Compensation(settings(), QUILL)
    change = steps((50, "t_q_degc", 8.0), (60, "at_degc", 1.6))
    for i in range(90):
        values = readings(day, 200 + i) | {"y_um": math.nan}
        change(i, values)
        compensation.process(sample(i, values))
    state = compensation.state()
    if value is None:
        value = ["inf"] * len(json.loads(state)["jumps"]["beside"]["believing"]["engine"]["observer"]["x"])
    fresh = Compensation(settings(), QUILL)
    before = fresh.state()
    with pytest.raises(DataError, match=r"^state: "):
        fresh.restore(broken(state, path, value))
    assert fresh.state() == before
    fresh.restore(state)
    assert fresh.state() == state
