"""A candidate is at the level that it would have if it had run since the zero, however short the record is."""

from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.codes import Reason
from compensator.model.model_file import parse_model
from compensator.service.compensation import Compensation
from compensator.service.loop.run import OfflineLoop, warmed_on
from compensator.service.outcome import Outcome, sets_zero_at_rest
from compensator.service.transfer.shadow import Shadow
from tests.service.looping import QUILL_FILE, Night, evening, extended, machine, settings, shown, stronger

RECORD = 1400


def raised(i: int, values: dict[str, float]) -> None:
    """The coolant is 4 K warmer after six hours than it was at the zero."""
    values["coolant_degc"] += 4.0 if i > 360 else 0.0


def outcomes(samples: int, **changes: Any) -> list[Outcome]:
    present = Compensation(settings(), parse_model(extended(0.5), source="present"))
    return [present.process(one) for one in machine(samples, change=raised, **changes)]


@pytest.fixture(scope="module")
def record() -> list[Outcome]:
    return outcomes(2400)


def predicted(compensation: Compensation) -> float:
    return -compensation.status.target_um


def test_a_candidate_counts_its_channel_from_the_zero_at_rest_before_the_record(record: list[Outcome]) -> None:
    model = parse_model(extended(3.0), source="candidate")
    (at_rest,) = [outcome for outcome in record if sets_zero_at_rest(outcome)]
    whole = warmed_on(settings(), model, record)
    short = warmed_on(settings(), model, record[-RECORD:], at_rest)
    assert predicted(short) == pytest.approx(predicted(whole), abs=0.3)
    assert short.status.is_known
    # Without the zero its level is another one: the effect then counts from where the record happens to begin.
    assert abs(predicted(warmed_on(settings(), model, record[-RECORD:])) - predicted(whole)) > 3.0


def test_a_pause_in_the_record_counts(record: list[Outcome]) -> None:
    model = parse_model(extended(3.0), source="candidate")
    gap = [outcome for outcome in record if not 2200 <= outcome.sample.seq < 2300]
    paused = warmed_on(settings(), model, gap)
    by_hand = Compensation(settings(), model)
    for outcome in gap:
        if outcome.sample.seq == 2300:
            by_hand.pause(100)
        by_hand.process(outcome.sample)
    assert predicted(paused) == pytest.approx(predicted(by_hand), abs=1e-9)
    squeezed = [
        msgspec.structs.replace(outcome, sample=_moved(outcome.sample, i), estimate=outcome.estimate)
        for i, outcome in enumerate(gap)
    ]
    assert not np.isclose(predicted(warmed_on(settings(), model, squeezed)), predicted(paused), atol=1e-6)


def _moved(sample: Any, i: int) -> Any:
    """The sample as if no other one were missing before it."""
    start_ns = sample.time_utc_ns - sample.seq * 60_000_000_000
    return msgspec.structs.replace(sample, seq=i, time_utc_ns=start_ns + i * 60_000_000_000)


@pytest.mark.parametrize("hours", [3, -1])
def test_a_clock_that_was_set_is_no_pause(record: list[Outcome], hours: int) -> None:
    model = parse_model(extended(3.0), source="candidate")
    later_ns = hours * 3600 * 10**9
    changed = [
        msgspec.structs.replace(
            one, sample=msgspec.structs.replace(one.sample, time_utc_ns=one.sample.time_utc_ns + later_ns)
        )
        if one.sample.seq > 2390
        else one
        for one in record
    ]
    assert predicted(warmed_on(settings(), model, changed)) == predicted(warmed_on(settings(), model, record))


@pytest.mark.parametrize("kills", [False, True])
def test_a_restart_in_the_record_counts_although_numbers_go_on(kills: bool) -> None:
    """A service that stands still leaves numbers out, one that was off does not; both are told of by `pause`."""

    def first_prediction(left_out: int) -> float:
        loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
        for one in evening(1000):
            if 50 <= one.seq < 150:
                continue
            if one.seq == 150:
                loop.pause(100)
            if one.seq == 200 and kills:
                state = loop.state()
                loop = OfflineLoop(settings(), QUILL_FILE, Night(shown(extended())))
                loop.restore(state)
            number = one.seq if one.seq < 150 else one.seq - 100 + left_out
            if candidates := loop.process(msgspec.structs.replace(one, seq=number)).candidates:
                return candidates[0].y_pred_um
        raise AssertionError("no candidate")

    assert first_prediction(0) == first_prediction(100)


def test_what_a_person_has_seen_to_before_the_candidate_is_no_fault_of_it() -> None:
    """T_Q and AT were exchanged, and put right: the present model goes on, and so does a candidate on that record."""
    guarded = settings(plausibility={"t_q_below_at_after_min": 30.0}, guards={"t_q_below_at_max_k": 2.0})

    def exchanged(i: int, values: dict[str, float]) -> None:
        if 400 <= i < 600:
            values["t_q_degc"], values["at_degc"] = values["at_degc"], values["t_q_degc"]

    present = Compensation(guarded, parse_model(extended(0.5), source="present"))
    record = list[Outcome]()
    for one in machine(1200, change=exchanged):
        if one.seq == 620:
            present.resume()
        record.append(present.process(one))
    assert Reason.T_Q_AT_EXCHANGED in record[610].offset.reasons
    assert Reason.T_Q_AT_EXCHANGED not in record[-1].offset.reasons
    shadow = Shadow(warmed_on(guarded, parse_model(extended(3.0), source="candidate"), record[:-1]), b"")
    assert Reason.T_Q_AT_EXCHANGED not in shadow.process(record[-1])[1].offset.reasons
    # While the present one waits for a person, the candidate does, too.
    early = Shadow(warmed_on(guarded, parse_model(extended(3.0), source="candidate"), record[:610]), b"")
    assert Reason.T_Q_AT_EXCHANGED in early.process(record[610])[1].offset.reasons
    # What was fed with exchanged couples is unknown under both.
    assert not present.status.is_known and not shadow.compensation.status.is_known


def test_wires_that_measured_y_has_shown_to_be_right_are_so_for_every_model() -> None:
    """The present model's state is believed from there on, and so is a candidate's whose own Y does not show it."""
    checks = {"t_q_below_at_after_min": 30.0, "false_alarm_days": 30.0, "residual_std_um": 2.0}
    guarded = settings(plausibility=checks, guards={"t_q_below_at_max_k": 2.0, "suspect_jumps": True})

    def exchanged(i: int, values: dict[str, float]) -> None:
        if 400 <= i < 600:
            values["t_q_degc"], values["at_degc"] = values["at_degc"], values["t_q_degc"]

    present = Compensation(guarded, parse_model(extended(3.0), source="present"))
    shadow = Shadow(Compensation(guarded, parse_model(stronger(1.0), source="candidate")), b"")
    latched = list[tuple[bool, bool]]()
    for one in machine(1200, change=exchanged):
        outcome = present.process(one)
        shadow.process(outcome)
        latched.append((present.plausibility.exchanged, shadow.compensation.plausibility.exchanged))
    assert any(own and other for own, other in latched) and not any(latched[-1])
    assert present.status.is_known and shadow.compensation.status.is_known
