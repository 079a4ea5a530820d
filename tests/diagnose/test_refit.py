"""A base model that was calibrated while something acted: its paths are refitted together with what it lacks."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.arrays import rms_of
from compensator.codes import ModelWarning
from compensator.data.measurement import read, runs_in
from compensator.diagnose import diagnosis as diagnosis_module
from compensator.diagnose.choice.deployment import Deployment
from compensator.diagnose.choice.extended_model import with_effects
from compensator.diagnose.choice.held_out import HeldOut
from compensator.diagnose.choice.verdict import Judged
from compensator.diagnose.diagnosis import DiagnosisOptions, diagnose
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.background import LAGS_MIN, Background
from compensator.diagnose.search.findings import findings_of
from compensator.diagnose.search.refitted_paths import with_fewer_lags, with_paths
from compensator.identify.calibration import calibrate, predict
from compensator.identify.settings import Settings
from compensator.model.effects.blocks import FilterBank, lag_or_none
from compensator.model.effects.regression import AMBIENT, DRIVE, Regression
from compensator.model.engine import Engine
from compensator.model.model_file import load_model
from tests.bench.spindle import FILE
from tests.identify.quill_runs import runs_from


def lag(u, tau):
    p = np.exp(-1.0 / tau)
    return lfilter([1.0 - p], [1.0, -p], u)


def machine(seed, speeds, *, logged=True):
    """A machine whose spindle bends it by the square of the speed; T_Q sees a motor that heats alike at any speed."""
    rng = np.random.default_rng(seed)
    hours = [(speed, h) for speed in speeds for h in (speed, 0)]
    rpm = np.concatenate([np.zeros(60), *(np.full(200, float(on)) for _, on in hours)])
    n = rpm.size
    room = 21.0 + np.cumsum(rng.normal(0.0, 0.01, n)) + np.sin(np.arange(n) / 250.0)
    motor = 9.0 * lag((rpm > 0) * 1.0, 45.0)
    y = 1.4 * lag(motor, 90.0) - 2.0 * lag(room - room[0], 200.0)
    y = y - 2.4e-6 * lag(rpm**2, 70.0)
    columns = {
        "t_q_degc": room + motor + rng.normal(0, 0.02, n),
        "at_degc": room + rng.normal(0, 0.02, n),
        "y_um": y + rng.normal(0, 0.2, n),
        "shop_degc": 19.0 + lag(rng.normal(0.0, 1.0, n), 60.0) * 8.0,
        "second_um": 0.8 * y + rng.normal(0, 0.2, n),
    }
    if logged:
        columns["spindle_rpm"] = rpm
    return runs_from(columns)


def calibrated(runs):
    """A model as the command writes it: with the error of its own calibration."""
    calibration = calibrate(runs, Settings(kind="direct"), period_s=60.0, name="two inputs")
    return calibration.model


@pytest.fixture(scope="module")
def runs():
    return machine(1, (1500, 3000, 4500, 2200, 3800))


@pytest.fixture(scope="module")
def model(runs):
    return calibrated(runs)


@pytest.fixture(scope="module")
def searches():
    """What the searches of the runs gave, by what was called and whether the paths were free."""
    return {}


def searched_once(patch, searches):
    """Let diagnoses of the runs search once with free paths and once with those of the model."""

    def once(name, is_free):
        real = getattr(diagnosis_module, name)

        def called(first, *others):
            asked = name, is_free(first)
            if asked not in searches:
                searches[asked] = real(first, *others)
            return searches[asked]

        return called

    patch.setattr(diagnosis_module, "findings_of", once("findings_of", lambda evidence: evidence.free_paths))
    patch.setattr(diagnosis_module, "held_out_of", once("held_out_of", lambda found: found.search.evidence.free_paths))


@pytest.fixture(scope="module")
def found(model, runs, searches):
    with pytest.MonkeyPatch.context() as patch:
        searched_once(patch, searches)
        return diagnose(model, runs)


@pytest.fixture(scope="module")
def kept(model, runs, searches):
    with pytest.MonkeyPatch.context() as patch:
        searched_once(patch, searches)
        return diagnose(model, runs, DiagnosisOptions(keep_paths=True))


@pytest.fixture
def foretold(searches, found, kept, monkeypatch):
    """Let paths that are fitted anew leave other errors on held-out blocks: a function that is called with them."""
    searched_once(monkeypatch, searches)
    errors = searches["held_out_of", True]

    def change(**changed):
        monkeypatch.setitem(searches, ("held_out_of", True), dataclasses.replace(errors, **changed))

    return change


def test_the_channel_and_its_curve_are_named(found):
    assert [e.place for e in found.effects] == [("input", "", "spindle_rpm")]
    effect = found.effects[0]
    assert effect.term.hypothesis.effect.curve == "square"
    assert effect.deployable
    gain, tau = effect.named["gain_um_per_rpm2"], effect.named["tau_min"]
    assert gain == pytest.approx(-2.4e-6, rel=0.25)
    assert tau == pytest.approx(70.0, rel=0.35)
    assert 0.0 < effect.std["gain_um_per_rpm2"] < 0.2 * abs(gain)
    assert effect.std["tau_min"] > 0.0


def test_blocks_that_took_no_part_and_a_run_of_other_speeds_come_out_right(found, model):
    assert found.after.rms_um < 0.2 * found.before.rms_um
    fresh = machine(2, (4000, 1000, 2800))[0]
    first, extended = (float(np.sqrt(np.mean((fresh.y_um - predict(one, fresh)) ** 2))) for one in (model, found.model))
    assert extended < 0.15 * first
    assert extended < 1.5


def test_the_extended_model_says_what_error_it_has_left(found):
    assert 0.0 < found.model.y_std_um < 1.5
    assert any("were refitted" in str(words) for words in found.warnings)


def test_paths_that_are_to_be_kept_are_kept_and_that_they_miss_much_is_said(model, runs, found, kept):
    assert (kept.model.dtf, kept.model.tdtf) == (model.dtf, model.tdtf) and found.model.dtf != model.dtf
    assert [e.place for e in kept.effects][:1] == [("input", "", "spindle_rpm")]
    codes = [one.code for one in kept.warnings]
    assert ModelWarning.PATHS_KEPT in codes and ModelWarning.FITTED_ANEW not in codes
    silent = dataclasses.replace(model, held_out_rms_um=None)
    explained = Judged(verdict="explained", nothing_left=True, hides=False)
    for one, is_said in ((model, True), (silent, False)):
        assert (
            bool(diagnosis_module._paths_kept(evidence_of(one, runs), explained, deployed=True, is_off=False))
            is is_said
        )


@pytest.mark.parametrize(
    ("nothing", "whole", "deployed"),
    [(0.3, 0.6, True), (0.3, 0.9, False), (0.8, 0.95, True), (0.8, 1.05, False), (1.1, 1.05, True)],
)
def test_paths_that_foretell_nothing_of_held_out_blocks_are_kept(
    model, runs, found, searches, foretold, nothing, whole, deployed
):
    """Each block knows less of new paths than the whole, but not three times less, nor less than no compensation.

    Both errors are shares of the spread of Y, which no compensation leaves.
    """
    assert found.model.effects
    left = searches["held_out_of", True].nothing
    scale = found.evidence.spread_um / rms_of(left)
    foretold(nothing=nothing * scale * left, named=whole * scale * left, whole=whole * scale * left)
    again = diagnose(model, runs)
    assert (again.model.dtf != model.dtf) is deployed and again.model.effects
    assert (ModelWarning.PATHS_KEPT in [one.code for one in again.warnings]) is not deployed


@pytest.mark.usefixtures("found")
def test_beside_paths_that_were_fitted_anew_the_remainder_has_no_limit(model, searches):
    searched = searches["findings_of", True]
    searched = dataclasses.replace(searched, remainder=searched.channels)
    for refitted, is_limited in ((searched.refitted, False), (None, True)):
        extended, _ = with_effects(model, dataclasses.replace(searched, refitted=refitted), ())
        (rest,) = extended.effects
        assert rest.kind == "regression" and np.isfinite(rest.most_um) == is_limited


def test_paths_of_a_calibration_on_other_data_stay_unless_others_foretell_clearly_better(
    model, runs, searches, kept, foretold
):
    """Fitted anew to few hours, paths may explain these and no other day; the calibration knows more."""
    whole = searches["held_out_of", True].whole
    for share, stay in ((0.7, False), (0.8, True)):
        foretold(whole=share * kept.after.rms_um / rms_of(whole) * whole)
        reported = []
        options = DiagnosisOptions(unseen=True)
        again = diagnose(model, runs, options, progress=lambda *steps, reported=reported: reported.append(steps))
        assert (again.model.dtf == model.dtf) is stay
        assert reported == [(0, 4), (4, 8)]
        assert (ModelWarning.PATHS_KEPT in [one.code for one in again.warnings]) is stay


@pytest.mark.parametrize(("alone", "named", "surpasses"), [(1.4, 1.4, True), (1.3, 1.4, False), (1.4, 1.3, False)])
def test_new_paths_foretell_clearly_better_than_the_calibrated_ones_with_names_and_without(alone, named, surpasses):
    def deployment(nothing: float, whole: float) -> Deployment:
        left = dict.fromkeys(("named", "ceiling"), np.full(4, whole))
        held_out = HeldOut(nothing=np.full(4, nothing), whole=np.full(4, whole), steps=(), **left)
        decided = {"contradicted": False, "worse_um": None, "too_short_h": None}
        found = SimpleNamespace(terms=(), remainder="all channels", refitted=None)
        return Deployment(found=found, effects=(), held_out=held_out, **decided)

    assert deployment(9.0, 1.0).surpasses(deployment(alone, named)) is surpasses


def test_a_model_that_does_not_say_how_good_it_is_comes_to_the_same(model, found, runs):
    silent = dataclasses.replace(model, provenance={})
    again = findings_of(diagnosis_module._evidence(silent, runs))
    assert [term.hypothesis for term in again.terms] == [e.term.hypothesis for e in found.effects]
    assert again.refitted is not None and again.deploys_names and found.model.dtf != model.dtf


def test_what_is_not_logged_is_not_made_up(runs):
    blind = machine(1, (1500, 3000, 4500, 2200, 3800), logged=False)
    model = calibrated(blind)
    result = diagnose(model, blind)
    assert result.verdict in ("unexplained", "partly_explained")
    if not result.effects or result.after.rms_um > result.before.rms_um:
        assert result.model.effects == ()
    # Another probe moves with Y whatever the cause, and is no cause.
    assert all(e.place[2] != "second_um" for e in result.effects)


@pytest.mark.usefixtures("found")
def test_the_paths_are_what_the_regression_says(model, searches):
    """The filter banks of heat and ambient, written as transfer functions, give the same deformation."""
    found = searches["findings_of", True]
    evidence = found.search.evidence
    extended, rest = with_paths(model, found.refitted.effect)
    record = evidence.signals[0]
    y = extended.dtf.sampled.response(record.drive) + extended.tdtf.sampled.response(record.ambient_k)
    difference = found.own_paths - y
    # From rest, the one begins at its first input and the other at 0.
    assert np.ptp(difference[600:]) < 0.01 * np.ptp(found.own_paths)
    assert rest is None
    everything = Background(evidence).template
    _, rest = with_paths(model, everything)
    assert set(rest.channels) == set(everything.channels) - {"t_q_degc - at_degc", "at_degc"}


def test_held_out_samples_do_not_take_part(model, runs):
    evidence = evidence_of(model, runs)
    block = next(evidence.blocks(3))
    before = findings_of(evidence.with_free_paths().without(block)).whole
    disturbed = runs_from(
        {
            "t_q_degc": runs[0].t_q_degc,
            "at_degc": runs[0].at_degc,
            "y_um": np.where(block, runs[0].y_um + 3.0, runs[0].y_um),
            **runs[0].channels,
        }
    )
    other = evidence_of(model, disturbed)
    other = dataclasses.replace(other, probe_um=evidence.probe_um, runs=evidence.runs)
    again = findings_of(other.with_free_paths().without(block)).whole
    assert again == pytest.approx(before, abs=1e-5 * np.std(before))


@pytest.mark.skipif(not FILE.exists(), reason="the measured spindle's data is not here")
def test_the_other_probes_do_not_become_inputs():
    roles = {"t_q_degc": "t5_degc", "at_degc": "t16_degc", "y_um": "ch3_um"}
    runs, _ = runs_in([read(FILE, columns=roles)])
    evidence = evidence_of(calibrated(runs), runs)
    assert "spindle_rpm" in evidence.context.channels
    assert not [name for name in evidence.context.channels if name.startswith("ch")]
    assert json.dumps(sorted(evidence.context.zeroed)) == '["spindle_rpm"]'


TAUS_MIN = (0.0, *np.geomspace(1.0, 200.0, 8).tolist())


def with_few_lags(*gains, seed=0):
    """A regression over heat and ambient temperature whose lags are those that a machine's day needs."""
    drives = np.random.default_rng(seed).normal(0.0, 1.0, (len(gains), 200)).repeat(10, axis=1)
    banks = [FilterBank(TAUS_MIN, [(1.0,) * len(TAUS_MIN)], 1.0, lag_or_none).columns(drive) for drive in drives]
    found = [with_fewer_lags(np.array(g), TAUS_MIN, 1.0, bank) for g, bank in zip(gains, banks, strict=True)]
    names = (DRIVE["heat"], AMBIENT)[: len(gains)]
    return Regression(
        channels=names, exponents=(1.0,) * len(gains), taus_min=TAUS_MIN, gains=tuple(tuple(f.tolist()) for f in found)
    )


def test_a_path_of_few_lags_is_that_of_all_where_the_record_moves_fast():
    """Large gains of short lags cancel in a step response after a minute, and not where the heat is switched."""
    gains = (18.0, -25.0, 7.0, -2.0, 1.4, -1.9, 2.4, -2.7, 2.9)
    drive = np.random.default_rng(1).normal(0.0, 1.0, 300).repeat(10)
    model, _ = with_paths(load_model("quill"), with_few_lags(gains))
    wanted = FilterBank(TAUS_MIN, [gains], 1.0, lag_or_none).filter(drive - drive[0])
    assert np.std(model.dtf.sampled.response(drive - drive[0]) - wanted) < 0.1 * np.std(wanted)


@pytest.mark.parametrize("period_min", [24.0, 30.0])
def test_lags_that_a_long_sample_does_not_tell_apart_are_no_error(period_min):
    drive = np.random.default_rng(2).normal(0.0, 1.0, 1500).cumsum()
    bank = np.column_stack([lag_or_none(tau, period_min).filter(drive - drive[0]) for tau in LAGS_MIN])
    gains = np.random.default_rng(3).normal(0.0, 1.0, len(LAGS_MIN))
    kept = with_fewer_lags(gains, LAGS_MIN, period_min, bank)
    assert np.std(bank @ (gains - kept)) < 0.1 * np.std(bank @ gains)


def test_paths_fitted_anew_keep_the_observer_sane():
    """With poles that lie close the covariance loses all digits: the stated deviation was 1e15 µm and 0.1 in turn."""
    gains = (0.02, 0.4, -0.3, 0.1, 0.0, 0.2, -0.1, 0.05, 0.1)
    model, rest = with_paths(load_model("quill"), with_few_lags(gains, tuple(10.0 * gain for gain in gains)))
    assert rest is None and model.dtf.sampled.order <= 4
    assert model.dtf.sampled.dc_gain == pytest.approx(sum(gains), rel=0.03)
    engine = Engine(model)
    engine.set_reference(20.0, 20.0)
    estimates = [engine.step(20.0 + 3.0 * np.sin(i / 50.0), 20.0) for i in range(3000)]
    deviations = np.array([estimate.y_std_um for estimate in estimates[200:]])
    assert np.all(deviations > model.y_std_um)
    assert np.ptp(deviations) < 0.01 * deviations[-1]
