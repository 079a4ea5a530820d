"""The service on a simulated machine: sensors lost, limits, zero, commands, disk."""

from __future__ import annotations

import itertools
import math
from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.clock import NS
from compensator.messages import MESSAGES, Offset, number, schemas, shipped_schema
from compensator.recording.numbering import first_sequence, last_sequence
from compensator.recording.reading import decode, read_messages, recordings
from drivers.errors import DeviceTimeout
from drivers.reading import Quality, Reading
from tests.audit.tampering import end_of_chain
from tests.service.simulated import START_NS, Bench, config

MISSING = Reading.bad(Quality.OPEN, "wire broken")


def offsets(bench: Bench) -> np.ndarray:
    return np.array([number(o.offset.y_offset_um) for o in bench.outcomes])


def never_jumps(bench: Bench, rate: float = 8.0) -> bool:
    steps = np.diff(offsets(bench))
    return bool(np.all(np.abs(steps[~np.isnan(steps)]) <= rate + 1e-9))


async def test_offset_follows_the_machine(bench: Bench) -> None:
    await bench.run(600)
    y = np.array([number(o.estimate.y_um) for o in bench.outcomes])
    assert np.ptp(y) > 60.0
    assert np.std(y + offsets(bench)) < 0.6
    assert {o.offset.state for o in bench.outcomes} <= {"ok", "degraded"}
    assert never_jumps(bench)


async def test_following_the_rate_is_better_than_holding(bench: Bench) -> None:
    await bench.run(400)
    now, rate = offsets(bench), np.array([number(o.offset.y_offset_rate_um_per_min) for o in bench.outcomes])
    held = now[1:] - now[:-1]
    followed = now[1:] - (now[:-1] + rate[:-1])
    assert np.std(followed) < 0.5 * np.std(held)


async def test_labels_lie_on_the_minute_and_sequence_counts(bench: Bench) -> None:
    await bench.run(30)
    times = [o.offset.time_utc_ns for o in bench.outcomes]
    assert all(t % (60 * NS) == 0 for t in times)
    assert np.diff(times).tolist() == [60 * NS] * 29
    assert times[0] > START_NS
    assert [o.offset.seq for o in bench.outcomes] == list(range(30))


@pytest.mark.parametrize(("index", "code"), [(0, "t_q_missing"), (1, "at_missing")])
async def test_lost_temperature_predicts_then_holds_then_returns_without_a_jump(
    tmp_path: Any, index: int, code: str
) -> None:
    bench = Bench(tmp_path)
    bench.at_sample[100] = lambda: bench.device.replaced.update({index: MISSING})
    bench.at_sample[125] = bench.device.replaced.clear
    await bench.run(160)
    lost = bench.outcomes[100:125]
    assert all(code in o.offset.reasons for o in lost)
    assert [o.offset.state for o in lost[:10]] == ["degraded"] * 10
    assert [o.offset.state for o in lost[10:]] == ["hold"] * 15
    assert len({o.offset.y_offset_um for o in lost[9:]}) == 1
    stds = [number(o.offset.y_offset_std_um) for o in lost]
    assert all(b >= a for a, b in itertools.pairwise(stds)) and stds[-1] > stds[0]
    name = ("t_q_degc", "at_degc")[index]
    assert all(o.sample.channels[name].mean is None or math.isnan(o.sample.channels[name].mean) for o in lost)
    assert never_jumps(bench)
    assert bench.outcomes[-1].offset.state == "ok"
    residual = [number(o.estimate.residual_um) for o in bench.outcomes[-10:]]
    assert np.max(np.abs(residual)) < 1.5


async def test_dead_device_is_missing_not_zero_and_told_once(bench: Bench) -> None:
    def die() -> None:
        bench.device.error = DeviceTimeout("module", "no answer within 0.3 s")

    def live() -> None:
        bench.device.error = None

    bench.at_sample[20] = die
    bench.at_sample[24] = live
    await bench.run(40)
    dead = bench.outcomes[20:24]
    assert all(o.sample.channels["y_um"].quality == "device_timeout" for o in dead)
    assert all(o.sample.channels["y_um"].count == 0 for o in dead)
    assert b'"mean":null' in msgspec.json.encode(dead[0].sample)
    events = [msgspec.json.decode(d) for n, d in bench.published if n == "event"]
    told = [e["text"] for e in events if e["kind"] == "device"]
    assert told == ["module: no answer within 0.3 s", "module: answers again"]
    assert bench.outcomes[-1].offset.state == "ok"


async def test_nothing_before_the_first_zero(bench: Bench) -> None:
    bench.device.replaced[1] = MISSING
    bench.at_sample[5] = bench.device.replaced.clear
    await bench.run(8)
    early = bench.outcomes[:5]
    assert all(o.offset.state == "starting" and "no_zero" in o.offset.reasons for o in early)
    assert all(msgspec.json.decode(msgspec.json.encode(o.offset))["y_offset_um"] is None for o in early)
    assert bench.outcomes[5].offset.state == "ok"
    assert bench.outcomes[5].offset.y_offset_um == pytest.approx(0.0, abs=1e-9)


async def test_limits_are_named(tmp_path: Any) -> None:
    limits = {
        "offset_max_um": 20.0,
        "offset_rate_max_um_per_min": 0.5,
        "validity": {"t_q_degc": [10.0, 60.0], "at_degc": [10.0, 35.0]},
    }
    bench = Bench(tmp_path, config(limits=limits))
    await bench.run(300)
    assert np.max(np.abs(offsets(bench))) <= 20.0 + 1e-9
    assert never_jumps(bench, 0.5)
    named = {reason for o in bench.outcomes for reason in o.offset.reasons}
    assert {"offset_limited", "rate_limited"} <= named
    for o in bench.outcomes:
        ahead = number(o.offset.y_offset_um) + number(o.offset.y_offset_rate_um_per_min)
        assert abs(ahead) <= 20.0 + 1e-9
        assert abs(number(o.offset.y_offset_rate_um_per_min)) <= 0.5 + 1e-9
        if "rate_limited" in o.offset.reasons:
            assert o.offset.state == "degraded"


async def test_outside_validity_holds(tmp_path: Any) -> None:
    limits = {
        "offset_max_um": 200.0,
        "offset_rate_max_um_per_min": 8.0,
        "validity": {"t_q_degc": [10.0, 25.0], "at_degc": [10.0, 35.0]},
    }
    bench = Bench(tmp_path, config(limits=limits))
    await bench.run(200)
    outside = [o for o in bench.outcomes if number(o.sample.channels["t_q_degc"].mean) > 25.0]
    assert outside
    assert all(o.offset.state == "hold" and "outside_validity:t_q_degc" in o.offset.reasons for o in outside)
    assert never_jumps(bench)


async def test_rate_range_and_stuck_guards(bench: Bench) -> None:
    jump = Reading.good(60.0)
    bench.at_sample[50] = lambda: bench.device.replaced.update({0: jump, 2: Reading.good(999.0)})
    bench.at_sample[52] = bench.device.replaced.clear
    bench.at_sample[60] = lambda: bench.device.replaced.update({1: Reading.good(bench.world.truth("at_degc"))})
    await bench.run(130)
    assert bench.outcomes[50].sample.channels["t_q_degc"].quality == "too_fast"
    assert bench.outcomes[50].sample.channels["t_q_degc"].device_quality == "good"
    assert bench.outcomes[50].sample.channels["y_um"].quality == "out_of_range"
    assert math.isnan(number(bench.outcomes[50].estimate.residual_um))
    assert bench.outcomes[53].offset.state == "ok"
    assert bench.outcomes[115].sample.channels["at_degc"].quality == "good"
    assert bench.outcomes[125].sample.channels["at_degc"].quality == "stuck"
    assert never_jumps(bench)


async def test_exchanged_couples_are_refused(bench: Bench) -> None:
    def exchange() -> None:
        bench.device.sources[0], bench.device.sources[1] = bench.device.sources[1], bench.device.sources[0]

    bench.at_sample[150] = exchange
    await bench.run(200)
    hot = number(bench.outcomes[149].sample.channels["t_q_degc"].mean) - number(
        bench.outcomes[149].sample.channels["at_degc"].mean
    )
    assert hot > 3.0
    bad = {bench.outcomes[150].sample.channels[n].quality for n in ("t_q_degc", "at_degc")}
    assert bad <= {"too_fast", "t_q_below_at"}
    assert never_jumps(bench)


async def test_single_wild_readings_leave_the_mean_alone(tmp_path: Any) -> None:
    quiet, wild = Bench(tmp_path / "a", noise=False), Bench(tmp_path / "b", noise=False)
    source, count = wild.device.sources[0], [0]

    def sometimes() -> float:
        count[0] += 1
        return 850.0 if count[0] % 6 == 3 else source()

    wild.device.sources[0] = sometimes
    await quiet.run(60)
    await wild.run(60)
    assert wild.outcomes[30].sample.channels["t_q_degc"].errors == {"outlier": 1}
    a = [number(o.sample.channels["t_q_degc"].mean) for o in quiet.outcomes]
    b = [number(o.sample.channels["t_q_degc"].mean) for o in wild.outcomes]
    assert np.max(np.abs(np.array(a) - np.array(b))) < 0.3


async def test_commands_hold_resume_zero(bench: Bench) -> None:
    def send(name: str, payload: bytes = b"") -> None:
        assert bench.daemon.command(name, payload)["ok"]

    bench.at_sample[100] = lambda: send("hold")
    bench.at_sample[120] = lambda: send("resume")
    bench.at_sample[160] = lambda: send("zero")
    await bench.run(260)
    held = bench.outcomes[101:120]
    assert all(o.offset.state == "hold" and "operator_hold" in o.offset.reasons for o in held)
    assert len({o.offset.y_offset_um for o in held}) == 1
    assert never_jumps(bench)
    # The machine is warm there: its stored heat goes on, only the deformation counts from here.
    zero = bench.outcomes[161 - 1]
    assert number(zero.estimate.y_um) == pytest.approx(0.0, abs=1e-9)
    assert any(note.data["mode"] == "warm" for note in zero.notes if note.kind == "zero")
    assert abs(number(zero.estimate.y_pred_um)) < 1.0
    settled = bench.outcomes[200:]
    assert np.std([number(o.estimate.residual_um) for o in settled]) < 0.7


async def test_a_zero_at_rest_on_a_warm_machine_is_obeyed_with_a_warning(bench: Bench) -> None:
    """Afterwards the model sees less than no heat: what it says of the next zero at rest is no doubt."""
    answers: dict[int, str] = {}

    def send(sample: int, mode: str) -> None:
        payload = f'{{"mode": "{mode}"}}'.encode()
        bench.at_sample[sample] = lambda: answers.__setitem__(sample, bench.daemon.command("zero", payload)["text"])

    for sample, mode in ((5, "rest"), (100, "warm"), (110, "rest"), (170, "rest")):
        send(sample, mode)
    await bench.run(175)
    notes = (note for outcome in bench.outcomes for note in outcome.notes if note.kind == "zero")
    _, cold, _, doubted, right = notes
    assert {answers[sample] for sample in (5, 100, 170)} == {"zero: acts at the next sample"}
    assert number(bench.outcomes[169].estimate.y_dtf_um) < -10.0
    assert not any("warning" in note.text or "warm_um" in note.data for note in (cold, right))
    assert doubted.data["mode"] == "rest" and doubted.data["warm_um"] > 20.0
    figure = f"{doubted.data['warm_um']:+.1f} µm of Y are from stored heat"
    assert doubted.text.startswith("zero on a machine at rest: ") and "warning: by the model" in doubted.text
    assert figure in doubted.text and figure in answers[110]


@pytest.mark.parametrize(
    ("name", "payload"),
    [("zero", b"{"), ("zero", b'{"mode":"hot"}'), ("zero", b"[1]"), ("dance", b""), ("hold", b"\xff\xfe")],
)
async def test_bad_commands_are_refused_in_words(bench: Bench, name: str, payload: bytes) -> None:
    await bench.run(2)
    answer = bench.daemon.command(name, payload)
    assert not answer["ok"] and answer["text"]


async def test_zero_at_rest_takes_a_bias_between_the_couples_away(bench: Bench) -> None:
    biased = bench.device.sources[0]
    bench.device.sources[0] = lambda: biased() + 0.4
    await bench.run(20)
    heats = [number(o.estimate.heat_w) for o in bench.outcomes[5:]]
    assert abs(np.mean(heats)) < 1.0
    assert abs(offsets(bench)[-1]) < 1.0


async def test_recording_holds_every_sample_and_what_was_published(bench: Bench) -> None:
    await bench.run(50)
    paths = recordings(bench.recorder.path.parent, "vmc-07")  # type: ignore[union-attr]
    assert len(paths) == 1
    logged = [r.data for r in read_messages(paths[0], ("offset",))]
    assert logged == [data for name, data in bench.published if name == "offset"]
    samples = [decode(r, paths[0]) for r in read_messages(paths[0], ("sample",))]
    assert len(samples) == 50
    assert last_sequence(paths[0].parent, "vmc-07") == 49
    kinds = [decode(r, paths[0]).kind for r in read_messages(paths[0], ("event",))]  # type: ignore[attr-defined]
    assert kinds[0] == "start" and kinds[-1] == "stop" and "zero" in kinds


async def test_sequence_never_repeats_even_without_the_recordings(bench: Bench) -> None:
    await bench.run(50)
    folder = bench.recorder.path.parent  # type: ignore[union-attr]
    now = bench.clock.utc_ns()
    first = first_sequence(folder, "vmc-07", now, 60.0)
    assert first > 49
    for path in recordings(folder, "vmc-07"):
        path.unlink()
    assert first_sequence(folder, "vmc-07", now, 60.0) >= first  # nothing on disk: the clock tells
    assert first_sequence(folder, "vmc-07", 0, 60.0) == 0  # a clock that was never set


async def test_sample_is_on_disk_before_its_offset_is_published(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    write = bench.recorder.write
    monkeypatch.setattr(bench.recorder, "write", lambda *a, **k: (order.append("disk"), write(*a, **k)))
    publish = bench.daemon._publish
    bench.daemon._publish = lambda name, data: (order.append(name), publish(name, data))[1]
    await bench.run(3)
    sampled = [entry for entry in order if entry in ("disk", "offset")]
    assert sampled[:6] == ["disk", "offset"] * 3


async def test_torn_recording_gives_every_whole_message(bench: Bench) -> None:
    live: list[bytes] = []
    bench.at_sample[20] = lambda: live.append(bench.recorder.path.read_bytes())  # type: ignore[union-attr]
    await bench.run(20)
    path = bench.recorder.path
    assert path is not None
    data = live[0]
    cut = data.rindex(b'"seq":19')
    path.write_bytes(data[:cut])
    samples = list(read_messages(path, ("sample",)))
    assert len(samples) in (19, 20)
    assert last_sequence(path.parent, "vmc-07") in (18, 19)


async def test_new_file_at_midnight_names_the_one_before(tmp_path: Any) -> None:
    bench = Bench(tmp_path)
    await bench.run(1085)  # 06:00 to past midnight
    paths = recordings(tmp_path / "rec", "vmc-07")
    assert [p.name for p in paths] == ["vmc-07_20260105T060100Z.mcap", "vmc-07_20260106T000000Z.mcap"]
    from mcap.reader import make_reader

    with paths[1].open("rb") as file:
        run = next(m for m in make_reader(file).iter_metadata() if m.name == "run").metadata
    assert run["previous_file"] == paths[0].name
    end = end_of_chain(paths[0])
    assert end is not None and run["previous_chain"] == end.value.hex()
    assert (end.sealed, end.whole, end.chunked, end.unlisted) == ("day", True, True, 0)


async def test_full_disk_goes_on_and_says_so(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    write = bench.recorder.write
    full = [False]

    def failing(records: Any, time_utc_ns: int, **rest: Any) -> None:
        if full[0]:
            raise OSError(28, "No space left on device")
        write(records, time_utc_ns, **rest)

    monkeypatch.setattr(bench.recorder, "write", failing)
    bench.at_sample[10] = lambda: full.__setitem__(0, True)
    bench.at_sample[15] = lambda: full.__setitem__(0, False)
    await bench.run(20)
    sent = [msgspec.json.decode(d, type=Offset) for n, d in bench.published if n == "offset"]
    assert all("recording_failed" in o.reasons and o.state == "degraded" for o in sent[10:15])
    assert all(o.state == "ok" for o in sent[16:])
    assert all(not math.isnan(number(o.y_offset_um)) for o in sent)


async def test_wall_clock_set_by_an_hour_keeps_the_pace(bench: Bench) -> None:
    bench.at_sample[10] = lambda: bench.clock.set_wall_clock(3600.0)
    bench.at_sample[20] = lambda: bench.clock.set_wall_clock(-3600.0)
    await bench.run(30)
    events = [msgspec.json.decode(d) for n, d in bench.published if n == "event"]
    assert [round(e["data"]["seconds"]) for e in events if e["kind"] == "clock"] == [3600, -3600]
    assert len(bench.outcomes) == 30
    assert never_jumps(bench)


def test_shipped_schemas_are_those_of_the_classes() -> None:
    for name, schema in schemas().items():
        assert msgspec.json.decode(shipped_schema(name)) == msgspec.json.decode(msgspec.json.encode(schema))
    assert set(MESSAGES) == set(schemas())
