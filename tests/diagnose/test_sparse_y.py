"""Diagnosis from Y measured now and then: named, or undecided with what would decide; never a false all-clear."""

import dataclasses
from functools import partial

import numpy as np
import pytest

import compensator as tc
from compensator.diagnose import diagnosis
from compensator.diagnose.advice.record_with_test import HOURS, RecordWithTest
from compensator.diagnose.advice.switched import HEAT
from compensator.diagnose.advice.trials import Trials
from compensator.diagnose.choice import held_out
from compensator.diagnose.fitting.fit import fit_terms
from compensator.diagnose.fitting.likelihood import Likelihood
from compensator.diagnose.fitting.points import Points, SlowRest
from compensator.diagnose.fitting.whitening import Whitening
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.background import Background
from compensator.diagnose.search.chips import without_chips
from compensator.diagnose.search.detection_limit import detection_limits
from compensator.diagnose.search.findings import findings_of
from compensator.diagnose.search.search import Search
from compensator.errors import DataError
from compensator.model.effects.hypothesis import proposals
from compensator.model.model_file import load_model
from compensator.report.diagnosis import tone_of
from tests.diagnose.scenarios import draw, lag, record
from tests.identify.quill_runs import runs_from

QUILL = load_model("quill")
STD_UM = 1.5
#: Channels of the records: each that is logged is searched, in every diagnosis.
CHANNELS = ("coolant_degc", "spindle_rpm", "cabinet_degc")


def probed(kind, seed, *, hours=48.0, every=60, std_um=STD_UM, size_um=4.0):
    """Two days with an effect, Y once an hour."""
    columns, true, _ = record([draw(kind, seed, size_um)], 1000 + seed, hours)
    y, at = np.full(true.size, np.nan), np.arange(every, true.size, every)
    y[at] = true[at] + np.random.default_rng([seed, 5]).normal(0.0, std_um, at.size)
    logged = {name: columns[name] for name in ("t_q_degc", "at_degc", *CHANNELS)}
    return {"t_s": np.arange(true.size) * 60.0} | logged | {"y_um": y}


def chipped(columns, chips):
    """The same with some values off: number of the value, µm."""
    at, y = np.flatnonzero(np.isfinite(columns["y_um"])), columns["y_um"].copy()
    for value, um in chips.items():
        y[at[value]] += um
    return columns | {"y_um": y}, [60 * int(at[value]) for value in chips]


def runs(columns, std_um=STD_UM):
    return [
        dataclasses.replace(run, y_std_um=std_um) for run in runs_from({k: v for k, v in columns.items() if k != "t_s"})
    ]


def searched(columns):
    """Return what a diagnosis finds in all values that fit, and the remarks on those that do not."""
    return without_chips(findings_of(evidence_of(QUILL, runs(columns))), partial(evidence_of, QUILL))


@pytest.fixture(scope="module")
def quiet():
    return tc.diagnose("quill", probed("none", 1), y_std_um=STD_UM)


@pytest.fixture(scope="module")
def gain():
    return tc.diagnose("quill", probed("gain DTF", 1), y_std_um=STD_UM)


@pytest.fixture(scope="module")
def step():
    return tc.diagnose("quill", probed("step", 1, size_um=8.0), y_std_um=STD_UM)


def test_the_noise_is_asked_for_and_nothing_is_called_adequate_without_it():
    with pytest.raises(DataError, match=r"47 value\(s\) in 2880 samples.*--y-std UM"):
        tc.diagnose("quill", probed("gain DTF", 1))
    with pytest.raises(DataError, match="y_um has 7 values, expected at least 12"):
        tc.diagnose("quill", probed("none", 1, every=360), y_std_um=STD_UM)


def test_no_effect_is_adequate_with_how_much_could_hide(quiet):
    found = quiet.to_dict()
    assert (found["verdict"], found["effects"]) == ("adequate", [])
    hides = found["could_hide"]
    assert (hides["values"], hides["every_min"], hides["too_much"]) == (47, 60.0, False)
    sizes = [one["size_um"] for one in hides["what"]]
    assert sizes == sorted(sizes, reverse=True)
    assert 0.0 < sizes[0] <= hides["matters_um"]
    assert "could act without being seen" in quiet.summary()
    assert "What could hide" in quiet._repr_html_() or "What could hide" in quiet.summary()


def test_the_page_says_how_much_could_hide(quiet, tmp_path):
    quiet.page(tmp_path / "page.html")
    assert "What could hide" in (tmp_path / "page.html").read_text()


def test_a_gain_is_named_from_47_hourly_probes(gain):
    effect = gain.to_dict()["effects"][0]
    assert (effect["kind"], effect["path"]) == ("gain", "DTF")
    assert len(gain.effects) == 1
    assert gain.verdict == "explained"
    assert gain.model.effects  # deployed: blocks of 16 values do not contradict by chance


def zeroed(columns, shifts_um, every_h):
    """The same data where a zero was set each so many hours, and Y counts anew from each."""
    minutes = np.arange(columns["y_um"].size)
    at_s = tuple(3600.0 * every_h * (i + 1) + 20.0 for i in range(len(shifts_um) - 1))
    shifted = columns["y_um"] + np.array(shifts_um)[np.searchsorted(at_s, 60.0 * minutes)]
    found = tc.read(columns | {"y_um": shifted})
    return dataclasses.replace(found, table=dataclasses.replace(found.table, zeros_s=at_s))


def test_a_zero_each_shift_leaves_a_diagnosis_all_probes(gain):
    """Eight probes about each zero: too few about one of them, and a step at each that the machine did not make."""
    columns = probed("gain DTF", 1)
    data = zeroed(columns, [0.0, 20.0, -35.0, 12.0, -8.0, 30.0], 8.0)
    found = tc.diagnose("quill", data, y_std_um=STD_UM)
    assert [(effect.kind, effect.path) for effect in found.effects] == [("gain", "DTF")]
    assert found.verdict == "explained"
    (own,), (other,) = (one.diagnosis.effects for one in (found, gain))
    assert own.effect.change == pytest.approx(other.effect.change, abs=0.05)
    assert [remark.code for remark in found.remarks] == ["zeros_left_out", "several_zeros"]
    assert "probe(s) left out: alone about their zero, or beside its change" in found.remarks[0]
    assert "about 6 zeros" in found.remarks[1]
    # The curve of the page has none of the steps.
    assert np.nanmax(np.abs(found.diagnosis.residual_before)) < 20.0
    with pytest.raises(DataError, match=r"y_um has [78] values, expected at least 12"):
        tc.diagnose("quill", columns | {"y_um": np.where(np.arange(2880) < 480, columns["y_um"], np.nan)}, y_std_um=1.5)


def test_a_value_shows_nothing_where_its_zero_does_not_show():
    (run,) = runs(probed("none", 1, hours=10.0))
    y, at = np.full(run.t_s.size, np.nan), [60, 120, 180, 240, 300, 301, 360, 420]
    y[at] = 1.0
    run = dataclasses.replace(run, y_um=y)
    # One value about the second zero, none about the third, a sample that the last zero divides.
    zeroed_run = run.with_zeros([60.0 * 301 + 10.0, 60.0 * 200, 60.0 * 250, 60.0 * 260])
    assert np.flatnonzero(np.isfinite(zeroed_run.y_um)).tolist() == [60, 120, 180, 360, 420]
    assert zeroed_run.zero_numbers[[60, 180, 360, 420]].tolist() == [0, 0, 1, 1]
    assert run.with_zeros([]) is run


def test_what_is_about_a_zero_that_was_held_out_is_about_its_own_mean():
    (run,) = runs(probed("none", 1, hours=20.0))
    evidence = evidence_of(QUILL, [run.with_zeros([36000.0])])
    late = evidence.used & (run.t_s > 36000.0)
    known = held_out.zeros_known(Points(evidence.without(late)))
    assert known == (True, False)
    left = held_out.left_of_block(evidence, late, known, np.full(run.t_s.size, 7.0))
    assert abs(left.mean()) < 1e-9 and left.std() > 0.5


def test_a_part_without_a_probe_keeps_no_gain_from_being_named():
    """A shift in which nobody probed: 29 probes are in the other part, fewer than samples would be wanted."""
    columns = probed("gain DTF", 1)
    parts = {name: np.split(values, [30 * 60]) for name, values in columns.items()}
    first, second = ({name: values[i] for name, values in parts.items()} for i in (0, 1))
    second["y_um"] = np.full(second["y_um"].size, np.nan)
    with_it = tc.diagnose(QUILL, [first, second], y_std_um=STD_UM)
    without = tc.diagnose(QUILL, [first], y_std_um=STD_UM)
    assert with_it.verdict == without.verdict and with_it.verdict != "adequate"


def test_tests_are_counted_in_probes(gain):
    tests = [test for rival in gain.effects[0].rivals if (test := rival.test)]
    assert tests
    for test in tests:
        assert test.probes == test.hours * 60.0 // test.every_min
        assert f"{test.probes} more probes" in test.sentence
    assert gain.to_dict()["advice"]["tests"][0]["probes"] == tests[0].probes


@pytest.mark.parametrize("every_min", [60, 240, 2160])
def test_a_test_is_credited_with_the_probes_before_its_end(every_min):
    evidence = evidence_of(QUILL, runs(probed("none", 1)))
    trial = next(trial for trial in Trials(evidence).of([]) if trial.driver == HEAT)
    joint = RecordWithTest(evidence, trial, float(every_min))
    probed_at_h = (joint.points.first[joint.before :] + 1 - evidence.used.size) / 60.0
    assert probed_at_h.tolist() == [every_min / 60.0 * (i + 1) for i in range(1440 // every_min)]
    assert joint.ends.tolist() == [np.sum(probed_at_h <= hours) for hours in HOURS]
    likelihood = Likelihood(joint.points.of(evidence), joint.points.typical_rest())
    gain = next(one for one in proposals(evidence.context) if one.place == ("gain", "DTF", ""))
    change = joint.change(fit_terms(likelihood, [(gain, ())]), fit_terms(likelihood, []))
    assert np.all(change[joint.ends == 0] == 0.0)
    assert (change[-1] > 0.0) == bool(joint.ends[-1])


@pytest.mark.parametrize("kind", ["drift", "step", "input", "gain TDTF", "late path"])
def test_effects_are_named_beside_a_rest_that_walks(kind):
    search = Search(evidence_of(QUILL, runs(probed(kind, 1))))
    assert [term.hypothesis.place for term in search.run().fit.terms] == [draw(kind, 1, 4.0).place]


@pytest.mark.parametrize("kind", ["unobserved", "periodic"])
def test_what_comes_and_goes_between_two_probes_is_no_all_clear(kind):
    found = tc.diagnose("quill", probed(kind, 1), y_std_um=STD_UM).to_dict()
    assert found["verdict"] == "unexplained"
    assert found["effects"] == []
    assert found["advice"]["tests"][0]["probes"] > 0


def test_a_source_that_no_channel_shows_is_named_where_its_times_explain_all():
    columns = probed("none", 5)
    on = lag(np.searchsorted([700, 1200, 1900], np.arange(2880)) % 2.0, 45.0)
    columns["y_um"] = columns["y_um"] + 12.0 * on
    why = tc.diagnose("quill", columns, y_std_um=STD_UM)
    assert [effect.kind for effect in why.effects] == ["unobserved"]
    assert why.verdict == "unexplained"
    assert why.model is not None and not why.model.effects


def test_values_that_could_not_show_what_matters_are_no_all_clear():
    why = tc.diagnose("quill", probed("none", 1, every=210), y_std_um=STD_UM)
    found = why.to_dict()
    assert found["verdict"] == "unexplained"
    assert found["could_hide"]["too_much"]
    assert found["could_hide"]["values_needed"] > found["could_hide"]["values"]
    assert "too few or too noisy to show whether the model is adequate" in why.summary()
    assert "lacks an effect" not in why.summary()


def test_a_size_that_could_hide_is_one_that_is_just_named():
    """Twice that size is named; a quarter of it is not."""
    columns = probed("none", 3)
    search = Search(evidence_of(QUILL, runs(columns)))
    size = next(
        one.size_um
        for one in detection_limits(search.run(), search.criterion.price).what
        if (one.kind, one.path) == ("gain", "DTF")
    )
    share = np.concatenate([r.share("DTF") for r in search.evidence.signals])
    for times, named in ((2.0, [("gain", "DTF", "")]), (0.25, [])):
        acted = columns | {"y_um": columns["y_um"] + times * size / np.ptp(share) * share}
        terms = Search(evidence_of(QUILL, runs(acted))).run().fit.terms
        assert [term.hypothesis.place for term in terms] == named


def test_a_stated_noise_that_is_too_small_is_no_all_clear_and_a_large_one_hides_more():
    columns = probed("none", 2)
    assert tc.diagnose("quill", columns, y_std_um=0.5).verdict != "adequate"
    sizes = []
    for std_um in (1.5, 3.0):
        search = Search(evidence_of(QUILL, runs(columns, std_um)))
        sizes.append(detection_limits(search.run(), search.criterion.price).what[0].size_um)
    assert sizes[1] > 1.4 * sizes[0]


def test_a_value_is_a_point_and_the_rest_decays_by_the_time_between():
    """Against the covariance written out: irregular times, an Ornstein–Uhlenbeck rest, white noise."""
    columns = probed("none", 1)
    keep = np.flatnonzero(np.isfinite(columns["y_um"]))[[0, 1, 2, 5, 6, 11, 12, 13, 20, 21, 22, 30, 31, 44]]
    columns["y_um"] = np.where(np.isin(np.arange(2880), keep), columns["y_um"], np.nan)
    points = Points(evidence_of(QUILL, runs(columns)))
    assert points.count == keep.size
    rest = SlowRest(1.5, 2.0, 150.0, 0.0, 0.0, 0.0)
    apart = np.abs(keep[:, None] - keep[None, :])
    covariance = 1.5**2 * np.eye(keep.size) + 2.0**2 * np.exp(-apart / 150.0)
    y = points.residual
    white = Whitening(points, rest)
    assert float(np.sum(white.of(y[:, None]) ** 2)) == pytest.approx(float(y @ np.linalg.solve(covariance, y)))
    assert white.log_det == pytest.approx(float(np.linalg.slogdet(covariance)[1]))


def test_points_do_not_grow_with_the_samples_between_two_probes():
    week = Points(evidence_of(QUILL, runs(probed("none", 1, hours=96.0))))
    assert week.first.size == week.count == 95
    assert Likelihood(week, week.typical_rest()).target.size < 200


def test_dense_data_say_nothing_of_hiding_and_no_probes():
    columns, _, _ = record([draw("gain DTF", 1, 4.0)], 1001, 12.0)
    logged = {name: columns[name] for name in ("t_q_degc", "at_degc", "y_um", *CHANNELS)}
    found = tc.diagnose("quill", {"t_s": np.arange(720) * 60.0} | logged).to_dict()
    assert "could_hide" not in found
    assert all("probes" not in test for test in found["advice"]["tests"])


def test_a_model_from_probes_grants_no_error_of_the_size_of_their_noise():
    """Calibrated with an error of its own of 0.3 µm, diagnosed with probes of 1.5 µm: 0.3 µm it is."""
    model = dataclasses.replace(QUILL, held_out_rms_um=0.3)
    evidence = evidence_of(model, runs(probed("none", 1)))
    assert evidence.noise.own_error_um == pytest.approx(0.3)
    assert Points(evidence).own_um < 0.5


@pytest.mark.parametrize("chips", [{30: 20.0}, {8: -20.0, 30: 20.0}])
def test_a_chip_spoils_no_all_clear_and_is_named(quiet, chips):
    columns, times = chipped(probed("none", 1), chips)
    why = tc.diagnose("quill", columns, y_std_um=STD_UM)
    found = why.to_dict()
    assert (found["verdict"], found["effects"]) == ("adequate", [])
    assert found["could_hide"]["values"] == 47 - len(chips)
    assert found["could_hide"]["matters_um"] == pytest.approx(quiet.to_dict()["could_hide"]["matters_um"], rel=0.05)
    assert found["warning_codes"] == ["y_left_out"]
    words = f"{len(chips)} of 47 measured y_um do not fit the others"
    assert words in found["warnings"][0]
    assert f"at t_s = {', '.join(map(str, times))} from the start" in found["warnings"][0]
    assert why.diagnosis.before.peak_to_peak_um < 10.0


@pytest.mark.parametrize("values", [(0,), (20, 46)])
def test_a_chip_does_not_change_what_is_named(gain, values):
    found, left_out = searched(chipped(probed("gain DTF", 1), dict.fromkeys(values, 20.0))[0])
    assert [term.hypothesis.place for term in found.terms] == [effect.place for effect in gain.effects]
    assert found.terms[0].named["change"] == pytest.approx(gain.effects[0].named["change"], abs=0.02)
    # The unknown initial state takes a chip of the first value.
    said = [words for words in left_out if "2 of 47 measured y_um do not fit the others" in words]
    assert len(said) == (values != (0,))


@pytest.mark.parametrize(
    "chips",
    [
        {45: 20.0, 46: 20.0},
        {20: 20.0, 21: 21.0},
        {12: 15.0, 13: 15.0, 14: 15.0},
        {3 * k: 20.0 * (-1) ** k for k in range(1, 13)},
    ],
    ids=["step at the end", "two in a row", "acts for 3 h", "a quarter of all"],
)
def test_what_several_values_show_is_no_chip(chips):
    found, left_out = searched(chipped(probed("none", 1), chips)[0])
    assert left_out == []
    # Nor is the model adequate.
    assert found.terms or not found.leaves_noise


def test_a_clean_record_and_a_step_lose_no_value(quiet, gain, step):
    assert [effect.kind for effect in step.effects] == ["step"]
    for why in (quiet, gain, step):
        assert "y_left_out" not in why.to_dict()["warning_codes"]


def test_nothing_is_explained_where_held_out_values_contradict():
    """A source that switches each 90 min, seen once an hour: no effect with a name foretells it."""
    columns = probed("none", 1)
    columns["y_um"] = columns["y_um"] + 8.0 * (columns["t_s"] % 10800.0 < 5400.0)
    why = tc.diagnose("quill", columns, y_std_um=STD_UM)
    found = why.to_dict()
    assert found["after"]["rms_um"] > found["before"]["rms_um"]
    assert found["verdict"] in ("partly_explained", "unexplained")
    assert tone_of(found) != "good"
    assert "were found" not in why.summary().partition("\n")[0]


def test_a_step_is_known_no_better_than_the_time_between_two_values(step):
    (effect,) = step.effects
    assert 60.0 / 12.0**0.5 <= effect.std["at_min"] < 60.0
    assert f"± {effect.std['at_min']:.0f} min: values lie 60 min apart" in effect.explanation


def test_a_remainder_that_helps_nothing_is_not_deployed(monkeypatch):
    def replaced(evidence, **given):
        """All channels in place of the gain: as good, and no better."""
        found = findings_of(evidence, **given)
        points, rest = found.search.points, found.selection.before.rest
        everything = Background(evidence).fitted(points, np.zeros(points.count), rest)
        return dataclasses.replace(found, remainder=everything, deploys_names=False)

    for module in (diagnosis, held_out):
        monkeypatch.setattr(module, "findings_of", replaced)
    why = tc.diagnose("quill", probed("gain DTF", 1), y_std_um=STD_UM)
    found = why.to_dict()
    assert found["remainder"] is None
    assert found["after"]["rms_um"] < found["before"]["rms_um"]
    assert [effect.kind for effect in why.model.effects] == ["gain"]
    assert "remainder is deployed" not in why.summary()


def test_what_could_hide_is_said_with_its_limit(quiet):
    sentence = quiet.summary().partition("\n")[0]
    limit = quiet.to_dict()["could_hide"]["matters_um"]
    assert f"limit for an adequate model: {limit:.1f} µm, a tenth of Y's movement" in sentence
    (hidden,) = [part for part in quiet.contents() if getattr(part, "title", "") == "What could hide"]
    sizes = [one["size_um"] for one in quiet.to_dict()["could_hide"]["what"]]
    assert all(f"{size:.1f} µm peak to peak" in " ".join(hidden.lines) for size in sizes)


@pytest.mark.parametrize(("sign", "said"), [(1.0, True), (-1.0, False)])
def test_values_that_are_equally_far_off_may_be_something_that_acts(sign, said):
    _, (remark,) = searched(chipped(probed("none", 1), {8: 20.0, 20: sign * 20.0, 33: 20.0})[0])
    assert "3 of 47" in remark
    assert ("All are off by about +" in remark) == said
