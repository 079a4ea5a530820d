"""A defect of the loop ends the shadow, never a sample, wherever it happens, and its cause is recorded."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from compensator.service.disk_writer import Entry
from compensator.service.journal import Journal
from compensator.service.loop import found, live
from compensator.service.loop.core import ShadowedLoop
from compensator.service.loop.decisions import LoopDecisions
from compensator.service.transfer.model_store import ModelStore, sha256_of
from compensator.service.transfer.shadow import Shadow
from tests.service.living import MACHINE
from tests.service.looping import extended, shown, stronger
from tests.service.test_loop_service import EVENING, Asked, Looping, checked
from tests.service.test_loop_several import Early
from tests.service.test_restart import QUILL


class Breaks:
    """Stands in for a method: raises the first time that it is called, or each time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, *, always: bool = False) -> None:
        self.calls = 0
        works = getattr(owner, name)

        def broken(*arguments: Any, **settings: Any) -> Any:
            self.calls += 1
            if always or self.calls == 1:
                raise ZeroDivisionError("a defect")
            return works(*arguments, **settings)

        monkeypatch.setattr(owner, name, broken)


def unharmed(machine: Looping, samples: int) -> None:
    """Every sample is decided by the model that was calibrated, and the next start finds that one."""
    assert len(machine.outcomes) == samples
    assert {outcome.offset.state for outcome in machine.outcomes[-60:]} == {"ok"}
    assert {outcome.offset.model_sha256 for outcome in machine.outcomes} == {sha256_of(QUILL)}
    assert machine.store.in_use() == machine.store.calibrated() == QUILL
    assert not any("internal_error" in outcome.offset.reasons for outcome in machine.outcomes)


def taken(machine: Looping) -> list[str]:
    """Return the hashes of what is in shadow."""
    loop = machine.daemon._loop  # type: ignore[union-attr]
    return [place.sha256 for place in loop._core.state.taken]  # type: ignore[union-attr]


def said(machine: Looping) -> str:
    """Return what is said about the end."""
    assert machine.steps()[-1] == ("end", "failed"), machine.steps()
    return str(machine.events("loop")[-1].text)


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (LoopDecisions, "receive"),
        (LoopDecisions, "begin"),
        (ShadowedLoop, "begin_shadow"),
        (found, "warm_up"),
        (LoopDecisions, "shadow_begins"),
    ],
)
async def test_between_two_samples_and_in_a_warm_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str
) -> None:
    machine = Looping(tmp_path, shown(extended()))
    broken = Breaks(monkeypatch, owner, name)
    await machine.run(EVENING + 60)
    assert broken.calls and "ZeroDivisionError: a defect" in said(machine)
    monkeypatch.undo()
    unharmed(machine, EVENING + 60)
    if name != "receive":  # a replay meets a defect of the rules, too
        checked(machine)


async def test_at_an_exchange_whose_model_is_stored_already(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Looping(tmp_path, shown(extended()))
    broken = Breaks(monkeypatch, LoopDecisions, "exchanged")
    await machine.run(960, until=lambda _: bool(broken.calls))
    await machine.run(60)
    assert machine.steps()[-2] == ("adopt", "") and "a defect" in said(machine)
    unharmed(machine, len(machine.outcomes))
    checked(machine)


async def test_what_runs_in_shadow_goes_on_when_a_newcomer_breaks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Early(tmp_path, shown(extended()), shown(stronger(0.1)), acts=lambda i: 0.5)
    await machine.run(EVENING + 120)
    broken = Breaks(monkeypatch, found, "warm_up")
    later = itertools.count()
    await machine.run(600, until=lambda _: bool(broken.calls) and next(later) == 60)
    assert "in the warm-up of the candidate" in said(machine)
    assert machine.candidates()[-1].model_sha256 == sha256_of(extended())
    unharmed(machine, len(machine.outcomes))
    checked(machine)


async def test_at_an_operators_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Looping(tmp_path, shown(extended()))
    machine.at_sample[EVENING + 60] = Asked(machine, "dismiss", force=True)
    broken = Breaks(monkeypatch, LoopDecisions, "dismiss")
    await machine.run(EVENING + 120)
    assert broken.calls and "a defect" in said(machine)
    unharmed(machine, EVENING + 120)


@pytest.mark.parametrize("disk_is_slow", [False, True])
async def test_after_a_sample(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk_is_slow: bool) -> None:
    """What is told about the loop, and what begins then: the offset is published already."""
    machine = Looping(tmp_path, shown(extended()))
    machine.at_sample[EVENING + 60] = lambda: Breaks(monkeypatch, live, "loop_status")
    if disk_is_slow:
        brief = Journal.wait_briefly

        async def late(journal: Journal, entry: Entry) -> bool:
            return await brief(journal, entry) and len(machine.outcomes) != EVENING + 60

        monkeypatch.setattr(Journal, "wait_briefly", late)
    await machine.run(EVENING + 120)
    assert "a defect" in said(machine)
    unharmed(machine, EVENING + 120)
    numbers = [json.loads(data)["seq"] for topic, data in machine.published if topic == "offset"]
    assert len(set(numbers)) == len(numbers) == EVENING + 120
    checked(machine)


async def test_a_message_that_cannot_be_sent(tmp_path: Path) -> None:
    """The event is on record; the sample of a warm-up counts, with the zero that was set with it."""
    machine = Looping(tmp_path, shown(extended()))
    take, unsent = machine.publish, ["event", "sample", "event", "estimate"]

    def publish(name: str, data: bytes) -> None:
        kind = json.loads(data).get("kind")
        if unsent and name == unsent[0] and (name != "event" or kind in ("loop", "diagnosis")):
            unsent.pop(0)
            raise RuntimeError("the session is closed")
        take(name, data)

    machine.publish = publish  # type: ignore[method-assign]
    await machine.run(EVENING + 60)
    assert not unsent and len(taken(machine)) == 1
    unharmed(machine, EVENING + 60)
    checked(machine)


async def test_a_model_that_cannot_be_stored_is_not_adopted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does it keep the loop, or a person, waiting for it."""
    machine = Looping(tmp_path, shown(extended()))
    broken = Breaks(monkeypatch, ModelStore, "adopt", always=True)
    await machine.run(960, until=lambda _: bool(broken.calls))
    loop = machine.daemon._loop  # type: ignore[union-attr]
    await machine.run(60)
    assert not loop.is_working and not loop.is_exchanging  # type: ignore[union-attr]
    assert ("end", "failed") in machine.steps()
    unharmed(machine, len(machine.outcomes))


async def test_a_second_defect_turns_the_loop_off_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Looping(tmp_path, shown(extended()))

    def breaks() -> None:
        Breaks(monkeypatch, Shadow, "process", always=True)
        Breaks(monkeypatch, LoopDecisions, "give_up", always=True)

    machine.at_sample[EVENING + 60] = breaks
    await machine.run(EVENING + 120)
    monkeypatch.undo()
    assert said(machine).endswith("the loop is off until the next start")
    unharmed(machine, EVENING + 120)


async def test_a_file_that_has_the_name_of_a_recording_only_takes_no_state(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()))
    await machine.run(EVENING + 60)
    before = taken(machine)
    (machine.recordings / f"{MACHINE}_20990101T000000Z.mcap").write_bytes(b"x\n")
    await machine.run(60)
    assert before and taken(machine) == before
    assert not any("without its state" in event.text for event in machine.events("restart"))


async def test_at_the_start_of_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Looping(tmp_path, shown(extended()))
    await machine.run(EVENING + 60)
    broken = Breaks(monkeypatch, ShadowedLoop, "process")
    await machine.run(60)
    assert broken.calls > 1
    assert any("without its state: internal error: ZeroDiv" in event.text for event in machine.events("restart"))
    monkeypatch.undo()
    unharmed(machine, EVENING + 120)
    checked(machine)
