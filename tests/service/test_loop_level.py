"""A candidate that is right about every change of Y and wrong in its level.

Measured Y shows the level if the present model was right until the effect began; else it is proposed, and adopted after
a zero.
"""

import asyncio
import dataclasses
import functools
import json
import shutil

import msgspec
import numpy as np
import pytest

from compensator.audit.replay_check import ReplayCheck
from compensator.audit.result import RecordingAudit
from compensator.config import LoopSettings
from compensator.errors import DataError
from compensator.events import ComparisonVerdict
from compensator.model.model_file import parse_model
from compensator.recording.container import Container
from compensator.recording.reading import groups_of, recordings
from compensator.service.compensation import Compensation
from compensator.service.loop import decisions as decisions_module
from compensator.service.loop.compared import Compared
from compensator.service.loop.level import ErrorBlocks, channels_at_zero
from compensator.service.loop.run import OfflineLoop
from compensator.service.loop.state import NO_VERDICT, InShadow, LoopState, Running
from compensator.service.loop.weighing import Diagnosed, without_candidate
from compensator.service.replay import opening_of
from compensator.service.transfer.model_store import sha256_of
from compensator.service.transfer.second_opinion import second_opinion
from compensator.service.transfer.two_models import BLOCK_NS, Block, ComparisonState
from compensator.service.transfer.warm_up import warm_up
from tests.service.living import MACHINE
from tests.service.looping import (
    DAY,
    LATER_NS,
    Night,
    crept,
    decisions,
    errors,
    evening,
    extended,
    grown,
    machine,
    run,
    settings,
    shown,
    stronger,
)
from tests.service.test_loop_service import Asked, Looping, changed, checked, in_phase, replayed
from tests.service.test_restart import QUILL as QUILL_FILE

#: An effect begins at 18 o'clock, eight hours before the night: so long its level is seen, and was right for six hours.
BEGAN, NIGHT = 6 * 60, 14 * 60
from_noon = functools.partial(evening, before_night=NIGHT)


def warm_at_first(i: int, values: dict[str, float], begins: int = BEGAN) -> None:
    """The coolant is 4 K warmer at the zero, while it does not act yet, than later."""
    values["coolant_degc"] += 4.0 if i < begins else 0.0


def begun(i: int) -> float:
    return float(i >= BEGAN)


def test_the_level_is_what_measured_y_shows_since_the_effect_began():
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
    steps = run(loop, from_noon(NIGHT + DAY + 60, begun, change=warm_at_first))
    adopted = [seq for seq, step, _ in decisions(steps) if step == "adopt"]
    assert len(adopted) == 1 and adopted[0] < NIGHT + 15 * 60
    after = errors(steps)[adopted[0] + 60 :]
    (event,) = [note for step in steps for note in step.events if note.kind == "adopt"]
    assert "y_moved" not in event.data["comparison"] and abs(event.data["level_um"]) == pytest.approx(12.0, abs=1.0)
    # Counted from the zero, when the coolant was 4 K warmer, it would be wrong by 12 µm.
    assert abs(np.mean(after)) < 1.0 and np.std(after) < 1.0


@pytest.mark.parametrize("begins", [0, 390])
def test_the_level_of_what_began_after_a_zero_on_a_warm_machine_is_that_of_the_present_model(begins):
    """What the candidate adds is 30 % of the heat's share: at the zero it adds that only if it acted there."""
    grew = grown(0.3)
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(stronger(0.3))))
    more = {"more": lambda i: grew(i) * (i >= begins)}
    samples = from_noon(NIGHT + 20 * 60, lambda i: 0.0, **more)
    run(loop, samples, 300)
    loop.compensation.zero("warm")
    steps = run(loop, samples)
    acted_um = grew(300)
    assert abs(acted_um) > 5.0
    (event,) = [note for step in steps for note in step.events if note.kind == "adopt"]
    assert event.data["level_um"] == pytest.approx(acted_um if begins else 0.0, abs=1.0)
    left_um = [step.outcome.estimate.residual_um for step in steps[-300:]]
    assert abs(np.mean(left_um)) < 1.0


def test_a_zero_between_the_decision_and_the_exchange_ends_the_level_of_the_zero_before():
    """The model is stored meanwhile, or the service was killed."""
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
    samples = from_noon(NIGHT + 20 * 60, begun, change=warm_at_first)
    while not loop._core.state.exchange:
        loop.process(next(samples))
    assert abs(loop._core.state.level_um) == pytest.approx(12.0, abs=1.0)
    loop.compensation.zero("warm")
    loop._core.process(loop.compensation.process(next(samples)))
    steps = run(loop, samples, 120)
    assert steps[-1].model_sha256 == sha256_of(extended())
    assert abs(np.mean(errors(steps)[60:])) < 2.0


def test_what_a_model_leaves_while_its_state_is_not_known_is_none_of_its_errors():
    """A warm-up that begins with one errs for hours: a slip since then would look like an effect's level."""
    error, compensation = ErrorBlocks(), Compensation(settings(), parse_model(QUILL_FILE, source="test"))
    outcomes = []
    for i, sample in enumerate(machine(300, lambda i: 0.0)):
        if i == 100:
            compensation.pause(None)
        outcomes.append(compensation.process(sample))
        error.update(outcomes[-1])
    known = {one.sample.time_utc_ns // BLOCK_NS for one in outcomes[:100]}
    assert np.ptp([one.estimate.residual_um for one in outcomes[100:]]) > 5.0
    assert {number for number, _ in error.blocks} == known


@pytest.mark.parametrize("slip_min", [60, 300])
def test_a_mount_that_slips_beside_an_effect_that_acts_is_no_level_of_it(slip_min):
    """The effect acts all the time, and the mount slips by 8 µm: the level of the candidate is right, that of Y not."""
    slip = 12 * 60 + slip_min
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
    steps = run(loop, machine(37 * 60, more=lambda i: 8.0 * (i >= slip)))
    error = errors(steps)[-300:] - 8.0
    assert abs(np.mean(error)) < 4.0


def test_a_slip_that_is_seen_some_blocks_late_is_no_level_either():
    """Three of its blocks were among those before, in which the candidate then was the worse one: 8 µm in `ok`."""
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
    steps = run(loop, from_noon(NIGHT + 13 * 60, more=lambda i: 8.0 * (i >= 7 * 60)))
    assert loop.phase == "proposed" and "adopt" not in [step for _, step, _ in decisions(steps)]


def test_a_level_that_contradicts_measured_y_is_left_to_a_person_and_stays_as_it_is():
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
    samples = from_noon(NIGHT + 25 * 60, begun, more=crept, change=warm_at_first)
    steps = run(loop, samples, NIGHT + 15 * 60)
    assert loop.phase == "proposed" and "adopt" not in [step for _, step, _ in decisions(steps)]
    loop.accept()
    agreed = len(steps)
    steps += run(loop, samples)
    assert [(step, why) for seq, step, why in decisions(steps) if seq == agreed] == [("adopt", "by_hand")]
    error = errors(steps)
    before, after = error[agreed - 720 : agreed], error[agreed + 30 :]
    # 3 µm/K times 4 K would be 12 µm.
    assert abs(np.mean(after)) < abs(np.mean(before)) + 1.0
    assert np.std(after) < 0.5 * np.std(before)


def test_what_moved_y_before_a_zero_moves_nothing_about_it():
    """A diagnosis says that a mount was knocked; a zero takes that away, and Y shows the level again."""
    knocked = dataclasses.replace(shown(extended()), y_moved_utc_ns=LATER_NS)
    loop = OfflineLoop(settings(), QUILL_FILE, Night(knocked))
    samples = evening(5 * 60)
    run(loop, samples, 4 * 60 + 10)
    assert loop._core.state.y_moved_ns > 0
    loop.compensation.zero("warm")
    run(loop, samples, 2)
    assert loop._core.state.y_moved_ns == 0


def test_such_a_candidate_is_adopted_after_a_zero():
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
    samples = from_noon(NIGHT + 35 * 60, begun, more=crept, change=warm_at_first)
    steps = run(loop, samples, NIGHT + 16 * 60)
    assert loop.phase == "proposed"
    loop.compensation.zero("warm")
    zero = len(steps)
    steps += run(loop, samples)
    (adopted,) = [seq for seq, step, _ in decisions(steps) if step == "adopt"]
    assert adopted - zero < 18 * 60
    # The error about the zero is what remains of the effect.
    assert np.sqrt(np.mean((errors(steps)[adopted + 60 :] - np.mean(errors(steps)[zero + 1 : zero + 30])) ** 2)) < 3.0


def test_what_is_better_about_a_zero_that_a_mount_has_crept_from_shows_no_level():
    """A diagnosis has named the drift: a candidate that follows it would be the better one about the zero, too."""
    found = dataclasses.replace(shown(extended()), y_moved_utc_ns=LATER_NS)
    samples = evening(3 * DAY)
    loop = OfflineLoop(settings(), QUILL_FILE, Night(found, shown(extended())))
    steps = run(loop, samples, 18 * 60)
    assert loop.phase == "proposed" and "adopt" not in [step for _, step, _ in decisions(steps)]
    loop.compensation.zero("warm")
    steps += run(loop, samples, 18 * 60)
    assert "adopt" in [step for _, step, _ in decisions(steps)]


def test_what_measured_y_did_before_the_last_zero_says_nothing_against_a_level_about_it():
    """A mount slipped, a person set a zero: diagnoses go on naming the slip for as long as it is on record."""
    samples = evening(3 * DAY)
    night = Night(shown(None, "adequate"), shown(extended()))
    loop = OfflineLoop(settings(), QUILL_FILE, night)
    steps = run(loop, samples, 120)
    slipped = steps[-1].outcome.sample.time_utc_ns
    night.found[1] = dataclasses.replace(night.found[1], y_moved_utc_ns=slipped)
    loop.compensation.zero("warm")
    steps += run(loop, samples, 2 * DAY - 300)
    assert "adopt" in [step for _, step, _ in decisions(steps)]


@pytest.mark.parametrize(("own_um", "other_um", "raised_um"), [(5.0, -5.2, 0.0), (4.0, 9.0, 5.0), (4.9, 5.1, 0.0)])
def test_the_way_back_keeps_the_level_of_its_zero_unless_the_present_one_is_clearly_nearer(own_um, other_um, raised_um):
    blocks = [Block(0, n, 30, (0.0, 0.0), (own_um + 0.3 * (n % 2), other_um + 0.1 * (n % 2), 0.0)) for n in range(20)]
    verdict = msgspec.structs.replace(NO_VERDICT, verdict=ComparisonVerdict.BETTER, y_moved=True)
    place = InShadow(sha256="b" * 64, effects=[], role="before", since_utc_ns=1, verdict=verdict)
    place.comparison = ComparisonState(blocks=blocks)
    found = Compared(place, settings().loop, 60.0, ErrorBlocks())
    assert found.level_at_return_um == pytest.approx(raised_um, abs=0.2)


@pytest.mark.parametrize(
    ("own_um", "other_um", "kept_um", "level_um"),
    [
        (10.0, 12.0, 12.0, 12.0),
        (10.0, 1.0, 12.0, 0.0),
        (10.0, 3.0, 4.0, 4.0),  # both are better: the one that is nearer by far
        (10.0, 3.0, 4.9, 0.0),  # nearer by little
        (10.0, 21.0, 12.0, None),  # neither is
    ],
)
def test_the_level_of_newer_parameters_is_their_own_or_that_of_the_present_ones(own_um, other_um, kept_um, level_um):
    blocks = [Block(0, n, 30, (0.0, 0.0), (own_um, other_um + 0.1 * (n % 2), 0.0)) for n in range(9)]
    changes = {"present_rms_um": own_um, "candidate_rms_um": other_um, "measured_by": "sensor"}
    verdict = msgspec.structs.replace(NO_VERDICT, **changes)
    place = InShadow(sha256="b" * 64, effects=[], role="candidate", since_utc_ns=1, verdict=verdict)
    place.comparison, place.kept_level_um = ComparisonState(blocks=blocks), kept_um
    assert Compared(place, settings().loop, 60.0, ErrorBlocks(), same=True).level_um == level_um
    place.comparison = ComparisonState()  # of probes, by which both models are corrected
    probed = msgspec.structs.replace(verdict, measured_by="probe", candidate_rms_um=0.9 * own_um)
    place.verdict, at_zero = probed, Compared(place, settings().loop, 60.0, ErrorBlocks(), same=True)
    assert at_zero.level_um == at_zero.level_at_return_um == 0.0
    place.verdict = verdict
    place.comparison = ComparisonState(blocks=blocks[:7])  # less than four hours do not show that of the present ones
    assert Compared(place, settings().loop, 60.0, ErrorBlocks(), same=True).level_um == (None if level_um else level_um)


@pytest.mark.parametrize(
    ("later", "every_h", "record_h", "is_adopted"),
    [
        (shown(extended(2.9)), 12, 36, True),
        (shown(extended(2.9), "partly_explained"), 12, 36, True),
        (DataError("no result"), 12, 36, False),
        (shown(extended(2.9)), 24, 24, False),  # its record begins where Y has moved
    ],
)
def test_a_diagnosis_that_sees_the_time_and_finds_no_move_of_y_refutes_one(later, every_h, record_h, is_adopted):
    """The beginning of an effect was called a drift; half a day later the record is explained without one."""
    drifted = dataclasses.replace(shown(extended()), y_moved_utc_ns=LATER_NS)
    loop = OfflineLoop(
        settings(loop={"every_h": every_h, "record_h": record_h}), QUILL_FILE, Night(drifted, *[later] * 9)
    )
    steps = run(loop, machine(3 * DAY), 2 * DAY)
    assert ("adopt" in [step for _, step, _ in decisions(steps)]) == is_adopted


def test_the_present_model_without_an_effect_refutes_no_move_of_y():
    """Nothing was diagnosed then."""
    hour_ns, now_ns = 3600 * 10**9, 500_000 * 3600 * 10**9
    moved_ns = now_ns - 18 * hour_ns
    for without, remains_ns in (("gain:DTF", moved_ns), ("", 0)):
        state = LoopState(zero_utc_ns=now_ns - 30 * hour_ns, y_moved_ns=moved_ns, time_utc_ns=now_ns)
        state.diagnosis = Running(from_utc_ns=now_ns - 36 * hour_ns, to_utc_ns=now_ns, why="misfit", without=without)
        loop = decisions_module.LoopDecisions(LoopSettings(), 60.0, ["gain:DTF"], state)
        loop.receive(without_candidate(Diagnosed("", (), None, "", without=without)), now_ns)
        assert state.y_moved_ns == remains_ns


def test_newer_parameters_of_the_present_effects_show_no_level():
    """What begins then is none of them: a mount that slips is no reason to raise their level."""
    present, other = ([(n, 0.2 * (n % 2) if n < 12 else 9.0 + k * (n % 2)) for n in range(40)] for k in (1.0, 0.2))
    other = [(n, 6.0 * (n % 2) if n < 12 else left) for n, left in other]
    place = InShadow(sha256="b" * 64, effects=["gain:DTF"], role="candidate", since_utc_ns=1)
    place.error = ErrorBlocks(blocks=other)
    shown_um = [
        Compared(place, settings().loop, 60.0, ErrorBlocks(blocks=present), same=same).shown_level_um
        for same in (False, True)
    ]
    assert shown_um[0] == pytest.approx(9.1, abs=0.2) and shown_um[1] is None


@pytest.mark.parametrize(
    ("off_at_zero", "zero_channels", "y_moved", "rms_um", "level_um"),
    [
        (["spindle_rpm"], ["spindle_rpm", "fan_rpm"], False, 3.9, 0.0),
        (["spindle_rpm"], ["spindle_rpm"], False, 4.1, None),  # measured Y contradicts it
        (["spindle_rpm"], ["spindle_rpm"], True, 7.9, 0.0),  # a mount has slipped
        (["spindle_rpm"], ["spindle_rpm"], True, 8.1, None),
        ([], [], False, 3.9, 0.0),  # a path of the heat
        (["spindle_rpm"], ["fan_rpm"], False, 3.9, None),  # it turned at the zero
        (["spindle_rpm"], None, False, 3.9, None),  # a zero on a warm machine
        (["spindle_rpm"], ["spindle_rpm"], False, 1.9, 6.0),  # its own misfit, at the level that measured Y shows
        (None, ["spindle_rpm"], False, 3.9, None),
    ],
)
def test_what_adds_nothing_at_rest_has_the_level_of_a_zero_at_rest(
    off_at_zero, zero_channels, y_moved, rms_um, level_um
):
    verdict = msgspec.structs.replace(NO_VERDICT, present_rms_um=4.0, candidate_rms_um=rms_um, measured_by="sensor")
    place = InShadow(sha256="b" * 64, effects=["input:spindle_rpm"], role="candidate", since_utc_ns=1, verdict=verdict)
    place.off_at_zero = off_at_zero
    began = [(n, 0.1 * (n % 2) if n < 12 else 7.0 + n % 2) for n in range(40)]
    place.error = ErrorBlocks(blocks=[(n, 6.0 * (n % 2) if n < 12 else 6.0) for n in range(40)])
    present = ErrorBlocks(blocks=began if level_um else [])
    found = Compared(place, settings().loop, 60.0, present, y_moved=y_moved, zero_channels=zero_channels)
    assert found.level_um == level_um
    newer = Compared(place, settings().loop, 60.0, present, y_moved=y_moved, zero_channels=zero_channels, same=True)
    assert newer.level_um == (0.0 if rms_um <= 0.8 * 4.0 and not y_moved else None)


def test_channels_that_read_0_at_a_zero_at_rest_are_known(tmp_path):
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
    steps = run(loop, machine(600, change=lambda i, values: values.update(coolant_degc=0.0 if i < 300 else 20.0)), 200)
    at_rest = next(step for step in steps if any(note.kind == "zero" for note in step.outcome.notes))
    assert channels_at_zero(at_rest.outcome) == ["coolant_degc"] == loop._core.state.zero_channels
    loop.compensation.zero("warm")
    run(loop, machine(600), 2)
    assert loop._core.state.zero_channels is None


@pytest.mark.parametrize(
    ("own_um", "other_um", "blocks", "before_um", "is_right"),
    [
        (20.0, 1.0, 8, None, True),
        (20.0, 1.0, 7, None, False),
        (20.0, 3.0, 8, None, False),
        (0.1, 0.1, 8, None, False),
        (20.0, 1.0, 8, 9.0, True),
        (20.0, 1.0, 8, 19.0, False),  # it was as wrong before, so nothing has ended
    ],
)
def test_a_way_back_that_alone_is_right_about_the_zero_is_gone_back_to(own_um, other_um, blocks, before_um, is_right):
    """An effect has ended on a machine at rest: nothing changes any longer that could show it."""
    before = ErrorBlocks(blocks=[(n, before_um) for n in range(-20, blocks) if before_um is not None])
    means = [(own_um + 0.1 * (n % 2), other_um, 0.01 * n) for n in range(blocks)]
    place = InShadow(sha256="b" * 64, effects=[], role="before", since_utc_ns=1)
    place.comparison = ComparisonState(blocks=[Block(0, n, 30, (0.0, 0.0), one) for n, one in enumerate(means)])
    found = Compared(place, settings().loop, 60.0, before)
    assert found.is_better_to_go_back_to(is_new=False) is is_right


@pytest.mark.parametrize(
    ("other_um", "same", "y_moved", "is_better"),
    [(0.1, True, False, True), (0.4, True, False, False), (0.1, False, False, False), (0.1, True, True, False)],
)
def test_newer_parameters_that_alone_are_right_about_the_zero_are_better(other_um, same, y_moved, is_better):
    """The present ones leave nearly a constant, which changes do not show."""
    means = [(2.4 + 0.1 * (n % 2), other_um, 0.01 * n) for n in range(30)]
    place = InShadow(sha256="b" * 64, effects=["gain:DTF"], role="candidate", since_utc_ns=1)
    place.comparison = ComparisonState(blocks=[Block(0, n, 30, (0.0, 0.0), one) for n, one in enumerate(means)])
    present = ErrorBlocks(blocks=[(n, 2.4) for n in range(-20, 30)])
    found = Compared(place, settings().loop, 60.0, present, same=same, y_moved=y_moved)
    assert found.is_better(30 * BLOCK_NS) is is_better


def test_what_was_found_and_compared_while_a_temperature_was_wrong_goes(monkeypatch):
    wrong = 4 * 60 + 400
    monkeypatch.setattr(decisions_module, "was_wrong", lambda outcome: outcome.sample.seq == wrong)
    loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended()), shown(None, "adequate")))
    steps = run(loop, evening(4 * 60 + 15 * 60))
    found = [(seq, step, why) for seq, step, why in decisions(steps) if step in ("shadow", "end", "adopt")]
    assert [step for _, step, _ in found] == ["shadow", "end"] and found[1][::2] == (wrong, "was_wrong")


class WarmAtFirst(Looping):
    """A machine whose coolant is 4 K warmer at the zero, while it does not act, than later; and its mount creeps."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        acted_from = self.device.sources[3]
        self.device.sources[3] = lambda: acted_from() + (4.0 if self.minute() < 2 * BEGAN else 0.0)
        measured = self.device.sources[2]
        self.device.sources[2] = lambda: measured() + crept(self.minute() // 2)


@pytest.fixture(scope="module")
def adopted(tmp_path_factory):
    """A service in which a person has adopted a candidate whose level contradicts measured Y."""
    service = WarmAtFirst(tmp_path_factory.mktemp("level"), shown(extended()), acts=begun, before_night=NIGHT)

    async def adopts():
        await service.run(2400, until=in_phase(service, "proposed"))
        service.at_sample[len(service.outcomes) + 30] = Asked(service, "adopt", candidate=True)
        await service.run(120, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
        await service.run(30)

    asyncio.run(adopts())
    return service


def decision_of(service):
    return next(event for event in service.events("loop") if event.data["step"] == "adopt")


def test_a_replay_comes_to_the_same_level(adopted):
    level_um = decision_of(adopted).data["level_um"]
    assert level_um == pytest.approx(-12.0, abs=3.0) or level_um == pytest.approx(12.0, abs=3.0)  # 3 µm/K times 4 K
    assert adopted.events("adopt")[-1].data["level_um"] == level_um
    assert abs(adopted.events("adopt")[-1].data["difference_um"]) < 7.0  # what the effect itself makes
    checked(adopted)


def test_a_replay_sees_a_level_that_was_changed(adopted):
    files = recordings(adopted.recordings, MACHINE)
    written = b'"level_um":%s' % json.dumps(decision_of(adopted).data["level_um"]).encode()
    deciding = [path for path in files if opening_of(path).get("candidate.toml") == extended()][-1]
    assert replayed(deciding, lambda group: group) is None
    assert replayed(deciding, changed("event", written, b'"level_um":0.0')).topic == "event"
    # In the state with which the recording of the adopted model begins.
    result = RecordingAudit(file=files[-1].name, size=0)
    with Container(files[-1]) as container:
        contents = container.survey(whole=False)
        state = json.loads(contents.attachments["state.json"].data)
        state["zero"]["y_base"] += 0.5
        part = dataclasses.replace(contents.attachments["state.json"], data=json.dumps(state).encode())
        check = ReplayCheck(
            dataclasses.replace(contents, attachments=contents.attachments | {"state.json": part}), result
        )
        for records, _, whole in groups_of(container):
            if whole and records:
                check.check(records)
    assert result.difference is not None and result.difference.topic == "estimate"


@pytest.mark.parametrize(
    ("first", "second", "goes_on"),
    [
        (lambda n: 6.0, lambda n: 6.3, True),
        (lambda n: 6.0, lambda n: 0.5 * n, False),
        (lambda n: 0.5 * n, lambda n: 6.0, False),  # it knew these hours, and may explain a mount that creeps
    ],
)
def test_what_was_shown_of_the_level_goes_on_with_other_parameters_that_leave_a_constant_too(first, second, goes_on):
    begins, since, now, until = 12, 20, 32, 41

    def errors_of(left):
        return ErrorBlocks(blocks=[(n, 6.0 * (n % 2) if n < begins else left(n)) for n in range(now)])

    present = ErrorBlocks(blocks=[(n, 0.1 * (n % 2) if n < begins else 7.0 + n % 2) for n in range(until)])
    before, after = (
        InShadow(sha256=sha, effects=["delay:DTF"], role="candidate", since_utc_ns=at * BLOCK_NS, error=errors_of(left))
        for sha, at, left in (("a", since, first), ("b", now, second))
    )
    compared = Compared(after, LoopSettings(), 60.0, present)
    compared.go_on_with(before, now * BLOCK_NS)
    assert after.level_utc_ns == (since * BLOCK_NS if goes_on else 0)
    assert compared.shown_level_um == (6.3 if goes_on else None)
    # Else it must stay in hours of its own.
    after.error.blocks += [(n, 6.3) for n in range(now, until)]
    assert compared.shown_level_um == 6.3


def test_that_an_effect_began_is_seen_in_what_older_parameters_left_before_the_record_of_the_newer_ones():
    """A stop over a weekend: the record of the newer ones begins after it, and the effect began before it."""
    begins, stops, goes_on, until = 12, 24, 100, 130
    times = [*range(stops), *range(goes_on, until)]
    present = ErrorBlocks(blocks=[(n, 0.1 * (n % 2) if n < begins else 7.0 + n % 2) for n in times])
    left = [(n, 6.0 * (n % 2) if n < begins else 6.0) for n in times]
    before = InShadow(sha256="a", effects=["delay:DTF"], role="candidate", since_utc_ns=stops * BLOCK_NS)
    before.error = ErrorBlocks(blocks=left[: -until + goes_on + 10])
    now = goes_on + 10
    after = InShadow(sha256="b", effects=["delay:DTF"], role="candidate", since_utc_ns=now * BLOCK_NS)
    after.error = ErrorBlocks(blocks=[one for one in left if goes_on <= one[0]])
    compared = Compared(after, LoopSettings(), 60.0, present)
    assert compared.shown_level_um is None
    compared.go_on_with(before, now * BLOCK_NS)
    assert compared.shown_level_um == 6.0


def kept(service, folder, last):
    """Copy the last recordings of a service."""
    folder.mkdir()
    for path in recordings(service.recordings, MACHINE)[-last:]:
        shutil.copy(path, folder)
    return folder


@pytest.mark.parametrize("last", [99, 1])
def test_a_warm_up_of_the_adopted_model_has_its_level_and_no_other_model_has_it(adopted, tmp_path, last):
    """As at a restart with another configuration; also where the zero is not on record any longer."""
    folder, level_um = kept(adopted, tmp_path / "kept", last), adopted.events("adopt")[-1].data["level_um"]
    own, other = (
        warm_up(folder, adopted.config, parse_model(data, source="test")).compensation
        for data in (extended(), QUILL_FILE)
    )
    estimate = adopted.outcomes[-1].estimate
    assert own.level_um == estimate.level_um == level_um and other.level_um == 0.0
    zero = own.status.zero
    assert zero is not None and zero.y_base_um == pytest.approx(0.0, abs=1e-9)
    assert other.status.zero is not None and other.status.zero.y_base_um == pytest.approx(0.0, abs=1e-9)
    if last > 1:
        assert own.status.target_um == pytest.approx(-estimate.y_pred_um, abs=0.2)


def test_by_how_much_the_offset_would_move_counts_from_the_level_of_the_present_model(adopted):
    models = [parse_model(data, source="test") for data in (extended(), QUILL_FILE)]
    found = second_opinion(adopted.recordings, adopted.config, *models)
    present_um, before_um = adopted.outcomes[-1].estimate.y_pred_um, adopted.candidates()[-1].y_pred_um
    assert found.offset_change_um == pytest.approx(present_um - before_um, abs=0.5)
