"""T_Q and AT exchanged on a warm machine, and put back: by plugs, wires or addresses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from compensator.errors import DataError
from compensator.service.compensation import Compensation, Outcome
from compensator.service.state import decode_state, frozen_state
from tests.service.jumping import (
    BEGIN,
    END,
    Change,
    events,
    is_wrong_in_ok,
    offsets,
    readings,
    run,
    settings,
    undisturbed,
    working_day,
)
from tests.service.records import QUILL, sample

NAMES = ("t_q_degc", "at_degc")
#: Once they are back: three samples for that, and the way of the offset.
BACK = 15


@pytest.fixture(scope="module")
def day() -> dict[str, np.ndarray]:
    return working_day()


def exchanged(*, begin: int = BEGIN, end: int = END, share: float = 1.0, open_for: int = 0) -> Change:
    """They are exchanged while a part of the first sample is left, and put back; or both are open before and after."""

    def change(i: int, values: dict[str, float]) -> None:
        t_q, at = (values[name] for name in NAMES)
        part = share if i == begin else 1.0 - share if i == end else float(begin < i < end)
        values["t_q_degc"], values["at_degc"] = t_q + part * (at - t_q), at + part * (t_q - at)
        if begin - open_for <= i < begin or end <= i < end + open_for:
            values["t_q_degc"] = values["at_degc"] = math.nan

    return change


def texts(outcomes: list[Outcome]) -> list[str]:
    return [text for o in outcomes for kind, text, _ in o.notes if kind == "plausibility"]


@pytest.mark.parametrize("share", [1.0, 0.3, 0.8])
@pytest.mark.parametrize("y", [False, True])
def test_once_they_are_back_the_offset_is_right_at_once(day: dict[str, np.ndarray], share: float, y: bool) -> None:
    outcomes = run(day, exchanged(share=share), y=y)
    assert all(o.offset.state in ("hold", "fault", "degraded") for o in outcomes[BEGIN + 1 : END])
    assert all("t_q_at_exchanged" in o.offset.reasons for o in outcomes[BEGIN + 20 : END])
    assert sum("exchanged plugs, wires or addresses" in text for text in texts(outcomes)) == 2
    assert not is_wrong_in_ok(outcomes)
    right = slice(END + BACK, None)
    assert np.max(np.abs(offsets(outcomes) - undisturbed())[right]) < 1.0
    assert {o.offset.state for o in outcomes[right]} == {"ok"}
    assert len(events(outcomes, "accepted")) == 2


@pytest.mark.parametrize("open_for", [2, 5, 20])
def test_both_are_open_while_the_plugs_are_changed(day: dict[str, np.ndarray], open_for: int) -> None:
    outcomes = run(day, exchanged(open_for=open_for))
    assert not is_wrong_in_ok(outcomes)
    assert np.max(np.abs(offsets(outcomes) - undisturbed())[END + open_for + 20 :]) < 5.0


@pytest.mark.parametrize("end", [BEGIN + 40, BEGIN + 100, BEGIN + 240])
def test_heat_that_is_switched_meanwhile_is_in_the_state(day: dict[str, np.ndarray], end: int) -> None:
    """The shifted engine follows each channel by the other one, and not by what it read before."""
    outcomes = run(day, exchanged(end=end))
    assert np.max(np.abs(offsets(outcomes) - undisturbed())[end + BACK :]) < 1.0


@pytest.mark.parametrize("part", [0.6, 1.5])
def test_jumps_of_another_size_are_no_exchange(day: dict[str, np.ndarray], part: float) -> None:
    def change(i: int, values: dict[str, float]) -> None:
        if BEGIN <= i < END:
            apart = part * (day["t_q_degc"][BEGIN] - day["at_degc"][BEGIN])
            values["t_q_degc"] -= apart
            values["at_degc"] += apart

    outcomes = run(day, change)
    assert not any("exchanged plugs" in text for text in texts(outcomes))
    assert not is_wrong_in_ok(outcomes)


@pytest.mark.parametrize(
    ("channel", "size"), [("t_q_degc", -5.0), ("t_q_degc", 9.0), ("at_degc", 2.5), ("at_degc", -4.0)]
)
@pytest.mark.parametrize("after", [3, 60])
def test_a_couple_that_is_pulled_meanwhile_is_not_believed_to_be_back(
    day: dict[str, np.ndarray], channel: str, size: float, after: int
) -> None:
    """Its reading is not what is expected: an expectation that has become uncertain by that shows nothing."""
    swap = exchanged(end=BEGIN + 80)

    def change(i: int, values: dict[str, float]) -> None:
        values[channel] += size if i >= BEGIN + 80 - after else 0.0
        swap(i, values)

    outcomes = run(day, change)
    assert not is_wrong_in_ok(outcomes)
    asked = {f"{what}_channel:{channel}" for what in ("suspect", "unconfirmed")} | {"t_q_at_exchanged"}
    assert all(asked & set(map(str, o.offset.reasons)) for o in outcomes[BEGIN + 80 :])


@pytest.mark.parametrize("k", [-2.5, 1.5])
def test_a_door_meanwhile_changes_nothing(day: dict[str, np.ndarray], k: float) -> None:
    swap = exchanged()

    def change(i: int, values: dict[str, float]) -> None:
        values["at_degc"] += k if BEGIN + 40 <= i < BEGIN + 55 else 0.0
        swap(i, values)

    outcomes = run(day, change)
    assert np.max(np.abs(offsets(outcomes) - undisturbed())[END + BACK :]) < 5.0


def test_the_end_of_an_exchange_that_nobody_noticed_is_none(day: dict[str, np.ndarray]) -> None:
    """Exchanged on the cold machine: what the state holds is wrong, and a person must say that they are right now."""
    outcomes = run(day, exchanged(begin=1))
    assert not any("exchanged plugs" in text for text in texts(outcomes))
    assert all("t_q_at_exchanged" in o.offset.reasons for o in outcomes[END:])


def test_resume_while_they_are_exchanged_believes_them(day: dict[str, np.ndarray]) -> None:
    """A person's word counts, also where it is wrong; the way back is a jump then."""

    def act(i: int, compensation: Compensation) -> None:
        if i == BEGIN + 60:
            compensation.resume()

    outcomes = run(day, exchanged(), act)
    assert not any(name in o.offset.reasons for o in outcomes[BEGIN + 61 : BEGIN + 70] for name in ("suspect_channel",))
    assert any("suspect_channel:t_q_degc" in o.offset.reasons for o in outcomes[END : END + 3])


def test_a_restart_in_between_changes_nothing(day: dict[str, np.ndarray]) -> None:
    change, one = exchanged(share=0.4), Compensation(settings(), QUILL)
    found = []
    for i in range(END + 30):
        if i in (BEGIN + 1, BEGIN + 60, END + 1):
            state = one.state()
            one = Compensation(settings(), QUILL)
            one.restore(state)
        values = readings(day, i)
        change(i, values)
        values["y_um"] = math.nan
        found.append(one.process(sample(i, values)))
    assert [o.offset for o in found] == [o.offset for o in run(day, change)[: END + 30]]


def test_a_state_of_an_exchange_of_one_channel_is_refused(day: dict[str, np.ndarray]) -> None:
    one = Compensation(settings(), QUILL)
    for i in range(BEGIN + 5):
        values = readings(day, i)
        values["at_degc"] += 5.0 if i >= BEGIN else 0.0
        one.process(sample(i, values))
    state = decode_state(one.state())
    assert state.jumps is not None
    state.jumps.exchanged = "yes"
    with pytest.raises(DataError, match="one channel"):
        Compensation(settings(), QUILL).restore(frozen_state(state)())
