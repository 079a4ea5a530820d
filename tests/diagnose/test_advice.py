"""Advice: what is hidden and near what it sits, which test decides, and what was seen only once."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from compensator.diagnose.advice.advice import Unexplained, _sensor, advice_of, resembling
from compensator.diagnose.advice.deciding import DECIDES, Deciding
from compensator.diagnose.advice.nearest import Near, nearest
from compensator.diagnose.advice.record_with_test import HOURS as HOURS_OF_TESTS
from compensator.diagnose.advice.record_with_test import expected_change
from compensator.diagnose.advice.switched import follows_day, goes_with, steepest, swings, switched
from compensator.diagnose.advice.trials import LEVEL_H, REST_H, Trials
from compensator.diagnose.diagnosis import diagnose
from compensator.diagnose.fitting.fit import fit_terms, settled
from compensator.diagnose.fitting.likelihood import Likelihood
from compensator.diagnose.fitting.points import Points
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.findings import findings_of
from compensator.diagnose.words.summary import contents, figures
from compensator.diagnose.words.warning_words import warnings_on
from compensator.display import Words
from compensator.model.model_file import load_model
from compensator.report.diagnosis import page_of
from tests.diagnose.scenarios import Scenario, chosen, lag, record, signals
from tests.identify.quill_runs import runs_from

QUILL = load_model("quill")
HOURS = 24.0


def machine(act, seed, hours=HOURS, **changed):
    """Columns of a day on which something acts on Y, with some columns replaced."""
    columns, _, _ = record([Scenario(place=(), act=act)], seed, hours)
    return columns | changed


def advised(columns):
    """What was found, and the advice for it."""
    found = findings_of(evidence_of(QUILL, runs_from(columns)))
    deciding = Deciding(Trials(found.search.evidence))
    return found, advice_of(found, deciding, between_rivals=[], explained_pct=None, is_explained=True)


# ---------------------------------------------------------------------- a source that no channel shows


@pytest.fixture(scope="module")
def door():
    """Each time the coolant is switched, a source changes by its own amount, which no channel shows."""
    flow = signals(31, HOURS)[1]["coolant_flow_lpm"]
    times = switched(flow, 1.0).astype(int)[::2]
    levels = np.zeros(flow.size)
    sizes = np.random.default_rng(3).uniform(3.0, 6.0, times.size) * (-1.0) ** np.arange(times.size)
    for at, size in zip(times.tolist(), np.cumsum(sizes).tolist(), strict=True):
        levels[at:] = size
    columns = machine(lambda s: lag(levels, 12.0), 31)
    logged = ("t_q_degc", "at_degc", "y_um", "coolant_flow_lpm", "spindle_rpm", "fan_rpm")
    return times, diagnose(QUILL, runs_from({name: columns[name] for name in logged}))


def test_an_unobserved_source_is_tied_to_the_event_it_goes_with(door):
    times, found = door
    assert found.verdict == "unexplained" and len(times) >= 4
    hidden = found.advice.unexplained
    assert hidden.kind == "unobserved"
    assert hidden.goes_with.event == "coolant_flow_lpm"
    assert hidden.tau_min == pytest.approx(12.0, rel=0.3)
    assert hidden.times[0][1] == pytest.approx(times[0] / 60.0, abs=0.1)
    assert hidden.rms_um == pytest.approx(float(np.std(found.effects[0].signal)), rel=1e-6)


def test_the_test_repeats_that_event_and_a_sensor_would_decide(door):
    test = door[1].advice.tests[0]
    assert test.driver == "coolant_flow_lpm" and test.decides and test.hours <= 4.0
    assert door[1].advice.unexplained.sensor_evidence > 10.0 * DECIDES


def test_the_advice_is_in_the_file_on_the_terminal_and_on_the_page(door):
    found = door[1]
    table = json.loads(json.dumps(figures(found)))["advice"]
    assert table["unexplained"]["goes_with"]["event"] == "coolant_flow_lpm"
    assert {when["run"] for when in table["unexplained"]["when"]} == set(found.series()["run"]), "as in series.csv"
    assert table["tests"][0]["decides"] is True and table["sensor"]
    said = [
        part for part in contents(found, ()) if isinstance(part, Words) and part.title.startswith("What to measure")
    ]
    assert len(said) == 1 and 3 <= len(said[0].lines) <= 6
    assert "coincides with the switching of coolant_flow_lpm" in said[0].lines[0]
    titles = [getattr(block, "title", "") for block in page_of(found, found.model, ()).blocks]
    assert "What to measure and test next" in titles


def test_times_that_meet_a_channel_by_chance_do_not_go_with_it():
    evidence = evidence_of(QUILL, runs_from(machine(lambda s: np.zeros(s[0]), 31)))
    away = switched(evidence.signals[0].channels["coolant_flow_lpm"], 1.0)
    assert goes_with(evidence, [(0, at) for at in away], 3.0).event == "coolant_flow_lpm"
    other = np.random.default_rng(0).uniform(0.0, HOURS * 60.0, 12)
    assert goes_with(evidence, [(0, at) for at in other], 3.0) is None


def test_a_course_follows_the_day_only_where_the_record_shows_days():
    long = evidence_of(QUILL, runs_from(machine(lambda s: np.zeros(s[0]), 31, 48.0)))
    minutes = long.signals[0].minutes
    assert follows_day(long, np.sin(2.0 * np.pi * minutes / 1440.0 + 1.0))
    assert not follows_day(long, np.sin(2.0 * np.pi * minutes / 500.0))
    short = evidence_of(QUILL, runs_from(machine(lambda s: np.zeros(s[0]), 31, 24.0)))
    assert not follows_day(short, np.sin(2.0 * np.pi * short.signals[0].minutes / 1440.0))


def test_what_nothing_explains_moves_where_y_does_and_not_at_the_edges_of_its_holes():
    """A slow walk, far from its mean where a door is open for half an hour and Y is missing."""
    n, door = int(HOURS * 60), np.zeros(int(HOURS * 60))
    for begin in range(200, n - 60, 240):
        door[begin : begin + 30] = 1.0
    walk = np.cumsum(np.random.default_rng(1).normal(0.0, 0.25, n))
    columns = machine(lambda s: walk, 7)
    columns = {name: columns[name] for name in ("t_q_degc", "at_degc")} | {
        "y_um": np.where(door, np.nan, columns["y_um"]),
        "door": door,
    }
    found = findings_of(evidence_of(QUILL, runs_from(columns)))
    deciding = Deciding(Trials(found.search.evidence))
    left = advice_of(found, deciding, between_rivals=[], explained_pct=None, is_explained=False).unexplained
    assert left.kind == "residual" and left.goes_with is None and len(left.times) >= 3
    edges = np.flatnonzero(np.diff(door)) / 60.0
    near = [np.min(np.abs(edges - hour)) < 0.14 for _, hour in left.times]
    assert np.mean(near) < 0.25, "by chance 15 %"


def test_a_course_known_now_and_then_moves_between_its_values():
    evidence = evidence_of(QUILL, runs_from(machine(lambda s: np.zeros(s[0]), 31)))
    course = np.full(int(HOURS * 60), np.nan)
    course[59::60] = 50.0
    course[59 + 60 * 14 :: 60] = 30.0
    assert steepest(evidence, course, 12) == [(0, 59.0 + 60.0 * 13.5)]


def test_swings_count_ups_and_downs_and_no_noise():
    rng = np.random.default_rng(0)
    assert swings(np.repeat([0.0, 1.0, 0.0, 1.0], 50) + rng.normal(0.0, 0.05, 200)) == 3


# ---------------------------------------------------------------------- the hidden channel's neighbour


@pytest.mark.parametrize("seed", [1, 3])
def test_the_neighbour_of_a_hidden_channel_comes_nearest(seed):
    """A heat of its own warms one place: a sensor there is not logged, one beside it and one far from it are."""
    rng = np.random.default_rng(seed)
    n = int(HOURS * 60)
    source = np.repeat(rng.uniform(0.0, 10.0, n // 90 + 1), 90)[:n]
    other = np.repeat(rng.uniform(0.0, 10.0, n // 70 + 1), 70)[:n]
    beside = lag(source, 25.0) + 0.3 * lag(other, 20.0) + rng.normal(0.0, 0.02, n)
    far = 0.5 * lag(source, 200.0) + lag(other, 40.0) + rng.normal(0.0, 0.02, n)
    columns = machine(lambda s: 0.8 * lag(lag(source, 15.0), 10.0), 40 + seed, housing_degc=beside, column_degc=far)
    found, advice = advised(columns)
    assert advice.nearest[0].channel == "housing_degc"
    assert advice.nearest[0].evidence > advice.nearest[1].evidence + DECIDES if advice.nearest[1:] else True
    assert nearest(found.selection.fit, found.selection.before.rest)[0] == advice.nearest[0]
    assert resembling(advice.nearest)[0].channel == "housing_degc"


def test_a_channel_resembles_only_by_more_than_chance():
    above, below = (Near(channel="at_degc", evidence=30.0, lag_min=0.0, by_chance=by) for by in (20.0, 28.0))
    assert resembling([above, below]) == [above]


def test_where_nothing_is_hidden_no_sensor_is_advised():
    columns = machine(lambda s: 3.0 * lag(s[1]["coolant_degc"], 30.0), 50)
    _, advice = advised(columns)
    assert advice.unexplained is None and advice.sensor == ""
    assert advice.nearest[0].channel == "coolant_degc"


# ---------------------------------------------------------------------- the test that decides


def test_the_expected_change_is_that_of_the_whole_covariance():
    rng = np.random.default_rng(1)
    d, table = rng.normal(size=20), rng.normal(size=(20, 3))
    root = rng.normal(size=(3, 5))
    precision = np.eye(3) + root @ root.T
    wanted = [
        0.5 * d[:k] @ np.linalg.solve(np.eye(k) + table[:k] @ np.linalg.solve(precision, table[:k].T), d[:k])
        for k in (7, 20)
    ]
    assert expected_change(d, table, precision, np.array([7, 20])) == pytest.approx(wanted)


def test_in_a_test_temperatures_follow_what_they_followed_in_the_record():
    n = int(HOURS * 60)
    heat = signals(5, HOURS)[2]
    rng = np.random.default_rng(2)
    columns = machine(lambda s: np.zeros(s[0]), 5, housing_degc=20.0 + 0.1 * lag(heat, 40.0) + rng.normal(0.0, 0.02, n))
    trials = Trials(evidence_of(QUILL, runs_from(columns)))
    first = {trial.driver: trial for trial in reversed(list(trials.of(("coolant_degc", "housing_degc"))))}
    step = trials.size("heat")
    heated, cooled = first["heat"].signals, first["coolant_degc"].signals
    assert heated.drive[-1] == pytest.approx(step) and heated.drive[30] == 0.0
    assert np.ptp(heated.channels["housing_degc"]) == pytest.approx(0.1 * step, rel=0.1)
    half = np.interp(0.05 * step, heated.channels["housing_degc"] - heated.channels["housing_degc"][0], heated.minutes)
    assert half - 60.0 == pytest.approx(40.0 * np.log(2.0), abs=6.0)
    assert np.ptp(cooled.channels["housing_degc"]) == 0.0 and not cooled.drive.any()
    assert abs(np.ptp(cooled.channels["coolant_degc"])) == pytest.approx(abs(trials.size("coolant_degc")))
    assert first["housing_degc"].by_itself and not first["coolant_degc"].by_itself


@pytest.fixture(scope="module")
def twins():
    """Coolant and cabinet move together in the record; the coolant acts."""

    def act(s):
        return 1.5 * lag(s[1]["coolant_degc"], 30.0)

    columns = machine(act, 5)
    rng = np.random.default_rng(5)
    columns["cabinet_degc"] = (
        22.0 + 0.8 * (columns["coolant_degc"] - 20.0) + rng.normal(0.0, 0.02, columns["y_um"].size)
    )
    logged = ("t_q_degc", "at_degc", "y_um", "coolant_degc", "cabinet_degc", "fan_rpm")
    columns = {name: columns[name] for name in logged}
    return columns, diagnose(QUILL, runs_from(columns))


def test_channels_that_move_together_are_told_apart_by_moving_one(twins):
    effect = twins[1].effects[0]
    rival = next(
        r for r in effect.rivals if {r.term.hypothesis.place[2], effect.channel} == {"coolant_degc", "cabinet_degc"}
    )
    assert rival.test.decides and rival.test.driver in ("coolant_degc", "cabinet_degc")
    # A temperature is no input that could be stepped.
    assert rival.how_to_tell_apart.startswith((f"Warm {rival.test.driver}", f"Cool {rival.test.driver}"))
    assert rival.test in twins[1].advice.tests


def test_the_test_that_is_said_to_decide_decides_when_it_is_run(twins):
    columns, found = twins
    effect = found.effects[0]
    rival = effect.rivals[0]
    trial = next(t for t in Trials(found.evidence).of((rival.test.driver,)) if t.words == rival.test.words)
    count = round(rival.test.hours * 60.0) + 1
    tried = [as_measured(trial.signals, columns, count, seed) for seed in (6, 7, 8, 9)]
    gained = []
    starts = [
        next(term for term in (effect.term, rival.term) if name in term.hypothesis.place).start
        for name in ("coolant_degc", "cabinet_degc")
    ]
    for runs in (runs_from(columns), *([*runs_from(columns), *runs_from(run)] for run in tried)):
        points = Points(evidence_of(QUILL, runs))
        likelihood = settled(fit_terms(Likelihood(points, points.typical_rest()), [starts[0]])).likelihood
        coolant, cabinet = (fit_terms(likelihood, [start]) for start in starts)
        gained.append(coolant.log_evidence - cabinet.log_evidence)
    changes = np.array(gained[1:]) - gained[0]
    assert changes.min() > DECIDES, changes
    assert 0.3 < changes.mean() / rival.test.expected_evidence < 3.0, changes


def as_measured(planned, columns, count, seed):
    """The run that a planned test gives on the true machine, with noise."""
    rng = np.random.default_rng(seed)
    coolant = planned.channels["coolant_degc"]
    y = planned.y_dtf_um + planned.y_tdtf_um + 1.5 * lag(coolant, 30.0) + rng.normal(0.0, 0.3, coolant.size)
    difference = QUILL.ttf.sampled.response(planned.drive)
    at = columns["at_degc"][0] + planned.ambient_k
    table = {"t_q_degc": at + difference, "at_degc": at}
    table = {name: values + rng.normal(0.0, 0.02, values.size) for name, values in table.items()}
    return {name: values[:count] for name, values in (table | {"y_um": y} | dict(planned.channels)).items()}


def test_a_test_names_no_level_that_it_does_not_reach():
    trials = Trials(evidence_of(QUILL, runs_from(machine(lambda s: np.zeros(s[0]), 31))))
    several = [trial for trial in trials.of(["coolant_flow_lpm"]) if trial.first_level]
    assert len(several) >= 4
    for trial in several:
        first, later = trial.words_of(REST_H + LEVEL_H), trial.words_of(REST_H + LEVEL_H + 1.0)
        assert "hold it" in first and "every" not in first and "each" not in first
        assert later == trial.words and ("every 2 h" in later or "2 h each" in later)


def test_a_switch_without_a_unit_is_stepped_without_one():
    flow = signals(31, HOURS)[1]["coolant_flow_lpm"]
    columns = machine(lambda s: np.zeros(s[0]), 31, fan_on=(flow > 1.0) * 1.0)
    trials = Trials(evidence_of(QUILL, runs_from(columns)))
    [step] = [
        trial for trial in trials.of(["fan_on"]) if trial.words.startswith("Step fan_on") and "half" not in trial.words
    ]
    assert step.words in (
        "Step fan_on by 1 and hold it, all else steady",
        "Step fan_on by −1 and hold it, all else steady",
    )


@pytest.fixture(scope="module")
def begun_at_speed():
    """Tests of a machine whose record begins at its highest speed, with the fan on, the floor on its own."""
    n, rng = int(HOURS * 60), np.random.default_rng(4)
    speed = np.repeat(rng.choice([0.0, 3000.0, 6000.0], n // 60), 60)
    speed[:60] = 6000.0
    fan, floor = np.repeat([1.0, 0.0, 1.0], n // 3), 20.0 + np.repeat(rng.normal(0.0, 1.0, n // 120), 120)
    changed = {"spindle_rpm": speed, "fan_on": fan, "floor_degc": floor + rng.normal(0.0, 0.02, n)}
    return Trials(evidence_of(QUILL, runs_from(machine(lambda s: np.zeros(s[0]), 31, **changed))))


@pytest.mark.parametrize(("channel", "size"), [("spindle_rpm", 6000.0), ("fan_on", 1.0)])
def test_a_test_begins_at_rest_although_its_record_began_at_speed(begun_at_speed, channel, size):
    trials = [trial for trial in begun_at_speed.of([channel]) if trial.driver == channel]
    assert begun_at_speed.size(channel) == size and trials
    for trial in trials:
        assert trial.signals.channels[channel][0] == 0.0 and trial.signals.channels[channel].max() == size
        assert "−" not in trial.words


def test_a_temperature_is_warmed_or_cooled_and_not_stepped(begun_at_speed):
    trials = [trial for trial in begun_at_speed.of(["floor_degc"]) if trial.driver == "floor_degc"]
    assert trials and all(trial.words.startswith(("Warm floor_degc", "Cool floor_degc")) for trial in trials)


def test_a_test_between_two_causes_moves_one_of_them(begun_at_speed):
    def movers(*places):
        return set(Deciding(begun_at_speed)._movers(*(SimpleNamespace(places=frozenset([one])) for one in places)))

    drift, floor, fan = ("drift", "", ""), ("input", "", "floor_degc"), ("input", "", "fan_on")
    assert movers(drift, floor) == {"", "floor_degc"}
    assert movers(floor, fan) == {"floor_degc", "fan_on"}
    assert movers(("gain", "TDTF", ""), fan) == {"at_degc", "fan_on"}
    assert movers(drift, ("step", "", "")) == set()  # anything may


def test_a_test_of_a_channel_is_long_enough_to_move_it(begun_at_speed):
    change = np.full(len(HOURS_OF_TESTS), 10.0 * DECIDES)
    hours = {
        trial.words: Deciding._test(trial, change, ("input fan_on", "nothing"), 0.0).hours
        for trial in begun_at_speed.of(["fan_on"])
        if trial.driver == "fan_on"
    }
    assert any("while" in words for words in hours)
    for words, length in hours.items():
        assert (length > REST_H + LEVEL_H) == ("while" in words)


def test_a_source_that_no_channel_shows_is_no_reason_to_record_for_longer():
    def codes(*, observed):
        effect = SimpleNamespace(
            effect=SimpleNamespace(observed=observed),
            term=SimpleNamespace(effect=SimpleNamespace(counts_from_rest=False)),
            place=("unobserved", "", ""),
            named={},
            hardly_determined=[],
            rivals=(),
            reverses_path=False,
        )
        return [remark.code for remark in warnings_on(chosen((effect,), left=2.0), deployed=False)]

    assert codes(observed=False) == [] and codes(observed=True) == ["made_worse"]


@pytest.mark.parametrize(
    ("channel", "words"), [("fan_rpm", "before fan_rpm changes"), ("oil_degc", "oil_degc follows")]
)
def test_what_is_commanded_follows_no_source(channel, words):
    hidden = Unexplained(
        kind="residual", rms_um=1.0, peak_to_peak_um=3.0, tau_min=40.0, times=(), goes_with=None, sensor_evidence=20.0
    )
    assert words in _sensor(hidden, [Near(channel=channel, evidence=2.0 * DECIDES, lag_min=-12.0)])


# ---------------------------------------------------------------------- seen once


def once(heats):
    """A machine that is heated some times, with a gain of the DTF that is 15 % too small."""
    n = 24 * 60
    heat = np.zeros(n)
    for k in range(heats):
        heat[60 + k * n // heats : 60 + k * n // heats + n // heats // 2] = 90.0
    rng = np.random.default_rng(9)
    y = 1.15 * QUILL.dtf.sampled.response(heat) + rng.normal(0.0, 0.3, n)
    difference = QUILL.ttf.sampled.response(heat) + rng.normal(0.0, 0.02, n)
    at = 20.0 + 0.3 * np.sin(2.0 * np.pi * np.arange(n) / 700.0) + rng.normal(0.0, 0.02, n)
    y += QUILL.tdtf.sampled.response(0.3 * np.sin(2.0 * np.pi * np.arange(n) / 700.0))
    return {"t_q_degc": at + difference, "at_degc": at, "y_um": y}


def test_an_effect_of_one_heating_is_said_to_be_seen_once():
    found, advice = advised(once(1))
    assert [t.hypothesis.place for t in found.terms] == [("gain", "DTF", "")]
    assert [seen.driver for seen in advice.seen_once] == ["heat"]
    assert advice.seen_once[0].test.driver == "heat" and advice.seen_once[0].test.decides


def test_an_effect_of_several_heatings_is_not():
    found, advice = advised(once(4))
    assert [t.hypothesis.place for t in found.terms] == [("gain", "DTF", "")]
    assert advice.seen_once == ()


def test_what_needs_no_advice_has_none():
    found = diagnose(QUILL, runs_from(machine(lambda s: np.zeros(s[0]), 60, 14.0)))
    assert found.verdict == "adequate" and found.advice is None
    assert figures(found)["advice"] is None


def test_a_test_has_what_an_effect_needs_although_it_stayed_as_it_was():
    """The fluid of a flow may be a channel that nothing moves: it is no channel to look for."""
    n = int(HOURS * 60)
    evidence = evidence_of(QUILL, runs_from(machine(lambda s: np.zeros(s[0]), 31, floor_degc=np.full(n, 21.5))))
    assert "floor_degc" not in evidence.context.channels
    trials = Trials(evidence)
    assert all(np.all(trial.signals.channels["floor_degc"] == 21.5) for trial in trials.of(["coolant_flow_lpm"]))
