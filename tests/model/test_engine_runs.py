"""The streaming engine: both ways to the heat, gaps, snapshots, effects."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy import linalg, signal

from compensator.data.record import SampledRecord
from compensator.errors import ModelError
from compensator.model.effects import Effect, effect_from, kinds, register
from compensator.model.effects.base import number, text
from compensator.model.effects.blocks import Block
from compensator.model.engine import Engine, Estimate, wrong_histories
from compensator.model.model_file import load_model, parse_model
from compensator.model.simulation import simulate
from compensator.model.thermal_model import ThermalModel

QUILL = load_model("quill")
RANDOM = np.random.default_rng(7)
HEAT = np.repeat([0.0, 60.0, 0.0, 30.0, 90.0, 0.0], 120)
N = HEAT.size
AMBIENT = 20.0 + 0.8 * np.sin(np.arange(N) / 200.0)


def with_method(method: str, **changes: float) -> ThermalModel:
    estimator = dataclasses.replace(QUILL.estimator, method=method, **changes)  # type: ignore[arg-type]
    return dataclasses.replace(QUILL, estimator=estimator)


def temperatures(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    assert QUILL.ttf is not None
    t_q = AMBIENT + QUILL.ttf.sampled.response(HEAT)
    return t_q + noise * RANDOM.normal(size=N), AMBIENT + noise * RANDOM.normal(size=N)


def started(model: ThermalModel, t_q: np.ndarray, at: np.ndarray) -> Engine:
    engine = Engine(model)
    engine.set_reference(float(t_q[0]), float(at[0]))
    return engine


def y_of(estimates: list[Estimate]) -> np.ndarray:
    return np.array([e.y_um for e in estimates])


def test_inverse_is_the_reversed_ttf_to_the_letter() -> None:
    assert QUILL.ttf is not None and QUILL.tdtf is not None
    t_q, at = temperatures(0.02)
    run = started(with_method("inverse"), t_q, at).run(t_q, at)
    ttf = QUILL.ttf.sampled
    heat = signal.lfilter(ttf.a, ttf.b, (t_q - at) - (t_q[0] - at[0]))
    y = QUILL.dtf.sampled.response(heat) + QUILL.tdtf.sampled.response(at - at[0])
    assert np.max(np.abs(np.array([e.heat_w for e in run]) - heat)) < 1e-8
    assert np.max(np.abs(y_of(run) - y)) < 1e-9


@pytest.mark.parametrize("method", ["inverse", "kalman"])
def test_stream_equals_batch_to_the_bit(method: str) -> None:
    t_q, at = temperatures(0.05)
    t_q[200:230] = np.nan
    at[220:240] = np.nan
    batch = started(with_method(method), t_q, at).run(t_q, at)
    engine = started(with_method(method), t_q, at)
    assert [engine.step(float(a), float(b)) for a, b in zip(t_q, at, strict=True)] == batch


@pytest.mark.parametrize("method", ["inverse", "kalman"])
@pytest.mark.parametrize("cut", [3, 150, 700])
def test_restored_engine_goes_on_with_the_same_bits(method: str, cut: int) -> None:
    t_q, at = np.tile(temperatures(0.05), 6)
    whole = started(with_method(method), t_q, at).run(t_q, at)
    at_cut = cut if cut < 700 else 4000  # the last one lies where the covariance has settled
    first = started(with_method(method), t_q, at)
    first.run(t_q[:at_cut], at[:at_cut])
    second = Engine(with_method(method))
    second.restore(first.snapshot())
    assert second.run(t_q[at_cut:], at[at_cut:]) == whole[at_cut:]


def test_kalman_agrees_with_the_riccati_equation() -> None:
    """Dense matrices made here, solved by scipy, against the observer's own recursion."""
    model = with_method("kalman")
    assert model.ttf is not None and model.tdtf is not None
    blocks = [model.ttf.sampled, model.dtf.sampled, model.tdtf.sampled]
    n = sum(b.order for b in blocks)
    F, H = np.zeros((n + 2, n + 2)), np.zeros((2, n + 2))
    start, starts = 0, []
    for block, source in zip(blocks, (n, n, n + 1), strict=True):
        k = block.order
        a = np.array(block.a[1:])
        b = np.array([*block.b, *[0.0] * (k + 1 - len(block.b))])
        F[start : start + k, start : start + k] = np.eye(k, k=1)
        F[start : start + k, start] -= a
        F[start : start + k, source] = b[1:] - a * b[0]
        starts.append(start)
        start += k
    F[n, n] = F[n + 1, n + 1] = 1.0
    H[0, n + 1] = 1.0
    H[1, starts[0]], H[1, n], H[1, n + 1] = 1.0, model.ttf.sampled.b[0], 1.0
    e = model.estimator
    Q = np.zeros_like(F)
    Q[n, n], Q[n + 1, n + 1] = e.drive_walk_std**2, e.at_walk_std_k**2
    R = np.diag([e.at_noise_std_k**2, e.t_q_noise_std_k**2])
    prior = linalg.solve_discrete_are(F.T, H.T, Q, R)
    posterior = prior - prior @ H.T @ np.linalg.solve(H @ prior @ H.T + R, H @ prior)
    C = np.zeros(n + 2)
    C[starts[1]] = C[starts[2]] = 1.0
    C[n], C[n + 1] = model.dtf.sampled.b[0], model.tdtf.sampled.b[0]
    t_q, at = np.tile(temperatures(0.05), 6)
    last = started(model, t_q, at).run(t_q, at)[-1]
    assert last.heat_std_w == pytest.approx(math.sqrt(posterior[n, n]), rel=1e-3)
    assert last.y_std_um**2 - model.y_std_um**2 == pytest.approx(C @ posterior @ C, rel=5e-3)


def test_kalman_has_less_noise_and_states_how_much() -> None:
    """0.05 K on T_Q − AT alone: 0.133 µm behind the plain inverse, about 0.11 behind the Kalman filter."""
    assert QUILL.ttf is not None
    heat = np.tile(np.repeat([0.0, 60.0, 30.0, 90.0, 0.0], 192), 3)
    difference = QUILL.ttf.sampled.response(heat)
    noise = np.random.default_rng(3).normal(0.0, 0.05, heat.size)
    rms = {}
    for method in ("inverse", "kalman"):
        model = with_method(method, at_noise_std_k=1e-4, at_walk_std_k=1e-3)
        engine = Engine(model)
        engine.set_reference(20.0, 20.0)
        run = engine.run(20.0 + difference + noise, np.full(heat.size, 20.0))
        rms[method] = float(np.std(y_of(run) - QUILL.dtf.sampled.response(heat)))
        stated = math.sqrt(run[-1].y_std_um ** 2 - model.y_std_um**2)
        assert stated == pytest.approx(rms[method], rel=0.15)
    assert rms["inverse"] == pytest.approx(0.133, abs=0.01)
    assert rms["kalman"] < 0.9 * rms["inverse"]


@pytest.mark.parametrize("missing", ["t_q", "at", "both"])
def test_a_gap_is_walked_over_with_interpolated_inputs(missing: str) -> None:
    t_q, at = temperatures()
    gap = slice(300, 320)
    holed_t_q, holed_at = t_q.copy(), at.copy()
    if missing != "at":
        holed_t_q[gap] = np.nan
    if missing != "t_q":
        holed_at[gap] = np.nan
    index = np.arange(N)

    def filled(values: np.ndarray) -> np.ndarray:
        known = ~np.isnan(values)
        return np.interp(index, index[known], values[known])

    model = with_method("inverse")
    holed = started(model, t_q, at).run(holed_t_q, holed_at)
    straight = started(model, t_q, at).run(filled(holed_t_q), filled(holed_at))
    assert np.max(np.abs(y_of(holed)[320:] - y_of(straight)[320:])) < 1e-9
    stds = [e.y_std_um for e in holed[302:320]]
    assert stds[-1] > holed[299].y_std_um
    if missing != "at":  # an error of AT acts through heat and TDTF with opposite signs
        assert all(b > a for a, b in itertools.pairwise(stds))
    assert holed[500].y_std_um < stds[-1]


def test_a_long_gap_is_left_as_predicted() -> None:
    t_q, at = temperatures()
    t_q[300:380] = np.nan
    engine = Engine(with_method("inverse"), bridge_samples=60)
    engine.set_reference(float(t_q[0]), float(at[0]))
    heats = [e.heat_w for e in engine.run(t_q, at)]
    assert heats[300:380] == pytest.approx([heats[299]] * 80)


def test_direct_model_has_no_heat() -> None:
    text = """
schema = 1
name = "direct"
kind = "direct"
sample_period_s = 60.0
[paths.DTF]
unit = "um/K"
form = "continuous"
numerator = [4.0]
denominator = [1.0, 30.0]
[estimator]
method = "inverse"
t_q_noise_std_k = 0.02
at_noise_std_k = 0.02
difference_walk_std_k = 0.2
at_walk_std_k = 0.01
"""
    model = parse_model(text.encode(), source="test")
    engine = Engine(model)
    engine.set_reference(22.0, 20.0)
    run = engine.run(np.full(600, 27.0), np.full(600, 20.0))
    assert run[-1].y_um == pytest.approx(20.0, abs=1e-3)
    assert all(math.isnan(e.heat_w) for e in run)


@pytest.mark.parametrize(("b", "a"), [([2.0], [1.0]), ([1.5, 0.5], [1.0, 0.0])])
def test_a_model_without_a_time_constant_is_simulated_from_rest(b: list[float], a: list[float]) -> None:
    text = f"""
schema = 1
name = "direct"
kind = "direct"
sample_period_s = 60.0
paths.DTF = {{ unit = "um/K", form = "sampled", b = {b}, a = {a} }}
[estimator]
method = "inverse"
t_q_noise_std_k = 0.02
at_noise_std_k = 0.02
difference_walk_std_k = 0.2
at_walk_std_k = 0.01
"""
    t_q = np.repeat([25.0, 27.0], 5)
    record = SampledRecord(t_s=60.0 * np.arange(10), columns={"t_q_degc": t_q, "at_degc": np.full(10, 20.0)})
    y = simulate(parse_model(text.encode(), source="test"), record, from_rest=True)["y_pred_um"]
    assert y[[0, -1]] == pytest.approx([0.0, 4.0])


class Slow(Block):
    def __init__(self) -> None:
        self.state = (0.0,)

    def step(self, u: float) -> float:
        self.state = (self.state[0] + 0.2 * (u - self.state[0]),)
        return self.state[0]


class ChannelLag(Effect):
    """Adds a lagged channel to y: what an effect of the model file looks like to the engine."""

    kind = "test-channel"
    channel: str = text()
    gain_um_per_k: float = number()

    def blocks(self, period_min: float) -> tuple[Any, ...]:
        return (Slow(),)

    def law(self, signals: Any, run: Sequence[Any]) -> Any:
        return self.gain_um_per_k * run[0](signals.channels[self.channel])


@pytest.fixture
def lag_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kind of effect that is there for one test only."""
    known = kinds()
    monkeypatch.setattr("compensator.model.effects.base._FORMS", [form for own in known.values() for form in own])
    register(ChannelLag)


@pytest.mark.usefixtures("lag_kind")
def test_effects_run_hold_a_missing_channel_and_survive_gaps() -> None:
    table = effect_from("test-channel", {"channel": "coolant_degc", "gain_um_per_k": 2.0})
    model = dataclasses.replace(with_method("inverse"), effects=(table,))
    t_q, at = np.full(100, 20.0), np.full(100, 20.0)
    coolant = np.where(np.arange(100) >= 10, 5.0, 0.0)
    holed = coolant.copy()
    holed[40:50] = np.nan
    engine = Engine(model)
    assert engine.channels == ("coolant_degc",)
    engine.set_reference(20.0, 20.0)
    run = engine.run(t_q, at, {"coolant_degc": holed})
    assert run[-1].y_effects_um == pytest.approx((10.0,), abs=1e-6)
    assert run[-1].y_um == pytest.approx(10.0, abs=1e-6)
    assert run[10].y_rate_um_per_min == pytest.approx(run[11].y_um - run[10].y_um)
    assert [e.y_effects_um[0] for e in run[45:48]] == pytest.approx([10.0] * 3, abs=0.02)
    whole = Engine(model)
    whole.set_reference(20.0, 20.0)
    assert y_of(whole.run(t_q, at, {"coolant_degc": coolant}))[50:] == pytest.approx(y_of(run)[50:], abs=1e-12)


COOLED = effect_from(
    "input", {"channel": "coolant_degc", "curve": "linear", "tau_min": [10.0], "gain": [0.5], "delay_min": 0.0}
)


@pytest.mark.parametrize("method", ["inverse", "kalman"])
@pytest.mark.parametrize(("dead_from", "lost"), [(298, 20), (250, 50), (100, 20), (310, 20), (100, 200), (290, 200)])
def test_a_dead_channel_does_not_keep_a_gap_of_a_temperature_from_being_repeated(
    method: str, dead_from: int, lost: int
) -> None:
    """The channel shows the same all the time: held, it says what it would have said."""
    model = dataclasses.replace(with_method(method), effects=(COOLED,))
    t_q, at = temperatures()

    def run(dead_from: int) -> np.ndarray:
        engine, found = started(model, t_q, at), []
        for i in range(N):
            channels = {"coolant_degc": 25.0 if i < dead_from else np.nan}
            if lost <= 60 or not 300 <= i < 300 + lost:
                found.append(engine.step(np.nan if 300 <= i < 300 + lost else t_q[i], at[i], channels))
            elif i == 300:
                engine.skip(lost)
            if i % 50 == 7:
                engine, before = Engine(model), engine
                engine.check(before.snapshot())
                engine.restore(before.snapshot())
        return np.array([(one.y_um, one.y_std_um) for one in found])

    assert run(dead_from).tolist() == run(N).tolist()


@pytest.mark.parametrize("held", [False, True])
def test_a_machine_that_begins_with_a_dead_channel_is_found_as_warm_as_it_is(held: bool) -> None:
    assert QUILL.ttf is not None
    t_q = 20.0 + QUILL.ttf.sampled.response(np.full(2000, 60.0))

    def found(coolant: float) -> Estimate:
        engine = started(dataclasses.replace(with_method("inverse"), effects=(COOLED,)), t_q, np.full(2000, 20.0))
        if not held:
            engine.step(20.0, 20.0, {"coolant_degc": coolant})
        engine.skip(1500, held=held)
        return engine.step(t_q[-1], 20.0, {"coolant_degc": coolant})

    assert found(np.nan) == found(25.0)
    assert found(np.nan).y_um > 40.0


@pytest.mark.parametrize("second", [0, 40, 100])
def test_a_second_pause_leaves_the_first_to_be_repeated(second: int) -> None:
    """T_Q is not back yet after the first one, from which nothing is known of before."""
    assert QUILL.ttf is not None
    t_q = 20.0 + QUILL.ttf.sampled.response(np.full(2000, 60.0))
    engine = Engine(with_method("inverse"))
    engine.set_reference(20.0, 20.0)
    engine.skip(1500, held=True)
    engine.step(np.nan, 20.0)
    if second:
        engine.skip(second)
    assert engine.step(t_q[-1], 20.0).y_um == pytest.approx(61.1, abs=0.5)


def test_a_channel_that_was_dead_for_long_is_taken_as_it_is_once_it_is_back() -> None:
    model = dataclasses.replace(with_method("kalman"), effects=(COOLED,))
    t_q, at = temperatures(0.02)
    coolant = np.where(np.arange(N) < 400, 25.0, 40.0)
    coolant[300:461] = np.nan
    bridged, plain = (Engine(model, bridge_samples=samples) for samples in (60, 0))
    for engine in (bridged, plain):
        engine.set_reference(float(t_q[0]), float(at[0]))
    channels = {"coolant_degc": coolant}
    assert bridged.run(t_q, at, channels) == plain.run(t_q, at, channels)


@pytest.mark.parametrize("method", ["inverse", "kalman"])
def test_a_sensor_with_another_zero_does_not_move_what_acts_by_its_temperature(method: str) -> None:
    """A couple that was exchanged reads 3 K more: what coolant takes from the machine is as it was, over restarts."""
    table = {"form": "flow", "channel": "flow_lpm", "fluid": "coolant_degc", "span": 10.0, "half": 0.5}
    effect = effect_from("input", table | {"tau_min": [20.0], "gain": [0.5], "gain_air": [0.2]})
    model = dataclasses.replace(with_method(method), effects=(effect,))
    t_q, at = temperatures()
    channels = [{"flow_lpm": 10.0 * (i % 90 > 30), "coolant_degc": 15.0} for i in range(N)]
    whole = started(model, t_q, at)
    expected = [whole.step(*values) for values in zip(t_q, at, channels, strict=True)]
    engine, found = started(model, t_q, at), []
    for i in range(N):
        if i == 300:
            engine.shift_reference(3.0, -1.0)
            engine, before = Engine(model), engine
            engine.restore(before.snapshot())
        more_k = (3.0, -1.0) if i >= 300 else (0.0, 0.0)
        found.append(engine.step(t_q[i] + more_k[0], at[i] + more_k[1], channels[i]))
    assert np.ptp([one.y_effects_um[0] for one in expected]) > 2.0
    assert y_of(found) == pytest.approx(y_of(expected), abs=1e-9)


def test_a_zero_does_not_exchange_a_sensor() -> None:
    """The couple reads 3 K more; after a zero it does so still, and coolant takes what it takes from the machine."""
    table = {"form": "flow", "channel": "flow_lpm", "fluid": "coolant_degc", "span": 10.0, "half": 0.5}
    effect = effect_from("input", table | {"tau_min": [20.0], "gain": [0.5], "gain_air": [0.2]})
    engine = Engine(dataclasses.replace(load_model("quill"), effects=(effect,)))
    # The pump starts after 10 min, with coolant as warm as the machine.
    pump = [{"flow_lpm": 10.0 * (i >= 10), "coolant_degc": 15.0} for i in range(60)]
    engine.set_reference(15.0, 15.0)
    engine.shift_reference(3.0, -1.0)
    for _ in range(2):
        engine.set_reference(18.0, 14.0)
        assert y_of([engine.step(18.0, 14.0, channels) for channels in pump]) == pytest.approx(0.0, abs=1e-9)
    engine.set_reference(18.0, 14.0, (0.0, 0.0))
    assert min(y_of([engine.step(18.0, 14.0, channels) for channels in pump])) < -0.5


def test_unknown_effect_is_named() -> None:
    with pytest.raises(ModelError, match=r"effect 1 has kind 'magic', expected one of: .*gain"):
        parse_model(f'{TEXT}\n[[effect]]\nkind = "magic"\n'.encode(), source="written")


TEXT = load_model.__globals__["read_model_bytes"]("quill").decode()

INPUT = 'kind = "input"\nchannel = "fan_rpm"\ncurve = "linear"\ndelay_min = 0\n'
DRIVE = 'kind = "nonlinear"\nform = "drive"\npath = "DTF"\nchange = 0.01\nb = [0.1]\n'
SCHEDULED = (
    'kind = "scheduled"\nform = "drive"\npath = "DTF"\nchannel = "fan_rpm"\norigin = "zero"\nspan = 1\n'
    "change = 1\nb = [0.1]\n"
)
GAIN = 'kind = "gain"\npath = "DTF"\nchange = 0.1\n'


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (INPUT + "tau_min = [1.0, 2.0]\ngain = [1.0]\n", "effect 2: input: a filter bank: 2 tau_min for 1 gain"),
        (DRIVE + "a = [2.0, -0.9]\n", "effect 2: nonlinear: .* starts with 1"),
        (DRIVE + "a = [1.0, -0.9]\nstd_factor = [[0.0, 0.0, 0.1, 0.0]]\n", "effect 2: nonlinear: .* starts with 1"),
        (DRIVE + "a = [1.0, -1.01]\n", "effect 2: nonlinear: unstable: pole at z = 1.01"),
        (DRIVE + "a = [1.0, -0.9]\nstd_factor = [[0.0, 0.0, 0.0, -0.1]]\n", "effect 2: nonlinear: unstable: pole"),
        (SCHEDULED + "a = [1.0, 0.0, 1.0]\n", "effect 2: scheduled: unstable: pole at z = .*1j, expected"),
        (GAIN + "explanation = 5\n", "effect gain: explanation = 5, expected a string"),
        (GAIN + 'explanation = "\\u001b[2J"\n', "without control characters"),
        (GAIN + f'explanation = "{"x" * 10_001}"\n', "at most 10000 characters"),
        (GAIN + "std = 3\n", "effect gain: std: expected a table, got 3"),
        (GAIN + "std = { change = nan }\n", "effect gain: std: change = nan, expected a number"),
        (GAIN + "std = { change = [1.0, inf] }\n", "effect gain: std: change = .*, expected a list of numbers"),
    ],
)
def test_an_effect_that_cannot_run_or_be_shown_is_refused_with_its_file(effect: str, expected: str) -> None:
    with pytest.raises(ModelError, match=f"^written: {expected}" if expected.startswith("effect") else expected):
        parse_model(f"{TEXT}\n[[effect]]\n{GAIN}\n[[effect]]\n{effect}".encode(), source="written")


def test_what_a_diagnosis_found_of_an_effect_is_read() -> None:
    found = 'std = { change = 1, taus = [2.0, 3.0] }\nexplanation = "4 µm: too high."\n'
    [effect] = parse_model(f"{TEXT}\n[[effect]]\n{GAIN}{found}".encode(), source="written").effects
    assert effect.std == {"change": 1.0, "taus": [2.0, 3.0]} and effect.explanation == "4 µm: too high."


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("schema = 1", "schema = 2", "schema = 2, expected 1"),
        ('name = "quill"', f'name = "{"q" * 301}"', "expected at most 300 printable characters"),
        ('name = "quill"', 'name = "a\\u001b[2J"', "expected at most 300 printable characters"),
        ("sample_period_s = 60.0", "sample_period = 60.0", "unknown key 'sample_period'"),
        ('unit = "K/W"', 'unit = "m.W^-1"', "expected 'K/W'"),
        (
            "denominator = [0.001022, 0.09112, 1.0]",
            "denominator = [-0.001022, 0.09112, 1.0]",
            "TTF is unstable",
        ),
        (
            "numerator = [0.0002567, 0.01629, 0.008079]",
            "numerator = [0.0002567, 0.01629, 0.000429]",
            "inverse ring",
        ),
        (
            'form = "continuous"\nnumerator = [0.0002567, 0.01629, 0.008079]\ndenominator = [0.001022, 0.09112, 1.0]',
            'form = "sampled"\nb = [0.01, 0.008]\na = [1.0, -0.9]',
            "makes the inverse ring",
        ),
        (
            "numerator = [0.0002567, 0.01629, 0.008079]",
            "numerator = [0.0002567, -0.01629]",
            "inverse unstable",
        ),
        ("numerator = [0.0002567, 0.01629, 0.008079]", "numerator = [nan]", "expected a list of numbers"),
        ("t_q_noise_std_k = 0.05", "t_q_noise_std_k = -0.05", "expected from 1e-09 to 1e+09"),
        ("t_q_noise_std_k = 0.05", "t_q_noise_std_k = 1e-200", "expected from 1e-09 to 1e+09"),
        ('method = "kalman"', 'method = "magic"', "expected one of: kalman, inverse"),
        ("at_degc = [15.0, 30.0]", "at_degc = [30.0, 15.0]", "expected the lower bound first"),
        ("[paths.DTF]", "[paths.XTF]", "unknown key 'XTF'"),
    ],
)
def test_bad_model_files_get_one_line(old: str, new: str, expected: str) -> None:
    assert old in TEXT
    with pytest.raises(ModelError) as caught:
        parse_model(TEXT.replace(old, new, 1).encode(), source="m.toml")
    assert expected in str(caught.value) and str(caught.value).startswith("m.toml: ")


@pytest.mark.parametrize("data", [b"", b"\xff\xfe\x00", b"[", b"a = 1", b"schema = 1"])
def test_no_model_in_a_file_is_said(data: bytes) -> None:
    with pytest.raises(ModelError):
        parse_model(data, source="m.toml")


@pytest.mark.parametrize("change", [0.0, 3.0])
def test_measured_y_leads_the_state_to_it_also_where_an_effect_amplifies_it(change: float) -> None:
    """A step by the paths alone would overshoot by what the curve adds, further each time."""
    t_q, at = temperatures()
    cube = effect_from("nonlinear", {"path": "DTF", "form": "cube", "change": change})
    model = dataclasses.replace(QUILL, effects=(cube,))
    engine, other = (Engine(model) for _ in range(2))
    for one in (engine, other):
        one.set_reference(float(t_q[0]), float(at[0]))
    for i in range(200):  # heat from sample 120 on, which one of them does not see
        engine.step(float(t_q[i]), float(at[i]))
        other.step(float(t_q[100]) if i > 100 else float(t_q[i]), float(at[i]))
    other.doubt([10.0 * np.array(history) for history in wrong_histories(model, (0, 20, 60, 120))[0]])
    for i in range(200, 260):
        right, found = engine.step(float(t_q[i]), float(at[i])), other.step(math.nan, float(at[i]))
        other.measure_y(right.y_um - found.y_um, 0.01)
        assert abs(found.y_um) < 1000.0
    assert found.y_um == pytest.approx(right.y_um, abs=2.0)


@pytest.mark.parametrize(
    ("kind", "table", "takes"),
    [
        ("nonlinear", {"path": "DTF", "form": "cube", "change": 1.0}, True),
        ("hysteresis", {"path": "DTF", "form": "play", "half_width_um": 5.0}, False),
        ("delay", {"path": "TDTF", "delay_min": 6.0, "lag_min": 0.0}, False),
    ],
)
def test_no_measured_y_corrects_what_an_effect_remembers(kind: str, table: dict[str, Any], takes: bool) -> None:
    model = dataclasses.replace(QUILL, effects=(effect_from(kind, table),))
    assert Engine(model).takes_y is takes
