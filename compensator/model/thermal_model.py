"""The thermal model: heat from temperatures, deformation from heat and ambient.

    heat = TTF⁻¹ · (T_Q − AT)
    y    = DTF · heat + TDTF · ΔAT + Σ effects

Where the heat was never measured there is no TTF: the DTF then leads from T_Q − AT straight to the deformation, in
µm/K (`kind = "direct"`), and everything else is the same.

Source: Mares and Barta, Mechatronic approach in modeling, identification and control of thermal
deformation of quill, equations (1) to (5).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from compensator.axes import FIRST, label_of
from compensator.display import Shown, Table, Words, with_std
from compensator.errors import ModelError
from compensator.model.effects import Effect
from compensator.model.effects.lateness import Lateness
from compensator.model.outputs import Output
from compensator.model.transfer_function import SampledTransferFunction, TransferFunction, continuous_image

Kind = Literal["heat", "direct"]
Method = Literal["kalman", "inverse"]

#: Unit of every path, by the kind of model.
PATH_UNITS: Mapping[Kind, Mapping[str, str]] = {
    "heat": {"TTF": "K/W", "DTF": "um/W", "TDTF": "um/K"},
    "direct": {"DTF": "um/K", "TDTF": "um/K"},
}

#: What a calibration or a diagnosis states as own error (`y_std_um`) is at least this part of the noise of Y: with none
#: the service would not watch the residual.
LEAST_OWN_ERROR = 0.3
#: A variance at most this many times its own rounding error is not determined.
_ROUNDING = 100.0
#: An inverse pole closer to −1 than this rings for more than about a dozen samples.
RINGING_LIMIT = -0.8
#: Smallest standard deviation of noise, in its unit.
LEAST_NOISE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Path:
    """One path of the model: a transfer function as the model file gives it.

    Parameters
    ----------
    sampled : SampledTransferFunction
        What the engine evaluates.
    unit : str
        Unit of the gain.
    continuous : TransferFunction, optional
        The function in s, where the file gives that form.
    covariance : tuple of tuple of float, optional
        Covariance of the sampled coefficients `b_0 … b_n, a_1 … a_n`, where an identification gives it.
    gain_std : float, optional
        Standard error of the gain at rest, where an identification gives it.
    """

    sampled: SampledTransferFunction
    unit: str
    continuous: TransferFunction | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    gain_std: float | None = None

    @classmethod
    def from_continuous(cls, function: TransferFunction, period_s: float) -> Path:
        """Make a path from a function in s, sampled by Tustin's rule."""
        return cls(sampled=function.sampled(period_s), unit=function.unit, continuous=function)

    def in_s(self) -> TransferFunction:
        """Return the function in s, made by the inverse of Tustin's rule where the file has z."""
        return self.continuous or continuous_image(self.sampled, unit=self.unit)

    def gain_with_std(self) -> tuple[float, float]:
        """Return the gain at rest, Σb / Σa, and its standard error.

        The gain is infinite for a path that integrates. The standard error is that of the identification; without it,
        that of the covariance of b and a_1 …, and NaN where there is none or where rounding outweighs it: the slower
        the path, the more of its covariance cancels in the gain.
        """
        total = math.fsum(self.sampled.a)
        gain = math.inf if total == 0.0 else (self.continuous or self.sampled).dc_gain
        if self.gain_std is not None or self.covariance is None or math.isinf(gain):
            return gain, math.nan if self.gain_std is None else self.gain_std
        gradient = np.array([1.0 / total] * len(self.sampled.b) + [-gain / total] * (len(self.sampled.a) - 1))
        covariance = np.array(self.covariance)
        variance = float(gradient @ covariance @ gradient)
        rounding = gradient.size * np.finfo(float).eps * float(np.abs(gradient) @ np.abs(covariance) @ np.abs(gradient))
        return gain, math.sqrt(variance) if variance > _ROUNDING * rounding else math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimator:
    """How the heat is estimated from the temperatures.

    Parameters
    ----------
    method : {"kalman", "inverse"}
        `inverse` reverses the TTF, as the paper does. `kalman` estimates heat and the states of all
        paths together, the heat as a random walk: less noise in y, and the lag stays small.
    t_q_noise_std_k, at_noise_std_k : float
        White noise of a sample of T_Q and AT, K.
    drive_walk_std : float
        Standard deviation of the change of the drive in one sample: heat, W, or T_Q − AT, K, in a
        direct model.
    at_walk_std_k : float
        Standard deviation of the change of the ambient in one sample, K.
    """

    method: Method
    t_q_noise_std_k: float
    at_noise_std_k: float
    drive_walk_std: float
    at_walk_std_k: float

    def __post_init__(self) -> None:
        for name in ("t_q_noise_std_k", "at_noise_std_k", "drive_walk_std", "at_walk_std_k"):
            value = getattr(self, name)
            # Their squares enter a division: beyond these bounds the estimate would be no number.
            if not LEAST_NOISE <= value <= 1.0 / LEAST_NOISE:
                raise ModelError(f"estimator: {name} = {value!r}, expected from {LEAST_NOISE:g} to {1 / LEAST_NOISE:g}")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ThermalModel(Shown):
    """A thermal model that the engine can run.

    Parameters
    ----------
    name : str
        Name for people.
    kind : {"heat", "direct"}
        With a TTF, or with a DTF in µm/K and no heat.
    period_s : float
        Sample period, s.
    ttf, tdtf : Path or None
        Heat to T_Q − AT; ambient change to deformation.
    dtf : Path
        Heat (or T_Q − AT) to deformation.
    estimator : Estimator
        How the heat is estimated.
    inputs : {"changes", "absolute"}
        Whether the temperatures count from their reference or as they are.
    validity : mapping of str to (float, float)
        Range of `t_q_degc`, `at_degc`, `heat_w`, … on which the model was made.
    y_std_um : float
        Standard deviation of the model's own error in y, µm, in addition to sensor noise.
    held_out_rms_um : float, optional
        Free-run error of the calibration on held-out data, µm; None for a model that no calibration on a machine made.
    effects : tuple of Effect
        Effects added to the base.
    alternatives : mapping of str to (str, Path)
        Other published versions of a path, by name: the path that it replaces, and itself.
    provenance : mapping
        Where it comes from: source, date, hash of the data, fits.
    sha256 : str
        Hash of the model file's bytes; empty for a model that was not read from a file.
    file : bytes
        Those bytes; what was changed since is another model.
    axis : str
        The axis whose deformation it gives.
    parts : tuple of ThermalModel
        Further parts that the same heat and ambient drive; only in a service of several axes.
    outputs : tuple of Output
        Further outputs, made of its own part, which has the name of its axis, and of those.
    """

    name: str
    kind: Kind
    period_s: float
    ttf: Path | None
    dtf: Path
    tdtf: Path | None
    estimator: Estimator
    inputs: Literal["changes", "absolute"] = "changes"
    validity: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    y_std_um: float = 0.0
    held_out_rms_um: float | None = None
    effects: tuple[Effect, ...] = ()
    alternatives: Mapping[str, tuple[str, Path]] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    sha256: str = ""
    file: bytes = field(default=b"", compare=False)
    axis: str = FIRST
    parts: tuple[ThermalModel, ...] = ()
    outputs: tuple[Output, ...] = ()

    def __post_init__(self) -> None:
        check_runnable(self)

    def contents(self) -> list[str | Table | Words]:
        """Return what it shows: its paths, its effects, and where it is valid."""
        paths = {"TTF": self.ttf, "DTF": self.dtf, "TDTF": self.tdtf}
        rows = [[name, *_path_cells(path)] for name, path in paths.items() if path is not None]
        head = ["path", "gain at rest", "unit", "time constants, min"]
        axis = "" if self.axis == FIRST else f", axis {label_of(self.axis)}"
        parts: list[str | Table | Words] = [f"model {self.name}{axis}", Table(head=head, rows=rows)]
        if self.effects:
            lines = [" ".join(filter(None, (effect.kind, effect.explanation))) for effect in self.effects]
            parts.append(Words(title="Effects", lines=lines))
        if self.validity:
            ranges = [[name, f"{low:g}", f"{high:g}"] for name, (low, high) in self.validity.items()]
            parts.append(Table(head=["valid for", "from", "to"], rows=ranges))
        return parts

    @property
    def channels(self) -> tuple[str, ...]:
        """Logged channels that its effects need, those of all parts, each once."""
        own = (channel for effect in self.effects for channel in effect.measured)
        return tuple(dict.fromkeys([*own, *(channel for part in self.parts for channel in part.channels)]))

    @property
    def late_t_q(self) -> Lateness | None:
        """By how much T_Q is late, where an effect says so."""
        return next((effect.lateness for effect in self.effects if effect.lateness is not None), None)

    @property
    def drive_walk_std(self) -> float:
        """Standard deviation of the drive's change over a sample, in its unit: the estimator's, or a late T_Q's."""
        late = self.late_t_q
        return self.estimator.drive_walk_std * (1.0 if late is None else late.walk_times)

    def with_prompt_t_q(self) -> ThermalModel:
        """Return the model without the effect of a late T_Q."""
        return dataclasses.replace(self, effects=tuple(effect for effect in self.effects if effect.lateness is None))

    def with_alternative(self, name: str) -> ThermalModel:
        """Return the model with one of its alternative paths in place.

        Raises
        ------
        ModelError
            If there is no such alternative.
        """
        if name not in self.alternatives:
            known = ", ".join(self.alternatives) or "none"
            raise ModelError(f"model {self.name}: no alternative {name!r}; it has: {known}")
        replaced, path = self.alternatives[name]
        changes: dict[str, Any] = {replaced.lower(): path}
        return dataclasses.replace(self, **changes)


def _path_cells(path: Path) -> list[str]:
    gain, std = path.gain_with_std()
    shown = f"{gain:.4g}" if math.isnan(std) else with_std(gain, std)
    taus = (path.continuous or path.sampled).time_constants_min()
    return [shown, path.unit.replace("um", "µm"), ", ".join(f"{tau:.4g}" for tau in taus if tau)]


def check_runnable(model: ThermalModel) -> None:
    """Refuse dynamics that cannot be run in a service.

    Raises
    ------
    ModelError
        For an unstable path, a TTF whose inverse is improper, unstable or rings, or an effect made for a model of
        another kind.
    """
    if not (math.isfinite(model.period_s) and model.period_s > 0):
        raise ModelError(f"model {model.name}: sample_period_s = {model.period_s!r}, expected a number above 0")
    if (model.ttf is None) != (model.kind == "direct"):
        raise ModelError(
            f"model {model.name}: kind {model.kind!r} and its paths do not fit: TTF "
            f"{'missing' if model.ttf is None else 'present'}"
        )
    for name in ("TTF", "DTF", "TDTF"):
        path: Path | None = getattr(model, name.lower())
        if path is not None:
            _check_path(model, name, path)
    if model.ttf is not None:
        check_inverse(model.name, model.ttf.sampled)
    for effect in model.effects:
        try:
            effect.check_base(model.kind)
        except ModelError as error:
            raise ModelError(f"model {model.name}: {error}") from error
    late = [effect for effect in model.effects if effect.lateness is not None]
    expected = "DTF" if model.ttf is None else "TTF"
    if len(late) > 1:
        raise ModelError(f"model {model.name}: {len(late)} effects of a late T_Q, expected one at most")
    if late and late[0].path != expected:
        raise ModelError(f"model {model.name}: effect delay of T_Q: path = {late[0].path!r}, expected {expected!r}")


def _check_path(model: ThermalModel, name: str, path: Path) -> None:
    expected = PATH_UNITS[model.kind][name]
    if path.unit != expected:
        raise ModelError(f"model {model.name}: path {name} has unit {path.unit!r}, expected {expected!r}")
    if path.sampled.period_s != model.period_s:
        raise ModelError(
            f"model {model.name}: path {name} is sampled at {path.sampled.period_s:g} s, "
            f"the model at {model.period_s:g} s"
        )
    try:
        path.sampled.check_stable()
    except ModelError as error:
        raise ModelError(f"model {model.name}: path {name} is {error}") from error


def check_inverse(model_name: str, ttf: SampledTransferFunction) -> None:
    """Refuse a TTF whose inverse is improper, unstable or rings.

    Parameters
    ----------
    model_name : str
        Name for the message.
    ttf : SampledTransferFunction
        Heat to T_Q − AT.

    Raises
    ------
    ModelError
        Naming the zero that is at fault.
    """
    where = f"model {model_name}: TTF cannot be inverted: "
    if ttf.b[0] == 0.0:
        raise ModelError(where + "no direct feed-through (b0 = 0), so its inverse needs the future")
    zeros = ttf.zeros()
    if zeros.size == 0:
        return
    worst = max(zeros, key=abs)
    if abs(worst) >= 1.0:
        raise ModelError(where + f"zero at z = {worst:.6g} makes the inverse unstable, expected |z| < 1")
    ringing = min(zeros, key=lambda z: float(np.real(z)))
    if ringing.real <= RINGING_LIMIT:
        raise ModelError(where + f"zero at z = {ringing:.6g} makes the inverse ring, expected Re z > {RINGING_LIMIT}")
