"""From the estimate of a sample to its offset: state, reasons and limits."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from compensator.arrays import NAN
from compensator.codes import Reason, State
from compensator.config import Config, Limits
from compensator.messages import SCHEMA, Offset
from compensator.model.thermal_model import ThermalModel
from compensator.service.axes import Bounds, OutputState
from compensator.service.outcome import Prediction, Values
from compensator.service.plausibility import JumpWatch, PlausibilityCheck
from compensator.service.state import Memory

#: A published offset is valid for this many samples.
VALID_SAMPLES = 2.5


class Limited(msgspec.Struct, frozen=True):
    """An offset within its limits, its rate, and the limits that were reached."""

    offset_um: float
    rate_um_per_min: float
    reasons: tuple[Reason, ...] = ()


class Decision(msgspec.Struct, frozen=True):
    """State, reasons and offset of one sample; there is no offset before the first zero."""

    state: State
    reasons: list[str]
    limited: Limited | None

    def message(self, model: ThermalModel, machine: str, seq: int, time_utc_ns: int, std_um: float) -> Offset:
        """Return the offset message to publish."""
        return Offset(
            schema=SCHEMA,
            machine=machine,
            seq=seq,
            time_utc_ns=time_utc_ns,
            valid_for_s=VALID_SAMPLES * model.period_s,
            y_offset_um=self.limited.offset_um if self.limited else NAN,
            y_offset_rate_um_per_min=self.limited.rate_um_per_min if self.limited else NAN,
            y_offset_std_um=std_um,
            state=self.state,
            reasons=self.reasons,
            model_sha256=model.sha256,
        )


class Condition(msgspec.Struct, frozen=True):
    """What a sample means for every axis: reasons that are the machine's, and whether the offsets are held.

    Parameters
    ----------
    channels, later : list of str
        Reasons of the temperatures, and those that come after the axis' own channels.
    blocking : list of str
        Why every offset is held.
    lost, expired, exchanged : bool
        Whether a temperature is missing, for too long, or both seem to be exchanged.
    """

    channels: list[str]
    later: list[str]
    blocking: list[str]
    lost: bool
    expired: bool
    exchanged: bool


class OffsetLimiter:
    """Keeps the offset within its limits, so that it never jumps; `period_min` is the length of a sample, min."""

    def __init__(self, limits: Limits | Bounds, period_min: float) -> None:
        self._max_um = limits.offset_max_um
        self._rate_max = limits.offset_rate_max_um_per_min
        self._period_min = period_min
        #: The last published offset, µm; 0 before the first, as the control then applies none.
        self.offset_um = 0.0

    def follow(self, target_um: float, target_rate_um_per_min: float) -> Limited:
        """Move towards a target.

        Parameters
        ----------
        target_um : float
            Target of the offset, µm.
        target_rate_um_per_min : float
            Rate of the target, µm/min.

        Returns
        -------
        Limited
            The next offset, and the expected rate to the one after it.

        Raises
        ------
        ValueError
            If the target is not a number: the limits below would let it pass.
        """
        if not (math.isfinite(target_um) and math.isfinite(target_rate_um_per_min)):
            raise ValueError("the target of the offset is not a finite number")
        reasons = []
        wanted = target_um
        if abs(wanted) > self._max_um:
            wanted = math.copysign(self._max_um, wanted)
            reasons.append(Reason.OFFSET_LIMITED)
        step_max = self._rate_max * self._period_min
        # At most the change of one sample, regardless of the time since the last published offset.
        if abs(wanted - self.offset_um) > step_max:
            wanted = self.offset_um + math.copysign(step_max, wanted - self.offset_um)
            reasons.append(Reason.RATE_LIMITED)
        self.offset_um = wanted
        rate = self._rate_towards(target_um + target_rate_um_per_min * self._period_min)
        return Limited(wanted, rate, tuple(reasons))

    def hold(self) -> Limited:
        """Keep the offset."""
        return Limited(self.offset_um, 0.0)

    def _rate_towards(self, next_target_um: float) -> float:
        ahead = max(-self._max_um, min(self._max_um, next_target_um))
        rate = (ahead - self.offset_um) / self._period_min
        return max(-self._rate_max, min(self._rate_max, rate))


class OffsetDecision:
    """Decides state, reasons and offset of each sample; `channels` are those that the effects of Y use."""

    def __init__(self, config: Config, model: ThermalModel, channels: Sequence[str]) -> None:
        self._channels = tuple(channels)
        self._period_min = model.period_s / 60.0
        self._predict_for_min = config.loss.predict_for_min
        self._validity = _validity(config, model)
        self.limiter = OffsetLimiter(config.limits, self._period_min)

    def decide(self, condition: Condition, values: Values, prediction: Prediction | None, memory: Memory) -> Decision:
        """Decide Y, see `decided`."""
        return self.decided(condition, values, self._channels, prediction, self.limiter, memory)

    def condition(
        self,
        values: Values,
        has_zero: bool,
        memory: Memory,
        plausibility: PlausibilityCheck,
        jumps: JumpWatch,
    ) -> Condition:
        """Return what a sample means for every axis; called once for each sample.

        Parameters
        ----------
        values : Values
            Its usable values.
        has_zero : bool
            Whether there is a prediction.
        memory : Memory
            Values kept from sample to sample; times in it advance.
        plausibility : PlausibilityCheck
            Checks between the sensors, including this sample.
        jumps : JumpWatch
            Channels that have jumped, and those that may have.
        """
        pairs = ((Reason.T_Q_MISSING, values.t_q), (Reason.AT_MISSING, values.at))
        reasons: list[str] = [reason for reason, value in pairs if math.isnan(value)]
        lost = bool(reasons)
        reasons += [f"{Reason.SUSPECT_CHANNEL}:{name}" for name in jumps.suspects]
        reasons += [f"{Reason.UNCONFIRMED_CHANNEL}:{name}" for name in jumps.unconfirmed]
        memory.missing_min = memory.missing_min + self._period_min if lost else 0.0
        expired = lost and memory.missing_min > self._predict_for_min
        later: list[str] = []
        blocking: list[str] = []
        if has_zero:
            if memory.cold_min > 0.0:
                memory.cold_min -= self._period_min
                later.append(Reason.COLD_START)
            later += plausibility.reasons
            blocking = self._blocking(values, expired, memory, plausibility)
        return Condition(reasons, later, blocking, lost, expired, plausibility.exchanged)

    def decided(
        self,
        condition: Condition,
        values: Values,
        channels: Sequence[str],
        prediction: Prediction | None,
        limiter: OffsetLimiter,
        memory: Memory | OutputState,
    ) -> Decision:
        """Decide one axis.

        Parameters
        ----------
        condition : Condition
            What the sample means for every axis.
        values : Values
            Its usable values.
        channels : sequence of str
            Channels that the effects of the axis use.
        prediction : Prediction, optional
            Predicted deformation of the axis since the zero, in its unit; None before the first zero.
        limiter : OffsetLimiter
            That of the axis.
        memory : Memory or OutputState
            That of the axis.
        """
        if prediction is None:
            state = State.FAULT if condition.expired else State.STARTING
            return Decision(state, [*condition.channels, Reason.NO_ZERO], None)
        missing = (name for name in channels if math.isnan(values.others.get(name, NAN)))
        reasons = [*condition.channels, *(f"{Reason.CHANNEL_MISSING}:{name}" for name in missing), *condition.later]
        blocking = condition.blocking
        if condition.exchanged:
            return Decision(State.FAULT, [*reasons, *blocking, Reason.T_Q_AT_EXCHANGED], limiter.hold())
        if blocking:
            return Decision(State.HOLD, reasons + blocking, limiter.hold())
        if condition.lost:
            reasons.append(Reason.PREDICTING)
        if prediction.is_limited:
            reasons.append(Reason.CORRECTION_LIMITED)
        limited = limiter.follow(0.0 - prediction.y_um, -prediction.rate_um_per_min)
        memory.model_changed &= Reason.RATE_LIMITED in limited.reasons
        if memory.model_changed:
            reasons.append(Reason.MODEL_CHANGED)
        reasons += limited.reasons
        return Decision(State.DEGRADED if reasons else State.OK, reasons, limited)

    def _blocking(self, values: Values, expired: bool, memory: Memory, plausibility: PlausibilityCheck) -> list[str]:
        """Return why the offset must be held."""
        # A single heat estimate overshoots when a source is switched; the mean over some samples does not.
        heat = mean(memory.heats)
        outside = [
            f"{Reason.OUTSIDE_VALIDITY}:{name}"
            for name, value in (("t_q_degc", values.t_q), ("at_degc", values.at), ("heat_w", heat))
            if name in self._validity
            and not math.isnan(value)
            and not self._validity[name][0] <= value <= self._validity[name][1]
        ]
        flags = (
            (Reason.PREDICTION_EXPIRED, expired),
            (Reason.RESIDUAL_TOO_LARGE, plausibility.too_large),
            (Reason.OPERATOR_HOLD, memory.operator_hold),
            (Reason.INTERNAL_ERROR, memory.internal_error),
        )
        return outside + [code for code, present in flags if present]


def _validity(config: Config, model: ThermalModel) -> dict[str, tuple[float, float]]:
    """Return the range of validity: the configuration's, narrowed by the model's."""
    limits = config.limits.validity
    bounds = {"t_q_degc": limits.t_q_degc, "at_degc": limits.at_degc}
    for key, (low, high) in model.validity.items():
        configured = bounds.get(key, (-math.inf, math.inf))
        bounds[key] = (max(low, configured[0]), min(high, configured[1]))
    return bounds


def mean(values: list[float]) -> float:
    """Return the mean; NaN for an empty list."""
    return math.fsum(values) / len(values) if values else NAN
