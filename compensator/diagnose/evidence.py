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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from compensator.arrays import Mask, Matrix, Vector
from compensator.data.runs import Run, noise_of, noise_std
from compensator.diagnose.noise import NoiseTest, drive_of, noise_floor, own_error
from compensator.diagnose.smoothing import course
from compensator.errors import DataError
from compensator.model.effects import Effect
from compensator.model.effects.hypothesis import DEGC, Context
from compensator.model.effects.signals import RecordSignals
from compensator.model.engine import Engine
from compensator.model.late_observer import observe
from compensator.model.thermal_model import ThermalModel
from compensator.model.transfer_function import SampledTransferFunction

#: An initial state moves y by no more than about this many times its spread, with the weight of one sample.
STATE_PRIOR = 1e-3
#: Fastest decay of an initial state, samples, and the largest ratio of neighbouring decays.
FASTEST, DECAY_RATIO = 2.0, 3.5
#: Recordings are held out whole where the larger half of them has less than this share of the samples.
LARGEST_GROUP = 0.75
#: Fewest samples of a measured deformation, and fewest values where it was measured now and then.
LEAST_SAMPLES, LEAST_VALUES = 60, 12
#: Least noise of Y: a reading has digits.
LEAST_NOISE_UM = 1e-3
#: A displacement is an effect, never a cause: another probe follows Y whatever moves it.
_DISPLACEMENT = "_um"
#: A channel whose span is less than this many of its noise deviations does not move.
MOVES = 8.0


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
    nuisances : numpy.ndarray, shape (n, k)
        A constant and decays of all times that the base may have, of each run, on every sample.
    basis : numpy.ndarray, shape (n, m)
        Orthonormal columns that the nuisances span on the samples used.
    context : Context
        What proposals may build on.
    noise : NoiseTest
        What noise and the base model's own error may leave of the samples used.
    probe_um : float
        White noise of the measured deformation, µm.
    free_paths : bool
        Whether nothing is known of the base's paths: the residual is then the measured deformation itself.
    """

    model: ThermalModel
    runs: tuple[Run, ...]
    signals: tuple[RecordSignals, ...]
    residual: Vector
    used: Mask
    nuisances: Matrix
    basis: Matrix
    context: Context
    noise: NoiseTest
    probe_um: float
    free_paths: bool = False

    @property
    def count(self) -> int:
        """Number of samples used."""
        return self.noise.count

    @property
    def is_sparse(self) -> bool:
        """Whether every run has Y measured now and then only, as by a touch probe."""
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
    def deformation_um(self) -> Vector:
        """Measured deformation less the effects that the model has already, shape (n,), µm; 0 where it is not used."""
        paths = np.concatenate([record.share("all") for record in self.signals])
        return np.asarray(np.where(self.used, self.residual + paths, 0.0))

    def without_nuisances(self, columns: Matrix) -> Matrix:
        """Project the nuisances out of columns, which are zero where samples are not used."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def blocks(self, count: int) -> Iterator[Mask]:
        """Yield masks of what is held out: whole recordings where there are several, or else blocks of time.

        Of few values each takes every so many of them: a block of time would hold an event that the others lack.

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
        masks = [self.used & (numbers == number) for number in np.unique(numbers)]
        groups = [np.zeros(self.used.size, dtype=bool) for _ in range(min(count, len(masks)))]
        for mask in sorted(masks, key=np.sum, reverse=True):
            smallest = min(range(len(groups)), key=lambda i: int(groups[i].sum()))
            groups[smallest] = groups[smallest] | mask
        yield from groups

    def without(self, mask: Mask) -> Evidence:
        """Return the evidence without some of its samples."""
        used = self.used & ~mask
        basis = _basis(self.nuisances, used)
        freedom = _freedom(used, basis) if self.is_sparse else 0
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

    def corrected(self, late: Effect) -> tuple[Evidence, Vector]:
        """Return the evidence with a late T_Q corrected as the engine does, and what that adds to y on every sample."""
        model = dataclasses.replace(self.model, effects=(*self.model.effects, late))
        signals = tuple(
            signals_of(model, run, own.number, own.begins_min) for run, own in zip(self.runs, self.signals, strict=True)
        )
        before, after = (
            np.concatenate([r.share("all") + effects_of(m, run) for r, run in zip(rs, self.runs, strict=True)])
            for m, rs in ((self.model, self.signals), (model, signals))
        )
        added = after - before
        residual = np.where(self.used, self.residual - added, 0.0)
        return dataclasses.replace(self, model=model, signals=signals, residual=residual), added

    def left(self, raw: Vector, effects: Vector, *, at_rest: bool) -> Vector:
        """Return a raw residual less effects and less the nuisances as the samples used know them, on every sample.

        A run of which no sample is used has its zero from its own mean.

        Parameters
        ----------
        raw, effects : numpy.ndarray, shape (n,)
            Residual of the base model, and what is subtracted from it, µm.
        at_rest : bool
            Whether only the zero of each run is unknown, and not its initial state.
        """
        open_ = raw - effects
        table = self.nuisances[:, :: self.nuisances.shape[1] // len(self.signals)] if at_rest else self.nuisances
        coefficients = np.linalg.lstsq(table[self.used], open_[self.used], rcond=STATE_PRIOR)[0]
        left = np.asarray(open_ - table @ coefficients)
        measured, first = np.isfinite(self.y_um), 0
        for record in self.signals:
            own = slice(first, first + record.size)
            if not self.used[own].any() and measured[own].any():
                left[own] -= left[own][measured[own]].mean()
            first += record.size
        return left


def _beginnings(runs: Sequence[Run]) -> list[float]:
    """Return when each run begins after the start of the first, min: by its own time, or after the one before."""
    begins: list[float] = []
    end = first = runs[0].t_s[0]
    for run in runs:
        start = max(end, run.t_s[0])
        begins.append(float(start - first) / 60.0)
        end = start + run.t_s[-1] - run.t_s[0]
    return begins


def signals_of(model: ThermalModel, run: Run, number: int = 0, begins_min: float = 0.0) -> RecordSignals:
    """Run the base model's paths over a run.

    The heat is that of the plain inverse, without lag and linear; where the model corrects a late T_Q, that of the
    engine, which cannot know more.
    """
    tdtf = model.tdtf.sampled if model.tdtf else SampledTransferFunction(b=(0.0,), a=(1.0,), period_s=model.period_s)
    if model.late_t_q is None:
        drive, ambient_k = drive_of(model, run.difference_k), run.ambient_k
        y_dtf_um, y_tdtf_um = model.dtf.sampled.response(drive), tdtf.response(ambient_k)
    else:
        t_q_degc, at_degc = run.reference
        seen = observe(model, run.t_q_degc - t_q_degc, run.at_degc - at_degc)
        drive, ambient_k, y_dtf_um, y_tdtf_um = seen.drive, seen.ambient_k, seen.y_dtf_um, seen.y_tdtf_um
    return RecordSignals(
        period_min=model.period_s / 60.0,
        drive=drive,
        ambient_k=ambient_k,
        y_dtf_um=y_dtf_um,
        y_tdtf_um=y_tdtf_um,
        channels={name: values for name, values in run.channels.items() if np.isfinite(values).all()},
        share_of_ambient=model.dtf.sampled.response(drive_of(model, run.ambient_k)),
        number=number,
        begins_min=begins_min,
    )


def effects_of(model: ThermalModel, run: Run) -> Vector:
    """Return what the effects that the model already has add, µm."""
    if not model.effects:
        return np.zeros(run.t_s.size)
    if model.late_t_q is None:
        model = dataclasses.replace(model, estimator=dataclasses.replace(model.estimator, method="inverse"))
    engine = Engine(model)
    engine.set_reference(*run.reference)
    return np.array([sum(e.y_effects_um) for e in engine.run(run.t_q_degc, run.at_degc, run.channels)])


def _without_noise(run: Run) -> Run:
    """Return a run with the courses of T_Q and AT in place of their readings."""
    t_q, at = run.difference_k + run.ambient_k, run.ambient_k
    t_q, at = course(t_q, noise_std(t_q)), course(at, noise_std(at))
    return dataclasses.replace(run, difference_k=t_q - at, ambient_k=at)


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
    courses = [_without_noise(run) for run in runs]
    begins = _beginnings(runs)
    signals = [signals_of(model, run, i, begins[i]) for i, run in enumerate(courses)]
    parts = [
        run.y_um - own.y_dtf_um - own.y_tdtf_um - effects_of(model, run)
        for run, own in zip(courses, signals, strict=True)
    ]
    residual = np.concatenate(parts)
    used = np.isfinite(residual)
    names, sparse = ", ".join(dict.fromkeys(run.name for run in runs)), all(run.has_sparse_y for run in runs)
    if used.sum() < (LEAST_VALUES if sparse else LEAST_SAMPLES):
        if sparse and used.any():
            raise DataError(f"{names}: y_um has {int(used.sum())} values, expected at least {LEAST_VALUES}")
        raise DataError(
            f"{names}: {int(used.sum())} samples of {model.period_s:g} s with y_um, expected at least {LEAST_SAMPLES}"
        )
    noise_um = math.hypot(noise_floor(model, runs), _late_error_um(model, courses, signals))
    spread_um = float(np.nanstd(np.concatenate([run.y_um for run in runs])))
    context = _context(model, runs, signals)
    nuisances = np.asarray(block_diag(*(nuisances_of(record, context) for record in signals)))
    basis = _basis(nuisances, used)
    # The noise of a value that was measured now and then is none of the calibration's.
    own_um = own_error(model, 0.0 if sparse else noise_um, spread_um)
    count, freedom = int(used.sum()), _freedom(used, basis) if sparse else 0
    return Evidence(
        model=model,
        runs=tuple(runs),
        signals=tuple(signals),
        residual=np.where(used, residual, 0.0),
        used=used,
        nuisances=nuisances,
        basis=basis,
        context=context,
        noise=NoiseTest(count=count, noise_um=noise_um, own_error_um=own_um, freedom=freedom),
        probe_um=max(noise_of(runs)["y_um"], LEAST_NOISE_UM),
    )


def _late_error_um(model: ThermalModel, runs: Sequence[Run], signals: Sequence[RecordSignals]) -> float:
    """Return what the engine does not know in time of a late T_Q: against a correction with the future, µm rms."""
    late = next((effect for effect in model.effects if effect.lateness is not None), None)
    if late is None:
        return 0.0
    prompt, errors = model.with_prompt_t_q(), []
    for run, own in zip(runs, signals, strict=True):
        seen = signals_of(prompt, run)
        errors.append(own.y_dtf_um - seen.y_dtf_um - late.columns(seen, ())[:, 0])
    return float(np.std(np.concatenate(errors)))


def _freedom(used: Mask, basis: Matrix) -> int:
    """Return the number of values less what the nuisances may absorb, at least 1."""
    return max(int(used.sum()) - int(basis.shape[1]), 1)


def _basis(nuisances: Matrix, used: Mask) -> Matrix:
    """Return orthonormal columns that the nuisances span on the samples used."""
    u, s, _ = np.linalg.svd(np.where(used[:, None], nuisances, 0.0), full_matrices=False)
    return u[:, s > STATE_PRIOR * s[0]]


def nuisances_of(record: RecordSignals, context: Context) -> Matrix:
    """Return a constant and decays from the fastest that can be seen to the base's slowest mode, each of size 1."""
    fastest = FASTEST * record.period_min
    slowest = max([3.0 * fastest, *(t for values in context.taus_min.values() for t in values)])
    taus = np.geomspace(fastest, slowest, 1 + math.ceil(math.log(slowest / fastest, DECAY_RATIO))).tolist()
    return np.column_stack([np.ones(record.size), *(np.exp(-record.minutes / tau) for tau in taus)])


def _context(model: ThermalModel, runs: Sequence[Run], signals: Sequence[RecordSignals]) -> Context:
    common = [name for name in signals[0].channels if all(name in record.channels for record in signals)]
    spans, zeroed = {}, set()
    for name in common:
        if name.endswith(_DISPLACEMENT):
            continue
        values = np.concatenate([record.channels[name] for record in signals])
        if np.ptp(values) > MOVES * noise_std(values) and np.ptp(values) > 0.0:
            spans[name] = float(np.ptp(values))
            if np.min(np.abs(values)) < 0.05 * np.ptp(values) and not name.endswith(DEGC):
                zeroed.add(name)
    paths = {name: path.sampled for name, path in (("DTF", model.dtf), ("TDTF", model.tdtf)) if path is not None}
    both = (("DTF", model.dtf), ("TDTF", model.tdtf))
    known = {name: path.gain_with_std() for name, path in both if path is not None}
    gains = {name: (gain, std if math.isfinite(std) else 0.0) for name, (gain, std) in known.items()}
    sizes = {name: max(float(np.ptp(record.share(name))) for record in signals) for name in ("DTF", "TDTF")}
    return Context(
        has_ambient=model.tdtf is not None,
        has_ttf=model.ttf is not None,
        minutes=max(record.size for record in signals) * signals[0].period_min,
        span_min=signals[-1].begins_min + signals[-1].size * signals[-1].period_min,
        period_min=signals[0].period_min,
        sizes_um=sizes,
        taus_min={name: tuple(t for t in path.time_constants_min() if t > 0.0) for name, path in paths.items()},
        spans=spans,
        zeroed=frozenset(zeroed),
        approximate=model.held_out_rms_um is not None,
        has_late_t_q=model.late_t_q is not None,
        functions={name: (path.b, path.a) for name, path in paths.items()},
        gains=gains,
    )
