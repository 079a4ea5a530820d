"""A model file that is written says the same as the model it comes from."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from compensator.errors import ModelError
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model, write_model
from compensator.model.thermal_model import EffectTable, Estimator, Path, ThermalModel
from compensator.model.transfer_function import SampledTransferFunction


def direct_model(**changes):
    path = Path(
        sampled=SampledTransferFunction(b=(0.1, -0.05), a=(1.0, -0.97), period_s=60.0),
        unit="um/K",
        covariance=((1e-6, 0.0, 1e-9), (0.0, 2e-6, 0.0), (1e-9, 0.0, 3e-8)),
    )
    estimator = Estimator(
        method="kalman", t_q_noise_std_k=0.02, at_noise_std_k=0.03, drive_walk_std=0.1, at_walk_std_k=0.1
    )
    model = ThermalModel(
        name="direct", kind="direct", period_s=60.0, ttf=None, dtf=path, tdtf=path, estimator=estimator, y_std_um=0.4
    )
    return dataclasses.replace(model, **changes)


def read_back(model):
    return dataclasses.replace(parse_model(dump_model(model).encode(), source="written"), sha256=model.sha256)


def test_the_published_model_survives():
    model = load_model("quill")
    assert read_back(model) == model


def test_sampled_paths_keep_every_bit_and_their_covariance():
    assert read_back(direct_model()) == direct_model()


def test_effects_and_nested_provenance_survive():
    model = direct_model(
        effects=(
            EffectTable(kind="input", table={"channel": "coolant_degc", "gain": 4.0, "curve": [1.0, 2.0], "on": True}),
            EffectTable(kind="gain", table={"path": "DTF", "std": {"gain": 0.5, "parts": [[1.0, 2.0], [3.0, 4.0]]}}),
        ),
        provenance={"data": [{"file": "a b.csv", "rows": 7}], "odd key": {"x y": "z"}, "empty": []},
    )
    assert read_back(model) == model


@given(st.text(max_size=40))
def test_any_text_survives(text):
    text = text.encode("utf-8", "replace").decode()
    assert read_back(direct_model(name=text, provenance={"note": text, text: 1})).provenance == {"note": text, text: 1}


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_any_number_survives_to_the_bit(value):
    assert math.copysign(1, read_back(direct_model(provenance={"x": value})).provenance["x"]) == math.copysign(1, value)
    assert read_back(direct_model(provenance={"x": value})).provenance["x"] == value


def test_a_number_that_is_not_finite_is_refused_by_name():
    with pytest.raises(ModelError, match=r"noise\.std = nan"):
        dump_model(direct_model(provenance={"noise": {"std": math.nan}}))


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    file = tmp_path / "model.toml"
    first = write_model(file, direct_model())
    with pytest.raises(ModelError):
        write_model(file, direct_model(provenance={"x": math.inf}))
    assert [p.name for p in tmp_path.iterdir()] == ["model.toml"]
    assert load_model(file).sha256 == first.sha256


def test_the_comment_gives_gain_and_standard_error():
    gain = (0.1 - 0.05) / 0.03
    assert f"Gain at rest {gain:.5g} +- " in dump_model(direct_model())
