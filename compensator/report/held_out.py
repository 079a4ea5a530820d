"""Held-out data on the page of a diagnosis: the waterfall of the error, and a time axis with blocks and runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from compensator.arrays import NAN, Indices, Vector, rms_of
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.choice.outcome import Diagnosis
from compensator.diagnose.fitting.prediction import FOLDS
from compensator.diagnose.words.summary import name
from compensator.report.figure import Bar, Edges, Figure, Line
from compensator.report.local_time import shown, zone_at

#: A gap between measured values is drawn as one if it is longer than this many usual intervals between them.
_GAP = 3.0
#: Line colours of what is left, of what an effect removes, of the remainder, and of what increases the error.
_LEFT, _EFFECT, _REMAINDER, _INCREASE = 1, 2, 3, 0
_NOTE = (
    "Each bar ends at the error with all effects down to it; each block is predicted by a search that did not use it. "
    "Percentages are shares of the mean square without any effect, because mean squares add and rms values do not. "
    "Where effects overlap, the upper one shows what both remove."
)
_INCREASED = " An orange bar, with “increased” beside it, adds to the error."


def waterfall(diagnosis: Diagnosis) -> Figure:
    """Return the error on held-out data as a waterfall: before, what each effect and the remainder remove, after.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    """
    before, after = rms_of(diagnosis.held_out_before), rms_of(diagnosis.held_out_found)
    count = len(list(diagnosis.evidence.blocks(FOLDS)))
    bars = [Bar("base model", f"{before:.2f} µm", 0.0, before, _LEFT)]

    def add(label: str, last: float, line: int, *, hatched: bool = False) -> None:
        first = bars[-1].last
        share = _percent((last**2 - first**2) / before**2 if before else 0.0)
        if share.startswith("+"):
            share, line = f"{share}, increased", _INCREASE
        bars.append(Bar(label, f"{last:.2f} µm ({share})", first, last, line, hatched=hatched))

    for effect, step in diagnosis.stepped:
        add(_found_in(effect, step.searches, count), step.rms_um, _EFFECT)
    named = rms_of(diagnosis.held_out_named) if diagnosis.remainder else after
    if _differs(named, bars[-1].last):
        together = "all effects, paths refitted with them"
        others = "other effects these searches found"
        add(together if diagnosis.evidence.free_paths else others, named, _EFFECT)
    if len(bars) > 1:
        bars.append(Bar("with the effects", f"{named:.2f} µm", 0.0, named, _LEFT))
    if diagnosis.remainder is not None:
        add("remainder (explains nothing)", after, _REMAINDER, hatched=True)
        bars.append(Bar("with the remainder", f"{after:.2f} µm", 0.0, after, _LEFT))
    note = _NOTE + _INCREASED * any(bar.line == _INCREASE for bar in bars)
    edges = [Edges(f"sensor noise, {diagnosis.noise_floor_um:.2f} µm", (diagnosis.noise_floor_um,))]
    if (ceiling := diagnosis.ceiling) is not None:
        edges.append(Edges(f"ceiling: the smallest error tried, {ceiling.least_um:.2f} µm", (ceiling.least_um,)))
    return Figure(
        title="Error on held-out data" + (", and what each effect removes" if len(bars) > 1 else ""),
        x_label="rms error on held-out data, µm",
        y_label="model",
        bars=tuple(bars),
        edges=tuple(edges),
        note=note if diagnosis.effects or diagnosis.remainder else "",
        height=1.1 + 0.5 * len(bars),
    )


def _found_in(effect: FoundEffect, searches: int, of: int) -> str:
    if not effect.effect.observed and searches == 0:
        return f"{name(effect)} (cannot be predicted)"
    return name(effect) if searches == of else f"{name(effect)} (found in {searches} of {of} searches)"


def _percent(share: float) -> str:
    """Return a change in percent with its sign; what is left of nearly everything is not rounded away."""
    text = f"{100.0 * share:+.{1 if 0.99 < abs(share) < 1.0 else 0}f}"
    return "0 %" if text[1:] == "0" else f"{text.replace('-', '−')} %"


def _differs(one: float, other: float) -> bool:
    return abs(one - other) > 0.01 * max(one, other)


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeAxis:
    """Time over all runs, one after another, with the edges of blocks and runs.

    Parameters
    ----------
    hours : numpy.ndarray, shape (n,)
        Time, h.
    run : numpy.ndarray of int, shape (n,)
        Number of the run.
    blocks, runs : tuple of Edges
        Edges of held-out blocks, and starts of runs after the first; empty where there are none.
    label : str
        Label of the axis.
    """

    hours: Vector
    run: Indices
    blocks: tuple[Edges, ...]
    runs: tuple[Edges, ...]
    label: str = "time, h"

    @classmethod
    def of(cls, diagnosis: Diagnosis, since_utc_s: float | None = None) -> Self:
        """Return the time axis of a diagnosis, of data that begin at a time where it is known, s since 1970 UTC."""
        sizes = [record.size for record in diagnosis.evidence.signals]
        run = np.repeat(np.arange(len(sizes)), sizes)
        hours = np.arange(run.size) * (diagnosis.model.period_s / 3600.0)
        starts = np.cumsum(sizes)[:-1]
        block = np.full(run.size, -1)
        masks = list(diagnosis.evidence.blocks(FOLDS))
        for number, mask in enumerate(masks):
            block[mask] = number
        used = np.flatnonzero(block >= 0)
        changes = used[1:][np.diff(block[used]) != 0]
        # Where whole runs are held out, their starts are the edges.
        changes = changes[~np.isin(changes, starts)]
        if diagnosis.could_hide is not None and not diagnosis.evidence.holds_out_recordings:
            # Every so many values are held out: there are no blocks of time.
            changes = changes[:0]
        label = "time, h"
        if since_utc_s is not None and not starts.size:
            first_s = since_utc_s + float(diagnosis.evidence.runs[0].t_s[0])
            label += f" after {shown(first_s)} {zone_at(first_s)}"
        return cls(
            label=label,
            hours=np.asarray(hours),
            run=run,
            blocks=_edges(f"edge between the {len(masks)} held-out blocks", hours[changes]),
            runs=_edges("start of the next run", hours[starts]),
        )

    @property
    def edges(self) -> tuple[Edges, ...]:
        """Edges of blocks and runs."""
        return (*self.blocks, *self.runs)

    @property
    def unnamed(self) -> tuple[Edges, ...]:
        """The same without entries of the legend, for a panel below another."""
        return tuple(replace(edge, name="") for edge in self.edges)

    @property
    def unnamed_runs(self) -> tuple[Edges, ...]:
        """Starts of runs without an entry of the legend."""
        return tuple(replace(edge, name="") for edge in self.runs)

    @property
    def note(self) -> str:
        """Words on several runs, for a note."""
        return f" {int(self.run[-1]) + 1} runs, drawn one after another." if self.runs else ""

    def line(self, name: str, values: Vector, *, weight: float = 1.5) -> Line:
        """Return a curve with its gaps, broken between runs; values measured now and then are joined."""
        known = np.flatnonzero(np.isfinite(values))
        steps = np.diff(known)
        apart = (np.diff(self.run[known]) != 0) | (steps > _GAP * np.median(steps) if steps.size else False)
        at = np.flatnonzero(apart) + 1
        hours = np.insert(self.hours[known], at, self.hours[known][at])
        return Line(name, hours, np.insert(values[known], at, NAN), weight=weight)


def _edges(name: str, at: Vector) -> tuple[Edges, ...]:
    return (Edges(name, tuple(at.tolist())),) if at.size else ()
