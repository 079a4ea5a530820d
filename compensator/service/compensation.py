"""From a sample to an offset: guards, zero, engine, plausibility, decision.

All decisions of the service are made here. The module uses no socket, file or clock, so a recorded sample gives the
same estimate and the same offset again, bit for bit. The published offset never jumps: every change passes the limiter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from compensator.arrays import NAN
from compensator.axes import FIRST
from compensator.codes import Reason, SampleQuality, State
from compensator.config import Config
from compensator.errors import ModelError
from compensator.events import DOUBT, EventKind, Note, ZeroData
from compensator.messages import Offset, Probe, Sample, number
from compensator.messages_axes import AxisOffset
from compensator.model.engine import Estimate
from compensator.model.model_file import parse_axes, parse_model
from compensator.model.outputs import with_outputs
from compensator.model.thermal_model import ThermalModel
from compensator.service.axes import planned_outputs
from compensator.service.continuity import Continuity, slowest_min
from compensator.service.decision import Decision, mean
from compensator.service.outcome import Outcome, Prediction, Values, estimate_message
from compensator.service.plausibility import (
    HEATED_W,
    TEMPERATURES,
    Judgement,
    SensorEvidence,
)
from compensator.service.probing import ReceivedProbe, Wanted
from compensator.service.probing.state import PastSample
from compensator.service.state import (
    ZeroMode,
)

__all__ = ["Compensation", "Outcome", "model_of", "slowest_min"]

#: Number of samples over which rate and heat are averaged before they are used in a decision.
MEAN_SAMPLES = 5
#: A machine is clearly not at rest if the model ascribes more deformation to stored heat than so many of its standard
#: deviations, and than a thermocouple makes that was replaced or has drifted, µm: then a zero at rest is right.
_WARM_DEVIATIONS, _WARM_UM = 4.0, 5.0


class Compensation(Continuity):
    """Compensation of one machine, with the limits and guards of a configuration and a model of the deformation."""

    # ------------------------------------------------------------------ commands

    def zero(self, mode: ZeroMode = "auto") -> None:
        """Request a zero at the next sample that has both temperatures.

        Parameters
        ----------
        mode : {"auto", "rest", "warm"}
            `rest`: the machine is in thermal equilibrium; temperatures and deformation are zeroed.
            `warm`: it is not; only the deformation is zeroed, and the stored heat stays in the state.
            `auto`: `rest` if the predicted growth is below the configured rate, else `warm`.

        Notes
        -----
        `rest` is obeyed where the model contradicts it, with a warning (`doubt_of_rest`): a person may know better, of
        a thermocouple that was replaced for instance.
        """
        self._release(new_zero=True)
        self._zero.wanted, self._zero.mode = True, mode

    @property
    def warm_um(self) -> float | None:
        """Deformation by stored heat after the last sample, µm, if the machine is clearly not at rest; else None."""
        # One reference, which is replaced as a whole: commands ask on other threads.
        memory, checks, estimate = self._memory, self.plausibility, self._memory.estimate
        # Without a known state, or while the temperatures contradict each other, the model knows nothing of heat.
        if estimate is None or memory.cold_min > 0.0 or checks.exchanged or checks.state.apart:
            return None
        least_um = max(_WARM_DEVIATIONS * estimate.y_std_um, _WARM_UM)
        # Less than no heat is no warm machine: the zero before was none at rest, or a thermocouple is wrong.
        gain, _ = self.model.dtf.gain_with_std()
        return estimate.y_dtf_um if math.copysign(1.0, gain) * estimate.y_dtf_um > least_um else None

    def hold(self) -> None:
        """Freeze the offset until `resume`."""
        self._memory.operator_hold = True

    def resume(self) -> None:
        """Follow the model again, at the permitted rate.

        If sensors were exchanged, the state is wrong and is treated as unknown. A channel that has jumped is believed.
        """
        self._release(new_zero=False)
        self._memory.operator_hold = False
        self._memory.internal_error = False
        if self.plausibility.exchanged:
            self.plausibility.acknowledge()
            if self._engine.has_reference:
                self._pass_cold(self._cold_samples)

    def believe_as_in_force(self, reasons: Sequence[str]) -> None:
        """Believe that T_Q and AT are right again where the model in force does, whose reasons of a sample are given.

        Where its state was unknown after exchanged wires a person has seen to them; else measured Y has shown it, maybe
        not yet by this model. A channel that has jumped is believed only if both models have suspected it.
        """
        self._use(self._jumps.follow(self._engine, reasons))
        if self.plausibility.exchanged and Reason.T_Q_AT_EXCHANGED not in reasons:
            if Reason.COLD_START in reasons:
                self.resume()
            else:
                self.plausibility.acknowledge()

    def _release(self, *, new_zero: bool) -> None:
        """Use channels again that have jumped."""
        self._use(self._jumps.release(self._engine, self._memory.estimate, new_zero=new_zero))

    def _use(self, found: Judgement) -> None:
        """Go on from what was judged between two samples."""
        self._follow(found)
        if found.estimate is not None:
            self._memory.estimate = found.estimate

    def receive_probes(self, probes: Sequence[ReceivedProbe]) -> None:
        """Receive the probes that the next sample decides; without `[probe]` they are ignored."""
        self._probes = tuple(probes)

    def fail(self) -> None:
        """Hold the offset because of an internal error, until `resume`."""
        self._memory.internal_error = True

    def held_axes(self, machine: str, seq: int, time_utc_ns: int) -> tuple[Offset, ...]:
        """Return the last offsets of all axes for a sample that could not be processed, that of Y first."""
        known = self._memory.estimate is not None
        limited = self._limiter.hold() if known else None
        decision = Decision(State.HOLD if known else State.FAULT, [Reason.INTERNAL_ERROR], limited)
        offset = decision.message(self.model, machine, seq, time_utc_ns, NAN)
        return (offset,) if self._further is None else self._further.hold(offset, known=known)

    # ------------------------------------------------------------------ what is asked

    @property
    def wanted(self) -> Wanted | None:
        """Whether a probe is wanted after the last sample; None without `[probe]`."""
        return self.probing.wanted(self._prediction().std_um) if self.probing is not None else None

    def describe_checks(self) -> str:
        """Describe which checks of the sensors are on and off."""
        return f"{self.plausibility.describe()}; {self._jumps.describe()}"

    # ------------------------------------------------------------------ one sample

    def process(self, raw: Sample) -> Outcome:
        """Process one sample.

        Parameters
        ----------
        raw : Sample
            Readings of the devices.

        Returns
        -------
        Outcome
            Everything to be recorded and published, in that order.
        """
        heat = self._memory.estimate.heat_w if self._memory.estimate else NAN
        channels = self._guards.check(raw.channels, heat, self._jumps.suspects)
        sample = msgspec.structs.replace(raw, channels=channels)
        values = Values.of(sample.channels)
        notes: list[Note] = []
        self._set_zero(raw.time_utc_ns, values, notes)
        self._memory.seq, self._memory.time_utc_ns = raw.seq, raw.time_utc_ns
        estimate = None
        if self._engine.has_reference:
            estimate = self._judge_jumps(sample, values, notes) or self._engine.step(
                values.t_q, values.at, values.others
            )
            self._jumps.observe(self._engine, values.y, self._zero.y_ref - self._zero.y_base, estimate)
            self._memory.estimate = estimate
            self._memory.rates = [*self._memory.rates[-MEAN_SAMPLES + 1 :], estimate.y_rate_um_per_min]
            self._memory.heats = [*self._memory.heats[-MEAN_SAMPLES + 1 :], estimate.heat_w]
            self.outputs.remember(estimate, MEAN_SAMPLES)
            self._remember_sample(raw, estimate)
        decided = self._decide_probes(raw, notes)
        prediction = self._prediction() if estimate else Prediction()
        y_pred = prediction.y_um
        if math.isnan(self._zero.y_ref) and estimate is not None:
            # The probe was missing at the zero: with this reference the residual starts at zero.
            self._zero.y_ref = values.y - y_pred
        predictions = self.outputs.predictions(estimate)
        self.outputs.refer(predictions, values.others)
        if self.plausibility.is_on:
            notes += self.plausibility.update(self._evidence(raw, values, prediction))
        condition = self._decision.condition(values, estimate is not None, self._memory, self.plausibility, self._jumps)
        decision = self._decision.decide(condition, values, prediction if estimate else None, self._memory)
        if self.probing is not None and decision.limited is not None:
            held = decision.state in (State.HOLD, State.FAULT)
            self.probing.publish(decision.limited.offset_um, decision.limited.rate_um_per_min, is_held=held)
        # During an alarm the offset may be wrong by the difference between measured and predicted Y.
        std = math.hypot(prediction.std_um, self.plausibility.error_um, self._jumps.doubt_um)
        offset = decision.message(self.model, sample.machine, sample.seq, sample.time_utc_ns, std)
        axes: dict[str, float | list[float] | None] | None = None
        further: tuple[AxisOffset, ...] = ()
        if self._further is not None:
            axes = self.outputs.values(estimate, predictions, values.others)
            offset, *others = self._further.decide(
                offset, condition, values, predictions if estimate else None, self._jumps.doubts
            )
            further = tuple(others)
        return Outcome(
            sample=sample,
            estimate=estimate_message(sample, values, estimate, self._engine, self._zero, prediction, axes),
            offset=offset,
            notes=tuple(notes),
            probes=decided,
            further=further,
        )

    def _judge_jumps(self, sample: Sample, values: Values, notes: list[Note]) -> Estimate | None:
        """Return the estimate of this sample if T_Q or AT is used again, or was refuted: the state is another one."""
        if not self._jumps.is_on:
            return None
        found = self._jumps.update(self._engine, sample.channels, values.others, values.y)
        notes += found.notes
        self._follow(found)
        if found.ends_exchange and self.plausibility.exchanged:
            self.plausibility.acknowledge()
        return found.estimate

    def _follow(self, found: Judgement) -> None:
        """Accept channels that are used again; the zero goes with the state that the engine was given."""
        for name, value in found.accepted.items():
            self._guards.accept(name, value)
        if found.zeros is not None:
            before, now = found.zeros
            self._zero.y_base += now.y_um - before.y_um
            self.outputs.move_zero(before, now)
            if self.probing is not None:
                self.probing.move_zero(before.contributions_um, now.contributions_um)

    def _remember_sample(self, raw: Sample, estimate: Estimate) -> None:
        """Keep what a probe of this time is compared with."""
        if self.probing is not None:
            self.probing.add(
                PastSample(
                    time_ns=raw.time_utc_ns,
                    y_um=estimate.y_um - self._zero.y_base,
                    rate_um_per_min=estimate.y_rate_um_per_min,
                    contributions_um=estimate.contributions_um,
                    noise_um=self._engine.y_noise_std_um,
                    offset_um=NAN,
                    offset_rate_um_per_min=NAN,
                    is_held=False,
                    behind_ns=raw.behind_of(self._config.sampling.polls_of(self.model.period_s)),
                )
            )

    def _decide_probes(self, raw: Sample, notes: list[Note]) -> tuple[Probe, ...]:
        """Decide the probes that arrived since the last sample, and add their events."""
        probes, self._probes = self._probes, ()
        if self.probing is None or not probes:
            return ()
        every: list[Probe] = []
        for received in probes:
            before_um = self._prediction().y_um
            probe, note, shown_um = self.probing.decide(raw.machine, raw.seq, received)
            notes.append(note)
            every.append(probe)
            if self._config.probe is None or self._memory.estimate is None:
                continue
            learned_um = self._prediction().y_um - before_um
            std_um = probe.std_um if probe.std_um is not None else self._config.probe.std_um
            self._jumps.receive_probe(shown_um, std_um, self._memory.estimate.y_um, learned_um)
        return tuple(every)

    def _evidence(self, raw: Sample, values: Values, prediction: Prediction) -> SensorEvidence:
        """Return the input of the checks between the sensors."""
        t_q, at = (
            number(channel.mean) if channel is not None and channel.device_quality == SampleQuality.GOOD else NAN
            for channel in (raw.channels.get(name) for name in ("t_q_degc", "at_degc"))
        )
        # One channel that has jumped is not an exchange of two, nor is one that reads what neither of them can.
        is_of_one = len(self._jumps.suspects) == 1 or not (self._can_be_exchanged(t_q) and self._can_be_exchanged(at))
        below_k = NAN if is_of_one else at - t_q
        reference = self._engine.reference
        rest = self._config.plausibility.rest if self._config.plausibility is not None else None
        # A prediction without both temperatures, or from an unknown state, is not evidence against a sensor.
        usable = not math.isnan(values.t_q + values.at) and self._memory.cold_min <= 0.0
        return SensorEvidence(
            below_k=below_k,
            apart_k=(values.t_q - reference.t_q_degc) - (values.at - reference.at_degc),
            rest=values.others.get(rest.channel, NAN) if rest is not None else NAN,
            residual_um=values.y - self._zero.y_ref - prediction.y_um if usable else NAN,
            std_um=prediction.std_um,
            predicted_um=prediction.y_um,
        )

    def _can_be_exchanged(self, degc: float) -> bool:
        """Return whether a reading is within the range of T_Q or of AT: that of the other one alone is an exchange."""
        if not self._jumps.is_on:  # version 0.1.0 did not ask: an audit of its recordings comes to the same states
            return True
        ranges = [channel.range for channel in self._config.channel if channel.name in TEMPERATURES]
        return any(one is None or one[0] <= degc <= one[1] for one in ranges)

    def _set_zero(self, time_ns: int, values: Values, notes: list[Note]) -> None:
        zero = self._zero
        if not zero.wanted or math.isnan(values.t_q) or math.isnan(values.at):
            return
        warm = self._engine.has_reference and self._is_warm(zero.mode)
        warm_um = self.warm_um if zero.mode == "rest" else None
        if warm:
            # The state is that of the last sample; the growth since then counts after the zero.
            zero.y_base = self._memory.estimate.y_um if self._memory.estimate else 0.0
        else:
            self._engine.set_reference(values.t_q, values.at)
            self._memory.estimate, self._memory.rates, self._memory.heats = None, [], []
            zero.y_base, self._memory.cold_min = 0.0, 0.0
        zero.y_ref, zero.level, zero.wanted = values.y, 0.0, False
        self.outputs.set_zero(self._memory.estimate if warm else None, values.others)
        self.plausibility.reset(at_rest=not warm)
        self._jumps.set_zero(self._memory.estimate if warm else None, values.y)
        if self.probing is not None:
            at_zero = self._memory.estimate
            self.probing.set_zero(time_ns, at_zero.contributions_um if at_zero is not None else None)
        # Version 0.1.0 recorded this text without data: an audit of its recordings compares it.
        text = (
            f"zero on a {'warm machine' if warm else 'machine at rest'}: T_Q {values.t_q:.3f} °C, AT {values.at:.3f} °C"
        )
        text += ", Y not measured" if math.isnan(values.y) else f", Y {values.y:.3f} µm"
        text += f"{DOUBT}{doubt_of_rest(warm_um)}" if warm_um is not None else ""
        data = ZeroData(
            mode="warm" if warm else "rest", t_q_degc=values.t_q, at_degc=values.at, y_um=values.y, warm_um=warm_um
        )
        notes.append(Note(EventKind.ZERO, text, data.table()))

    def _is_warm(self, mode: ZeroMode) -> bool:
        if mode != "auto" or not self._memory.rates:
            return mode == "warm"
        # A machine at a long thermal plateau grows slowly but is heated: this must not become a zero at rest.
        heated = abs(mean(self._memory.heats)) > HEATED_W
        largest = max(abs(mean(self._memory.rates)), self.outputs.largest_rate_um_per_min())
        return heated or largest > self._config.zero.rest_rate_um_per_min


def doubt_of_rest(warm_um: float) -> str:
    """Return what speaks against a zero at rest, and what to do, in words."""
    return (
        f"by the model the machine is not at rest, {warm_um:+.1f} µm of Y are from stored heat; if that is so, the "
        "offset is wrong by up to as much while it cools: set the zero at rest again when it has"
    )


def model_of(config: Config, data: bytes, *, source: str) -> ThermalModel:
    """Read a model file as a configuration uses it, with the alternative path that it selects.

    Raises
    ------
    ModelError
        If the model cannot be used; the message names the source and the error.
    """
    name = config.model.alternative
    if config.axis is None:
        model = parse_model(data, source=source)
        return model.with_alternative(name) if name else model
    models = parse_axes(data, source=source)
    if name and not any(name in one.alternatives for one in models.values()):
        raise ModelError(f"{source}: no alternative {name!r}")
    if name:
        models = {axis: one.with_alternative(name) if name in one.alternatives else one for axis, one in models.items()}
    first = config.axis.y.part_of(FIRST)
    if first not in models:
        raise ModelError(f"{source}: axis y: no part axis.{first} in the model, it has: {', '.join(models)}")
    try:
        return with_outputs(models, first, [one.output for one in planned_outputs(config.axis)])
    except ModelError as error:
        raise ModelError(f"{source}: {error}") from error
