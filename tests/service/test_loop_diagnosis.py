"""The diagnosis of the loop on records in which an effect began, and in which nothing but the mount moved."""

from __future__ import annotations

import numpy as np
import pytest

import compensator.api.loop as api
from compensator.api.diagnosis import DiagnosisResult
from compensator.api.loop import _diagnosed, diagnoses_of_table, diagnosis_of_record
from compensator.data.table import Table
from compensator.model.thermal_model import ThermalModel
from compensator.service.loop.record import usable_table
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


def test_what_is_after_the_change_of_the_residual_is_diagnosed_again_and_ends_of_it_until_they_are_too_short(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop = LoopRun(settings(), QUILL, Night(shown(None, "adequate")))
    begins, spans = 1200, list[float]()
    table = usable_table([step.outcome for step in run(loop, machine(2160, acts=lambda i: float(i > begins)))])

    def counted(table: Table, base: ThermalModel, probe_std_um: float | None) -> DiagnosisResult:
        spans.append(float(np.ptp(table.t_s)) / 60.0)
        return _diagnosed(table, base, probe_std_um)

    monkeypatch.setattr(api, "_diagnosed", counted)
    monkeypatch.setattr(api, "WELL_EXPLAINED", 0.0)
    diagnoses_of_table(table, QUILL)
    assert spans[1] == pytest.approx(2160 - begins, abs=120)
    assert spans == sorted(spans, reverse=True) and spans[-1] == 60.0 * api.SHORTEST_H
