"""From a sample to an offset: guards, zero, engine, loss of a sensor, limits, state.

This is the whole decision of the service, and it knows no socket, file or clock: a recorded sample gives the
same estimate and the same offset again, bit for bit. What it publishes never jumps: every change goes
through the limiter, whatever caused it.
"""

from __future__ import annotations

import math

import msgspec

from compensator.config import Config
from compensator.errors import DataError, ServiceError
from compensator.events import EventKind, Note, ZeroData
from compensator.messages import SCHEMA, Offset, Sample, State, number
from compensator.model.effects import effect_from
from compensator.model.engine import Engine, Estimate
from compensator.model.thermal_model import ThermalModel
from compensator.service.guards import HEATED_W, SensorGuards
from compensator.service.limits import Limited, OffsetLimiter
from compensator.service.outcome import VALID_SAMPLES, Outcome, Values, estimate_message, offset_message, values_of
from compensator.service.plausibility import Evidence, PlausibilityCheck, PlausibilityState
from compensator.service.state import (
    STATE_SCHEMA,
    CompensationState,
    Memory,
    ZeroMode,
    ZeroState,
    decode_state,
    encode_state,
)

__all__ = ["Compensation", "Outcome", "slowest_min"]

NAN = float("nan")

#: Number of samples over which rate and heat are averaged before they decide anything.
MEAN_SAMPLES = 5

#: Longest pause that is walked over, in samples: more would delay the sample after it.
MOST_BRIDGED = 1500
#: A state that began unknown counts as known after so many of the slowest time constants (5 % are left then).
KNOWN_AFTER = 3.0


class Compensation:
    """Compensation of one machine.

    Parameters
    ----------
    config : Config
        Limits, guards, loss, zero.
    model : ThermalModel
        What predicts the deformation.
    """

    def __init__(self, config: Config, model: ThermalModel) -> None:
        self._config = config
        self.model = model
        self._period_min = model.period_s / 60.0
        self._engine = Engine(model)
        names = {channel.name for channel in config.channel}
        missing = [name for name in self._engine.channels if name not in names]
        if missing:
            raise ServiceError(f"model {model.name}: an effect needs channel {missing[0]!r}, which is not configured")
        self._guards = SensorGuards(config.channel, config.guards, self._period_min)
        self.plausibility = PlausibilityCheck(config, model)
        self._limiter = OffsetLimiter(config.limits, self._period_min)
        self._zero = ZeroState(wanted=config.zero.at_start)
        self._memory = Memory()
        self._validity = self._bounds()
        #: The model's slowest time constant, min.
        self.slowest_min = slowest_min(model)

    def _bounds(self) -> dict[str, tuple[float, float]]:
        """Return the range of validity: the configuration's, narrowed by the model's own."""
        limits = self._config.limits.validity
        bounds = {"t_q_degc": limits.t_q_degc, "at_degc": limits.at_degc}
        for key, (low, high) in self.model.validity.items():
            configured = bounds.get(key, (-math.inf, math.inf))
            bounds[key] = (max(low, configured[0]), min(high, configured[1]))
        return bounds

    # ------------------------------------------------------------------ commands

    def zero(self, mode: ZeroMode = "auto") -> None:
        """Ask for a zero at the next sample that has both temperatures.

        Parameters
        ----------
        mode : {"auto", "rest", "warm"}
            `rest`: the machine is in thermal equilibrium; temperatures and deformation count from here.
            `warm`: it is not; only the deformation counts from here, what the machine has stored goes on.
            `auto`: `rest` where the predicted growth is below the configured rate, else `warm`.
        """
        self._zero.wanted, self._zero.mode = True, mode

    def hold(self) -> None:
        """Freeze the offset until `resume`."""
        self._memory.operator_hold = True

    def resume(self) -> None:
        """Follow the model again, at the permitted rate.

        After exchanged sensors the state is that of a machine which never was: it begins unknown.
        """
        self._memory.operator_hold = False
        self._memory.internal_error = False
        if self.plausibility.exchanged:
            self.plausibility.seen()
            if self._engine.has_reference:
                self._pass_cold(min(math.ceil(KNOWN_AFTER * self.slowest_min / self._period_min), MOST_BRIDGED))

    def fail(self) -> None:
        """Hold the offset because the service met an error of its own."""
        self._memory.internal_error = True

    def held(self, machine: str, seq: int, time_utc_ns: int) -> Offset:
        """Return the message that the last offset stands, for a sample that could not be worked on."""
        stands = self._limiter.offset_um if self._memory.estimate else NAN
        return Offset(
            schema=SCHEMA,
            machine=machine,
            seq=seq,
            time_utc_ns=time_utc_ns,
            valid_for_s=VALID_SAMPLES * self.model.period_s,
            y_offset_um=stands,
            y_offset_rate_um_per_min=0.0 if self._memory.estimate else NAN,
            y_offset_std_um=NAN,
            state="hold" if self._memory.estimate else "fault",
            reasons=["internal_error"],
            model_sha256=self.model.sha256,
        )

    # ------------------------------------------------------------------ state

    @property
    def has_reference(self) -> bool:
        """Whether the inputs have a reference yet."""
        return self._engine.has_reference

    @property
    def last(self) -> tuple[int, int]:
        """Number and time, ns since 1970 UTC, of the last sample; −1 and 0 before the first."""
        return self._memory.seq, self._memory.time_utc_ns

    @property
    def offset_um(self) -> float:
        """The last offset, µm."""
        return self._limiter.offset_um

    @property
    def target_um(self) -> float:
        """Where the offset is to go, µm; NaN while there is no estimate."""
        estimate = self._memory.estimate
        return self._zero.y_base - estimate.y_um if estimate is not None else NAN

    @property
    def std_um(self) -> float:
        """Standard deviation of the prediction, µm; NaN while there is none."""
        return self._memory.estimate.y_std_um if self._memory.estimate is not None else NAN

    @property
    def is_under_way(self) -> bool:
        """Whether the offset is still under way to that of another model."""
        return self._memory.model_changed

    @property
    def operator_hold(self) -> bool:
        """Whether an operator has frozen the offset."""
        return self._memory.operator_hold

    @property
    def zero_that_stands(self) -> dict[str, float]:
        """The zero, as `begin` takes it."""
        reference = self._engine.reference
        return {
            "t_q_ref_degc": reference.t_q_degc,
            "at_ref_degc": reference.at_degc,
            "y_ref_um": self._zero.y_ref,
            "y_base_um": self._zero.y_base,
        }

    @property
    def is_cold(self) -> bool:
        """Whether the state began unknown and that is not forgotten yet."""
        return self._memory.cold_min > 0.0

    @property
    def bridge_max_min(self) -> float:
        """Longest pause that is interpolated, min."""
        wanted = self._config.restart.bridge_max_min
        return min(self.slowest_min if wanted is None else wanted, MOST_BRIDGED * self._period_min)

    def state(self) -> bytes:
        """Return everything that decides the next outcome, as JSON that keeps every bit."""
        return encode_state(
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
            )
        )

    def restore(self, state: bytes) -> None:
        """Go on from a state; all further outcomes are those that would have followed, bit for bit.

        Raises
        ------
        DataError
            If it is no state, or that of another model or of other channels. Nothing is changed then.
        """
        whole = decode_state(state)
        for name, found, expected in (
            ("model_sha256", whole.model_sha256, self.model.sha256),
            ("alternative", whole.alternative, self._config.model.alternative),
            ("guards", sorted(whole.guards), sorted(self._guards.snapshot())),
        ):
            if found != expected:
                raise DataError(f"state: {name} = {found!r}, expected {expected!r}")
        engine = Engine(self.model)
        try:
            engine.check(whole.engine)
            engine.restore(whole.engine)
        except ValueError as error:
            raise DataError(f"state: {error}") from error
        estimate = whole.memory.estimate
        if estimate is not None and len(estimate.y_effects_um) != len(self.model.effects):
            raise DataError(f"state: estimate of {len(estimate.y_effects_um)} effects")
        self._engine, self._zero, self._memory = engine, whole.zero, whole.memory
        self._guards.restore(whole.guards)
        self._limiter.offset_um = whole.offset_um
        # A state of before there was this check has no part for it: it begins anew.
        self.plausibility.state = whole.plausibility or PlausibilityState()

    def pause(self, samples: int) -> None:
        """Pass over samples that nobody took, such as those while the service did not run.

        They count as missing: the prediction goes on and its standard deviation grows, and the next sample with both
        temperatures walks over them again. A pause of more than `bridge_max_min` says nothing certain about the state
        at its end: the machine is then taken to have been all the while as it is found, and the reason `cold_start`
        stands until that is forgotten.

        Parameters
        ----------
        samples : int
            How many; nothing is done for none.
        """
        if samples <= 0:
            return
        minutes = samples * self._period_min
        self._guards.pass_time(minutes)
        self.plausibility.pass_time(samples)
        self._memory.missing_min += minutes
        if not self._engine.has_reference:
            return
        if minutes > self.bridge_max_min:
            self._pass_cold(min(samples, MOST_BRIDGED))
        else:
            self._memory.estimate = self._engine.skip(samples)

    def pause_of_unknown_length(self) -> None:
        """Pass over a pause whose length nobody knows, as over one that is too long to be bridged."""
        longest = max(KNOWN_AFTER * self.slowest_min, self.bridge_max_min)
        self.pause(math.floor(longest / self._period_min) + 1)

    def _pass_cold(self, samples: int) -> None:
        self._memory.estimate = self._engine.skip(samples, held=True)
        self._memory.cold_min = KNOWN_AFTER * self.slowest_min

    def begin(self, *, t_q_ref_degc: float, at_ref_degc: float, y_ref_um: float, y_base_um: float) -> None:
        """Begin with a zero that was set before there is a record, and with an unknown state.

        Parameters
        ----------
        t_q_ref_degc, at_ref_degc, y_ref_um : float
            The zero: temperatures, °C, and measured deformation, µm (NaN where it is not known).
        y_base_um : float
            Predicted deformation at the last zero on a warm machine, µm.
        """
        self._engine.set_reference(t_q_ref_degc, at_ref_degc)
        self._zero = ZeroState(y_ref=y_ref_um, y_base=y_base_um)
        self._pass_cold(min(math.ceil(KNOWN_AFTER * self.slowest_min / self._period_min), MOST_BRIDGED))

    def begin_at_zero(self) -> None:
        """Wait for the zero of a record, whatever the configuration says of the start."""
        self._zero = ZeroState()

    def go_on_from(self, offset_um: float, *, model_changed: bool = False) -> None:
        """Go on from the offset that stands; from there it moves at the permitted rate.

        Parameters
        ----------
        offset_um : float
            What was published last, µm.
        model_changed : bool
            Whether it is another model's; the reason stands until the offset has arrived at its new value.
        """
        self._limiter.offset_um = offset_um
        self._memory.model_changed = model_changed

    def succeed(self, other: Compensation) -> None:
        """Take the place of a compensation with another model: its offset, holds and waiting zero stand.

        Parameters
        ----------
        other : Compensation
            The one before.
        """
        memory = other._memory
        self._memory.operator_hold, self._memory.internal_error = memory.operator_hold, memory.internal_error
        self._zero.wanted, self._zero.mode = other._zero.wanted, other._zero.mode
        self.go_on_from(other.offset_um, model_changed=memory.estimate is not None)

    # ------------------------------------------------------------------ one sample

    def process(self, raw: Sample) -> Outcome:
        """Take one sample.

        Parameters
        ----------
        raw : Sample
            What the devices gave.

        Returns
        -------
        Outcome
            Everything to be recorded and published, in that order.
        """
        heat = self._memory.estimate.heat_w if self._memory.estimate else NAN
        sample = msgspec.structs.replace(raw, channels=self._guards.judge(raw.channels, heat))
        values = values_of(sample.channels)
        notes: list[Note] = []
        self._set_zero(values, notes)
        self._memory.seq, self._memory.time_utc_ns = raw.seq, raw.time_utc_ns
        estimate = None
        if self._engine.has_reference:
            estimate = self._engine.step(values.t_q, values.at, values.others)
            self._memory.estimate = estimate
            self._memory.rates = [*self._memory.rates[-MEAN_SAMPLES + 1 :], estimate.y_rate_um_per_min]
            self._memory.heats = [*self._memory.heats[-MEAN_SAMPLES + 1 :], estimate.heat_w]
        y_pred = estimate.y_um - self._zero.y_base if estimate else NAN
        if math.isnan(self._zero.y_ref) and estimate is not None:
            # The probe was missing at the zero: its reference makes the residual start at zero.
            self._zero.y_ref = values.y - y_pred
        if self.plausibility.is_on:
            notes += self.plausibility.take(self._evidence(raw, values, estimate, y_pred))
        state, reasons, limited = self._decide(values, estimate, y_pred)
        # Somebody is suspected: the offset may be wrong by what measured and predicted Y differ by.
        std = math.hypot(estimate.y_std_um, self.plausibility.error_um) if estimate else NAN
        return Outcome(
            sample=sample,
            estimate=estimate_message(sample, values, estimate, self._engine.reference, self._zero, y_pred),
            offset=offset_message(sample, self.model, std, state, reasons, limited),
            notes=tuple(notes),
        )

    def _evidence(self, raw: Sample, values: Values, estimate: Estimate | None, y_pred: float) -> Evidence:
        """Return what the checks between the sensors look at."""
        t_q, at = (
            number(channel.mean) if channel is not None and channel.device_quality == "good" else NAN
            for channel in (raw.channels.get(name) for name in ("t_q_degc", "at_degc"))
        )
        reference = self._engine.reference
        rest = self._config.plausibility.rest if self._config.plausibility is not None else None
        # A prediction without both temperatures, or from an unknown state, is no witness against a sensor.
        usable = not math.isnan(values.t_q + values.at) and self._memory.cold_min <= 0.0
        return Evidence(
            below_k=at - t_q,
            apart_k=(values.t_q - reference.t_q_degc) - (values.at - reference.at_degc),
            rest=values.others.get(rest.channel, NAN) if rest is not None else NAN,
            residual_um=values.y - self._zero.y_ref - y_pred if usable else NAN,
            std_um=estimate.y_std_um if estimate else NAN,
            predicted_um=y_pred,
        )

    def _set_zero(self, values: Values, notes: list[Note]) -> None:
        zero = self._zero
        if not zero.wanted or math.isnan(values.t_q) or math.isnan(values.at):
            return
        warm = self._engine.has_reference and self._is_warm(zero.mode)
        if warm:
            # The state is that of the last sample; its growth until this one belongs to what comes.
            zero.y_base = self._memory.estimate.y_um if self._memory.estimate else 0.0
        else:
            self._engine.set_reference(values.t_q, values.at)
            self._memory.estimate, self._memory.rates, self._memory.heats = None, [], []
            zero.y_base, self._memory.cold_min = 0.0, 0.0
        zero.y_ref, zero.wanted = values.y, False
        self.plausibility.zeroed(at_rest=not warm)
        # Version 0.1.0 recorded this text without data: an audit of its recordings compares it.
        text = (
            f"zero on a {'warm machine' if warm else 'machine at rest'}: T_Q {values.t_q:.3f} °C, AT {values.at:.3f} °C"
        )
        text += ", Y not measured" if math.isnan(values.y) else f", Y {values.y:.3f} µm"
        data = ZeroData(mode="warm" if warm else "rest", t_q_degc=values.t_q, at_degc=values.at, y_um=values.y)
        notes.append(Note(EventKind.ZERO, text, data.table()))

    def _is_warm(self, mode: ZeroMode) -> bool:
        if mode != "auto" or not self._memory.rates:
            return mode == "warm"
        # A machine on a long plateau hardly grows, but it is heated: its heat must not become the zero.
        heated = abs(_mean(self._memory.heats)) > HEATED_W
        return heated or abs(_mean(self._memory.rates)) > self._config.zero.rest_rate_um_per_min

    # ------------------------------------------------------------------ decision

    def _decide(
        self, values: Values, estimate: Estimate | None, y_pred: float
    ) -> tuple[State, list[str], Limited | None]:
        reasons = [
            code for code, value in (("t_q_missing", values.t_q), ("at_missing", values.at)) if math.isnan(value)
        ]
        lost = bool(reasons)
        self._memory.missing_min = self._memory.missing_min + self._period_min if lost else 0.0
        expired = lost and self._memory.missing_min > self._config.loss.predict_for_min
        if estimate is None:
            state: State = "fault" if expired else "starting"
            return state, [*reasons, "no_zero"], None
        reasons += [
            f"channel_missing:{name}" for name in self._engine.channels if math.isnan(values.others.get(name, NAN))
        ]
        if self._memory.cold_min > 0.0:
            self._memory.cold_min -= self._period_min
            reasons.append("cold_start")
        reasons += self.plausibility.reasons
        blocking = self._blocking(values, expired)
        if self.plausibility.exchanged:
            return "fault", [*reasons, *blocking, "t_q_at_exchanged"], self._limiter.hold()
        if blocking:
            return "hold", reasons + blocking, self._limiter.hold()
        if lost:
            reasons.append("predicting")
        limited = self._limiter.follow(0.0 - y_pred, -estimate.y_rate_um_per_min)
        self._memory.model_changed &= "rate_limited" in limited.reasons
        if self._memory.model_changed:
            reasons.append("model_changed")
        reasons += limited.reasons
        return ("degraded" if reasons else "ok"), reasons, limited

    def _blocking(self, values: Values, expired: bool) -> list[str]:
        """Return why the offset must stay where it is."""
        # A single estimate of the heat overshoots when a source is switched; its mean over some samples does not.
        heat = _mean(self._memory.heats)
        outside = [
            f"outside_validity:{name}"
            for name, value in (("t_q_degc", values.t_q), ("at_degc", values.at), ("heat_w", heat))
            if name in self._validity
            and not math.isnan(value)
            and not self._validity[name][0] <= value <= self._validity[name][1]
        ]
        flags = (
            ("prediction_expired", expired),
            ("residual_too_large", self.plausibility.too_large),
            ("operator_hold", self._memory.operator_hold),
            ("internal_error", self._memory.internal_error),
        )
        return outside + [code for code, present in flags if present]


def slowest_min(model: ThermalModel) -> float:
    """Return the slowest time constant of a model's paths and effects, min."""
    paths = [path for path in (model.ttf, model.dtf, model.tdtf) if path is not None]
    times = [tau for path in paths for tau in path.sampled.time_constants_min() if math.isfinite(tau)]
    for effect in model.effects:
        times += effect_from(effect.kind, effect.table).time_constants_min
    return max(times, default=model.period_s / 60.0)


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values) if values else NAN
