"""What is said of the named effects: found, found in part or undecided; and the ceiling, which nothing lies below."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from compensator.diagnose.choice.found_effect import FoundEffect, rivals_of
from compensator.diagnose.choice.held_out import ceiling_of
from compensator.diagnose.choice.verdict import verdict_of
from compensator.diagnose.words.ceiling_words import ceiling, explained
from compensator.diagnose.words.remainder_words import remainder
from compensator.diagnose.words.summary import headline
from compensator.report.diagnosis import tone_of
from tests.diagnose.scenarios import held_out_errors

#: Errors of two gains that are known only together.
FAR = {"gain 1": 30.0, "gain 2": 30.0}


def fresh(base: float, own: float, *, zero: float = 0.0) -> dict[str, Any]:
    """Errors of both models on a run that took no part, about the mean; a constant comes on top about the zero."""
    scores = {
        name: {"rms_um": float(np.hypot(um, zero)), "rms_about_mean_um": um}
        for name, um in (("base model", base), ("extended model", own), ("no compensation", 60.0))
    }
    return {"name": "other.csv", "role": "held out", "scores": scores}


def found(*runs: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Content of `diagnosis.json` with one effect that leaves noise in the data searched."""
    effect = {
        "kind": "scheduled",
        "path": "DTF",
        "channel": "column_degc",
        "deployable": True,
        "determined": True,
        "rms_before_um": 3.5,
        "rms_after_um": 0.2,
    }
    noise = 0.18
    table: dict[str, Any] = {
        "verdict": verdict_of("explained", runs, noise),
        "effects": [effect],
        "rivals": [],
        "before": {"rms_um": 4.5},
        "after": {"rms_um": 0.2},
        "noise_floor_um": noise,
        "fit": {"before_um": 3.6, "named_um": 0.2, "after_um": 0.2},
        "remainder": None,
        "ceiling": {"rms_um": 0.6, "explained_pct": 100.0, "least_rms_um": 0.2},
        "advice": None,
        "warning_codes": [],
        "free_run": list(runs),
    }
    return table | changes


def test_an_effect_that_a_fresh_run_confirms_is_found() -> None:
    table = found(fresh(5.0, 0.3))
    assert table["verdict"] == "explained" and tone_of(table) == "good"
    assert "The missing effects were found" in headline(table)


@pytest.mark.parametrize("own", [6.76, 5.0])
def test_what_a_fresh_run_hardly_confirms_was_not_found(own: float) -> None:
    table = found(fresh(6.75, own))
    assert table["verdict"] == "partly_explained" and tone_of(table) == "warn"
    assert "was not found" in headline(table) and "were found" not in headline(table)


def test_a_fresh_run_of_noise_or_with_a_constant_says_nothing_against_it() -> None:
    assert found(fresh(0.17, 0.18))["verdict"] == "explained"
    assert found(fresh(5.0, 0.3, zero=20.0))["verdict"] == "explained"
    # Nothing of it can be deployed: both models are the same.
    assert found(fresh(13.9, 13.9))["verdict"] == "explained"


def test_an_effect_that_cannot_be_deployed_is_no_pass() -> None:
    table = found(fresh(13.9, 13.9))
    table["effects"] = [dict(table["effects"][0], kind="drift", deployable=False)]
    assert tone_of(table) == "warn" and "none of them can be deployed" in headline(table)


@pytest.mark.parametrize(("about_zero", "is_said"), [(10.5, True), (3.0, False)])
def test_an_adequate_model_that_errs_about_the_zero_says_so(about_zero: float, is_said: bool) -> None:
    """A sensor that settles in the first hours, and a warm start, are taken in by zero and initial state."""
    scores = {"base model": {"rms_um": about_zero, "rms_about_mean_um": 1.3}}
    scores["no compensation"] = {"rms_um": 57.6, "rms_about_mean_um": 35.3}
    run = {"name": "run.csv", "role": "searched", "scores": scores}
    table = found(verdict="adequate", effects=[], before={"rms_um": 1.2}, free_run=[run])
    assert ("About the zero it errs by 10.5 µm rms" in headline(table)) is is_said
    assert (tone_of(table) == "warn") is is_said
    assert "About the zero" not in headline(table | {"verdict": "unexplained"})


def test_an_effect_below_its_standard_error_is_undecided() -> None:
    rival = {"how_to_tell_apart": "Step it (expected change of the log evidence 13; 5 decides)."}
    table = found(verdict="partly_explained", rivals=[rival])
    table["effects"] = [dict(table["effects"][0], determined=False)]
    assert "standard error" in headline(table) and "test that decides" in headline(table)
    assert "found" not in headline(table) and tone_of(table) == "warn"


def rest_of(before_um: float, after_um: float, **changes: bool) -> dict[str, Any]:
    """The remainder of a diagnosis, deployed."""
    figures = {"rms_before_um": before_um, "rms_after_um": after_um}
    return {"deployed": True, "channels": ["at_degc"], "instead": False, "belongs": False} | figures | changes


def test_where_the_remainder_does_the_work_it_is_said() -> None:
    rest = rest_of(2.35, 0.17, belongs=True)
    fit = {"before_um": 5.62, "named_um": 2.28, "after_um": 0.16}
    table = found(fresh(5.0, 0.2), verdict="partly_explained", remainder=rest, fit=fit)
    words = headline(table)
    assert "of 5.62 µm rms in the fit, 2.28 is left by it" in words
    assert "explains nothing, corrects that to 0.16." in words and "were found" not in words
    assert tone_of(table) == "warn"
    assert "it is the base model's own error" in remainder(table)[0].text()
    table["remainder"]["confirmed"] = 0.503
    assert "it is 50 % of the base model's own error" in remainder(table)[0].text()
    coolant = table["effects"][0] | {"kind": "input", "path": None, "channel": "coolant_degc"}
    together = table | {"effects": [coolant]}
    words = headline(together)
    assert "2.28 is left by it. What heat and ambient do by coolant_degc the base model has already" in words
    assert "with its own error corrected, 0.16 is left." in words
    alone = together | {"fit": fit | {"named_um": 6.0}}
    assert "What was found explains the error of 5.62 µm rms in the fit not by itself." in headline(alone)
    best = {"rms_um": 1.0, "explained_pct": 0.0}
    assert explained(together | {"before": {"rms_um": 5.0}, "ceiling": best}).endswith("base model's own error.")
    other = found(verdict="partly_explained", remainder=rest | {"instead": True}, fit=fit)
    assert "is deployed in its place" in headline(other)


def test_a_remainder_that_increases_the_held_out_error_says_so_and_why_it_is_deployed() -> None:
    text = remainder(found(remainder=rest_of(4.7, 6.37, instead=True)))[0].text()
    assert "It increases the error there." in text and "all data are more probable with it" in text
    assert "removes nothing" not in text and "4.70 µm rms with the named effects, 6.37 with it in their place" in text


@pytest.mark.parametrize(("named", "whole", "best"), [(4.7, 6.37, 4.7), (5.49, 4.18, 4.18), (7.0, 7.0, 4.82)])
def test_no_error_is_below_the_ceiling(named: float, whole: float, best: float) -> None:
    one = np.ones(9)
    held_out = held_out_errors(9.0 * one, named=named * one, whole=whole * one, ceiling=4.82 * one)
    top = ceiling_of(held_out)
    assert top is not None and top.rms_um == pytest.approx(4.82) and top.least_um == pytest.approx(best)
    assert top.explained_pct == pytest.approx(min(100.0 * (81.0 - named**2) / (81.0 - 4.82**2), 100.0))
    table = found(
        before={"rms_um": 9.0},
        after={"rms_um": whole},
        remainder={"rms_before_um": named, "rms_after_um": whole, "deployed": True, "channels": []},
        ceiling={"rms_um": top.rms_um, "explained_pct": top.explained_pct, "least_rms_um": top.least_rms_um},
    )
    text = ceiling(table).text()
    assert f"{best:.2f} µm rms" in text and "4.82" in text and "Their error is smaller" not in text


def test_a_rival_is_as_good_by_the_figure_and_the_evidence_of_the_choice() -> None:
    def term(name: str) -> Any:
        return SimpleNamespace(hypothesis=SimpleNamespace(place=(name, "", "")))

    others = [
        SimpleNamespace(term=term(name), rms_um=um, score=score)
        for name, um, score in (("better", 0.1, 30.0), ("near", 0.11, -12.0), ("far", 0.09, -113.0), ("left", 0.3, 5.0))
    ]
    rivals = rivals_of(term("chosen"), others, (0.1, 0.0), lambda _: None)  # type: ignore[arg-type]
    assert [(one.term.hypothesis.place[0], one.log_evidence) for one in rivals] == [("better", 30.0), ("near", -12.0)]
    assert {one.rms_chosen_um for one in rivals} == {0.1}


@pytest.mark.parametrize(
    ("named", "std", "known"),
    [
        ({"change": -0.047}, {"change": 0.093}, False),
        ({"tau": 9.0, "gain": 1.0}, {"tau": 12.0, "gain": 0.1}, True),
        ({"tau": 9.0, "gain": 0.1}, {"tau": 1.0, "gain": 0.2}, False),
        ({"tau": 9.0, "gain 1": 0.1, "gain 2": 4.0}, {"tau": 1.0, "gain 1": 0.2, "gain 2": 1.0}, True),
        # Lags near each other: each gain is open, their sum is known.
        ({"tau": 9.0, "gain": 2.0, "gain 1": 9.0, "gain 2": -7.0}, {"tau": 1.0, "gain": 0.1, **FAR}, True),
    ],
)
def test_an_effect_is_determined_by_its_size(named: dict[str, float], std: dict[str, float], known: bool) -> None:
    searched = (SimpleNamespace(name="tau"),)
    effect = FoundEffect(
        term=SimpleNamespace(hypothesis=SimpleNamespace(free=searched), named=named),  # type: ignore[arg-type]
        effect=SimpleNamespace(has_any_form=False, std=std),  # type: ignore[arg-type]
        rms_before_um=1.0,
        rms_after_um=0.2,
        signal=np.zeros(3),
        rivals=(),
    )
    assert effect.is_determined is known
