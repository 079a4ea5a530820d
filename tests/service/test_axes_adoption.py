"""Before another model takes over a machine of several axes, every measured axis is compared."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from compensator.audit.machine_audit import audit
from compensator.errors import ServiceError
from compensator.events import ComparisonData
from compensator.messages_axes import AxesEstimate
from compensator.model.model_file import parse_model
from compensator.recording.reading import messages
from compensator.report.gathering import read_history
from compensator.report.page import html_of
from compensator.report.recordings import page_of
from compensator.service.compensation import model_of
from compensator.service.transfer.second_opinion import described, refuse_if_worse, second_opinion, sensor_suspected
from tests.service.several import AXES, SENSORS, SeveralAxes, config_text, model_text, part
from tests.service.test_second_opinion import QUILL, day, gain  # noqa: F401

PARTS = ("y", "x", "z")


def stronger(name: str, factor: float) -> Any:
    """A part of the model whose growth by the heat is stronger."""
    model = part(name)
    numerator = tuple(factor * one for one in model.dtf.continuous.numerator)
    dtf = dataclasses.replace(model.dtf.continuous, numerator=numerator)  # type: ignore[type-var]
    return dataclasses.replace(model, dtf=type(model.dtf).from_continuous(dtf, 60.0))


def wrong(*names: str, factor: float = 1.4) -> bytes:
    return model_text(*PARTS, parts={name: stronger(name, factor) for name in names})


@pytest.fixture(scope="module")
def shift(tmp_path_factory: pytest.TempPathFactory) -> SeveralAxes:
    """Eight hours on record with the right model; it is asked to adopt one that is wrong on Z, twice."""
    machine = SeveralAxes(tmp_path_factory.mktemp("shift"), config_text(AXES), model_text(*PARTS), noise=True)
    asked: dict[bool, Any] = {}

    def adopt(*, force: bool) -> None:
        payload = json.dumps({"model": wrong("z").decode(), "force": force}).encode()
        asked[force] = machine.command("adopt", payload)

    def insist() -> None:
        if True not in asked and asked[False].done():
            adopt(force=True)

    machine.run(640, {480: lambda: adopt(force=False), **dict.fromkeys(range(481, 600), insist)})
    machine.asked = asked  # type: ignore[attr-defined]
    return machine


def opinion(machine: SeveralAxes, candidate: bytes, present: bytes | None = None) -> ComparisonData:
    config = machine.config
    models = (model_of(config, data, source="test") for data in (present or machine.configured, candidate))
    return second_opinion(machine.folder / "rec", config, *models)


def test_a_model_that_is_wrong_on_one_axis_is_refused_by_its_name_and_taken_by_force(shift: SeveralAxes) -> None:
    refused, forced = (shift.asked[force].result() for force in (False, True))  # type: ignore[attr-defined]
    assert refused["ok"] is False
    assert "is clearly worse on Z: last 8" in refused["text"]
    assert "measured Z is right, or use --force" in refused["text"]
    assert "\n" not in refused["text"]
    assert "Y" not in refused["text"]
    found = refused["comparison"]
    assert (found["verdict"], found["axes"]["x"]["verdict"], found["axes"]["z"]["verdict"]) == (
        "alike", "alike", "worse",
    )  # fmt: skip
    assert found["axes"]["z"]["candidate_rms_um"] > 3.0 * found["axes"]["z"]["present_rms_um"]
    assert found["axes"]["z"]["present_rms_um"] != found["present_rms_um"]
    assert forced["ok"] is True
    for axis in "XYZ":
        assert f"{axis}: last 8" in forced["text"]
    said = [event["data"] for event in shift.sent("event") if event["kind"] == "adopt"]
    assert [(one["ok"], one["comparison"]["axes"]["z"]["verdict"]) for one in said] == [
        (False, "worse"),
        (True, "worse"),
    ]


def test_what_was_foreseen_of_an_offset_is_what_it_does(shift: SeveralAxes) -> None:
    foreseen = shift.asked[True].result()["comparison"]["axes"]["z"]["offset_change_um"]  # type: ignore[attr-defined]
    swapped = next(
        i for i, one in enumerate(shift.outcomes) if one.offset.model_sha256 != shift.outcomes[0].offset.model_sha256
    )
    estimates = [shift.outcomes[i].estimate for i in (swapped - 1, swapped)]
    before, after = (one.axes["z_pred_um"] for one in estimates if isinstance(one, AxesEstimate))
    assert isinstance(before, float)
    assert isinstance(after, float)
    assert foreseen == pytest.approx(before - after, abs=1.5)
    assert abs(foreseen) > 3.0


def test_recording_and_page_show_every_axis(shift: SeveralAxes) -> None:
    events = [one for path in shift.recordings for one in messages(path, ("event",)) if one.kind == "adopt"]
    assert [set(one.data["comparison"]["axes"]) for one in events] == [{"x", "z"}] * 2
    assert audit(shift.recordings).clean
    page = html_of(page_of(read_history(shift.recordings)))
    worse = events[1].data["comparison"]["axes"]["z"]
    assert f"; Z {worse['present_rms_um']:.1f} → {worse['candidate_rms_um']:.1f}" in page


@pytest.mark.parametrize(
    ("names", "on"), [(("x",), "X"), (("y",), "Y"), (("y", "z"), "Y and Z")], ids=["x", "y", "y and z"]
)
def test_the_axes_on_which_it_is_worse_are_named(shift: SeveralAxes, names: tuple[str, ...], on: str) -> None:
    found = opinion(shift, wrong(*names, factor=1.6))
    model = model_of(shift.config, wrong(*names, factor=1.6), source="test")
    with pytest.raises(
        ServiceError, match=rf"is clearly worse on {on}: {names[0].upper() + ': ' if names[1:] else ''}last"
    ) as refused:
        refuse_if_worse(found, model, force=False)
    assert f"measured {on} is right" in str(refused.value)
    refuse_if_worse(found, model, force=True)


def test_better_on_one_axis_is_not_lost_in_another(shift: SeveralAxes) -> None:
    found = opinion(shift, model_text(*PARTS), wrong("z"))
    assert {axis: one.verdict for axis, one in found.by_axis().items()} == {"y": "alike", "x": "alike", "z": "better"}
    refuse_if_worse(found, parse_model(model_text(*PARTS), source="test"), force=False)


def test_an_axis_that_nothing_measures_judges_no_model(tmp_path: Path) -> None:
    bare = config_text(AXES).replace(SENSORS.encode(), b"")
    machine = SeveralAxes(tmp_path, bare, model_text(*PARTS))
    machine.run(5)
    found = opinion(machine, wrong("z"))
    assert found.axes == {}
    assert "axes" not in found.table()


def test_a_displacement_sensor_that_was_lost_is_said_of_its_axis(tmp_path: Path) -> None:
    machine = SeveralAxes(tmp_path, config_text(AXES), model_text(*PARTS))
    machine.device.sources[-1] = lambda: float("nan")
    machine.run(5)
    text = described(opinion(machine, wrong("z")))
    assert "Z: no verdict: no measured Z in the last 24 h of the recordings; the offset would move by" in text


def test_a_machine_with_y_alone_says_what_it_said(day: Any) -> None:  # noqa: F811
    found = day.opinion(QUILL, gain(0.4))
    assert found.table().keys() == {
        "verdict", "measured_by", "hours", "samples", "present_rms_um", "candidate_rms_um", "deviations", "effective",
        "offset_change_um", "ratio",
    }  # fmt: skip
    assert described(found).startswith("last 11.7 h: present ")
    with pytest.raises(ServiceError, match=r"\) is clearly worse: last 11\.7 h: present .* measured Y is right"):
        refuse_if_worse(found, parse_model(gain(0.4), source="test"), force=False)


def test_the_sensor_of_y_casts_no_doubt_on_another_axis(tmp_path: Path) -> None:
    """While measured Y is suspected, and nothing else, Z judges; while a temperature is, nothing does."""
    checks = "\n[plausibility]\nfalse_alarm_days = 365.0\nresidual_std_um = 2.0\nresidual_correlation_min = 240.0\n"
    machine = SeveralAxes(tmp_path, config_text(AXES) + checks.encode(), model_text(*PARTS), noise=True)
    y, count = machine.device.sources[2], [0]

    def moved() -> float:
        count[0] += 1
        return y() + 40.0 * (len(machine.outcomes) > 60)

    machine.device.sources[2] = moved
    machine.run(480)
    suspected = [sensor_suspected(one.offset.reasons) for one in machine.outcomes]
    assert sum(suspected) > 240
    found = opinion(machine, wrong("z"))
    assert found.axes["z"].verdict == "worse"
    assert found.verdict == "not_judged"
