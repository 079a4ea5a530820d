"""Order selection: the number of modes, by the free-run error on held-out blocks.

A fold is a block of time whose measured deformation is held out while the model is fitted to the other blocks; the
model runs through it, because its inputs are known. Only the initial state behind a gap may be taken from it. The
simplest structure is chosen whose held-out error exceeds the smallest by at most one standard error. Structures whose
amplitudes the data do not determine are excluded.

Where Y was measured now and then, blocks have few values and differ by chance; the structure is then chosen by Akaike's
information criterion, corrected for few values (Hurvich and Tsai, Biometrika 1989).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from compensator.arrays import Vector
from compensator.axes import label_of
from compensator.errors import DataError
from compensator.identify.arx import starts
from compensator.identify.output_error import OutputErrorFit, Segment, Structure, fit_output_error
from compensator.progress import Progress, unreported

#: Time constants that differ by less than this share coincide.
TWINS = 0.05
#: What a fit has seen of a segment shows its zero and initial state from this share on.
SEEN = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class TriedStructure:
    """A structure that was tried, and its held-out error.

    Parameters
    ----------
    structure : Structure
        Orders.
    rms : float
        Root mean square of the free-run error on the held-out folds.
    fold_rms : tuple of float
        The same for each fold.
    supported : bool
        Whether the data determines its amplitudes, see `is_supported`.
    squares : float
        Sum of squares of the residual of the fit to everything.
    parameters : int
        Number of parameters of that fit, with initial states and zeros.
    information : float
        Akaike's criterion where it chooses; NaN elsewhere.
    chosen : bool
        Whether it was chosen.
    shared_with : tuple of str
        Axes with which it has common time constants.
    """

    structure: Structure
    rms: float
    fold_rms: tuple[float, ...]
    supported: bool
    squares: float
    parameters: int
    information: float = math.nan
    chosen: bool = False
    shared_with: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The structure in words."""
        others = ", ".join(map(label_of, self.shared_with))
        return f"{self.structure}{f', time constants shared with {others}' if others else ''}"


def fit(
    segments: Sequence[Segment], structure: Structure, period_s: float, warm: Sequence[float] | None = None
) -> OutputErrorFit:
    """Fit from ARX's poles and two spreads of time constants, or from the time constants of a similar fit."""
    begin = [list(warm)] if warm is not None else starts(segments, structure, period_s=period_s)
    return fit_output_error(segments, structure, period_s=period_s, starts=begin)


def folds_of(segments: Sequence[Segment], count: int) -> Iterator[list[Segment]]:
    """Yield the segments with one block after another of the samples held out."""
    order = np.cumsum(np.concatenate([segment.used for segment in segments])) - 1
    edges = np.linspace(0, order[-1] + 1, count + 1).astype(int)
    parts = np.split(order, np.cumsum([segment.y.size for segment in segments])[:-1])
    for low, high in pairwise(edges.tolist()):
        yield [
            dataclasses.replace(segment, used=segment.used & ~((at >= low) & (at < high)))
            for segment, at in zip(segments, parts, strict=True)
        ]


def sees_start(segments: Sequence[Segment], part: Sequence[Segment], i: int) -> bool:
    """Whether a part shows how a segment begins, or does not have to.

    Of the first segment it has to: a calibration mostly begins at rest, and any other initial state must foretell the
    block that hides it. How warm the machine is behind a gap nothing else shows.
    """
    return i == 0 or bool(part[i].used[np.argmax(segments[i].used)])


def held_out_errors(fit: OutputErrorFit, segments: Sequence[Segment], part: Sequence[Segment]) -> Vector:
    """Return the free-run errors of a fit to a part of the samples on those that it did not see.

    A segment of which the part has less than `SEEN`, or not the beginning, shows its zero and initial state in its own
    samples alone: they are fitted to these. What is left is the error of the paths, less what a state takes in.
    """
    errors = [np.zeros(0)]
    for i, (residual, whole, seen) in enumerate(zip(fit.residuals, segments, part, strict=True)):
        held = whole.used & ~seen.used
        if held.any():
            is_known = seen.used.sum() >= SEEN * whole.used.sum() and (whole.rest or sees_start(segments, part, i))
            errors.append((residual if is_known else fit.about_own_start(residual, whole))[held])
    return np.concatenate(errors)


@dataclass(frozen=True, slots=True, kw_only=True)
class FitWithFolds:
    """A structure fitted to everything and, fold by fold, to the rest.

    Parameters
    ----------
    structure : Structure
        Orders.
    whole : OutputErrorFit
        The fit to everything.
    errors : tuple of numpy.ndarray
        Free-run errors on each fold of the fit to the other folds.
    sees_start : tuple of (tuple of bool)
        For each fold and each segment `sees_start`.
    """

    structure: Structure
    whole: OutputErrorFit
    errors: tuple[Vector, ...]
    sees_start: tuple[tuple[bool, ...], ...]

    @property
    def fold_rms(self) -> tuple[float, ...]:
        """Root mean square of the errors on each fold."""
        return tuple(float(np.sqrt(np.mean(e**2))) for e in self.errors)


def fit_with_folds(segments: Sequence[Segment], structure: Structure, period_s: float, folds: int) -> FitWithFolds:
    """Fit a structure to everything, and to all but one fold after another."""
    whole = fit(segments, structure, period_s)
    errors, seen = [], []
    for part in folds_of(segments, folds):
        if sum(int(segment.used.sum()) for segment in part) == 0:
            continue
        found = held_out_errors(fit(part, structure, period_s, warm=whole.taus_min.tolist()), segments, part)
        if found.size:
            errors.append(found)
            seen.append(tuple(sees_start(segments, part, i) for i in range(len(segments))))
    return FitWithFolds(structure=structure, whole=whole, errors=tuple(errors), sees_start=tuple(seen))


def choose(
    segments: Sequence[Segment],
    structures: Sequence[Structure],
    *,
    period_s: float,
    folds: int,
    known: FitWithFolds | None = None,
    progress: Progress = unreported,
) -> tuple[list[TriedStructure], OutputErrorFit]:
    """Evaluate structures on folds and mark the chosen one.

    Parameters
    ----------
    segments : sequence of Segment
        Data.
    structures : sequence of Structure
        Candidates.
    period_s : float
        Sample period, s.
    folds : int
        Number of blocks.
    known : FitWithFolds, optional
        A structure that was tried on these data before.
    progress : callable
        Called with the number of structures done and their total.

    Returns
    -------
    list of TriedStructure
        In the order given, one of them chosen.
    OutputErrorFit
        Its fit to everything.

    Raises
    ------
    DataError
        If the data is too short for every candidate.
    """
    candidates: list[TriedStructure] = []
    fits: dict[Structure, OutputErrorFit] = {}
    before = {known.structure: known} if known is not None else {}
    for done, structure in enumerate(structures):
        progress(done, len(structures))
        try:
            found = before.get(structure) or fit_with_folds(segments, structure, period_s, folds)
        except DataError:
            continue
        candidates.append(_tried_structure(segments, found))
        fits[structure] = found.whole
    if not candidates:
        raise DataError(f"too little data for the smallest structure ({structures[0]})")
    prior = structures[0].prior
    if prior is not None:
        candidates = _with_information(candidates, sum(int(s.used.sum()) for s in segments), prior.noise)
    among = [c for c in candidates if c.supported] or candidates
    if prior is not None:
        winner = min(among, key=lambda c: c.information)
    else:
        best = min(among, key=lambda c: c.rms)
        winner = min(
            (c for c in among if no_worse(c.fold_rms, best.fold_rms)), key=lambda c: (c.structure.parameters, c.rms)
        )
    return [dataclasses.replace(c, chosen=c is winner) for c in candidates], fits[winner.structure]


def _with_information(candidates: Sequence[TriedStructure], count: int, noise: float) -> list[TriedStructure]:
    """Return candidates with Akaike's criterion, corrected for few values."""
    # A noise that was stated too small must not ask for more and more parameters.
    variance = max(noise**2, min(c.squares / (count - c.parameters) for c in candidates))
    return [
        dataclasses.replace(
            c, information=c.squares / variance + 2.0 * c.parameters * count / max(count - c.parameters - 1, 1)
        )
        for c in candidates
    ]


def _tried_structure(segments: Sequence[Segment], found: FitWithFolds) -> TriedStructure:
    structure, whole = found.structure, found.whole
    return TriedStructure(
        structure=structure,
        rms=float(np.sqrt(np.mean(np.concatenate(found.errors) ** 2))),
        fold_rms=found.fold_rms,
        supported=is_supported(whole),
        squares=float(sum(np.sum(r[s.used] ** 2) for r, s in zip(whole.residuals, segments, strict=True))),
        parameters=structure.parameters + sum(own.size for own in whole.nuisances),
    )


def is_supported(fit: OutputErrorFit) -> bool:
    """Whether the data determines the amplitudes of a fit.

    They may also be so many that large gains cancel on the data, held-out blocks included, and elsewhere run free. Then
    time constants coincide, and the gain at rest of the first input is less than its standard error.
    """
    gain, std = fit.gain()
    return fit.rank_deficit == 0 and (abs(gain) > std or not coincide(fit.taus_min.tolist()))


def coincide(taus_min: Sequence[float]) -> list[float]:
    """Return time constants, min, that the next longer one exceeds by less than `TWINS`."""
    return [short for short, long in pairwise(sorted(taus_min)) if long < (1.0 + TWINS) * short]


def no_worse(fold_rms: Sequence[float], best: Sequence[float]) -> bool:
    """Whether mean squares on the folds exceed the smallest by no more than one standard error of the excess."""
    worse = np.array(fold_rms) ** 2 - np.array(best) ** 2
    if worse.size < 2:
        return bool(worse.mean() <= 0.0)
    return bool(worse.mean() <= worse.std(ddof=1) / np.sqrt(worse.size))
