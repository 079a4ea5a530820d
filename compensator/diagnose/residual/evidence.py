"""The residual of a model over measured runs, with its nuisances, as the search uses it.

    residual = measured − free run of the base model = Σ effects + nuisances + noise

Nuisances are what every record has and no effect causes: its zero and its unknown initial state. The likelihood
integrates them out, and they are projected out of every residual that is stated, so that they are never mistaken for
an effect.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from compensator.arrays import Mask, Matrix, Vector
from compensator.codes import Remark
from compensator.data.runs import Run, noise_of
from compensator.diagnose.residual.base_run import (
    beginnings,
    context_of,
    effects_of,
    late_error_um,
    signals_of,
    warm_effects_of,
    with_warmths,
    without_noise,
)
from compensator.diagnose.residual.no_causes import no_causes
from compensator.diagnose.residual.noise import NoiseTest, is_far_off, noise_floor, own_error_um
from compensator.diagnose.residual.nuisances import STATE_PRIOR, basis_of, decays_of, freedom_of, zeros_of
from compensator.errors import DataError
from compensator.model.effects import Effect
from compensator.model.effects.hypothesis import COOLEST, EQUAL, Context, Place
from compensator.model.effects.signals import RecordSignals
from compensator.model.thermal_model import ThermalModel

#: Recordings are held out whole where the larger half of them has less than this share of the samples.
LARGEST_GROUP = 0.75
#: Fewest samples of a measured deformation, and fewest values where it was measured now and then.
LEAST_SAMPLES, LEAST_VALUES = 60, 12
#: Least noise of Y: a reading has digits.
LEAST_NOISE_UM = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Residuals and signals of some runs.

    Parameters
    ----------
    model : ThermalModel
        The base model.
    runs : tuple of Run
        Measured data.
    signals : tuple of RecordSignals
        Signals of the base model on each run.
    residual : numpy.ndarray, shape (n,)
        Of all runs, one after another, µm; 0 where it is not used.
    used : numpy.ndarray of bool, shape (n,)
        Samples that take part.
    zeros : numpy.ndarray, shape (n, z)
        A column for each zero that Y counts from, 1 on its samples: each run has one, or several where Y was probed.
    decays : numpy.ndarray, shape (n, k)
        Decays of all times that the base may have, from the begin of each run and after holes, on every sample.
    basis : numpy.ndarray, shape (n, m)
        Orthonormal columns that the nuisances span on the samples used.
    context : Context
        What proposals may build on.
    at_rest : str
        Where the machine is at rest, for the effects that the model has already (`Hypothesis.rest`).
    noise : NoiseTest
        What noise and the base model's own error may leave of the samples used.
    probe_um : float
        White noise of the measured deformation, µm.
    no_causes : mapping of str to Remark
        Channels that cannot be a cause, each with a remark.
    free_paths : bool
        Whether nothing is known of the base's paths: the residual is then the measured deformation itself.
    expected : frozenset of Place
        Effects that another axis of the machine shows: to name one of them is no choice among many.
    """

    model: ThermalModel
    runs: tuple[Run, ...]
    signals: tuple[RecordSignals, ...]
    residual: Vector
    used: Mask
    zeros: Matrix
    decays: Matrix
    basis: Matrix
    context: Context
    at_rest: str
    noise: NoiseTest
    probe_um: float
    no_causes: Mapping[str, Remark]
    free_paths: bool = False
    expected: frozenset[Place] = frozenset()

    @property
    def count(self) -> int:
        """Number of samples used."""
        return self.noise.count

    @property
    def start_k(self) -> float:
        """T_Q − AT at the coolest start, K; 0 where no record begins so warm that it matters."""
        starts = [run.reference[0] - run.reference[1] for run in self.runs]
        return min(starts) if self.context.begins_warm else 0.0

    @property
    def is_sparse(self) -> bool:
        """Whether every run with Y has it measured now and then only, as by a touch probe."""
        return self.noise.freedom > 0

    @property
    def sparse(self) -> tuple[bool, ...]:
        """Whether Y was measured now and then, for each record of signals; what follows the runs is like the last."""
        runs = [run.has_sparse_y for run in self.runs]
        return (*runs, *(runs[-1:] * (len(self.signals) - len(runs))))

    @property
    def y_um(self) -> Vector:
        """Measured deformation on every sample of all runs, shape (n,), µm; NaN where it is missing."""
        return np.concatenate([run.y_um for run in self.runs])

    @property
    def spread_um(self) -> float:
        """Standard deviation of the measured deformation, µm."""
        return float(np.nanstd(self.y_um))

    @property
    def is_far_off(self) -> bool:
        """Whether the calibration of the base missed by more than is granted: its paths lack something."""
        return is_far_off(self.model, self.noise.noise_um, self.spread_um)

    @property
    def deformation_um(self) -> Vector:
        """Measured deformation less the effects that the model has already, shape (n,), µm; 0 where it is not used."""
        paths = np.concatenate([record.share("all") for record in self.signals])
        return np.asarray(np.where(self.used, self.residual + paths, 0.0))

    def without_nuisances(self, columns: Matrix) -> Matrix:
        """Project the nuisances out of columns, which are zero where samples are not used."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def blocks(self, count: int) -> Iterator[Mask]:
        """Yield masks of what is held out: whole recordings where there are several, or else blocks of time.

        Of few values in one recording each takes every so many: a block of time would hold an event that others lack.

        Parameters
        ----------
        count : int
            How many blocks of time with equally many of the samples used; most groups of recordings.
        """
        if self.holds_out_recordings:
            yield from self._recordings(count)
            return
        at = np.flatnonzero(self.used)
        if self.is_sparse:
            for first in range(count):
                yield np.isin(np.arange(self.used.size), at[first::count])
            return
        for low, high in itertools.pairwise(np.linspace(0, at.size, count + 1).astype(int).tolist()):
            block = np.zeros(self.used.size, dtype=bool)
            block[at[low:high]] = True
            yield block

    @property
    def holds_out_recordings(self) -> bool:
        """Whether recordings can be held out: there are several, and no single one has most of the samples."""
        groups = list(self._recordings(2))
        return len(groups) > 1 and max(int(mask.sum()) for mask in groups) < LARGEST_GROUP * self.count

    def _recordings(self, count: int) -> Iterator[Mask]:
        """Yield masks of groups of recordings with about equally many of the samples used."""
        numbers = np.repeat([run.recording for run in self.runs], [run.t_s.size for run in self.runs])
        masks = [self.used & (numbers == number) for number in np.unique(numbers[self.used])]
        groups = [np.zeros(self.used.size, dtype=bool) for _ in range(min(count, len(masks)))]
        for mask in sorted(masks, key=np.sum, reverse=True):
            smallest = min(range(len(groups)), key=lambda i: int(groups[i].sum()))
            groups[smallest] = groups[smallest] | mask
        yield from groups

    def samples_of_runs(self) -> list[slice]:
        """Return where the samples of each run are."""
        ends = np.cumsum([0, *(record.size for record in self.signals)]).tolist()
        return [slice(first, end) for first, end in itertools.pairwise(ends)]

    def without(self, mask: Mask) -> Evidence:
        """Return the evidence without some of its samples."""
        used = self.used & ~mask
        basis = basis_of(np.concatenate([self.zeros, self.decays], axis=1), used)
        freedom = freedom_of(used, basis) if self.is_sparse else 0
        return dataclasses.replace(
            self,
            residual=np.where(used, self.residual, 0.0),
            used=used,
            basis=basis,
            noise=dataclasses.replace(self.noise, count=int(used.sum()), freedom=freedom),
        )

    def with_free_paths(self) -> Evidence:
        """Return the evidence for a base that is far off, whose paths are estimated with everything else."""
        return dataclasses.replace(self, residual=self.deformation_um, free_paths=True)

    @property
    def has_initial_state(self) -> bool:
        """Whether it is known what the initial state of the paths adds."""
        return any(own.initial_um is not None for own in self.signals)

    def with_initial_state(self, initial_um: Vector | None) -> Evidence:
        """Return the evidence with what the initial state of the paths adds on every sample, µm; None: not known."""
        parts = [None if initial_um is None else initial_um[run] for run in self.samples_of_runs()]
        signals = [dataclasses.replace(own, initial_um=part) for own, part in zip(self.signals, parts, strict=True)]
        return dataclasses.replace(self, signals=tuple(signals))

    def corrected(self, late: Effect) -> tuple[Evidence, Vector]:
        """Return the evidence with a late T_Q corrected as the engine does, and what that adds to y on every sample."""
        model = dataclasses.replace(self.model, effects=(*self.model.effects, late))
        signals = tuple(
            dataclasses.replace(
                signals_of(model, run, own.number, own.begins_min), warmths=own.warmths, initial_um=own.initial_um
            )
            for run, own in zip(self.runs, self.signals, strict=True)
        )
        before, after = (
            np.concatenate([r.share("all") + effects_of(m, run) for r, run in zip(rs, self.runs, strict=True)])
            for m, rs in ((self.model, self.signals), (model, signals))
        )
        added = after - before
        residual = np.where(self.used, self.residual - added, 0.0)
        return dataclasses.replace(self, model=model, signals=signals, residual=residual), added

    def left(self, added: Vector, *, at_rest: bool = False) -> Vector:
        """Return the residual less effects and less the nuisances as the samples used know them, on every sample.

        Parameters
        ----------
        added : numpy.ndarray, shape (n,)
            What effects add to Y, µm.
        at_rest : bool
            Whether only the zeros are unknown, and not the initial states.
        """
        open_ = self.residual - added
        table = self.zeros if at_rest else np.concatenate([self.zeros, self.decays], axis=1)
        coefficients = np.linalg.lstsq(table[self.used], open_[self.used], rcond=STATE_PRIOR)[0]
        return np.asarray(open_ - table @ coefficients)


def evidence_of(model: ThermalModel, runs: Sequence[Run]) -> Evidence:
    """Form the residual of a model over runs.

    Parameters
    ----------
    model : ThermalModel
        The base model.
    runs : sequence of Run
        Measured data with y.

    Raises
    ------
    DataError
        If there is no y in it.
    """
    names = ", ".join(dict.fromkeys(run.name for run in runs))
    apart = no_causes(names, runs)
    runs = [run.bridging(model.channels) for run in runs]
    courses = [without_noise(run) for run in runs]
    runs = [run.counting_from(course.reference) for run, course in zip(runs, courses, strict=True)]
    begins = beginnings(runs)
    signals = [signals_of(model, run, i, begins[i]) for i, run in enumerate(courses)]
    signals = with_warmths(model, runs, signals)
    cold = [effects_of(model, run) for run in courses]
    used = np.concatenate([np.isfinite(run.y_um) & ~run.in_holes for run in runs])
    # A part in which Y was never measured says nothing of how it is measured.
    sparse = all(run.has_sparse_y for run in runs if np.isfinite(run.y_um).any())
    if used.sum() < (LEAST_VALUES if sparse else LEAST_SAMPLES):
        if sparse and used.any():
            raise DataError(f"{names}: y_um has {int(used.sum())} values, expected at least {LEAST_VALUES}")
        raise DataError(
            f"{names}: {int(used.sum())} samples of {model.period_s:g} s with y_um, expected at least {LEAST_SAMPLES}"
        )
    context = context_of(model, signals, apart)
    zeros = np.asarray(block_diag(*(zeros_of(run.zero_numbers) for run in runs)))
    after = [decays_of(own, context, run.holes) for run, own in zip(runs, signals, strict=True)]
    decays = np.asarray(block_diag(*after))
    basis = basis_of(np.concatenate([zeros, decays], axis=1), used)

    def residual_of(rest: str) -> Vector:
        """Return the residual if the machine is at rest there, which effects of the model may count from."""
        parts = [
            run.y_um - own.y_dtf_um - own.y_tdtf_um - (effects + warm_effects_of(model, own, rest))
            for run, own, effects in zip(runs, signals, cold, strict=True)
        ]
        return np.where(used, np.concatenate(parts), 0.0)

    def left(rest: str) -> float:
        open_ = residual_of(rest)
        return float(np.linalg.norm(open_ - basis @ (basis.T @ open_)))

    at_rest = min((COOLEST, EQUAL) if context.begins_warm else (COOLEST,), key=left)
    runs = _levelled(runs, residual_of(at_rest))
    residual = residual_of(at_rest)
    noise_um = math.hypot(noise_floor(model, runs), late_error_um(model, courses, signals))
    spread_um = float(np.nanstd(np.concatenate([run.y_um for run in runs])))
    # The noise of a value that was measured now and then is none of the calibration's.
    own_um = own_error_um(model, 0.0 if sparse else noise_um, spread_um)
    count, freedom = int(used.sum()), freedom_of(used, basis) if sparse else 0
    return Evidence(
        model=model,
        runs=tuple(runs),
        signals=tuple(signals),
        residual=residual,
        used=used,
        zeros=zeros,
        decays=decays,
        basis=basis,
        context=context,
        at_rest=at_rest,
        noise=NoiseTest(count=count, noise_um=noise_um, own_error_um=own_um, freedom=freedom),
        probe_um=max(noise_of(runs)["y_um"], LEAST_NOISE_UM),
        no_causes=apart,
    )


def _levelled(runs: Sequence[Run], residual: Vector) -> list[Run]:
    """Return runs without the steps of Y at their zeros: they are set so that the model errs by one mean about each.

    How large they are is not known, and what is found does not depend on it: each zero is free.
    """
    errors = np.split(residual, np.cumsum([run.t_s.size for run in runs])[:-1])
    return [_without_steps(run, error) for run, error in zip(runs, errors, strict=True)]


def _without_steps(run: Run, error: Vector) -> Run:
    if not run.zeros_s:
        return run
    numbers, measured, y_um = run.zero_numbers, np.isfinite(run.y_um) & ~run.in_holes, run.y_um
    means = [np.mean(error[measured & (numbers == number)]) for number in range(len(run.zeros_s) + 1)]
    return dataclasses.replace(run, y_um=y_um - (np.array(means) - means[0])[numbers])
