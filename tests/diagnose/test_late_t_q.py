"""A late T_Q is named, deployed, and on a fresh day most of what can be removed is removed in real time."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.data.runs import Run
from compensator.diagnose.diagnosis import Diagnosis, diagnose
from compensator.diagnose.fitting.fit import Term, fit_terms
from compensator.diagnose.fitting.likelihood import Likelihood
from compensator.diagnose.fitting.points import Points
from compensator.diagnose.residual.base_run import signals_of
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search import foresight
from compensator.diagnose.search.findings import findings_of
from compensator.identify.calibration import predict
from compensator.model.effects.base import Effect, effect_from, filters
from compensator.model.effects.delay import DelayedSensor
from compensator.model.effects.hypothesis import proposals
from compensator.model.engine import Engine
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model
from compensator.model.thermal_model import ThermalModel
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from sim_hardware.physics.effects import LateSensor
from tests.diagnose.scenarios import Scenario, record, signals
from tests.identify.quill_runs import runs_from
from tests.model.test_late_t_q import run_of
from tests.service.records import direct

QUILL = load_model("quill")
PLACE = ("delay", "TTF", "")


def sensor(lag_min: float, delay_min: float) -> Scenario:
    """The way of the heat to T_Q, late."""

    def act(difference: np.ndarray) -> np.ndarray:
        keep = np.exp(-1.0 / lag_min) if lag_min else 0.0
        lagged = lfilter([1.0 - keep], [1.0, -keep], difference)
        k = np.arange(lagged.size)
        return np.asarray(np.interp(k - delay_min, k, lagged))

    return Scenario(place=PLACE, act=lambda s: np.zeros(s[0]), sensor=act)


def error(model: ThermalModel, run: Run, y: np.ndarray) -> float:
    return float(np.var(y - predict(model, run)))


def removed(extended: ThermalModel, late: list[Scenario], others: list[Scenario]) -> float:
    """The share that the model file removes, on a fresh day, of what a T_Q that is not late would remove."""
    deployed = parse_model(dump_model(extended).encode(), source="model.toml")
    (columns, true, _), (prompt, _, effect) = (record(scenarios, 5100, 18.0) for scenarios in (late + others, others))
    base = error(QUILL, runs_from(columns)[0], true)
    possible = base - error(QUILL, runs_from(prompt)[0], true - effect)
    return (base - error(deployed, runs_from(columns)[0], true)) / possible


def logged(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What a record is diagnosed with: each further channel is searched, and none acts."""
    return {name: columns[name] for name in ("t_q_degc", "at_degc", "y_um", "coolant_degc")}


def searched(base: ThermalModel, runs: list[Run]) -> tuple[tuple[Term, ...], ThermalModel]:
    """What a search in all of the data names, and the model with it as the engine runs it."""
    terms = findings_of(evidence_of(base, runs)).terms
    return terms, dataclasses.replace(base, effects=tuple(term.effect for term in terms), sha256="")


@functools.cache
def diagnosed(lag_min: float, delay_min: float) -> tuple[Run, Diagnosis]:
    """A day with a late T_Q, and what is found in it."""
    [run] = runs_from(logged(record([sensor(lag_min, delay_min)], 1100, 36.0)[0]))
    return run, diagnose(QUILL, [run])


@pytest.mark.parametrize(("lag_min", "delay_min", "least"), [(6.0, 0.0, 0.97), (0.0, 4.0, 0.9)])
def test_a_late_t_q_is_named_deployed_and_removed(lag_min: float, delay_min: float, least: float) -> None:
    run, found = diagnosed(lag_min, delay_min)
    [effect] = found.effects
    assert effect.place == PLACE
    assert effect.deployable
    assert found.verdict == "explained"
    total = sum(value for name, value in effect.named.items() if name.endswith("_min"))
    assert total == pytest.approx(lag_min + delay_min, abs=0.6)
    assert "in real time" in effect.explanation
    assert removed(found.model, [sensor(lag_min, delay_min)], []) > least
    # Nothing is left beside what the engine states, and with no error of its own the residual would not be watched.
    assert found.model.y_std_um == pytest.approx(0.09, rel=0.2)
    # What is promised is what the engine leaves, and not what could be known afterwards.
    left_um = np.sqrt(error(found.model, run, run.y_um))
    assert found.after.rms_um == pytest.approx(left_um, rel=0.1)
    assert effect.rms_after_um == pytest.approx(left_um, rel=0.1)


@pytest.mark.parametrize(
    ("error_w", "channels", "left"), [(2.0, ("heat_w", "at_degc", "motor_w"), 0.05), (60.0, ("motor_w",), 0.7)]
)
def test_what_a_dead_time_hides_another_channel_shows(error_w: float, channels: tuple[str, ...], left: float) -> None:
    """Where the motor's power is logged, it shows the minutes in which T_Q cannot know of the heat.

    A good one takes the place of the correction, a poor one is a remainder beside it.
    """
    late = sensor(0.0, 12.0)

    def with_power(seed: int, hours: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
        columns, true, _ = record([late], seed, hours)
        kept = {name: columns[name] for name in ("t_q_degc", "at_degc", "y_um")}
        noise_w = np.random.default_rng(seed).normal(0.0, error_w, true.size)
        return kept | {"motor_w": 4.0 * signals(seed, hours)[2] + noise_w}, true

    found = diagnose(QUILL, runs_from(with_power(1106, 24.0)[0]))
    [effect] = found.effects
    assert effect.place == PLACE
    assert found.remainder is not None and found.remainder.deployed and found.remainder.channels == channels
    fresh, true = with_power(5106, 12.0)
    [run] = runs_from(fresh)
    deployed = parse_model(dump_model(found.model).encode(), source="model.toml")
    corrected = dataclasses.replace(deployed, effects=(effect.effect,))
    assert error(deployed, run, true) < left * error(corrected, run, true)


def direct_run(seed: int, hours: float, delay_min: float) -> tuple[Run, np.ndarray]:
    """A run of the direct model's machine with a late T_Q, and its true deformation."""
    t_q, at, _ = run_of(seed, hours, 0.01, form="sensor", lag_min=0.0, delay_min=delay_min)
    _, _, _, ambient, _, _, difference = signals(seed, hours)
    base = direct("kalman")
    assert base.tdtf is not None
    y = base.dtf.sampled.response(difference) + base.tdtf.sampled.response(ambient)
    noise_um = np.random.default_rng(seed).normal(0.0, 0.1, y.size)
    return runs_from({"t_q_degc": t_q, "at_degc": at, "y_um": y + noise_um})[0], y


def late_in(base: ThermalModel, runs: list[Run]) -> Effect:
    """The one effect that a search names, as the engine runs it."""
    ([term], _) = searched(base, runs)
    return term.effect


def test_how_the_drive_goes_on_is_learned_with_a_late_t_q() -> None:
    """T_Q − AT of a direct model does not stay where it is: what a dead time hides of it is foreseen in part."""
    base = direct("kalman")
    late = late_in(base, [direct_run(1108, 14.0, 10.0)[0]])
    assert isinstance(late, DelayedSensor) and late.behind_min > 1.0
    stays = dataclasses.replace(late, walk_times=1.0, behind_min=0.0)
    fresh, true = direct_run(5108, 14.0, 10.0)
    prompt = error(base, direct_run(5108, 14.0, 0.0)[0], true)
    held, foreseen = (error(dataclasses.replace(base, effects=(one,)), fresh, true) for one in (stays, late))
    assert foreseen - prompt < 0.6 * (held - prompt)


def test_how_fast_the_heat_moves_is_learned_with_a_late_t_q() -> None:
    """A calibration with hardly a change of the heat says that it hardly moves, and the correction comes late."""
    calm = dataclasses.replace(QUILL, estimator=dataclasses.replace(QUILL.estimator, drive_walk_std=0.5))
    columns, _, _ = record([sensor(0.0, 2.0)], 1109, 14.0)
    late = late_in(calm, runs_from(columns))
    assert isinstance(late, DelayedSensor) and late.walk_times > 2.0 and late.behind_min == 0.0
    fresh, true, _ = record([sensor(0.0, 2.0)], 5109, 14.0)
    before, after = (
        error(dataclasses.replace(calm, effects=(one,)), runs_from(fresh)[0], true)
        for one in (dataclasses.replace(late, walk_times=1.0), late)
    )
    assert after < 0.5 * before


def test_no_dead_time_is_none() -> None:
    """The search of a lag and a dead time ends at the bound, where there is none."""
    columns, _, _ = record([sensor(6.0, 0.0)], 1107, 36.0)
    evidence = evidence_of(QUILL, runs_from(columns))
    both = next(h for h in proposals(evidence.context) if h.place == PLACE and h.form == "path, dead time and lag")
    points = Points(evidence)
    fit = fit_terms(Likelihood(points, points.typical_rest()), [(both, (0.5, 4.0))])
    assert fit.terms[0].named["delay_min"] == 0.0
    assert fit.terms[0].named["lag_min"] == pytest.approx(6.0, abs=0.5)


def test_another_effect_beside_it_is_fitted_to_what_it_gets() -> None:
    late = sensor(0.0, 3.0)
    weaker = Scenario(place=("gain", "DTF", ""), act=lambda s: -0.2 * s[4])
    terms, extended = searched(QUILL, runs_from(record([late, weaker], 1101, 24.0)[0]))
    assert sorted(term.hypothesis.place for term in terms) == [PLACE, ("gain", "DTF", "")]
    gain = next(term for term in terms if term.effect.kind == "gain")
    assert gain.named["change"] == pytest.approx(-0.2, abs=0.02)
    assert removed(extended, [late], [weaker]) > 0.95


def test_a_correction_that_does_harm_is_left_out_and_what_stands_beside_it_is_deployed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A drive that is expected to hardly move: what the engine makes of the dead time is worse than the dead time.
    monkeypatch.setattr(foresight, "_best", lambda evidence, late: foresight.Foresight(walk_times=0.01))
    late = sensor(0.0, 3.0)
    weaker = Scenario(place=("gain", "DTF", ""), act=lambda s: -0.2 * s[4])
    found = diagnose(QUILL, runs_from(record([late, weaker], 1101, 24.0)[0]))
    gain, delay = found.effects
    assert [gain.place, delay.place] == [("gain", "DTF", ""), PLACE]
    assert [effect.kind for effect in found.model.effects] == ["gain"]
    assert gain.deployable and not delay.deployable
    assert "T_Q is used as it is" in delay.explanation and "can correct this" not in delay.explanation
    assert gain.named["change"] == pytest.approx(-0.2, abs=4.0 * gain.std["change"])
    # Known with the future it explains all that is left: that is stated, and looked for no further.
    assert delay.rms_after_um < 0.3 * delay.rms_before_um
    assert found.advice is None or found.advice.unexplained is None
    assert found.model.y_std_um == pytest.approx(gain.rms_after_um, rel=0.3)
    assert found.after.rms_um == pytest.approx(gain.rms_after_um, rel=0.1)
    assert removed(found.model, [late], [weaker]) > 0.85
    # The page draws what the model takes off, and what is left with the delay in it.
    curves = found.series()
    assert np.nanstd(curves["residual_after_um"]) == pytest.approx(gain.rms_after_um, rel=0.05)
    assert curves["effect_1_um"].any() and not curves["effect_2_um"].any()
    assert len(found.steps) == 1


def test_the_signals_of_a_model_that_corrects_it_are_the_engines() -> None:
    run, found = diagnosed(0.0, 4.0)
    own = signals_of(found.model, run)
    np.testing.assert_array_equal(own.share("all"), predict(found.model, run))
    assert findings_of(evidence_of(found.model, [run])).terms == ()


def test_what_flows_beside_a_late_t_q_gets_the_engines_temperatures() -> None:
    late = DelayedSensor(path="TTF", form="sensor", delay_min=8.0, lag_min=0.0)
    table = {"form": "flow", "channel": "flow_lpm", "fluid": "coolant_degc", "span": 10.0, "half": 0.5}
    flow = effect_from("input", table | {"tau_min": [20.0], "gain": [0.5], "gain_air": [0.2]})
    model = dataclasses.replace(QUILL, effects=(late, flow))
    columns, _, _ = record([sensor(0.0, 8.0)], 1103, 12.0)
    minutes = np.arange(columns["y_um"].size)
    channels = {"flow_lpm": 10.0 * (minutes % 90 > 30), "coolant_degc": 22.0 + 0.0 * minutes}
    [run] = runs_from({name: columns[name] for name in ("t_q_degc", "at_degc", "y_um")} | channels)
    engine = Engine(model)
    engine.set_reference(*run.reference)
    streamed = [e.y_effects_um[1] for e in engine.run(run.t_q_degc, run.at_degc, run.channels)]
    at_once = flow.law(signals_of(model, run), filters(flow.blocks(1.0)))
    assert np.ptp(streamed) > 2.0
    np.testing.assert_allclose(streamed, at_once, rtol=0, atol=1e-9)


def test_a_late_thermocouple_of_another_hand() -> None:
    """Ten seconds a step, and means over a minute."""
    duty = Duty.working_day(43, hours=16.0)
    sensors = usual_sensors(duty.extra_names, temperature_noise_k=0.05, y_noise_um=1.0)

    def columns(effects: list[LateSensor], seed: int) -> dict[str, np.ndarray]:
        table = World(PublishedQuill(effects=effects), duty, sensors, seed).record(60.0)
        table.pop("t_s")
        return table

    late = LateSensor(delay_s=60.0, lag_s=180.0)
    [term], extended = searched(QUILL, runs_from(columns([late], 6)))
    assert term.hypothesis.place == PLACE
    # That thermocouple is late for the heat and prompt for the ambient.
    assert term.hypothesis.form.startswith("path")
    fresh, prompt = (runs_from(columns(effects, 7))[0] for effects in ([late], []))
    noise = error(QUILL, prompt, prompt.y_um)
    base, after = (error(model, fresh, fresh.y_um) for model in (QUILL, extended))
    assert (base - after) / (base - noise) > 0.9


def test_a_thermocouple_that_is_late_for_the_ambient_too() -> None:
    t_q, at, y = run_of(1104, 14.0, 0.02, form="sensor", lag_min=5.0, delay_min=0.0)
    noise = np.random.default_rng(2).normal(0.0, 0.3, y.size)
    [term], extended = searched(QUILL, runs_from({"t_q_degc": t_q, "at_degc": at, "y_um": y + noise}))
    assert term.hypothesis.place == PLACE
    assert term.hypothesis.form.startswith("sensor")
    t_q, at, y = run_of(1105, 14.0, 0.02, form="sensor", lag_min=5.0, delay_min=0.0)
    [fresh] = runs_from({"t_q_degc": t_q, "at_degc": at, "y_um": y})
    assert error(extended, fresh, y) < 0.02 * error(QUILL, fresh, y)


def test_a_direct_model_names_its_sensor() -> None:
    late, base = sensor(4.0, 0.0), direct("kalman")
    columns, _, _ = record([late], 1103, 14.0)
    _, _, _, _, _, y_tdtf, difference = signals(1103, 14.0)
    y = base.dtf.sampled.response(difference) + y_tdtf
    columns["y_um"] = y + np.random.default_rng(1).normal(0.0, 0.1, y.size)
    found = diagnose(base, runs_from(logged(columns)))
    assert [e.place for e in found.effects] == [("delay", "DTF", "")]
    assert found.model.late_t_q is not None
    assert found.after.rms_um < 0.6 * found.before.rms_um
