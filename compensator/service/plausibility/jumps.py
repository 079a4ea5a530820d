"""Jumps of T_Q and AT: a channel that has jumped is not used until its new value is confirmed.

From the jump on, two more engines run beside the one that predicts without the channel:

- *believing* takes the channel as it is;
- *shifted* takes it less the jump: the sensor still follows its temperature, but with another zero.

The channel is accepted again if

- it returns to what the shifted engine expects (a contact is mended): the state becomes that of the shifted engine,
  which knows what happened meanwhile;
- the model agrees with it: over the last samples the believing engine has expected T_Q and AT better than the shifted
  one, by a log likelihood ratio (T_Q follows AT, and heat that rises stays). The state becomes that of the believing
  one;
- measured Y, or two probes, agree with the believing engine and contradict the shifted one;
- an operator says so: `resume` believes it, a zero keeps the state and gives the sensor its new zero.

A jump within `rate_max_per_min` is used at first; with `jump_min_k` both engines run for some samples, unless heat
within its range of validity explains a jump of T_Q. A channel that goes on to move like that is still in the same
jump, which takes some samples. Where the shifted one expects them far better, the channel becomes suspect and the state
that of the shifted engine: what the wrong values did is undone.

A jump may also hide in samples without the channel: its couple was open, or the service was stopped. With `jump_min_k`
a channel that then reads otherwise than expected is *unconfirmed*: heat or air that changed meanwhile looks the same.
It is used, both engines run, and their difference is part of the standard deviation until the same evidence speaks for
one of them.

AT that moves within the permitted rate while T_Q does not follow is *unconfirmed*, too, not suspect: T_Q follows the
air as slowly as the machine does, and a door looks like that. Once AT has returned, what the shifted engine expected is
believed if T_Q has spoken for it, and the other answer is the doubt, until both agree.

A channel that returns by most of its jump, but not by all of it, has jumped by what is left (from `jump_min_k` on): its
couple was pushed in halfway.

A loose contact jumps again and again: it has no level that the shifted engine could follow, which goes without it. Of
T_Q its expectation is soon too wide for a return to show. Once the channel has come to rest, for as long as it would
have to be back, and where the shifted engine thinks possible, it is like a couple that was open: used again, and
unconfirmed. The believing engine starts with its last jump.

An unconfirmed channel that jumps again says that it is wrong now, not that it was wrong before. Unless something has
contradicted it, or it was at rest for a shorter time than it was loose before, the compensation's engine keeps what it
has shown and goes on without it. The shifted engine still believes none of it; their difference stays part of the
standard deviation. The channel is believed anew from the one of both that expects its new level rather: where it comes
to rest elsewhere, one of both levels was wrong.

While one channel is suspect, the other one is watched in the same way by a further watch *beside* this one, in which
the shifted engine is that of the compensation. Once the suspect channel has returned, that watch goes on alone.

Everything here is computed from the samples alone, with scalar floats; the state is part of the compensation's.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping

import msgspec

from compensator.arrays import NAN
from compensator.codes import SampleQuality
from compensator.config import Config
from compensator.events import Note
from compensator.messages import ChannelSample, number
from compensator.model.engine import Engine, Estimate
from compensator.model.thermal_model import ThermalModel
from compensator.service.plausibility.guards import TEMPERATURES
from compensator.service.plausibility.jump_engines import (
    UNSEEN_SAMPLES,
    Fed,
    JumpEngines,
    count_held,
    grown,
    is_unsteady,
    moves,
    shifts_against,
)
from compensator.service.plausibility.jump_evidence import (
    is_contradicted,
    weigh_probe,
    weigh_y,
)
from compensator.service.plausibility.jump_signs import AIR, BESIDE, UNSEEN, JumpSigns, jump_note, unconfirmed_note
from compensator.service.plausibility.jump_state import FORGOTTEN_SAMPLES, JumpState, Phase
from compensator.service.plausibility.jump_verdict import Judgement, suspected, watched

#: Part of the permitted change that the temperature itself makes; beyond it a suspect channel has jumped again.
_NATURAL = 0.5
#: Weight of a new residual in the level before a jump.
_LEVEL = 0.1


class JumpWatch:
    """Watches T_Q and AT of one machine for jumps; without `guards.suspect_jumps` it does nothing."""

    def __init__(self, config: Config, model: ThermalModel) -> None:
        self.is_on = config.guards.suspect_jumps
        least_k = config.guards.jump_min_k
        self._signs = JumpSigns(model, least_k) if least_k is not None else None
        self._least_k = math.inf if least_k is None else least_k
        self._model = model
        period_min = model.period_s / 60.0
        self._change_k = {
            channel.name: _NATURAL * (channel.rate_max_per_min or math.inf) * period_min
            for channel in config.channel
            if channel.name in TEMPERATURES
        }
        stated = config.plausibility.residual_std_um if config.plausibility is not None else None
        self._y_std_um = stated or model.y_std_um
        self._state = JumpState()
        self._engines: JumpEngines | None = None
        self._names: tuple[str, ...] = TEMPERATURES
        self._beside: JumpWatch | None = None
        self._estimate: Estimate | None = None

    def describe(self) -> str:
        """Describe whether jumps are watched for."""
        if not self.is_on:
            return "jumps of T_Q and AT off (no guards.suspect_jumps)"
        if self._signs is None:
            return "jumps of T_Q and AT beyond rate_max_per_min (no guards.jump_min_k)"
        return f"jumps of T_Q and AT beyond rate_max_per_min, and from {self._signs.least_k:g} K on"

    # ------------------------------------------------------------------ state

    @property
    def doubts(self) -> tuple[float, ...]:
        """As `doubt_um`, of each further output in its unit; empty where no channel is, or was, unconfirmed."""
        return tuple(self._apart()[1:])

    @property
    def suspects(self) -> tuple[str, ...]:
        """Channels that are not used."""
        beside = self._beside.suspects if self._beside is not None else ()
        return (*self._state.shifts_k, *beside) if self._state.is_suspect else ()

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """Channels that are used, and may have another zero since samples without them."""
        beside = self._beside.unconfirmed if self._beside is not None else ()
        return tuple(self._state.shifts_k) if self._state.is_unconfirmed else beside

    @property
    def doubt_um(self) -> float:
        """Standard deviation by channels that are, or were, used unconfirmed, µm: either engine may be right."""
        return next(iter(self._apart()), 0.0)

    @property
    def state(self) -> JumpState:
        """State after the last sample."""
        if self._engines is None:
            return msgspec.structs.replace(self._state)
        return msgspec.structs.replace(
            self._state,
            believing=self._engines.believing.branch(),
            shifted=self._engines.shifted.branch(),
            used_zero=self._engines.used_zero,
            beside=self._beside.state if self._beside is not None else None,
        )

    def restore(self, state: JumpState | None) -> None:
        """Continue from a state; None if it is that of a version without this watch.

        Raises
        ------
        ValueError
            If it does not belong to the model.
        """
        state = state or JumpState()
        self._engines = JumpEngines.restored(self._model, state)
        self._beside = None
        if state.beside is not None:
            self._beside = self._watch_beside(state)
            self._beside.restore(state.beside)
        self._state = msgspec.structs.replace(
            state,
            believing=None,
            shifted=None,
            used_zero=None,
            beside=None,
            shifts_k=dict(state.shifts_k),
            shift_std_k=dict(state.shift_std_k),
            first_k=dict(state.first_k),
            back=dict(state.back),
            left_k=dict(state.left_k),
            last=dict(state.last),
            unseen=dict(state.unseen),
        )

    def reset(self, *, at_rest: bool) -> None:
        """Account for a zero: the level of Y is another one; at rest all is forgotten but what is not used."""
        self._state.level_um = NAN
        if at_rest and not self._state.is_suspect:
            self._end()
        if self._engines is not None:
            self._engines.set_zero()

    def pass_time(self, samples: int, *, held: bool) -> None:
        """Account for samples that were not measured; after `held` ones the state is unknown and nothing expected."""
        self._state.unseen = {} if held else {name: self._state.unseen.get(name, 0) + samples for name in TEMPERATURES}
        self._state.start_counts()
        if self._engines is not None:
            self._engines.pass_time(samples, held=held)
        if self._beside is not None:
            self._beside.pass_time(samples, held=held)

    def release(self, engine: Engine, *, new_zero: bool) -> Judgement:
        """Use suspect channels again because an operator says so; `resume` confirms those that are unconfirmed.

        Parameters
        ----------
        engine : Engine
            Engine of the compensation; its state becomes that of one of the two engines.
        new_zero : bool
            Whether the sensors have another zero from now on; otherwise their values are believed since the jump.

        Returns
        -------
        Judgement
            The channels, whose values are not known, and the estimate of the new state.
        """
        engines, used_zero = self._engines, self._used_zero
        if engines is None:
            return Judgement()
        estimate: Estimate | None = None
        if self._state.is_unconfirmed and not new_zero:
            if self._state.phase == Phase.AIR_RETURNED:  # it was the air: the engine that has believed it was right
                estimate = engines.give(engine, engines.shifted)
            return self._released(used_zero, estimate)
        if not self._state.is_suspect:
            return Judgement()
        names = self.suspects
        new_zero = new_zero and self._model.inputs == "changes"
        # Where both are suspect, the watch beside this one takes both less their jumps.
        beside = self._beside if self._beside is not None and self._beside.suspects else None
        shifted = beside._engines.shifted if beside is not None and beside._engines is not None else engines.shifted
        if new_zero and self._state.phase == Phase.SUSPECT_AFTER_USE:
            # What the engine has gone on from stays; its estimate does, too.
            shifts = shifts_against(engine, self._state)
        else:
            shifts = dict(self._state.shifts_k)
            estimate = engines.give(engine, shifted if new_zero else engines.believing)
        if beside is not None:
            shifts |= beside._state.shifts_k
        if new_zero:
            engine.shift_reference(shifts.get("t_q_degc", 0.0), shifts.get("at_degc", 0.0))
        return self._released(used_zero, estimate, names)

    def _released(
        self, used_zero: Estimate | None, estimate: Estimate | None, names: tuple[str, ...] = ()
    ) -> Judgement:
        zeros = self._zeros(used_zero)
        self._end()
        return Judgement(estimate, accepted=dict.fromkeys(names, NAN), zeros=zeros)

    @property
    def _used_zero(self) -> Estimate | None:
        return self._engines.used_zero if self._engines is not None else None

    def _zeros(self, before: Estimate | None) -> tuple[Estimate, Estimate] | None:
        """Return what the compensation's engine had estimated at the last zero, before and now; None if unchanged."""
        now = self._used_zero
        return (before, now) if before is not None and now is not None and now is not before else None

    def _end(self) -> None:
        self._engines = self._beside = None
        self._state = self._state.ended()

    def _go_on_with(self, beside: JumpWatch) -> None:
        """End the jump, and go on with that of the other channel."""
        at_zero = self._used_zero
        self._state, self._engines, self._beside = beside._state, beside._engines, None
        if self._engines is not None:
            self._engines.believing.at_zero = self._engines.shifted.at_zero = self._engines.used_zero = at_zero
        self._state.quiet = 0

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
        offered = {name: _offered(channels.get(name)) for name in TEMPERATURES}
        jumped = [name for name in TEMPERATURES if _quality(channels.get(name)) == SampleQuality.TOO_FAST]
        return self._judge(engine, offered, jumped, others, y_um)

    def _judge(
        self,
        engine: Engine,
        offered: Mapping[str, float],
        jumped: list[str],
        others: Mapping[str, float],
        y_um: float,
    ) -> Judgement:
        """Judge a sample of values, °C, of which some have `jumped` by their rate."""
        notes: list[Note] = []
        used_zero = self._used_zero
        was_unconfirmed, was_new = self._state.is_unconfirmed, self._engines is None
        seen_again = self._seen_again(offered)
        if self._engines is not None and is_unsteady(self._state) and set(jumped) <= set(self._state.shifts_k):
            if jumped or moves(self._state, offered, self._change_k):
                notes += self._unsettle(engine, self._engines, offered)
        elif self._engines is not None and jumped and not self._state.is_suspect:
            self._use_no_longer(engine, self._engines, offered)
        elif jumped and not self._state.is_suspect:
            self._begin(engine, self._state.begun(Phase.SUSPECT))
        elif not self._state.shifts_k and self._signs is not None:
            hidden = self._unexpected(engine, offered, seen_again)
            jumped = [*hidden, *(name for name in self._watchable(engine, offered) if name not in hidden)]
            if jumped:
                self._begin(engine, self._state.begun(Phase.UNCONFIRMED if hidden else Phase.WATCHED))
        elif self._engines is not None and self._signs is not None and self._state.is_watched:
            jumped = self._going_on(self._engines, offered)
            if self._state.is_air and "t_q_degc" in self._watchable(engine, offered):
                # One of both is wrong: what T_Q has shown of AT counts no more, nor AT of T_Q.
                self._state.phase = Phase.UNCONFIRMED
                self._state.start_evidence()
                jumped = ["t_q_degc", *jumped]
        if self._state.shifts_k:
            known = {*jumped, *self._state.shifts_k}
            jumped = [*jumped, *(n for n in self._unexpected(engine, offered, seen_again) if n not in known)]
        engines = self._engines
        if engines is None:
            return Judgement()
        self._state.last |= {name: offered[name] for name in TEMPERATURES if not math.isnan(offered[name])}
        fed = engines.feed(self._state, offered, jumped, self._change_k, self._least_k)
        count_held(self._state, engine, offered["at_degc"], self._least_k)
        if fed.jumped and self._state.is_suspect:
            self._believe_anew(engine, engines, offered)
            self._state.start_evidence()
            notes += [jump_note(name, self._state.shifts_k[name]) for name in jumped if name in fed.jumped]
        elif fed.jumped and self._state.is_unconfirmed:
            for name in fed.jumped:
                when = AIR if self._state.is_air else UNSEEN if name in seen_again or was_new else BESIDE
                notes.append(unconfirmed_note(name, self._state.shifts_k[name], when))
        beside = self._watch_other(engines, fed, others, y_um)
        notes += beside.notes
        engines.weigh(self._state, offered, fed)
        engines.step(offered, fed, others, beside.estimate)
        self._state.samples += 1
        self._state.age += 1
        weigh_y(self._state, engines, y_um, self._y_std_um)
        is_suspect = self._state.is_suspect
        estimate = engines.go_without(engine, self._state, offered, others) if was_unconfirmed and is_suspect else None
        verdict = (suspected if is_suspect else watched)(engine, engines, self._state, offered)
        zeros = self._zeros(used_zero)
        if verdict.has_returned and self._beside is not None and self._beside._state.shifts_k:
            self._go_on_with(self._beside)
        elif verdict.ends:
            self._end()
        return Judgement(
            verdict.estimate or estimate, [*notes, *verdict.notes], beside.accepted | verdict.accepted, zeros=zeros
        )

    def receive_probe(self, innovation_um: float, std_um: float, predicted_um: float) -> None:
        """Compare both engines with a probe.

        Parameters
        ----------
        innovation_um : float
            Probe − prediction of the compensation, µm.
        std_um : float
            Standard deviation of the probe, µm.
        predicted_um : float
            Prediction of the compensation after the last sample, µm, without a correction.
        """
        if self._engines is not None:
            std_um = math.hypot(std_um, self._y_std_um)
            weigh_probe(self._state, self._engines, innovation_um + predicted_um, std_um)
        if self._beside is not None:
            self._beside.receive_probe(innovation_um, std_um, predicted_um)

    def observe(self, y_um: float, estimate: Estimate) -> None:
        """Count quiet samples, and follow the level of measured Y − prediction, which a later jump is compared with."""
        state, self._estimate = self._state, estimate
        if not self.is_on or state.shifts_k:
            return
        state.quiet = min(state.quiet + 1, FORGOTTEN_SAMPLES)
        if math.isnan(y_um):
            return
        residual = y_um - estimate.y_um
        state.level_um = (
            residual if math.isnan(state.level_um) else state.level_um + _LEVEL * (residual - state.level_um)
        )

    # ------------------------------------------------------------------ inside

    def _begin(self, engine: Engine, state: JumpState) -> None:
        self._engines = JumpEngines.begin(self._model, engine.snapshot())
        self._state = state

    def _apart(self) -> list[float]:
        """Return the standard deviation of Y and of each further output by both answers; empty where there is one."""
        state, engines = self._state, self._engines
        if engines is None or not (state.is_unconfirmed or state.phase == Phase.SUSPECT_AFTER_USE):
            return self._beside._apart() if self._beside is not None else []
        used, other = engines.believing.estimate if state.is_unconfirmed else self._estimate, engines.shifted.estimate
        if used is None or other is None:
            return []
        answers = grown(used, engines.used_zero), grown(other, engines.shifted.at_zero)
        return [abs(one - another) / math.sqrt(2.0) for one, another in zip(*answers, strict=True)]

    def _use_no_longer(self, engine: Engine, engines: JumpEngines, offered: Mapping[str, float]) -> None:
        """Suspect channels that jump again: what unconfirmed ones have shown is kept if nothing contradicts it."""
        state = self._state
        was_used = state.is_unconfirmed and state.age - state.loose > state.loose and not is_contradicted(state)
        if was_used:
            state.age = 0
        else:
            engines.give(engine, engines.shifted)
        self._state.suspect(Phase.SUSPECT_AFTER_USE if was_used else Phase.SUSPECT)
        self._believe_anew(engine, engines, offered)

    def _believe_anew(self, engine: Engine, engines: JumpEngines, offered: Mapping[str, float]) -> None:
        """Let the believing engine begin with this jump: what was wrong before it is undone."""
        self._state.loose = self._state.age
        is_kept = self._state.phase == Phase.SUSPECT_AFTER_USE and engines.fits(engine, self._state, offered)
        engines.believe_from(engine if is_kept else None)

    def _unsettle(self, engine: Engine, engines: JumpEngines, offered: Mapping[str, float]) -> list[Note]:
        """Account for a further jump of a loose contact."""
        state = self._state
        if state.is_suspect and state.samples <= 1 and engines.goes_away(state, offered):
            # What goes on from sample to sample is one jump, or heat.
            state.samples = 0
            return []
        state.at_held = 0
        state.again += 1
        if state.is_suspect:
            self._believe_anew(engine, engines, offered)
            state.start_evidence()
            return []
        self._use_no_longer(engine, engines, offered)
        return [jump_note(name, shift_k) for name, shift_k in state.shifts_k.items() if not math.isnan(offered[name])]

    def _watch_beside(self, state: JumpState) -> JumpWatch:
        """Return a watch for the channels that have not jumped."""
        watch = copy.copy(self)
        watch._names = tuple(name for name in self._names if name not in state.shifts_k)
        watch._state, watch._engines, watch._beside = JumpState(level_um=state.level_um), None, None
        return watch

    def _watch_other(self, engines: JumpEngines, fed: Fed, others: Mapping[str, float], y_um: float) -> Judgement:
        """Watch the other channel while one is suspect; the shifted engine is that of the compensation then."""
        if not self._state.is_suspect or len(self._state.shifts_k) != 1 or self._signs is None:
            self._beside = None
            return Judgement()
        if self._beside is None:
            self._beside = self._watch_beside(self._state)
        found = self._beside._judge(engines.shifted.engine, fed.values, [], others, y_um)
        fed.values.update(dict.fromkeys(self._beside.suspects, NAN))
        return found

    def _unexpected(self, engine: Engine, offered: Mapping[str, float], seen_again: list[str]) -> list[str]:
        if self._signs is None:
            return []
        return [name for name in self._signs.unexpected(engine, offered, seen_again) if name in self._names]

    def _watchable(self, engine: Engine, offered: Mapping[str, float]) -> list[str]:
        if self._signs is None:
            return []
        return [name for name in self._signs.watchable(engine, offered) if name in self._names]

    def _going_on(self, engines: JumpEngines, offered: Mapping[str, float]) -> list[str]:
        """Return the watched channels that go on to move as nothing explains: a jump may take some samples."""
        shifts = self._state.shifts_k
        less = {name: value - shifts.get(name, 0.0) for name, value in offered.items()}
        return [name for name in self._watchable(engines.shifted.engine, less) if name in shifts]

    def _seen_again(self, offered: Mapping[str, float]) -> list[str]:
        """Return the channels that are seen again after samples without them, and count such samples."""
        unseen = self._state.unseen
        self._state.unseen = {name: unseen.get(name, 0) + 1 for name in TEMPERATURES if math.isnan(offered[name])}
        return [
            name for name, samples in unseen.items() if samples >= UNSEEN_SAMPLES and name not in self._state.unseen
        ]


def _quality(channel: ChannelSample | None) -> str:
    return channel.quality if channel is not None else ""


def _offered(channel: ChannelSample | None) -> float:
    """Return the value of a channel, whether it is used or only suspect; NaN if it cannot be one."""
    usable = (SampleQuality.GOOD, SampleQuality.SUSPECT, SampleQuality.TOO_FAST, SampleQuality.T_Q_BELOW_AT)
    return number(channel.mean) if channel is not None and channel.quality in usable else NAN
