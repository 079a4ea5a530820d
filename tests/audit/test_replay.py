"""A replay gives what the service recorded, bit for bit, whatever happened; a changed bit is found by its field."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.audit.machine_audit import Audit, audit, summary
from compensator.commands.workers import workers
from compensator.config import LoadedConfig, parse_config
from compensator.messages import Event, Offset
from compensator.model.model_file import parse_model
from compensator.recording import recorder as recorder_module
from compensator.recording.numbering import first_sequence
from compensator.recording.reading import read_messages, recordings
from compensator.recording.recorder import McapRecorder
from compensator.service.daemon import Daemon
from compensator.service.transfer.restart import resume
from drivers.errors import DeviceTimeout
from drivers.reading import Quality, Reading
from tests.audit.made import CONFIG, MACHINE, MINUTE_NS, QUILL, Service, other_model, readings
from tests.audit.tampering import find, lines_of, rewrite
from tests.service.simulated import START_NS, Bench

OPEN = Reading.bad(Quality.OPEN, "wire broken")
LIMITED = CONFIG.replace(b"offset_max_um = 200.0", b"offset_max_um = 6.0").replace(
    b"offset_rate_max_um_per_min = 8.0", b"offset_rate_max_um_per_min = 0.4"
)


def look(folder: Path) -> Audit:
    return audit(recordings(folder, MACHINE))


def reasons(folder: Path) -> set[str]:
    """Every reason that was published."""
    found: set[str] = set()
    for path in recordings(folder, MACHINE):
        for record in read_messages(path, ("offset",)):
            found.update(msgspec.json.decode(record.data, type=Offset).reasons)
    return found


def kinds(folder: Path) -> set[str]:
    return {
        msgspec.json.decode(record.data, type=Event).kind
        for path in recordings(folder, MACHINE)
        for record in read_messages(path, ("event",))
    }


def replayable(tmp_path: Path, config: bytes = CONFIG) -> Bench:
    """The real daemon on a simulated machine, with the attachments that an audit needs."""
    bench = Bench(tmp_path, parse_config(config, source="test"))
    bench.recorder.attachments = {"config.toml": config, "model.toml": QUILL}
    return bench


# ------------------------------------------------------------------ the daemon itself


def wires(bench: Bench) -> None:
    """Lost sensors: for one sample, for some, for longer than is predicted; the device itself gone."""
    bench.at_sample[70] = lambda: bench.device.replaced.update({0: OPEN})
    bench.at_sample[71] = bench.device.replaced.clear
    bench.at_sample[80] = lambda: bench.device.replaced.update({1: OPEN})
    bench.at_sample[86] = bench.device.replaced.clear
    bench.at_sample[90] = lambda: bench.device.replaced.update({0: OPEN, 2: OPEN})
    bench.at_sample[115] = bench.device.replaced.clear

    def gone() -> None:
        bench.device.error = DeviceTimeout("module", "no answer")

    def back() -> None:
        bench.device.error = None

    bench.at_sample[120], bench.at_sample[123] = gone, back
    bench.at_sample[130] = lambda: bench.device.replaced.update({0: Reading.good(75.0)})
    bench.at_sample[131] = bench.device.replaced.clear


def commands(bench: Bench) -> None:
    for at, name, payload in (
        (60, "hold", b""),
        (65, "zero", b'{"mode":"warm"}'),
        (66, "resume", b""),
        (80, "zero", b'{"mode":"rest"}'),
        (95, "zero", b""),
        (96, "hold", b""),
        (96, "resume", b""),
        (110, "hold", b""),
    ):
        before = bench.at_sample.get(at, lambda: None)
        bench.at_sample[at] = lambda b=before, n=name, p=payload: (b(), bench.daemon.command(n, p))  # type: ignore[misc]


@pytest.mark.parametrize(
    ("happens", "config", "expected"),
    [
        (wires, CONFIG, {"t_q_missing", "at_missing", "predicting", "prediction_expired"}),
        (commands, CONFIG, {"operator_hold"}),
        (lambda bench: (wires(bench), commands(bench)), LIMITED, {"offset_limited", "rate_limited", "operator_hold"}),
    ],
    ids=["wires", "commands", "limited"],
)
async def test_what_the_daemon_recorded_comes_out_again(
    tmp_path: Path, happens: Callable[[Bench], Any], config: bytes, expected: set[str]
) -> None:
    bench = replayable(tmp_path, config)
    happens(bench)
    await bench.run(150)
    found = look(tmp_path / "rec")
    assert found.clean and found.samples == 150, summary(found)
    assert expected <= reasons(tmp_path / "rec")


async def test_over_midnight_the_second_file_stands_by_itself(tmp_path: Path) -> None:
    bench = replayable(tmp_path)
    await bench.run(1100)
    paths = recordings(tmp_path / "rec", MACHINE)
    found = look(tmp_path / "rec")
    assert found.clean and [file.samples for file in found.files] == [1079, 21]
    assert found.files[1].state_before == found.files[0].state_after
    assert audit(paths[1:]).clean


async def test_a_disk_that_fails_and_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = replayable(tmp_path)
    sync = recorder_module.RecordingFile.sync
    full = False

    def failing(live: Any) -> None:
        if full:
            raise OSError(28, "No space left on device")
        sync(live)

    def fill(value: bool) -> None:
        nonlocal full
        full = value

    monkeypatch.setattr(recorder_module.RecordingFile, "sync", failing)
    bench.at_sample[30], bench.at_sample[42] = lambda: fill(True), lambda: fill(False)
    bench.at_sample[35] = lambda: bench.daemon.command("hold", b"")
    bench.at_sample[45] = lambda: bench.daemon.command("resume", b"")
    bench.at_sample[50], bench.at_sample[51] = lambda: fill(True), lambda: fill(False)
    await bench.run(60)
    found = look(tmp_path / "rec")
    assert found.clean, summary(found)
    # What the disk refused waited, and is on record as it was published.
    assert found.samples == 60 and sum(file.early for file in found.files) == 13
    assert "recording_failed" in reasons(tmp_path / "rec")
    logged = [r.data for path in recordings(tmp_path / "rec", MACHINE) for r in read_messages(path, ("offset",))]
    assert logged == [data for name, data in bench.published if name == "offset"]
    assert [file.began for file in found.files] == ["start", "failure", "failure"]
    assert [file.end for file in found.files] == ["recovered", "recovered", "finished"]
    why = [remark for remark in found.remarks if remark.code == "recovered"]
    for remark, after in zip(why, found.files[1:], strict=True):
        assert f"the service went on in {after.file}, whose events say why;" in remark
    assert "killed" not in " ".join(found.remarks)
    assert not list((tmp_path / "rec").glob("*.part"))


async def test_an_internal_error_holds_and_comes_out_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = replayable(tmp_path)
    process = bench.daemon._compensation.process
    count = 0

    def breaking(raw: Any) -> Any:
        nonlocal count
        count += 1
        if count == 20:
            raise ValueError("a defect")
        return process(raw)

    monkeypatch.setattr(bench.daemon._compensation, "process", breaking)
    bench.at_sample[30] = lambda: bench.daemon.command("resume", b"")
    await bench.run(40)
    found = look(tmp_path / "rec")
    assert found.clean, summary(found)
    assert "internal_error" in reasons(tmp_path / "rec")


@pytest.mark.parametrize("minutes", [0, 7, 600])
def test_a_restart_after_a_stop_or_a_kill(tmp_path: Path, minutes: int) -> None:
    folder = tmp_path / "rec"
    config = parse_config(CONFIG, source="test")
    loaded = LoadedConfig(config=config, path=tmp_path / "machine.toml", data=CONFIG)
    bench = replayable(tmp_path)
    live: list[bytes] = []
    bench.at_sample[80] = lambda: live.append(bench.recorder.path.read_bytes())  # type: ignore[union-attr]
    asyncio.run(bench.run(80))
    assert bench.recorder.path is not None
    bench.recorder.path.write_bytes(live[0])  # as a kill leaves it
    asyncio.run(bench.clock.sleep(60.0 * minutes))
    resumed = resume(loaded, parse_model(QUILL, source="test"))
    daemon = Daemon(
        config=config,
        compensation=resumed.compensation,
        devices={"module": bench.device},
        recorder=McapRecorder(folder, MACHINE, {"config.toml": CONFIG, "model.toml": QUILL}),
        publish=lambda name, data: None,
        clock=bench.clock,
        notes=resumed.notes,
        first_sequence=first_sequence(folder, MACHINE, bench.clock.utc_ns(), 60.0),
    )
    asyncio.run(daemon.run(samples=30))
    found = look(folder)
    assert found.clean and found.samples == 110, summary(found)
    assert [file.end for file in found.files] == ["recovered", "finished"]
    assert "restart" in kinds(folder)


# ------------------------------------------------------------------ scenes without the loop


def test_another_model_is_taken_over(tmp_path: Path) -> None:
    service = Service(tmp_path).run(100)
    service.adopt(other_model())
    service.run(60)
    service.stop()
    found = look(tmp_path)
    assert found.clean, summary(found)
    assert [file.began for file in found.files] == ["start", "new"]
    assert len({file.model for file in found.files}) == 2 and "cold_start" in reasons(tmp_path)


def test_a_file_without_a_state_begins_afresh(tmp_path: Path) -> None:
    service = Service(tmp_path).run(50)
    service.stop()
    path = recordings(tmp_path, MACHINE)[0]
    rewrite(path, contents=lambda contents: contents.attachments.pop("state.json") and None)  # type: ignore[func-returns-value]
    found = look(tmp_path)
    assert found.samples == 50 and not found.differing


def test_an_error_of_the_services_own(tmp_path: Path) -> None:
    service = Service(tmp_path).run(30)
    service.fail()
    service.run(5)
    service.command("resume")
    service.run(5).stop()
    found = look(tmp_path)
    assert found.clean and found.samples == 40, summary(found)


def test_a_clock_that_was_set_back_does_not_mix_up_the_files(tmp_path: Path) -> None:
    service = Service(tmp_path).run(20)
    service.stop()
    state, before = service.compensation.state(), START_NS - 120 * MINUTE_NS
    for start_ns, seq in ((before, 20), (before, 30), (START_NS + 600 * MINUTE_NS, 40)):
        service = Service(tmp_path, seq=seq, start_ns=start_ns, state=state).run(10)
        service.stop()
        state = service.compensation.state()
    found = look(tmp_path)
    assert found.clean and not found.remarks, summary(found)
    assert [file.first_seq for file in found.files] == [0, 20, 30, 40]
    assert [path.stem[-4:] for path in recordings(tmp_path, MACHINE)] == ["000Z", "-001", "-002", "000Z"]


def test_samples_that_nobody_took_are_said(tmp_path: Path) -> None:
    service = Service(tmp_path).run(20)
    for values in readings(5, 20):
        service.take(values, lost=True)
    service.run(20).stop()
    found = look(tmp_path)
    assert found.clean and "5 sample(s) between others were not recorded" in " ".join(found.remarks)


# ------------------------------------------------------------------ a difference


@pytest.mark.parametrize(
    ("topic", "field"),
    [
        ("estimate", "y_pred_um"),
        ("estimate", "y_std_um"),
        ("offset", "y_offset_um"),
        ("offset", "y_offset_rate_um_per_min"),
    ],
)
def test_one_bit_of_a_number_is_named_by_its_field(tmp_path: Path, topic: str, field: str) -> None:
    Service(tmp_path).run(40).stop()
    path = recordings(tmp_path, MACHINE)[0]
    lines, _ = lines_of(path)
    at = find(lines, topic, 25)
    message = msgspec.json.decode(lines[at].data)
    value = message[field]
    (bits,) = struct.unpack("<q", struct.pack("<d", value))
    (changed,) = struct.unpack("<d", struct.pack("<q", bits ^ 1))
    edited = lines[at].edited(msgspec.json.encode({field: value})[1:-1], msgspec.json.encode({field: changed})[1:-1])
    rewrite(path, lambda lines: [*lines[:at], edited, *lines[at + 1 :]])
    found = look(tmp_path)
    assert found.differing == 1 and found.difference is not None
    assert (found.difference.topic, found.difference.seq) == (topic, 25)
    assert [(f.name, f.recorded, f.recomputed) for f in found.difference.fields] == [(field, changed, value)]
    assert field in summary(found) and repr(changed) in summary(found)


def test_a_raw_value_that_was_changed_shows_in_what_follows_from_it(tmp_path: Path) -> None:
    Service(tmp_path).run(40).stop()
    path = recordings(tmp_path, MACHINE)[0]
    lines, _ = lines_of(path)
    at = find(lines, "sample", 25)
    sample = msgspec.json.decode(lines[at].data)
    mean = sample["channels"]["t_q_degc"]["mean"]
    edited = lines[at].edited(repr(mean).encode(), repr(mean + 0.5).encode())
    rewrite(path, lambda lines: [*lines[:at], edited, *lines[at + 1 :]])
    found = look(tmp_path)
    assert found.difference is not None and found.difference.topic == "estimate" and found.difference.seq == 25
    assert "heat_w" in {field.name for field in found.difference.fields}
    assert found.differing == 15  # the filter remembers it
    assert {(f.kind, f.topic) for f in found.findings} == {("altered", "sample")}


def test_a_verdict_that_was_changed_is_named(tmp_path: Path) -> None:
    Service(tmp_path).run(40).stop()
    path = recordings(tmp_path, MACHINE)[0]
    lines, _ = lines_of(path)
    at = find(lines, "sample", 25)
    edited = lines[at].edited(b'"quality":"good"', b'"quality":"stuck"')
    rewrite(path, lambda lines: [*lines[:at], edited, *lines[at + 1 :]])
    found = look(tmp_path)
    assert found.difference is not None and found.difference.topic == "sample"
    assert found.difference.fields[0].name == "channels.t_q_degc.quality"


def test_a_state_that_was_exchanged_is_found_even_with_a_chain_that_fits(tmp_path: Path) -> None:
    """The state at the end of a day is that which the next one opens with."""
    evening = START_NS + (17 * 60 + 30) * MINUTE_NS
    service = Service(tmp_path, start_ns=evening).run(30)
    other = Service(tmp_path / "other").run(20)
    service.compensation.restore(other.compensation.state())
    service.run(10).stop()
    other.kill()
    found = look(tmp_path)
    assert {f.kind for f in found.findings} == {"state"}, summary(found)


def test_several_processes_find_the_same(tmp_path: Path) -> None:
    evening = START_NS + (17 * 60 + 50) * MINUTE_NS
    Service(tmp_path, start_ns=evening).run(30).stop()
    paths = recordings(tmp_path, MACHINE)
    told: list[tuple[int, int]] = []
    with workers(2, None) as executor:
        assert executor is not None
        side_by_side = audit(paths[::-1], executor=executor, progress=lambda done, whole: told.append((done, whole)))
    assert side_by_side == audit(paths)
    assert told[-1][0] == told[-1][1] == sum(path.stat().st_size for path in paths)
