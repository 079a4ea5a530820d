"""A model file that is written says the same as the model it comes from."""

import dataclasses
import datetime
import hashlib
import math
import os
import pathlib

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from compensator.errors import ModelError
from compensator.model.effects import effect_from
from compensator.model.effects.gain import Gain
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model, write_model
from compensator.model.thermal_model import Estimator, Path, ThermalModel
from compensator.model.transfer_function import SampledTransferFunction, TransferFunction

SAMPLED = Path(
    sampled=SampledTransferFunction(b=(0.1, -0.05), a=(1.0, -0.97), period_s=60.0),
    unit="um/K",
    covariance=((1e-6, 0.0, 1e-9), (0.0, 2e-6, 0.0), (1e-9, 0.0, 3e-8)),
)

INPUT = {"channel": "coolant_degc", "curve": "linear", "tau_min": [5.0], "gain": [4.0], "delay_min": 0.0}
GAIN = {"path": "DTF", "change": 0.1}


def direct_model(**changes):
    estimator = Estimator(
        method="kalman", t_q_noise_std_k=0.02, at_noise_std_k=0.03, drive_walk_std=0.1, at_walk_std_k=0.1
    )
    model = ThermalModel(
        name="direct",
        kind="direct",
        period_s=60.0,
        ttf=None,
        dtf=SAMPLED,
        tdtf=SAMPLED,
        estimator=estimator,
        y_std_um=0.4,
    )
    return dataclasses.replace(model, **changes)


def read_back(model):
    return dataclasses.replace(parse_model(dump_model(model).encode(), source="written"), sha256=model.sha256)


def test_the_published_model_survives():
    model = load_model("quill")
    assert read_back(model) == model


def test_a_model_as_it_was_read_is_written_as_its_own_file(tmp_path):
    own = tmp_path / "own.toml"
    own.write_bytes(b"# of the old machine\r\n" + dump_model(direct_model()).encode())
    model, copy = load_model(own), tmp_path / "copy.toml"
    assert write_model(copy, model).sha256 == model.sha256 and copy.read_bytes() == own.read_bytes()
    # What was changed since is another model.
    changed = dataclasses.replace(model, y_std_um=0.7)
    assert write_model(copy, changed).y_std_um == 0.7 and copy.read_text() == dump_model(changed)


def test_sampled_paths_keep_every_bit_and_their_covariance():
    assert read_back(direct_model()) == direct_model()


def test_effects_and_nested_provenance_survive():
    model = direct_model(
        effects=(
            effect_from("input", INPUT),
            effect_from("gain", GAIN | {"std": {"gain": 0.5, "parts": [1.0, 2.0]}}),
            effect_from("gain", GAIN | {"explanation": "Too low: µm."}),
        ),
        provenance={
            "data": [{"file": "a b.csv", "rows": 7}],
            "empty": [],
            "odd key": {"x y": "z", "parts": [[1.0, 2.0], [3.0]], "on": True},
        },
    )
    assert read_back(model) == model
    assert read_back(model).provenance["odd key"]["on"] is True  # 1 == True
    assert read_back(model).effects[2].explanation == "Too low: µm."
    assert read_back(model).effects[0].to_table() == INPUT


@given(st.text(max_size=40))
@example('"\\ \x00\x7f\x85\r\n\u2028 # µ')
@example("")
def test_any_text_survives(text):
    text = text.encode("utf-8", "replace").decode()
    model = direct_model(
        name="".join(filter(str.isprintable, text)), provenance={"note": text, text: [text, {text: [[text]]}]}
    )
    assert read_back(model) == model


@settings(deadline=None)  # the first call imports
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_any_number_survives_to_the_bit(value):
    assert math.copysign(1, read_back(direct_model(provenance={"x": value})).provenance["x"]) == math.copysign(1, value)
    assert read_back(direct_model(provenance={"x": value})).provenance["x"] == value


def test_dates_that_an_engineer_wrote_survive():
    noon = datetime.datetime(2020, 1, 2, 12, 0, 0, 500, tzinfo=datetime.UTC)
    model = direct_model(provenance={"day": noon.date(), "at": noon, "local": noon.replace(tzinfo=None)})
    assert read_back(model) == model


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"provenance": {"noise": {"std": math.nan}}}, r"provenance\.noise\.std = nan"),
        ({"validity": {"at_degc": (15.0, math.inf)}}, r"validity\.at_degc = inf"),
        ({"y_std_um": math.nan}, r"uncertainty\.y_std_um = nan"),
        ({"effects": (Gain(path="DTF", change=0.1, std={"parts": [-math.inf]}),)}, r"effect 1\.std\.parts = -inf"),
        ({"dtf": dataclasses.replace(SAMPLED, covariance=((math.nan,) * 3,) * 3)}, r"paths\.DTF\.covariance = nan"),
    ],
)
def test_a_number_that_is_not_finite_is_refused_by_name(changes, message):
    with pytest.raises(ModelError, match=message):
        dump_model(direct_model(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"provenance": {"who": None}}, r"provenance\.who = None"),
        (
            {"dtf": dataclasses.replace(SAMPLED, covariance=((1.0, 1.0, 1.0),))},
            r"paths\.DTF\.covariance: expected 3 rows",
        ),
    ],
)
def test_what_a_file_cannot_say_is_refused_by_name(changes, message):
    with pytest.raises(ModelError, match=message):
        dump_model(direct_model(**changes))


@pytest.mark.parametrize("bad", [{"provenance": {"x": math.inf}}, {"y_std_um": -1.0}, {"validity": {"x": (3.0, 1.0)}}])
def test_a_model_that_cannot_be_written_or_read_leaves_the_old_file_and_nothing_else(tmp_path, bad):
    file = tmp_path / "model.toml"
    first = write_model(file, direct_model())
    with pytest.raises(ModelError):
        write_model(file, direct_model(**bad))
    assert [p.name for p in tmp_path.iterdir()] == ["model.toml"]
    assert load_model(file).sha256 == first.sha256


def test_a_disk_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    file = tmp_path / "model.toml"
    first = write_model(file, direct_model())
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_model(file, direct_model(name="second"))
    assert [p.name for p in tmp_path.iterdir()] == ["model.toml"]
    assert load_model(file) == first


def test_what_was_written_comes_back_even_under_the_name_of_a_built_in_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written = write_model(pathlib.Path("quill"), direct_model())
    assert dataclasses.replace(written, sha256="") == direct_model()
    assert written.sha256 == hashlib.sha256((tmp_path / "quill").read_bytes()).hexdigest()


def test_a_damaged_name_does_not_stop_the_writing(tmp_path):
    assert write_model(tmp_path / "model.toml", direct_model(name="run\udcff")).name == "run?"


def test_the_comment_gives_gain_and_standard_error():
    b, a = SAMPLED.sampled.b, SAMPLED.sampled.a
    at = np.array([*b, *a[1:]])

    def gain(x):
        return (x[0] + x[1]) / (1.0 + x[2])

    slope = np.array([(gain(at + h) - gain(at - h)) / 2e-6 for h in 1e-6 * np.eye(3)])
    std = math.sqrt(slope @ np.array(SAMPLED.covariance) @ slope)
    assert f"T_Q - AT to deformation. Gain at rest {gain(at):.5g} +- {std:.2g} um/K" in dump_model(direct_model())


def test_a_standard_error_lost_to_rounding_is_not_written():
    # Two slow poles: the variance of the gain is far below the rounding of the covariance of b and a.
    a = tuple(np.poly([0.9999, 0.9998]).tolist())
    b = (1e-8, 1e-8)
    deviation = np.array([1e-9, 1e-9, 0.1, -0.1])
    covariance = tuple(tuple(row) for row in np.outer(deviation, deviation).tolist())
    path = Path(sampled=SampledTransferFunction(b=b, a=a, period_s=60.0), unit="um/K", covariance=covariance)
    assert "Gain at rest 1 um/K." in dump_model(direct_model(dtf=path))
    known = dataclasses.replace(path, gain_std=0.25)
    assert "Gain at rest 1 +- 0.25 um/K (one standard error)." in dump_model(direct_model(dtf=known))
    assert read_back(direct_model(dtf=known)).dtf == known


def test_the_comment_gives_time_constants_and_zeros():
    text = dump_model(load_model("quill"))
    assert "Time constants: 12.82, 76.34 min. Zeros: s = -2, -0.01588 1/min." in text
    assert "Time constants: 1.667 min. Zeros: none." in text
    assert "Zeros: z = 0.5." in dump_model(direct_model())


def test_a_pole_faster_than_the_sampling_keeps_its_time_constant_in_the_comment():
    fast = TransferFunction(numerator=(1.0,), denominator=(1.0, 0.05), unit="um/K")  # a pole at z = -0.82
    assert "Time constants: 0.05 min." in dump_model(direct_model(dtf=Path.from_continuous(fast, 60.0)))


@pytest.mark.parametrize(
    "path",
    [
        Path(sampled=SampledTransferFunction(b=(0.1,), a=(1.0, -1.0), period_s=60.0), unit="um/K"),
        Path.from_continuous(TransferFunction(numerator=(1.0,), denominator=(0.0, 1.0), unit="um/K"), 60.0),
    ],
)
def test_an_alternative_that_integrates_is_written(path):
    model = direct_model(alternatives={"drift away": ("DTF", path)})
    assert "Stands in for DTF. No gain at rest" in dump_model(model)
    assert read_back(model) == model


def test_a_unit_cannot_break_out_of_its_comment():
    odd = dataclasses.replace(SAMPLED, unit='um/K"; name = 3 # \\')
    model = direct_model(alternatives={"odd": ("DTF", odd)})
    assert read_back(model) == model
