"""Another model for the running service: without a jump, warmed up, and back again."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import stat
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from compensator.errors import ServiceError
from compensator.messages import number
from compensator.model.model_file import parse_model
from compensator.recording.reading import recordings
from compensator.service.compensation import Compensation, Outcome, slowest_min
from compensator.service.replay import opening_of
from compensator.service.transfer import adoption
from compensator.service.transfer import second_opinion as second_opinion_module
from compensator.service.transfer import warm_up as warm_up_module
from compensator.service.transfer.adoption import Adoption
from compensator.service.transfer.model_store import ModelStore, sha256_of
from compensator.service.transfer.second_opinion import second_opinion
from compensator.service.transfer.warm_up import RecordedRun, Successor, warm_up, window_of
from tests.service.living import MACHINE, Machine, check_files, largest_step, settings
from tests.service.test_restart import QUILL, STRONGER

SLOW = settings(
    limits={
        "offset_max_um": 200.0,
        "offset_rate_max_um_per_min": 2.0,
        "validity": {"t_q_degc": [10.0, 60.0], "at_degc": [10.0, 35.0]},
    },
)
WITH_INPUT = QUILL.replace(b'name = "quill"', b'name = "coolant"') + (
    b'\n[[effect]]\nkind = "input"\nchannel = "coolant_degc"\ncurve = "linear"\ntau_min = [60.0]\n'
    b"gain = [3.0]\ndelay_min = 5.0\n"
)


def payload(model: bytes, **more: Any) -> bytes:
    return json.dumps({"sha256": sha256_of(model), "model": model.decode(), **more}).encode()


class Asked:
    """Sends a command and keeps its answer."""

    def __init__(self, machine: Machine, name: str, data: bytes = b"") -> None:
        self._machine, self._name, self._data = machine, name, data
        self.reply: Any = None

    def __call__(self) -> None:
        self.reply = self._machine.command(self._name, self._data)

    @property
    def is_answered(self) -> bool:
        return self.reply is not None and (not isinstance(self.reply, Future) or self.reply.done())

    @property
    def answer(self) -> dict[str, Any]:
        answer: dict[str, Any] = self.reply.result(timeout=0) if isinstance(self.reply, Future) else self.reply
        return answer


def adopted(model: bytes, then: int = 0) -> Callable[[Outcome], bool]:
    """Tell when the service has used a model for some samples."""
    count = [0]

    def arrived(outcome: Outcome) -> bool:
        count[0] += outcome.offset.model_sha256 == sha256_of(model)
        return count[0] > then

    return arrived


@pytest.mark.parametrize("model", [STRONGER, WITH_INPUT], ids=["gain", "input"])
async def test_the_running_service_takes_a_model_over_as_if_it_had_run_all_the_time(
    tmp_path: Path, model: bytes
) -> None:
    machine = Machine(tmp_path / "adopting", SLOW)
    asked = machine.at_sample[200] = Asked(machine, "adopt", payload(model))
    await machine.run(700, adopted(model, then=80))
    assert asked.answer["ok"], asked.answer
    always = Machine(tmp_path / "always", SLOW, model)
    await always.run(len(machine.outcomes))
    whole = always.by_time()
    new = [o for o in machine.outcomes if o.offset.model_sha256 == sha256_of(model)]
    swap = len(machine.outcomes) - len(new)
    assert 200 < swap < 620 and len(new) == 81
    for outcome in new:
        expected = whole[outcome.offset.time_utc_ns].estimate
        assert outcome.estimate.y_pred_um == expected.y_pred_um
        assert outcome.estimate.y_effects_um == expected.y_effects_um
        assert outcome.estimate.y_ref_um == expected.y_ref_um
    # Never a jump: not at the swap, not on the way, and the way is said.
    assert largest_step(machine.outcomes) <= 2.0 + 1e-9
    event = machine.events("adopt")[-1]
    assert event.data["old_sha256"] == sha256_of(QUILL) and event.data["new_sha256"] == sha256_of(model)
    assert event.data["state_known"] and event.data["warm_up_samples"] >= 200
    # It goes the whole way at the limit, towards what the new model wants at that moment, and says so until then.
    at_um, limit_um, on_the_way = number(machine.outcomes[swap - 1].offset.y_offset_um), 2.0, True
    for outcome in new:
        wanted_um = -number(whole[outcome.offset.time_utc_ns].estimate.y_pred_um)
        on_the_way = on_the_way and abs(wanted_um - at_um) > limit_um
        at_um += min(max(wanted_um - at_um, -limit_um), limit_um)
        assert number(outcome.offset.y_offset_um) == pytest.approx(at_um, abs=1e-9)
        assert ("model_changed" in outcome.offset.reasons) == on_the_way
        assert outcome.offset.state == "degraded" or not on_the_way
    last = machine.outcomes[swap - 1]
    change_um = number(last.estimate.y_pred_um) - number(whole[last.offset.time_utc_ns].estimate.y_pred_um)
    assert event.data["difference_um"] == pytest.approx(change_um, abs=1e-9)
    assert "model_changed" not in new[-1].offset.reasons
    assert number(new[-1].offset.y_offset_um) == whole[new[-1].offset.time_utc_ns].offset.y_offset_um
    # The new model travels in a file of its own, from which all its outcomes come again.
    files = recordings(machine.recordings, MACHINE)
    assert [opening_of(path)["model.toml"] for path in files] == [QUILL, model]
    assert check_files(machine) == len(machine.outcomes)
    told = [event for event in machine.events("command") if event.text == "adopt"]
    asked = {"command": "adopt", "sha256": sha256_of(model), "force": False, "by": "unnamed", "by_proof": "none"}
    assert len(told) == 1 and told[0].data == asked
    # The next start uses it.
    assert machine.store.in_use() == model
    await machine.run(3)
    assert machine.outcomes[-1].offset.model_sha256 == sha256_of(model)
    assert "cold_start" not in machine.outcomes[-1].offset.reasons
    assert largest_step(machine.outcomes) <= 2.0 + 1e-9


async def test_a_zero_on_a_warm_machine_and_a_restart_lie_in_the_warm_up(tmp_path: Path) -> None:
    """The deformation counts from the new model's own value at the zero; a pause is bridged by it, too."""

    async def lived(machine: Machine) -> None:
        machine.at_sample[90] = lambda: machine.command("zero", b'{"mode": "warm"}')
        await machine.run_and_kill(150)
        await machine.sleep(20.0)

    machine, always = Machine(tmp_path / "a"), Machine(tmp_path / "b", model=STRONGER)
    await lived(machine)
    asked = machine.at_sample[200] = Asked(machine, "adopt", payload(STRONGER))
    await machine.run(400, adopted(STRONGER, then=5))
    assert asked.answer["ok"], asked.answer
    await lived(always)
    await always.run(len(machine.outcomes) - 150)
    a, b = machine.outcomes[-1].estimate, always.outcomes[-1].estimate
    assert (a.time_utc_ns, a.y_pred_um, a.y_base_um) == (b.time_utc_ns, b.y_pred_um, b.y_base_um)
    assert a.y_base_um != 0.0
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9


async def test_an_operator_hold_stands_and_a_zero_meanwhile_counts(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "a", SLOW)
    machine.at_sample[190] = lambda: machine.command("hold")
    machine.at_sample[200] = Asked(machine, "adopt", payload(STRONGER))
    machine.at_sample[201] = lambda: machine.command("zero", b'{"mode": "rest"}')
    await machine.run(500, adopted(STRONGER, then=20))
    new = machine.outcomes[-21:]
    assert all(o.offset.state == "hold" and "operator_hold" in o.offset.reasons for o in machine.outcomes[191:])
    assert len({o.offset.y_offset_um for o in machine.outcomes[191:]}) == 1
    assert new[-1].estimate.t_q_ref_degc == machine.outcomes[210].estimate.t_q_ref_degc
    assert new[-1].estimate.t_q_ref_degc != machine.outcomes[150].estimate.t_q_ref_degc
    machine.at_sample[len(machine.outcomes) + 1] = lambda: machine.command("resume")
    await machine.run(10)
    assert "operator_hold" not in machine.outcomes[-1].offset.reasons
    assert largest_step(machine.outcomes) <= 2.0 + 1e-9


async def test_a_long_warm_up_delays_no_sample_and_is_caught_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(tmp_path / "a")
    held, loop = threading.Event(), asyncio.get_running_loop()
    prepare = Adoption._successor

    def slow(self: Adoption, *arguments: Any) -> Any:
        warmed = prepare(self, *arguments)
        loop.call_soon_threadsafe(machine.promises.open.clear)  # simulated time does not wait for what is held
        assert held.wait(120.0)
        return warmed

    monkeypatch.setattr(Adoption, "_successor", slow)
    asked = machine.at_sample[150] = Asked(machine, "adopt", payload(STRONGER))
    second = machine.at_sample[160] = Asked(machine, "back")

    def release() -> None:
        held.set()
        machine.promises.add(asked.reply)

    machine.at_sample[200] = release
    await machine.run(500, adopted(STRONGER))
    assert asked.answer["ok"]
    assert not second.answer["ok"] and "another model is being prepared" in second.answer["text"]
    swap = len(machine.outcomes) - 1
    assert swap >= 200
    times = [o.offset.time_utc_ns for o in machine.outcomes]
    assert {b - a for a, b in itertools.pairwise(times)} == {60_000_000_000}
    always = Machine(tmp_path / "b", model=STRONGER)
    await always.run(len(machine.outcomes))
    assert machine.outcomes[-1].estimate.y_pred_um == always.outcomes[-1].estimate.y_pred_um


async def test_too_little_on_record_is_refused_and_taken_only_by_force(tmp_path: Path) -> None:
    """The first recording is gone, and with it the zero."""
    machine = Machine(tmp_path, SLOW)
    await machine.run(200)
    await machine.run(40)
    recordings(machine.recordings, MACHINE)[0].unlink()
    refused = machine.at_sample[245] = Asked(machine, "adopt", payload(STRONGER))
    forced = Asked(machine, "adopt", payload(STRONGER, force=True))

    def when_refused(outcome: Outcome) -> bool:
        if refused.reply is not None and refused.reply.done() and forced.reply is None:
            assert machine.store.in_use() == QUILL
            forced()
        return arrived(outcome)

    arrived = adopted(STRONGER, then=10)
    await machine.run(300, when_refused)
    assert not refused.answer["ok"]
    assert (
        "the recordings without a gap cover" in refused.answer["text"]
        and "standard deviation of its offset" in refused.answer["text"]
    )
    events = machine.events("adopt")
    assert events[0].text.startswith("refused:") and events[0].data["ok"] is False
    assert forced.answer["ok"] and forced.answer["state_known"] is False and "too little" in forced.answer["text"]
    new = machine.outcomes[-11:]
    before = machine.outcomes[-12]
    assert all("cold_start" in o.offset.reasons and o.offset.state == "degraded" for o in new)
    assert number(new[0].offset.y_offset_std_um) > 1.5 * number(before.offset.y_offset_std_um)
    assert new[0].estimate.t_q_ref_degc == before.estimate.t_q_ref_degc
    assert largest_step(machine.outcomes) <= 2.0 + 1e-9


async def test_a_model_that_fails_as_it_takes_over_is_not_found_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(tmp_path, SLOW)
    machine.at_sample[60] = Asked(machine, "adopt", payload(STRONGER, force=True))

    def broken(*_: Any) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(Successor, "follow", broken)
    await machine.run(90)
    assert {outcome.offset.model_sha256 for outcome in machine.outcomes} == {sha256_of(QUILL)}
    assert {outcome.offset.state for outcome in machine.outcomes} <= {"ok", "degraded"}
    assert machine.store.in_use() == QUILL
    with pytest.raises(ServiceError, match="no previous model"):
        machine.store.before()
    (event,) = machine.events("adopt")
    assert event.data["ok"] is False and "ZeroDivisionError: a defect; model quill goes on" in event.text
    assert check_files(machine) == 90


@pytest.mark.parametrize(
    "fails",
    [
        lambda store: store.adopt(STRONGER + b"# another\n", name="another", time_utc_ns=3),
        lambda store: store.back(name="quill", time_utc_ns=3),
    ],
)
def test_the_model_of_the_loop_is_its_own_also_after_another_change_has_failed(
    tmp_path: Path, fails: Callable[[ModelStore], None]
) -> None:
    store, calibrated = ModelStore(tmp_path, QUILL, MACHINE), QUILL + b"# calibrated\n"
    store.adopt(calibrated, name="calibrated", time_utc_ns=1)
    store.adopt(STRONGER, name="stronger", time_utc_ns=2, by_loop=True)
    fails(store)
    store.go_on_with(sha256_of(STRONGER), name="stronger", time_utc_ns=4)
    assert (store.in_use(), store.calibrated(), store.before()) == (STRONGER, calibrated, calibrated)
    store.back(name="calibrated", time_utc_ns=5)
    assert store.in_use() == calibrated and store.before() == QUILL
    # Nothing is left of one that fails beside the configured model either.
    store.back(name="quill", time_utc_ns=6)
    store.adopt(STRONGER, name="stronger", time_utc_ns=7)
    store.go_on_with(sha256_of(QUILL), name="quill", time_utc_ns=8)
    assert store.in_use() == QUILL
    with pytest.raises(ServiceError):
        store.before()


@pytest.mark.parametrize("minutes", [10.0, 40.0])
async def test_a_pause_before_it_takes_over_passes_for_it_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, minutes: float
) -> None:
    """The service stands still after the model is prepared: it must not go on from before that."""
    machine = Machine(tmp_path / "adopting", SLOW)
    machine.at_sample[200] = Asked(machine, "adopt", payload(STRONGER))
    swap, stood = Adoption.swap, [0]

    def delayed(adoption: Adoption) -> Compensation:
        if not stood[0] and adoption.is_under_way and adoption._order.ready is not None:  # type: ignore[union-attr]
            stood[0] = len(machine.outcomes) + 1
            machine.at_sample[stood[0]] = lambda: machine.clock.stand_still(60.0 * minutes)
            return adoption._running()
        return swap(adoption)

    monkeypatch.setattr(Adoption, "swap", delayed)
    await machine.run(500, adopted(STRONGER, then=20))
    monkeypatch.undo()
    always = Machine(tmp_path / "always", SLOW, STRONGER)
    always.at_sample[stood[0]] = lambda: always.clock.stand_still(60.0 * minutes)
    await always.run(len(machine.outcomes))
    whole = always.by_time()
    new = [one for one in machine.outcomes if one.offset.model_sha256 == sha256_of(STRONGER)]
    assert len(new) == 21
    assert [one.estimate for one in new] == [whole[one.offset.time_utc_ns].estimate for one in new]
    assert check_files(machine) == len(machine.outcomes)


@pytest.mark.parametrize("zero", ["", "rest", "warm"])
async def test_a_model_keeps_its_level_however_long_ago_it_was_in_force_until_a_zero(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zero: str
) -> None:
    """The loop had raised it; a warm-up does not look back so far."""
    machine = Machine(tmp_path, SLOW)

    def raised() -> None:
        assert machine.daemon is not None
        machine.daemon._compensation.raise_level(6.0)
        machine.daemon._journal.start_new_file()

    machine.at_sample[60] = raised
    machine.at_sample[90] = Asked(machine, "adopt", payload(STRONGER, force=True))
    if zero:
        machine.at_sample[150] = Asked(machine, "zero", json.dumps({"mode": zero}).encode())
    await machine.run(300)
    monkeypatch.setattr(warm_up_module, "WARM_UP", 0.3)
    monkeypatch.setattr(second_opinion_module, "COMPARED_H", 0.2)
    assert machine.events("adopt")[-1].data["ok"]
    own, other = (parse_model(data, source="test") for data in (QUILL, STRONGER))
    level_um = 0.0 if zero else 6.0
    window = window_of(machine.recordings, MACHINE, slowest_min(own), lambda: None)
    assert zero or window.from_ns > machine.outcomes[90].offset.time_utc_ns
    back = warm_up(machine.recordings, machine.config, own).compensation
    assert back.level_um == level_um and back.status.zero is not None
    assert warm_up(machine.recordings, machine.config, other).compensation.level_um == 0.0
    moves_um = second_opinion(machine.recordings, machine.config, other, own).offset_change_um
    monkeypatch.setattr(RecordedRun, "begin_at_level", lambda run, window: None)
    without_um = second_opinion(machine.recordings, machine.config, other, own).offset_change_um
    assert moves_um is not None and without_um is not None
    assert without_um - moves_um == pytest.approx(level_um)


async def test_back_and_further_back_to_the_configured_one(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    for name, model, expected in (
        ("adopt", STRONGER, STRONGER),
        ("adopt", WITH_INPUT, WITH_INPUT),
        ("back", b"", STRONGER),
        ("back", b"", QUILL),
    ):
        asked = machine.at_sample[len(machine.outcomes) + 30] = Asked(
            machine, name, payload(model) if name == "adopt" else b""
        )
        await machine.run(300, adopted(expected, then=2))
        assert asked.answer["ok"], asked.answer
        assert machine.store.in_use() == expected
    asked = machine.at_sample[len(machine.outcomes) + 2] = Asked(machine, "back")
    await machine.run(60, lambda _: asked.reply is not None and asked.reply.done())
    assert not asked.answer["ok"] and "no previous model" in asked.answer["text"]
    again = machine.at_sample[len(machine.outcomes) + 2] = Asked(
        machine, "adopt", json.dumps({"sha256": sha256_of(STRONGER)}).encode()
    )
    await machine.run(300, adopted(STRONGER))
    assert again.answer["ok"]  # by its name in the store
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    check_files(machine)


OTHER_PERIOD = QUILL.replace(b"sample_period_s = 60.0", b"sample_period_s = 120.0")
REFUSED = [
    (b"not a model", "not a TOML file"),
    (QUILL, "already"),
    (OTHER_PERIOD, "the service runs at 60 s"),
    (QUILL.replace(b"sample_period_s = 60.0", b"sample_period_s = 55.0"), "whole multiple"),
    (WITH_INPUT.replace(b"coolant_degc", b"oil_degc"), "oil_degc"),
    (QUILL + b'\n[[effect]]\nkind = "magic"\n', "magic"),
    (QUILL.replace(b"[0.0002567, 0.01629, 0.008079]", b"[-0.0002567, 0.01629, 0.008079]"), "unstable"),
]


async def test_models_that_cannot_be_run_are_refused_and_nothing_changes(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    asked = [Asked(machine, "adopt", payload(model)) for model, _ in REFUSED]
    pending = list(asked)

    def one_after_the_other(outcome: Outcome) -> bool:
        sent = [a for a in asked if a not in pending]
        if len(machine.outcomes) >= 10 and all(a.reply.done() for a in sent):
            if not pending:
                return True
            pending.pop(0)()
        return False

    await machine.run(300, one_after_the_other)
    for one, (_, expected) in zip(asked, REFUSED, strict=True):
        assert not one.answer["ok"] and expected in one.answer["text"] and "\n" not in one.answer["text"]
    assert {o.offset.model_sha256 for o in machine.outcomes} == {sha256_of(QUILL)}
    assert {o.offset.state for o in machine.outcomes} == {"ok"}
    with pytest.raises(ServiceError, match="no previous model"):
        machine.store.before()
    assert len(recordings(machine.recordings, MACHINE)) == 1


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{}",
        b"[]",
        b"{",
        b"[" * 100_000,
        b'{"model": 3}',
        b'{"sha256": "0"}',
        b'{"force": "yes"}',
        b'{"model": "x", "sha256": "y"}',
        b'{"surprise": 1}',
        b"x" * 1_000_001,
        b'{"sha256": "../../etc/passwd"}',
    ],
)
async def test_payloads_that_are_no_model_are_refused_in_words(tmp_path: Path, data: bytes) -> None:
    machine = Machine(tmp_path)
    asked = machine.at_sample[2] = Asked(machine, "adopt", data)

    await machine.run(100, lambda _: asked.is_answered)
    assert not asked.answer["ok"] and asked.answer["text"] and "Traceback" not in asked.answer["text"]


@pytest.mark.parametrize("count", [2000, 20_000])
async def test_an_order_too_large_is_refused_at_once_and_keeps_no_other_waiting(tmp_path: Path, count: int) -> None:
    machine = Machine(tmp_path)
    values = ", ".join(["0.001"] * count)
    head, _, rest = QUILL.decode().partition("[paths.DTF]")
    path = f'[paths.DTF]\nunit = "um/W"\nform = "sampled"\nb = [{values}]\na = [1.0, {values}]\n\n['
    large = (head + path + rest.partition("\n[")[2]).encode()
    first = machine.at_sample[10] = Asked(machine, "adopt", payload(large))
    second = Asked(machine, "adopt", payload(STRONGER, force=True))

    def both_answered(_: Outcome) -> bool:
        if first.is_answered and second.reply is None:
            second()
        return second.is_answered

    began = time.monotonic()
    await machine.run(1000, both_answered)
    assert time.monotonic() - began < 100.0
    assert not first.answer["ok"] and f"b has {count} values, expected at most 20" in first.answer["text"]
    assert second.answer["ok"], second.answer


async def test_a_service_that_ends_meanwhile_still_answers(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    asked = machine.at_sample[20] = Asked(machine, "adopt", payload(STRONGER))
    await machine.run(20)
    await machine.run(2)
    assert isinstance(asked.reply, Future) and asked.reply.done()
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9


@pytest.mark.parametrize("notices", [True, False])
async def test_a_model_that_takes_for_ever_does_not_keep_the_service_from_ending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, notices: bool
) -> None:
    """Whether its thread looks for the end of the service, or is inside a computation that does not return."""
    monkeypatch.setattr(adoption, "GRACE_S", 0.2)
    monkeypatch.setattr(adoption, "NOTICE_S", 20.0 if notices else 0.2)
    released, at_work = threading.Event(), threading.Event()

    def for_ever(*_: Any, between_samples: Callable[[], None], **__: Any) -> Any:
        at_work.set()
        while not released.wait(0.01):
            if notices:
                between_samples()
        raise ServiceError("not reached")

    monkeypatch.setattr(adoption, "warm_up", for_ever)
    machine = Machine(tmp_path)
    asked = Asked(machine, "adopt", payload(STRONGER, force=True))

    def ask() -> None:
        asked()
        machine.promises.open.clear()  # simulated time does not wait for it

    machine.at_sample[20] = ask
    machine.at_sample[22] = lambda: at_work.wait(60.0)
    try:
        await machine.run(24)
        assert at_work.is_set()
        assert not asked.answer["ok"] and asked.answer["text"] == "the service is ending"
    finally:
        released.set()
    assert machine.store.in_use() == QUILL
    check_files(machine)


async def test_before_the_first_zero_there_is_nothing_to_warm_up(tmp_path: Path) -> None:
    machine = Machine(tmp_path, settings(zero={"rest_rate_um_per_min": 0.2, "at_start": False}))
    machine.at_sample[5] = Asked(machine, "adopt", payload(STRONGER))
    await machine.run(100, adopted(STRONGER))
    assert machine.outcomes[-1].offset.state == "starting"
    machine.at_sample[len(machine.outcomes) + 1] = lambda: machine.command("zero")
    await machine.run(5)
    assert machine.outcomes[-1].offset.state == "ok"


def test_the_store_keeps_the_history_and_the_configuration_has_the_last_word(tmp_path: Path) -> None:
    store = ModelStore(tmp_path / "models", QUILL, MACHINE)
    assert store.in_use() == QUILL
    with pytest.raises(ServiceError, match="no previous model"):
        store.before()
    store.adopt(STRONGER, name="stronger", time_utc_ns=1)
    store.adopt(WITH_INPUT, name="coolant", time_utc_ns=2)
    store.back(name="stronger", time_utc_ns=3)
    assert (store.in_use(), store.before()) == (STRONGER, QUILL)
    history = json.loads((store.folder / "adopted.json").read_bytes())["history"]
    assert [(h["action"], h["name"]) for h in history] == [
        ("adopt", "stronger"),
        ("adopt", "coolant"),
        ("back", "stronger"),
    ]
    assert store.load(sha256_of(WITH_INPUT)) == WITH_INPUT
    edited = ModelStore(tmp_path / "models", WITH_INPUT, MACHINE)  # somebody has configured another model since
    assert edited.in_use() == WITH_INPUT
    with pytest.raises(ServiceError, match="no previous model"):
        edited.before()
    (store.folder / f"{sha256_of(STRONGER)}.toml").write_bytes(b"something else")
    with pytest.raises(ServiceError, match="the file was changed"):
        store.in_use()
    (store.folder / "adopted.json").write_bytes(b"{")
    with pytest.raises(ServiceError, match="adopt a model, or remove it to use the configured one"):
        store.in_use()
    store.adopt(WITH_INPUT, name="coolant", time_utc_ns=4)
    assert store.in_use() == WITH_INPUT and (store.folder / "adopted.damaged").read_bytes() == b"{"
    # Two machines in one folder: the model of the one is not taken over by the other.
    other = ModelStore(tmp_path / "models", QUILL, "vmc-08")
    with pytest.raises(ServiceError, match="of machine vmc-07, expected vmc-08"):
        other.in_use()
    with pytest.raises(ServiceError, match="a folder of its own"):
        other.adopt(STRONGER, name="stronger", time_utc_ns=5)
    assert store.in_use() == WITH_INPUT


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_what_root_stores_belongs_to_the_user_of_the_service(tmp_path: Path, umask: int) -> None:
    recordings = tmp_path / "recordings"
    os.chown(tmp_path, 65534, 65533)
    before = os.umask(umask)
    try:
        ModelStore(recordings / "models", QUILL, MACHINE).adopt(STRONGER, name="stronger", time_utc_ns=1)
    finally:
        os.umask(before)
    written = [recordings, recordings / "models", *(recordings / "models").iterdir()]
    assert len(written) == 4
    for path in written:
        status = path.stat()
        assert (status.st_uid, status.st_gid) == (65534, 65533), path
        assert stat.S_IMODE(status.st_mode) == (0o755 if path.is_dir() else 0o644), path


async def test_couples_that_a_person_has_put_right_are_no_fault_of_a_model_adopted_afterwards(tmp_path: Path) -> None:
    checked = settings(plausibility={"t_q_below_at_after_min": 10.0}, guards={"t_q_below_at_max_k": 1.0})
    machine = Machine(tmp_path, checked)
    sources = machine.device.sources
    t_q, at = sources[0], sources[1]

    def wire(first: Any, second: Any) -> Callable[[], None]:
        def act() -> None:
            sources[0], sources[1] = first, second

        return act

    machine.at_sample[100], machine.at_sample[130] = wire(at, t_q), wire(t_q, at)
    machine.at_sample[140] = lambda: machine.command("resume")
    machine.at_sample[160] = Asked(machine, "adopt", payload(STRONGER))
    await machine.run(400, adopted(STRONGER, then=5))
    assert "t_q_at_exchanged" in machine.outcomes[135].offset.reasons
    assert "t_q_at_exchanged" not in machine.outcomes[150].offset.reasons
    assert "t_q_at_exchanged" not in machine.outcomes[-1].offset.reasons


@pytest.mark.parametrize(("error_um", "said"), [(b"0.0", True), (b"1.5", False)])
async def test_a_model_that_states_no_error_ends_a_check_and_this_is_said(
    tmp_path: Path, error_um: bytes, *, said: bool
) -> None:
    model = QUILL.replace(b"y_std_um = 2.3", b"y_std_um = " + error_um)
    machine = Machine(tmp_path, settings(plausibility={"false_alarm_days": 30.0}))
    machine.at_sample[200] = Asked(machine, "adopt", payload(model))
    await machine.run(700, adopted(model))
    assert ("are not compared any more" in machine.events("adopt")[-1].text) == said
