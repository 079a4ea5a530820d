"""From measured runs to a thermal model with its errors, noise and range of validity."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from compensator.arrays import Mask, Vector
from compensator.codes import Remark
from compensator.data.chips import CHIP_DEVIATIONS, isolated, left_out, without
from compensator.data.runs import Run, noise_of, noise_std, walk_std
from compensator.data.screening import screen
from compensator.errors import DataError
from compensator.identify.arx import free_run_rms
from compensator.identify.choice import TriedStructure
from compensator.identify.deformation import DeformationFit, PathFit, fit_deformation
from compensator.identify.output_error import OutputErrorFit
from compensator.identify.settings import Settings
from compensator.identify.temperature import TemperatureFit, fit_temperature
from compensator.model.engine import Engine
from compensator.model.simulation import Scores, scores
from compensator.model.thermal_model import LEAST_OWN_ERROR, PATH_UNITS, Estimator, Kind, Path, ThermalModel
from compensator.progress import Progress, unreported

#: Minimum noise assumed for a temperature, K: about a converter's step.
LEAST_NOISE_K = 0.005
#: Minimum change of the ambient temperature per sample assumed by the estimator, K, because doors are opened.
LEAST_AT_WALK_K = 0.1
#: Zero of a run that was not fitted: the mean of its first hour.
ZERO_S = 3600.0
#: Where Y is measured now and then, at least so many values make the zero.
ZERO_VALUES = 5
#: How far the range of validity exceeds the data: share of its range, and at least, K.
BEYOND_SHARE, BEYOND_K = 0.33, 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of the data with its free-run prediction.

    Parameters
    ----------
    name : str
        File and part of it.
    role : {"fitted", "held out"}
        Whether it was used for fitting or selection.
    t_s, y_um, y_pred_um : numpy.ndarray, shape (n,)
        Time, s; measured deformation and the engine's prediction from T_Q and AT (zeroed), µm.
    hours : float
        Length of its samples, h; where Y is measured now and then, from the first value to the last.
    model, nothing, persistence : Scores
        Of the model, of no compensation (y counted from the run's start), and of the last value measured before
        the part.
    inputs : dict of str to numpy.ndarray, shape (n,)
        `t_q_degc`, `at_degc`, and `heat_w` where it is known.
    """

    name: str
    role: str
    t_s: Vector
    y_um: Vector
    y_pred_um: Vector
    hours: float
    model: Scores
    nothing: Scores
    persistence: Scores
    inputs: Mapping[str, Vector] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """The result of a calibration.

    Parameters
    ----------
    model : ThermalModel
        The model.
    settings : Settings
        Kind, method, orders that were requested.
    runs : tuple of Run
        Data of the fit.
    used : tuple of numpy.ndarray of bool
        Samples of each run that were fitted.
    drives : tuple of numpy.ndarray
        Input of the DTF in each run: heat, W, or T_Q − AT, K.
    temperature : TemperatureFit or None
        The TTF.
    deformation : DeformationFit
        DTF and TDTF.
    parts : tuple of Part
        Free-run errors, fitted and held out.
    folds_rms_um : float
        Free-run error on held-out folds, µm.
    noise : dict of str to float
        White noise of `t_q_degc`, `at_degc`, `y_um`, in their units.
    remarks : tuple of str
        Corrections of the data, and changes of the structure.
    checked : tuple of Run
        Runs that took no part in the fit, of which some parts are.
    """

    model: ThermalModel
    settings: Settings
    runs: tuple[Run, ...]
    used: tuple[Mask, ...]
    drives: tuple[Vector, ...]
    temperature: TemperatureFit | None
    deformation: DeformationFit
    parts: tuple[Part, ...]
    folds_rms_um: float
    noise: Mapping[str, float]
    remarks: tuple[str, ...]
    checked: tuple[Run, ...] = ()

    @property
    def ttf_fit_pct(self) -> float:
        """Fit of the TTF in free run from the known heat, %; NaN without one."""
        if self.temperature is None:
            return float("nan")
        pairs = list(zip(self.temperature.segments, self.temperature.fit.residuals, strict=True))
        y = np.concatenate([s.y[s.used] for s, _ in pairs])
        return scores(y, y - np.concatenate([r[s.used] for s, r in pairs])).fit_pct

    @property
    def arx_rms_um(self) -> float:
        """Free-run rms of an ARX of the same structure on the fitted data, µm: for comparison only."""
        segments, structure = self.deformation.segments, self.deformation.main.structure
        return free_run_rms(segments, structure, period_s=self.model.period_s)

    @property
    def paths(self) -> tuple[PathFit, ...]:
        """TTF (if there is one), DTF, TDTF."""
        first = (PathFit.of("TTF", self.temperature.fit),) if self.temperature else ()
        return (*first, self.deformation.dtf, self.deformation.tdtf)


def joined(parts: Sequence[Part]) -> tuple[Vector, Vector, Vector, list[tuple[float, float]]]:
    """Join parts on one time axis, h: files follow each other with a gap of half an hour, in which Y is NaN.

    Returns
    -------
    (numpy.ndarray, numpy.ndarray, numpy.ndarray, list of (float, float))
        Time, h; measured and predicted Y, µm; first and last hour of each held-out part.
    """
    t: list[Vector] = []
    y: list[Vector] = []
    predicted: list[Vector] = []
    held_out = []
    shift, last_name = 0.0, ""
    for part in parts:
        hours = part.t_s / 3600.0
        if t and part.name != last_name:
            end = t[-1][-1]
            shift = end + 0.5 - hours[0]
            for values, gap in ((t, end), (y, np.nan), (predicted, np.nan)):
                values.append(np.array([gap]))
        last_name = part.name
        t.append(hours + shift)
        y.append(part.y_um)
        predicted.append(part.y_pred_um)
        if part.role == "held out":
            held_out.append((float(t[-1][0]), float(t[-1][-1])))
    return np.concatenate(t), np.concatenate(y), np.concatenate(predicted), held_out


def calibrate(
    runs: Sequence[Run],
    settings: Settings,
    *,
    period_s: float,
    name: str,
    fit_until_s: float | None = None,
    etve: Sequence[Run] = (),
    validation: Sequence[Run] = (),
    provenance: Mapping[str, Any] | None = None,
    remarks: Sequence[str] = (),
    like: Calibration | None = None,
    progress: Progress = unreported,
) -> Calibration:
    """Fit a thermal model to measured runs.

    Parameters
    ----------
    runs : sequence of Run
        Data of the fit.
    settings : Settings
        Kind, method, orders.
    period_s : float
        Sample period, s.
    name : str
        Name of the model.
    fit_until_s : float, optional
        Only samples before this time are fitted; the rest is held out.
    etve, validation : sequence of Run
        Tests without heat source (methods II and III); runs for validation only.
    provenance : mapping, optional
        Origin of the data, for the model file.
    remarks : sequence of str
        Corrections that were made while reading the data.
    like : Calibration, optional
        That of another axis of the machine, whose TTF and estimator are used: heat and temperatures are the machine's.
    progress : callable
        Called with the number of structures done and their total.

    Returns
    -------
    Calibration
        Model, fits, errors.

    Raises
    ------
    DataError
        If no model can be fitted to the data; the message states the reason.
    """
    kind = _kind(runs, settings) if like is None else like.model.kind
    data = ", ".join(dict.fromkeys(run.name for run in runs)) or name
    screen(data, runs, period_s, needs_heat=kind == "heat")
    used = [_mask(run, fit_until_s) for run in runs]
    if sum(int(run.covered(mask).sum()) for run, mask in zip(runs, used, strict=True)) * period_s < 7200.0:
        raise DataError(f"{data}: less than 2 h of samples left for the fit")
    # A run that starts after the hours of the fit is held out completely.
    later = [run for run, mask in zip(runs, used, strict=True) if not mask.any() and np.isfinite(run.y_um).any()]
    runs, used = [run for run, mask in zip(runs, used, strict=True) if mask.any()], [m for m in used if m.any()]
    temperature = like.temperature if like is not None else None
    if kind == "heat" and temperature is None:
        temperature = fit_temperature(
            runs, _until(runs, fit_until_s), settings.ttf, period_s=period_s, folds=settings.folds
        )
    drives = [_drive(run, temperature, settings) for run in runs]
    deformation = fit_deformation(runs, used, drives, settings, period_s=period_s, etve=etve, progress=progress)
    chips = _chips(runs, deformation)
    if any(chip.any() for chip in chips):
        remarks = (*remarks, left_out(runs, chips))
        runs, used = without(runs, chips), [mask & ~chip for mask, chip in zip(used, chips, strict=True)]
        deformation = fit_deformation(runs, used, drives, settings, period_s=period_s, etve=etve, progress=progress)
    chosen = next(c for c in deformation.candidates if c.chosen)
    noise = noise_of(runs)
    noise |= {name: max(noise[name], LEAST_NOISE_K) for name in ("t_q_degc", "at_degc")}
    sparse = any(run.has_sparse_y for run in runs)
    y_std_um, held_out_um = _errors_um(deformation, chosen.rms, noise["y_um"], sparse=sparse)
    model = ThermalModel(
        name=name,
        kind=kind,
        period_s=period_s,
        ttf=_path("TTF", kind, PathFit.of("TTF", temperature.fit)) if temperature else None,
        dtf=_path("DTF", kind, deformation.dtf),
        tdtf=_path("TDTF", kind, deformation.tdtf),
        estimator=_estimator(runs, drives, noise, kind) if like is None else like.model.estimator,
        validity=_validity(runs, used, kind),
        y_std_um=y_std_um,
        held_out_rms_um=held_out_um,
        provenance=dict(provenance or {}),
    )
    runs, checked, missed = _without_isolated(model, deformation, runs, used, [*later, *validation])
    remarks = (*remarks, *missed)
    fixed = (temperature.remark,) if temperature and temperature.remark else ()
    return Calibration(
        model=model,
        settings=settings,
        runs=tuple(runs),
        used=tuple(used),
        drives=tuple(drives),
        temperature=temperature,
        deformation=deformation,
        parts=tuple(_parts(model, deformation, runs, used, checked)),
        folds_rms_um=chosen.rms,
        noise=noise,
        remarks=(*remarks, *fixed, *deformation.remarks),
        checked=tuple(checked),
    )


def with_deformation(calibration: Calibration, result: OutputErrorFit, candidate: TriedStructure) -> Calibration:
    """Return a calibration with another fit of the deformation, that with the time constants of several axes.

    Parameters
    ----------
    calibration : Calibration
        The calibration of the axis alone.
    result : OutputErrorFit
        The other fit of the same data.
    candidate : TriedStructure
        Its structure and errors on held-out blocks.
    """
    before, old = calibration.deformation, calibration.model
    together = before.tdtf.fit is before.dtf.fit
    candidates = [dataclasses.replace(one, chosen=False) for one in before.candidates]
    deformation = dataclasses.replace(
        before,
        dtf=PathFit.of("DTF", result, 0),
        tdtf=PathFit.of("TDTF", result, 1) if together else before.tdtf,
        candidates=(*candidates, candidate),
    )
    sparse = any(run.has_sparse_y for run in calibration.runs)
    y_std_um, held_out_um = _errors_um(deformation, candidate.rms, calibration.noise["y_um"], sparse=sparse)
    model = dataclasses.replace(
        old,
        dtf=_path("DTF", old.kind, deformation.dtf),
        tdtf=_path("TDTF", old.kind, deformation.tdtf),
        y_std_um=y_std_um,
        held_out_rms_um=held_out_um,
    )
    parts = _parts(model, deformation, calibration.runs, calibration.used, calibration.checked)
    return dataclasses.replace(
        calibration, model=model, deformation=deformation, parts=tuple(parts), folds_rms_um=candidate.rms
    )


def of_machine(calibrations: Mapping[str, Calibration]) -> dict[str, Calibration]:
    """Return the calibrations of all axes with the validity of the machine: where every axis was measured.

    Raises
    ------
    DataError
        If no temperature is common to the data of all axes.
    """
    ranges = [one.model.validity for one in calibrations.values()]
    validity = {
        name: (max(one[name][0] for one in ranges), min(one[name][1] for one in ranges))
        for name in ranges[0]
        if all(name in one for one in ranges)
    }
    for name, (low, high) in validity.items():
        if low >= high:
            raise DataError(f"{name}: the axes were measured at different temperatures, expected a common range")
    return {
        axis: dataclasses.replace(one, model=dataclasses.replace(one.model, validity=validity, axis=axis))
        for axis, one in calibrations.items()
    }


def _errors_um(deformation: DeformationFit, rms_um: float, noise_um: float, *, sparse: bool) -> tuple[float, float]:
    """Return the standard deviation of the model's own error, and its error on held-out data, µm."""
    if sparse:
        own_um = _own_error_um(deformation, rms_um, noise_um)
        return own_um, own_um
    return float(np.sqrt(max(rms_um**2 - noise_um**2, (LEAST_OWN_ERROR * noise_um) ** 2))), rms_um


def _chips(runs: Sequence[Run], deformation: DeformationFit) -> list[Mask]:
    """Return the values of a deformation measured now and then that lie far from the fit: a chip, a wrong feature."""
    if not any(run.has_sparse_y for run in runs):
        return [np.zeros(run.t_s.size, dtype=bool) for run in runs]
    residuals = [
        np.where(s.used, r, 0.0) for s, r in zip(deformation.segments, deformation.main.residuals, strict=True)
    ]
    left = np.concatenate([r[s.used] for s, r in zip(deformation.segments, residuals, strict=True)])
    noise = (*(run.y_noise_um for run in runs), float(np.median(np.abs(left))) / 0.6745)
    limit = CHIP_DEVIATIONS * max(noise)
    return [np.asarray(np.abs(residual) > limit) for residual in residuals]


def _own_error_um(deformation: DeformationFit, rms_um: float, noise_um: float) -> float:
    """Return the model's own error where Y was measured now and then, µm rms.

    What the standard errors of the parameters make of the prediction, and what held-out blocks show beyond the noise of
    the values by more than chance: a probe's noise is none of the model.
    """
    count = sum(int(segment.used.sum()) for segment in deformation.segments)
    parts = [deformation.main.simulate_with_std(segment.inputs)[1] for segment in deformation.segments]
    by_parameters = float(np.mean(np.concatenate(parts) ** 2))
    excess = rms_um**2 - noise_um**2
    by_blocks = excess if excess > 2.0 * noise_um**2 * np.sqrt(2.0 / count) else 0.0
    return float(np.sqrt(max(by_parameters, by_blocks)))


def _kind(runs: Sequence[Run], settings: Settings) -> Kind:
    if settings.kind != "auto":
        return settings.kind
    return "heat" if any(run.heat_w is not None for run in runs) else "direct"


def _until(runs: Sequence[Run], fit_until_s: float | None) -> list[Mask]:
    return [run.t_s < (np.inf if fit_until_s is None else fit_until_s) for run in runs]


def _mask(run: Run, fit_until_s: float | None) -> Mask:
    return np.asarray(_until([run], fit_until_s)[0] & np.isfinite(run.y_um))


def _drive(run: Run, temperature: TemperatureFit | None, settings: Settings) -> Vector:
    if temperature is None:
        return run.difference_k
    if settings.drive == "known" and run.heat_w is not None:
        return run.heat_w
    return temperature.heat(run.difference_k)


def _path(name: str, kind: Kind, path: PathFit) -> Path:
    unit = PATH_UNITS[kind][name]
    if path.fit is None:
        return Path(sampled=path.function, unit=unit)
    covariance = tuple(tuple(row) for row in path.fit.coefficient_covariance(path.column).tolist())
    return Path(sampled=path.function, unit=unit, covariance=covariance, gain_std=path.fit.gain(path.column)[1])


def _estimator(runs: Sequence[Run], drives: Sequence[Vector], noise: Mapping[str, float], kind: Kind) -> Estimator:
    """Return the filter's settings: sensor noise, and the change of drive and ambient per sample."""
    sensor = float(np.hypot(noise["t_q_degc"], noise["at_degc"]))
    known = [run.heat_w for run in runs if run.heat_w is not None]
    if kind == "direct":
        walk = max(walk_std([run.difference_k for run in runs], sensor), sensor)
    elif known:
        walk = walk_std(known, 0.0)
    else:
        walk = walk_std(drives, max(noise_std(drive) for drive in drives))
    return Estimator(
        method="kalman",
        t_q_noise_std_k=noise["t_q_degc"],
        at_noise_std_k=noise["at_degc"],
        drive_walk_std=walk,
        at_walk_std_k=max(walk_std([run.ambient_k for run in runs], noise["at_degc"]), LEAST_AT_WALK_K),
    )


def _validity(runs: Sequence[Run], used: Sequence[Mask], kind: Kind) -> dict[str, tuple[float, float]]:
    """Return the ranges of the fitted data, and a third more."""

    def widened(values: Vector, least: float) -> tuple[float, float]:
        low, high = float(values.min()), float(values.max())
        beyond = max(BEYOND_SHARE * (high - low), least)
        return round(low - beyond, 3), round(high + beyond, 3)

    used = [run.covered(mask) for run, mask in zip(runs, used, strict=True)]
    ranges = {
        "t_q_degc": widened(np.concatenate([r.t_q_degc[m] for r, m in zip(runs, used, strict=True)]), BEYOND_K),
        "at_degc": widened(np.concatenate([r.at_degc[m] for r, m in zip(runs, used, strict=True)]), BEYOND_K),
    }
    heats = [r.heat_w[m] for r, m in zip(runs, used, strict=True) if r.heat_w is not None]
    if kind == "heat" and heats:
        ranges["heat_w"] = widened(np.concatenate(heats), 0.0)
    return ranges


# ---------------------------------------------------------------------------- free run


def _parts(
    model: ThermalModel,
    deformation: DeformationFit,
    runs: Sequence[Run],
    used: Sequence[Mask],
    validation: Sequence[Run],
) -> list[Part]:
    parts = []
    for i, (run, mask) in enumerate(zip(runs, used, strict=True)):
        predicted = predict(model, run) + deformation.main.free_decay(i, run.t_s.size)
        predicted += float(np.mean((run.y_um - predicted)[mask]))
        parts.append(_part(run, predicted, mask, "fitted", model.period_s))
        rest = np.isfinite(run.y_um) & ~mask
        if rest.any():
            parts.append(_part(run, predicted, rest, "held out", model.period_s))
    # What lies between long gaps is a run of its own, also where it has no measured Y.
    for run in (one for one in validation if np.isfinite(one.y_um).any()):
        predicted = predict(model, run)
        predicted += float(np.mean((run.y_um - predicted)[_zero_of(run)]))
        parts.append(_part(run, predicted, np.isfinite(run.y_um), "held out", model.period_s))
    return parts


def _without_isolated(
    model: ThermalModel,
    deformation: DeformationFit,
    runs: Sequence[Run],
    used: Sequence[Mask],
    checked: Sequence[Run],
) -> tuple[list[Run], list[Run], tuple[Remark, ...]]:
    """Return fitted and other runs without the chips among sparse values that took no part in the fit."""
    nothing = [np.zeros(run.t_s.size, dtype=bool) for run in checked]
    held_out = [(run, deformation.main.free_decay(i, run.t_s.size), used[i]) for i, run in enumerate(runs)]
    held_out += [(run, np.zeros(run.t_s.size), mask) for run, mask in zip(checked, nothing, strict=True)]
    chips = []
    for run, decay, mask in held_out:
        chip = np.zeros(run.t_s.size, dtype=bool)
        if run.has_sparse_y and (np.isfinite(run.y_um) & ~mask).any():
            chip = isolated(run.y_um - predict(model, run) - decay, run.y_noise_um) & ~mask
        chips.append(chip)
    every = [run for run, _, _ in held_out]
    remarks = (left_out(every, chips),) if any(chip.any() for chip in chips) else ()
    every = without(every, chips)
    return every[: len(runs)], every[len(runs) :], remarks


def _zero_of(run: Run) -> Mask:
    """Return the samples whose mean is the zero of a run that was not fitted."""
    known = np.isfinite(run.y_um)
    first = np.flatnonzero(known)
    if not run.has_sparse_y:
        return np.asarray(known & (run.t_s < run.t_s[first[0]] + ZERO_S))
    until = max(run.t_s[first[0]] + ZERO_S, run.t_s[first[:ZERO_VALUES][-1]])
    return np.asarray(known & (run.t_s <= until))


def predict(model: ThermalModel, run: Run) -> Vector:
    """Return the deformation that the service's engine predicts from T_Q and AT of a run, µm, shape (n,)."""
    engine = Engine(model)
    engine.set_reference(*run.reference)
    return np.array([e.y_um for e in engine.run(run.t_q_degc, run.at_degc, run.channels)])


def _part(run: Run, predicted: Vector, mask: Mask, role: str, period_s: float) -> Part:
    known = np.flatnonzero(np.isfinite(run.y_um))
    y = run.y_um[mask]
    before = known[known < np.argmax(mask)]
    start = float(np.mean(run.y_um[known[: 1 if run.has_sparse_y else 5]]))
    held = float(run.y_um[before[-1]]) if before.size else start
    return Part(
        name=run.name,
        role=role,
        t_s=run.t_s[mask],
        y_um=y,
        y_pred_um=predicted[mask],
        hours=float(run.covered(mask).sum()) * period_s / 3600.0,
        model=scores(y, predicted[mask]),
        nothing=scores(y, np.full(y.size, start)),
        persistence=scores(y, np.full(y.size, held)),
        inputs={"t_q_degc": run.t_q_degc[mask], "at_degc": run.at_degc[mask]}
        | ({"heat_w": run.heat_w[mask]} if run.heat_w is not None else {}),
    )
