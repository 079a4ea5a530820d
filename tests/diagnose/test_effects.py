"""Every deployable effect streams what its whole-record side says, from a file, across a restart."""

import dataclasses

import numpy as np
import pytest

from compensator.diagnose.fitting.fit import Term, response
from compensator.diagnose.residual.base_run import signals_of
from compensator.diagnose.residual.evidence import evidence_of
from compensator.errors import ModelError
from compensator.model.effects import effect_from, kinds
from compensator.model.effects.hypothesis import proposals
from compensator.model.effects.input import Input
from compensator.model.engine import Engine
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model
from tests.diagnose.scenarios import record
from tests.identify.quill_runs import runs_from
from tests.service.records import EFFECTS

QUILL = load_model("quill")
INVERSE = dataclasses.replace(QUILL, estimator=dataclasses.replace(QUILL.estimator, method="inverse"))


@pytest.fixture(scope="module")
def day():
    columns, _, _ = record([], 5, 12.0)
    return runs_from(columns)


@pytest.fixture(scope="module")
def evidence(day):
    return evidence_of(QUILL, day)


#: The gain of the DTF by the flow of a pump that always runs.
SCHEDULE = {"path": "DTF", "channel": "pump_lpm", "form": "share", "origin": 8.0, "span": 2.0, "change": 0.1}


def forms(evidence):
    wanted = ("coolant_degc", "fan_rpm", "")
    context = dataclasses.replace(evidence.context, approximate=True)
    every = [*proposals(context), *proposals(context, background=True)]
    return [h for h in every if h.effect.deployable and h.effect.channel in wanted]


def table_of(hypothesis, values, amplitudes):
    return hypothesis.with_values(values, amplitudes)


def test_every_form_streams_what_it_says_of_a_whole_record(day, evidence):
    run = day[0]
    seen = set()
    # A diagnosis starts from the courses of T_Q and AT; the engine has their readings.
    evidence = dataclasses.replace(evidence, signals=(signals_of(INVERSE, run),))
    for hypothesis in forms(evidence):
        values = tuple(free.grid[len(free.grid) // 2] for free in hypothesis.free)
        amplitudes = tuple(0.3 + 0.1 * i for i in range(len(hypothesis.amplitudes)))
        term = Term(hypothesis=hypothesis, values=values, amplitudes=amplitudes)
        table = table_of(hypothesis, values, amplitudes)
        model = dataclasses.replace(INVERSE, effects=(table,))
        model = parse_model(dump_model(model).encode(), source=table.kind)
        engine = Engine(model)
        engine.set_reference(*run.reference)
        streamed = [e.y_effects_um[0] for e in engine.run(run.t_q_degc, run.at_degc, run.channels)]
        if table.lateness is not None:
            # Corrected in the heat, and not added to y; what the search uses knows the future.
            assert not any(streamed)
            continue
        whole = response(evidence, term)
        scale = max(1.0, float(np.max(np.abs(whole))))
        assert streamed == pytest.approx(whole, abs=2e-6 * scale), (hypothesis.place, hypothesis.form)
        seen.add(table.kind)
    # The remainder has no form to search for.
    assert seen == set(kinds()) - {"regression"}


def test_a_lag_of_the_heat_is_at_rest_whatever_the_first_reading_is():
    columns, _, _ = record([], 5, 12.0)
    columns["t_q_degc"][0] += 0.3
    evidence = evidence_of(QUILL, runs_from(columns))
    slow = next(h for h in proposals(evidence.context) if h.place[:2] == ("dynamics", "DTF") and h.form == "missing")
    added = response(evidence, Term(hypothesis=slow, values=(1000.0,), amplitudes=(1.0,)))
    assert abs(added[0]) < 1e-9 and np.max(np.abs(added)) > 1.0


@pytest.mark.parametrize("approximate", [True, False])
def test_no_temperature_in_degrees_celsius_is_squared(approximate):
    """Its zero is arbitrary, also on a winter day on which it comes near 0; that of a speed is not."""
    columns, _, _ = record([], 5, 12.0)
    columns["coolant_degc"] = columns["coolant_degc"] - np.mean(columns["coolant_degc"])
    context = dataclasses.replace(evidence_of(QUILL, runs_from(columns)).context, approximate=approximate)
    curves = {}
    for hypothesis in proposals(context):
        if isinstance(hypothesis.effect, Input):
            curves.setdefault(hypothesis.effect.channel, set()).add(hypothesis.effect.curve)
    assert curves["coolant_degc"] == {"linear"} and "square" in curves["spindle_rpm"]
    assert "coolant_degc" not in context.zeroed


def test_a_restart_in_between_changes_no_bit(day, evidence):
    run = day[0]
    for hypothesis in forms(evidence):
        values = tuple(free.grid[0] for free in hypothesis.free)
        table = table_of(hypothesis, values, (0.5,) * len(hypothesis.amplitudes))
        model = dataclasses.replace(QUILL, effects=(table,))
        engine, second = Engine(model), Engine(model)
        engine.set_reference(*run.reference)
        channels = [{n: float(v[k]) for n, v in run.channels.items()} for k in range(200)]
        for k in range(100):
            engine.step(run.t_q_degc[k], run.at_degc[k], channels[k])
        second.restore(engine.snapshot())
        for k in range(100, 200):
            first = engine.step(run.t_q_degc[k], run.at_degc[k], channels[k])
            assert second.step(run.t_q_degc[k], run.at_degc[k], channels[k]) == first, (
                hypothesis.place,
                hypothesis.form,
            )


@pytest.mark.parametrize(
    ("kind", "table", "words"),
    [
        ("input", {"channel": "x", "curve": "cubic", "tau_min": [1.0], "gain": [1.0], "delay_min": 0.0}, "curve"),
        ("input", {"channel": "x", "curve": "linear", "tau_min": [-1.0], "gain": [1.0], "delay_min": 0.0}, "tau_min"),
        ("gain", {"path": "TTF", "change": 0.1}, "path"),
        ("gain", {"path": "DTF", "chnge": 0.1}, "chnge"),
        ("hysteresis", {"path": "DTF", "form": "play", "half_width_um": float("nan")}, "half_width_um"),
        ("delay", {"path": "DTF", "delay_min": "soon", "lag_min": 0.0}, "delay_min"),
        ("gain", {"path": "DTF", "form": "share", "change": 0.1}, "unknown key 'form'"),
        ("delay", {"path": "DTF", "delay_min": 1.0, "lag_min": 0.0, "walk_times": 5.0}, "unknown key 'walk_times'"),
        ("nonlinear", {"form": "cube", "path": "DTF", "change": 0.1, "b": [0.1], "a": [1.0]}, "unknown key 'b'"),
        ("scheduled", SCHEDULE | {"tau_min": 30.0}, "unknown key 'tau_min'"),
        ("scheduled", SCHEDULE | {"origin": "20"}, "origin"),
        ("scheduled", SCHEDULE | {"origin": True}, "origin"),
        ("scheduled", SCHEDULE | {"origin": float("nan")}, "origin"),
    ],
)
def test_a_wrong_table_names_kind_key_and_value(kind, table, words):
    with pytest.raises(ModelError, match=f"effect {kind}: .*{words}"):
        effect_from(kind, table)


@pytest.mark.parametrize("name", ["t_q_degc", "at_degc", "y_um", ""])
def test_no_effect_takes_a_temperature_of_the_paths_or_measured_y_as_its_channel(name):
    """The service gives effects neither: they would act in `simulate` alone."""
    for kind, table in EFFECTS:
        for key in {"channel", "fluid"} & table.keys():
            with pytest.raises(ModelError, match=f"effect {kind}: {key} = '{name}', expected a logged channel"):
                effect_from(kind, table | {key: name})


@pytest.mark.parametrize(("origin", "acts"), [(8.0, True), ("zero", True), ("start", False)])
def test_a_schedule_counts_from_its_origin_on_a_day_that_begins_elsewhere(origin, acts):
    effect = effect_from("scheduled", SCHEDULE | {"origin": origin})
    model = parse_model(dump_model(dataclasses.replace(QUILL, effects=(effect,))).encode(), source="test")
    assert model.effects[0].origin == origin
    engine = Engine(model)
    engine.set_reference(20.0, 20.0)
    added = [engine.step(40.0, 20.0, {"pump_lpm": 1.0}).y_effects_um[0] for _ in range(60)]
    assert (abs(added[-1]) > 1.0) is acts


def test_a_schedule_is_proposed_from_where_the_record_begins(evidence):
    begins = np.median(evidence.runs[0].channels["coolant_degc"][:10])
    found = [h.effect for h in forms(evidence) if h.effect.kind == "scheduled" and h.effect.channel == "coolant_degc"]
    assert found and all(effect.origin == begins for effect in found)
    # It is no parameter, so rows of `std_factor` of a file that counts from the start still fit.
    assert all(effect.parameters == dataclasses.replace(effect, origin="start").parameters for effect in found)


def test_a_channel_that_is_missing_at_first_starts_the_effect_when_it_comes():
    table = {"channel": "c", "curve": "linear", "tau_min": [0.5], "gain": [2.0], "delay_min": 0.0}
    engine = Engine(dataclasses.replace(QUILL, effects=(effect_from("input", table),)))
    engine.set_reference(20.0, 20.0)
    assert engine.step(20.0, 20.0, {"c": float("nan")}).y_effects_um == (0.0,)
    assert engine.step(20.0, 20.0, {"c": 30.0}).y_effects_um == (0.0,)
    assert engine.step(20.0, 20.0, {"c": 31.0}).y_effects_um[0] > 0.5
