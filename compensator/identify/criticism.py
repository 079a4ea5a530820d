"""Model criticism: responses of the paths, correlations of the residual, warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import freqz
from scipy.special import gammaincc

from compensator.arrays import ComplexVector, Mask, Vector
from compensator.codes import ModelWarning, Remark
from compensator.data.runs import Run, is_sparse
from compensator.display import with_std
from compensator.identify.calibration import Calibration
from compensator.identify.choice import coincide
from compensator.identify.deformation import PathFit

#: Lags of the correlations, samples.
LAGS = 60
#: Two-sided 99 % quantile of a normal distribution.
NORMAL_99 = 2.576
#: Points of a frequency response.
FREQUENCIES = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class PathView:
    """Responses of a path.

    Parameters
    ----------
    name, unit : str
        Which path; unit of its gain.
    t_min : numpy.ndarray, shape (n,)
        Time axis, min.
    step, step_std : numpy.ndarray, shape (n,)
        Response to a unit step and its standard error, in the gain's unit.
    impulse : numpy.ndarray, shape (n,)
        Response to a unit pulse of one sample.
    frequency_per_h : numpy.ndarray, shape (f,)
        Frequencies, 1/h.
    magnitude, phase_deg : numpy.ndarray, shape (f,)
        Frequency response.
    poles, zeros : numpy.ndarray of complex
        In the z plane.
    gain, gain_std : float
        At rest.
    taus_min, taus_std_min : tuple of float
        Time constants of its denominator.
    """

    name: str
    unit: str
    t_min: Vector
    step: Vector
    step_std: Vector
    impulse: Vector
    frequency_per_h: Vector
    magnitude: Vector
    phase_deg: Vector
    poles: ComplexVector
    zeros: ComplexVector
    gain: float
    gain_std: float
    taus_min: tuple[float, ...]
    taus_std_min: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualView:
    """Correlations in a residual.

    Parameters
    ----------
    name : str
        Fit to which the residual belongs.
    autocorrelation : numpy.ndarray, shape (LAGS,)
        Lags 1 … LAGS.
    limit : float
        99 % limit of white noise.
    white_chance : float
        Probability of at least this autocorrelation in white noise (Ljung and Box).
    cross : dict of str to (numpy.ndarray, float)
        Correlation with each input at lags −LAGS … LAGS and its 99 % limit, which allows for both autocorrelations.
    lag_unit : str
        What a lag counts: samples, or measured values where Y is measured now and then.
    """

    name: str
    autocorrelation: Vector
    limit: float
    white_chance: float
    cross: dict[str, tuple[Vector, float]]
    lag_unit: str = "samples"


def view_path(path: PathFit, unit: str, period_s: float) -> PathView:
    """Compute the responses of a path.

    Parameters
    ----------
    path : PathFit
        Which.
    unit : str
        Unit of its gain.
    period_s : float
        Sample period, s.
    """
    function = path.function
    poles = function.poles()
    slowest = max(function.time_constants_min(), default=period_s / 60.0)
    n = int(np.clip(5.0 * slowest / (period_s / 60.0), 60, 6000))
    t_min: Vector = np.arange(n, dtype=np.float64) * period_s / 60.0
    step, std = np.asarray(function.response(np.ones(n))), np.zeros(n)
    if path.fit is not None:
        units = np.zeros((len(path.fit.structure.terms), n))
        units[path.column] = 1.0
        step, std = path.fit.simulate_with_std(units)
    pulse = np.zeros(n)
    pulse[0] = 1.0
    frequency = np.geomspace(1.0 / (20.0 * slowest / 60.0), 0.5 * 3600.0 / period_s, FREQUENCIES)
    response = freqz(function.b, function.a, worN=2.0 * np.pi * frequency * period_s / 3600.0)[1]
    gain, gain_std = path.fit.gain(path.column) if path.fit else (function.dc_gain, 0.0)
    taus = tuple(path.fit.taus_min.tolist()) if path.fit else (slowest,)
    return PathView(
        name=path.name,
        unit=unit,
        t_min=t_min,
        step=step,
        step_std=std,
        impulse=np.asarray(function.response(pulse)),
        frequency_per_h=frequency,
        magnitude=np.abs(response),
        phase_deg=np.degrees(np.unwrap(np.angle(response))),
        poles=poles,
        zeros=function.zeros(),
        gain=gain,
        gain_std=gain_std,
        taus_min=taus,
        taus_std_min=tuple(path.fit.taus_std_min.tolist()) if path.fit else (0.0,) * len(taus),
    )


def view_residual(name: str, residuals: Sequence[Vector], inputs: dict[str, Sequence[Vector]]) -> ResidualView:
    """Compute the correlations of a residual.

    Parameters
    ----------
    name : str
        Fit to which the residual belongs.
    residuals : sequence of numpy.ndarray
        One for each run; NaN where y is missing.
    inputs : dict of str to sequence of numpy.ndarray
        Inputs on the same samples.
    """
    sparse = any(is_sparse(r) for r in residuals)
    if sparse:
        known = [np.isfinite(r) for r in residuals]
        inputs = {key: [v[k] for v, k in zip(values, known, strict=True)] for key, values in inputs.items()}
        residuals = [r[k] for r, k in zip(residuals, known, strict=True)]
    filled = [np.where(np.isfinite(r), r - np.nanmean(r), 0.0) for r in residuals]
    count = sum(int(np.isfinite(r).sum()) for r in residuals)
    own = _correlation(filled, filled)[LAGS:]
    # A lag that few pairs of values have shows nothing.
    lags = min(LAGS, count // 4) if sparse else LAGS
    statistic = count * (count + 2) * float(np.sum(own[1 : lags + 1] ** 2 / (count - np.arange(1, lags + 1))))
    cross = {}
    for input_name, values in inputs.items():
        moved = [v - np.mean(v) for v in values]
        input_own = _correlation(moved, moved)[LAGS:]
        spread = np.sqrt(max(1.0 + 2.0 * float(np.sum(own[1:] * input_own[1:])), 1.0))
        cross[input_name] = (_correlation(filled, moved), float(NORMAL_99 * spread / np.sqrt(count)))
    return ResidualView(
        name=name,
        autocorrelation=own[1:],
        limit=float(NORMAL_99 / np.sqrt(count)),
        white_chance=float(gammaincc(lags / 2.0, statistic / 2.0)),
        cross=cross,
        lag_unit="measured values" if sparse else "samples",
    )


def _correlation(first: Sequence[Vector], second: Sequence[Vector]) -> Vector:
    """Return Σ first[k] second[k − lag] for lag −LAGS … LAGS over the norms."""
    total = np.zeros(2 * LAGS + 1)
    for a, b in zip(first, second, strict=True):
        size = 1 << int(np.ceil(np.log2(a.size + LAGS + 1)))
        both = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)
        total += np.concatenate((both[-LAGS:], both[: LAGS + 1]))
    norm = np.sqrt(sum(float(a @ a) for a in first) * sum(float(b @ b) for b in second))
    return total / norm if norm > 0 else total


@dataclass(frozen=True, slots=True, kw_only=True)
class Criticism:
    """Diagnostics of a model for the engineer who approves it.

    Parameters
    ----------
    paths : tuple of PathView
        TTF (where there is one), DTF, TDTF.
    residuals : tuple of ResidualView
        Residuals of the TTF's and the DTF's fit.
    warnings : tuple of Remark
        The most serious first.
    """

    paths: tuple[PathView, ...]
    residuals: tuple[ResidualView, ...]
    warnings: tuple[Remark, ...]


def criticise(calibration: Calibration) -> Criticism:
    """Compute responses, correlations and warnings of an identified model.

    Parameters
    ----------
    calibration : Calibration
        Result of the identification.
    """
    model = calibration.model
    units = {"TTF": "K/W", "DTF": model.dtf.unit, "TDTF": "um/K"}
    paths = tuple(view_path(path, units[path.name], model.period_s) for path in calibration.paths)
    drive = "heat" if model.kind == "heat" else "T_Q − AT"
    residuals = [
        view_residual(
            "deformation",
            calibration.deformation.main.residuals,
            {drive: calibration.drives, "AT": [run.ambient_k for run in calibration.runs]},
        )
    ]
    if calibration.temperature is not None:
        known = [segment.inputs[0] for segment in calibration.temperature.segments]
        residuals.insert(0, view_residual("T_Q − AT", calibration.temperature.fit.residuals, {"heat": known}))
    warnings = _Warnings(calibration, paths, residuals)
    return Criticism(paths=paths, residuals=tuple(residuals), warnings=warnings.all())


class _Warnings:
    """Each method returns one kind of warning, or nothing."""

    def __init__(self, calibration: Calibration, paths: Sequence[PathView], residuals: Sequence[ResidualView]) -> None:
        self.calibration, self.residuals = calibration, residuals
        self.paths = {path.name: path for path in paths}
        self.hours = [float(np.sum(mask)) * calibration.model.period_s / 3600.0 for _, mask in self._pairs()]

    def all(self) -> tuple[Remark, ...]:
        found = [
            self.worse_than_nothing(),
            self.quiet_ambient(),
            self.short_record(),
            self.ramp(),
            self.common_cause(),
            *self.undetermined_gain(),
            *self.odd_zero(),
            *self.wrong_way(),
            *self.twin_modes(),
            self.inverse_noise(),
            self.coloured(),
            self.narrow_range(),
        ]
        return tuple(words for words in found if words is not None)

    def worse_than_nothing(self) -> Remark | None:
        for part in self.calibration.parts:
            if part.role == "held out" and part.model.rms_um > part.nothing.rms_um:
                return Remark(
                    ModelWarning.WORSE_THAN_NOTHING,
                    f"On {part.name} (held out) the model is worse than no compensation: {part.model.rms_um:.1f} "
                    f"instead of {part.nothing.rms_um:.1f} µm rms.",
                )
        return None

    def quiet_ambient(self) -> Remark | None:
        swing = max(float(np.ptp(run.ambient_k[mask])) for run, mask in self._pairs())
        path = self.paths["TDTF"]
        if path.gain_std == 0.0:
            return None
        gain = f"the TDTF's gain is {with_std(path.gain, path.gain_std)} µm/K"
        if swing < 2.0:
            return Remark(
                ModelWarning.QUIET_AMBIENT,
                f"The ambient changed by only {swing:.1f} K; {gain}: do not rely on it for larger changes.",
            )
        if path.gain_std > 0.3 * abs(path.gain):
            return Remark(
                ModelWarning.UNDETERMINED_AMBIENT,
                f"The TDTF is poorly determined although the ambient changed by {swing:.1f} K: {gain}.",
            )
        return None

    def short_record(self) -> Remark | None:
        slowest = max(path.taus_min[-1] for path in self.paths.values())
        longest = max(self.hours)
        if longest * 60.0 < 3.0 * slowest:
            return Remark(
                ModelWarning.SHORT_RECORD,
                f"The longest record covers {longest:.1f} h, the slowest time constant is {slowest / 60.0:.1f} h: the "
                "steady state is extrapolated.",
            )
        return None

    def ramp(self) -> Remark | None:
        main = self.calibration.deformation.main
        if main.taus_min[-1] < 0.95 * main.longest_min:
            return None
        return Remark(
            ModelWarning.DRIFTING_MODE,
            f"The slowest mode is slower than the record ({main.longest_min / 60.0:.0f} h) and was limited to it: "
            "the inputs do not explain a remaining drift, and a free run beyond the record is an extrapolation.",
        )

    def common_cause(self) -> Remark | None:
        drives = np.concatenate([d[m] for d, (_, m) in zip(self.calibration.drives, self._pairs(), strict=True)])
        ambient = np.concatenate([run.ambient_k[mask] for run, mask in self._pairs()])
        if np.ptp(ambient) == 0.0 or np.ptp(drives) == 0.0:
            return None
        together = abs(float(np.corrcoef(drives, ambient)[0, 1]))
        if together < 0.8:
            return None
        return Remark(
            ModelWarning.COMMON_CAUSE,
            f"The drive of the DTF and the ambient temperature changed together (correlation {together:.2f}): the "
            "shares of the DTF and the TDTF in the deformation are ambiguous.",
        )

    def undetermined_gain(self) -> list[Remark]:
        return [
            Remark(
                ModelWarning.UNDETERMINED_GAIN,
                f"The gain of the {name} at rest is poorly determined: {with_std(path.gain, path.gain_std)} "
                f"{_shown(path.unit)}.",
            )
            for name, path in self.paths.items()
            if name != "TDTF" and path.gain_std > 0.3 * abs(path.gain)
        ]

    def odd_zero(self) -> list[Remark]:
        words = []
        for name, path in self.paths.items():
            outside = [z for z in path.zeros if abs(z) > 1.0]
            if outside:
                worst = max(outside, key=abs)
                words.append(
                    Remark(
                        ModelWarning.ZERO_OUTSIDE,
                        f"The {name} has a zero outside the unit circle (z = {worst.real:.3g}): its response starts "
                        "in the wrong direction. It is never inverted, so stability is not affected.",
                    )
                )
        return words

    def wrong_way(self) -> list[Remark]:
        words = []
        for name, path in self.paths.items():
            if path.gain * path.step[np.argmax(np.abs(path.step))] < 0:
                words.append(
                    Remark(
                        ModelWarning.TURNING_RESPONSE,
                        f"The step response of the {name} reverses: it peaks at {_peak(path):.3g} and settles at "
                        f"{path.gain:.3g} {_shown(path.unit)}.",
                    )
                )
        return words

    def twin_modes(self) -> list[Remark]:
        words = []
        for name, path in self.paths.items():
            twins = coincide(path.taus_min)
            if twins and name != "TDTF":
                words.append(
                    Remark(
                        ModelWarning.TWIN_MODES,
                        f"Two time constants of the {name} coincide at {twins[0]:.3g} min: their standard errors "
                        "are meaningless, and one mode fewer may be enough.",
                    )
                )
        return words

    def inverse_noise(self) -> Remark | None:
        temperature = self.calibration.temperature
        if temperature is None:
            return None
        noise = self.calibration.noise
        watts = temperature.noise_gain_w_per_k * float(np.hypot(noise["t_q_degc"], noise["at_degc"]))
        known = [run.heat_w for run in self.calibration.runs if run.heat_w is not None]
        span = max(float(np.ptp(heat)) for heat in known)
        if watts < 0.2 * span:
            return None
        return Remark(
            ModelWarning.INVERSE_NOISE,
            f"The noise of the thermocouples causes {watts:.0f} W of noise in a heat of {span:.0f} W.",
        )

    def coloured(self) -> Remark | None:
        main = self.calibration.deformation.main
        noise = self.calibration.noise["y_um"]
        still = self.residuals[-1]
        known = {name: float(np.max(np.abs(values))) / limit for name, (values, limit) in still.cross.items()}
        largest = max(known, key=lambda name: known[name])
        if still.white_chance > 0.01 and known[largest] < 1.0:
            return None
        tail = f" and is correlated with {largest}" if known[largest] > 1.0 else ""
        return Remark(
            ModelWarning.COLOURED_RESIDUAL,
            f"The residual ({main.sigma:.2f} µm rms, sensor noise {noise:.2f}) is not white{tail}: the model is "
            "incomplete. The standard errors allow for it.",
        )

    def narrow_range(self) -> Remark | None:
        low, high = self.calibration.model.validity["at_degc"]
        t_low, t_high = self.calibration.model.validity["t_q_degc"]
        return Remark(
            ModelWarning.VALIDITY_RANGE,
            f"Valid for AT from {low:.0f} to {high:.0f} °C and T_Q from {t_low:.0f} to {t_high:.0f} °C (the range of "
            "the data and a third more); outside it the service holds the offset.",
        )

    def _pairs(self) -> list[tuple[Run, Mask]]:
        """Return each run with the samples that its measured values stand for."""
        pairs = zip(self.calibration.runs, self.calibration.used, strict=True)
        return [(run, run.covered(mask)) for run, mask in pairs]


def _peak(path: PathView) -> float:
    return float(path.step[np.argmax(np.abs(path.step))])


def _shown(unit: str) -> str:
    return unit.replace("um", "µm")
