"""The page of a diagnosis: waterfall, effects over their residuals, ceiling and remainder."""

from __future__ import annotations

import dataclasses
import json
import math
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import compensator as tc
from compensator.arrays import rms_of
from compensator.data.measurement import read
from compensator.diagnose.advice.advice import Advice, Unexplained
from compensator.diagnose.choice import held_out as held_out_module
from compensator.diagnose.choice.outcome import Ceiling, Diagnosis, Refused, Remainder, Step
from compensator.diagnose.fitting.points import Points
from compensator.diagnose.fitting.prediction import FOLDS
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.words.summary import contents, error_table, figures, headline, name, verdict
from compensator.display import text_of_all
from compensator.model.model_file import load_model
from compensator.report.diagnosis import page_of, tone_of
from compensator.report.drawing import svg
from compensator.report.figure import Bar, Edges, Figure, Line, described
from compensator.report.held_out import TimeAxis, waterfall
from compensator.report.page import Page, Section, html_of
from compensator.report.results import pages_in
from tests.diagnose.scenarios import draw, record
from tests.identify.quill_runs import runs_from

#: Words and numbers of many pages with the same figures.
pytestmark = pytest.mark.usefixtures("equal_pictures_once")

QUILL = load_model("quill")
REMAINDER = Remainder(deployed=True, channels=("t1_degc", "base_degc"), rms_before_um=1.4, rms_after_um=0.9)


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    """A coolant and a step, in 10 h."""
    columns, _, _ = record([draw("input", 21), draw("step", 21)], 1121, 10.0)
    diagnosis = tc.diagnose("quill", {"t_s": 60.0 * np.arange(600), **columns}).diagnosis
    assert len(diagnosis.effects) == 2
    return diagnosis


def page(diagnosis: Diagnosis) -> Page:
    return page_of(diagnosis, diagnosis.model, ())


def text(diagnosis: Diagnosis) -> str:
    return html_of(page(diagnosis))


def sections(diagnosis: Diagnosis) -> list[Section]:
    return [block for block in page(diagnosis).blocks if isinstance(block, Section)]


# ---------------------------------------------------------------------------- waterfall


def made(
    found: Diagnosis, before: float, named: float, after: float, steps: tuple[tuple[float, int], ...], **changes: Any
) -> Any:
    """A diagnosis with errors of these sizes; `steps`: of each effect the error with it, and how many searches."""
    one = np.ones(found.held_out_before.size)
    effects = found.effects[: len(steps)]
    return dataclasses.replace(
        found,
        held_out_before=before * one,
        held_out_named=named * one,
        held_out_after=after * one,
        steps=tuple(
            Step(place=effect.place, rms_um=rms_um, searches=searches)
            for effect, (rms_um, searches) in zip(effects, steps, strict=True)
        ),
        effects=effects,
        **changes,
    )


STEPS = ((3.0, FOLDS), (1.0, 2))


def test_each_bar_begins_where_the_one_above_ends_and_shares_of_the_squares_add_up(found: Diagnosis) -> None:
    ceiling = Ceiling(rms_um=0.8, explained_pct=83.0)
    picture = waterfall(made(found, 5.0, 1.0, 0.5, STEPS, remainder=REMAINDER, ceiling=ceiling))
    before, first, second, named, rest, after = picture.bars
    assert [b.last for b in (before, named, after)] == pytest.approx([5.0, 1.0, 0.5])
    assert {b.first for b in (before, named, after)} == {0.0}
    assert [b.first for b in (first, second, rest)] == pytest.approx([5.0, 3.0, 1.0])
    assert [b.last for b in (first, second, rest)] == pytest.approx([3.0, 1.0, 0.5])
    # 25 − 9, 9 − 1 and 1 − 0.25 of 25 µm².
    assert [b.value for b in (first, second, rest)] == ["3.00 µm (−64 %)", "1.00 µm (−32 %)", "0.50 µm (−3 %)"]
    assert "found in 2 of 3 searches" in second.name and "found in" not in first.name
    assert rest.hatched and "explains nothing" in rest.name
    assert {edge.at for edge in picture.edges} == {(found.noise_floor_um,), (0.8,)}


def test_an_effect_without_a_step_gets_none_of_another_one(found: Diagnosis) -> None:
    """A late T_Q that was left in while the errors were measured, and in whose place all channels were put then."""
    one = dataclasses.replace(made(found, 5.0, 1.0, 1.0, STEPS), steps=found.steps[1:])
    second = name(found.effects[1])
    assert [row[0] for row in error_table(one).rows if row[0].startswith("+ ")] == [f"+ {second}"]
    assert waterfall(one).bars[1].name.startswith(second)


def test_what_only_the_searches_found_is_a_bar_of_its_own(found: Diagnosis) -> None:
    picture = waterfall(made(found, 5.0, 2.0, 2.0, STEPS, remainder=None, ceiling=None))
    assert [bar.last for bar in picture.bars] == pytest.approx([5.0, 3.0, 1.0, 2.0, 2.0])
    assert picture.bars[3].value == "2.00 µm (+12 %, increased)" and "these searches" in picture.bars[3].name
    assert len(picture.edges) == 1


def test_what_increases_the_error_has_its_own_colour_and_a_word(found: Diagnosis) -> None:
    picture = waterfall(made(found, 5.0, 1.0, 1.5, ((6.0, 1), (1.0, FOLDS)), remainder=REMAINDER, ceiling=None))
    left, worse, better, _, remainder, _ = picture.bars
    assert worse.line == remainder.line and worse.line not in (left.line, better.line)
    assert [bar for bar in picture.bars if "increased" in bar.value] == [worse, remainder]
    assert remainder.hatched and "adds to the error" in picture.note
    assert "6.00 µm (+44 %, increased)." in described(picture)
    fine = waterfall(made(found, 5.0, 1.0, 1.0, STEPS, remainder=None, ceiling=None))
    assert worse.line not in {bar.line for bar in fine.bars} and "adds to" not in fine.note


def test_nothing_found_is_one_bar(found: Diagnosis) -> None:
    picture = waterfall(made(found, 0.3, 0.3, 0.3, (), remainder=None, ceiling=None))
    assert [bar.name for bar in picture.bars] == ["base model"] and picture.note == ""


def test_the_waterfall_of_a_diagnosis_ends_at_its_errors(found: Diagnosis) -> None:
    picture = waterfall(found)
    assert picture.bars[0].last == pytest.approx(found.before.rms_um, rel=0.02)
    assert picture.bars[-1].last == pytest.approx(rms_of(found.held_out_after))
    assert len(found.steps) == len(found.effects)
    assert found.steps[0].rms_um < 0.8 * found.before.rms_um


def test_steps_are_predictions_of_searches_without_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two effects of known size: one that every search finds, one that only the searches with the first block find."""
    columns, _, _ = record([], 5, 12.0)
    evidence = evidence_of(QUILL, runs_from(columns))
    rng = np.random.default_rng(0)
    large, small = 5.0 * rng.normal(size=evidence.used.size), rng.normal(size=evidence.used.size)
    residual = np.where(evidence.used, large + small, 0.0)
    evidence = dataclasses.replace(evidence, residual=residual)
    places = [("gain", "DTF", ""), ("input", "", "coolant_degc")]
    seen_by_all = SimpleNamespace(observed=True)
    terms = [SimpleNamespace(hypothesis=SimpleNamespace(place=place), effect=seen_by_all) for place in places]
    nothing = np.zeros(evidence.used.size)

    def findings_of(seen: Any, **_: Any) -> Any:
        count = 2 if seen.used[:200].all() else 1
        assert seen.used.sum() < evidence.used.sum()
        return SimpleNamespace(
            search=SimpleNamespace(points=Points(seen)),
            terms=terms[:count],
            responses=[large, small][:count],
            own_paths=nothing,
            paths=nothing,
            named=large + (count - 1) * small,
            whole=large + (count - 1) * small,
            ceiling=nothing,
            is_own_error_alone=False,
        )

    monkeypatch.setattr(held_out_module, "findings_of", findings_of)
    search = SimpleNamespace(evidence=evidence, grid=None)
    rest = dataclasses.replace(Points(evidence).typical_rest(), noise_um=1.0, slow_um=0.01, start_um=0.01)
    fit = SimpleNamespace(rest=rest)
    all_of = SimpleNamespace(
        search=search,
        selection=SimpleNamespace(fit=fit, before=fit),
        terms=terms,
        responses=(large, small),
        remainder=None,
        deploys_names=True,
        foresight=None,
        left_in=None,
        is_own_error_alone=False,
    )
    held_out = held_out_module.held_out_of(all_of, places, lambda done, of: None, map)
    first, second = held_out.steps
    assert (first.searches, second.searches) == (3, 2)
    # What the search without the first block does not find is left there, and nowhere else.
    left = [float(np.nanstd(held_out.named[block])) for block in evidence.blocks(FOLDS)]
    assert left == pytest.approx([1.0, 0.0, 0.0], abs=0.15)
    assert first.rms_um == pytest.approx(1.0, rel=0.15)
    assert second.rms_um == pytest.approx(math.sqrt(1.0 / 3.0), rel=0.15)
    assert second.rms_um == pytest.approx(rms_of(held_out.named))


# ---------------------------------------------------------------------------- effects


def test_an_effect_lies_over_its_residual_and_its_channel_below_it(found: Diagnosis) -> None:
    effect = next(e for e in found.effects if e.channel)
    section = sections(found)[found.effects.index(effect)]
    picture = next(block for block in section.blocks if isinstance(block, Figure))
    without, alone = picture.lines
    used = np.isfinite(found.residual_after)
    # What is left with every effect is what stands between the two curves.
    between = without.y - np.interp(without.x, alone.x, alone.y)
    assert between[np.isfinite(between)] == pytest.approx(found.residual_after[used], abs=1e-9)
    assert np.std(alone.y) > 3.0 * np.std(between)
    [panel] = picture.below
    [channel] = panel.lines
    assert channel.name == effect.channel and panel.y_label == "°C"
    assert channel.y == pytest.approx(found.evidence.signals[0].channels[effect.channel])
    # The words with the size come before the figure, and the coefficients after it.
    order = [type(block).__name__ for block in section.blocks[:3]]
    assert order == ["Words", "Figure", "Table"]


def test_what_no_channel_shows_has_no_channel_below(found: Diagnosis) -> None:
    step = dataclasses.replace(found.effects[0], term=drawn_term("step"))
    section, *_ = sections(dataclasses.replace(found, effects=(step, *found.effects[1:])))
    picture = next(block for block in section.blocks if isinstance(block, Figure))
    assert picture.below == () and "No channel shows its cause." in picture.note


def test_a_path_is_shown_with_what_drives_it(found: Diagnosis) -> None:
    gain = dataclasses.replace(found.effects[0], term=drawn_term("gain"))
    section, *_ = sections(dataclasses.replace(found, effects=(gain, *found.effects[1:])))
    picture = next(block for block in section.blocks if isinstance(block, Figure))
    assert picture.below[0].y_label == "W"
    assert picture.below[0].lines[0].y == pytest.approx(found.evidence.signals[0].drive)


def test_the_only_effect_is_drawn_once_in_the_first_picture(found: Diagnosis) -> None:
    effect = next(e for e in found.effects if e.channel)
    one = dataclasses.replace(found, effects=(effect,), steps=found.steps[:1])
    assert not [block for section in sections(one) for block in section.blocks if isinstance(block, Figure)]
    first = page(one).blocks[0]
    assert isinstance(first, Figure)
    _, alone = first.lines
    assert alone.y[np.isfinite(alone.y)] == pytest.approx(effect.signal)
    assert [panel.lines[0].name for panel in first.below] == [effect.channel]


def test_the_residual_of_the_base_model_is_drawn_as_the_data_have_it(found: Diagnosis) -> None:
    wave = np.sin(np.arange(found.residual_after.size) / 40.0)
    # The remainder takes out what the effects leave.
    with_it = dataclasses.replace(
        found, remainder=REMAINDER, remainder_um=wave, residual_after=found.residual_after - wave
    )

    def lines(diagnosis: Diagnosis) -> list[Line]:
        first = page(diagnosis).blocks[0]
        assert isinstance(first, Figure)
        return list(first.lines)

    base, effects, rest = lines(with_it)
    used = np.isfinite(found.residual_after)
    filled = np.zeros(used.size)
    filled[used] = base.y[np.isfinite(base.y)]
    assert found.evidence.without_nuisances(filled)[used] == pytest.approx(found.residual_before[used], abs=1e-6)
    assert rest.name == "remainder (explains nothing)" and rest.y[np.isfinite(rest.y)] == pytest.approx(wave)
    between = filled[used] - effects.y[np.isfinite(effects.y)][used]
    assert between == pytest.approx((with_it.residual_after + wave)[used])
    # Neither a remainder nor effects that the extended model has not are drawn as if it had.
    idle = refused(dataclasses.replace(with_it, remainder=dataclasses.replace(REMAINDER, deployed=False)))
    assert [line.name for line in lines(idle)] == [
        "residual of the base model",
        ("effect" if len(found.effects) == 1 else "all effects") + " (not in the extended model)",
    ]
    instead = dataclasses.replace(with_it, remainder=dataclasses.replace(REMAINDER, instead=True))
    assert lines(instead)[2].name == "remainder, in place of the effects"
    assert lines(instead)[2].y[used] == pytest.approx((lines(instead)[1].y + wave)[used])


def test_the_headline_is_the_verdict_and_one_figure(found: Diagnosis) -> None:
    words = headline(figures(found))
    before, after = found.before.rms_um, found.after.rms_um
    assert f"{before:.2f} µm rms without them, {after:.2f} with them." in words and words == page(found).verdict
    assert len(words) < 0.7 * len(verdict(figures(found)))
    # Where the errors in free run are known, the headline has them: one figure in all commands and pages.
    other = {"rms_um": 9.0, "rms_about_mean_um": 8.0}
    base = {"rms_um": 2.0, "rms_about_mean_um": 1.9}
    scores = {
        "base model": base,
        "extended model": other,
        "no compensation": {"rms_um": 40.0, "rms_about_mean_um": 30.0},
    }
    worse = {"free_run": [{"name": "other.csv", "role": "held out", "scores": scores}]}
    assert "so it is worse there" in headline(figures(found) | worse)


def drawn_term(kind: str) -> Any:
    places = {"step": ("step", "", ""), "gain": ("gain", "DTF", "")}
    return SimpleNamespace(
        hypothesis=SimpleNamespace(place=places[kind], form="", free=(), label=kind), named={}, effect=None
    )


def test_an_effect_that_was_not_deployed_does_not_claim_it(found: Diagnosis) -> None:
    assert len(found.model.effects) == sum(effect.deployable for effect in found.effects) > 0
    assert text(found).count("Deployed in the extended model.") == len(found.model.effects)
    assert "The model was left unchanged." not in text(found)
    assert "Deployed in the extended model." not in text(refused(found))
    assert "Not deployed: it is a test." in text(refused(found))
    assert "The model was left unchanged." in text(refused(found))
    assert "with what is not deployed" in text(refused(found)) and "(not deployed)" in text(refused(found))


def refused(found: Diagnosis) -> Diagnosis:
    """The same diagnosis where nothing is deployed."""
    why = "it is a test"
    return dataclasses.replace(
        found,
        model=QUILL,
        effects=tuple(dataclasses.replace(effect, refused=why) for effect in found.effects),
        held_out_after=found.held_out_before,
        refused=Refused(why=why, held_out=found.held_out_after),
    )


# ---------------------------------------------------------------------------- time axis


def axis(*records: dict[str, np.ndarray]) -> TimeAxis:
    runs = [run for columns in records for run in runs_from(columns)]
    evidence = evidence_of(QUILL, runs)
    return TimeAxis.of(SimpleNamespace(evidence=evidence, model=QUILL, could_hide=None))  # type: ignore[arg-type]


def drawn_in(blocks: Any) -> list[Figure]:
    """Return all figures of a page."""
    own = [block for block in blocks if isinstance(block, Figure) and not block.bars]
    return own + [figure for block in blocks if hasattr(block, "blocks") for figure in drawn_in(block.blocks)]


def test_the_time_of_one_run_has_its_date(found: Diagnosis) -> None:
    since_s = datetime(2026, 11, 28, 2, 0, tzinfo=UTC).timestamp()
    figures = drawn_in(page_of(found, found.model, (), since_utc_s=since_s).blocks)
    assert {one.x_label for one in figures} == {"time, h after 2026-11-28 02:00 UTC"} and len(figures) > 3
    assert TimeAxis.of(found).label == "time, h"


@pytest.mark.parametrize(
    ("times", "since_s"),
    [({"time_utc": ["2026-11-28T02:00:00Z", "2026-11-28T02:01:00Z"]}, 1795831200.0), ({"t_s": [60.0, 120.0]}, None)],
)
def test_when_data_begin_is_known_of_times_with_a_date_alone(times: Any, since_s: float | None) -> None:
    columns = {name: [20.0, 20.1] for name in ("t_q_degc", "at_degc", "y_um")}
    assert read(times | columns).since_utc_s == since_s


def test_edges_of_blocks_and_runs_are_marked_and_no_curve_crosses_from_run_to_run() -> None:
    (first, _, _), (second, _, _) = record([], 5, 6.0), record([], 6, 4.5)
    time = axis(first, second)
    [blocks], [runs] = time.blocks, time.runs
    assert blocks.at == pytest.approx((3.5, 7.0)) and runs.at == pytest.approx((6.0,))
    line = time.line("y", np.arange(630.0))
    assert np.isnan(line.y).sum() == 1 and line.x[np.isnan(line.y)][0] == pytest.approx(6.0)
    assert "2 runs" in time.note and axis(first).note == ""
    assert {edge.name for edge in time.unnamed} == {""} and len(time.unnamed) == 2
    # An edge that is the start of a run is marked once.
    shorter = axis(first, {name: values[:180] for name, values in second.items()})
    assert shorter.blocks[0].at == pytest.approx((3.0,)) and shorter.runs[0].at == pytest.approx((6.0,))


def test_a_gap_is_left_open_and_values_now_and_then_are_joined() -> None:
    columns, _, _ = record([], 5, 6.0)
    time = axis(columns)
    y = np.arange(360.0)
    y[100:200] = np.nan
    y[250] = np.nan  # one lost sample is no gap
    line = time.line("y", y)
    assert np.isnan(line.y).sum() == 1 and line.y.size == 360 - 101 + 1
    probed = np.full(360, np.nan)
    probed[::15] = 1.0
    assert np.isfinite(time.line("y", probed).y).all()
    probed[120:240] = np.nan
    assert np.isnan(time.line("y", probed).y).sum() == 1
    assert time.line("y", np.full(360, np.nan)).y.size == 0


# ---------------------------------------------------------------------------- ceiling and remainder


def with_ceiling(found: Diagnosis, share: float, **changes: Any) -> Diagnosis:
    ceiling = Ceiling(rms_um=0.2 * found.before.rms_um, explained_pct=share)
    return dataclasses.replace(found, ceiling=ceiling, verdict="explained", **changes)


def test_the_share_of_the_ceiling_is_said_everywhere(found: Diagnosis, tmp_path: Path) -> None:
    explained = with_ceiling(found, 83.0)
    sentence = "The named effects explain 83 % of what the channels can explain."
    printed = text_of_all(contents(explained, ()))
    assert sentence in text(explained) and sentence in printed and sentence in verdict(figures(explained))
    assert "show clearly more" not in text(explained) + printed
    assert tone_of(figures(explained)) == "good"


def test_where_the_effects_fall_short_it_is_said_and_not_passed(found: Diagnosis, tmp_path: Path) -> None:
    short = with_ceiling(found, 40.0)
    assert "The channels show clearly more" in text(short) and "no remainder was added" in text(short)
    assert page(short).tone == "warn" and "The missing effects were found" not in page(short).verdict
    # The overview of the folder says the same.
    (tmp_path / "diagnosis.json").write_text(json.dumps(figures(short)), encoding="utf-8")
    (tmp_path / "report.html").write_text(text(short), encoding="utf-8")
    [overview] = pages_in(tmp_path)
    assert overview.tone == "warn" and overview.verdict == page(short).verdict and "40 %" in overview.verdict


def test_channels_that_explain_next_to_nothing_make_no_share(found: Diagnosis) -> None:
    ceiling = Ceiling(rms_um=0.99 * found.before.rms_um, explained_pct=0.0)
    adequate = dataclasses.replace(found, ceiling=ceiling, verdict="explained")
    assert "explain almost nothing" in text(adequate) and "show clearly more" not in text(adequate)
    assert page(adequate).tone == "good"


def test_the_remainder_is_named_as_what_it_is(found: Diagnosis) -> None:
    with_it = with_ceiling(found, 40.0, remainder=REMAINDER)
    printed = text_of_all(contents(with_it, ()))
    for where in (text(with_it), printed):
        assert "t1_degc, base_degc: a correction that explains nothing." in where
        assert (
            "1.40 µm rms with the named effects alone, 0.90 with it" in where
            and "the remainder corrects some of the rest" in where
        )
    # The effects are not credited with what the remainder does.
    assert f"1.40 µm rms with them, {with_it.after.rms_um:.2f} with the remainder" in verdict(figures(with_it))
    assert [row[0] for row in error_table(with_it).rows][-3:] == [
        "with the remainder",
        "best linear use of all channels",
        "sensor noise alone",
    ]
    worse = dataclasses.replace(with_it, remainder=dataclasses.replace(REMAINDER, rms_after_um=1.5))
    assert "corrects some of the rest" not in text(worse) and "does not lower the error" in text(worse)
    assert "It increases the error there" in text(worse) and "It increases the error there" not in text(with_it)
    idle = dataclasses.replace(with_it, remainder=dataclasses.replace(REMAINDER, rms_after_um=1.4))
    assert "removes nothing there that can be measured" in text(idle)
    assert "removes nothing there that can be measured" not in text(with_it) + text(worse)
    idle = dataclasses.replace(with_it, remainder=dataclasses.replace(REMAINDER, deployed=False))
    assert "Not deployed in the extended model." in text(idle)


def test_what_only_the_remainder_corrects_is_not_called_unseen(found: Diagnosis) -> None:
    nameless = {"effects": (), "steps": (), "tried": ()}
    alone = dataclasses.replace(with_ceiling(found, 0.0, remainder=REMAINDER, **nameless), verdict="unexplained")
    assert "has no name here" in page(alone).verdict and "no channel shows" not in page(alone).verdict
    assert page(alone).tone == "warn"
    # Where the channels show nothing of it, that is said.
    left = Unexplained(
        kind="residual", rms_um=2.0, peak_to_peak_um=6.0, tau_min=60.0, times=(), goes_with=None, sensor_evidence=9.0
    )
    unseen = dataclasses.replace(alone, remainder=None, ceiling=None, advice=Advice(unexplained=left))
    assert "no channel shows" in page(unseen).verdict and "has no name here" not in page(unseen).verdict
    # Or that nothing is left of it in the fit, and held-out blocks have more.
    absorbed = dataclasses.replace(unseen, advice=Advice())
    assert "does not foretell the rest of the record" in page(absorbed).verdict and page(absorbed).tone == "warn"


def test_without_effect_ceiling_and_remainder_the_page_says_so_and_claims_nothing(found: Diagnosis) -> None:
    nothing = {"effects": (), "steps": (), "tried": (), "ceiling": None, "remainder": None, "advice": None}
    bare = dataclasses.replace(found, **nothing, verdict="adequate")
    words = text(bare)
    assert "No linear combination of the logged channels has a smaller error" in words
    assert "before and after" not in words and "a correction that explains nothing" not in words
    assert "explain" not in verdict(figures(bare))
    assert not sections(bare)


# ---------------------------------------------------------------------------- drawing


def test_bars_have_their_names_and_values_beside_them() -> None:
    bars = (
        Bar("base $model", "4.05 µm", 0.0, 4.05),
        Bar("a rather long name " * 3, "0.31 µm", 4.05, 0.31, hatched=True),
    )
    drawn = svg(Figure(title="t", x_label="rms, µm", y_label="model", bars=bars, edges=(Edges("noise", (0.3,)),)), "p")
    for words in (">base $model<", ">4.05 µm<", ">0.31 µm<", ">noise<"):
        assert words in drawn
    assert "base $model: 4.05 µm." in drawn  # for those who do not see it


def test_a_panel_below_shares_the_time_axis_and_the_legend_of_the_edges() -> None:
    x = np.arange(30.0)
    edges = (Edges("edge of a block", (10.0, 20.0)),)
    below = Figure(
        title="", x_label="time, h", y_label="°C", lines=(Line("coolant", x, x),), edges=(Edges("", (10.0,)),)
    )
    above = Figure(
        title="t",
        x_label="time, h",
        y_label="Y, µm",
        lines=(Line("y", x, -x),),
        edges=edges,
        below=(below,),
        height=3.0,
    )
    drawn = svg(above, "p")
    assert drawn.count(">time, h<") == 1 and drawn.count(">edge of a block<") == 1
    assert ">°C<" in drawn and ">coolant<" in drawn and "Below: x: time, h; y: °C. coolant: 0 to 29" in drawn
    assert above.full_height == pytest.approx(3.0 + below.height)
    # Each curve of a figure has a colour of its own.
    assert "var(--line-0)" in drawn and "var(--line-1)" in drawn
