"""Time constants that several axes have in common: they are of the machine, the gains of an axis.

The outputs of all axes are fitted together with the same poles; amplitudes, initial states and zeros stay those of each
axis. Each residual counts by its standard deviation in the fit of its axis alone, at low frequencies.

Axes share their time constants where the data do not contradict: on held-out blocks of time no axis has a larger error
than by its own fit, apart from a negligible difference. The criterion that chooses the order (`choice.no_worse`) does
not serve here: few blocks that differ much permit an error that is larger by a seventh.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.errors import DataError
from compensator.identify.arx import starts
from compensator.identify.calibration import Calibration, with_deformation
from compensator.identify.choice import TriedStructure, folds_of, held_out_errors, is_supported
from compensator.identify.output_error import (
    OutputErrorFit,
    Segment,
    Structure,
    bounds_of,
    result_of,
    search,
)
from compensator.identify.output_error import _Problem as Problem
from compensator.progress import Progress, unreported

#: A held-out error larger by this share than with time constants of its own is none worth having them.
NEGLIGIBLE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisFit:
    """The data of one axis and the fit of it alone.

    Parameters
    ----------
    segments : tuple of Segment
        Data of the fit.
    fit : OutputErrorFit
        The fit of the axis alone.
    alone : TriedStructure
        Its structure with its errors on held-out blocks.
    """

    segments: tuple[Segment, ...]
    fit: OutputErrorFit
    alone: TriedStructure

    @property
    def weight(self) -> float:
        """What one unit of the residual counts: the reciprocal of its standard deviation at low frequencies."""
        return 1.0 / max(self.fit.sigma * math.sqrt(self.fit.variance_inflation), 1e-12)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shared:
    """Axes with common time constants.

    Parameters
    ----------
    fits : dict of str to OutputErrorFit
        Fit of each axis, with the common poles.
    candidates : dict of str to TriedStructure
        Structure and errors on held-out blocks of each axis.
    """

    fits: Mapping[str, OutputErrorFit]
    candidates: Mapping[str, TriedStructure]

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes."""
        return tuple(self.fits)


class _Joint:
    """The problems of several outputs at the same poles."""

    def __init__(self, problems: Sequence[Problem], weights: Sequence[float]) -> None:
        self.problems, self.weights, self.structure = problems, weights, problems[0].structure

    @property
    def residual(self) -> Vector:
        """Projected residuals of all outputs, each in its standard deviations."""
        return np.concatenate([w * one.residual for w, one in zip(self.weights, self.problems, strict=True)])

    def solve(self, log_taus: Vector) -> None:
        """Project every output at these log time constants."""
        for one in self.problems:
            one.solve(log_taus)

    def fun(self, log_taus: Vector) -> Vector:
        """Return the projected residual."""
        self.solve(log_taus)
        return self.residual

    def jac(self, log_taus: Vector) -> Matrix:
        """Return its Jacobian."""
        tables = [w * one.jac(log_taus) for w, one in zip(self.weights, self.problems, strict=True)]
        return np.concatenate(tables)


def fit_shared(
    outputs: Sequence[Sequence[Segment]],
    structures: Sequence[Structure],
    *,
    period_s: float,
    weights: Sequence[float],
    starts: Sequence[Sequence[float]],
) -> list[OutputErrorFit]:
    """Fit several outputs with common time constants.

    Parameters
    ----------
    outputs : sequence of sequence of Segment
        Data of each output.
    structures : sequence of Structure
        Structure of each: of one order.
    period_s : float
        Sample period, s.
    weights : sequence of float
        What one unit of the residual of each output counts.
    starts : sequence of sequence of float
        Initial time constants, min.

    Returns
    -------
    list of OutputErrorFit
        As the fit of each output alone, at the common time constants, with the standard errors of all data together.

    Raises
    ------
    DataError
        If an output has fewer samples than parameters.
    """
    problems = [Problem(segments, structure, period_s) for segments, structure in zip(outputs, structures, strict=True)]
    for problem, structure in zip(problems, structures, strict=True):
        if problem.count <= structure.parameters + sum(problem.states) + len(problem.segments):
            raise DataError(f"{problem.count} measured sample(s), too few for {structure}")
    bounds = [bounds_of(problem, period_s) for problem in problems]
    search(_Joint(problems, weights), starts, (max(low for low, _ in bounds), min(high for _, high in bounds)))
    return _with_common_errors([result_of(problem) for problem in problems])


def _with_common_errors(fits: Sequence[OutputErrorFit]) -> list[OutputErrorFit]:
    """Return fits at common poles with the covariance that all outputs together leave of them.

    With C the covariance of (log τ, c) of an output alone, what all know of τ together is the sum of C_ττ⁻¹, and the
    amplitudes follow a change of τ by K = C_cτ C_ττ⁻¹.
    """
    order = fits[0].structure.order
    if order == 0:
        return list(fits)
    own = [fit.covariance[:order, :order] for fit in fits]
    common = np.linalg.pinv(np.sum([np.linalg.pinv(one, hermitian=True) for one in own], axis=0), hermitian=True)
    found = []
    for fit, poles in zip(fits, own, strict=True):
        follow = fit.covariance[order:, :order] @ np.linalg.pinv(poles, hermitian=True)
        fixed = fit.covariance[order:, order:] - follow @ poles @ follow.T
        follows = follow @ common
        covariance = np.block([[common, follows.T], [follows, fixed + follows @ follow.T]])
        found.append(dataclasses.replace(fit, covariance=np.asarray(covariance)))
    return found


def share(
    outputs: Mapping[str, AxisFit], *, period_s: float, folds: int, progress: Progress = unreported
) -> list[Shared]:
    """Find the axes that share their time constants, where the data do not contradict.

    All together are tried first, then groups grow by the pair that gains most.

    Parameters
    ----------
    outputs : mapping of str to AxisFit
        Data and fit of each axis alone.
    period_s : float
        Sample period, s.
    folds : int
        Number of held-out blocks.
    progress : callable
        Called with the groups tried and how many may be.

    Returns
    -------
    list of Shared
        Groups of two axes at least; an axis that is in none keeps its own time constants.
    """
    everything = tuple(outputs)
    if len(everything) < 2:
        return []
    tried: dict[frozenset[str], Shared | None] = {}

    def group(axes: Sequence[str]) -> Shared | None:
        key = frozenset(axes)
        if key not in tried:
            progress(len(tried), max(len(everything) * (len(everything) - 1) // 2, len(tried) + 1))
            ordered = [axis for axis in everything if axis in key]
            tried[key] = _shared({axis: outputs[axis] for axis in ordered}, period_s, folds)
        return tried[key]

    if (whole := group(everything)) is not None:
        return [whole]
    groups: list[tuple[str, ...]] = [(axis,) for axis in everything]
    while True:
        merged = [(one, other, group((*one, *other))) for one, other in itertools.combinations(groups, 2)]
        allowed = [(_gain(found, outputs), one, other) for one, other, found in merged if found is not None]
        if not allowed:
            break
        _, one, other = max(allowed)
        groups = [(*one, *other), *(each for each in groups if each not in (one, other))]
    found = [group(axes) for axes in groups if len(axes) > 1]
    return [one for one in found if one is not None]


def _gain(shared: Shared, outputs: Mapping[str, AxisFit]) -> float:
    """Return by what factor the held-out errors become smaller, as the mean of its logarithms."""
    ratios = [math.log(outputs[axis].alone.rms / one.rms) for axis, one in shared.candidates.items()]
    return float(np.mean(ratios))


def _shared(outputs: Mapping[str, AxisFit], period_s: float, folds: int) -> Shared | None:
    """Fit axes together with the best of the structures that they have alone; None where the data contradict."""
    found = []
    for structure in {str(one.alone.structure): one.alone.structure for one in outputs.values()}.values():
        try:
            found.append(_candidates(outputs, structure, period_s, folds))
        except DataError:
            continue
    agreeing = [one for one in found if all(_agrees(c, outputs[axis].alone) for axis, c in one.candidates.items())]
    return max(agreeing, key=lambda one: _gain(one, outputs), default=None)


def _agrees(together: TriedStructure, alone: TriedStructure) -> bool:
    """Whether the data of an axis permit the common time constants."""
    return together.supported and together.rms <= (1.0 + NEGLIGIBLE) * alone.rms


def _candidates(outputs: Mapping[str, AxisFit], structure: Structure, period_s: float, folds: int) -> Shared:
    """Fit axes together with one structure; with their errors on held-out blocks."""
    each = list(outputs.values())
    structures = [dataclasses.replace(structure, prior=one.alone.structure.prior) for one in each]
    weights = [one.weight for one in each]
    begin = [one.fit.taus_min.tolist() for one in each if one.fit.structure.order == structure.order]
    begin += starts(each[0].segments, structures[0], period_s=period_s)

    def fits_of(parts: Sequence[Sequence[Segment]], begin: Sequence[Sequence[float]]) -> list[OutputErrorFit]:
        return fit_shared(parts, structures, period_s=period_s, weights=weights, starts=begin)

    whole = fits_of([one.segments for one in each], begin)
    errors: list[list[Vector]] = [[] for _ in each]
    for parts in zip(*(folds_of(one.segments, folds) for one in each), strict=True):
        for own, one, part, fit in zip(errors, each, parts, fits_of(parts, [whole[0].taus_min.tolist()]), strict=True):
            own.append(held_out_errors(fit, one.segments, part))
    candidates = {}
    for axis, one, own, fit, kind in zip(outputs, each, errors, whole, structures, strict=True):
        candidates[axis] = TriedStructure(
            structure=kind,
            rms=float(np.sqrt(np.mean(np.concatenate(own) ** 2))),
            fold_rms=tuple(float(np.sqrt(np.mean(e**2))) for e in own if e.size),
            supported=is_supported(fit),
            squares=float(sum(np.sum(r[s.used] ** 2) for r, s in zip(fit.residuals, one.segments, strict=True))),
            parameters=kind.parameters + sum(n.size for n in fit.nuisances),
            chosen=True,
            shared_with=tuple(other for other in outputs if other != axis),
        )
    return Shared(fits=dict(zip(outputs, whole, strict=True)), candidates=candidates)


def calibrated_together(
    calibrations: Mapping[str, Calibration], *, progress: Progress
) -> tuple[dict[str, Calibration], tuple[tuple[str, ...], ...]]:
    """Return the calibrations of all axes with common time constants where the data permit, and who has them.

    Parameters
    ----------
    calibrations : mapping of str to Calibration
        Each axis alone.
    progress : callable
        As `share`.
    """
    outputs = {
        axis: AxisFit(
            segments=one.deformation.segments,
            fit=one.deformation.main,
            alone=next(c for c in one.deformation.candidates if c.chosen),
        )
        for axis, one in calibrations.items()
    }
    first = next(iter(calibrations.values()))
    groups = share(outputs, period_s=first.model.period_s, folds=first.settings.folds, progress=progress)
    together = {
        axis: with_deformation(calibrations[axis], fit, group.candidates[axis])
        for group in groups
        for axis, fit in group.fits.items()
    }
    return {**calibrations, **together}, tuple(group.axes for group in groups)
