"""The loop in the service: recorded, replayed, killed and started again, and in the hands of an operator."""

from __future__ import annotations

import asyncio
import errno
import json
import math
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import msgspec
import numpy as np
import pytest

from compensator.api import shop
from compensator.audit.machine_audit import audit, summary
from compensator.audit.replay_check import ReplayCheck
from compensator.audit.result import RecordingAudit
from compensator.clock import NS
from compensator.config import Config, parse_config
from compensator.events import ComparisonData, EventKind, NotJudged
from compensator.messages import Candidate, Event, number
from compensator.recording.container import Container
from compensator.recording.reading import RawRecord, groups_of, messages, recordings
from compensator.service.event_log import EventLog
from compensator.service.loop.compared import Compared
from compensator.service.loop.process import DiagnosisProcess
from compensator.service.loop.run import OfflineLoop
from compensator.service.loop.state import LoopState, Running, decode_loop
from compensator.service.loop.weighing import Diagnosed
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.outcome import Outcome
from compensator.service.replay import opening_of
from compensator.service.transfer import adoption, model_store
from compensator.service.transfer.model_store import sha256_of
from compensator.service.transfer.shadow import Shadow
from compensator.service.transfer.two_models import not_judged
from compensator.watch.history import STEP_NS, MachineHistory
from compensator.watch.past import last_day
from tests.audit.made import CONFIG
from tests.service.living import MACHINE, Machine, largest_step
from tests.service.looping import extended, shown
from tests.service.simulated import START_NS
from tests.service.test_restart import QUILL

LOOP = b"""
[loop]
policy = "POLICY"
every_h = 24
shadow_h = 6.0
"""


#: The service starts so long before the night's diagnosis, samples; none of these needs a whole day before it.
EVENING = 60


EFFECT = ["input:coolant_degc"]


class Looping(Machine):
    """A machine whose coolant acts on Y, with a loop whose diagnosis is told what it finds."""

    def __init__(
        self,
        folder: Path,
        *found: Diagnosed,
        policy: str = "adopt",
        acts: Callable[[int], float] = lambda i: 1.0,
        before_night: int = EVENING,
        poll_s: float = 60.0,
        every_h: int = 24,
    ) -> None:
        data = CONFIG.replace(b"poll_interval_s = 10.0", f"poll_interval_s = {poll_s}".encode())
        data += LOOP.replace(b"POLICY", policy.encode()).replace(b"every_h = 24", b"every_h = %d" % every_h)
        start_ns = START_NS + (20 * 60 - before_night) * 60 * NS
        super().__init__(folder, parse_config(data, source="test"), start_ns=start_ns)
        self.config_bytes, self.acts, self.found = data, acts, list(found)
        self.asked: list[Running] = []
        self.state_um = 0.0
        rng = np.random.default_rng(7)
        self.device.sources[3] = self.coolant_degc
        self.device.sources[2] = lambda: self.world.truth("y_um") + self.effect_um() + 0.4 * float(rng.normal())
        self.lag: dict[int, float] = {}

    def use(self, data: bytes) -> None:
        """Let the next start read another configuration."""
        self.config, self.config_bytes = parse_config(data, source="test"), data

    def minute(self) -> int:
        return round((self.clock.utc_ns() - self.began_ns) / 30e9)

    @property
    def began_ns(self) -> int:
        self._began = getattr(self, "_began", self.clock.utc_ns())
        return self._began

    def coolant_degc(self, i: int | None = None) -> float:
        t = (self.minute() if i is None else i) / 2.0
        return 22.0 + 1.5 * math.sin(t / 90.0) + 0.8 * math.sin(t / 37.0)

    def effect_um(self) -> float:
        """Return the effect of the coolant now: first order of 60 min, 5 min late."""
        now = self.minute()
        keep = math.exp(-0.5 / 60.0)
        if not self.lag:
            self.lag[0] = 0.0
        for i in range(len(self.lag), now + 1):
            driven = self.coolant_degc(max(i - 10, 0)) - self.coolant_degc(0)
            self.lag[i] = keep * self.lag[i - 1] + (1.0 - keep) * driven
        return 3.0 * self.acts(now // 2) * self.lag[now]

    async def diagnose(self, wanted: Running, calibrated: bytes) -> Diagnosed:
        assert calibrated == QUILL
        self.asked.append(wanted)
        return self.found.pop(0) if len(self.found) > 1 else self.found[0]

    def steps(self) -> list[tuple[str, str]]:
        """Return each recorded decision."""
        events = [event for path in recordings(self.recordings, MACHINE) for event in messages(path, ("event",))]
        return [(event.data["step"], event.data.get("why", "")) for event in events if event.kind == "loop"]

    def decides(self, step: str, why: str = "") -> Callable[[Any], bool]:
        """Return what tells after a sample whether this was decided, by what was published since the sample before."""
        seen = len(self.published)

        def arrived(_: Any) -> bool:
            nonlocal seen
            new, seen = self.published[seen:], len(self.published)
            events = [msgspec.json.decode(data, type=Event) for name, data in new if name == "event"]
            made = [(event.data["step"], event.data.get("why", "")) for event in events if event.kind == "loop"]
            return any(step == one and why in (other, "") for one, other in made)

        return arrived

    def candidates(self) -> list[Candidate]:
        return [one for path in recordings(self.recordings, MACHINE) for one in messages(path, ("candidate",))]


def checked(machine: Looping) -> None:
    """Replay everything: each message and each decision comes again."""
    audited = audit(recordings(machine.recordings, MACHINE))
    assert audited.clean, [file.difference for file in audited.files] + [f.line() for f in audited.findings]
    assert audited.samples == len(machine.outcomes)


async def test_the_service_adopts_what_shows_itself_better_and_every_decision_is_replayed(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()))
    await machine.run(960, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    await machine.run(60)
    steps = machine.steps()
    assert steps == [("diagnose", "planned"), ("shadow", ""), ("adopt", "")]
    audited = summary(audit(recordings(machine.recordings, MACHINE)))
    assert "bit for bit. It makes the 3 decisions of the loop again, on the same figures.\n" in audited
    assert machine.store.in_use() == extended() and machine.store.calibrated() == QUILL
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    checked(machine)
    found = machine.candidates()
    # Recorded with each sample of its comparison, and published to nobody.
    assert [one.seq for one in found[:5]] == list(range(found[0].seq, found[0].seq + 5))
    assert {one.role for one in found} == {"candidate", "before"}
    assert not any(name == "candidate" for name, _ in machine.published)
    files = recordings(machine.recordings, MACHINE)
    openings = [opening_of(path) for path in files]
    models = [tuple(map(opening.get, ("model.toml", "candidate.toml", "before.toml"))) for opening in openings]
    assert list(dict.fromkeys(models)) == [(QUILL, None, None), (QUILL, extended(), None), (extended(), None, QUILL)]
    event = machine.events("adopt")[-1]
    assert event.data["by"] == "loop" and event.data["comparison"]["verdict"] == "better"
    # A replay sees what was changed afterwards: a record of the shadow, and a decision that was made up or left out.
    comparing = next(path for path in files if opening_of(path).get("candidate.toml") == extended())
    assert replayed(comparing, lambda group: group) is None
    assert replayed(comparing, changed("candidate", b'"verdict":"', b'"verdict":"x')).topic == "candidate"
    assert replayed(comparing, lambda group: [one for one in group if one.topic != "candidate"]).topic == "candidate"
    deciding = next(path for path in reversed(files) if opening_of(path).get("candidate.toml") == extended())
    assert replayed(deciding, changed("event", b'"step":"adopt"', b'"step":"back"')).topic == "event"


def changed(topic: str, old: bytes, new: bytes) -> Callable[[list[RawRecord]], list[RawRecord]]:
    """Change the records of a topic."""
    return lambda group: [one._replace(body=one.body.replace(old, new)) if one.topic == topic else one for one in group]


def replayed(path: Path, change: Callable[[list[RawRecord]], list[RawRecord]]) -> Any:
    """Replay a recording with changed records; return the first difference."""
    result = RecordingAudit(file=path.name, size=0)
    with Container(path) as container:
        check = ReplayCheck(container.survey(whole=False), result)
        for records, _, whole in groups_of(container):
            if whole and records:
                check.check(change(records))
    check.finish()
    return result.difference


class Asked:
    """Sends a command when it is called, and keeps its answer."""

    def __init__(self, machine: Looping, name: str, **arguments: Any) -> None:
        self._machine, self._name, self._arguments = machine, name, arguments
        self.reply: Any = None

    def __call__(self) -> None:
        self.reply = self._machine.command(self._name, json.dumps(self._arguments).encode())

    @property
    def answer(self) -> dict[str, Any]:
        answer: dict[str, Any] = self.reply.result(timeout=0) if isinstance(self.reply, Future) else self.reply
        return answer


def in_phase(machine: Looping, phase: str, then: Callable[[], None] = lambda: None) -> Callable[[Any], bool]:
    """Tell when the loop is in a phase, and do something then."""

    def arrived(_: Any) -> bool:
        status = next(json.loads(sent) for name, sent in reversed(machine.published) if name == "status")
        if status["loop"]["phase"] == phase:
            then()
            return True
        return False

    return arrived


async def test_a_proposal_waits_for_a_person_and_is_adopted_by_one_command(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()), policy="propose")
    early = machine.at_sample[EVENING + 60] = Asked(machine, "adopt", candidate=True)
    await machine.run(960, until=in_phase(machine, "proposed"))
    assert not early.answer["ok"] and "not proposed yet" in early.answer["text"]
    assert machine.store.in_use() == QUILL and machine.steps()[-1] == ("propose", "")
    yes = machine.at_sample[len(machine.outcomes) + 30] = Asked(machine, "adopt", candidate=True)
    await machine.run(120, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    assert yes.answer["ok"] and "µm rms, this one" in yes.answer["text"], yes.answer
    # As `adopt FILE` answers: with the comparison, and by how much the offset moves.
    assert "is adopted; " in yes.answer["text"] and "the offset would move by" in yes.answer["text"]
    expected = machine.events("adopt")[-1].data["difference_um"]
    assert yes.answer["comparison"]["offset_change_um"] == pytest.approx(expected, abs=0.5)
    assert yes.answer["comparison"]["verdict"] == "better" and yes.answer["model_sha256"] == sha256_of(extended())
    assert machine.store.in_use() == extended() and machine.store.calibrated() == QUILL
    await machine.run(30)
    checked(machine)
    # A page that is opened now has the candidate's prediction of the hours before, from the recordings.
    seen = MachineHistory()
    for message in last_day(machine.recordings, MACHINE, machine.clock.utc_ns()):
        if isinstance(message, Candidate):
            seen.add_recorded_candidate(message)
        elif not isinstance(message, Event):
            seen.add(message, machine.clock.utc_ns())
    found = machine.candidates()
    drawn = [value for value in seen.columns()["candidate_um"] if value is not None]
    assert len(drawn) == len({one.time_utc_ns // STEP_NS for one in found}) > 300
    assert drawn[0] == pytest.approx(found[0].y_pred_um, abs=1e-3)


async def test_a_second_answer_to_a_candidate_before_the_first_acts_is_refused(tmp_path: Path) -> None:
    """Of a yes and a no within a minute only the first acts, and the second is not told that it does."""
    machine = Looping(tmp_path, shown(extended()), policy="propose")
    yes, no = Asked(machine, "adopt", candidate=True, force=True), Asked(machine, "dismiss", force=True)

    def both() -> None:
        yes()
        no()

    machine.at_sample[EVENING + 60] = both
    await machine.run(EVENING + 120)
    assert yes.answer["ok"], yes.answer
    assert not no.answer["ok"] and "answered already" in no.answer["text"], no.answer
    assert machine.store.in_use() == extended()


async def test_a_dismissed_candidate_does_not_come_again(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()), every_h=8)
    # It is not proposed: who answers has read of another one.
    late = machine.at_sample[EVENING + 50] = Asked(machine, "dismiss")
    other = machine.at_sample[EVENING + 55] = Asked(machine, "dismiss", sha256="0" * 12)
    short = machine.at_sample[EVENING + 56] = Asked(machine, "dismiss", sha256=sha256_of(extended())[:3])
    no = Asked(machine, "dismiss", sha256=sha256_of(extended())[:12])
    back = Asked(machine, "back")

    def both() -> None:
        no()
        back()

    machine.at_sample[EVENING + 60] = both
    await machine.run(EVENING + 8 * 60 + 60)
    assert not late.answer["ok"] and "compensator dismiss HASH" in late.answer["text"], late.answer
    assert not other.answer["ok"] and "candidate 000000000000 has given its place" in other.answer["text"]
    assert not short.answer["ok"] and "expected at least 6 digits of a hash" in short.answer["text"]
    assert no.answer["ok"], no.answer
    # What has been answered is not lost by another change of the model within the minute.
    assert not back.answer["ok"] and "the candidate was answered" in back.answer["text"], back.answer
    again = machine.at_sample[len(machine.outcomes) + 1] = Asked(machine, "dismiss")
    await machine.run(20)
    assert machine.steps()[2:5] in ([("end", "dismissed"), ("diagnose", "planned"), ("nothing", "avoided")],), (
        machine.steps()
    )
    assert not again.answer["ok"] and "no candidate" in again.answer["text"]
    assert machine.store.in_use() == QUILL
    # Nor after the loop has been off for some time.
    on, (avoided,), zero_ns = machine.config_bytes, last_state(machine).avoided, last_state(machine).zero_utc_ns
    machine.use(on.replace(b'policy = "adopt"', b'policy = "off"'))
    await machine.run(60)
    assert "loop.json" not in opening_of(recordings(machine.recordings, MACHINE)[-1])
    machine.use(on)
    await machine.run(5)
    (kept,) = last_state(machine).avoided
    assert last_state(machine).zero_utc_ns == zero_ns > 0
    assert kept.effects == EFFECT and abs(kept.until_utc_ns - avoided.until_utc_ns) <= 10 * 60 * NS
    checked(machine)


async def test_a_model_that_a_person_adopts_ends_the_shadow_and_is_the_calibrated_one_from_then_on(
    tmp_path: Path,
) -> None:
    machine = Looping(tmp_path, shown(extended()))
    other = extended(2.9)
    adopt = Asked(machine, "adopt", model=other.decode(), sha256=sha256_of(other))
    machine.at_sample[EVENING + 100] = adopt
    await machine.run(960, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(other))
    assert adopt.answer["ok"], adopt.answer
    await machine.run(30)
    assert machine.steps() == [("diagnose", "planned"), ("shadow", ""), ("end", "by_hand")]
    assert machine.store.calibrated() == other
    assert "candidate.toml" not in opening_of(recordings(machine.recordings, MACHINE)[-1])
    assert last_state(machine).base_effects == EFFECT
    machine.at_sample[len(machine.outcomes) + 1] = Asked(machine, "back")
    await machine.run(120, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(QUILL))
    await machine.run(5)
    assert last_state(machine).effects == last_state(machine).base_effects == []
    checked(machine)


async def test_what_the_loop_decides_while_a_person_goes_back_is_not_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or `back` would take the loop's model from the list of those in use, and not the one that it replaces."""
    machine, first = Looping(tmp_path, shown(extended())), QUILL + b"# adopted before\n"
    machine.store.adopt(first, name="first", time_utc_ns=1)
    monkeypatch.setattr(machine, "diagnose", AsyncMock(return_value=shown(extended())))
    await machine.run(960, until=in_phase(machine, "shadow"))
    compared, go, running = threading.Event(), threading.Event(), asyncio.get_running_loop()

    def slow(*_: Any, **__: Any) -> ComparisonData:
        compared.set()
        running.call_soon_threadsafe(machine.promises.open.clear)  # samples go on
        go.wait(60.0)
        return not_judged(NotJudged.NO_Y)

    monkeypatch.setattr(adoption, "second_opinion", slow)
    back = machine.at_sample[len(machine.outcomes) + 330] = Asked(machine, "back")
    decided: list[int] = []

    def until(outcome: Outcome) -> bool:
        if not decided and any(event.data["step"] == "adopt" for event in machine.events("loop")):
            decided.append(len(machine.outcomes))
        if decided and len(machine.outcomes) == decided[0] + 5:
            assert compared.is_set() and outcome.offset.model_sha256 == sha256_of(first)
            go.set()
            machine.promises.add(back.reply)
        return outcome.offset.model_sha256 == sha256_of(QUILL)

    await machine.run(600, until=until)
    assert back.answer["ok"] and machine.store.in_use() == QUILL, back.answer
    await machine.run(3)
    assert machine.outcomes[-1].offset.model_sha256 == sha256_of(QUILL)
    checked(machine)


async def test_what_a_person_goes_back_from_without_the_service_is_avoided_as_with_it(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()))
    await machine.run(960, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    await machine.run(5)
    machine.store.back(name="quill", time_utc_ns=machine.clock.utc_ns())
    await machine.run(5)
    (avoided,) = last_state(machine).avoided
    assert avoided.effects == EFFECT and last_state(machine).effects == []
    # Once: a configuration that is edited afterwards is no `back`.
    machine.use(machine.config_bytes + b"# a remark\n")
    await machine.run(5)
    assert [one.effects for one in last_state(machine).avoided] == [EFFECT]


def last_state(machine: Looping) -> LoopState:
    """Return the state of the loop with which the last recording begins."""
    return decode_loop(opening_of(recordings(machine.recordings, MACHINE)[-1])["loop.json"])


async def test_what_the_loop_has_added_is_its_own_whatever_is_edited_in_the_configuration(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()))
    await machine.run(960, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    await machine.run(5)
    assert (last_state(machine).effects, last_state(machine).base_effects) == (EFFECT, [])
    machine.use(machine.config_bytes + b"# a remark\n")
    await machine.run(5)
    assert (last_state(machine).effects, last_state(machine).base_effects) == (EFFECT, [])
    for path in recordings(machine.recordings, MACHINE):
        path.unlink()  # and whatever is lost
    await machine.run(5)
    assert (last_state(machine).effects, last_state(machine).base_effects) == (EFFECT, [])


async def test_a_kill_in_a_shadow_loses_nothing_of_the_comparison(tmp_path: Path) -> None:
    machine = Looping(tmp_path / "killed", shown(extended()))
    await machine.run(EVENING + 50)
    await machine.run_and_kill(100)
    await machine.run(600, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    always = Looping(tmp_path / "always", shown(extended()))
    await always.run(EVENING + 750, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    assert machine.steps() == always.steps() == [("diagnose", "planned"), ("shadow", ""), ("adopt", "")]
    ends = [one.outcomes[-1].sample.time_utc_ns for one in (machine, always)]
    # The pauses cost samples, and the comparison the block that they are in.
    assert abs(ends[0] - ends[1]) <= 3600e9
    assert {one.seq for one in machine.candidates()} >= {
        o.sample.seq for o in machine.outcomes[EVENING + 60 : EVENING + 140]
    }
    checked(machine)


async def test_a_kill_as_a_file_is_begun_is_no_time_without_the_loop(tmp_path: Path) -> None:
    """The state of the compensation is on disk, and that of the loop is not."""
    machine = Looping(tmp_path, shown(extended()))
    await machine.run(EVENING + 60)
    (path,) = recordings(machine.recordings, MACHINE)[-1:]
    assert "candidate.toml" in opening_of(path)
    await machine.run_and_kill(5)
    path = recordings(machine.recordings, MACHINE)[-1]
    path.write_bytes(path.read_bytes()[: path.read_bytes().index(b"loop.json") - 4])
    assert list(opening_of(path)) == ["config.toml", "model.toml", "state.json"]
    await machine.run(5)
    assert machine.steps() == [("diagnose", "planned"), ("shadow", "")]
    assert "candidate.toml" in opening_of(recordings(machine.recordings, MACHINE)[-1])


async def test_a_kill_in_the_middle_of_a_diagnosis_leaves_nothing_and_it_is_made_once_more(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()))
    hangs, machine.waits_for_diagnoses = asyncio.Event(), False

    async def hanging(wanted: Running, calibrated: bytes) -> Diagnosed:
        machine.asked.append(wanted)
        await hangs.wait()
        raise AssertionError

    answers, machine.diagnose = machine.diagnose, hanging  # type: ignore[method-assign]
    await machine.run_and_kill(EVENING + 50)
    assert len(machine.asked) == 1 and machine.steps() == [("diagnose", "planned")]
    machine.diagnose, machine.waits_for_diagnoses = answers, True  # type: ignore[method-assign]
    await machine.run(100)
    assert machine.steps() == [("diagnose", "planned"), ("diagnose", "again"), ("shadow", "")]
    assert machine.asked[1].to_utc_ns == machine.asked[0].to_utc_ns
    checked(machine)


async def test_a_diagnosis_that_is_interrupted_twice_waits_for_the_next_night(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()))
    machine.waits_for_diagnoses = False

    async def hanging(wanted: Running, calibrated: bytes) -> Diagnosed:
        machine.asked.append(wanted)
        await asyncio.Event().wait()
        raise AssertionError

    machine.diagnose = hanging  # type: ignore[method-assign]
    await machine.run(EVENING + 50)
    await machine.run(200, until=lambda _: len(machine.asked) == 2)
    for _ in range(2):
        await machine.run(10)
    assert len(machine.asked) == 2
    assert machine.steps() == [("diagnose", "planned"), ("diagnose", "again"), ("end", "interrupted")]
    checked(machine)


async def killed_as_the_model_was_stored(folder: Path) -> Looping:
    """Return a machine whose service was killed between a stored model and its first sample: at a poll between."""
    machine = Looping(folder, shown(extended()), poll_s=30.0)
    copy = folder / "killed"

    def stored() -> None:
        model = machine.outcomes[-1].offset.model_sha256 if machine.outcomes else ""
        if not copy.exists() and model == sha256_of(QUILL) and machine.store.in_use() == extended():
            shutil.copytree(machine.recordings, copy)
            assert machine.daemon is not None
            machine.daemon.stop()

    machine.at_poll = stored
    await machine.run(960)
    machine.at_poll = lambda: None
    last = machine.outcomes[-1]
    assert last.offset.model_sha256 == sha256_of(QUILL)
    shutil.rmtree(machine.recordings)
    copy.rename(machine.recordings)
    return machine


async def test_a_kill_between_the_stored_model_and_its_first_sample_completes_the_exchange(tmp_path: Path) -> None:
    machine = await killed_as_the_model_was_stored(tmp_path)
    await machine.run(30)
    after = machine.outcomes[-30:]
    assert {outcome.offset.model_sha256 for outcome in after} == {sha256_of(extended())}
    # As if nothing had happened: the shadow goes on where it was, without another warm-up.
    assert not any("cold_start" in outcome.offset.reasons for outcome in after)
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    assert {one.role for one in machine.candidates()[-30:]} == {"before"}
    assert machine.events("adopt")[-1].data["by"] == "loop"
    checked(machine)


async def test_a_stored_model_has_its_level_though_the_configuration_was_edited_before_its_first_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Compared, "level_at_adoption_um", property(lambda self: 6.0))
    machine = await killed_as_the_model_was_stored(tmp_path)
    machine.use(machine.config_bytes + b"# a remark\n")
    for _ in range(2):
        await machine.run(3)
        assert machine.outcomes[-1].offset.model_sha256 == sha256_of(extended())
        assert machine.outcomes[-1].estimate.level_um == 6.0
    checked(machine)


async def test_an_exchange_that_is_completed_goes_on_from_what_was_published_while_the_disk_failed(
    tmp_path: Path,
) -> None:
    machine = await killed_as_the_model_was_stored(tmp_path)
    last = machine.outcomes[-1].offset
    early = msgspec.structs.replace(
        last,
        seq=last.seq + 3,
        time_utc_ns=last.time_utc_ns + 180 * NS,
        y_offset_um=number(last.y_offset_um) + 15.0,
        state="hold",
        reasons=["operator_hold", "recording_late"],
    )
    OffsetCheckpoint(machine.recordings, MACHINE, machine.folder).write(early)
    await machine.sleep(3)
    await machine.run(3)
    after = [outcome.offset for outcome in machine.outcomes[-3:]]
    assert {one.model_sha256 for one in after} == {sha256_of(extended())}
    assert {one.y_offset_um for one in after} == {early.y_offset_um}
    assert all("operator_hold" in one.reasons for one in after)


async def test_a_disk_that_is_full_at_an_adoption_leaves_the_present_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine, works, refused = Looping(tmp_path, shown(extended()), every_h=8), model_store.replace_file, list[Path]()

    def full(path: Path, data: bytes, **_: object) -> None:
        refused.append(path)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(model_store, "replace_file", full)
    await machine.run(960, until=lambda _: bool(refused))
    monkeypatch.setattr(model_store, "replace_file", works)
    await machine.run(30)
    assert machine.steps() == [("diagnose", "planned"), ("shadow", ""), ("adopt", ""), ("end", "failed")]
    assert "No space left on device" in machine.events("loop")[-1].text
    assert "the present one stays, and it is compared no more" in machine.events("loop")[-1].text
    assert machine.store.in_use() == QUILL and machine.outcomes[-1].offset.model_sha256 == sha256_of(QUILL)
    # The restart finds no model half stored, and the next diagnosis makes another candidate.
    await machine.run(1440, until=in_phase(machine, "shadow"))
    assert machine.steps()[4:] == [("diagnose", "planned"), ("shadow", "")]
    checked(machine)


async def test_another_policy_ends_the_shadow_at_the_restart_and_holds_from_then_on(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()), every_h=8)
    await machine.run(EVENING + 300)
    assert machine.steps()[-1] == ("shadow", "")
    machine.use(machine.config_bytes.replace(b'policy = "adopt"', b'policy = "propose"'))
    await machine.run(5)
    assert machine.steps()[-1] == ("end", "by_hand")
    await machine.run(1800, until=in_phase(machine, "proposed"))
    await machine.run(60)
    assert machine.steps()[3:] == [("diagnose", "planned"), ("shadow", ""), ("propose", "")]
    assert machine.store.in_use() == QUILL
    machine.use(machine.config_bytes.replace(b'policy = "propose"', b'policy = "off"'))
    await machine.run(5)
    assert "loop.json" not in opening_of(recordings(machine.recordings, MACHINE)[-1])
    checked(machine)


async def test_a_defect_of_the_shadow_ends_the_shadow_and_never_a_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Looping(tmp_path, shown(extended()))
    works = Shadow.process

    def breaks(shadow: Shadow, outcome: Outcome) -> Any:
        if len(machine.outcomes) == EVENING + 100:
            raise ZeroDivisionError("a defect")
        return works(shadow, outcome)

    monkeypatch.setattr(Shadow, "process", breaks)
    await machine.run(EVENING + 120)
    monkeypatch.setattr(Shadow, "process", works)
    assert machine.steps() == [("diagnose", "planned"), ("shadow", ""), ("end", "failed")]
    states = {outcome.offset.state for outcome in machine.outcomes[EVENING + 90 :]}
    assert states == {"ok"} and len(machine.outcomes) == EVENING + 120
    assert "a defect" in machine.events("loop")[-1].text
    checked(machine)


async def test_the_process_of_the_service_finds_the_effect_in_its_recordings(tmp_path: Path) -> None:
    machine = Looping(tmp_path, before_night=480)
    machine.diagnose = DiagnosisProcess(  # type: ignore[method-assign]
        machine.config, machine.recordings, machine.store.folder / "diagnoses"
    )
    await machine.run(530, until=in_phase(machine, "shadow"))
    assert machine.steps() == [("diagnose", "planned"), ("shadow", "")]
    found = machine.events("diagnosis")[-1].data
    assert found["verdict"] == "explained" and found["effects"] == ["input:coolant_degc"]
    folder = next((machine.store.folder / "diagnoses").iterdir())
    assert {"diagnosis.json", "model.toml", "report.html"} <= {path.name for path in folder.iterdir()}
    await machine.run(5)
    assert opening_of(recordings(machine.recordings, MACHINE)[-1])["candidate.toml"] == (
        (folder / "model.toml").read_bytes()
    )
    checked(machine)


async def test_a_loop_of_a_shop_decides_by_the_settings_of_a_table_that_is_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Looping(tmp_path, shown(extended()), policy="off")
    await machine.run(5)
    used: list[Config] = []

    def seen(config: Config, *others: Any) -> OfflineLoop:
        used.append(config)
        return OfflineLoop(config, *others)

    monkeypatch.setattr(shop, "OfflineLoop", seen)
    assert not shop.loop_of_machine(machine.recordings, "propose").error
    assert machine.config.loop is not None
    assert [one.loop for one in used] == [msgspec.structs.replace(machine.config.loop, policy="propose")]


async def test_a_loop_that_is_off_says_what_to_set(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()), policy="off")
    no = machine.at_sample[5] = Asked(machine, "dismiss")
    await machine.run(10)
    assert not no.answer["ok"] and 'policy = "propose" or "adopt"' in no.answer["text"], no.answer


async def test_what_is_exchanged_stays_exchanged_whatever_fails_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The offset goes on with the model that the recordings, the store and the events name."""
    machine = Looping(tmp_path, shown(extended()))
    note = EventLog.note

    def fails(log: EventLog, kind: EventKind, text: str, data: Any = None) -> None:
        note(log, kind, text, data)
        if kind == EventKind.ADOPT:
            raise ZeroDivisionError("a defect")

    monkeypatch.setattr(EventLog, "note", fails)
    await machine.run(960, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    monkeypatch.undo()
    await machine.run(30)
    assert {one.offset.model_sha256 for one in machine.outcomes[-30:]} == {sha256_of(extended())}
    assert machine.store.in_use() == extended()
    assert ("adopt", "") in machine.steps() and "a defect" in machine.events("loop")[-1].text
    checked(machine)
