"""The diagnosis of the loop on records in which an effect began, and in which nothing but the mount moved."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import compensator.api.loop_diagnosis as api
from compensator.api.diagnosis import DiagnosisResult
from compensator.api.loop_diagnosis import Part, _diagnosed, diagnoses_of_table, diagnosis_of_record
from compensator.clock import NS
from compensator.data.measurement import Measurement
from compensator.data.table import Table
from compensator.model.model_file import parse_model
from compensator.model.thermal_model import ThermalModel
from compensator.service.loop.record import usable_table
from compensator.service.loop.run import OfflineLoop
from compensator.service.outcome import Outcome
from tests.service.looping import Night, machine, run, settings, shown
from tests.service.test_restart import QUILL

#: Both tests of an effect that began within the record ask about the same one: it is searched once.
once = pytest.mark.usefixtures("equal_questions_once")
SAMPLES, BEGINS, KNOCKED = 1440, 480, 800


@pytest.fixture(scope="module")
def begun() -> list[Outcome]:
    """What a service has on record of a machine on which an effect begins."""
    loop = OfflineLoop(settings(), QUILL, Night(shown(None, "adequate")))
    return [step.outcome for step in run(loop, machine(SAMPLES, acts=lambda i: float(i > BEGINS)))]


@pytest.fixture(scope="module")
def knocked() -> Part:
    """Diagnosis of a machine whose mount was knocked."""
    loop = OfflineLoop(settings(), QUILL, Night(shown(None, "adequate")))
    steps = run(loop, machine(1200, acts=lambda i: 0.0, more=lambda i: 8.0 * (i > KNOCKED)))
    return diagnoses_of_table(usable_table([step.outcome for step in steps]), QUILL)[0]


@once
def test_an_effect_that_began_within_the_record_is_found_in_the_end_of_it(begun: list[Outcome]) -> None:
    found = diagnosis_of_record(begun, QUILL)
    assert found.model is not None and "coolant_degc" in " ".join(found.effects)


def test_a_mount_that_was_knocked_is_named_to_a_person_and_gives_no_candidate(knocked: Part) -> None:
    found = api.summarised(knocked, knocked, QUILL)
    assert found.model is None and found.effects == () and "step" in found.needs
    begin_ns = round(float(knocked.table.t_s.min()) * NS)
    assert (found.y_moved_utc_ns - begin_ns) / (60 * NS) == pytest.approx(KNOCKED, abs=3)


def test_the_time_of_a_step_is_right_where_a_record_begins_without_t_q(knocked: Part) -> None:
    t_q_degc = np.where(np.arange(knocked.table.t_s.size) < 300, np.nan, knocked.table.columns["t_q_degc"])
    table = dataclasses.replace(knocked.table, columns=knocked.table.columns | {"t_q_degc": t_q_degc})
    part = Part.of(table, parse_model(QUILL, source="test"), None)
    assert (part.y_moved_s - float(table.t_s.min())) / 60.0 == pytest.approx(KNOCKED, abs=3)


@once
def test_a_step_that_only_the_whole_of_a_record_shows_is_the_begin_of_what_its_end_explains(
    begun: list[Outcome], knocked: Part
) -> None:
    end, _ = diagnoses_of_table(usable_table(begun), QUILL)
    assert end.found.verdict == "explained" and not api.summarised(end, knocked, QUILL).y_moved_utc_ns
    partly = dataclasses.replace(end.found.diagnosis, verdict="partly_explained")
    unexplained = dataclasses.replace(end, found=dataclasses.replace(end.found, diagnosis=partly))
    assert api.summarised(unexplained, knocked, QUILL).y_moved_utc_ns


@once
def test_what_is_after_the_change_of_the_residual_is_diagnosed_again_and_ends_of_it_until_they_are_too_short(
    begun: list[Outcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    spans = list[float]()

    def counted(table: Table, base: ThermalModel, probe_std_um: float | None) -> DiagnosisResult:
        spans.append(float(np.ptp(table.t_s)) / 60.0)
        return _diagnosed(table, base, probe_std_um)

    monkeypatch.setattr(api, "_diagnosed", counted)
    monkeypatch.setattr(api, "WELL_EXPLAINED", 0.0)
    diagnoses_of_table(usable_table(begun), QUILL)
    assert spans[1] == pytest.approx(SAMPLES - BEGINS, abs=120)
    assert spans == sorted(spans, reverse=True) and spans[-1] == 60.0 * api.SHORT_H


def test_an_end_without_measured_y_is_not_diagnosed(knocked: Part, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where no probe was taken for hours: what the whole of the record shows counts."""
    asked = list[float]()

    def diagnose(base: ThermalModel, measured: list[Measurement], **_: object) -> DiagnosisResult:
        asked.append(float(np.ptp(measured[0].table.t_s)) / 60.0)
        return knocked.found

    monkeypatch.setattr(api, "diagnose", diagnose)
    y_um = np.where(np.arange(knocked.table.t_s.size) < KNOCKED - 100, knocked.table.columns["y_um"], np.nan)
    table = dataclasses.replace(knocked.table, columns=knocked.table.columns | {"y_um": y_um})
    part, whole = diagnoses_of_table(table, QUILL)
    assert part is whole and asked == [float(np.ptp(table.t_s)) / 60.0]
