"""Y measured now and then, as by a touch probe: known as sparse, its noise asked for, a model identified from it."""

import numpy as np
import pytest

import compensator as tc
from compensator.data.runs import is_sparse, noise_of
from compensator.errors import CompensatorError, DataError, UsageError
from compensator.identify.calibration import predict
from tests.diagnose.scenarios import record, signals
from tests.identify.quill_runs import fit_pct, runs_from

STD_UM, EVERY, HOURS = 1.5, 10, 36.0


def probed(seed=3, *, every=EVERY, hours=HOURS, heat=True, std_um=STD_UM):
    """A day of the published machine with Y in every so many rows only."""
    measured, true, _ = record([], seed, hours)
    y, at = np.full(true.size, np.nan), np.arange(every - 1, true.size, every)
    y[at] = true[at] + np.random.default_rng(seed).normal(0.0, std_um, at.size)
    columns = {"t_s": np.arange(true.size) * 60.0, "y_um": y} | {c: measured[c] for c in ("t_q_degc", "at_degc")}
    return columns | ({"heat_w": signals(seed, hours)[2]} if heat else {})


@pytest.fixture(scope="module")
def found():
    return tc.identify(probed(), y_std_um=STD_UM)


def test_values_without_neighbours_are_known_as_sparse():
    y = np.full(600, np.nan)
    y[::10] = 1.0
    assert is_sparse(y)
    bursts = np.full(600, np.nan)
    for k in range(0, 600, 60):
        bursts[k : k + 5] = 1.0
    assert is_sparse(bursts)  # five readings at each stop: most of four in a row span two stops


def test_a_sensor_with_gaps_is_not_sparse():
    y = np.ones(600)
    y[100:350] = np.nan
    y[400::7] = np.nan
    assert not is_sparse(y)
    assert not is_sparse(np.full(600, np.nan))


def test_the_noise_of_probes_is_asked_for_in_one_line():
    with pytest.raises(DataError, match=r"^data: y_um has 216 value\(s\) in 2160 samples.*--y-std UM") as refused:
        tc.identify(probed())
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("std_um", [0.0, -1.0, float("nan"), float("inf"), "x", True])
def test_a_standard_deviation_that_is_none_is_refused(std_um):
    for verb in (
        lambda: tc.identify(probed(), y_std_um=std_um),
        lambda: tc.diagnose("quill", probed(), y_std_um=std_um),
        lambda: tc.simulate("quill", probed(), correct=True, y_std_um=std_um),
    ):
        with pytest.raises(UsageError, match=r"--y-std .* \(y_std_um in Python\)"):
            verb()


def test_the_noise_is_asked_for_in_the_same_words():
    words = set()
    for verb in (
        lambda: tc.identify(probed()),
        lambda: tc.diagnose("quill", probed()),
        lambda: tc.simulate("quill", probed(), correct=True),
    ):
        with pytest.raises(CompensatorError) as refused:
            verb()
        words.add(str(refused.value))
    assert len(words) == 1


def test_a_stated_noise_is_used_as_stated_where_neighbours_show_one():
    measured, _, _ = record([], 1, 12.0)
    run = runs_from({"t_q_degc": measured["t_q_degc"], "at_degc": measured["at_degc"], "y_um": measured["y_um"]})[0]
    assert noise_of([run])["y_um"] == pytest.approx(0.3, rel=0.1)
    columns = {"t_s": run.t_s, "t_q_degc": run.t_q_degc, "at_degc": run.at_degc, "y_um": run.y_um}
    stated = tc.identify(columns, y_std_um=0.7, order=(3, 3, 2))
    assert stated.calibration.noise["y_um"] == 0.7
    assert stated.model.provenance["asked"]["y_std_um"] == 0.7


def test_too_few_values_make_no_model():
    few = probed(every=120)
    with pytest.raises(DataError, match="18 values, expected at least 30"):
        tc.identify(few, y_std_um=STD_UM)


def test_a_model_from_probes_predicts_another_day(found):
    measured, true, _ = record([], 77, 24.0)
    fresh = runs_from({"t_q_degc": measured["t_q_degc"], "at_degc": measured["at_degc"], "y_um": true})[0]
    predicted = predict(found.model, fresh)
    assert fit_pct(true - true.mean(), predicted - predicted.mean()) > 98.0


def test_no_value_is_interpolated(found):
    run = found.calibration.runs[0]
    assert np.isfinite(run.y_um).sum() == 216
    assert found.calibration.parts[0].y_um.size == 216


def test_hours_and_validity_are_those_of_the_record_and_not_of_its_values(found):
    """216 values are 36 h, not 216 minutes; the range of T_Q is that between the values as well."""
    codes = found.to_dict()["warning_codes"]
    assert "short_record" not in codes
    assert found.calibration.parts[0].hours == pytest.approx(HOURS, abs=0.5)
    run = found.calibration.runs[0]
    low, high = found.model.validity["t_q_degc"]
    span = float(np.ptp(run.t_q_degc[run.covered(np.isfinite(run.y_um))]))
    assert high - low == pytest.approx(span + 2 * max(0.33 * span, 2.0), rel=1e-3)


def test_the_noise_of_the_probe_is_none_of_the_model(found):
    """Its own error, which a diagnosis grants it and the service states, is far below the noise of one value."""
    assert 0.05 < found.model.y_std_um < 0.6
    assert found.model.held_out_rms_um == found.model.y_std_um


def test_gains_lie_within_their_standard_errors(found):
    gain, std = found.calibration.deformation.main.gain(0)
    assert abs(gain - 1.01816) < 3.0 * std
    assert std < 0.05


def test_what_the_data_do_not_determine_stays_near_what_is_known():
    """An ambient that hardly moves: without a prior the TDTF's gain is anything; its standard error says so."""
    columns = probed(4)
    still = columns["at_degc"][0] + np.random.default_rng(0).normal(0.0, 0.02, columns["at_degc"].size)
    columns["t_q_degc"] = columns["t_q_degc"] - columns["at_degc"] + still
    columns["at_degc"] = still
    heat = signals(4, HOURS)[4]
    y, known = columns["y_um"], np.isfinite(columns["y_um"])
    columns["y_um"] = np.where(known, heat + np.random.default_rng(1).normal(0.0, STD_UM, y.size), np.nan)
    found = tc.identify(columns, y_std_um=STD_UM, order=(3, 3, 2))
    gain, std = found.calibration.deformation.main.gain(1)
    assert abs(gain) < 30.0
    assert 10.0 < std <= 25.0
    assert "quiet_ambient" in found.to_dict()["warning_codes"]


def test_sparse_validation_is_zeroed_by_several_values(found):
    checked = tc.identify(probed(), validate=probed(8, every=60, hours=24.0), y_std_um=STD_UM, order=(3, 3, 2))
    part = next(p for p in checked.calibration.parts if p.role == "held out")
    assert part.y_um.size == 24
    assert part.model.rms_um < 2.2


@pytest.fixture(scope="module")
def chipped():
    columns = probed()
    at = np.flatnonzero(np.isfinite(columns["y_um"]))[5::40]
    columns["y_um"][at] += 20.0
    return tc.identify(columns, y_std_um=STD_UM, order=(3, 3, 2)), at


def test_chips_are_left_out_and_named(found, chipped):
    result, at = chipped
    (remark,) = [one for one in result.calibration.remarks if one.code == "y_left_out"]
    assert f"{at.size} of 216 measured y_um do not fit the others" in remark
    assert "at t_s = " + ", ".join(str(60 * row) for row in at) in remark
    assert "loose contacts" not in remark
    gain, clean = (one.calibration.deformation.main.gain(0)[0] for one in (result, found))
    assert gain == pytest.approx(clean, abs=0.02)
    assert "do not fit" not in " ".join(found.to_dict()["remarks"])


def test_chips_are_no_held_out_data(chipped):
    result, at = chipped
    (part,) = result.calibration.parts
    assert (part.role, part.y_um.size) == ("fitted", 216 - at.size)
    assert part.model.peak_to_peak_um < 12.0
    assert "On held-out blocks of time" in result.summary()
    assert result.calibration.noise["y_um"] == STD_UM


@pytest.mark.parametrize("how", ["validate", "fit_until_h"])
def test_a_chip_in_held_out_data_is_no_error_of_the_model(how):
    columns, checked = probed(), probed(8, every=60, hours=24.0)
    data = checked if how == "validate" else columns
    row = np.flatnonzero(np.isfinite(data["y_um"]))[-9]
    data["y_um"][row] += 20.0
    given = {"validate": checked} if how == "validate" else {"fit_until_h": 24.0}
    result = tc.identify(columns, y_std_um=STD_UM, order=(3, 3, 2), **given)
    part = next(p for p in result.calibration.parts if p.role == "held out")
    assert part.model.rms_um < 2.5
    assert 60.0 * row not in part.t_s
    assert f"at t_s = {60 * row} from the start." in " ".join(result.to_dict()["remarks"])


def test_the_command_takes_the_standard_deviation(tmp_path, capsys):
    from compensator.cli import main

    columns = probed()
    names = list(columns)
    rows = zip(*columns.values(), strict=True)
    lines = [",".join("" if np.isnan(v) else f"{v:.4f}" for v in row) for row in rows]
    data = tmp_path / "run.csv"
    data.write_text("\n".join([",".join(names), *lines]) + "\n")
    out = tmp_path / "m" / "model.toml"
    assert main(["identify", str(data), "--out", str(out), "--order", "3", "3", "2"]) == 2
    assert "--y-std UM" in capsys.readouterr().err
    assert main(["identify", str(data), "--out", str(out), "--order", "3", "3", "2", "--y-std", "1.5"]) == 0
    assert "measured values" in (tmp_path / "m" / "model-calibration.html").read_text()


def test_few_values_in_several_records_are_enough_for_a_small_structure():
    """Of 28 values in four parts a middle structure has 29 parameters: a smaller one shows how the records start."""
    records = [probed(seed, every=100, hours=12.0) for seed in range(3, 8)]
    assert sum(np.isfinite(one["y_um"]).sum() for one in records) == 35
    assert tc.identify(records, y_std_um=STD_UM).model.dtf.gain_with_std()[0] > 0.0
