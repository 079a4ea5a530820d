"""One law for stream and record: for every form of every kind, with drawn inputs and parameters."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.model.effects.base import effect_from, filters, forms
from compensator.model.effects.blocks import (
    ChangeSeen,
    Delay,
    FilterBank,
    FromStart,
    Function,
    Lag,
    Play,
    Stick,
    lag_or_none,
)
from compensator.model.effects.signals import RecordSignals, Signals
from compensator.model.effects.stream import EffectStream
from compensator.model.transfer_function import SampledTransferFunction

FUNCTION = SampledTransferFunction(b=(0.2, 0.1), a=(1.0, -0.7), period_s=60.0)
RECORDS = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=40).map(np.array)
BLOCKS = {
    "start": lambda x: FromStart(),
    "seen": lambda x: ChangeSeen(),
    "undelayed": lambda x: FilterBank((0.0, x), ((1.0, -2.0),), 1.0, lag=lag_or_none),
    "zero": lambda x: FromStart(x),
    "lag": lambda x: Lag(x, 1.0),
    "bank": lambda x: FilterBank((x, 3.0), ((1.0, -2.0),), 1.0),
    "delay": lambda x: Delay(x, 1.0),
    "function": lambda x: Function(FUNCTION),
    "play": Play,
    "stick": Stick,
}
#: Parameters of the remainder, whose lengths go together; one of its channels twice, one never seen.
REGRESSION = {
    "channels": lambda data, number: ["c", "heat_w", "at_degc", "c", "unseen"],
    "exponents": lambda data, number: [1.0, 2.0, 1.0, 2.0, 1.0],
    "taus_min": lambda data, number: [0.0, data.draw(number)],
    "gains": lambda data, number: [[data.draw(number), data.draw(number)] for _ in range(5)],
    "std_factor": lambda data, number: [[data.draw(number) for _ in range(10)]],
}


@pytest.mark.parametrize("name", BLOCKS)
@given(u=RECORDS, x=st.floats(0.0, 30.0))
@settings(max_examples=60, deadline=None)
def test_a_block_filters_a_record_as_it_steps_and_goes_on_from_its_state(name, u, x):
    block, again = BLOCKS[name](x), BLOCKS[name](x)
    stepped = []
    for k, value in enumerate(u.tolist()):
        again.state = block.state
        stepped.append(block.step(value))
        assert again.step(value) == stepped[k]
    assert stepped == pytest.approx(BLOCKS[name](x).filter(u), abs=1e-9 * max(1.0, float(np.max(np.abs(u)))))


def drawn(data, field):
    """A parameter as the model file would hold it."""
    if field.metadata.get("choices"):
        return data.draw(st.sampled_from(field.metadata["choices"]))
    number = st.floats(0.5, 40.0)
    if field.name in REGRESSION:
        return REGRESSION[field.name](data, number)
    if field.name in ("channel", "fluid"):
        return "c"
    if field.name == "b":
        return list(FUNCTION.b)
    if field.name == "a":
        return list(FUNCTION.a)
    if str(field.type).startswith("tuple"):
        return [data.draw(number), data.draw(number)]
    return data.draw(st.floats(-2.0, 2.0)) if field.name in ("change", "gain") else data.draw(number)


@pytest.mark.parametrize("form", [f for f in forms() if f.deployable], ids=lambda form: form.__name__)
@given(data=st.data(), seed=st.integers(0, 999))
@settings(max_examples=25, deadline=None)
def test_every_form_streams_what_it_filters(form, data, seed):
    fields = [f for f in form.__dataclass_fields__.values() if "read" in f.metadata]
    table = {f.name: drawn(data, f) for f in fields}
    effect = effect_from(form.kind, table)
    assert effect_from(form.kind, effect.to_table()) == effect
    left_out = {f.name for f in fields if "optional" in f.metadata and table[f.name] == f.default}
    assert effect.to_table() == {name: value for name, value in table.items() if name not in left_out}
    walk = np.random.default_rng(seed).normal(0.0, 3.0, (7, 60)).cumsum(axis=1)
    record = RecordSignals(
        period_min=1.0,
        drive=walk[0],
        ambient_k=walk[1],
        y_dtf_um=walk[2],
        y_tdtf_um=walk[3],
        t_q_degc=walk[4],
        at_degc=walk[5],
        channels={"c": walk[6]},
    )
    stream = EffectStream(effect, 1.0)
    stepped = [
        stream.step(Signals(drive=u, ambient_k=a, t_q_degc=t, at_degc=b, y_dtf_um=y, y_tdtf_um=z, channels={"c": c}))
        for u, a, y, z, t, b, c in walk.T.tolist()
    ]
    filtered = effect.law(record, filters(effect.blocks(1.0)))
    assert stepped == pytest.approx(filtered, abs=1e-9 * max(1.0, float(np.max(np.abs(filtered)))))


def test_nothing_acts_before_a_channel_was_seen():
    table = {"channel": "c", "curve": "linear", "tau_min": [5.0], "gain": [1.0], "delay_min": 0.0}
    stream = EffectStream(effect_from("input", table), 1.0)
    before = stream.snapshot()
    for channels in ({}, {"c": math.nan}):
        still = {"drive": 0.0, "ambient_k": 0.0, "t_q_degc": 20.0, "at_degc": 20.0, "y_dtf_um": 0.0, "y_tdtf_um": 0.0}
        signals = Signals(**still, channels=channels)
        assert stream.step(signals) == 0.0
    assert repr(stream.snapshot()) == repr(before)
