"""A service of several axes: each is decided, recorded, published, held, restarted and audited with the same sample."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.audit.machine_audit import audit
from compensator.audit.other_model import compare
from compensator.cli import main
from compensator.config import LoadedConfig, parse_config
from compensator.errors import CompensatorError, ConfigError, ModelError, ServiceError
from compensator.messages import Offset, encode, schemas, shipped_schema
from compensator.messages_axes import AXES_MESSAGES, AxesEstimate, further_values
from compensator.model.effects import effect_from
from compensator.model.model_file import load_model
from compensator.model.thermal_model import Path as ModelPath
from compensator.model.thermal_model import ThermalModel
from compensator.recording.live_file import RecordingFile
from compensator.recording.reading import messages
from compensator.service.compensation import Compensation, Outcome, model_of
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.status import Zero
from compensator.service.transfer.restart import resume
from tests.audit import made
from tests.audit.attacks import rechained_all
from tests.audit.tampering import Line
from tests.service.records import sample
from tests.service.several import (
    AXES,
    LIMITS,
    SENSORS,
    SLOPE,
    TILT,
    SeveralAxes,
    by_axis,
    config_text,
    model_text,
    part,
)

EVERY = (AXES, TILT, SLOPE)
PARTS = ("y", "x", "z", "low", "high", "y_slope")
#: Signal of the simulated machine that each value corrects.
TRUTHS = {"x": "x_um", "y": "y_um", "z": "z_um", "y_slope": "y_slope_um_per_m"}


def compensation(*tables: str, model: bytes | None = None, **replaced: str) -> Compensation:
    """A compensation without a service."""
    config = parse_config(config_text(*(tables or EVERY), **replaced), source="test")
    return Compensation(config, model_of(config, model or model_text(*PARTS), source="test"))


def processed(running: Compensation, count: int, first: int = 0, **changed: float) -> list[Outcome]:
    """Process samples of a machine that works; `changed` replaces channels."""
    return [
        running.process(sample(first + i, values | {"x_um": 1.0, "z_um": 2.0} | changed))
        for i, values in enumerate(made.readings(count, first))
    ]


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> SeveralAxes:
    """Six hours of a machine with X, Y, Z, a tilt and a slope, with one restart."""
    machine = SeveralAxes(tmp_path_factory.mktemp("axes"), config_text(*EVERY), model_text(*PARTS))
    truths: list[dict[str, float]] = []
    names = [*TRUTHS.values(), "low_um", "high_um"]
    note = {i: lambda: truths.append({name: machine.world.truth(name) for name in names}) for i in range(1, 301)}
    machine.run(300, note)
    machine.run(60)
    machine.truths = truths  # type: ignore[attr-defined]
    return machine


def test_every_axis_tilt_and_slope_is_corrected(day: SeveralAxes) -> None:
    truths = day.truths  # type: ignore[attr-defined]
    left: dict[str, list[float]] = {}
    moved: dict[str, list[float]] = {}
    for truth, outcome in list(zip(truths, day.outcomes, strict=False))[1:]:
        offsets = by_axis(outcome)
        values = {axis: offsets[axis].y_offset_um for axis in "xyz"}
        values["y_slope"] = offsets["y"].y_slope_um_per_m
        true = {name: truth[signal] for name, signal in TRUTHS.items()}
        values["a"], true["a"] = offsets["a"].y_offset_um, (truth["high_um"] - truth["low_um"]) / 200.0 * 1000.0
        for name, value in values.items():
            left.setdefault(name, []).append(true[name] + value)
            moved.setdefault(name, []).append(true[name])
    for name, errors in left.items():
        assert np.ptp(moved[name]) > 5.0
        assert np.std(errors) < 0.1 * np.ptp(moved[name]), name


def test_all_axes_of_a_sample_have_one_number_and_are_named(day: SeveralAxes) -> None:
    for outcome in day.outcomes[:3] + day.outcomes[-3:]:
        offsets = by_axis(outcome)
        assert list(offsets) == ["y", "x", "z", "a"]
        assert {(one.seq, one.time_utc_ns, one.valid_for_s) for one in offsets.values()} == {
            (outcome.offset.seq, outcome.offset.time_utc_ns, 150.0)
        }
        assert all(one.axes == ["x", "y", "z", "a"] for one in offsets.values())
    sent = day.sent("a_offset")[-1]
    assert (sent["axis"], sent["acts_on"], sent["reference_mm"]) == ("a", "y", 120.0)
    assert {"a_offset_urad", "a_offset_rate_urad_per_min", "a_offset_std_urad"} <= set(sent)
    sent = day.sent("offset")[-1]
    assert sent["reference_mm"] == 300.0
    assert {"y_offset_um", "y_slope_um_per_m", "y_slope_rate_um_per_m_per_min", "y_slope_std_um_per_m"} <= set(sent)
    assert list(day.sent("status")[-1]["axes"]) == ["x", "y", "z", "a"]


def test_what_is_published_of_an_axis_is_on_disk_as_it_was(day: SeveralAxes) -> None:
    recorded = [encode(one) for path in day.recordings for one in messages(path, ("offset",))]
    further = [one for path in day.recordings for one in messages(path, ("offsets",))]
    for axis in "xza":
        assert [encode(getattr(one, axis)) for one in further] == [
            data for name, data in day.published if name == f"{axis}_offset"
        ]
    assert recorded == [data for name, data in day.published if name == "offset"]
    assert len(recorded) == len(further) == 360


def test_a_restart_continues_every_axis_to_the_bit(day: SeveralAxes, tmp_path: Path) -> None:
    whole = SeveralAxes(tmp_path, config_text(*EVERY), model_text(*PARTS))
    whole.run(330)
    for one, other in zip(whole.outcomes, day.outcomes, strict=False):
        assert [encode(offset) for offset in by_axis(one).values()] == [
            encode(offset) for offset in by_axis(other).values()
        ]


def test_the_audit_decides_every_axis_again(day: SeveralAxes) -> None:
    found = audit(day.recordings)
    assert found.clean, (found.findings, found.difference)
    assert found.samples == 360


@pytest.mark.parametrize(
    ("topic", "path"),
    [
        ("offsets", ("z", "z_offset_um")),
        ("offsets", ("a", "a_offset_urad")),
        ("offset", ("y_slope_um_per_m",)),
        ("estimate", ("axes", "z_pred_um")),
    ],
)
def test_a_changed_value_of_an_axis_is_found_though_the_chain_fits(
    day: SeveralAxes, tmp_path: Path, topic: str, path: tuple[str, ...]
) -> None:
    def edited(lines: list[Line]) -> list[Line]:
        index = [i for i, line in enumerate(lines) if line.topic == topic][20]
        table = json.loads(lines[index].data)
        (table[path[0]] if len(path) > 1 else table)[path[-1]] += 0.5
        lines[index] = dataclasses.replace(lines[index], data=json.dumps(table, separators=(",", ":")).encode())
        return lines

    paths = [tmp_path / own.name for own in day.recordings]
    for copy, own in zip(paths, day.recordings, strict=True):
        copy.write_bytes(own.read_bytes())
    rechained_all(paths[:1], edited)
    difference = audit(paths[:1]).difference
    assert difference is not None
    assert difference.topic == topic
    assert [field.name for field in difference.fields] == [".".join(path)]


def test_an_offset_that_is_missing_or_of_no_axis_is_found(day: SeveralAxes, tmp_path: Path) -> None:
    def removed(lines: list[Line]) -> list[Line]:
        index = [i for i, line in enumerate(lines) if line.topic == "offsets"][20]
        return lines[:index] + lines[index + 1 :]

    path = tmp_path / day.recordings[0].name
    path.write_bytes(day.recordings[0].read_bytes())
    rechained_all([path], removed)
    difference = audit([path]).difference
    assert difference is not None
    assert difference.topic == "offsets"
    # A line for each axis, not one of all.
    assert [field.name for field in difference.fields] == [f"message of {axis}" for axis in "xza"]
    assert all(field.recorded is None and field.recomputed["axis"] in field.name[-1] for field in difference.fields)
    assert max(map(len, difference.lines())) < 600


@pytest.mark.parametrize("topic", ["offsets", "offset", "estimate"])
@pytest.mark.parametrize("apart", [False, True])
def test_a_second_value_beside_the_true_one_is_found_though_the_chain_fits(
    day: SeveralAxes, tmp_path: Path, topic: str, apart: bool
) -> None:
    """A reader may meet the false one first; a replay that only looks for its own would pass both."""

    def doubled(lines: list[Line]) -> list[Line]:
        at = [i for i, line in enumerate(lines) if line.topic == topic][20]
        false = dataclasses.replace(lines[at], data=lines[at].data.replace(b"_um", b"_Um", 1))
        end = next(i for i in range(at, len(lines)) if lines[i].topic == "chain")
        return [*lines[: end + 1], false, lines[end], *lines[end + 1 :]] if apart else [*lines[:at], false, *lines[at:]]

    path = tmp_path / day.recordings[0].name
    path.write_bytes(day.recordings[0].read_bytes())
    rechained_all([path], doubled)
    found = audit([path])
    assert found.differing or found.findings_count, "passed"
    if topic == "offsets" and found.difference is not None:
        assert max(map(len, found.difference.lines())) < 600


def test_y_is_what_it_is_without_the_other_axes() -> None:
    """Nothing leads from the other axes to the heat or to Y."""
    both = compensation(AXES, TILT)
    config = parse_config(made.CONFIG + SENSORS.encode(), source="test")
    alone = Compensation(config, model_of(config, model_text("y"), source="test"))
    for one, other in zip(processed(both, 150), processed(alone, 150), strict=True):
        assert one.estimate.heat_w == pytest.approx(other.estimate.heat_w, abs=1e-6)
        assert one.offset.y_offset_um == pytest.approx(other.offset.y_offset_um, abs=1e-6)
        assert one.offset.y_offset_std_um == pytest.approx(other.offset.y_offset_std_um, abs=1e-6)


def test_a_machine_with_y_alone_sees_none_of_this() -> None:
    config = parse_config(made.CONFIG + SENSORS.encode(), source="test")
    alone = Compensation(config, model_of(config, model_text("y", "z"), source="test"))
    outcome = processed(alone, 3)[-1]
    assert type(outcome.offset) is Offset
    assert outcome.further == ()
    assert b"axes" not in encode(outcome.estimate) + encode(outcome.offset)
    table = json.loads(alone.state())
    assert "axes" not in table
    assert "outputs" not in table["memory"]["estimate"]


def test_each_axis_has_its_own_limits_and_its_own_reasons() -> None:
    running = compensation(AXES, **{"offset_rate_max_um_per_min = 4.0": "offset_rate_max_um_per_min = 0.01"})
    outcomes = processed(running, 60)
    offsets = [by_axis(outcome) for outcome in outcomes]
    steps = np.abs(np.diff([one["x"].y_offset_um for one in offsets]))
    assert steps.max() == pytest.approx(0.01)
    assert offsets[-1]["x"].reasons == ["rate_limited"]
    assert (offsets[-1]["z"].state, offsets[-1]["y"].state) == ("ok", "ok")


def test_a_lost_temperature_is_every_axis_s_and_a_lost_channel_of_an_effect_its_own() -> None:
    effect = effect_from(
        "input", {"channel": "coolant_degc", "curve": "linear", "tau_min": [9.0], "gain": [2.0], "delay_min": 0.0}
    )
    model = model_text("y", "x", parts={"z": part("z", effect)})
    running = compensation(AXES, model=model)
    processed(running, 30)
    offsets = by_axis(processed(running, 1, 30, coolant_degc=np.nan)[-1])
    assert {axis: one.reasons for axis, one in offsets.items()} == {
        "y": [],
        "x": [],
        "z": ["channel_missing:coolant_degc"],
    }
    offsets = by_axis(processed(running, 1, 31, t_q_degc=np.nan)[-1])
    assert all("predicting" in one.reasons for one in offsets.values())
    offsets = by_axis(processed(running, 15, 32, t_q_degc=np.nan)[-1])
    assert all(one.state == "hold" and one.y_offset_rate_um_per_min == 0.0 for one in offsets.values())


def test_an_effect_of_one_axis_acts_on_this_axis_alone() -> None:
    effect = effect_from(
        "input", {"channel": "coolant_degc", "curve": "linear", "tau_min": [9.0], "gain": [2.0], "delay_min": 0.0}
    )
    plain = compensation(AXES)
    extended = compensation(AXES, model=model_text("y", "x", parts={"z": part("z", effect)}))
    for running in (plain, extended):
        processed(running, 5)
    one, other = (by_axis(processed(running, 60, 5, coolant_degc=25.0)[-1]) for running in (plain, extended))
    assert one["y"].y_offset_um == pytest.approx(other["y"].y_offset_um, abs=1e-9)
    assert other["z"].y_offset_um - one["z"].y_offset_um == pytest.approx(-8.0, abs=1.0)


def test_the_sense_of_a_control_is_that_of_its_offset_and_its_residual() -> None:
    plain, turned = compensation(AXES), compensation(AXES + "sign = -1\n")
    for one, other in zip(processed(plain, 90), processed(turned, 90), strict=True):
        assert by_axis(one)["z"].y_offset_um == -by_axis(other)["z"].y_offset_um
        assert one.estimate.axes["z_um"] == -other.estimate.axes["z_um"]  # type: ignore[attr-defined]
    # Who applies it can see that it was turned; otherwise nothing is said.
    assert json.loads(encode(by_axis(other)["z"]))["sign"] == -1
    for offset in (by_axis(one)["z"], by_axis(other)["x"], by_axis(other)["y"]):
        assert "sign" not in json.loads(encode(offset))


def test_the_deviation_of_a_tilt_knows_that_its_probes_share_the_heat() -> None:
    """The noise of T_Q moves both probes alike: it counts by the difference of their gains, not by both."""
    quiet = {name: dataclasses.replace(part(name), y_std_um=0.0) for name in ("y", "x", "z", "low", "high")}
    running = compensation(AXES, TILT, model=model_text(parts=quiet))
    estimate = processed(running, 90)[-1].estimate.axes  # type: ignore[attr-defined]
    alike = {**quiet, "high": dataclasses.replace(quiet["low"], axis="high")}
    same = compensation(AXES, TILT, model=model_text(parts=alike))
    found = processed(same, 90)[-1].estimate.axes  # type: ignore[attr-defined]
    assert (found["a_pred_urad"], found["a_std_urad"]) == (0.0, pytest.approx(0.0, abs=1e-6))
    assert estimate["a_std_urad"] > 0.01


def test_a_sample_that_fails_holds_every_axis() -> None:
    running = compensation()
    last = by_axis(processed(running, 60)[-1])
    running.fail()
    held = {one.axis: one for one in running.held_axes("vmc-07", 60, 0)}  # type: ignore[attr-defined]
    assert list(held) == ["y", "x", "z", "a"]
    for axis, one in held.items():
        assert (one.state, one.reasons) == ("hold", ["internal_error"])
        assert (one.y_offset_um, one.y_offset_rate_um_per_min) == (last[axis].y_offset_um, 0.0)
    assert held["y"].y_slope_um_per_m == last["y"].y_slope_um_per_m


def test_a_state_restores_every_axis_and_belongs_to_its_axes() -> None:
    running = compensation()
    processed(running, 60)
    other = compensation()
    other.restore(running.state())
    for one, again in zip(processed(running, 30, 60), processed(other, 30, 60), strict=True):
        assert encode(one.estimate) == encode(again.estimate)
        assert list(map(encode, one.further)) == list(map(encode, again.further))
    with pytest.raises(CompensatorError, match="axes"):
        compensation(AXES).restore(running.state())


def test_a_zero_on_a_warm_machine_zeroes_every_axis() -> None:
    running = compensation()
    processed(running, 120)
    running.zero("warm")
    outcome = processed(running, 1, 120)[-1]
    for axis, one in by_axis(outcome).items():
        assert one.y_offset_um != 0.0, axis  # on its way to 0
    values = outcome.estimate.axes  # type: ignore[attr-defined]
    assert abs(values["z_base_um"]) > 3.0
    assert abs(values["z_pred_um"]) < 0.5
    assert (values["z_um"], values["z_ref_um"]) == (0.0, 2.0)


def test_a_zero_before_the_record_is_that_of_every_axis() -> None:
    running = compensation()
    processed(running, 120)
    running.zero("warm")
    outcome = processed(running, 2, 120)[-1]
    zero = running.status.zero
    assert zero is not None and abs(zero.further["z"]) > 3.0 and zero.further.keys() == running.outputs.states.keys()
    recorded = msgspec.json.decode(encode(outcome.estimate), type=AxesEstimate)
    assert Zero.of_estimate(recorded).equals(zero) and not msgspec.structs.replace(zero, further={}).equals(zero)
    other = compensation()
    other.begin(zero)
    again = processed(other, 1, 122)[-1].estimate.axes  # type: ignore[attr-defined]
    for name in ("z_base_um", "a_base_urad", "y_slope_base_um_per_m"):
        assert again[name] == outcome.estimate.axes[name] != 0.0  # type: ignore[attr-defined]


def of_strength(name: str, numerator: float) -> ThermalModel:
    """A part of the model with another gain of its DTF."""
    own = part(name)
    dtf = dataclasses.replace(own.dtf.continuous, numerator=(numerator,))  # type: ignore[type-var]
    return dataclasses.replace(own, dtf=type(own.dtf).from_continuous(dtf, 60.0))


def test_a_model_of_all_axes_is_adopted_and_the_offsets_do_not_jump(tmp_path: Path) -> None:
    machine = SeveralAxes(tmp_path, config_text(AXES), model_text("y", "x", "z"))
    model = model_text("y", "x", parts={"z": of_strength("z", 1.5)})
    asked: dict[str, Any] = {}

    def adopt(name: str, text: bytes) -> Any:
        payload = json.dumps({"model": text.decode(), "force": True}).encode()
        return lambda: asked.update({name: machine.command("adopt", payload)})

    machine.run(200, {60: adopt("without", model_text("y", "x")), 120: adopt("whole", model)})
    assert asked["without"].result()["ok"] is False
    assert "axis z: no part axis.z in the model" in asked["without"].result()["text"]
    assert asked["whole"].result()["ok"] is True
    z = [by_axis(outcome)["z"] for outcome in machine.outcomes]
    assert len({one.model_sha256 for one in z}) == 2
    assert np.abs(np.diff([one.y_offset_um for one in z])).max() < 8.0 + 1e-9
    assert audit(machine.recordings).clean


def test_after_a_restart_each_axis_says_whether_its_own_offset_still_moves_to_that_of_a_model(tmp_path: Path) -> None:
    """Z has a model that is far off and Y the same as before: of Y it is no reason, before the restart and after it."""
    machine = SeveralAxes(tmp_path, config_text(AXES), model_text("y", "x", "z"))
    model = model_text("y", "x", parts={"z": of_strength("z", 10.0)})
    payload = json.dumps({"model": model.decode(), "force": True}).encode()

    def moving(outcome: Outcome) -> list[str]:
        return [axis for axis, one in by_axis(outcome).items() if "model_changed" in one.reasons]

    def stop_while_z_moves() -> None:
        if moving(machine.outcomes[-1]) == ["z"] and machine.daemon is not None:
            machine.daemon.stop()

    machine.run(
        200, {120: lambda: machine.command("adopt", payload)} | dict.fromkeys(range(121, 200), stop_while_z_moves)
    )
    stopped = len(machine.outcomes)
    machine.run(1)
    assert stopped < 200 and [moving(outcome) for outcome in machine.outcomes[-2:]] == [["z"], ["z"]]
    assert audit(machine.recordings).clean


def test_after_a_kill_on_a_full_disk_every_axis_continues_from_what_was_published(tmp_path: Path) -> None:
    machine = SeveralAxes(tmp_path, config_text(*EVERY), model_text(*PARTS))
    machine.run(120)
    last = by_axis(machine.outcomes[-1])
    published = {
        axis: msgspec.structs.replace(one, seq=one.seq + 5, y_offset_um=one.y_offset_um - 40.0)
        for axis, one in last.items()
    }
    checkpoint = OffsetCheckpoint(tmp_path / "rec", "vmc-07", tmp_path)
    checkpoint.write(published["y"], further_values(published.values()))
    machine.run(1)
    for axis, one in by_axis(machine.outcomes[-1]).items():
        step = abs(one.y_offset_um - published[axis].y_offset_um)
        assert step == pytest.approx({"x": 4.0, "y": 8.0, "z": 8.0, "a": 20.0}[axis]), axis
    assert abs(by_axis(machine.outcomes[-1])["y"].y_slope_um_per_m - published["y"].y_slope_um_per_m) < 1.0


def test_a_checkpoint_beyond_the_limit_of_an_axis_is_not_used(tmp_path: Path) -> None:
    checkpoint = OffsetCheckpoint(tmp_path / "rec", "vmc-07", tmp_path)
    offset = processed(compensation(AXES), 3)[-1].offset
    checkpoint.write(offset, {"z": 151.0})
    assert checkpoint.read(200.0, {"z": 150.0}) is None
    found = checkpoint.read(200.0, {"z": 152.0})
    assert found is not None
    assert found.further == {"z": 151.0}


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ((AXES.replace("[axis.z]", "[axis.w]"),), "axis.w: no such key, expected one of: y, x, z, a, b"),
        ((AXES.replace("offset_max_um = 150.0\n", ""),), "axis.z.offset_max_um: missing"),
        ((AXES.replace("150.0", "-1.0"),), "axis.z.offset_max_um = -1.0"),
        ((AXES.replace("150.0", "nan"),), "axis.z.offset_max_um = nan"),
        ((AXES + "sign = 2\n",), "axis.z.sign = 2: expected one of: -1, 1"),
        ((AXES + 'sign = "-1"\n',), "axis.z.sign = '-1': expected one of: -1, 1"),
        ((AXES, TILT + 'acts_on = "w"\n'), "axis.a.acts_on = 'w': expected one of: x, y, z"),
        ((AXES, '[loop]\npolicy = "maybe"\n'), "loop.policy = 'maybe': expected one of: off, propose, adopt"),
        ((AXES, "[loop]\nevery_h = 5\n"), "loop.every_h = 5: expected one of: 4, 6, 8, 12, 24"),
        ((AXES, TILT.replace("reference_mm = 120.0", "reference_mm = 1e9")), "axis.a.reference_mm = 1000000000.0"),
        ((AXES, TILT.replace("distance_mm = 200.0", "distance_mm = 0.0")), "axis.a.distance_mm = 0.0"),
        ((AXES.replace("[axis.y]", "[axis.y]\nsign = -1"),), "axis.y.sign = -1: expected 1"),
        ((AXES, TILT + 'acts_on = "b"\n'), "axis.a.acts_on = 'b'"),
        ((AXES.replace("[axis.x]", "").replace("offset_max_um = 60.0\noffset_rate_max_um_per_min = 4.0", ""),
          TILT + 'acts_on = "x"\n'), "axis.a: acts on 'x', expected one of: y, z"),
        ((AXES, TILT.replace('"high"', '"low"')), "axis.a.probes"),
        ((AXES + 'part = "x"\n',), "axis.z.part = 'x': expected a part of its own, axis.x has this one"),
        ((AXES.partition("[axis.x]")[2].join(["[axis.x]", ""]),), "axis.y: missing; zero, checks and probes of"),
        (("[axis.z]\n" + LIMITS,), "Where a single axis is corrected there is no [axis.*]: that axis is called Y"),
        ((AXES, '[loop]\npolicy = "propose"\n'), "loop.policy: expected 'off' with [axis.*]"),
    ],
)  # fmt: skip
def test_a_wrong_table_of_an_axis_is_one_line(tables: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_config(config_text(*tables), source="machine.toml")
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_limits_of_y_stand_in_one_place() -> None:
    text = config_text(AXES).replace(b"[limits]", b"[limits]\noffset_max_um = 100.0")
    with pytest.raises(ConfigError, match=r"limits.offset_max_um = 100.0: expected in axis.y"):
        parse_config(text, source="machine.toml")


@pytest.mark.parametrize(
    ("tables", "model", "said"),
    [
        ((AXES,), model_text("y", "x"), "axis z: no part axis.z in the model, it has: Y, X"),
        ((AXES,), model_text("x", "z"), "no part axis.y in the model"),
        ((AXES, TILT), model_text("y", "x", "z", "low"), "axis a: no part axis.high in the model"),
    ],
)
def test_an_axis_without_its_part_of_the_model_is_one_line(tables: tuple[str, ...], model: bytes, said: str) -> None:
    config = parse_config(config_text(*tables), source="machine.toml")
    with pytest.raises(ModelError) as refused:
        model_of(config, model, source="model.toml")
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_shipped_schemas_of_several_axes_are_those_of_the_classes() -> None:
    for name, schema in schemas(AXES_MESSAGES).items():
        assert msgspec.json.decode(shipped_schema(name)) == msgspec.json.decode(msgspec.json.encode(schema))


def test_another_model_is_compared_on_y(day: SeveralAxes) -> None:
    found = compare(day.recordings[:1], load_model("quill"))
    assert found.samples == 300
    assert found.own.residual_after.rms == pytest.approx(found.own.residual_before.rms, abs=1e-6)


def test_another_model_is_compared_on_every_axis_that_is_measured(
    day: SeveralAxes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    z = part("z")
    gains = tuple(1.5 * gain for gain in z.dtf.continuous.numerator)  # type: ignore[union-attr]
    stronger = ModelPath.from_continuous(
        dataclasses.replace(z.dtf.continuous, numerator=gains),  # type: ignore[type-var]
        z.period_s,
    )
    other = model_text(*PARTS, parts={"z": dataclasses.replace(z, dtf=stronger)})
    (tmp_path / "other.toml").write_bytes(other)
    (tmp_path / "y.toml").write_bytes(model_text("y"))

    def compared(name: str) -> dict[str, Any]:
        assert main(["replay", str(day.recordings[0]), "--model", str(tmp_path / name), "--json"]) == 0
        return json.loads(capsys.readouterr().out)  # type: ignore[no-any-return]

    found = compared("other.toml")
    assert set(found["axes"]) == {"x", "z"}  # no tilt and no slope is measured
    for one in (found, found["axes"]["x"]):
        assert one["left_um"]["after"] == one["left_um"]["before"] and one["offset_difference_um"]["peak_um"] == 0.0
    z_left = found["axes"]["z"]["left_um"]
    assert z_left["after"]["samples"] == z_left["before"]["samples"] > 250
    assert z_left["after"]["rms_um"] > 3.0 * z_left["before"]["rms_um"]
    page = tmp_path / "page.html"
    command = ["replay", str(day.recordings[0]), "--model", str(tmp_path / "other.toml"), "--page", str(page)]
    assert main(command) == 0
    assert "Z: remaining error, quill (recorded)" in capsys.readouterr().out
    assert re.search(r" Z: [0-9.]+ instead of [0-9.]+ µm rms\.", page.read_text(encoding="utf-8"))
    # A model of Y alone is compared on Y, and that is said.
    alone = compared("y.toml")
    assert "axes" not in alone and "no part axis.x in the model" in alone["only_y"]
    assert alone["left_um"] == found["left_um"]


def test_a_model_without_the_axes_of_the_configuration_is_refused() -> None:
    config = parse_config(config_text(AXES), source="test")
    with pytest.raises(ServiceError, match="its axes are not those of the configuration, expected x, z"):
        Compensation(config, load_model("quill"))


def test_a_jump_of_a_temperature_is_judged_for_every_axis() -> None:
    """While T_Q is suspect the prediction continues without it; once it is believed every axis has the new state."""
    guards = {"guards.t_q_below_at_max_k = 2.0": "guards = {t_q_below_at_max_k = 2.0, suspect_jumps = true}"}
    running, other = compensation(**guards), compensation(**guards)
    processed(running, 60)
    processed(other, 60)
    jumped = processed(running, 3, 60, t_q_degc=40.0)[-1]
    held = [by_axis(jumped)[axis] for axis in "yxza"]
    assert all("suspect_channel:t_q_degc" in one.reasons for one in held)
    again = compensation(**guards)
    again.restore(running.state())
    running.resume()
    again.resume()
    one, two = (processed(which, 3, 63)[-1] for which in (running, again))
    assert list(map(encode, one.further)) == list(map(encode, two.further))
    plain = by_axis(processed(other, 6, 60)[-1])
    assert "suspect_channel:t_q_degc" not in by_axis(one)["z"].reasons
    assert by_axis(one)["z"].y_offset_um != plain["z"].y_offset_um


def test_a_warm_zero_while_at_is_unconfirmed_counts_for_every_axis_whichever_answer_was_right() -> None:
    guards = {
        "guards.t_q_below_at_max_k = 2.0": "guards = {t_q_below_at_max_k = 2.0, suspect_jumps = true, jump_min_k = 0.6}"
    }

    def offsets(size_k: float) -> list[dict[str, float | None]]:
        running, found = compensation(**guards), []
        for i, values in enumerate(made.readings(300)):
            values["at_degc"] += size_k if 100 <= i < 180 else 0.0
            if 100 <= i < 140:
                values["y_um"] = math.nan  # it would show which answer is right
            if i == 140:
                running.zero("warm")
            outcome = running.process(sample(i, values | {"x_um": 1.0, "z_um": 2.0}))
            found.append({axis: one.y_offset_um for axis, one in by_axis(outcome).items()})
            if 110 <= i < 180:
                assert ("unconfirmed_channel:at_degc" in outcome.offset.reasons) is (size_k != 0.0)
        return found

    wrong, right = offsets(0.9), offsets(0.0)
    assert abs(wrong[135]["y"] - right[135]["y"]) > 5.0
    for axis in "yxza":
        assert wrong[-1][axis] == pytest.approx(right[-1][axis], abs=0.5), axis


def test_axes_that_are_added_begin_at_zero_and_y_goes_on(tmp_path: Path) -> None:
    machine = SeveralAxes(tmp_path, made.CONFIG + SENSORS.encode(), model_text("y"))
    machine.run(150)
    last = machine.outcomes[-1].offset.y_offset_um
    assert last is not None
    machine.text, machine.configured = config_text(AXES), model_text("y", "x", "z")
    machine.run(30)
    assert any("the configuration has changed" in event["text"] for event in machine.sent("event"))
    first = by_axis(machine.outcomes[150])
    assert abs(first["y"].y_offset_um - last) <= 8.0
    assert abs(first["z"].y_offset_um) == pytest.approx(8.0)  # on its way, at its rate, from what the control applies
    z = np.array([by_axis(outcome)["z"].y_offset_um for outcome in machine.outcomes[150:]])
    assert np.abs(np.diff(z)).max() < 8.0 + 1e-9
    assert abs(z[-1] + machine.world.truth("z_um")) < 5.0
    machine.text, machine.configured = made.CONFIG + SENSORS.encode(), model_text("y")
    machine.run(2)
    assert type(machine.outcomes[-1].offset) is Offset
    assert abs(machine.outcomes[-1].offset.y_offset_um - machine.outcomes[-3].offset.y_offset_um) < 16.0
    assert audit(machine.recordings).clean


def test_on_a_disk_that_refuses_every_axis_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = SeveralAxes(tmp_path, config_text(AXES), model_text("y", "x", "z"))
    sync = RecordingFile.sync

    def full(live: Any) -> None:
        raise OSError(28, "No space left on device")

    machine.run(
        12,
        {
            4: lambda: monkeypatch.setattr(RecordingFile, "sync", full),
            8: lambda: monkeypatch.setattr(RecordingFile, "sync", sync),
        },
    )
    z = machine.sent("z_offset")
    assert ["recording_failed" in one["reasons"] for one in z] == [i in range(4, 8) for i in range(12)]
    assert [one["reasons"] for one in z] == [one["reasons"] for one in machine.sent("offset")]
    shown = [one["axes"]["z"] for one in machine.sent("status")]
    assert shown == [{"state": one["state"], "reasons": one["reasons"]} for one in z]
    assert audit(machine.recordings).clean


def test_a_probe_corrects_y_alone_and_one_of_another_axis_is_refused(tmp_path: Path) -> None:
    probing = "\n[probe]\nstd_um = 1.0\nmeasured_max_um = 60.0\nlargest_um = 20.0\noldest_min = 10.0\n"
    machine = SeveralAxes(tmp_path, config_text(AXES + probing), model_text("y", "x", "z"))
    asked: dict[str, Any] = {}

    def probe(axis: str) -> Any:
        def send() -> None:
            last = by_axis(machine.outcomes[-1])[axis]
            request = {"schema": 1, "time_utc_ns": last.time_utc_ns, "axis": axis, "measured_um": 5.0,
                       "offset_applied_um": last.y_offset_um, "feature": "sphere", "tool": "probe"}  # fmt: skip
            asked[axis] = machine.command("probe", json.dumps(request).encode())

        return send

    machine.run(140, {60: probe("z"), 120: probe("y")})
    assert asked["z"].result()["ok"] is False
    assert "axis = 'z', expected 'y'" in asked["z"].result()["text"]
    assert asked["y"].result()["ok"] is True
    before, after = (by_axis(machine.outcomes[i]) for i in (119, 125))
    corrected = machine.outcomes[125].estimate
    values = corrected.axes  # type: ignore[attr-defined]
    own = corrected.y_dtf_um + corrected.y_tdtf_um  # type: ignore[operator]
    assert abs(corrected.y_pred_um - own) > 1.0  # type: ignore[operator]
    assert values["z_pred_um"] == pytest.approx(values["z_dtf_um"] + values["z_tdtf_um"])
    assert (before["z"].state, after["z"].state) == ("ok", "ok")
    assert audit(machine.recordings).clean


def test_a_torn_end_gives_no_axis_a_value_that_was_not_published(tmp_path: Path) -> None:
    """The file is cut anywhere in its last group: every axis continues from the last sample that is whole."""
    machine = SeveralAxes(tmp_path, config_text(*EVERY), model_text(*PARTS))
    live: dict[int, bytes] = {}

    def keep(samples: int) -> Any:
        return lambda: live.update({samples: machine.recordings[-1].read_bytes()})

    machine.run(32, {30: keep(30), 31: keep(31)})
    name = machine.recordings[-1].name
    loaded = LoadedConfig(config=machine.config, path=tmp_path / "again" / "machine.toml", data=machine.text)
    model = model_of(machine.config, machine.configured, source="test")
    (tmp_path / "again" / "rec").mkdir(parents=True)
    found = set()
    for size in range(len(live[30]), len(live[31]) + 1, 151):
        (tmp_path / "again" / "rec" / name).write_bytes(live[31][:size])
        status = resume(loaded, model).compensation.status
        offsets = [further_values(by_axis(machine.outcomes[number]).values()) for number in (29, 30)]
        which = offsets.index(dict(status.handover.further))
        assert machine.outcomes[29 + which].offset.y_offset_um == status.handover.offset_um
        found.add(which)
    assert found == {0, 1}


def test_parts_of_the_model_may_have_other_names_than_the_axes() -> None:
    tables = AXES.replace("[axis.y]", '[axis.y]\npart = "low"').replace("[axis.z]", '[axis.z]\npart = "high"')
    running = compensation(tables, TILT, model=model_text("x", "low", "high"))
    outcome = processed(running, 90)[-1]
    offsets = by_axis(outcome)
    expected = (offsets["z"].y_offset_um - offsets["y"].y_offset_um) / 200.0 * 1000.0
    assert offsets["a"].y_offset_um == pytest.approx(expected)
    assert abs(expected) > 1.0


def test_an_internal_error_holds_every_axis_in_the_service_and_in_the_audit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = SeveralAxes(tmp_path, config_text(*EVERY), model_text(*PARTS))
    process = Compensation.process

    def broken(*_: Any) -> Any:
        monkeypatch.setattr(Compensation, "process", process)
        raise ValueError("test")

    machine.run(50, {40: lambda: monkeypatch.setattr(Compensation, "process", broken)})
    z, y = machine.sent("z_offset"), machine.sent("offset")
    assert [one["seq"] for one in z] == [one["seq"] for one in y]
    held = [one for one in z if one["reasons"] == ["internal_error"]]
    assert len(held) == 10  # the sample itself, and those after it until `resume`
    assert {one["z_offset_um"] for one in held} == {z[39]["z_offset_um"]}
    found = audit(machine.recordings)
    assert found.clean, (found.findings, found.difference)
