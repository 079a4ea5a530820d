"""The search names kind and place of an effect that it is not given, and what it adds holds on another day."""

import dataclasses

import numpy as np
import pytest

from compensator.diagnose import diagnosis as diagnosis_module
from compensator.diagnose.choice import deployment as deployment_module
from compensator.diagnose.diagnosis import diagnose
from compensator.diagnose.fitting.fit import Term, fit_terms
from compensator.diagnose.fitting.likelihood import Likelihood
from compensator.diagnose.fitting.points import Points
from compensator.diagnose.fitting.standard_errors import deviations, standard_errors
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.search import Search
from compensator.diagnose.words.summary import figures, verdict
from compensator.display import is_determined
from compensator.identify.calibration import predict
from compensator.model.effects.hypothesis import proposals
from compensator.model.model_file import load_model
from compensator.report.diagnosis import tone_of
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from sim_hardware.physics.effects.mechanical import StickSlip
from tests.diagnose.scenarios import KINDS, Scenario, draw, mistimed, record
from tests.identify.quill_runs import runs_from

QUILL = load_model("quill")
#: Kinds that are diagnosed to the end: what is deployed, and what is not, is asked about as well.
DEPLOYED, NOT_DEPLOYED = ("input", "gain TDTF", "missing mode", "play"), ("drift", "step", "periodic", "unobserved")


def logged(columns):
    """Columns for a diagnosis to the end: each further channel is searched four times. Searches alone have them all."""
    return {name: columns[name] for name in ("t_q_degc", "at_degc", "y_um", "coolant_degc", "spindle_rpm")}


def search(scenarios, seed, hours=24.0, **noise):
    columns, _, _ = record(scenarios, seed, hours, **noise)
    return Search(evidence_of(QUILL, runs_from(columns))).run().fit.terms


def named(scenarios, seed, hours=24.0, **noise):
    return sorted(term.hypothesis.place for term in search(scenarios, seed, hours, **noise))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in DEPLOYED + NOT_DEPLOYED])
def test_one_effect_is_named_and_no_second_invented(kind):
    scenario = draw(kind, 100)
    assert named([scenario], 1100) == ([scenario.place] if scenario.place else [])


@pytest.mark.parametrize("factor", [0.85, 1.06, 1.24])
def test_a_time_constant_that_changed_a_little_is_found(factor):
    """Its response grows with the change, which no amplitude takes up: far from it a search does not begin."""
    (term,) = search([mistimed(factor)], 1300)
    assert term.hypothesis.place == ("dynamics", "DTF", "")
    assert term.named["tau_min"] == pytest.approx(20.92 * factor, rel=0.03)


@pytest.mark.parametrize("at", [707, 1001])
def test_a_large_step_is_found_at_its_sample(at):
    """Beside it a search of its time ends where it begins, and a source switched on and off again looks better."""
    jumped = Scenario(place=("step", "", ""), act=lambda signals: -25.0 * (np.arange(signals[0]) >= at))
    (term,) = search([jumped], 1301, noise_um=0.1)
    assert term.hypothesis.place == ("step", "", "") and term.named["at_min"] == pytest.approx(at, abs=0.5)


@pytest.mark.parametrize("pair", [("input", "step"), ("gain DTF", "drift"), ("play", "input")])
def test_two_effects_at_once(pair):
    scenarios = [draw(kind, 21) for kind in pair]
    assert named(scenarios, 1121) == sorted(s.place for s in scenarios)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_added_to_data_without_an_effect(seed):
    assert named([], 1200 + seed, hours=24.0 + 12.0 * seed, noise_k=0.04, noise_um=0.15) == []


@pytest.mark.parametrize("kind", DEPLOYED)
def test_the_extended_model_removes_the_error_on_a_fresh_day(kind):
    scenario = draw(kind, 7)
    columns, _, _ = record([scenario], 1007, 18.0)
    diagnosis = diagnose(QUILL, runs_from(logged(columns)))
    assert [e.place for e in diagnosis.effects] == [scenario.place]
    fresh, true, effect = record([scenario], 5007, 24.0)
    run = runs_from(fresh)[0]

    def error(model, y):
        e = y - predict(model, run)
        return float(np.mean((e - e.mean()) ** 2))

    possible = error(QUILL, true) - error(QUILL, true - effect)
    assert error(QUILL, true) - error(diagnosis.model, true) > 0.97 * possible
    assert diagnosis.verdict == "explained"
    assert diagnosis.after.rms_um < 0.5 * diagnosis.before.rms_um
    assert diagnosis.effects[0].rms_after_um < 1.3 * diagnosis.noise_floor_um


@pytest.mark.parametrize("kind", NOT_DEPLOYED)
def test_what_cannot_be_deployed_is_explained_and_left_out(kind):
    scenario = draw(kind, 8)
    columns, _, _ = record([scenario], 1008, 18.0)
    diagnosis = diagnose(QUILL, runs_from(logged(columns)))
    assert [e.place for e in diagnosis.effects] == [scenario.place]
    assert not diagnosis.effects[0].deployable
    assert diagnosis.model.effects == ()
    assert len(diagnosis.effects[0].explanation.split()) > 12
    assert diagnosis.verdict == ("unexplained" if kind == "unobserved" else "explained")


def test_rough_data_hides_nothing_and_invents_nothing():
    columns, _, _ = record([draw("gain DTF", 3)], 1003)
    rng = np.random.default_rng(0)
    n = columns["y_um"].size
    columns["t_q_degc"] += 0.3
    for name in ("t_q_degc", "at_degc"):
        columns[name] = np.round(columns[name] / 0.02) * 0.02
    for name in ("t_q_degc", "at_degc", "y_um"):
        columns[name][rng.integers(100, n, 6)] = np.nan
    columns["y_um"][rng.integers(100, n, 4)] += 40.0
    found = Search(evidence_of(QUILL, runs_from(columns))).run()
    assert [term.hypothesis.place for term in found.fit.terms] == [("gain", "DTF", "")]


def test_physics_of_another_hand():
    duty = Duty.working_day(41, hours=30.0)
    sensors = usual_sensors(duty.extra_names, temperature_noise_k=0.1, y_noise_um=2.0)
    columns = World(PublishedQuill(effects=[StickSlip(play_um=6.0)]), duty, sensors, 5).record(60.0)
    columns.pop("t_s")
    (term,) = Search(evidence_of(QUILL, runs_from(columns))).run().fit.terms
    assert term.hypothesis.place == ("hysteresis", "DTF", "")
    assert term.named["half_width_um"] == pytest.approx(3.0, rel=0.1)


def test_standard_errors_are_what_scatters():
    scenario = draw("gain DTF", 5)
    values, stds = [], []
    for noise in range(14):
        columns, _, _ = record([scenario], 1305, 24.0)
        rng = np.random.default_rng(noise)
        columns["y_um"] = columns["y_um"] + rng.normal(0.0, 1.0, columns["y_um"].size)
        evidence = evidence_of(QUILL, runs_from(columns))
        hypothesis = next(h for h in proposals(evidence.context) if h.place == ("gain", "DTF", ""))
        points = Points(evidence)
        fit = fit_terms(Likelihood(points, points.typical_rest()), [(hypothesis, ())])
        values.append(fit.terms[0].amplitudes[0])
        stds.append(standard_errors(fit)[0]["change"])
    assert 0.5 * np.std(values) < np.mean(stds) < 2.0 * np.std(values)


def test_of_two_equal_lags_the_sum_is_stated():
    """Each gain by itself is anything; what the channel does at rest is known, and comes first."""
    columns, _, _ = record([draw("input", 3, 4.0)], 70, 24.0)
    evidence = evidence_of(QUILL, runs_from(columns))
    place = Search(evidence).run().fit.terms[0].hypothesis.place
    of_channel = {h.form: h for h in proposals(evidence.context) if h.place == place}
    one_lag, two = of_channel["lag"], of_channel["two lags"]
    points = Points(evidence)
    fit = fit_terms(Likelihood(points, points.typical_rest()), [(one_lag, (30.0,))])
    (one,) = fit.terms
    (tau,) = one.values
    term = Term(
        hypothesis=two, values=(tau, 1.001 * tau), amplitudes=(3.0 * one.amplitudes[0], -2.0 * one.amplitudes[0])
    )
    (error,) = standard_errors(dataclasses.replace(fit, terms=(term,)))
    gain, first, second = (name for name in term.named if name.startswith("gain_"))
    assert next(iter(term.named)) == gain and term.named[gain] == pytest.approx(one.amplitudes[0])
    assert not is_determined(term.named[first], error[first]) and not is_determined(term.named[second], error[second])
    assert error[gain] < 0.1 * abs(term.named[gain])


def test_what_makes_data_worse_that_was_not_seen_is_no_explanation(monkeypatch):
    """However well it fits: the verdict must not say found, and the model is left as it was."""
    columns, _, _ = record([draw("gain DTF", 3)], 77, hours=14.0)
    results = {}

    def once(name):
        """Do it once for all diagnoses: they differ only in what is made of the errors."""
        original = getattr(diagnosis_module, name)

        def first(*arguments):
            if name not in results:
                results[name] = original(*arguments)
            return results[name]

        monkeypatch.setattr(diagnosis_module, name, first)
        return first

    once("findings_of")
    held_out = once("held_out_of")
    good = diagnose(QUILL, runs_from(columns))
    assert good.verdict == "explained" and good.model.effects and "were found" in verdict(figures(good))

    def worse(*arguments):
        errors = held_out(*arguments)
        wrong = times * errors.nothing
        return dataclasses.replace(errors, named=wrong, whole=wrong, ceiling=wrong)

    times = 1.5

    monkeypatch.setattr(diagnosis_module, "held_out_of", worse)
    # Each block may hold an event of its own: then it is deployed, and said.
    unsure = diagnose(QUILL, runs_from(columns))
    assert unsure.verdict == "partly_explained" and unsure.model.effects
    assert "not_confirmed" in [warning.code for warning in unsure.warnings]
    assert "The missing effects were found" not in verdict(figures(unsure))
    times = 2.6
    bad = diagnose(QUILL, runs_from(columns))
    assert bad.verdict == "partly_explained" and not bad.model.effects
    assert "made_worse" in [warning.code for warning in bad.warnings]
    assert not any(effect.deployable for effect in bad.effects) and bad.after == bad.before
    assert bad.refused.why == "held-out blocks contradict what was found" and bad.found.rms_um > bad.before.rms_um
    assert "increases the error on held-out data" in verdict(figures(bad)) and "were found" not in verdict(figures(bad))
    # The same where its own data contradict what would be deployed, in free run.
    times = 0.1
    monkeypatch.setattr(deployment_module, "in_free_run", lambda _: (1.0, 1.3))
    bad = diagnose(QUILL, runs_from(columns))
    assert bad.verdict == "partly_explained" and tone_of(figures(bad)) == "warn"
    assert not bad.model.effects and "worse_in_free_run" in [warning.code for warning in bad.warnings]
    assert not any(effect.deployable for effect in bad.effects) and bad.after == bad.before
    assert "in free run over the same data" in verdict(figures(bad))


def test_two_effects_that_are_known_only_together_are_not_known_apart():
    """Two channels that hardly differ share an effect in any way: together it is known, each by itself is not."""
    columns, _, _ = record([draw("input", 3, 4.0)], 70, 24.0)
    inputs = [name for name in columns if name not in ("t_q_degc", "at_degc", "y_um", "t_s")]
    rng = np.random.default_rng(1)
    columns["twin_degc"] = columns["coolant_degc"] + 0.02 * np.cumsum(rng.normal(size=columns["y_um"].size)) / 30.0
    evidence = evidence_of(QUILL, runs_from(columns))
    points = Points(evidence)
    found = {
        name: next(h for h in proposals(evidence.context) if h.place == ("input", "", name) and h.form == "lag")
        for name in ("coolant_degc", "twin_degc")
    }
    assert "coolant_degc" in inputs
    likelihood = Likelihood(points, points.typical_rest())
    start = (30.0,)
    one = fit_terms(likelihood, [(found["coolant_degc"], start)])
    both = fit_terms(likelihood, [(found["coolant_degc"], start), (found["twin_degc"], start)])
    [(size, std)] = deviations(one)
    assert std < 0.2 * size
    assert all(std > 3.0 * deviations(one)[0][1] for _, std in deviations(both))


def test_the_end_of_a_record_is_no_second_effect():
    """The heat is switched minutes before the end: T_Q, which is late, does not show it any more."""
    late = draw("late sensor", 3)
    columns, _, _ = record([late], 1003, 24.0)
    columns["y_um"][-4:] -= [8.0, 12.0, 16.0, 20.0]
    terms = Search(evidence_of(QUILL, runs_from(columns))).run().fit.terms
    assert [term.hypothesis.place for term in terms] == [late.place]


def test_an_effect_is_exchanged_for_another_form_of_itself():
    """A lag alone comes first, and what it leaves would have another name; with its dead time nothing is left."""
    terms = search([draw("input delay", 2)], 1002, 36.0, noise_k=0.0178, noise_um=0.254)
    assert [(term.hypothesis.place, term.hypothesis.form) for term in terms] == [
        (("input", "", "fan_rpm"), "lag and delay")
    ]


@pytest.mark.parametrize(("own_um", "share", "is_named"), [(0.6, 0.25, False), (0.6, 0.6, True), (None, 0.25, True)])
def test_a_delay_alone_beside_an_error_of_timing_removes_at_least_half(own_um, share, is_named):
    """A quarter of a dead time removes 1 − 0.75² of the mean square: the calibration may miss as much by itself."""
    columns, _, _ = record([draw("late path", 4)], 80, 12.0)
    base = dataclasses.replace(QUILL, held_out_rms_um=own_um)
    search = Search(evidence_of(base, runs_from(columns)))
    selection = search.run()
    (term,) = selection.fit.terms
    assert term.hypothesis.place == ("delay", "DTF", "")
    less = dataclasses.replace(term, values=tuple(share * value for value in term.values))
    fit = dataclasses.replace(selection.fit, terms=(less,))
    assert search.criterion.is_worth_naming(less, selection.before, fit) is is_named
