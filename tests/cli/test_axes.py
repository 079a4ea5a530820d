"""Commands for a machine with several axes: columns, files and texts of each."""

import csv
import json

import pytest

import compensator as tc
from compensator.axes import AxisWords
from compensator.cli import main
from compensator.codes import DataRemark, Remark
from compensator.data.axes import words_of
from compensator.data.measurement import measurements
from compensator.display import Table, Words
from compensator.errors import DataError
from compensator.model.model_file import load_axes, load_model, parse_axes
from compensator.model.model_writer import dump_axes, dump_model
from compensator.report.results import pages_in
from tests.identify.axes_data import machine


def write(path, table):
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(zip(*table.values(), strict=True))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("axes")
    write(folder / "run.csv", machine())
    write(folder / "second.csv", machine(7))
    arguments = ["identify", str(folder / "run.csv"), "--order", "2", "2", "2", "--out", str(folder / "machine.toml")]
    assert main(arguments) == 0
    return folder


def columns_of(path):
    with path.open(encoding="utf-8") as file:
        return next(csv.reader(file))


def test_one_command_makes_one_model_and_one_page_of_all_axes(folder):
    assert list(load_axes(folder / "machine.toml")) == ["x", "y", "z"]
    page = (folder / "machine-calibration.html").read_text(encoding="utf-8")
    assert "Axis X" in page and "Z, µm" in page and "common time constants" in page
    [listed] = pages_in(folder)
    assert listed.verdict.startswith("X: ") and " Z: " in listed.verdict


def test_a_table_has_the_columns_of_all_axes_and_those_of_y_as_ever(folder, capsys):
    model, run = str(folder / "machine.toml"), str(folder / "second.csv")
    assert main(["simulate", run, "--model", model, "--out", str(folder / "all.csv"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found["axes"]) == {"x", "y", "z"} and found["axes"]["z"]["fit_pct"] > 90.0
    names = columns_of(folder / "all.csv")
    assert names.count("t_s") == names.count("heat_w") == 1
    assert {"y_pred_um", "residual_um", "z_pred_um", "z_residual_um", "x_um", "x_std_um"} <= set(names)
    assert main(["simulate", run, "--model", model, "--axis", "y", "--out", str(folder / "y.csv")]) == 0
    write(folder / "alone.csv", machine(7, axes=("y",)))
    one = folder / "y.toml"
    one.write_text(dump_model(load_model(folder / "machine.toml")), encoding="utf-8")
    assert main(["simulate", str(folder / "alone.csv"), "--model", str(one), "--out", str(folder / "y2.csv")]) == 0
    assert (folder / "y.csv").read_bytes() == (folder / "y2.csv").read_bytes()


def test_models_are_compared_for_every_axis_that_they_have(folder, capsys):
    arguments = ["compare", str(folder / "second.csv"), "--model", str(folder / "machine.toml"), "--json"]
    assert main([*arguments, "--out", str(folder / "compared.csv"), "--page", str(folder / "compared.html")]) == 0
    found = json.loads(capsys.readouterr().out)["axes"]
    for axis in ("x", "y", "z"):
        assert found[axis]["scores"]["machine"]["rms_um"] < 0.2 * found[axis]["scores"]["no compensation"]["rms_um"]
    assert "z_pred_um machine" in columns_of(folder / "compared.csv")
    assert main([*arguments, "--axis", "z"]) == 0
    assert "scores" in json.loads(capsys.readouterr().out)


def test_wrong_axes_are_refused_in_one_line(folder, capsys):
    model, run, out = str(folder / "machine.toml"), str(folder / "run.csv"), str(folder / "no.csv")
    write(folder / "only-y.csv", machine(axes=("y",)))
    for arguments, words in (
        (["simulate", run, "--model", model, "--axis", "a", "--out", out], "no axis a; it has: x, y, z"),
        (["simulate", run, "--model", "quill", "--axis", "z", "--out", out], "no axis z; it has: y"),
        (["identify", str(folder / "only-y.csv"), "--axis", "z", "--out", str(folder / "z.toml")], "no column z_um"),
        (["compare", run, "--model", model, "--model", model], "given 2 times"),
    ):
        assert main(arguments) == 2
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1


@pytest.mark.usefixtures("without_pictures")
def test_a_role_gives_an_axis_its_column(folder):
    table = machine(axes=("z",))
    table["probe_5"] = table.pop("z_um")
    write(folder / "named.csv", table)
    arguments = ["identify", str(folder / "named.csv"), "--column", "z_um=probe_5", "--order", "2", "2", "2"]
    assert main([*arguments, "--out", str(folder / "named.toml")]) == 0
    assert list(load_axes(folder / "named.toml")) == ["z"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("[axis.z.paths.DTF]", "[axis.z.paths.DTG]"), "axis.z: paths: unknown key"),
        (("[axis.x.uncertainty]", "[axis.x.estimator]"), "axis.x: unknown key"),
        (("[estimator]", "[paths.DTF]"), "paths: unknown key"),
        (("[axis.x.uncertainty]", "[uncertainty]"), "uncertainty: expected in the part of an axis"),
        (("[axis.z.", "[axis.Z."), "axis."),
    ],
)
def test_a_file_of_several_axes_is_refused_with_the_place(folder, change, words):
    text = (folder / "machine.toml").read_text(encoding="utf-8").replace(*change)
    with pytest.raises(Exception, match=r"m\.toml: ") as error:
        parse_axes(text.encode(), source="m.toml")
    assert words in str(error.value)


def test_axes_of_one_file_have_one_heat(folder):
    models, quill = load_axes(folder / "machine.toml"), load_model("quill")
    with pytest.raises(Exception, match="differs from that of axis"):
        dump_axes({"y": quill, "x": models["x"]})


def test_texts_of_an_axis_keep_channels_and_models_of_the_user():
    table = machine(axes=("y", "z"))
    table |= dict.fromkeys(("y_scale_um", "motor Y", "Y", "y_pred_um", "r"), table["at_degc"])
    words = words_of("z", measurements(table, "data"), models=["mill Y"])
    text = "y_scale_um, motor Y and mill Y; Y, y_um, y_pred_um, residual_um, y_scale_um_2"
    assert words(text) == "y_scale_um, motor Y and mill Y; Z, z_um, z_pred_um, z_residual_um, z_scale_um_2"
    assert words({"channel": "y_scale_um", "why": "y_scale_um moves Y"}) == {
        "channel": "y_scale_um",
        "why": "y_scale_um moves Z",
    }


@pytest.mark.parametrize("axis", ["z", "ch1", "y_slope"])
def test_texts_of_an_axis_are_made_once(axis):
    words = AxisWords(axis)
    text = words("no y_um; Y, y_pred_um, residual_um")
    assert text == f"no {axis}_um; {axis if axis != 'z' else 'Z'}, {axis}_pred_um, {axis}_residual_um"
    assert words(text) == text


def test_a_comparison_keeps_the_names_of_models(folder):
    models = {"mill Y": folder / "machine.toml", "again": folder / "machine.toml"}
    found = tc.compare(models, str(folder / "second.csv"), axis="z")
    assert "mill Y" in found.summary() and "mill Z" not in found.summary()


def test_texts_of_an_axis_keep_names_of_the_user_codes_and_options():
    words = AxisWords("z", frozenset({"/data/Y/y_um.csv"}))
    remark = words(Remark(DataRemark.WILD_READINGS, "/data/Y/y_um.csv: y_um: 3 outlier(s) left out."))
    assert remark.startswith("/data/Y/y_um.csv: z_um: 3") and remark.code is DataRemark.WILD_READINGS
    parts = words([Table(title="Y, µm", head=["y_pred_um"], rows=[["1"]]), Words(title="", lines=["Y moves"])])
    assert parts[0].title == "Z, µm" and parts[0].head == ["z_pred_um"] and parts[1].lines == ["Z moves"]
    assert words("--y-std UM (y_std_um in Python)") == "--y-std UM (y_std_um in Python)"
    with pytest.raises(DataError, match=r"^no z_um$"), words.errors():
        raise DataError("no y_um")
