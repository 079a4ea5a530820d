"""The streaming engine: a thermal model and its effects, one sample at a time.

The service, `simulate`, `identify` and `replay` all run this class, `diagnose` for the effects that a model already
has. `run` is `step` over a whole record, so both give the same bits. A step takes constant time, except the one that
ends a gap: it returns to the sample before the gap and repeats the missing ones with interpolated inputs, at most
`bridge_samples` of them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from compensator.arrays import NAN, Vector
from compensator.errors import ModelError
from compensator.model.effects import EffectStream, Signals
from compensator.model.late_observer import LateObserver, observer_of
from compensator.model.observer import Forecast, ObserverState
from compensator.model.outputs import OutputEstimate
from compensator.model.thermal_model import ThermalModel

#: Longest run of incomplete samples that is repeated once both temperatures are back.
BRIDGE_SAMPLES = 60
#: Step by which the growth of y with the paths is found, µm, and iterations of a correction by measured y.
_SLOPE_UM, _ITERATIONS = 1.0, 6
#: The paths move by no more than this many times a residual that effects make small.
_MOST_MOVED = 5.0
#: Samples within which a covariance is steady.
_SETTLES_IN = 1500


@dataclass(frozen=True, slots=True)
class Reference:
    """Temperatures that the inputs are changes from.

    Parameters
    ----------
    t_q_degc, at_degc : float
        Temperatures at the zero, °C.
    """

    t_q_degc: float
    at_degc: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the engine knows after a sample.

    Parameters
    ----------
    heat_w : float
        Estimated heat, W; NaN in a direct model.
    heat_std_w : float
        Its standard deviation, W; NaN in a direct model.
    y_dtf_um, y_tdtf_um : float
        Shares of the two paths, µm.
    y_effects_um : tuple of float
        Share of each effect, µm, in the order of the model file.
    y_um : float
        Predicted deformation, µm.
    y_std_um : float
        Its standard deviation: sensor noise, missing samples, the model's own error and the variance that effects
        state of their own, µm.
    y_rate_um_per_min : float
        Growth over the next sample, with heat and ambient as they are, µm/min.
    outputs : tuple of OutputEstimate
        Further outputs of the model.
    """

    heat_w: float
    heat_std_w: float
    y_dtf_um: float
    y_tdtf_um: float
    y_effects_um: tuple[float, ...]
    y_um: float
    y_std_um: float
    y_rate_um_per_min: float
    outputs: tuple[OutputEstimate, ...] = ()

    @property
    def contributions_um(self) -> tuple[float, ...]:
        """Share of each path and effect, µm, in the order of `Engine.contribution_names`; their sum is `y_um`."""
        return (self.y_dtf_um, self.y_tdtf_um, *self.y_effects_um)


@dataclass(frozen=True, slots=True)
class Inputs:
    """Inputs of one sample as the engine uses them: changes of the temperatures, channels as they are.

    Parameters
    ----------
    t_q_k, at_k : float
        Changes of T_Q and AT from their reference, K; NaN where missing.
    channels : dict of str to float
        Channels that the effects use, in their own units; NaN where missing.
    """

    t_q_k: float
    at_k: float
    channels: dict[str, float]

    @property
    def has_temperatures(self) -> bool:
        """Whether neither T_Q nor AT is missing."""
        return not (math.isnan(self.t_q_k) or math.isnan(self.at_k))

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return self.has_temperatures and not any(map(math.isnan, self.channels.values()))


@dataclass(frozen=True, slots=True)
class EngineState:
    """Everything that the engine needs to continue with the same bits.

    Parameters
    ----------
    observer : ObserverState
        State of the observer.
    effects : tuple of tuple of float
        State of each effect, those of further parts of the model after those of the first.
    channels : tuple of (str, float)
        Last good value of each channel that an effect uses.
    reference : Reference
        What the inputs are changes from.
    last_complete : Inputs, optional
        The last sample with both temperatures, where a gap that begins after it may be bridged; complete, unless a
        channel has been missing for longer than a gap may last.
    gap : Gap, optional
        The gap under way.
    shifted_k : tuple of (float, float)
        By how much the sensors of T_Q and AT show more than those that the model was made with, K.
    """

    observer: ObserverState
    effects: tuple[tuple[float, ...], ...]
    channels: tuple[tuple[str, float], ...]
    reference: Reference
    last_complete: Inputs | None = None
    gap: Gap | None = None
    shifted_k: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Gap:
    """Samples without T_Q, AT or a channel since one that had them, kept to be repeated.

    Parameters
    ----------
    state : EngineState
        State before the first of them.
    before : Inputs or None
        The sample before them, with the last good value of each channel; None where there is none.
    samples : tuple of Inputs
        The incomplete samples.
    limit : int
        A gap of more samples than this is left as predicted.
    held : bool
        Whether the missing values are taken to be those after the gap throughout, instead of on a straight line
        between its ends.
    """

    state: EngineState
    before: Inputs | None
    samples: tuple[Inputs, ...] = ()
    limit: int = BRIDGE_SAMPLES
    held: bool = False

    @property
    def is_of_channels(self) -> bool:
        """Whether it has samples, and channels alone are missing in them."""
        return bool(self.samples) and all(sample.has_temperatures for sample in self.samples)


@dataclass(frozen=True, slots=True)
class _Part:
    """A part of the model with its effects, and those of them that state a variance."""

    model: ThermalModel
    effects: list[EffectStream]
    uncertain: list[EffectStream]


class _PartEstimate(NamedTuple):
    """What a part of the model gives after a sample; its variance is without that of sensor noise."""

    dtf_um: float
    tdtf_um: float
    effects_um: tuple[float, ...]
    um: float
    variance_um2: float
    rate_um_per_min: float


class Engine:
    """Runs a thermal model over samples.

    Parameters
    ----------
    model : ThermalModel
        What to run.
    bridge_samples : int
        Longest gap that is interpolated; a longer one is left as predicted.

    Raises
    ------
    ModelError
        If a filter bank of an effect has not as many gains as time constants.

    Examples
    --------
    >>> from compensator.model.model_file import load_model
    >>> engine = Engine(load_model("quill"))
    >>> engine.set_reference(20.0, 20.0)
    >>> round(engine.step(20.0, 20.0).y_um, 6)
    0.0
    """

    def __init__(self, model: ThermalModel, *, bridge_samples: int = BRIDGE_SAMPLES) -> None:
        self.model = model
        self.bridge_samples = bridge_samples
        self._observer = observer_of(model)
        self._period_min = model.period_s / 60.0
        self._start_effects()
        self.channels = model.channels
        numbers = {part.axis: i for i, part in enumerate((model, *model.parts))}
        self._outputs = [[(numbers[name], weight) for name, weight in output.weights] for output in model.outputs]
        absolute = model.inputs == "absolute"
        self._reference = Reference(0.0, 0.0) if absolute else Reference(NAN, NAN)
        self._shifted_k = (0.0, 0.0)
        self._held: dict[str, float] = {}
        self._last_complete: Inputs | None = None
        self._gap: Gap | None = None

    # ------------------------------------------------------------------ reference and state

    @property
    def reference(self) -> Reference:
        """What the inputs are changes from."""
        return self._reference

    @property
    def has_reference(self) -> bool:
        """Whether the inputs have a reference yet."""
        return not (math.isnan(self._reference.t_q_degc) or math.isnan(self._reference.at_degc))

    @property
    def shifted_k(self) -> tuple[float, float]:
        """By how much the sensors of T_Q and AT show more than those that the model was made with, K."""
        return self._shifted_k

    @property
    def contribution_names(self) -> tuple[str, ...]:
        """Names of what adds to the deformation: the two paths, and each effect with its number and label."""
        effects = (f"{number} {effect.label}" for number, effect in enumerate(self.model.effects, start=1))
        return ("DTF", "TDTF", *effects)

    @property
    def y_noise_std_um(self) -> float:
        """Standard deviation of y that sensor noise and missing samples cause, µm; a part of `Estimate.y_std_um`."""
        return math.sqrt(self._observer.y_variance_um2)

    def set_reference(self, t_q_degc: float, at_degc: float, shifted_k: tuple[float, float] | None = None) -> None:
        """Start at rest, with these temperatures as zero (ignored where the model's inputs are absolute).

        Parameters
        ----------
        t_q_degc, at_degc : float
            Temperatures at the zero, °C.
        shifted_k : tuple of (float, float), optional
            By how much the sensors of T_Q and AT show more than those that the model was made with, K; by default as
            before: a zero does not exchange a sensor.

        Raises
        ------
        ModelError
            If one of them is missing.
        """
        if math.isnan(t_q_degc) or math.isnan(at_degc):
            raise ModelError("a zero needs both temperatures; one is missing")
        if self.model.inputs == "changes":
            self._reference = Reference(t_q_degc, at_degc)
        if shifted_k is not None:
            self._shifted_k = shifted_k
        self._observer.reset()
        self._start_effects()
        self._held = {}
        self._last_complete = self._gap = None

    def _start_effects(self) -> None:
        self._parts: list[_Part] = []
        for model in (self.model, *self.model.parts):
            effects = [EffectStream(effect, self._period_min) for effect in model.effects]
            self._parts.append(_Part(model, effects, [stream for stream in effects if stream.effect.has_variance]))
        self._effects = [stream for part in self._parts for stream in part.effects]

    def snapshot(self) -> EngineState:
        """Return the state after the last sample."""
        return EngineState(
            observer=self._observer.snapshot(),
            effects=tuple(effect.snapshot() for effect in self._effects),
            channels=tuple(self._held.items()),
            reference=self._reference,
            last_complete=self._last_complete,
            gap=self._gap,
            shifted_k=self._shifted_k,
        )

    def restore(self, state: EngineState) -> None:
        """Continue from a snapshot.

        Raises
        ------
        ValueError
            If it belongs to another model.
        """
        if len(state.effects) != len(self._effects):
            raise ValueError(f"snapshot of {len(state.effects)} effects, the model has {len(self._effects)}")
        for effect, effect_state in zip(self._effects, state.effects, strict=True):
            if len(effect_state) != len(effect.snapshot()):
                raise ValueError(f"snapshot of {len(effect_state)} numbers for an effect of kind {effect.kind!r}")
        self._observer.restore(state.observer)
        for effect, effect_state in zip(self._effects, state.effects, strict=True):
            effect.restore(effect_state)
        self._held = dict(state.channels)
        self._reference, self._shifted_k = state.reference, state.shifted_k
        self._last_complete, self._gap = state.last_complete, state.gap

    def check(self, state: EngineState) -> None:
        """Refuse a snapshot from elsewhere whose parts do not fit together.

        Raises
        ------
        ValueError
            Saying what does not fit.
        """
        gap = state.gap
        inputs = [state.last_complete] if state.last_complete is not None else []
        if gap is not None:
            if gap.state.gap is not None:
                raise ValueError("snapshot with a gap before its gap")
            self.check(gap.state)
            inputs += [*gap.samples, *([gap.before] if gap.before is not None else [])]
        if any(tuple(entry.channels) != self.channels for entry in inputs):
            raise ValueError(f"snapshot with channels that the effects do not use, expected {list(self.channels)}")
        probe = Engine(self.model)
        probe.restore(dataclasses.replace(state, gap=None))

    # ------------------------------------------------------------------ one sample

    def step(self, t_q_degc: float, at_degc: float, channels: Mapping[str, float] | None = None) -> Estimate:
        """Advance by one sample.

        Parameters
        ----------
        t_q_degc, at_degc : float
            Temperatures, °C; NaN where missing.
        channels : mapping of str to float, optional
            Auxiliary channels that the effects use; NaN or absent where missing.

        Returns
        -------
        Estimate
            Heat and deformation after this sample.

        Raises
        ------
        ModelError
            If there is no reference yet.
        """
        if not self.has_reference:
            raise ModelError("the engine has no reference yet: call set_reference first")
        given = channels or {}
        inputs = Inputs(
            t_q_k=t_q_degc - self._reference.t_q_degc,
            at_k=at_degc - self._reference.at_degc,
            channels={name: given.get(name, NAN) for name in self.channels},
        )
        unknown = None
        gap = self._gap
        # A dead channel must not keep the temperatures from being repeated.
        is_over = gap is not None and inputs.has_temperatures and not gap.is_of_channels
        if inputs.complete or is_over:
            if gap is not None:
                unknown = self._observer.covariance_ahead()
                self._repeat(gap, inputs)
                self._gap = None
            self._last_complete = inputs
        else:
            self._remember(inputs)
        return self._advance(inputs, unknown=unknown)

    def forecast(self, at_degc: float) -> Forecast:
        """Return what the next sample is expected to measure, without advancing.

        Parameters
        ----------
        at_degc : float
            AT of that sample, °C, from which T_Q is then expected; NaN where missing.

        Returns
        -------
        Forecast
            With temperatures in °C.
        """
        reference = self._reference
        found = self._observer.forecast(at_degc - reference.at_degc)
        return dataclasses.replace(found, t_q_k=found.t_q_k + reference.t_q_degc, at_k=found.at_k + reference.at_degc)

    def drive_for(self, t_q_k: float) -> float:
        """Return the heat, W (T_Q − AT, K, in a direct model), that would explain a difference of T_Q, K, at once."""
        return self._observer.drive_for(t_q_k)

    def measure_y(self, residual_um: float, variance_um2: float) -> float:
        """Correct the state after a sample by a measured deformation; return the variance expected of the residual.

        Parameters
        ----------
        residual_um : float
            Measured deformation − that of the last estimate, µm.
        variance_um2 : float
            Variance of the value itself, µm².
        """
        observer, before = self._observer, self._observer.shares_of(0, self._observer.x)
        y_before, slopes = self._y_and_slopes(*before)
        gain, expected = observer.gain_of_y(variance_um2, slopes)
        innovation, effects = residual_um, self._parts[0].effects
        # Effects may amplify what the paths do: then the slopes are those where the correction leads to (iterated EKF).
        for _ in range(_ITERATIONS if effects else 0):
            moved = [innovation * share for share in observer.shares_of(0, [*gain, 0.0])]
            now = before[0] + moved[0], before[1] + moved[1]
            y_now, slopes = self._y_and_slopes(*now)
            gain, _ = observer.gain_of_y(variance_um2, slopes)
            linear = slopes[0] * moved[0] + slopes[1] * moved[1]
            innovation = residual_um - (y_now - y_before) + linear
        if effects:
            dtf, tdtf = (innovation * share for share in observer.shares_of(0, [*gain, 0.0]))
            moved_um = self._y_of(before[0] + dtf, before[1] + tdtf) - y_before
            is_nearer = abs(residual_um - moved_um) <= abs(residual_um)
            if not (is_nearer and abs(dtf + tdtf) <= _MOST_MOVED * abs(residual_um)):
                return expected
        observer.measure_y(innovation, variance_um2, slopes)
        return expected

    def _y_of(self, dtf: float, tdtf: float) -> float:
        """Return y with other shares of DTF and TDTF now, effects included, µm."""
        signals = self._signals(dtf, tdtf)
        return dtf + tdtf + math.fsum(effect.peek(signals) for effect in self._parts[0].effects)

    def _y_and_slopes(self, dtf: float, tdtf: float) -> tuple[float, tuple[float, float]]:
        """Return y there, and by how much it changes with the shares of DTF and TDTF."""
        now = self._y_of(dtf, tdtf)
        if not self._parts[0].effects:
            return now, (1.0, 1.0)
        by_dtf, by_tdtf = self._y_of(dtf + _SLOPE_UM, tdtf) - now, self._y_of(dtf, tdtf + _SLOPE_UM) - now
        return now, (by_dtf / _SLOPE_UM, by_tdtf / _SLOPE_UM)

    @property
    def takes_y(self) -> bool:
        """Whether the state can be corrected by a measured deformation: it is not that of some samples before.

        Nor does a `hysteresis` or a delayed path remember what the paths have done, which a correction does not reach.
        A lag of what they have done (`dynamics`, `scheduled`) does not keep it from being corrected: it forgets.
        """
        has_memory = any(
            one.kind in ("hysteresis", "delay") and one.effect.lateness is None for one in self._parts[0].effects
        )
        return not (has_memory or isinstance(self._observer, LateObserver))

    def doubt(self, changes: Sequence[Sequence[float] | Vector]) -> None:
        """Doubt the state by what wrong temperatures may have made of it, and interpolate nothing over this time.

        Parameters
        ----------
        changes : sequence of sequence of float
            One standard deviation of each independent error, as `wrong_histories` gives them.
        """
        self._gap = self._last_complete = None
        self._observer.doubt(changes)

    def shift_reference(self, t_q_k: float, at_k: float) -> None:
        """Move the reference without a change of the state: a sensor has another zero from now on, K."""
        reference, (t_q_before, at_before) = self._reference, self._shifted_k
        self._reference = Reference(reference.t_q_degc + t_q_k, reference.at_degc + at_k)
        self._shifted_k = (t_q_before + t_q_k, at_before + at_k)

    def run(
        self,
        t_q_degc: Sequence[float] | Vector,
        at_degc: Sequence[float] | Vector,
        channels: Mapping[str, Sequence[float] | Vector] | None = None,
    ) -> list[Estimate]:
        """Run over a whole record, sample by sample.

        Parameters
        ----------
        t_q_degc, at_degc : array_like, shape (n,)
            Temperatures, °C; NaN where missing.
        channels : mapping of str to array_like, shape (n,), optional
            Auxiliary channels.

        Returns
        -------
        list of Estimate, length n
            One for each sample.

        Raises
        ------
        ModelError
            If there is no reference yet.
        """
        t_q = np.asarray(t_q_degc, dtype=float).tolist()
        at = np.asarray(at_degc, dtype=float).tolist()
        columns = {name: np.asarray(values, dtype=float).tolist() for name, values in (channels or {}).items()}
        return [
            self.step(t_q[i], at[i], {name: values[i] for name, values in columns.items()}) for i in range(len(t_q))
        ]

    def skip(self, samples: int, *, held: bool = False) -> Estimate:
        """Skip samples that were not measured, as missing ones; the next sample with both temperatures repeats them.

        Parameters
        ----------
        samples : int
            How many, at least 1; there is no limit to what is repeated.
        held : bool
            Whether the machine is assumed to have been throughout the gap as it is found after it, instead of on a
            straight line between its ends: the state before a long gap says nothing about its end.

        Returns
        -------
        Estimate
            What is predicted at the end of the gap.

        Raises
        ------
        ModelError
            If there is no reference yet.
        """
        self._end_gap_of_channels()
        gap = self._gap or self._new_gap()
        if held or gap.held or gap.before is not None:
            # A long pause must not use up the limit of a short sensor loss after it.
            limit = max(gap.limit, len(gap.samples) + samples + self.bridge_samples)
            self._gap = dataclasses.replace(gap, limit=limit, held=held or gap.held)
        for _ in range(samples):
            estimate = self.step(NAN, NAN)
        return estimate

    # ------------------------------------------------------------------ inside

    def _advance(
        self, inputs: Inputs, extra_t_q_k2: float = 0.0, extra_at_k2: float = 0.0, unknown: Vector | None = None
    ) -> Estimate:
        observer = self._observer
        observer.step(inputs.t_q_k, inputs.at_k, extra_t_q_k2=extra_t_q_k2, extra_at_k2=extra_at_k2)
        if unknown is not None:
            observer.widen(unknown)
        if self._effects:
            self._hold_channels(inputs)
        ahead = observer.ahead()
        first, *further = (self._advance_part(number, part, ahead) for number, part in enumerate(self._parts))
        heat = self.model.kind == "heat"
        return Estimate(
            heat_w=observer.drive if heat else NAN,
            heat_std_w=observer.drive_std if heat else NAN,
            y_dtf_um=first.dtf_um,
            y_tdtf_um=first.tdtf_um,
            y_effects_um=first.effects_um,
            y_um=first.um,
            y_std_um=math.sqrt(first.variance_um2),
            y_rate_um_per_min=first.rate_um_per_min,
            outputs=self._output_estimates((first, *further)) if self._outputs else (),
        )

    def _advance_part(self, number: int, part: _Part, ahead: list[float]) -> _PartEstimate:
        """Step the effects of a part of the model; `ahead` is the observer's state one sample ahead."""
        observer = self._observer
        dtf, tdtf = observer.shares_of(number, observer.x)
        shares: tuple[float, ...] = ()
        if part.effects:
            signals = self._signals(dtf, tdtf)
            shares = tuple(effect.step(signals) for effect in part.effects)
        y = dtf + tdtf
        for share in shares:  # not sum(): newer Pythons compensate it, and the bits would depend on the version
            y += share
        dtf_ahead, tdtf_ahead = observer.shares_of(number, ahead)
        rate = (dtf_ahead + tdtf_ahead - dtf - tdtf) / self._period_min
        if part.effects:
            rate += self._effects_rate(part, dtf_ahead, tdtf_ahead, shares)
        # That of the first part includes sensor noise; outputs, which may share parts, add theirs themselves.
        variance = (observer.y_variance_um2 if number == 0 else 0.0) + part.model.y_std_um**2
        for effect in part.uncertain:
            variance += effect.variance_um2()
        # What the effects of one direction leave open together; fsum rounds once, so the bits are the same everywhere.
        for changes in itertools.zip_longest(*(effect.deviations_um for effect in part.effects), fillvalue=0.0):
            variance += math.fsum(changes) ** 2
        return _PartEstimate(dtf, tdtf, shares, y, variance, rate)

    def _output_estimates(self, parts: Sequence[_PartEstimate]) -> tuple[OutputEstimate, ...]:
        """Return the further outputs, each a weighted sum of parts."""
        found = []
        for weights, noise in zip(self._outputs, self._observer.output_variances, strict=True):
            dtf = tdtf = value = rate = 0.0
            effects: list[float] = []
            variance = noise
            for number, weight in weights:
                part = parts[number]
                dtf += weight * part.dtf_um
                tdtf += weight * part.tdtf_um
                value += weight * part.um
                rate += weight * part.rate_um_per_min
                effects += [weight * share for share in part.effects_um]
                own = part.variance_um2 - (self._observer.y_variance_um2 if number == 0 else 0.0)
                variance += weight * weight * own
            found.append(OutputEstimate(dtf, tdtf, tuple(effects), value, math.sqrt(max(variance, 0.0)), rate))
        return tuple(found)

    def _hold_channels(self, inputs: Inputs) -> None:
        """Keep what the channels show; one that is missing keeps its last good value."""
        for name, value in inputs.channels.items():
            if not math.isnan(value):
                self._held[name] = value

    def _signals(self, dtf: float, tdtf: float) -> Signals[float]:
        observer, reference, (t_q_more, at_more) = self._observer, self._reference, self._shifted_k
        return Signals(
            drive=observer.drive,
            ambient_k=observer.ambient_k,
            t_q_degc=observer.t_q_k + reference.t_q_degc - t_q_more,
            at_degc=observer.ambient_k + reference.at_degc - at_more,
            y_dtf_um=dtf,
            y_tdtf_um=tdtf,
            channels=self._held,
        )

    def _effects_rate(self, part: _Part, dtf_ahead: float, tdtf_ahead: float, shares: tuple[float, ...]) -> float:
        """Return the growth of a part's effects over the next sample, from the signals ahead, µm/min."""
        signals = self._signals(dtf_ahead, tdtf_ahead)
        growth = 0.0
        for effect, share in zip(part.effects, shares, strict=True):
            growth += effect.peek(signals) - share
        return growth / self._period_min

    def _remember(self, inputs: Inputs) -> None:
        """Keep an incomplete sample, as long as the gap can still be bridged."""
        if not inputs.has_temperatures:
            self._end_gap_of_channels()
        elif self._gap is None and not (self._last_complete and self._last_complete.complete):
            # A channel has been missing for too long to be interpolated: a gap begins once a temperature is, too.
            self._last_complete = inputs
            return
        if self._gap is None and self._last_complete is not None:
            self._gap = self._new_gap()
        if self._gap is not None:
            self._gap = dataclasses.replace(self._gap, samples=(*self._gap.samples, inputs))
            if len(self._gap.samples) > self._gap.limit:
                self._gap, self._last_complete = None, inputs if inputs.has_temperatures else None

    def _new_gap(self) -> Gap:
        """Return a gap that begins after the last sample."""
        before = self._last_complete
        if before is not None:
            before = dataclasses.replace(before, channels={name: self._held.get(name, NAN) for name in self.channels})
        return Gap(state=self.snapshot(), before=before, limit=self.bridge_samples)

    def _end_gap_of_channels(self) -> None:
        """Leave channels as they were held: where a temperature is missing, too, the last one that was seen counts."""
        if self._gap is not None and self._gap.is_of_channels:
            self._last_complete, self._gap = self._gap.samples[-1], None

    def _repeat(self, gap: Gap, after: Inputs) -> None:
        """Return to where the gap began and repeat it with interpolated inputs; what is missing at an end stays so."""
        reference, shifted_k = self._reference, self._shifted_k
        self.restore(gap.state)
        self._reference, self._shifted_k = reference, shifted_k
        n = len(gap.samples) + 1
        estimator = self.model.estimator
        feed = self.model.ttf.sampled.b[0] if self.model.ttf else 1.0
        at_walk = estimator.at_walk_std_k**2
        t_q_walk = (feed * self.model.drive_walk_std) ** 2 + at_walk
        before = after if gap.held or gap.before is None else gap.before
        for i, sample in enumerate(gap.samples, start=1):
            t_q, t_q_missing = _interpolated(sample.t_q_k, before.t_q_k, after.t_q_k, i / n)
            at, at_missing = _interpolated(sample.at_k, before.at_k, after.at_k, i / n)
            channels = {
                name: _interpolated(value, before.channels[name], after.channels[name], i / n)[0]
                for name, value in sample.channels.items()
            }
            # Variance of a random walk that is pinned at both ends.
            bridge = i * (n - i) / n
            self._advance(
                Inputs(t_q, at, channels),
                extra_t_q_k2=bridge * t_q_walk if t_q_missing else 0.0,
                extra_at_k2=bridge * at_walk if at_missing else 0.0,
            )


def _interpolated(value: float, before: float, after: float, part: float) -> tuple[float, bool]:
    """Return the value, or the straight line between its neighbours where it is missing, and whether it was."""
    if not math.isnan(value):
        return value, False
    return before + part * (after - before), True


def wrong_histories(model: ThermalModel, samples: Sequence[int]) -> tuple[list[Vector], list[Vector]]:
    """Return what 1 K too much of T_Q, and of AT, leaves in the state, for each of some past times.

    Parameters
    ----------
    model : ThermalModel
        The model; without a dead time of T_Q, whose state is that of some samples before.
    samples : sequence of int
        The times between these numbers of samples ago, increasing.
    """
    found = []
    for t_q_k, at_k in ((1.0, 0.0), (0.0, 1.0)):
        observer = observer_of(model)
        for _ in range(_SETTLES_IN):
            observer.step(0.0, 0.0)
            if observer.settled:
                break
        states = [np.array(observer.x[:-1])]
        for _ in range(samples[-1]):
            observer.step(t_q_k, at_k)
            states.append(np.array(observer.x[:-1]))
        found.append([states[after] - states[before] for before, after in itertools.pairwise(samples)])
    return found[0], found[1]
