"""`compensator loop`: what the loop makes of the recordings of a shop, one folder for each machine."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from compensator.api import shop
from compensator.cli import main
from compensator.clock import NS
from compensator.demo.machine import configuration
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData, LoopAction, LoopData
from compensator.service.loop.core import ShadowedLoop
from compensator.service.loop.run import Diagnosed
from tests.audit.made import CONFIG, QUILL, Service, readings

LOOP = b'\n[loop]\npolicy = "propose"\n'
BETTER = ComparisonData(
    verdict=ComparisonVerdict.BETTER, measured_by="sensor", hours=12.0, present_rms_um=6.0, candidate_rms_um=1.0
)
PROPOSED = LoopData(step=LoopAction.PROPOSE, effects=["gain:DTF"], model_sha256="a" * 64, comparison=BETTER)
#: What a loop did: minute, kind, text, data.
TOLD: tuple[tuple[int, str, str, dict[str, Any]], ...] = (
    (60, "diagnosis", "found", DiagnosisData(verdict="explained", effects=["gain:DTF"]).table()),
    (60, "loop", "begins", LoopData(step=LoopAction.SHADOW, effects=["gain:DTF"], role="candidate").table()),
    (300, "loop", "proposed", PROPOSED.table()),
)


@pytest.mark.parametrize(("checks", "is_warned"), [("", True), ("[plausibility]\nfalse_alarm_days = 30.0\n", False)])
def test_a_loop_that_nothing_but_the_clock_sets_going_is_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], checks: str, is_warned: bool
) -> None:
    lines = {"rtu": "/dev/ttyS90", "dcon": "/dev/ttyS91", "tcp": 1502, "plc": 1503, "data": 1, "command": 2}
    text = re.sub(r"\[plausibility\].*?(?=\n\[|\Z)", "", configuration("vmc-07", lines, 7447), flags=re.S)
    (tmp_path / "machine.toml").write_text(text + LOOP.decode() + checks, encoding="utf-8")
    assert main(["check", "--config", str(tmp_path / "machine.toml")]) == 0
    assert ("[loop_without_check]" in capsys.readouterr().err) is is_warned


def recorded(
    folder: Path, minutes: int, *, config: bytes = CONFIG, told: tuple[Any, ...] = (), hold: int = -1, resume: int = -1
) -> Path:
    service = Service(folder, config=config)
    for i, values in enumerate(readings(minutes)):
        for minute, kind, text, data in told:
            if minute == i:
                service.note(kind, text, data)
        if i == hold:
            service.command("hold")
        if i == resume:
            service.command("resume")
        service.take(values)
    service.stop()
    return folder


def result(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    assert main(["loop", *arguments, "--json"]) == 0
    machines: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["machines"]
    return machines


@pytest.fixture
def told(tmp_path: Path) -> Path:
    return recorded(tmp_path / "live", 400, config=CONFIG + LOOP, told=TOLD)


def test_decisions_of_a_machine_with_a_loop_are_those_of_its_recordings(
    told: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (one,) = result([str(told)], capsys)
    assert one["is_recorded"] and one["diagnoses"] == 1
    assert one["found"] == one["proposed"] == ["gain:DTF"]
    assert (one["adopted"], one["gone_back"]) == (0, 0)
    assert "decide on the proposal" in one["needs"]
    assert one["measured_by"] == "sensor" and one["now_um"] > 0.0 and one["first_um"] is None


@pytest.mark.parametrize("takes_over", [False, True])
def test_a_decision_that_was_not_carried_out_is_no_adoption(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], takes_over: bool
) -> None:
    decided = LoopData(step=LoopAction.ADOPT, effects=["gain:DTF"], model_sha256="a" * 64)
    ended = LoopData(step=LoopAction.END, role="candidate", model_sha256="a" * 64, why="was_wrong")
    exchange = {"ok": True, "action": "adopt", "by": "loop", "new_sha256": "a" * 64, "effects": ["gain:DTF"]}
    refused = {"ok": False, "action": "adopt"}
    after = (351, "adopt", "replaces", exchange) if takes_over else (351, "loop", "ended", ended.table())
    told = (*TOLD, (350, "loop", "adopted", decided.table()), after, (360, "adopt", "refused", refused))
    (one,) = result([str(recorded(tmp_path / "live", 400, config=CONFIG + LOOP, told=told))], capsys)
    assert (one["adopted"], one["effects"]) == ((1, ["gain:DTF"]) if takes_over else (0, []))


@pytest.mark.parametrize(("is_recorded", "now_um"), [(True, 30.0), (False, 5.0)])
def test_the_error_that_probes_show_is_with_the_offset_of_the_loop(is_recorded: bool, now_um: float) -> None:
    """The probe saw 50 µm with −20 µm applied; the loop that is computed now had −45 µm then, and learns of it."""
    summary = shop._Summary("folder", "machine", is_recorded=is_recorded)
    probe: Any = SimpleNamespace(time_utc_ns=10**18 + 1, measured_um=30.0, deformation_um=50.0, taken=True)
    for i, offset_um in enumerate((-60.0, -20.0 if is_recorded else -45.0, -50.0)):
        estimate: Any = SimpleNamespace(time_utc_ns=10**18 + (i - 1) * 60 * NS, y_um=None)
        offset: Any = SimpleNamespace(y_offset_um=offset_um)
        summary.add(estimate, offset, [probe] if i == 2 else [])
    assert summary.now_um == pytest.approx(now_um)


@pytest.mark.parametrize(
    ("after", "proposed"),
    [
        (LoopData(step=LoopAction.WITHDRAW, role="candidate", model_sha256="a" * 64), []),
        (LoopData(step=LoopAction.END, role="candidate", model_sha256="a" * 64, why="by_hand"), []),
        (
            LoopData(step=LoopAction.SHADOW, role="candidate", model_sha256="b" * 64, effects=["delay:DTF"]),
            ["gain:DTF"],
        ),
        (LoopData(step=LoopAction.END, role="candidate", model_sha256="b" * 64, why="worse"), ["gain:DTF"]),
        (LoopData(step=LoopAction.END, role="before", model_sha256="c" * 64, why="watched"), ["gain:DTF"]),
    ],
)
def test_a_proposal_asks_something_of_a_person_whatever_happens_to_other_models(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], after: LoopData, proposed: list[str]
) -> None:
    told = (*TOLD, (350, "loop", "after it", after.table()))
    (one,) = result([str(recorded(tmp_path / "live", 400, config=CONFIG + LOOP, told=told))], capsys)
    assert one["proposed"] == proposed and bool(one["needs"]) == bool(proposed)


def test_a_decision_of_another_version_ends_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = (*TOLD, (350, "loop", "a step of a later version", {"step": "muse"}), (351, "loop", "nothing", {}))
    (one,) = result([str(recorded(tmp_path / "live", 400, config=CONFIG + LOOP, told=told))], capsys)
    assert one["proposed"] == ["gain:DTF"]


def test_newer_parameters_of_a_proposal_take_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    newer = LoopData(step=LoopAction.SHADOW, role="candidate", model_sha256="b" * 64, effects=["gain:DTF"])
    falls = LoopData(step=LoopAction.WITHDRAW, role="candidate", model_sha256="b" * 64)
    told = (*TOLD, (350, "loop", "newer", newer.table()), (360, "loop", "falls", falls.table()))
    (one,) = result([str(recorded(tmp_path / "live", 400, config=CONFIG + LOOP, told=told))], capsys)
    assert one["proposed"] == [] and not one["needs"]


def finds_nothing(seen: list[Any]) -> Any:
    """Diagnoses that find nothing, and are counted with what they were given."""

    def of(_config: Any) -> Any:
        def diagnose(record: Any, model: bytes) -> Diagnosed:
            seen.append((len(record), model))
            return Diagnosed("adequate", (), None, "nothing that the model lacks")

        return diagnose

    return of


def test_the_loop_is_run_over_recordings_of_a_machine_without_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(shop, "diagnosis_in_process", finds_nothing(seen))
    folder = recorded(tmp_path / "plain", 1500)
    (one,) = result([str(folder)], capsys)
    assert not one["is_recorded"] and one["diagnoses"] == len(seen) > 0
    assert all(model == QUILL for _, model in seen)
    # Nothing was adopted, so the loop leaves what the model alone leaves.
    assert one["now_um"] == pytest.approx(one["first_um"])
    assert one["needs"] == "" and one["error"] == ""


def test_samples_during_a_hold_by_hand_are_not_diagnosed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(shop, "diagnosis_in_process", finds_nothing(seen))
    (one,) = result([str(recorded(tmp_path / "held", 1500, hold=30))], capsys)
    assert one["diagnoses"] == 0 and not seen


def test_a_resume_of_the_recordings_is_one_of_the_models_in_shadow_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    resumed: list[ShadowedLoop] = []
    monkeypatch.setattr(ShadowedLoop, "resume", lambda core: resumed.append(core))
    result([str(recorded(tmp_path / "held", 120, hold=30, resume=60))], capsys)
    assert len(resumed) == 1


def test_a_shop_is_a_folder_of_folders_and_one_bad_machine_stops_no_other(
    tmp_path: Path, told: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compensator.commands.workers.os.cpu_count", lambda: 1)
    bad = tmp_path / "hall" / "rubbish" / "recordings"
    bad.mkdir(parents=True)
    (bad / "torn.mcap").write_bytes(b"no recording")
    (tmp_path / "hall" / "round").symlink_to(tmp_path)
    page = tmp_path / "shop.html"
    assert main(["loop", str(tmp_path), "--page", str(page)]) == 0
    text = capsys.readouterr().out
    assert "2 machine(s): action needed on 2, 1 of them with a proposal; 1 could not be read." in text
    assert "torn.mcap" in text and str(page) in text
    shown = page.read_text(encoding="utf-8")
    # Folders of recordings often have the same name.
    assert str(bad) in text and str(bad) in shown
    assert "gain:DTF" in shown and "Failed" in shown


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["loop", str(tmp_path / "nowhere")]) == 2
    assert "nowhere: no folder" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["loop", str(tmp_path / "empty")]) == 2
    assert "empty" in (error := capsys.readouterr().err) and error.count("\n") == 1


def test_processes_of_their_own_find_what_one_process_finds(
    tmp_path: Path, told: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(tmp_path / "second", 200)
    found = []
    for cores in (1, 2):
        monkeypatch.setattr("compensator.commands.workers.os.cpu_count", lambda cores=cores: cores)
        found.append(result([str(told), str(tmp_path / "second")], capsys))
    assert found[0] == found[1]
    assert [one["machine"] for one in found[0]] == ["vmc-07", "vmc-07"]


def test_a_file_without_its_end_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What it lacks may be a decision; the newest file has no end while the service runs."""
    folder = recorded(tmp_path / "live", 200, config=CONFIG + LOOP)
    recorded(folder, 200, config=CONFIG + LOOP)
    last, first = sorted(folder.glob("*.mcap"))  # -001 is the second one
    for path in (last, first):
        assert result([str(folder)], capsys)[0]["cut"] == []
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 9 // 10])
    assert main(["loop", str(folder)]) == 0
    assert f"1 file(s) without their end: {first.name}" in capsys.readouterr().out
