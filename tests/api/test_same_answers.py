"""Each command and its verb agree to the last digit, from files, from arrays, and from DataFrames."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import compensator as tc
from compensator.api import diagnosis, identification
from compensator.cli import main
from compensator.demo.calibration import write_table
from tests.api.tables import arrays, by_time, frame, write_run
from tests.audit.made import Service
from tests.diagnose.scenarios import draw, record
from tests.identify.quill_runs import CALIBRATION_W, VALIDATION_W
from tests.shared_folder import search_once

FORMS: dict[str, Callable[[Path], Any]] = {
    "path": lambda path: path,
    "text": str,
    "arrays": arrays,
    "frame": frame,
    "by_time": by_time,
    "read": tc.read,
}
ORDER = ("--order", 1, 1, 1)
forms = pytest.mark.parametrize("form", FORMS)
#: A text is taken for a path in one place.
long_forms = pytest.mark.parametrize("form", [form for form in FORMS if form != "text"])


pytestmark = pytest.mark.usefixtures("equal_pictures_once")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of the published machine, and one with an effect that its model lacks."""
    folder = tmp_path_factory.mktemp("runs")
    write_run(folder / "run.csv", CALIBRATION_W, 1)
    write_run(folder / "other.csv", VALIDATION_W, 2)
    columns, _, _ = record([draw("input", 4)], 79, 10.0)
    logged = {name: columns[name] for name in ("t_q_degc", "at_degc", "y_um", "spindle_rpm", "coolant_degc")}
    write_table(folder / "effect.csv", {"t_s": np.arange(columns["y_um"].size) * 60.0, **logged})
    return folder


def said(*words: object) -> str:
    """Run a command; return what it printed."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main([*map(str, words)]) == 0
    return out.getvalue()


def printed_by(*words: object) -> dict[str, Any]:
    """Run a command; return its JSON."""
    return json.loads(said(*words, "--json"))


def command(*words: object) -> tuple[dict[str, Any], str]:
    """Run a command twice; return its JSON and its text. The second one prints what the first one has found."""
    found: list[Any] = []

    def once(original: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any, **settings: Any) -> Any:
            if not found:
                found.append(original(*arguments, **settings))
            return found[0]

        return called

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identification, "calibrate", once(identification.calibrate))
        patch.setattr(diagnosis, "find_effects", once(diagnosis.find_effects))
        return printed_by(*words), said(*words)


@pytest.fixture(scope="module")
def identified(folder: Path) -> tuple[dict[str, Any], str]:
    run, other, out = folder / "run.csv", folder / "other.csv", folder / "identified" / "made.toml"
    return command("identify", run, "--validate", other, *ORDER, "--reference", "quill", "--out", out)


@pytest.fixture(scope="module")
def diagnosed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str]:
    with pytest.MonkeyPatch.context() as patch:
        search_once(patch, tmp_path_factory)
        return command("diagnose", folder / "effect.csv", "--model", "quill", "--out", folder / "diagnosis")


def as_json(found: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(found))


def content(model: Path) -> dict[str, Any]:
    """A model file without the names of its sources: a table in memory has none."""
    read = tomllib.loads(model.read_text(encoding="utf-8"))
    provenance = read["provenance"]
    for part in (provenance, provenance.get("diagnosis", {})):
        part.pop("data", None)
    for key in ("free_run", "parts", "remarks", "warnings"):
        for part in provenance.get(key, []):
            part.pop("name", None) if isinstance(part, dict) else None
    return read


def without_names(found: dict[str, Any]) -> dict[str, Any]:
    lists = {
        name: [{key: value for key, value in part.items() if key != "name"} for part in found[name]]
        for name in ("free_run", "parts")
        if name in found
    }
    return found | lists


@long_forms
def test_identify(tmp_path: Path, folder: Path, form: str, identified: tuple[dict[str, Any], str]) -> None:
    printed, text = dict(identified[0]), identified[1]
    out, of = folder / "identified" / "made.toml", FORMS[form]
    found = tc.identify(
        of(folder / "run.csv"), validate=of(folder / "other.csv"), order=(1, 1, 1), reference="quill", name="made"
    )
    assert found.save(tmp_path / "saved.toml") == tmp_path / "saved.toml"
    files = {key: printed.pop(key) for key in ("model", "model_sha256", "report")}
    if form in ("path", "read"):
        assert as_json(found.to_dict()) == printed
        assert text.startswith(found.summary() + "\n\nmodel: ")
        assert (tmp_path / "saved.toml").read_bytes() == out.read_bytes()
        assert found.model.sha256 == files["model_sha256"] == tc.load_model(out).sha256
        found.page(tmp_path / "saved.html")
        assert (tmp_path / "saved.html").read_bytes() == (out.with_name(f"{out.stem}-calibration.html")).read_bytes()
    else:
        assert without_names(as_json(found.to_dict())) == without_names(printed)
        assert content(tmp_path / "saved.toml") == content(out)
        source = found.model.provenance["data"][0]
        assert (source["role"], source["table"], source["rows"]) == ("fit", "data", 720)
        assert set(source["columns"]) == {"t_q_degc", "at_degc", "y_um", "heat_w"} and len(source["sha256"]) == 64
    params = {f"dtf_tau_{i}_min": tau["value"] for i, tau in enumerate(printed["paths"]["DTF"]["tau_min"], start=1)}
    assert params.items() <= found.params.items() and found.params.keys() == found.std_errors.keys()
    assert found.std_errors["tdtf_gain_um_per_k"] == printed["paths"]["TDTF"]["gain"]["std"]


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    ("words", "options"),
    [
        (
            ["--method", "I", "--tdtf", 7, 120, "--kind", "heat", "--ttf", 1, 1, 0],
            {"method": "I", "tdtf": (7, 120), "kind": "heat", "ttf": (1, 1, 0)},
        ),
        (
            ["--method", "III", "--etve-end", 4, "--folds", 3, "--drive", "known"],
            {"method": "III", "etve_end_h": 4, "folds": 3, "drive": "known"},
        ),
        (["--kind", "direct", "--fit-until", 8], {"kind": "direct", "fit_until_h": 8}),
    ],
    ids=("method I", "method III", "fit until"),
)
def test_options_of_identify(tmp_path: Path, folder: Path, words: list[object], options: dict[str, Any]) -> None:
    etve = ["--etve", folder / "other.csv"] if "III" in words else []
    printed = printed_by(
        "identify", folder / "run.csv", "--out", tmp_path / "model.toml", "--order", 1, 1, 1, *etve, *words
    )
    found = tc.identify(folder / "run.csv", order=(1, 1, 1), etve=etve[1:], **options)
    assert found.model.sha256 == printed["model_sha256"]


@forms
def test_simulate(tmp_path: Path, folder: Path, form: str) -> None:
    other, out = folder / "other.csv", tmp_path / "out.csv"
    printed, text = command("simulate", other, "--model", "quill", "--out", out)
    found = tc.simulate("quill", FORMS[form](other))
    assert text == f"{found.summary()}\ntable: {out}\n"
    found.save(tmp_path / "saved.csv")
    assert (tmp_path / "saved.csv").read_bytes() == out.read_bytes()
    with out.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(found)
    for name in rows[0]:
        written = [float(row[name] or "nan") for row in rows]
        np.testing.assert_array_equal(written, np.asarray(found[name]))
    assert isinstance(found, pd.DataFrame) == (form in ("frame", "by_time"))
    result = found.result if isinstance(found, pd.DataFrame) else found
    assert as_json(result.to_dict()) | {"out": str(out)} == printed
    assert found.scores.rms_um == printed["rms_um"]


@pytest.mark.usefixtures("equal_questions_once")
@long_forms
def test_diagnose(tmp_path: Path, folder: Path, form: str, diagnosed: tuple[dict[str, Any], str]) -> None:
    (printed, text), out = diagnosed, folder / "diagnosis"
    found = tc.diagnose("quill", FORMS[form](folder / "effect.csv"))
    wanted = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert without_names(as_json(found.to_dict())) == without_names(wanted)
    assert without_names(as_json(found.to_dict())).items() <= without_names(printed).items()
    assert found.verdict == printed["verdict"] == "explained"
    assert [(e.kind, e.channel, e["rms_after_um"]) for e in found.effects] == [
        (e["kind"], e["channel"], e["rms_after_um"]) for e in printed["effects"]
    ]
    found.save(tmp_path / "saved")
    found.save(tmp_path / "saved.toml")
    saved = json.loads((tmp_path / "saved" / "diagnosis.json").read_text(encoding="utf-8"))
    assert saved == as_json(found.to_dict())
    names: list[str] = []
    if form in ("path", "read"):
        names = ["diagnosis.json", "model.toml", "report.html"]
        assert text.startswith(found.summary() + "\n\nmodel: ")
        assert found.model.sha256 == printed["model_sha256"]
        assert (tmp_path / "saved.toml").read_bytes() == (out / "model.toml").read_bytes()
    assert content(tmp_path / "saved.toml") == content(out / "model.toml")
    for name in names:
        assert (tmp_path / "saved" / name).read_bytes() == (out / name).read_bytes()


@pytest.mark.usefixtures("without_pictures")
def test_a_model_handed_over_in_python_is_diagnosed_as_its_file_is(tmp_path: Path, folder: Path) -> None:
    # The calibration's own error decides what a diagnosis looks for: it comes along without a file.
    found = tc.identify(folder / "run.csv", order=(2, 2, 2))
    found.save(tmp_path / "model.toml")
    printed = printed_by("diagnose", folder / "effect.csv", "--model", tmp_path / "model.toml", "--out", tmp_path / "d")
    with ThreadPoolExecutor(2) as executor:
        why = tc.diagnose(found.model, frame(folder / "effect.csv"), executor=executor)
    assert without_names(as_json(why.to_dict())).items() <= without_names(printed).items()
    assert content(why.save(tmp_path / "why.toml")) == content(tmp_path / "d" / "model.toml")
    provenance = why.model.provenance["diagnosis"]
    assert provenance["base_model_sha256"] == found.model.sha256 == tc.load_model(tmp_path / "model.toml").sha256


def test_recordings_and_export(tmp_path: Path) -> None:
    Service(tmp_path / "rec").run(20).stop()
    Service(tmp_path / "rec", seq=20).run(10).stop()
    recordings = sorted((tmp_path / "rec").glob("*.mcap"))
    printed = printed_by("export", *recordings, "--out", tmp_path / "command.csv")
    assert tc.export(recordings, tmp_path / "verb.csv") == printed["samples"] == 30
    assert (tmp_path / "verb.csv").read_bytes() == (tmp_path / "command.csv").read_bytes()
    assert tc.export(str(recordings[0]), str(tmp_path / "one.csv")) == 20
    # Recordings that follow each other are one record; a page names each of them.
    data = tc.compare({"quill": "quill"}, recordings).as_page().data
    assert list(data) == [path.name for path in recordings]
    simulated = tc.simulate("quill", tc.read(recordings))
    assert simulated["t_s"].size == 30
    for data in (recordings[::-1], tmp_path / "verb.csv", frame_of_text(tmp_path / "verb.csv")):
        np.testing.assert_array_equal(tc.simulate("quill", data)["y_pred_um"], simulated["y_pred_um"])


def frame_of_text(path: Path) -> pd.DataFrame:
    return pd.read_csv(path)
