"""The page of `report` shows what happened to a machine's models, by whom, and on which figures."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

import pytest

from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData, LoopAction, LoopData
from compensator.messages import Event
from compensator.recording.reading import recordings
from compensator.report.gathering import read_history
from compensator.report.history import History
from compensator.report.page import html_of
from compensator.report.recordings import figures, page_of, verdict
from compensator.report.story import Story, _row, figures_of, in_words
from tests.audit.made import MACHINE, Service, other_model, readings

CANDIDATE, BEFORE = "c" * 64, "b" * 64
FIGURES = ComparisonData(
    verdict=ComparisonVerdict.BETTER,
    measured_by="sensor",
    hours=14.0,
    present_rms_um=6.91,
    candidate_rms_um=1.23,
    deviations=9.4,
)
#: Minute of each event, kind, text, data.
TOLD: tuple[tuple[int, str, str, dict[str, Any]], ...] = (
    (100, "loop", "a diagnosis of the last 36 h begins", LoopData(step=LoopAction.DIAGNOSE, why="planned").table()),
    (101, "diagnosis", "found", DiagnosisData(verdict="explained", effects=["input:coolant_degc"]).table()),
    (
        101,
        "loop",
        "a candidate is compared",
        LoopData(
            step=LoopAction.SHADOW, role="candidate", model_sha256=CANDIDATE, effects=["input:coolant_degc"]
        ).table(),
    ),
    (
        900,
        "loop",
        "a better model is adopted",
        LoopData(
            step=LoopAction.ADOPT, model_sha256=CANDIDATE, effects=["input:coolant_degc"], comparison=FIGURES
        ).table(),
    ),
    (901, "adopt", "model c replaces b", {"ok": True, "action": "adopt", "new_sha256": CANDIDATE, "by": "loop"}),
    (1700, "command", "adopt", {"command": "adopt", "by": "engineer-3", "by_proof": "certificate"}),
    (
        1701,
        "adopt",
        "model d replaces c",
        {
            "ok": True,
            "action": "adopt",
            "new_sha256": "d" * 64,
            "effects": ["hysteresis:all"],
            "comparison": FIGURES.table(),
        },
    ),
    (
        1900,
        "diagnosis",
        "nothing",
        DiagnosisData(verdict="unexplained", needs="check the mount of the displacement sensor").table(),
    ),
    (1900, "loop", "nothing follows", LoopData(step=LoopAction.NOTHING, why="unexplained").table()),
    (2000, "loop", "back to the model before", LoopData(step=LoopAction.BACK, model_sha256=BEFORE).table()),
)


def made(folder: Path, told: tuple[tuple[int, str, str, dict[str, Any]], ...]) -> History:
    """Two days of a machine with these events; half a day with another model."""
    service = Service(folder)
    for i, values in enumerate(readings(2880)):
        for minute, kind, text, data in told:
            if minute == i:
                service.note(kind, text, data)
        if i == 901 and told:
            service.adopt(other_model())
        service.take(values)
    service.stop()
    return read_history(recordings(folder, MACHINE))


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    return made(tmp_path_factory.mktemp("story") / "rec", TOLD)


@pytest.fixture(scope="module")
def text(history: History) -> str:
    return html.unescape(html_of(page_of(history)))


def rows(text: str) -> list[list[str]]:
    found = re.findall(r"<tr>(.*?)</tr>", text, re.S)
    return [[re.sub(r"<[^>]+>", "", cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)] for row in found]


def test_a_decision_stands_with_its_figures_and_who_made_it(text: str) -> None:
    (own,) = [row for row in rows(text) if row[1:2] == ["adopted"] and row[2] == "the loop"]
    assert own[3] == "cccccc input:coolant_degc"
    assert own[4:6] == ["6.9 → 1.2", "14 h, 9.4 σ"]


def test_the_exchange_that_follows_a_decision_of_the_loop_is_not_a_second_adoption(history: History, text: str) -> None:
    assert len([row for row in rows(text) if row[1:2] == ["adopted"]]) == 2
    assert figures(history)["models_story"]["adopted"] == 2  # type: ignore[index]


def test_an_operator_is_named(text: str) -> None:
    (ordered,) = [row for row in rows(text) if row[1:2] == ["adopted"] and row[2] != "the loop"]
    assert ordered[2] == "engineer-3" and ordered[3] == "dddddd hysteresis:all"
    assert ordered[4] == "6.9 → 1.2"


def test_a_recording_that_names_no_effects_says_nothing_of_them() -> None:
    data = {"ok": True, "action": "adopt", "new_sha256": "d" * 64}
    story = Story()
    story.add(Event(schema=1, machine="m", seq=1, time_utc_ns=1, kind="adopt", text="model d replaces c", data=data))
    assert _row(story.steps[0])[3] == "dddddd"


def test_nights_without_a_result_fill_no_table_but_are_counted(history: History, text: str) -> None:
    assert not [row for row in rows(text) if row[1:2] in (["nothing follows"], ["diagnose"])]
    assert "Models: 2 diagnoses, 1 in shadow, 2 adopted, 1 gone back." in verdict(history)
    assert "A person is needed: check the mount of the displacement sensor." in text


def test_each_model_has_its_time_in_force(history: History) -> None:
    first, second = ((stretch.pieces[0][0], stretch.pieces[-1][1]) for stretch in history.in_force.values())
    assert first[1] == second[0]
    assert second[1] - first[0] == pytest.approx(2880 * 60.0)
    assert first[1] - first[0] == pytest.approx(901 * 60.0)


def test_recordings_without_such_events_have_no_story(tmp_path: Path) -> None:
    plain = made(tmp_path / "rec", ())
    assert "The machine's models" not in html_of(page_of(plain))
    assert "Models:" not in verdict(plain)
    assert "models_story" not in figures(plain)


def test_a_candidate_that_is_proposed_again_is_one_proposal() -> None:
    story = Story()
    proposals = [(CANDIDATE, LoopAction.PROPOSE), (CANDIDATE, LoopAction.WITHDRAW)] * 2 + [
        ("d" * 64, LoopAction.PROPOSE)
    ]
    for number, (sha256, step) in enumerate(proposals):
        data = LoopData(step=step, model_sha256=sha256).table()
        story.add(Event(schema=1, machine="m", seq=number, time_utc_ns=number, kind="loop", text=step, data=data))
    counted = figures_of(story)["models_story"]
    assert isinstance(counted, dict) and counted["proposed"] == 2 and "2 proposed" in in_words(story)


def told(story: Story, minute: int, kind: str, data: dict[str, Any]) -> None:
    time_utc_ns = minute * 60 * 10**9
    story.add(Event(schema=1, machine="m", seq=minute, time_utc_ns=time_utc_ns, kind=kind, text=kind, data=data))


def test_who_accepts_or_dismisses_a_candidate_of_the_loop_is_named() -> None:
    story = Story()
    told(story, 1, "command", {"command": "adopt", "candidate": True, "by": "anna"})
    told(story, 1, "loop", LoopData(step=LoopAction.ADOPT, why="by_hand", model_sha256=CANDIDATE).table())
    told(story, 2, "adopt", {"ok": True, "action": "adopt", "by": "loop", "new_sha256": CANDIDATE})
    told(story, 8, "command", {"command": "dismiss", "by": "bert"})
    told(story, 8, "loop", LoopData(step=LoopAction.END, why="dismissed", model_sha256=BEFORE).table())
    told(story, 9, "loop", LoopData(step=LoopAction.END, why="worse", model_sha256=BEFORE).table())
    told(story, 10, "loop", LoopData(step=LoopAction.END, why="by_hand", model_sha256=BEFORE).table())  # at a restart
    assert [step.by for step in story.steps] == ["anna", "bert", "the loop", "an operator"]


def test_a_person_s_model_soon_after_a_decision_that_was_not_carried_out_is_told() -> None:
    story = Story()
    told(story, 1, "loop", LoopData(step=LoopAction.ADOPT, model_sha256=CANDIDATE).table())
    told(story, 2, "loop", LoopData(step=LoopAction.END, why="was_wrong", model_sha256=CANDIDATE).table())
    told(story, 10, "command", {"command": "adopt", "by": "bert"})
    told(story, 12, "adopt", {"ok": True, "action": "adopt", "new_sha256": "d" * 64})
    assert (story.steps[-1].what, story.steps[-1].by, story.steps[-1].model_sha256) == ("adopt", "bert", "d" * 64)
