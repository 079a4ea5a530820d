"""What a compensation carries from sample to sample, over a restart, a pause, and to another model.

The state is everything that determines the next outcome. What becomes of a sample is decided in `compensation`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from compensator.clock import NS
from compensator.config import Config
from compensator.errors import DataError, ServiceError
from compensator.model.engine import Engine
from compensator.model.thermal_model import ThermalModel
from compensator.service.axes import FurtherOutputs, planned_outputs
from compensator.service.axes_decision import FurtherDecision
from compensator.service.decision import OffsetDecision
from compensator.service.outcome import Prediction
from compensator.service.plausibility import (
    JumpWatch,
    PlausibilityCheck,
    PlausibilityState,
    SensorGuards,
)
from compensator.service.probing import Probing, ReceivedProbe
from compensator.service.state import (
    STATE_SCHEMA,
    CompensationState,
    Memory,
    ZeroState,
    decode_state,
    frozen_state,
)
from compensator.service.status import CompensationStatus, Handover, Zero

#: Longest pause that is simulated, in samples: a longer one would delay the sample after it.
MOST_BRIDGED = 1500
#: An unknown initial state counts as known after this many slowest time constants: 5 % of its error are left.
KNOWN_AFTER = 3.0


class Continuity:
    """The parts of a compensation and their state between two samples.

    Parameters
    ----------
    config : Config
        Limits and guards.
    model : ThermalModel
        Model of the deformation, see `model_of`.

    Raises
    ------
    ServiceError
        If the configuration lacks a channel of the model, or has other axes.
    """

    def __init__(self, config: Config, model: ThermalModel) -> None:
        self._config = config
        self.model = model
        self._period_min = model.period_s / 60.0
        self._engine = Engine(model)
        names = {channel.name for channel in config.channel}
        missing = [name for name in self._engine.channels if name not in names]
        if missing:
            names_missing = " and ".join(map(repr, missing))
            raise ServiceError(
                f"model {model.name}: an effect needs channel {names_missing}, which is not configured; `compensator "
                "check` prints the lines to paste"
            )
        wanted = [one.output for one in planned_outputs(config.axis)]
        if list(model.outputs) != wanted:
            names_of = ", ".join(one.name for one in wanted) or "Y alone"
            raise ServiceError(f"model {model.name}: its axes are not those of the configuration, expected {names_of}")
        self._guards = SensorGuards(config.channel, config.guards, self._period_min)
        self.plausibility = PlausibilityCheck(config, model)
        self._jumps = JumpWatch(config, model)
        own_channels = dict.fromkeys(channel for effect in model.effects for channel in effect.measured)
        self._decision = OffsetDecision(config, model, tuple(own_channels))
        self._limiter = self._decision.limiter
        self.outputs = FurtherOutputs(config.axis)
        self._further = FurtherDecision(self.outputs, model, self._decision) if config.axis is not None else None
        self._probes: tuple[ReceivedProbe, ...] = ()
        self.probing = Probing.of(config, self._engine.contribution_names, model.period_s)
        self._zero = ZeroState(wanted=config.zero.at_start)
        self._memory = Memory()
        #: Slowest time constant of the model, min.
        self.slowest_min = slowest_min(model)

    @property
    def status(self) -> CompensationStatus:
        """Zero, target and handover after the last sample."""
        memory, zero, prediction, probing = self._memory, self._zero, self._prediction(), self.probing
        return CompensationStatus(
            seq=memory.seq,
            time_utc_ns=memory.time_utc_ns,
            zero=Zero.of_references(self._engine, zero, self.outputs.states) if self._engine.has_reference else None,
            is_known=memory.cold_min <= 0.0,
            target_um=0.0 - prediction.y_um,
            std_um=prediction.std_um,
            handover=Handover(
                offset_um=self._limiter.offset_um,
                operator_hold=memory.operator_hold,
                internal_error=memory.internal_error,
                waiting_zero=zero.mode if zero.wanted else None,
                model_changed=memory.model_changed,
                probing=probing.handover if probing is not None else None,
                further=self.outputs.offsets(),
            ),
        )

    @property
    def waits_for_resume(self) -> bool:
        """Whether a person's `resume` would change which sensors are believed."""
        return self.plausibility.exchanged or bool(self._jumps.suspects or self._jumps.unconfirmed)

    @property
    def further_targets(self) -> dict[str, float]:
        """Offsets of the further outputs by the model, before limits, by name; NaN without an estimate."""
        found = self.outputs.predictions(self._memory.estimate)
        return {one.name: 0.0 - predicted.value for one, predicted in zip(self.outputs.planned, found, strict=True)}

    @property
    def has_gap(self) -> bool:
        """Whether T_Q or AT was missing up to now: with the next sample the state is not yet that of its time."""
        return self._engine.has_reference and self._memory.missing_min > 0.0

    @property
    def predicts_until_ns(self) -> int | None:
        """Time of the sample that is held if the missing temperature does not return; None while none is missing."""
        memory, predict_min = self._memory, self._config.loss.predict_for_min
        if not 0.0 < memory.missing_min <= predict_min:
            return None
        samples = math.floor((predict_min - memory.missing_min) / self._period_min + 1e-9) + 1
        return memory.time_utc_ns + round(samples * self._period_min * 60.0 * NS)

    @property
    def bridge_max_min(self) -> float:
        """Longest pause that is interpolated, min."""
        wanted = self._config.restart.bridge_max_min
        return min(self.slowest_min if wanted is None else wanted, MOST_BRIDGED * self._period_min)

    def _prediction(self) -> Prediction:
        """Return the deformation since the zero after the last sample, corrected by the probes; NaN before a zero."""
        estimate = self._memory.estimate
        if estimate is None:
            return Prediction()
        y_um, std_um, rate = estimate.y_um - self._zero.y_base, estimate.y_std_um, estimate.y_rate_um_per_min
        if self.probing is None:
            return Prediction(y_um, std_um, rate)
        found = self.probing.corrected(estimate.contributions_um, self._engine.y_noise_std_um)
        if math.isnan(found.std_um):
            return Prediction(y_um, std_um, rate)
        return Prediction(y_um + found.y_um, found.std_um, rate + found.rate_um_per_min, found.is_limited)

    # ------------------------------------------------------------------ state

    def state(self) -> bytes:
        """Return everything that determines the next outcome, as JSON without loss of precision."""
        return self.frozen()()

    def frozen(self) -> Callable[[], bytes]:
        """Return what encodes the present state, see `state`, whatever is processed until it is called."""
        return frozen_state(
            CompensationState(
                schema=STATE_SCHEMA,
                model_sha256=self.model.sha256,
                alternative=self._config.model.alternative,
                engine=self._engine.snapshot(),
                guards=self._guards.snapshot(),
                offset_um=self._limiter.offset_um,
                zero=self._zero,
                memory=self._memory,
                plausibility=self.plausibility.state if self.plausibility.is_on else None,
                probing=self.probing.state if self.probing is not None else None,
                jumps=self._jumps.state if self._jumps.is_on else None,
                axes=self.outputs.states if self._further is not None else None,
            )
        )

    def restore(self, state: bytes) -> None:
        """Continue from a state; all further outcomes are the same as without the interruption, bit for bit.

        Raises
        ------
        DataError
            If it cannot be read, or belongs to another model or other channels; nothing is changed then.
        """
        restored = decode_state(state)
        for name, found, expected in (
            ("model_sha256", restored.model_sha256, self.model.sha256),
            ("alternative", restored.alternative, self._config.model.alternative),
            ("guards", sorted(restored.guards), sorted(self._guards.snapshot())),
            ("axes", sorted(restored.axes or {}), sorted(self.outputs.states)),
        ):
            if found != expected:
                raise DataError(f"state: {name} = {found!r}, expected {expected!r}")
        engine = Engine(self.model)
        try:
            engine.check(restored.engine)
            engine.restore(restored.engine)
        except ValueError as error:
            raise DataError(f"state: {error}") from error
        estimate = restored.memory.estimate
        if estimate is not None and len(estimate.y_effects_um) != len(self.model.effects):
            raise DataError(f"state: estimate of {len(estimate.y_effects_um)} effects")
        if estimate is not None and len(estimate.outputs) != len(self.model.outputs):
            raise DataError(f"state: estimate of {len(estimate.outputs)} further outputs")
        jumps = JumpWatch(self._config, self.model)
        try:
            jumps.restore(restored.jumps)
        except ValueError as error:
            raise DataError(f"state: {error}") from error
        if self.probing is not None and restored.probing is not None:
            self.probing.restore(restored.probing)
        self._engine, self._zero, self._memory, self._jumps = engine, restored.zero, restored.memory, jumps
        self._guards.restore(restored.guards)
        self._limiter.offset_um = restored.offset_um
        self.outputs.states = {name: (restored.axes or {})[name] for name in self.outputs.states}
        # A state from a version without these checks does not contain theirs.
        self.plausibility.state = restored.plausibility or PlausibilityState()

    def pause(self, samples: int | None) -> None:
        """Account for samples that were not measured, for example while the service was not running.

        They count as missing: the prediction continues, its standard deviation grows, and at the next sample with both
        temperatures they are interpolated. After more than `bridge_max_min` the state is unknown: the machine is
        assumed to have been in its present condition throughout, and the reason `cold_start` remains until the error
        of this assumption has decayed.

        Parameters
        ----------
        samples : int or None
            Number of samples; 0 has no effect. None if it is unknown, which counts as too long to be bridged.
        """
        if samples is None:
            longest = max(KNOWN_AFTER * self.slowest_min, self.bridge_max_min)
            samples = math.floor(longest / self._period_min) + 1
        if samples <= 0:
            return
        minutes = samples * self._period_min
        self._guards.pass_time(minutes)
        self.plausibility.pass_time(samples)
        self._memory.missing_min += minutes
        if not self._zero.wanted:
            # How it was heated before says nothing of now: a zero must not be one at rest by it.
            self._memory.rates, self._memory.heats = [], []
            self.outputs.forget_rates()
        if not self._engine.has_reference:
            return
        is_cold = minutes > self.bridge_max_min
        if is_cold:
            self._pass_cold(min(samples, MOST_BRIDGED))
        else:
            self._jumps.pass_time(samples, held=False)
            self._memory.estimate = self._engine.skip(samples)
        if self.probing is not None and self._memory.estimate is not None:
            self.probing.pass_time(self._memory.estimate.contributions_um, minutes)

    @property
    def _cold_samples(self) -> int:
        """Samples after which a state that started unknown counts as known."""
        return min(math.ceil(KNOWN_AFTER * self.slowest_min / self._period_min), MOST_BRIDGED)

    def _pass_cold(self, samples: int) -> None:
        self._jumps.pass_time(samples, held=True)
        self._memory.estimate = self._engine.skip(samples, held=True)
        self._memory.cold_min = KNOWN_AFTER * self.slowest_min

    def begin(self, zero: Zero | None) -> None:
        """Start with a zero that was set before the record, and with an unknown state.

        Parameters
        ----------
        zero : Zero or None
            None to wait for the zero of the record, regardless of `zero.at_start`.
        """
        self.outputs.begin({} if zero is None else zero.further)
        if zero is None:
            self._zero = ZeroState()
            return
        self._engine.set_reference(zero.t_q_ref_degc, zero.at_ref_degc, (zero.t_q_shift_k, zero.at_shift_k))
        self._zero = ZeroState(y_ref=zero.y_ref_um, y_base=zero.y_base_um)
        self._pass_cold(self._cold_samples)

    def continue_from(self, handover: Handover) -> None:
        """Continue from another compensation: its offset moves on at the permitted rate, and its holds remain."""
        self.take_offsets(handover.offset_um, handover.further)
        self.take_holds(operator_hold=handover.operator_hold, internal_error=handover.internal_error)
        zero, self._memory.model_changed = self._zero, handover.model_changed
        for state in self.outputs.states.values():
            state.model_changed = handover.model_changed
        zero.wanted, zero.mode = handover.waiting_zero is not None, handover.waiting_zero or zero.mode
        if self.probing is not None and handover.probing is not None:
            self.probing.continue_from(handover.probing)

    def take_offsets(self, offset_um: float, further: Mapping[str, float]) -> None:
        """Go on from other offsets than its own, that of Y, µm, and further outputs by name; all else stays."""
        self._limiter.offset_um = offset_um
        self.outputs.take_offsets(further)

    def take_holds(self, *, operator_hold: bool, internal_error: bool) -> None:
        """Hold the offset until `resume` for these causes, and for no other of them."""
        self._memory.operator_hold, self._memory.internal_error = operator_hold, internal_error

    def raise_level(self, um: float) -> None:
        """Raise the predicted deformation from now on by a constant, µm; its changes stay as they are."""
        self._zero.y_base -= um
        self._zero.level += um
        self._jumps.raise_level(um)
        if self.probing is not None:
            self.probing.raise_level(um)

    @property
    def level_um(self) -> float:
        """By how much the predicted deformation was raised since the zero, µm."""
        return self._zero.level


def slowest_min(model: ThermalModel) -> float:
    """Return the slowest time constant of the paths and effects of a model and its further parts, min."""
    times: list[float] = []
    for part in (model, *model.parts):
        paths = [path for path in (part.ttf, part.dtf, part.tdtf) if path is not None]
        times += [tau for path in paths for tau in path.sampled.time_constants_min() if math.isfinite(tau)]
        for effect in part.effects:
            times += effect.time_constants_min
    return max(times, default=model.period_s / 60.0)
