"""DTF and TDTF by the paper's four methods, with the order chosen on held-out blocks.

Methods I to III first subtract the ambient's share of the deformation (the paper's equation 1),

    δ_Q = δ_y − TDTF · ΔAT,

with a TDTF that is given (I) or fitted to a test without heat source (ETVE, ISO 230-3: the whole test, II, or its
end, III), and fit the DTF to the rest. Method IV fits both together, with a common denominator.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Mask, Vector
from compensator.data.runs import Run
from compensator.errors import DataError
from compensator.identify.choice import FitWithFolds, TriedStructure, choose
from compensator.identify.output_error import OutputErrorFit, Prior, Segment, Structure
from compensator.identify.rest import settle_starts
from compensator.identify.settings import Settings
from compensator.model.transfer_function import SampledTransferFunction, TransferFunction
from compensator.progress import Progress, unreported

#: Numbers of modes considered for an ETVE; the paper's had five.
ETVE_ORDERS = (1, 2, 3, 4, 5)
#: What is known before few values of Y: the gain of the drive is no more than about this many times the ratio of the
#: spreads, that of the air no more than about a column of two metres of steel has, µm/K.
DRIVE_TIMES, AMBIENT_UM_PER_K = 5.0, 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PathFit:
    """A path and its fit.

    Parameters
    ----------
    name : {"TTF", "DTF", "TDTF"}
        Which path.
    fit : OutputErrorFit or None
        None if the path was given.
    column : int
        Number of its input in the fit.
    function : SampledTransferFunction
        Function that the engine evaluates.
    """

    name: str
    fit: OutputErrorFit | None
    column: int
    function: SampledTransferFunction

    @classmethod
    def of(cls, name: str, result: OutputErrorFit, column: int = 0) -> PathFit:
        """Return the path of one input of a fit."""
        return cls(name=name, fit=result, column=column, function=result.function(column))


@dataclass(frozen=True, slots=True, kw_only=True)
class DeformationFit:
    """The fit of DTF and TDTF.

    Parameters
    ----------
    dtf, tdtf : PathFit
        The two paths.
    segments : tuple of Segment
        Data of the DTF's fit, one for each run.
    candidates : tuple of TriedStructure
        Structures considered for the DTF (and TDTF, in method IV).
    etve_candidates : tuple of TriedStructure
        Structures considered for the TDTF on the ETVE.
    remarks : tuple of str
        Remarks for the engineer.
    """

    dtf: PathFit
    tdtf: PathFit
    segments: tuple[Segment, ...]
    candidates: tuple[TriedStructure, ...]
    etve_candidates: tuple[TriedStructure, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def main(self) -> OutputErrorFit:
        """The fit of the DTF."""
        assert self.dtf.fit is not None
        return self.dtf.fit


def fit_deformation(
    runs: Sequence[Run],
    used: Sequence[Mask],
    drives: Sequence[Vector],
    settings: Settings,
    *,
    period_s: float,
    etve: Sequence[Run] = (),
    progress: Progress = unreported,
) -> DeformationFit:
    """Fit DTF and TDTF by one of the four methods.

    Parameters
    ----------
    runs : sequence of Run
        Data.
    used : sequence of array of bool
        Samples of each run that are fitted.
    drives : sequence of numpy.ndarray
        Input of the DTF in each run: heat, W, or T_Q − AT, K.
    settings : Settings
        Method, orders, folds.
    period_s : float
        Sample period, s.
    etve : sequence of Run
        Runs without a heat source, for methods II and III.
    progress : callable
        Called with the number of structures done and their total.

    Raises
    ------
    DataError
        If the method needs an ETVE and none is given, or an order cannot be fitted.
    """
    prior = _prior(runs, used, drives)
    if settings.method == "IV":
        return _together(runs, used, drives, settings, period_s, prior, progress)
    etve_candidates: tuple[TriedStructure, ...] = ()
    if settings.method == "I":
        assert settings.given_tdtf is not None
        tdtf = _given(settings.given_tdtf, period_s)
    else:
        tdtf, etve_candidates = _from_etve(etve, settings, period_s, progress)
    rest = [
        Segment.of(drive, run.y_um - tdtf.function.response(run.ambient_k), mask)
        for run, mask, drive in zip(runs, used, drives, strict=True)
    ]
    if prior is not None:
        prior = dataclasses.replace(prior, gains=prior.gains[:1])
    if settings.order is not None:
        structures = [Structure(order=settings.order[0], terms=(settings.order[1],), prior=prior)]
    else:
        orders = range(1, settings.max_order + 1)
        structures = [Structure(order=n, terms=(n,), prior=prior) for n in orders]
    segments, candidates, result = _chosen(rest, structures, settings, period_s, progress)
    return DeformationFit(
        dtf=PathFit.of("DTF", result),
        tdtf=tdtf,
        segments=tuple(segments),
        candidates=tuple(candidates),
        etve_candidates=etve_candidates,
    )


def _together(
    runs: Sequence[Run],
    used: Sequence[Mask],
    drives: Sequence[Vector],
    settings: Settings,
    period_s: float,
    prior: Prior | None,
    progress: Progress,
) -> DeformationFit:
    data = [
        Segment.of([drive, run.ambient_k], run.y_um, mask) for run, mask, drive in zip(runs, used, drives, strict=True)
    ]
    if settings.order is not None:
        n, nb_dtf, nb_tdtf = settings.order
        structures = [Structure(order=n, terms=(nb_dtf, nb_tdtf), prior=prior)]
    else:
        structures = [
            Structure(order=n, terms=(n, k), prior=prior)
            for n in range(1, settings.max_order + 1)
            for k in range(1, n + 1)
        ]
    segments, candidates, result = _chosen(data, structures, settings, period_s, progress)
    return DeformationFit(
        dtf=PathFit.of("DTF", result, 0),
        tdtf=PathFit.of("TDTF", result, 1),
        segments=tuple(segments),
        candidates=tuple(candidates),
    )


def _prior(runs: Sequence[Run], used: Sequence[Mask], drives: Sequence[Vector]) -> Prior | None:
    """Return what is known of the amplitudes before the data, where Y was measured now and then; None elsewhere."""
    if not any(run.has_sparse_y for run in runs):
        return None
    measured = [run.y_um[mask] - np.mean(run.y_um[mask]) for run, mask in zip(runs, used, strict=True) if mask.any()]
    driven = [drive[run.covered(mask)] for run, mask, drive in zip(runs, used, drives, strict=True) if mask.any()]
    spread = float(np.std(np.concatenate(measured)))
    gain = DRIVE_TIMES * spread / max(float(np.std(np.concatenate(driven))), 1e-9)
    return Prior(noise=max(run.y_noise_um for run in runs), gains=(gain, AMBIENT_UM_PER_K), spread=spread)


def _chosen(
    data: Sequence[Segment], structures: Sequence[Structure], settings: Settings, period_s: float, progress: Progress
) -> tuple[list[Segment], list[TriedStructure], OutputErrorFit]:
    """Determine how the runs start, choose a structure on the held-out blocks and fit it to all data."""
    segments, known = _settled(data, structures[: len(structures) // 2 + 1], settings.folds, period_s)
    candidates, result = choose(
        segments, structures, period_s=period_s, folds=settings.folds, known=known, progress=progress
    )
    return segments, candidates, result


def _settled(
    data: Sequence[Segment], structures: Sequence[Structure], folds: int, period_s: float
) -> tuple[list[Segment], FitWithFolds]:
    """Determine how the runs start with the largest structure for which the data are enough."""
    for structure in reversed(structures[1:]):
        with suppress(DataError):
            return settle_starts(data, structure, period_s, folds)
    return settle_starts(data, structures[0], period_s, folds)


def _given(tdtf: tuple[float, float], period_s: float) -> PathFit:
    gain, tau = tdtf
    function = TransferFunction(numerator=(gain,), denominator=(1.0, tau), unit="um/K").sampled(period_s)
    return PathFit(name="TDTF", fit=None, column=0, function=function)


def _from_etve(
    etve: Sequence[Run], settings: Settings, period_s: float, progress: Progress
) -> tuple[PathFit, tuple[TriedStructure, ...]]:
    if not etve:
        raise DataError(
            f"method {settings.method} needs an ETVE (a run with all heat sources off), expected --etve DATA"
        )
    data = []
    for run in etve:
        used = np.isfinite(run.y_um)
        if settings.method == "III":
            used &= run.t_s >= run.t_s[-1] - settings.etve_end_h * 3600.0
        data.append(Segment.of(run.ambient_k, run.y_um, used))
    orders = ETVE_ORDERS if settings.order is None else (settings.order[0],)
    terms = None if settings.order is None else settings.order[2]
    prior = _prior(etve, [np.isfinite(run.y_um) for run in etve], [run.ambient_k for run in etve])
    if prior is not None:
        prior = dataclasses.replace(prior, gains=prior.gains[1:])
    each = ((n, m) for n in orders for m in ((n, 1) if n > 1 else (1,)))
    structures = [Structure(order=n, terms=(terms or m,), prior=prior) for n, m in each]
    _, candidates, result = _chosen(data, structures, settings, period_s, progress)
    return PathFit.of("TDTF", result), tuple(candidates)
