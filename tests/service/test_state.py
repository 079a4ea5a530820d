"""The state: whatever has happened, a compensation that is restored goes on with the same bits."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.errors import CompensatorError, DataError
from compensator.messages import SEQ_MAX, encode
from compensator.model.effects import kinds
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome
from compensator.service.state import LARGEST_COVARIANCE, decode_state, frozen_state
from tests.service.records import EFFECTS, QUILL, day, direct, late, with_effects, with_method
from tests.service.simulated import TABLE, config

CHANNELS = [*TABLE["channel"], {"name": "spindle_rpm", "device": "module", "input": 4}]
CONFIG = config(
    channel=CHANNELS,
    limits={
        "offset_max_um": 60.0,
        "offset_rate_max_um_per_min": 1.5,
        "validity": {"t_q_degc": [10.0, 34.0], "at_degc": [10.0, 35.0]},
    },
)
MODELS = {
    "kalman": QUILL,
    "inverse": with_method("inverse"),
    "direct": direct("kalman"),
    "direct inverse": direct("inverse"),
    "effects": with_effects(),
    "effects inverse": with_effects(with_method("inverse")),
    "absolute": dataclasses.replace(QUILL, inputs="absolute"),
    "lag": late(QUILL, delay_min=0.0),
    "late": late(QUILL, form="path"),
    "late inverse": late(with_method("inverse")),
    "late direct": late(direct("kalman"), path="DTF"),
    "late, effects": late(with_effects()),
}
LOST = {
    "t_q_degc": [range(3), range(90, 96), range(150, 175), range(225, 230)],
    "at_degc": [range(92, 99), range(228, 233)],
    "y_um": [range(12), range(180, 190)],
    "coolant_degc": [range(40, 43), range(93, 110)],
}

#: What a state may hold: whatever is not finite stands for itself, and no finite number is larger than a covariance.
NUMBERS = st.floats(-LARGEST_COVARIANCE, LARGEST_COVARIANCE) | st.sampled_from([math.inf, -math.inf, math.nan])
#: Where the effects of each kind stand in the state; the last one of a kind.
PLACE = {kind: i for i, (kind, _) in enumerate(EFFECTS)}


def bits(outcome: Outcome) -> list[bytes]:
    return [encode(outcome.sample), encode(outcome.estimate), encode(outcome.offset), repr(outcome.notes).encode()]


def commanded(compensation: Compensation, seq: int) -> None:
    if seq == 60:
        compensation.hold()
    if seq == 75:
        compensation.resume()
    if seq in (120, 226):  # the second one waits for the temperatures
        compensation.zero("auto" if seq == 120 else "rest")
    if seq == 195:
        compensation.fail()
    if seq == 200:
        compensation.resume()
    if seq == 210:
        compensation.pause(20)
    if seq == 245:
        compensation.pause(800)  # too long to be bridged


def test_every_kind_of_effect_that_streams_is_among_them() -> None:
    """Other tests register kinds of their own."""
    assert {kind for kind, _ in EFFECTS} == {kind for kind in kinds() if not kind.startswith("test-")}


@pytest.mark.parametrize("name", MODELS)
def test_restored_after_every_sample_goes_on_with_the_same_bits(name: str) -> None:
    """By induction: if one step from a restored state gives the same outcome and the same state, all steps do."""
    whole = Compensation(CONFIG, MODELS[name])
    state, seen = whole.state(), set[str]()
    for raw in day(280, lost=LOST):
        restored = Compensation(CONFIG, MODELS[name])
        restored.restore(state)
        for one in (whole, restored):
            commanded(one, raw.seq)
        outcome = whole.process(raw)
        assert bits(restored.process(raw)) == bits(outcome), raw.seq
        state = whole.state()
        assert restored.state() == state, raw.seq
        seen |= {outcome.offset.state, *outcome.offset.reasons}
    # The day goes through everything that the state must remember, or the test would prove nothing.
    assert {"degraded", "hold", "operator_hold", "internal_error", "predicting", "cold_start"} <= seen
    assert "prediction_expired" in seen
    if name in ("kalman", "inverse"):
        assert {"starting", "rate_limited", "outside_validity:t_q_degc"} <= seen
    if name.startswith("effects"):
        assert "channel_missing:coolant_degc" in seen


def test_a_settled_covariance_stays_settled() -> None:
    whole = Compensation(CONFIG, QUILL)
    raws = list(day(1900))
    for raw in raws[:1800]:
        whole.process(raw)
    assert decode_state(whole.state()).engine.observer.settled
    restored = Compensation(CONFIG, QUILL)
    restored.restore(whole.state())
    assert [bits(restored.process(r)) for r in raws[1800:]] == [bits(whole.process(r)) for r in raws[1800:]]


@given(st.tuples(*[NUMBERS, st.floats(0.0, 1e60)] * 2), st.floats(-1e30, 1e30) | st.just(math.nan), NUMBERS)
@settings(max_examples=200, deadline=None)
def test_every_number_comes_back_to_the_bit(
    guard: tuple[float, float, float, float], y_ref: float, missing: float
) -> None:
    state = decode_state(Compensation(CONFIG, QUILL).state())
    state.guards["y_um"] = guard
    state.zero.y_ref, state.memory.missing_min = y_ref, missing
    again = decode_state(frozen_state(state)())
    before = [*guard, y_ref, missing]
    after = [*again.guards["y_um"], again.zero.y_ref, again.memory.missing_min]
    assert [v.hex() for v in after] == [v.hex() for v in before]  # hex tells -0.0 and NaN


def at_work(model: ThermalModel = QUILL) -> dict[str, Any]:
    compensation = Compensation(CONFIG, model)
    for raw in day(100, lost={"t_q_degc": [range(95, 100)]}):
        compensation.process(raw)
    state: dict[str, Any] = json.loads(compensation.state())
    assert state["engine"]["gap"]["samples"]
    return state


def without(state: dict[str, Any], *keys: str) -> dict[str, Any]:
    inner = state
    for key in keys[:-1]:
        inner = inner[key]
    del inner[keys[-1]]
    return state


def changed(state: dict[str, Any], value: Any, *keys: Any) -> dict[str, Any]:
    inner: Any = state
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    return state


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (b"", "state:"),
        (b"{", "state:"),
        (b"\xff\xfe", "state:"),
        (b"[1, 2]", "state:"),
        (b"[" * 100_000, "state:"),
        (without(at_work(), "engine"), "engine"),
        (changed(at_work(), 1, "surprise"), "surprise"),
        (changed(at_work(), 2, "schema"), "schema = 2, expected 1"),
        (changed(at_work(), "0" * 64, "model_sha256"), "model_sha256"),
        (changed(at_work(), "TDTF-I", "alternative"), "alternative"),
        (without(at_work(), "guards", "y_um"), "guards"),
        (changed(at_work(), [0.0], "engine", "observer", "x"), "snapshot of 1 states"),
        (changed(at_work(), [0.0], "engine", "observer", "p"), "snapshot of"),
        (changed(at_work(), [[1.0]], "engine", "effects"), "effects"),
        (changed(at_work(), "nan", "engine", "observer", "x", 0), "not finite"),
        (changed(at_work(), "nan", "zero", "y_base"), "y_base"),
        (changed(at_work(), -5.0, "guards", "t_q_degc", 1), "guards"),
        (changed(at_work(), "nan", "engine", "reference", "at_degc"), "not finite"),
        (changed(at_work(), 1e31, "zero", "y_ref"), "reference"),
        (changed(at_work(), 1e31, "zero", "y_base"), "y_base"),
        (changed(at_work(), [], "engine", "observer", "p"), "covariance"),
        (changed(at_work(), -5.0, "engine", "observer", "p", 0), "covariance"),
        (changed(at_work(), 1e9, "engine", "observer", "p", 1), "covariance"),
        (changed(at_work(), "inf", "offset_um"), "not finite"),
        (changed(at_work(), -5001.0, "offset_um"), "offset"),
        (changed(at_work(), 1e300, "memory", "missing_min"), "memory.missing_min"),
        (changed(at_work(), [0.0, 0.0, -1e61, 0.0], "guards", "y_um"), "guards"),
        (changed(at_work(), int("9" * 400), "memory", "time_utc_ns"), "memory.time_utc_ns"),
        (changed(at_work(), "9" * 400, "memory", "time_utc_ns"), "memory.time_utc_ns"),
        (changed(at_work(), SEQ_MAX + 1, "memory", "seq"), "memory.seq"),
        (changed(at_work(), [0.0], "engine", "gap", "state", "observer", "x"), "snapshot of 1 states"),
        (changed(at_work(), {"x": 1.0}, "engine", "gap", "before", "channels"), "channels"),
        (changed(at_work(with_effects()), [1.0, 2.0], "engine", "effects", PLACE["hysteresis"]), "hysteresis"),
        (changed(at_work(with_effects()), {}, "engine", "gap", "samples", 0, "channels"), "channels"),
        (changed(at_work(with_effects()), [1.0], "memory", "estimate", "y_effects_um"), "effects"),
    ],
)
def test_what_is_no_state_gets_one_line_and_changes_nothing(state: Any, expected: str) -> None:
    data = state if isinstance(state, bytes) else json.dumps(state).encode()
    of_effects = not isinstance(state, bytes) and state.get("model_sha256") == "e" * 64
    compensation = Compensation(CONFIG, with_effects() if of_effects else QUILL)
    before = compensation.state()
    with pytest.raises(DataError) as error:
        compensation.restore(data)
    assert expected in str(error.value) and "\n" not in str(error.value)
    assert compensation.state() == before


@given(st.binary(max_size=300), st.integers(0, 2000), st.integers(0, 255))
@settings(max_examples=150, deadline=None)
def test_damaged_bytes_never_raise_anything_else(noise: bytes, at: int, byte: int) -> None:
    compensation = Compensation(CONFIG, QUILL)
    whole = bytearray(compensation.state())
    whole[at % len(whole)] = byte
    for data in (noise, bytes(whole)):
        try:
            compensation.restore(data)
        except CompensatorError:
            continue


def test_a_pause_is_walked_over_and_the_uncertainty_grows_with_it() -> None:
    """A compensation that slept goes on like one that was awake, and says how sure it is."""
    raws = list(day(400))
    stds = []
    for pause in (5, 30, 120):
        awake, slept = Compensation(CONFIG, QUILL), Compensation(CONFIG, QUILL)
        for raw in raws[:200]:
            awake.process(raw)
            slept.process(raw)
        slept.pause(pause)
        for raw in raws[200 : 200 + pause]:
            awake.process(raw)
        a, b = awake.process(raws[200 + pause]), slept.process(raws[200 + pause])
        stds.append(b.offset.y_offset_std_um)
        assert b.offset.y_offset_std_um > a.offset.y_offset_std_um
        assert "cold_start" not in b.offset.reasons
        assert not math.isnan(b.offset.y_offset_um)
    assert stds == sorted(stds)


def test_the_checks_keep_the_names_of_their_state() -> None:
    """State files of earlier versions have these names."""
    compensation = Compensation(config(plausibility={"t_q_below_at_after_min": 30.0}), QUILL)
    names = json.loads(compensation.state())["plausibility"].keys()
    assert " ".join(names) == (
        "below_min exchanged rest_min apart taken used sums blocks z skipped high low suspects accused calm"
    )
