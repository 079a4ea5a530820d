"""Jumps of T_Q and AT: a channel that has jumped is not used until its new value is confirmed.

From the jump on, two more engines run beside the one that predicts without the channel: the *believing* one takes the
channel as it is, the *shifted* one less the jump. What happens until it is decided, by phases: README.md of
this folder.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from compensator.arrays import NAN
from compensator.codes import Reason, SampleQuality
from compensator.config import Config
from compensator.events import Implausibility
from compensator.messages import ChannelSample, number
from compensator.model.engine import Engine, EngineState, Estimate
from compensator.model.thermal_model import ThermalModel
from compensator.service.plausibility.grown_y import GrownY
from compensator.service.plausibility.guards import TEMPERATURES
from compensator.service.plausibility.hindsight import Hindsight
from compensator.service.plausibility.jump_signs import JumpSigns, accepted_note
from compensator.service.plausibility.jump_state import JumpState
from compensator.service.plausibility.one_jump import Judgement, JumpSetup, OneJump

#: Part of the permitted change, or of the smallest jump if that is more, that the temperature itself makes; beyond it a
#: suspect channel has jumped again.
_NATURAL = 0.5
#: Weight of a new residual in the level before a jump, and of the difference of two in a row in the noise of Y; at
#: most so many deviations of it count, for a chip is no noise.
_LEVEL, _NOISE, _MOST_NOISE = 0.1, 0.02, 5.0
#: Samples for which Y corrects what a fault has left, and deviations beyond which a value of Y is wrong itself.
_LEARNING, _FAR = 120, 5.0


class JumpWatch:
    """Watches T_Q and AT of one machine for jumps; without `guards.suspect_jumps` it does nothing."""

    def __init__(self, config: Config, model: ThermalModel) -> None:
        self.is_on = config.guards.suspect_jumps
        least_k = config.guards.jump_min_k
        period_min = model.period_s / 60.0
        stated = config.plausibility.residual_std_um if config.plausibility is not None else None
        self._setup = JumpSetup(
            model=model,
            signs=JumpSigns(model, least_k) if least_k is not None else None,
            least_k=math.inf if least_k is None else least_k,
            change_k={
                channel.name: _NATURAL * max((channel.rate_max_per_min or math.inf) * period_min, least_k or 0.0)
                for channel in config.channel
                if channel.name in TEMPERATURES
            },
            y_std_um=stated or model.y_std_um,
        )
        self._jump = OneJump(self._setup)
        self._hindsight, self._learning = Hindsight(model, self._setup.y_std_um), 0
        self._level_um = self._zero_um = NAN
        self._noise_um2, self._last_um = 0.0, NAN
        self._learned_um = 0.0
        self._estimate: Estimate | None = None

    def describe(self) -> str:
        """Describe whether jumps are watched for."""
        if not self.is_on:
            return "jumps of T_Q and AT off (no guards.suspect_jumps)"
        if self._setup.signs is None:
            return "jumps of T_Q and AT beyond rate_max_per_min (no guards.jump_min_k)"
        return f"jumps of T_Q and AT beyond rate_max_per_min, and from {self._setup.least_k:g} K on"

    # ------------------------------------------------------------------ state

    @property
    def suspects(self) -> tuple[str, ...]:
        """Channels that are not used."""
        return self._jump.suspects

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """Channels that are used, and of which nothing confirms that they have kept their zero."""
        return self._jump.unconfirmed

    @property
    def doubt_um(self) -> float:
        """Standard deviation by channels that are, or were, used unconfirmed, µm: either engine may be right."""
        return next(iter(self._jump.doubts(self._estimate)), 0.0)

    @property
    def doubts(self) -> tuple[float, ...]:
        """As `doubt_um`, of each further output in its unit; empty where no channel is, or was, unconfirmed."""
        return tuple(self._jump.doubts(self._estimate)[1:])

    @property
    def state(self) -> JumpState:
        """State after the last sample."""
        return msgspec.structs.replace(
            self._jump.snapshot(),
            level_um=self._level_um,
            zero_um=self._zero_um,
            noise_um2=self._noise_um2,
            last_um=self._last_um,
            learned_um=self._learned_um,
            hindsight=self._hindsight.state,
            learning=self._learning,
        )

    def restore(self, state: JumpState | None) -> None:
        """Continue from a state; None if it is that of a version without this watch.

        Raises
        ------
        ValueError
            If it does not belong to the model, or is incomplete; nothing is changed then.
        """
        state = state or JumpState()
        jump = OneJump.restored(self._setup, state)
        self._hindsight.restore(state.hindsight)
        self._jump, self._learning = jump, state.learning
        self._level_um, self._zero_um = state.level_um, state.zero_um
        self._noise_um2, self._last_um = max(state.noise_um2, 0.0), state.last_um
        self._learned_um, self._estimate = state.learned_um, None

    def set_zero(self, used: Estimate | None, y_um: float) -> None:
        """Account for a zero.

        Parameters
        ----------
        used : Estimate or None
            That of the last sample, on a warm machine; None for a zero at rest, which ends all that is in question.
        y_um : float
            Measured Y at the zero, µm; NaN if it cannot be used.
        """
        if used is None:
            self._jump.end()
        self._jump.set_zero(used)
        self._level_um = self._zero_um = y_um if self._jump.is_open else NAN
        self._learned_um = 0.0
        self._end_hindsight()

    def raise_level(self, um: float) -> None:
        """Account for a prediction that is raised by a constant, µm: so is what measured Y is without deformation."""
        self._zero_um += um
        self._hindsight.end()

    def pass_time(self, samples: int, *, held: bool) -> None:
        """Account for samples that were not measured; after `held` ones the state is unknown and nothing expected."""
        self._jump.pass_time(samples, held=held)
        self._end_hindsight()

    def release(self, engine: Engine, used: Estimate | None, *, new_zero: bool) -> Judgement:
        """Use suspect channels again because an operator says so; `resume` confirms those that are unconfirmed.

        Parameters
        ----------
        engine : Engine
            Engine of the compensation; its state becomes that of one of the two engines.
        used : Estimate, optional
            Its last estimate.
        new_zero : bool
            Whether the sensors have another zero from now on; otherwise, and with absolute temperatures, their values
            are believed since the jump.

        Returns
        -------
        Judgement
            The channels, whose values are not known, and the estimate of the new state.
        """
        before = self._before()
        found = self._jump.release(engine, used, new_zero=new_zero)
        self._end_hindsight()
        self._forget(*before)
        return found

    def follow(self, engine: Engine, reasons: Sequence[str]) -> Judgement:
        """Use suspect channels again where the model in force has suspected them, too, and does no longer.

        Probes during a hold have shown it there, or a person has said so, or that model, measured Y or its hindsight
        speaks for them. What a fault before the jump has left in the state stays there. Channels that return, or are
        loose, are left to this watch: what they showed was wrong.

        Parameters
        ----------
        engine : Engine
            Engine of the compensation; its state becomes that of the engine that has believed the channels.
        reasons : sequence of str
            Those of the model in force at this sample.
        """
        state, names = self._jump.state, self.suspects
        suspected = [f"{Reason.SUSPECT_CHANNEL}:{name}" in reasons for name in names]
        was_in_force, state.in_force = state.in_force, bool(names) and all(suspected)
        if not (names and was_in_force) or any(suspected) or not self._jump.stays:
            return Judgement()
        before = self._before()
        is_confirmed = not any(f"{Reason.UNCONFIRMED_CHANNEL}:{name}" in reasons for name in names)
        found = self._jump.believe(engine, is_confirmed=is_confirmed)
        self._end_hindsight()
        self._forget(*before)
        return found

    # ------------------------------------------------------------------ one sample

    def update(
        self, engine: Engine, channels: Mapping[str, ChannelSample], others: Mapping[str, float], y_um: float
    ) -> Judgement:
        """Judge a sample before the engine's step.

        Parameters
        ----------
        engine : Engine
            Engine of the compensation, after the sample before.
        channels : mapping of str to ChannelSample
            Channels with their final quality.
        others : mapping of str to float
            Usable values of the auxiliary channels.
        y_um : float
            Measured Y, µm; NaN if it cannot be used.
        """
        measured = {name: _measured(channels.get(name)) for name in TEMPERATURES}
        fast = [name for name in TEMPERATURES if _quality(channels.get(name)) == SampleQuality.TOO_FAST]
        before = self._before()
        grown = GrownY(
            by_level=y_um - self._level_um,
            by_zero=y_um - self._zero_um,
            level_std_um=self._std_um(),
            zero_std_um=self._std_um(at_zero=True),
        )
        # In its first sample a jump may have been used: the state that both answers begin with is that of the next one.
        then = engine.snapshot() if self.suspects else None
        found = self._jump.judge(engine, measured, fast, others, grown)
        if then is None:
            self._hindsight.end()
        else:
            self._learning = 0
            found = self._in_hindsight(engine, then, found, measured, others, grown)
        self._forget(*before)
        return found

    def _in_hindsight(
        self,
        engine: Engine,
        then: EngineState,
        found: Judgement,
        measured: Mapping[str, float],
        others: Mapping[str, float],
        grown: GrownY,
    ) -> Judgement:
        """Use suspect channels again if measured Y shows that they were wrong before their jump and are right now."""
        suspects = self._jump.suspects
        # What was believed at a zero since the jump is not known here, and a loose contact may be right for a while. Of
        # exchanged channels it is known what they were before, and will be.
        no_question = self._jump.is_loose or self._jump.is_exchanged
        if not suspects or no_question or self._jump.zero_in_use is not None:
            self._hindsight.end()
            return found
        jumps_k = {name: size for name, size in self._jump.sizes_k().items() if name in suspects}
        mended = self._hindsight.judge(then, jumps_k, measured, others, grown)
        if mended is None:
            return found
        state, estimate = mended
        engine.restore(state)
        self._jump.end()
        self._hindsight.end()
        self._learning = _LEARNING
        how = "is used again: measured Y shows that it was wrong before its jump of"
        notes = [
            accepted_note(name, jumps_k[name], f"{how} {jumps_k[name]:+.2f} K", Implausibility.WAS_WRONG)
            for name in suspects
        ]
        return Judgement(
            estimate, [*found.notes, *notes], found.accepted | {name: measured[name] for name in suspects}, found.zeros
        )

    def _end_hindsight(self) -> None:
        self._hindsight.end()
        self._learning = 0

    def receive_probe(self, innovation_um: float, std_um: float, predicted_um: float, learned_um: float) -> None:
        """Compare both engines with a probe.

        Parameters
        ----------
        innovation_um : float
            Probe − prediction of the compensation with its correction by earlier probes, µm.
        std_um : float
            Standard deviation of the probe, µm.
        predicted_um : float
            Prediction of the compensation after the last sample, µm, without a correction.
        learned_um : float
            By how much this probe has changed the correction, µm. What probes correct since a jump may be the jump.
        """
        if not self._jump.is_open:
            return
        at_zero = self._jump.zero_in_use
        grown_um = innovation_um + self._learned_um + predicted_um - (at_zero.y_um if at_zero is not None else 0.0)
        self._jump.receive_probe(grown_um, math.hypot(std_um, self._setup.y_std_um))
        self._learned_um += learned_um

    def observe(self, engine: Engine, y_um: float, zero_um: float, estimate: Estimate) -> None:
        """Count quiet samples, and follow what measured Y is compared with after a later jump.

        Parameters
        ----------
        engine : Engine
            Engine of the compensation; what a fault has left in its state is corrected.
        y_um, zero_um : float
            Measured Y, and what it is without deformation by the zero, µm; NaN if it is not known.
        estimate : Estimate
            That of the compensation's engine.
        """
        self._estimate = estimate
        if not self.is_on or self._jump.is_open:
            self._last_um = NAN
            return
        self._jump.state.count_quiet()
        self._zero_um = zero_um
        self._learn(engine, y_um - zero_um - estimate.y_um)
        residual = y_um - estimate.y_um
        change, self._last_um = residual - self._last_um, residual
        if not math.isnan(change):
            most_um = _MOST_NOISE * self._std_um()
            self._noise_um2 += _NOISE * (min(0.5 * change * change, most_um * most_um) - self._noise_um2)
        if math.isnan(y_um):
            return
        known = not math.isnan(self._level_um)
        self._level_um = self._level_um + _LEVEL * (residual - self._level_um) if known else residual

    def _learn(self, engine: Engine, residual_um: float) -> None:
        """Correct by Y what a fault has left in the state: a few values do not tell its fast part from its slow one."""
        if self._learning == 0:
            return
        self._learning -= 1
        variance_um2 = self._std_um(at_zero=True) ** 2
        if residual_um * residual_um < _FAR * _FAR * (variance_um2 + engine.y_noise_std_um**2):  # not for NaN either
            engine.measure_y(residual_um, variance_um2)

    def _std_um(self, *, at_zero: bool = False) -> float:
        """Return the deviation of a value of Y − prediction, µm: own error of the model, and noise of Y."""
        own_um = self._setup.y_std_um
        return math.sqrt(own_um * own_um + (2.0 if at_zero else 1.0) * self._noise_um2)

    def _before(self) -> tuple[bool, bool]:
        """Return whether a jump is under way, and whether Y − prediction is another one once it is over."""
        return self._jump.is_open, bool(self.suspects) or self._jump.zero_in_use is not None

    def _forget(self, was_open: bool, has_changed: bool) -> None:
        """Forget what measured Y and probes have shown since a jump, once it is over."""
        if was_open and not self._jump.is_open:
            self._learned_um = 0.0
            if has_changed:
                self._level_um = NAN


def _quality(channel: ChannelSample | None) -> str:
    return channel.quality if channel is not None else ""


def _measured(channel: ChannelSample | None) -> float:
    """Return the value of a channel, whether it is used or only suspect; NaN if it cannot be one."""
    usable = (SampleQuality.GOOD, SampleQuality.SUSPECT, SampleQuality.TOO_FAST, SampleQuality.T_Q_BELOW_AT)
    return number(channel.mean) if channel is not None and channel.quality in usable else NAN
