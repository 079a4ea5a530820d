"""The story of a machine's models: what the loop found, compared, proposed and adopted, by whom, on which figures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from compensator.axes import label_of
from compensator.events import (
    CommandName,
    ComparisonData,
    DiagnosisData,
    EventKind,
    LoopAction,
    LoopData,
    command_of,
    data_of,
)
from compensator.messages import Event
from compensator.report.local_time import shown, zone_at
from compensator.report.notation import plain
from compensator.report.page import Block, Cell, Details, Figure, Line, Marks, Section, Strip, Table, Words

#: Number of steps that are kept; the others are only counted.
STEPS = 400
#: Models whose time in force is drawn one by one.
_MODELS = 8
_BY_LOOP, _BY_OPERATOR = "the loop", "an operator"
_NS, _HALF_DAY_S = 1e-9, 43200.0
#: Why the loop decides after a person's order.
_ORDERS: Mapping[str, str] = {
    CommandName.ADOPT: "by_hand",
    CommandName.BACK: "by_hand",
    CommandName.DISMISS: "dismissed",
}
#: Steps in words; those of every night are counted.
WORDS: Mapping[str, str] = {
    LoopAction.SHADOW: "comparison begins",
    LoopAction.PROPOSE: "proposed",
    LoopAction.WITHDRAW: "proposal withdrawn",
    LoopAction.ADOPT: "adopted",
    LoopAction.BACK: "gone back",
    LoopAction.END: "comparison ended",
    LoopAction.NOTHING: "nothing follows",
    LoopAction.WAIT: "nothing is compared",
    LoopAction.WAIT_OVER: "compared again",
    "refused": "refused",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A step of the story.

    Parameters
    ----------
    at_s : float
        When, s since 1970 UTC.
    what : str
        A `LoopAction`, or `refused`.
    text : str
        The event in one line.
    model_sha256 : str
        The model that it is about; empty where it is about none.
    effects : tuple of str or None
        Its effects; None where the recording does not name them.
    by : str
        Who decided.
    comparison : ComparisonData, optional
        On which figures.
    """

    at_s: float
    what: str
    text: str
    model_sha256: str = ""
    effects: tuple[str, ...] | None = ()
    by: str = _BY_LOOP
    comparison: ComparisonData | None = None


@dataclass(slots=True)
class Story:
    """What happened to a machine's models.

    Parameters
    ----------
    steps : list of Step
        The last steps, in order.
    counts : collections.Counter
        Numbers of all steps by kind.
    diagnoses : collections.Counter
        Numbers of diagnoses by verdict.
    needs : str
        What the last diagnosis asked of a person.
    """

    steps: list[Step] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    diagnoses: Counter[str] = field(default_factory=Counter)
    needs: str = ""
    #: Who gave the last order, by why the loop then decides.
    _senders: dict[str, str] = field(default_factory=dict)
    #: Hashes of what was proposed: the same one again is no other proposal.
    _proposed: set[str] = field(default_factory=set)

    @property
    def is_empty(self) -> bool:
        """Whether no model was ever found, compared or changed."""
        return not self.counts and not self.diagnoses

    def add(self, event: Event) -> None:
        """Add an event; those of other matters are left out."""
        if event.kind == EventKind.LOOP:
            self._add_decision(event)
        elif event.kind == EventKind.DIAGNOSIS:
            found = data_of(event, DiagnosisData)
            if found is not None and not found.without:
                self.diagnoses[found.verdict] += 1
                self.needs = found.needs
        elif event.kind == EventKind.COMMAND and (why := _ORDERS.get(command_of(event))):
            self._senders[why] = str(event.data.get("by", ""))
        elif event.kind == EventKind.ADOPT:
            self._add_exchange(event)

    def _add_decision(self, event: Event) -> None:
        found = data_of(event, LoopData)
        if found is None:
            return
        step = Step(
            at_s=event.time_utc_ns * _NS,
            what=found.step,
            text=event.text,
            model_sha256=found.model_sha256,
            effects=tuple(found.effects),
            by=(self._senders.get(found.why) or _BY_OPERATOR) if found.why in _ORDERS.values() else _BY_LOOP,
            comparison=found.comparison,
        )
        self._append(step)

    def _add_exchange(self, event: Event) -> None:
        """Add a change of the model that an operator has ordered; that of the loop follows from its decision."""
        at_s, data = event.time_utc_ns * _NS, event.data
        effects, sender = data.get("effects"), self._senders.pop("by_hand", "")
        if data.get("by") == "loop":
            return
        comparison = data_of(event, _Compared)
        self._append(
            Step(
                at_s=at_s,
                what=str(data.get("action", CommandName.ADOPT)) if data.get("ok") is True else "refused",
                text=event.text,
                model_sha256=str(data.get("new_sha256", "")),
                effects=tuple(map(str, effects)) if isinstance(effects, list) else None,
                by=sender or _BY_OPERATOR,
                comparison=comparison.comparison if comparison is not None else None,
            )
        )

    def _append(self, step: Step) -> None:
        is_again = step.what == LoopAction.PROPOSE and step.model_sha256 in self._proposed
        self.counts[step.what] += not is_again
        if step.what == LoopAction.PROPOSE:
            self._proposed.add(step.model_sha256)
        if step.what != LoopAction.DIAGNOSE:
            self.steps = [*self.steps[1 - STEPS :], step]


class _Compared(LoopData, frozen=True, kw_only=True):
    """The part of an exchange's data that a decision has, too."""

    step: LoopAction = LoopAction.ADOPT


def figures_of(story: Story) -> dict[str, object]:
    """Return the numbers of the story, for `--json`; empty without any."""
    if story.is_empty:
        return {}
    return {
        "models_story": {
            "diagnoses": sum(story.diagnoses.values()),
            "in_shadow": story.counts[LoopAction.SHADOW],
            "proposed": story.counts[LoopAction.PROPOSE],
            "adopted": story.counts[LoopAction.ADOPT],
            "gone_back": story.counts[LoopAction.BACK],
            "needs": story.needs,
        }
    }


def in_words(story: Story) -> str:
    """Return the story in one sentence; empty without any."""
    if story.is_empty:
        return ""
    counts, made = story.counts, sum(story.diagnoses.values())
    parts = [f"{made} {'diagnosis' if made == 1 else 'diagnoses'}"] if made else []
    names = (
        (LoopAction.SHADOW, "in shadow"),
        (LoopAction.PROPOSE, "proposed"),
        (LoopAction.ADOPT, "adopted"),
        (LoopAction.BACK, "gone back"),
    )
    parts += [f"{counts[step]} {words}" for step, words in names if counts[step]]
    return f"Models: {', '.join(parts)}."


def story_section(
    story: Story,
    *,
    left_by_day: Mapping[float, float],
    in_force: Mapping[str, Sequence[tuple[float, float]]],
    names: Mapping[str, str],
    x_limits: tuple[float, float],
) -> Section:
    """Return the section of the page.

    Parameters
    ----------
    story : Story
        The story.
    left_by_day : mapping of float to float
        What measured Y shows of the error by day: noon, s since 1970 UTC, and µm rms.
    in_force : mapping of str to sequence of (float, float)
        When each model was in force, by hash, s since 1970 UTC.
    names : mapping of str to str
        Names of the models by hash.
    x_limits : tuple of float
        Ends of the time axis.
    """
    blocks: list[Block] = [Words(title="", lines=[in_words(story), *_needs(story)])]
    blocks.append(_picture(story, left_by_day, x_limits))
    if len(in_force) > 1:
        blocks.append(_strips(story, in_force, names, x_limits))
    blocks += story_tables(story)
    return Section(title="The machine's models", blocks=blocks)


def _needs(story: Story) -> list[Cell]:
    return [f"A person is needed: {story.needs}."] if story.needs else []


def _picture(story: Story, left_by_day: Mapping[float, float], x_limits: tuple[float, float]) -> Figure:
    days = sorted(left_by_day)
    y = np.repeat([left_by_day[day] for day in days], 2)
    x = np.column_stack((np.array(days) - _HALF_DAY_S, np.array(days) + _HALF_DAY_S)).ravel()
    top = float(np.nanmax(y)) if y.size and bool(np.isfinite(y).any()) else 1.0
    marks = []
    for what, marker, height in ((LoopAction.ADOPT, "o", 1.08), (LoopAction.BACK, "x", 1.16)):
        at = np.array([step.at_s for step in story.steps if step.what == what])
        if at.size:
            marks.append(Marks(WORDS[what], at, np.full(at.size, height * top), marker=marker))  # type: ignore[arg-type]
    return Figure(
        title="Remaining error, day by day, and changes of the model",
        x_label=f"time, {zone_at(x_limits[1])}",
        y_label="error in Y, µm rms",
        lines=(Line("remaining error with the offset applied", x, y),),
        marks=tuple(marks),
        limits=(0.0,),
        clock=True,
        local=True,
        x_limits=x_limits,
        note="Each step is a day. Measured + offset, or what touch probes found; a day without measured Y is a gap.",
    )


def _strips(
    story: Story,
    in_force: Mapping[str, Sequence[tuple[float, float]]],
    names: Mapping[str, str],
    x_limits: tuple[float, float],
) -> Figure:
    effects = {step.model_sha256: step.effects or () for step in story.steps if step.model_sha256}
    shown = list(in_force.items())[-_MODELS:]
    strips = [
        Strip(_model(sha, names, effects), tuple(pieces), i % 4) for i, (sha, pieces) in enumerate(shown) if pieces
    ]
    return Figure(
        title="Which model was in force",
        x_label=f"time, {zone_at(x_limits[1])}",
        y_label="model",
        strips=tuple(strips),
        clock=True,
        local=True,
        x_limits=x_limits,
        height=1.1 + 0.27 * len(strips),
        note=f"The last {_MODELS} of {len(in_force)} models." if len(in_force) > _MODELS else "",
    )


def _model(sha: str, names: Mapping[str, str], effects: Mapping[str, Sequence[str]]) -> str:
    added = ", ".join(effects.get(sha, ()))
    return f"{sha[:6]} {added or names.get(sha, '')}".strip()


def story_tables(story: Story) -> list[Block]:
    """Return every decision with its figures, and all steps in words."""
    head = [
        f"time, {zone_at(story.steps[-1].at_s if story.steps else math.nan)}",
        "what",
        "by",
        "model, effects",
        "error, µm rms",
        "on what",
    ]
    told = [step for step in story.steps if step.what != LoopAction.NOTHING]
    blocks: list[Block] = []
    if told:
        note = (
            "Error: measured − predicted of the present model → of the other one, over the measured Y or the probes "
            "that were compared; σ: by how many standard deviations they refute the present one."
        )
        blocks.append(Table(head=head, rows=[_row(step) for step in told], note=note))
    lines: list[Cell] = [f"{shown(step.at_s)}: {step.text}" for step in story.steps]
    if lines:
        blocks.append(Details(title=f"All steps in words ({len(lines)})", blocks=[Words(title="", lines=lines)]))
    return blocks


def _row(step: Step) -> list[Cell]:
    found = step.comparison
    is_known = step.model_sha256 and step.effects is not None
    effects = ", ".join(step.effects or ()) or ("no added effect" if is_known else "")
    model = f"{step.model_sha256[:6]} {effects}".strip()
    figures = ["", ""]
    if found is not None:
        compared = {axis: _figures(one) for axis, one in found.by_axis().items()}
        told = {f"{label_of(axis)} " if found.axes else "": one for axis, one in compared.items() if one is not None}
        figures = ["; ".join(f"{axis}{one[i]}" for axis, one in told.items()) for i in (0, 1)]
    return [shown(step.at_s), WORDS.get(step.what, step.what), step.by, model, *figures]


def _figures(found: ComparisonData) -> tuple[str, str] | None:
    """Return both errors, and on what they rest; None if nothing was compared."""
    if found.present_rms_um is None or found.candidate_rms_um is None:
        return None
    measured = f"{found.probes} probes" if found.measured_by == "probe" else f"{found.hours:.3g} h"
    deviations = "" if found.deviations is None else f", {plain(found.deviations, 1)} σ"
    return f"{found.present_rms_um:.1f} → {found.candidate_rms_um:.1f}", f"{measured}{deviations}"
