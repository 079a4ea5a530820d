"""A channel that comes back from a jump: where it comes to rest, and what one wrong sample after a gap leaves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from compensator.messages import Event
from compensator.service.compensation import Compensation
from compensator.service.replay import RecordedStep
from compensator.service.state import decode_state
from compensator.service.transfer.warm_up import RecordedRun
from tests.service.jumping import BEGIN, END, is_wrong_in_ok, readings, run, settings, steps, working_day
from tests.service.records import QUILL, sample

#: Long enough for what is asked about to be decided.
LATER = END + 120


@pytest.fixture(scope="module")
def day() -> dict[str, np.ndarray]:
    return working_day()


@pytest.mark.parametrize(
    ("name", "size", "on_the_way", "rest"),
    [("at_degc", 8.0, (0.0,), 1.5), ("at_degc", 8.0, (0.9, 1.8), 2.6), ("t_q_degc", 9.0, (0.0,), 1.7)],
)
def test_what_is_left_of_a_jump_is_where_the_channel_comes_to_rest(
    day: dict[str, np.ndarray], name: str, size: float, on_the_way: tuple[float, ...], rest: float
) -> None:
    """One sample on the way is not the rest: a couple that is pushed in slowly."""
    way = [(BEGIN + 30 + i, name, k) for i, k in enumerate((*on_the_way, rest))]
    outcomes = run(day, steps((BEGIN, name, size), *way))
    assert not is_wrong_in_ok(outcomes)
    asked = {f"suspect_channel:{name}", f"unconfirmed_channel:{name}"}
    assert all(asked & set(map(str, o.offset.reasons)) for o in outcomes[BEGIN:END])


@pytest.mark.parametrize("name", ["t_q_degc", "at_degc"])
@pytest.mark.parametrize("size", [1.3, -2.0, 3.0])
def test_one_wrong_sample_after_some_without_the_channel_is_forgotten(
    day: dict[str, np.ndarray], name: str, size: float
) -> None:
    outcomes = run(day, steps((BEGIN, name, math.nan), (BEGIN + 3, name, size), (BEGIN + 4, name, 0.0)))
    assert f"unconfirmed_channel:{name}" in outcomes[BEGIN + 3].offset.reasons
    assert not is_wrong_in_ok(outcomes)
    asked = {f"suspect_channel:{name}", f"unconfirmed_channel:{name}"}
    assert not any(asked & set(map(str, o.offset.reasons)) for o in outcomes[LATER:])


@pytest.mark.parametrize(("begin", "air", "size"), [(306, -1.26, 2.4), (305, 1.89, -2.67)])
def test_a_door_does_not_hide_a_jump_of_t_q_that_nobody_saw(
    day: dict[str, np.ndarray], begin: int, air: float, size: float
) -> None:
    """The engine that believes the air explains a T_Q that is wrong by heat; the other one does not."""
    outcomes = run(
        day,
        steps(
            (begin, "at_degc", air),
            (begin + 1, "t_q_degc", math.nan),
            (begin + 7, "t_q_degc", size),
            (begin + 8, "at_degc", 0.0),
        ),
    )
    assert not is_wrong_in_ok(outcomes)
    asked = {"suspect_channel:t_q_degc", "unconfirmed_channel:t_q_degc"}
    assert all(asked & set(map(str, o.offset.reasons)) for o in outcomes[begin + 7 : END])


def test_jumps_of_yesterday_make_no_loose_contact_after_a_night(day: dict[str, np.ndarray]) -> None:
    compensation = Compensation(settings(), QUILL)
    change = steps((BEGIN, "t_q_degc", 8.0), (BEGIN + 5, "t_q_degc", 0.0))
    for i in range(BEGIN + 20):
        values = readings(day, i)
        change(i, values)
        compensation.process(sample(i, values))

    def quiet() -> dict[str, int]:
        jumps = decode_state(compensation.state()).jumps
        assert jumps is not None
        return jumps.quiet

    before = quiet()["t_q_degc"]
    compensation.pause(30)
    assert quiet() == {"t_q_degc": before + 30}
    compensation.pause(600)
    assert quiet() == {}


def test_what_a_person_has_confirmed_another_model_does_not_ask_about(day: dict[str, np.ndarray]) -> None:
    """A warm-up, and the comparison before an adoption, get the person's `resume` from the record."""
    conf = settings()
    run_again = RecordedRun(conf, Compensation(conf, QUILL))
    asked = []
    for i in range(200, BEGIN + 60):
        values = readings(day, i) | {"y_um": math.nan}
        values["t_q_degc"] += 6.0 if i >= BEGIN else 0.0
        raw = sample(i, values)
        resume = Event(
            schema=1,
            machine=raw.machine,
            seq=i,
            time_utc_ns=raw.time_utc_ns,
            kind="command",
            text="resume",
            data={"command": "resume"},
        )
        events = [resume] if i == BEGIN + 30 else []
        step = RecordedStep(file="a.mcap", run={"file": "a.mcap"}, records={}, events=events, sample=raw)
        outcome = run_again.process(step)
        assert outcome is not None
        asked.append("suspect_channel:t_q_degc" in outcome.offset.reasons)
    assert asked == [BEGIN <= i < BEGIN + 30 for i in range(200, BEGIN + 60)]
