"""The channels that a model needs: named by `check`, with the lines to paste, and by the diagnosis that finds them."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from compensator.channel_lines import channel_lines
from compensator.cli import main
from compensator.config import load_config
from compensator.demo.calibration import write_table
from compensator.model.model_file import load_model
from compensator.model.model_writer import write_axes
from tests.diagnose.scenarios import draw, record
from tests.reference.kept import KEPT

EXAMPLE = Path(__file__).resolve().parents[2] / "deploy/machine.example.toml"
MODEL = KEPT / "models/effects.toml"


def test_check_prints_the_lines_that_are_missing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["check", "--config", str(EXAMPLE), "--model", str(MODEL)]
    assert main([*words, "--json"]) == 2
    told = capfd.readouterr()
    found = json.loads(told.out)
    missing = found["missing_channels"]
    assert missing and found["ok"] is False
    assert len(told.err.splitlines()) == 1 and all(name in told.err for name in missing)
    assert main(words) == 2
    pasted = capfd.readouterr().out
    assert [one["name"] for one in tomllib.loads(pasted)["channel"]] == missing

    # With the lines in the configuration, and a device for them, the model can run.
    config = tmp_path / "machine.toml"
    units = [name.rpartition("_")[2] for name in missing]
    inputs = [f'{{ input = {i}, unit = "{unit}", address = {i}, type = "int16" }}' for i, unit in enumerate(units)]
    lines = '[[line]]\nname = "plc"\nprotocol = "modbus-tcp"\nhost = "192.168.10.30"\n[[device]]\nname = "signals"\n'
    lines += f'line = "plc"\nmodel = "modbus-map"\naddress = 1\ninputs = [{", ".join(inputs)}]\n\n'
    for i, one in enumerate(pasted.split("\n\n")):
        lines += one.replace('"DEVICE"\ninput = 0', f'"signals"\ninput = {i}') + "\n\n"
    config.write_text(EXAMPLE.read_text(encoding="utf-8") + lines, encoding="utf-8")
    assert {channel.name for channel in load_config(config).config.channel} >= set(missing)
    assert main(["check", "--config", str(config), "--model", str(MODEL)]) == 0


def test_check_names_the_parts_of_the_model_that_it_is_given(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    quill = dataclasses.replace(load_model("quill"), file=b"")
    write_axes(tmp_path / "several.toml", {"y": quill, "z": dataclasses.replace(quill, axis="z")})
    words = ["check", "--config", str(EXAMPLE), "--json"]
    assert main(words) == 0 and "axes" not in json.loads(capfd.readouterr().out)
    assert main([*words, "--model", str(tmp_path / "several.toml")]) == 0
    found = json.loads(capfd.readouterr().out)
    assert (found["axes"], found["unused_parts"]) == (["y"], ["z"])


def test_a_configured_model_without_its_channel_is_named_too(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "machine.toml"
    text = EXAMPLE.read_text(encoding="utf-8").replace('file = "quill"', f'file = "{MODEL}"')
    config.write_text(text, encoding="utf-8")
    assert main(["check", "--config", str(config)]) == 2
    assert "[[channel]]" in capfd.readouterr().out


@pytest.mark.usefixtures("without_pictures", "equal_questions_once")
def test_a_diagnosis_prints_the_lines_of_the_channels_it_adds(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    columns, _, _ = record([draw("input", 4)], 79, 10.0)
    write_table(tmp_path / "effect.csv", {"t_s": np.arange(columns["y_um"].size) * 60.0, **columns})
    assert main(["diagnose", str(tmp_path / "effect.csv"), "--model", "quill", "--out", str(tmp_path / "d")]) == 0
    out = capfd.readouterr().out
    listed = out[out.index("[[channel]]") :].split("\n\nmodel:")[0].split("\n\n")[0]
    (channel,) = tomllib.loads(listed)["channel"]
    seen = columns[channel["name"]]
    assert channel["range"][0] <= seen.min() and channel["range"][1] >= seen.max()
    assert channel["name"] in (tmp_path / "d" / "report.html").read_text(encoding="utf-8").split("[[channel]]")[1]


@pytest.mark.parametrize("seen", [(-1.4e-5, 0.02), (0.3, 0.34), (0.0, 3000.0), (18.0, 24.0), (5.0, 5.0)])
def test_the_range_proposed_holds_what_was_seen(seen: tuple[float, float]) -> None:
    [channel] = tomllib.loads(channel_lines(["flow_lpm"], {"flow_lpm": seen}))["channel"]
    low, high = channel["range"]
    assert low <= seen[0] and high > seen[1]
    assert low >= -0.001 or seen[0] >= 0.0
    assert high - low <= 3.5 * max(seen[1] - seen[0], 0.2)


def test_a_name_of_any_form_is_written_as_toml() -> None:
    assert tomllib.loads(channel_lines(['a"b\\c=1']))["channel"][0]["name"] == 'a"b\\c=1'
