"""Several axes: common time constants where the data permit, one estimation of the heat, pairs of probes."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import compensator as tc
from compensator.config import parse_config
from compensator.errors import ConfigError, DataError, ModelError, UsageError
from compensator.identify.output_error import Segment, Structure, fit_output_error
from compensator.identify.pairs import pairs
from compensator.identify.shared_poles import fit_shared
from compensator.model.model_file import load_axes, load_model
from compensator.tilt_lines import tilt_lines
from tests.identify.axes_data import machine
from tests.service.several import AXES, config_text

SPINDLE = Path(__file__).resolve().parents[3] / "shared/data/measured-spindle/spindle-15s.csv"


@pytest.fixture(scope="module")
def found():
    return tc.identify(machine(), name="machine", order=(2, 2, 2))


def test_axes_share_the_time_constants_that_the_data_permit_and_no_others(found):
    assert list(found) == ["x", "y", "z"]
    assert found.shared == (("y", "z"),)
    y, z = (found[axis].model for axis in ("y", "z"))
    assert y.dtf.sampled.a == z.dtf.sampled.a == y.tdtf.sampled.a
    assert found["x"].model.dtf.sampled.a != y.dtf.sampled.a
    assert [found["y"].params[f"dtf_tau_{i}_min"] for i in (1, 2)] == pytest.approx([30.0, 150.0], rel=0.05)
    for axis, gain in (("x", 2.0), ("y", 5.0), ("z", 7.0)):
        assert found[axis].params["dtf_gain_um_per_k"] == pytest.approx(gain, rel=0.03)


def test_parameters_and_their_errors_are_there_by_axis_as_the_models_are(found):
    assert list(found.params) == list(found.std_errors) == list(found.model)
    assert found.params["z"] == found["z"].params and found.std_errors["z"] == found["z"].std_errors


def test_axes_with_common_time_constants_have_the_order_that_the_data_permit():
    found = tc.identify(machine(axes=("y", "z")))
    assert found.shared == (("y", "z"),)
    for axis, gain in (("y", 5.0), ("z", 7.0)):
        assert [found[axis].params[f"dtf_tau_{i}_min"] for i in (1, 2)] == pytest.approx([30.0, 150.0], rel=0.05)
        assert "dtf_tau_3_min" not in found[axis].params
        assert found[axis].params["dtf_gain_um_per_k"] == pytest.approx(gain, rel=0.03)


def test_no_axis_is_clearly_worse_than_alone_and_its_errors_are_smaller(found):
    for axis in ("y", "z"):
        alone = tc.identify(machine(axes=(axis,)), order=(2, 2, 2))
        assert alone.calibration.folds_rms_um == pytest.approx(found.alone_rms_um[axis], rel=1e-6)
        assert found[axis].calibration.folds_rms_um <= 1.02 * found.alone_rms_um[axis]
        assert found[axis].std_errors["dtf_tau_2_min"] < alone.std_errors["dtf_tau_2_min"]


def test_the_standard_errors_of_common_poles_are_those_of_one_fit_of_all_data():
    """The same as one problem: the inputs of each output in rows of their own, which are 0 for the other output."""
    rng = np.random.default_rng(5)
    inputs = np.repeat(rng.normal(0.0, 1.0, 30), 40)
    truth = {"a": (2.0, 0.1), "b": (-5.0, 0.2)}
    pole = (2.0 * 25.0 - 1.0) / (2.0 * 25.0 + 1.0)
    response = lfilter([1.0 - pole], [1.0, -pole], inputs)
    y = {name: gain * response + rng.normal(0.0, noise, inputs.size) for name, (gain, noise) in truth.items()}
    structure = Structure(order=1, terms=(1,))
    together = fit_shared(
        [[Segment.of(inputs, y[name], rest=True)] for name in truth],
        [structure, structure],
        period_s=60.0,
        weights=[1.0 / noise for _, noise in truth.values()],
        starts=[[10.0]],
    )
    blank = np.zeros_like(inputs)
    rows = {"a": [inputs, blank], "b": [blank, inputs]}
    one = fit_output_error(
        [Segment.of(rows[name], y[name] / truth[name][1], rest=True) for name in truth],
        Structure(order=1, terms=(1, 1)),
        period_s=60.0,
        starts=[[10.0]],
    )
    assert together[0].taus_min == pytest.approx(one.taus_min, rel=1e-6)
    assert together[0].taus_std_min == pytest.approx(one.taus_std_min, rel=0.1)
    for j, (name, (_, noise)) in enumerate(truth.items()):
        gain, std = one.gain(j)
        assert together[j].gain()[0] == pytest.approx(gain * noise, rel=1e-6), name
        assert together[j].gain()[1] == pytest.approx(std * noise, rel=0.1), name


def test_one_file_has_the_heat_once_and_gives_every_axis_back(found, tmp_path):
    path = found.save(tmp_path / "machine.toml")
    models = load_axes(path)
    assert list(models) == ["x", "y", "z"]
    assert models["z"] == found.model["z"] and models["z"].axis == "z"
    text = path.read_text(encoding="utf-8")
    assert text.count("[estimator]") == text.count("[validity]") == 1
    assert load_model(path) == models["y"], "what knows Y alone gets Y"
    alone = tc.identify(machine(), axis="z", order=(2, 2, 2)).save(tmp_path / "z.toml")
    with pytest.raises(ModelError, match=r"z\.toml: a model of Z, expected one of Y"):
        load_model(alone)
    assert load_model(alone, axis="z").axis == "z"


def test_an_axis_that_was_measured_for_part_of_the_time_keeps_the_machines_heat():
    heat = machine(3)
    first, second = dict(heat), machine(4)
    del second["z_um"]
    both = tc.identify([first, second], axis=["y", "z"], order=(2, 2, 2))
    y, z = both["y"].model, both["z"].model
    assert y.estimator == z.estimator and y.validity == z.validity
    assert len(both["z"].calibration.runs) == 1 and len(both["y"].calibration.runs) == 2


def test_what_is_said_names_the_axis(found, tmp_path):
    page = found["z"].page(tmp_path / "z.html").read_text(encoding="utf-8")
    assert "Z, µm" in page and "Y, µm" not in page
    assert "z_um" in found["z"].predictions and "z_residual_um" in found["z"].predictions
    assert "noise" in found["z"].to_dict() and "z_um" in found["z"].to_dict()["noise"]
    short = {name: values[:90] for name, values in machine(axes=("z",)).items()}
    with pytest.raises(DataError) as error:
        tc.identify(short | {"z_um": np.zeros(90)}, axis="z")
    assert "y_um" not in str(error.value)
    whole = machine(axes=("z",))
    with pytest.raises(DataError, match=r"z_um = 0 in every row"):
        tc.identify(whole | {"z_um": np.zeros(whole["t_s"].size)}, axis="z")


def test_a_plot_has_the_panels_of_every_axis(found):
    labels = [panel.get_ylabel() for panel in found.plot().axes]
    assert labels == [label for one in ("X", "Y", "Z") for label in (f"{one}, µm", f"{one} residual, µm")]


@pytest.mark.usefixtures("without_pictures")
def test_the_summary_has_a_column_for_each_axis(found, tmp_path):
    text = found.summary()
    assert "Y and Z have common time constants" in text and "X has its own" in text
    head = next(line for line in text.splitlines() if line.split() == ["X", "Y", "Z"])
    assert head
    page = found.page(tmp_path / "all.html").read_text(encoding="utf-8")
    assert page.count("<h2>Axis ") == 3


def test_y_alone_is_as_if_there_were_no_other_axis():
    table = machine()
    alone = tc.identify(
        {name: values for name, values in table.items() if name not in ("x_um", "z_um")}, order=(2, 2, 2)
    )
    chosen = tc.identify(table, axis="y", order=(2, 2, 2))
    assert chosen.model.dtf == alone.model.dtf and chosen.model.tdtf == alone.model.tdtf
    assert chosen.to_dict()["parts"] == alone.to_dict()["parts"]


@pytest.mark.parametrize(
    ("axis", "words"),
    [
        ("Z", "name of an axis"),
        ("ch1_um", "name of an axis"),
        (["z", "z"], "given 2 times"),
        ("ch9", "no column ch9_um"),
    ],
)
def test_an_axis_that_cannot_be_is_refused_in_one_line(axis, words):
    with pytest.raises((UsageError, DataError), match=words):
        tc.identify(machine(), axis=axis)


def test_three_probes_that_move_alike_show_no_pair():
    slow = np.cumsum(np.random.default_rng(2).normal(0.0, 1.0, 1500))
    other = np.cumsum(np.random.default_rng(3).normal(0.0, 1.0, 1500))
    two = {"p1": [slow], "p2": [-0.7 * slow], "p3": [other]}
    [pair] = pairs(two, 60.0)
    assert (pair.first, pair.second) == ("p1", "p2") and pair.ratio == pytest.approx(-0.7)
    assert "against each other" in str(pair) and "contradict" in str(pair)
    assert not list(pairs(two | {"p4": [1.1 * slow]}, 60.0)), "which of three are the pair cannot be seen"
    assert not list(pairs({"x": [slow], "y": [slow], "p3": [other]}, 60.0)), "X and Y have directions of their own"
    [pair] = pairs(two | {"y_slope": [slow]}, 60.0)
    assert (pair.first, pair.second) == ("p1", "p2"), "the slope of an axis is no probe"


def test_the_lines_of_a_tilt_are_a_configuration_once_they_are_filled_in(tmp_path, without_pictures):
    table = machine(axes=("y",))
    low = table.pop("y_um")
    found = tc.identify(table | {"p1_um": low, "p2_um": 1.5 * low + 2.0}, axis=["p1", "p2"], order=(1, 1, 1))
    lines = found.tilt_lines()
    assert 'probes = ["p1", "p2"]' in lines and lines in found.summary() and "[axis.b]" not in lines
    assert f"seen: {0.5 * np.ptp(low):.1f} µm" in lines
    assert "axis.a" in found.page(tmp_path / "page.html").read_text(encoding="utf-8")
    text = config_text(AXES, lines).decode()
    with pytest.raises(ConfigError, match=r"axis\.a\.\w+ = 'FILL IN'") as error:
        parse_config(text.encode(), source="machine.toml")
    assert "\n" not in str(error.value)
    config = parse_config(text.replace('"FILL IN"', "150.0").encode(), source="machine.toml")
    assert config.axis.a.probes == ("p1", "p2") and config.axis.a.distance_mm == 150.0
    parts = load_axes(found.save(tmp_path / "machine.toml"))
    assert set(config.axis.a.probes) <= set(parts)


def test_probes_that_move_against_each_other_are_said_in_the_lines():
    slow = np.cumsum(np.random.default_rng(2).normal(0.0, 1.0, 1500))
    [pair] = pairs({"p1": [slow], "p2": [-0.7 * slow]}, 60.0)
    [alike] = pairs({"p1": [slow], "p2": [0.7 * slow]}, 60.0)
    # The sense in which one of them counts is no tilt.
    assert pair.apart_um == alike.apart_um == pytest.approx(0.3 * np.ptp(slow))
    both = ("p1", "p2")
    assert "against each other" in tilt_lines([(*both, 1.0)], against=[both])
    assert "against each other" not in tilt_lines([(*both, 1.0)])
    assert tilt_lines([(*both, 1.0)] * 3).count("[axis.") == 2, "a machine has two tilts"


@pytest.mark.skipif(not SPINDLE.exists(), reason="the measured spindle is not here")
def test_five_probes_of_the_measured_spindle_in_one_command():
    roles = {"t_q_degc": "t5_degc", "at_degc": "t16_degc"}
    probes = [f"ch{i}" for i in range(1, 6)]
    found = tc.identify(SPINDLE, columns=roles, axis=probes, order=(2, 2, 2))
    assert {frozenset(group) for group in found.shared} == {frozenset(("ch1", "ch2")), frozenset(("ch3", "ch4"))}
    assert [(one.first, one.second) for one in found.pairs] == [("ch1", "ch2"), ("ch3", "ch4")]
    assert "[axis.a]" in found.tilt_lines() and 'probes = ["ch3", "ch4"]' in found.tilt_lines().split("[axis.b]")[1]
    for axis, result in found.items():
        assert result.calibration.folds_rms_um <= 1.005 * found.alone_rms_um[axis], axis
