"""The residual of a model over measured runs, with its nuisances, as the search wants it.

    residual = measured − free run of the base model = Σ effects + nuisances + noise

Nuisances are what every record has and nobody is to blame for: its zero and its unknown initial state. They are
projected out of everything before anything is compared, so that they are never mistaken for an effect.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from compensator.arrays import Mask, Matrix, Vector
from compensator.data.runs import Run, noise_std
from compensator.errors import DataError
from compensator.identify.output_error import low_frequency_ratio
from compensator.model.effects.hypothesis import RecordSignals, Setting
from compensator.model.engine import Engine
from compensator.model.thermal_model import ThermalModel
from compensator.model.transfer_function import SampledTransferFunction

#: An initial state moves y by no more than about this many times its spread, with the weight of one sample.
STATE_PRIOR = 1e-3
#: Largest error of its own that a base model is granted, as a share of the deformation's standard deviation.
OWN_SHARE = 0.02
#: Below this many times the base model's own error nothing is looked for.
OWN_TIMES = 1.3
#: A residual up to this many times the base model's own error may come by itself on another day.
EXPECTED_TIMES = 1.4
#: A sum of squares up to this many times that of noise and own error is noise.
CLEAN_TIMES = 1.3
#: A displacement is what a cause does, never a cause: another probe follows Y whatever moves it.
_OUTCOME = "_um"
#: A channel whose span is less than this many of its noise deviations does not move.
MOVES = 8.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Residuals and signals of some runs.

    Parameters
    ----------
    runs : tuple of Run
        Measured data.
    waves : tuple of RecordSignals
        Signals of the base model on each run.
    residual : numpy.ndarray, shape (n,)
        Of all runs, one after another, µm; 0 where it is not used.
    used : numpy.ndarray of bool, shape (n,)
        Samples that take part.
    nuisances : numpy.ndarray, shape (n, k)
        A constant and the decay of every mode, of each run, on every sample.
    basis : numpy.ndarray, shape (n, m)
        Orthonormal columns that the nuisances span on the samples used.
    setting : Setting
        What proposals may build on.
    noise_um : float
        What the sensors' noise alone makes of the residual, µm.
    own_error_um : float
        What the base model's own error is known to be, from its calibration, µm; 0 where nobody knows.
    """

    runs: tuple[Run, ...]
    waves: tuple[RecordSignals, ...]
    residual: Vector
    used: Mask
    nuisances: Matrix
    basis: Matrix
    setting: Setting
    noise_um: float
    own_error_um: float

    @property
    def count(self) -> int:
        """Number of samples used."""
        return int(self.used.sum())

    @property
    def y_um(self) -> Vector:
        """Measured deformation on every sample of all runs, shape (n,), µm; NaN where it is missing."""
        return _measured(self.runs)

    @property
    def spread_um(self) -> float:
        """Standard deviation of the measured deformation, µm."""
        return float(np.nanstd(self.y_um))

    @property
    def deformation_um(self) -> Vector:
        """Measured deformation less the effects that the model has already, shape (n,), µm; 0 where it is not used."""
        paths = np.concatenate([wave.y_dtf_um + wave.y_tdtf_um for wave in self.waves])
        return np.asarray(np.where(self.used, self.residual + paths, 0.0))

    def without_nuisances(self, columns: Matrix) -> Matrix:
        """Project the nuisances out of columns, which are zero where samples are not used."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    @property
    def allowance(self) -> float:
        """Sum of squares that the base model's own error may leave, µm²: nothing is looked for below it."""
        return self.count * (OWN_TIMES * self.own_error_um) ** 2

    def blocks(self, count: int) -> Iterator[Mask]:
        """Yield masks of blocks of time with equally many of the samples used."""
        at = np.flatnonzero(self.used)
        for low, high in itertools.pairwise(np.linspace(0, at.size, count + 1).astype(int).tolist()):
            block = np.zeros(self.used.size, dtype=bool)
            block[at[low:high]] = True
            yield block

    @property
    def floor(self) -> float:
        """Sum of squares of noise and the base model's own error, as they are known, µm²."""
        return CLEAN_TIMES * self.count * (self.noise_um**2 + self.own_error_um**2)

    @property
    def is_expected(self) -> bool:
        """Whether the residual as it stands is no larger than a calibration that misses by as much leads to expect."""
        left = self.without_nuisances(self.residual)
        return float(left @ left) < self.count * (self.noise_um**2 + (EXPECTED_TIMES * self.own_error_um) ** 2)

    def is_noise(self, cost: float) -> bool:
        """Tell whether a sum of squares is no more than noise and own error."""
        return cost < CLEAN_TIMES * (self.count * self.noise_um**2 + self.allowance)

    def hidden(self, mask: Mask) -> Evidence:
        """Return the evidence without some of its samples."""
        used = self.used & ~mask
        values = np.where(self.used, self.residual, np.nan)
        return gathered(
            self.runs, self.waves, values, used, self.setting, noise_um=self.noise_um, own_error_um=self.own_error_um
        )

    def left(self, raw: Vector, effects: Vector, *, at_rest: bool) -> Vector:
        """Return a raw residual less effects and less the nuisances as the samples used know them, on every sample.

        Parameters
        ----------
        raw, effects : numpy.ndarray, shape (n,)
            Residual of the base model, and what is taken off it, µm.
        at_rest : bool
            Whether only the zero of each run is unknown, and not its initial state.
        """
        open_ = raw - effects
        table = self.nuisances[:, :: self.nuisances.shape[1] // len(self.waves)] if at_rest else self.nuisances
        coefficients = np.linalg.lstsq(table[self.used], open_[self.used], rcond=STATE_PRIOR)[0]
        return np.asarray(open_ - table @ coefficients)

    def parts(self, values: Vector) -> list[Vector]:
        """Cut a signal of all runs into one for each run, samples used only."""
        cuts = np.cumsum([wave.size for wave in self.waves])[:-1]
        pairs = zip(np.split(values, cuts), np.split(self.used, cuts), strict=True)
        return [v[u] for v, u in pairs]

    def colour(self, values: Vector) -> float:
        """Return how much more power a residual has at low frequencies than white noise of its variance."""
        return max(1.0, low_frequency_ratio(self.parts(values)))


def waves_of(model: ThermalModel, run: Run) -> RecordSignals:
    """Run the base model's paths over a run, the heat by the plain inverse: without lag, and linear."""
    drive = run.difference_k
    if model.ttf is not None:
        drive = np.asarray(lfilter(model.ttf.sampled.a, model.ttf.sampled.b, drive))
    tdtf = model.tdtf.sampled if model.tdtf else SampledTransferFunction(b=(0.0,), a=(1.0,), period_s=model.period_s)
    return RecordSignals(
        period_min=model.period_s / 60.0,
        drive=drive,
        ambient_k=run.ambient_k,
        y_dtf_um=model.dtf.sampled.response(drive),
        y_tdtf_um=tdtf.response(run.ambient_k),
        channels={name: values for name, values in run.channels.items() if np.isfinite(values).all()},
        dtf=model.dtf.sampled,
        tdtf=tdtf,
    )


def effects_of(model: ThermalModel, run: Run) -> Vector:
    """Return what the effects that the model already has add, µm."""
    if not model.effects:
        return np.zeros(run.t_s.size)
    exact = dataclasses.replace(model, estimator=dataclasses.replace(model.estimator, method="inverse"))
    engine = Engine(exact)
    engine.set_reference(*run.reference)
    return np.array([sum(e.y_effects_um) for e in engine.run(run.t_q_degc, run.at_degc, run.channels)])


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
    waves = [waves_of(model, run) for run in runs]
    parts = [
        run.y_um - wave.y_dtf_um - wave.y_tdtf_um - effects_of(model, run)
        for run, wave in zip(runs, waves, strict=True)
    ]
    residual = np.concatenate(parts)
    used = np.isfinite(residual)
    if used.sum() < 60:
        names = ", ".join(dict.fromkeys(run.name for run in runs))
        raise DataError(f"{names}: {int(used.sum())} samples of {model.period_s:g} s with y_um, expected at least 60")
    noise_um = noise_floor(model, runs)
    own = float(np.sqrt(max((model.held_out_rms_um or 0.0) ** 2 - noise_um**2, 0.0)))
    # A calibration that misses by more than this has not merely an error of its own, it lacks something.
    own = min(own, OWN_SHARE * float(np.nanstd(_measured(runs))))
    return gathered(runs, waves, residual, used, _setting(model, runs, waves), noise_um=noise_um, own_error_um=own)


def _measured(runs: Sequence[Run]) -> Vector:
    return np.concatenate([run.y_um for run in runs])


def gathered(
    runs: Sequence[Run],
    waves: Sequence[RecordSignals],
    residual: Vector,
    used: Mask,
    setting: Setting,
    *,
    noise_um: float,
    own_error_um: float,
) -> Evidence:
    """Put runs and their residual together with the basis of their nuisances."""
    blocks = [_nuisances(wave, setting) for wave in waves]
    sizes = [wave.size for wave in waves]
    table = np.zeros((sum(sizes), sum(block.shape[1] for block in blocks)))
    row = column = 0
    for block in blocks:
        table[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    seen = np.where(used[:, None], table, 0.0)
    u, s, _ = np.linalg.svd(seen, full_matrices=False)
    basis = u[:, s > STATE_PRIOR * s[0]]
    return Evidence(
        runs=tuple(runs),
        waves=tuple(waves),
        residual=np.where(used, residual, 0.0),
        used=used,
        nuisances=table,
        basis=basis,
        setting=setting,
        noise_um=noise_um,
        own_error_um=own_error_um,
    )


def _nuisances(wave: RecordSignals, setting: Setting) -> Matrix:
    """Return a constant and the decay of every mode, each of size 1."""
    minutes = np.arange(wave.size) * wave.period_min
    taus: list[float] = []
    for tau in sorted({round(t, 1) for values in setting.taus_min.values() for t in values}):
        if tau > 3.0 * wave.period_min and (not taus or tau > 1.3 * taus[-1]):
            taus.append(tau)
    return np.column_stack([np.ones(wave.size), *(np.exp(-minutes / tau) for tau in taus)])


def _setting(model: ThermalModel, runs: Sequence[Run], waves: Sequence[RecordSignals]) -> Setting:
    common = [name for name in waves[0].channels if all(name in wave.channels for wave in waves)]
    moving, zeroed = {}, set()
    for name in common:
        if name.endswith(_OUTCOME):
            continue
        values = np.concatenate([wave.channels[name] for wave in waves])
        if np.ptp(values) > MOVES * noise_std(values) and np.ptp(values) > 0.0:
            moving[name] = float(np.ptp(values))
            if np.min(np.abs(values)) < 0.05 * np.ptp(values):
                zeroed.add(name)
    paths = {"DTF": model.dtf, "TDTF": model.tdtf}
    return Setting(
        channels=tuple(moving),
        has_ambient=model.tdtf is not None,
        has_ttf=model.ttf is not None,
        minutes=max(wave.size for wave in waves) * waves[0].period_min,
        period_min=waves[0].period_min,
        sizes_um={
            "DTF": max(float(np.ptp(wave.y_dtf_um)) for wave in waves),
            "TDTF": max(float(np.ptp(wave.y_tdtf_um)) for wave in waves),
        },
        taus_min={
            name: tuple(t for t in path.sampled.time_constants_min() if t > 0.0)
            for name, path in paths.items()
            if path is not None
        },
        spans=moving,
        zeroed=frozenset(zeroed),
        rough=model.held_out_rms_um is not None,
        functions={name: (path.sampled.b, path.sampled.a) for name, path in paths.items() if path is not None},
    )


def noise_floor(model: ThermalModel, runs: Sequence[Run]) -> float:
    """Return what the sensors' noise alone makes of the residual, µm.

    White noise of the probe, and that of both thermocouples through the model.
    """
    noise = {name: max(noise_std(getattr(run, name)) for run in runs) for name in ("t_q_degc", "at_degc", "y_um")}
    impulse = np.zeros(3000)
    impulse[0] = 1.0
    drive = impulse
    if model.ttf is not None:
        drive = np.asarray(lfilter(model.ttf.sampled.a, model.ttf.sampled.b, impulse))
    by_t_q = model.dtf.sampled.response(drive)
    by_at = -by_t_q + (model.tdtf.sampled.response(impulse) if model.tdtf else 0.0)
    parts = (noise["y_um"], noise["t_q_degc"] * np.linalg.norm(by_t_q), noise["at_degc"] * np.linalg.norm(by_at))
    return float(np.sqrt(sum(part**2 for part in parts)))
