"""The loop over simulated days: what it adopts, what it goes back from, and what it leaves alone."""

from __future__ import annotations

import numpy as np

from compensator.events import EventKind
from compensator.service.loop.run import LoopRun
from compensator.service.transfer.model_store import sha256_of
from tests.service.looping import DAY, Night, decisions, errors, extended, machine, run, settings, shown
from tests.service.test_restart import QUILL

#: Samples are counted from 6 o'clock; the first night is 20 h later.
NIGHT = 20 * 60


def test_an_effect_is_found_at_night_shadowed_and_adopted_without_a_jump() -> None:
    night = Night(shown(extended()))
    loop = LoopRun(settings(), QUILL, night)
    steps = run(loop, machine(2 * DAY))
    found = decisions(steps)
    assert [step for _, step, _ in found[:3]] == ["diagnose", "shadow", "adopt"]
    adopted = found[2][0]
    assert 12 * 60 <= adopted - found[0][0] <= 14 * 60
    assert loop.effects == ("input:coolant_degc",) and loop.phase == "watching"
    assert {step.model_sha256 for step in steps[adopted + 1 :]} == {sha256_of(extended())}
    events = [note for step in steps for note in step.events if note.kind == EventKind.ADOPT]
    assert [(event.data["action"], event.data["by"]) for event in events] == [("adopt", "loop")]
    assert events[0].data["comparison"]["verdict"] == "better"
    left = errors(steps)
    assert np.std(left[adopted + 60 :]) < 0.3 * np.std(left[:adopted])
    offsets = np.array([step.outcome.offset.y_offset_um for step in steps[1:]])
    assert np.max(np.abs(np.diff(offsets))) <= 8.0 + 1e-9
    # The second night finds what is there already.
    assert ("nothing", "unchanged") in [decision[1:] for decision in found[3:]]
    assert all(model == QUILL for _, model in night.asked)
