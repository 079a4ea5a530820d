"""The diagnosis of the loop on records in which an effect began, and in which nothing but the mount moved."""

from __future__ import annotations

from compensator.api.loop import diagnosis_of_record
from compensator.service.loop.run import LoopRun
from tests.service.looping import Night, machine, run, settings, shown
from tests.service.test_restart import QUILL


def test_an_effect_that_began_within_the_record_is_found_in_the_end_of_it() -> None:
    loop = LoopRun(settings(), QUILL, Night(shown(None, "adequate")))
    begins = 720
    steps = run(loop, machine(2160, acts=lambda i: float(i > begins)))
    found = diagnosis_of_record([step.outcome for step in steps], QUILL)
    assert found.model is not None and "coolant_degc" in " ".join(found.effects)


def test_a_mount_that_was_knocked_is_named_to_a_person_and_gives_no_candidate() -> None:
    loop = LoopRun(settings(), QUILL, Night(shown(None, "adequate")))
    steps = run(loop, machine(1200, acts=lambda i: 0.0, more=lambda i: 8.0 * (i > 800)))
    found = diagnosis_of_record([step.outcome for step in steps], QUILL)
    assert found.model is None and found.effects == () and "step" in found.needs
