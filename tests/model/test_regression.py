"""The remainder as an effect: arithmetic against scipy, variance, lost channels, model file, service, recordings."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy import signal

from compensator.audit.machine_audit import audit, summary
from compensator.cli import main
from compensator.demo.calibration import write_table
from compensator.diagnose.choice.outcome import Ceiling, Diagnosis, Remainder
from compensator.diagnose.words.ceiling_words import ceiling
from compensator.diagnose.words.remainder_words import remainder
from compensator.diagnose.words.summary import figures, verdict
from compensator.errors import ModelError, ServiceError
from compensator.messages import Offset, number
from compensator.model.effects import effect_from
from compensator.model.effects.base import filters, forms
from compensator.model.effects.blocks import ChangeSeen
from compensator.model.effects.hypothesis import Context, proposals
from compensator.model.effects.regression import MOST_CHANNELS, MOST_LAGS, MOST_ROWS, Regression
from compensator.model.effects.seen import Range, Seen
from compensator.model.effects.signals import RecordSignals
from compensator.model.engine import Engine, Estimate
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model, write_model
from compensator.model.thermal_model import ThermalModel
from compensator.recording.reading import read_messages, recordings
from compensator.service.compensation import Compensation, Outcome
from tests.audit.made import MACHINE, Service, readings
from tests.service.records import direct, sample
from tests.service.simulated import config

QUILL = load_model("quill")
INVERSE = dataclasses.replace(QUILL, estimator=dataclasses.replace(QUILL.estimator, method="inverse"))
TAUS = (0.0, 4.0, 35.0)
REMAINDER = Regression(
    channels=("coolant_degc", "heat_w", "speed_rpm", "at_degc", "speed_rpm"),
    exponents=(1.0, 1.0, 1.0, 1.0, 2.0),
    taus_min=TAUS,
    gains=((0.4, -0.2, 1.1), (0.01, 0.02, -0.03), (1e-3, 2e-3, -1e-3), (0.3, -0.5, 0.2), (1e-7, -3e-7, 5e-7)),
    std_factor=(
        tuple(0.01 * (i % 4 - 1.5) / (1 + 1e5 * (i > 11)) for i in range(15)),
        (0.0,) * 9 + (0.2,) + (0.0,) * 5,
    ),
)
#: It would go further at both ends of the record.
LIMITED = dataclasses.replace(REMAINDER, most_um=3.0)
N = 300
RANDOM = np.random.default_rng(11)
AT = 20.0 + 0.8 * np.sin(np.arange(N) / 60.0)
T_Q = AT + np.repeat([0.0, 4.0, 9.0, 2.0, 0.0], N // 5) + 0.02 * RANDOM.normal(size=N)
T_Q[0] = AT[0]
CHANNELS = {
    "coolant_degc": 22.0 + np.cumsum(0.05 * RANDOM.normal(size=N)),
    "speed_rpm": np.repeat([500.0, -3000.0, 0.0, 4500.0, 1500.0, 500.0], N // 6),
}


def with_remainder(effect: Regression = REMAINDER, base: ThermalModel = QUILL) -> ThermalModel:
    model = dataclasses.replace(base, effects=(effect,))
    return parse_model(dump_model(model).encode(), source="written")


def started(model: ThermalModel) -> Engine:
    engine = Engine(model)
    engine.set_reference(float(T_Q[0]), float(AT[0]))
    return engine


def holed() -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """The record with gaps of every sort: bridged ones, one that is too long, and a channel that comes late."""
    t_q, at, channels = T_Q.copy(), AT.copy(), {name: values.copy() for name, values in CHANNELS.items()}
    t_q[40:50] = at[45:53] = channels["coolant_degc"][47:60] = np.nan
    channels["speed_rpm"][:7] = channels["speed_rpm"][110:190] = np.nan
    t_q[250:258] = np.nan
    return t_q, at, channels


def at_sample(channels: dict[str, np.ndarray], k: int) -> dict[str, float]:
    return {name: float(values[k]) for name, values in channels.items()}


def columns(estimates: list[Estimate]) -> np.ndarray:
    """Outputs of all lags, by scipy alone: input by input, lag by lag."""
    speed = CHANNELS["speed_rpm"]
    found = []
    for u in (
        CHANNELS["coolant_degc"] - CHANNELS["coolant_degc"][0],
        np.array([e.heat_w for e in estimates]),
        speed - speed[0],
        AT - AT[0],
        np.sign(speed) * speed**2 - np.sign(speed[0]) * speed[0] ** 2,
    ):
        for tau in TAUS:
            b, a = ([1.0], [1.0]) if tau == 0.0 else signal.bilinear([1.0], [tau, 1.0], fs=1.0)
            found.append(signal.lfilter(b, a, u - u[0]) + u[0])
    return np.column_stack(found)


def test_its_addition_is_the_weighted_sum_of_lags_by_scipy_from_a_written_file() -> None:
    estimates = started(with_remainder(base=INVERSE)).run(T_Q, AT, CHANNELS)
    wanted = columns(estimates) @ np.concatenate(REMAINDER.gains)
    assert np.ptp(wanted) > 5.0
    assert [e.y_effects_um[0] for e in estimates] == pytest.approx(wanted, abs=1e-8)
    assert [e.y_um for e in estimates] == pytest.approx(
        [e.y_dtf_um + e.y_tdtf_um + y for e, y in zip(estimates, wanted, strict=True)], abs=1e-8
    )


def test_its_columns_over_a_record_are_what_the_gains_weight() -> None:
    """What a fit of the gains uses; with an undelayed column, and from the first value that is there."""
    drive, ambient = np.sin(np.arange(N) / 9.0), np.cos(np.arange(N) / 30.0)
    late = CHANNELS["coolant_degc"].copy()
    late[:20] = np.nan
    record = RecordSignals(
        drive=drive,
        ambient_k=ambient,
        t_q_degc=20.0 + drive + ambient,
        at_degc=20.0 + ambient,
        y_dtf_um=drive,
        y_tdtf_um=ambient,
        channels={"coolant_degc": late, "speed_rpm": CHANNELS["speed_rpm"]},
        period_min=1.0,
    )
    found = REMAINDER.columns(record, REMAINDER.blocks(1.0))
    assert found.shape == (N, 15)
    whole = REMAINDER.law(record, filters(REMAINDER.blocks(1.0)))
    assert found @ np.concatenate(REMAINDER.gains) == pytest.approx(whole)
    assert np.array_equal(found[:, 3], drive) and np.array_equal(found[:, 9], ambient)
    assert not found[:21, :3].any() and np.array_equal(found[20:, 0], late[20:] - late[20])


@pytest.mark.parametrize(
    ("base", "effect"),
    [(QUILL, REMAINDER), (INVERSE, REMAINDER), (QUILL, LIMITED)],
    ids=["kalman", "inverse", "limited"],
)
def test_stream_equals_batch_over_gaps_and_from_every_snapshot_to_the_bit(
    base: ThermalModel, effect: Regression
) -> None:
    t_q, at, channels = holed()
    model = with_remainder(effect, base)
    batch = started(model).run(t_q, at, channels)
    engine = started(model)
    for k in range(N):
        second = Engine(model)
        second.restore(engine.snapshot())
        second.check(engine.snapshot())
        values = float(t_q[k]), float(at[k]), at_sample(channels, k)
        assert repr(engine.step(*values)) == repr(second.step(*values)) == repr(batch[k])
    assert all(math.isfinite(e.y_um) and math.isfinite(e.y_std_um) for e in batch)


# ---------------------------------------------------------------------------- standard deviation


def test_the_variance_of_its_own_adds_to_that_of_the_model() -> None:
    silent = dataclasses.replace(REMAINDER, std_factor=())
    stated, without = (started(with_remainder(e, INVERSE)).run(T_Q, AT, CHANNELS) for e in (REMAINDER, silent))
    factor = np.array(REMAINDER.std_factor)
    own = np.sum((columns(without) @ factor.T) ** 2, axis=1)
    assert own[0] == 0.0 and own.max() > 0.05
    assert [e.y_std_um**2 for e in stated] == pytest.approx(
        [e.y_std_um**2 + v for e, v in zip(without, own, strict=True)], rel=1e-9
    )
    assert [e.y_um for e in stated] == [e.y_um for e in without]


def test_without_a_factor_the_standard_deviation_keeps_its_bits() -> None:
    silent = dataclasses.replace(REMAINDER, std_factor=())
    t_q, at, _ = holed()
    bare, found = (started(model).run(t_q, at, CHANNELS) for model in (QUILL, with_remainder(silent)))
    assert [e.y_std_um.hex() for e in found] == [e.y_std_um.hex() for e in bare]
    assert [e.y_dtf_um.hex() for e in found] == [e.y_dtf_um.hex() for e in bare]


def test_it_goes_no_further_than_its_limit_and_its_deviation_says_by_how_much_it_would() -> None:
    free, limited = (started(with_remainder(e, INVERSE)).run(T_Q, AT, CHANNELS) for e in (REMAINDER, LIMITED))
    wanted = np.array([e.y_effects_um[0] for e in free])
    beyond = wanted - np.clip(wanted, -3.0, 3.0)
    assert beyond.min() < -1.0 and beyond.max() > 1.0 and np.mean(beyond == 0.0) > 0.1
    assert [e.y_effects_um[0] for e in limited] == [float(y) for y in wanted - beyond]
    assert [e.y_std_um**2 for e in limited] == pytest.approx(
        [e.y_std_um**2 + b**2 for e, b in zip(free, beyond, strict=True)], rel=1e-9
    )
    alone = dataclasses.replace(LIMITED, std_factor=())
    silent, bare = (started(model).run(T_Q, AT, CHANNELS) for model in (with_remainder(alone, INVERSE), INVERSE))
    assert [e.y_std_um**2 for e in silent] == pytest.approx(
        [e.y_std_um**2 + b**2 for e, b in zip(bare, beyond, strict=True)], rel=1e-9
    )


# ---------------------------------------------------------------------------- channels that are missing


def test_it_is_the_sum_of_its_channels_also_where_one_comes_late_or_is_lost() -> None:
    """An `input` of one channel waits for it and then keeps its last value; so does each channel of the remainder."""
    t_q, at, channels = holed()
    lags = (4.0, 35.0)
    gains = {"coolant_degc": (0.7, -0.3), "speed_rpm": (1e-3, 2e-3)}
    parts = [
        effect_from(
            "input",
            {"channel": name, "curve": "linear", "tau_min": [*lags], "gain": [*row], "delay_min": 0.0},
        )
        for name, row in gains.items()
    ]
    whole = Regression(channels=tuple(gains), exponents=(1.0, 1.0), taus_min=lags, gains=tuple(gains.values()))
    one = started(with_remainder(whole)).run(t_q, at, channels)
    many = started(dataclasses.replace(QUILL, effects=tuple(parts))).run(t_q, at, channels)
    assert one[6].y_effects_um[0] != 0.0  # before the speed was seen
    assert [e.y_effects_um[0] for e in one] == pytest.approx([sum(e.y_effects_um) for e in many], abs=1e-9)
    assert [e.y_rate_um_per_min for e in one] == pytest.approx([e.y_rate_um_per_min for e in many], abs=1e-9)


def test_a_channel_that_drops_out_keeps_its_last_value_and_nothing_jumps() -> None:
    steady = {"coolant_degc": np.full(N, 25.0), "speed_rpm": np.full(N, 3000.0)}
    steady["coolant_degc"][0] = 22.0  # so that its share is far from 0
    lost = {name: values.copy() for name, values in steady.items()}
    lost["coolant_degc"][150:250] = np.nan
    whole, holed_y = (started(with_remainder()).run(T_Q, AT, channels) for channels in (steady, lost))
    assert abs(whole[149].y_effects_um[0]) > 1.0
    assert [e.y_um for e in holed_y] == [e.y_um for e in whole]
    assert [e.y_std_um for e in holed_y] == [e.y_std_um for e in whole]


def test_a_change_over_gaps_streams_as_it_filters_and_is_never_0_for_missing() -> None:
    u = np.array([math.nan, 5.0, 7.0, math.nan, math.nan, 6.0, math.nan])
    block = ChangeSeen()
    assert [block.step(value) for value in u.tolist()] == ChangeSeen().filter(u).tolist() == [0, 0, 2, 2, 2, 1, 1]
    assert not ChangeSeen().filter(np.full(3, math.nan)).any()


# ---------------------------------------------------------------------------- model file and errors


def test_the_model_file_holds_it_to_the_bit_and_says_what_it_is(tmp_path: Path) -> None:
    explained = dataclasses.replace(
        REMAINDER, explanation=REMAINDER.explain(Seen(rms_um=0.9, added_um=Range(-1.2, 2.4)))
    )
    written = write_model(tmp_path / "model.toml", dataclasses.replace(QUILL, effects=(explained,)))
    assert written.effects == (explained,)
    assert "# The remainder: a regularised linear response of several channels." in dump_model(written)
    silent = dataclasses.replace(REMAINDER, std_factor=())
    assert "std_factor" not in dump_model(with_remainder(silent)) and with_remainder(silent).effects == (silent,)
    assert "most_um" not in dump_model(written)
    assert "most_um = 3.0" in dump_model(with_remainder(LIMITED)) and with_remainder(LIMITED).effects == (LIMITED,)
    assert explained.label == "regression of 4 channels"
    for words in ("remainder", "coolant_degc", "0.90 µm rms", "−1.2 to +2.4 µm", "a correction that explains nothing"):
        assert words in explained.explanation
    limited = LIMITED.explain(Seen(rms_um=0.9, added_um=Range(-1.2, 2.4)))
    assert limited.endswith("explains nothing, and goes no further than 3.0 µm to either side.")


TABLE: dict[str, Any] = {
    "channels": ["a", "heat_w"],
    "exponents": [1, 2],
    "taus_min": [0.0, 9.0],
    "gains": [[1, 2], [3, 4]],
}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"channels": "a"}, "channels = 'a', expected a list of strings"),
        ({"channels": []}, "channels = [], expected a list of strings"),
        ({"channels": ["a", 3]}, "channels = ['a', 3]"),
        ({"channels": ["a"]}, "exponents = (1.0, 2.0) of length 2, expected 1"),
        ({"channels": ["a", "y_um"]}, "channels = 'y_um', expected a logged channel"),
        ({"channels": ["a", "t_q_degc"]}, "channels = 't_q_degc', expected a logged channel"),
        ({"channels": ["a", ""]}, "channels = ''"),
        ({"channels": ["a", "a"], "exponents": [2, 2]}, "channels = ('a', 2.0), expected one entry"),
        ({"exponents": [1, 1.5]}, "exponents = 1.5, expected 1 or 2"),
        ({"exponents": [1, 3]}, "exponents = [1, 3]"),
        ({"exponents": [1]}, "exponents = (1.0,) of length 1, expected 2"),
        ({"taus_min": [-1.0, 9.0]}, "taus_min = [-1.0, 9.0]"),
        ({"taus_min": [0.0, math.inf]}, "taus_min = [0.0, inf]"),
        ({"taus_min": [float(i) for i in range(MOST_LAGS + 1)]}, "of length 13, expected 1 to 12"),
        ({"gains": [1.0, 2.0]}, "gains = [1.0, 2.0], expected a list of lists"),
        ({"gains": [[1, 2]]}, "gains = ((1.0, 2.0),) of length 1, expected 2 rows"),
        ({"gains": [[1, 2], [3]]}, "gains = (3.0,) of length 1, expected 2"),
        ({"gains": [[1, 2], [3, math.nan]]}, "gains = [3, nan]"),
        ({"std_factor": [[1.0, 2.0]]}, "std_factor = (1.0, 2.0) of length 2, expected 4"),
        ({"std_factor": [[0.0] * 4] * (MOST_ROWS + 1)}, "of length 9, expected 0 to 8 rows"),
        ({"std_factor": [["x"]]}, "std_factor = ['x']"),
        ({"most_um": -1.0}, "most_um = -1.0, expected a number"),
        ({"most_um": math.inf}, "most_um = inf, expected a number"),
        ({"gain": [1.0]}, "unknown key 'gain'"),
    ],
)
def test_a_wrong_table_names_key_and_value_in_one_line(changes: dict[str, Any], words: str) -> None:
    effect_from("regression", TABLE)
    with pytest.raises(ModelError) as error:
        effect_from("regression", TABLE | changes)
    assert str(error.value).startswith("effect regression: ") and words in str(error.value)
    assert "\n" not in str(error.value)


def test_the_most_that_is_permitted_runs_and_one_channel_more_is_refused() -> None:
    def large(channels: int) -> Regression:
        names = tuple(f"t{i}_degc" for i in range(channels))
        taus = tuple(float(i) for i in range(MOST_LAGS))
        factor = ((1e-3,) * (channels * MOST_LAGS),) * MOST_ROWS
        row = (0.01,) * MOST_LAGS
        return Regression(
            channels=names, exponents=(1.0,) * channels, taus_min=taus, gains=(row,) * channels, std_factor=factor
        )

    engine = started(with_remainder(large(MOST_CHANNELS)))
    values = dict.fromkeys(engine.channels, 20.0)
    engine.step(20.0, 20.0, values)
    found = engine.step(20.0, 20.0, dict.fromkeys(values, 21.0))
    assert found.y_effects_um[0] > 0.0 and found.y_std_um > QUILL.y_std_um
    with pytest.raises(ModelError, match="of length 65, expected 1 to 64 channels"):
        large(MOST_CHANNELS + 1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gains": ((1.0, math.inf), (0.0, 0.0))}, "gains = inf, expected finite"),
        ({"std_factor": ((0.0, math.nan, 0.0, 0.0),)}, "std_factor = nan, expected finite"),
        ({"taus_min": (0.0, math.nan)}, "taus_min = nan, expected from 0 to"),
        ({"most_um": math.nan}, "most_um = nan, expected a number from 0 on"),
        ({"most_um": 1e300}, "most_um = 1e\\+300, expected a number from 0 on"),
    ],
)
def test_the_constructor_refuses_what_the_file_would(changes: dict[str, Any], words: str) -> None:
    whole: dict[str, Any] = {
        "channels": ("a", "b"),
        "exponents": (1.0, 1.0),
        "taus_min": (0.0, 5.0),
        "gains": ((1.0, 2.0), (3.0, 4.0)),
    }
    with pytest.raises(ModelError, match=words):
        Regression(**(whole | changes))


def test_the_drive_has_the_name_of_the_models_kind() -> None:
    base = direct("kalman")
    with pytest.raises(ModelError, match="channels = 'heat_w', expected 't_q_degc - at_degc'"):
        dataclasses.replace(base, effects=(REMAINDER,))
    difference = Regression(channels=("t_q_degc - at_degc",), exponents=(1.0,), taus_min=(0.0,), gains=((2.0,),))
    with pytest.raises(ModelError, match="expected 'heat_w', the drive of a model of kind 'heat'"):
        dataclasses.replace(QUILL, effects=(difference,))
    engine = started(dataclasses.replace(direct("inverse"), effects=(difference,)))
    assert engine.channels == ()
    found = engine.run(T_Q, AT)
    assert [e.y_effects_um[0] for e in found] == pytest.approx(2.0 * ((T_Q - AT) - (T_Q[0] - AT[0])), abs=1e-9)


def test_the_search_never_proposes_it() -> None:
    context = Context(
        has_ambient=True,
        has_ttf=True,
        span_min=1440.0,
        minutes=2000.0,
        period_min=1.0,
        sizes_um={"DTF": 50.0, "TDTF": 5.0},
        taus_min={"DTF": (20.0,)},
        spans={"coolant_degc": 3.0},
        first={"coolant_degc": 20.0},
        functions={"DTF": ((0.1,), (1.0,)), "TDTF": ((0.1,), (1.0,))},
        approximate=True,
    )
    assert Regression in forms()
    found = [*proposals(context), *proposals(context, background=True)]
    assert found
    assert "regression" not in {hypothesis.effect.kind for hypothesis in found}


# ---------------------------------------------------------------------------- service, recordings, simulate

OF_SERVICE = Regression(
    channels=("coolant_degc", "at_degc"),
    exponents=(1.0, 1.0),
    taus_min=(0.0, 12.0),
    gains=((2.0, 1.0), (0.5, 0.2)),
    std_factor=((0.8, 0.0, 0.0, 0.1),),
)


def processed(model: ThermalModel, lost: range = range(0)) -> list[Outcome]:
    compensation = Compensation(config(), model)
    found = []
    for i, values in enumerate(readings(120)):
        values["coolant_degc"] += 0.0 if i < 20 else 1.5
        if i in lost:
            values["coolant_degc"] = math.nan
        found.append(compensation.process(sample(i, values)))
    return found


def test_a_service_holds_a_lost_channel_and_says_which() -> None:
    whole, lost = processed(with_remainder(OF_SERVICE)), processed(with_remainder(OF_SERVICE), range(60, 100))
    for i, outcome in enumerate(lost):
        assert ("channel_missing:coolant_degc" in outcome.offset.reasons) == (60 <= i < 100)
        assert outcome.offset.state in (("degraded",) if 60 <= i < 100 else ("ok", "degraded"))
    share = [outcome.estimate.y_effects_um[0] for outcome in lost]
    assert abs(share[59]) > 3.0
    # The channel's noise alone is missing; were it 0 or left out, the share would fall to a tenth.
    assert all(abs(a - o.estimate.y_effects_um[0]) < 0.5 for a, o in zip(share, whole, strict=True))


def test_the_published_standard_deviation_has_it() -> None:
    stated = processed(with_remainder(OF_SERVICE))
    without = processed(with_remainder(dataclasses.replace(OF_SERVICE, std_factor=())))
    for i in (0, 119):
        a, b = (number(run[i].offset.y_offset_std_um) for run in (stated, without))
        assert a == b if i == 0 else math.sqrt(a**2 - b**2) == pytest.approx(0.8 * 1.5, abs=0.3)


def test_a_channel_that_is_not_configured_is_named() -> None:
    with pytest.raises(ServiceError, match="an effect needs channel 'speed_rpm', which is not configured"):
        Compensation(config(), with_remainder())


def test_its_recordings_replay_byte_for_byte(tmp_path: Path) -> None:
    model = dump_model(dataclasses.replace(QUILL, effects=(OF_SERVICE,))).encode()
    service = Service(tmp_path, model=model)
    for i, values in enumerate(readings(90)):
        if 30 <= i < 37 or i >= 60:
            values["coolant_degc"] = math.nan
        if 33 <= i < 40 or 70 <= i < 74:
            values["t_q_degc"] = math.nan
        service.take(values)
    service.stop()
    again = Service(tmp_path, model=model, seq=service.seq, state=service.compensation.state())
    again.run(40)
    again.stop()
    found = audit(recordings(tmp_path, MACHINE))
    assert found.clean and found.samples == 130 and len(found.files) == 2, summary(found)
    offsets = [
        msgspec.json.decode(record.data, type=Offset)
        for path in recordings(tmp_path, MACHINE)
        for record in read_messages(path, ("offset",))
    ]
    assert "channel_missing:coolant_degc" in {reason for offset in offsets for reason in offset.reasons}


def test_simulate_runs_the_extended_model(tmp_path: Path) -> None:
    table, out = tmp_path / "run.csv", tmp_path / "s.csv"
    write_table(table, {"t_s": 60.0 * np.arange(N), "t_q_degc": T_Q, "at_degc": AT, "y_um": 0.0 * AT, **CHANNELS})
    write_model(tmp_path / "model.toml", dataclasses.replace(INVERSE, effects=(REMAINDER,)))
    assert main(["simulate", str(table), "--model", str(tmp_path / "model.toml"), "--out", str(out)]) == 0
    found = np.genfromtxt(out, delimiter=",", names=True)
    estimates = started(with_remainder(base=INVERSE)).run(T_Q, AT, CHANNELS)
    assert found["y_pred_um"] == pytest.approx([e.y_um for e in estimates], abs=1e-4)
    assert found["y_std_um"] == pytest.approx([e.y_std_um for e in estimates], abs=1e-4)


# ---------------------------------------------------------------------------- the diagnosis' result


def test_remainder_and_ceiling_are_in_the_file_and_on_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    from compensator.diagnose.words import summary as page

    class Bare:
        verdict = "explained"
        effects = warnings = ()
        held_out = "blocks"
        noise_floor_um = 0.3
        before = after = found = page.Scores(fit_pct=1.0, rms_um=2.0, peak_to_peak_um=3.0)
        remainder: Remainder | None = None
        ceiling: Ceiling | None = None
        advice = could_hide = refused = None
        model = SimpleNamespace(channels=())
        evidence = SimpleNamespace(model=model)
        residual_before = residual_after = np.full(3, 2.0)
        named_rms_um = 2.0
        since_h = 0.0

    found: Any = Bare()
    assert figures(found)["remainder"] is None and figures(found)["ceiling"] is None
    # Without a ceiling no linear combination of the channels is better, and that is said; a remainder is not made up.
    assert "No linear combination" in ceiling(figures(found)).text() and remainder(figures(found)) == []
    assert "remainder" not in verdict(figures(found))
    found.remainder = Remainder(deployed=True, channels=("t1_degc", "base_degc"), rms_before_um=1.4, rms_after_um=0.9)
    found.ceiling = Ceiling(rms_um=0.8, explained_pct=83.0)
    wanted = {
        "remainder": {
            "deployed": True,
            "channels": ["t1_degc", "base_degc"],
            "rms_before_um": 1.4,
            "rms_after_um": 0.9,
            "instead": False,
            "belongs": False,
            "confirmed": 1.0,
        },
        "ceiling": {"rms_um": 0.8, "explained_pct": 83.0, "least_rms_um": None},
    }
    in_file = figures(found)
    assert {key: in_file[key] for key in wanted} == wanted
    assert json.loads(json.dumps(in_file))["remainder"] == wanted["remainder"]
    printed = "\n".join(
        line for part in page.contents(found, ()) if isinstance(part, page.Words) for line in part.lines
    )
    for words in (
        "response of t1_degc, base_degc: a correction that explains nothing.",
        "Deployed in the extended model.",
        "1.40 µm rms without it, 0.90 with it",
        "the error on held-out data is 0.80 µm rms",
        "with the base model 2.00",
    ):
        assert words in printed
    assert "2.00 µm rms, 2.00 with the remainder" in verdict(in_file)
    defaults = {f.name: f.default for f in dataclasses.fields(Diagnosis)}
    assert defaults["remainder"] is None and defaults["ceiling"] is None
