"""The watch for one jump: of the channels that jump together, and of the other one beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec

from compensator.arrays import NAN
from compensator.events import Note
from compensator.model.engine import Engine, Estimate
from compensator.model.thermal_model import ThermalModel
from compensator.service.plausibility.grown_y import GrownY
from compensator.service.plausibility.guards import TEMPERATURES
from compensator.service.plausibility.jump_engines import (
    UNSEEN_SAMPLES,
    Fed,
    JumpEngines,
    count_as_used,
    count_held,
    grown,
    is_unsteady,
    moves,
    shifts_against,
    stds,
)
from compensator.service.plausibility.jump_evidence import is_contradicted, weigh_probe, weigh_y
from compensator.service.plausibility.jump_signs import (
    AIR,
    BESIDE,
    EXCHANGED,
    UNSEEN,
    JumpSigns,
    jump_note,
    unconfirmed_note,
)
from compensator.service.plausibility.jump_state import JumpState, Phase
from compensator.service.plausibility.jump_verdict import JumpFinding, JumpJudge


class Judgement(msgspec.Struct, frozen=True):
    """What a sample, or an operator, changes in the compensation.

    Parameters
    ----------
    estimate : Estimate, optional
        The estimate after this sample, if the engine was given another state or is stepped; None if it is as before.
    notes : list of Note
        Events.
    accepted : dict of str to float
        Channels that are used again, with their values, °C.
    zeros : tuple of Estimate, optional
        What the engine had estimated at the last zero, before and since it was given another state; None if that is
        the same.
    gives : bool
        Whether the engine was given another state.
    ends_exchange : bool
        Whether exchanged channels read their own temperature again.
    """

    estimate: Estimate | None = None
    notes: list[Note] = []
    accepted: dict[str, float] = {}
    zeros: tuple[Estimate, Estimate] | None = None
    gives: bool = False
    ends_exchange: bool = False


@dataclass(frozen=True, slots=True)
class JumpSetup:
    """What every watch of a machine shares.

    Parameters
    ----------
    model : ThermalModel
        The model.
    signs : JumpSigns, optional
        Finds jumps within the permitted rate and unseen ones; None without `guards.jump_min_k`.
    least_k : float
        Smallest jump that is looked for, K; infinite without.
    change_k : dict of str to float
        By channel: part of the permitted change of a sample that the temperature itself makes, K.
    y_std_um : float
        Standard deviation of Y − prediction without the noise of a value of Y, µm.
    """

    model: ThermalModel
    signs: JumpSigns | None
    least_k: float
    change_k: dict[str, float]
    y_std_um: float


class OneJump:
    """Watches channels for a jump, and decides what it was.

    Parameters
    ----------
    setup : JumpSetup
        What every watch of the machine shares.
    names : tuple of str
        The channels that may jump here.
    """

    def __init__(self, setup: JumpSetup, names: tuple[str, ...] = TEMPERATURES) -> None:
        self._setup, self._names = setup, names
        self.state = JumpState()
        self._engines: JumpEngines | None = None
        self._beside: OneJump | None = None
        #: What the engine that is judged had estimated at a zero on a warm machine before this jump.
        self._at_zero: Estimate | None = None

    # ------------------------------------------------------------------ state

    @property
    def is_open(self) -> bool:
        """Whether a channel has jumped, or may have."""
        return bool(self.state.jumps)

    @property
    def suspects(self) -> tuple[str, ...]:
        """Channels that are not used."""
        own = tuple(self.state.jumps) if self.state.is_suspect else ()
        return own + (self._beside.suspects if self._beside is not None else ())

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """Channels that are used, and of which nothing confirms that they have kept their zero."""
        own = tuple(self.state.jumps) if self.state.is_unconfirmed else ()
        return own + (self._beside.unconfirmed if self._beside is not None else ())

    @property
    def is_loose(self) -> bool:
        """Whether a channel in question has jumped again and again."""
        return is_unsteady(self.state) or (self._beside is not None and self._beside.is_loose)

    @property
    def is_exchanged(self) -> bool:
        """Whether T_Q and AT may read each other's temperature."""
        return self.state.may_be_exchanged

    def sizes_k(self) -> dict[str, float]:
        """Return the jumps of all channels in question, K."""
        beside = self._beside.sizes_k() if self._beside is not None else {}
        return {name: jump.size_k for name, jump in self.state.jumps.items()} | beside

    def doubts(self, used: Estimate | None) -> list[float]:
        """Return the standard deviation of Y and of each further output by both answers; empty where there is one.

        Parameters
        ----------
        used : Estimate, optional
            That of the engine whose samples are judged here.
        """
        state, engines = self.state, self._engines
        if engines is None:
            return []
        beside = self._beside.doubts(engines.shifted.estimate) if self._beside is not None else []
        other = engines.shifted.estimate
        if used is None or other is None or not (state.is_unconfirmed or state.phase == Phase.SUSPECT_AFTER_USE):
            return beside
        answers = zip(grown(used, engines.zero_in_use), grown(other, engines.shifted.at_zero), strict=True)
        # Both are as likely. What the other one knows less of Y counts: it may have come to the same by chance.
        own = [
            math.sqrt(0.5 * ((one - another) ** 2 + max(std_of_other**2 - std**2, 0.0)))
            for (one, another), std, std_of_other in zip(answers, stds(used), stds(other), strict=True)
        ]
        return [math.hypot(one, another) for one, another in zip(own, beside, strict=True)] if beside else own

    def snapshot(self) -> JumpState:
        """Return the state with that of its engines, and of the watch beside."""
        if self._engines is None:
            return msgspec.structs.replace(self.state)
        return msgspec.structs.replace(
            self.state,
            believing=self._engines.believing.branch(),
            shifted=self._engines.shifted.branch(),
            zero_in_use=self._engines.zero_in_use,
            beside=self._beside.snapshot() if self._beside is not None else None,
        )

    @classmethod
    def restored(cls, setup: JumpSetup, state: JumpState, names: tuple[str, ...] = TEMPERATURES) -> OneJump:
        """Return the watch of a state.

        Raises
        ------
        ValueError
            If it does not belong to the model, or is incomplete.
        """
        found = cls(setup, names)
        found._engines = JumpEngines.restored(setup.model, state)
        if state.beside is not None:
            found._beside = cls.restored(setup, state.beside, _others(state))
            found._beside._at_zero = found._engines.shifted.at_zero if found._engines is not None else None
        found.state = state.without_engines()
        return found

    def set_zero(self, used: Estimate | None) -> None:
        """Count from a zero on a warm machine on what each engine predicts; `used` is that of the compensation."""
        if self._engines is not None:
            self._engines.set_zero(used)

    def pass_time(self, samples: int, *, held: bool) -> None:
        """Account for samples that were not measured; after `held` ones the state is unknown and nothing expected."""
        unseen = self.state.unseen
        self.state.unseen = {} if held else {name: unseen.get(name, 0) + samples for name in self._names}
        self.state.start_counts()
        if not self.is_open:
            self.state.count_quiet(samples)
        if self._engines is not None:
            self._engines.pass_time(samples, held=held)
        if self._beside is not None:
            self._beside.pass_time(samples, held=held)

    def end(self) -> None:
        """Use all channels as they are."""
        self._leave_beside()
        self._engines = None
        self.state = self.state.ended()

    def _leave_beside(self) -> None:
        """End the watch beside, which knows how loose its channel is."""
        if self._beside is not None:
            self.state.remember(self._beside.state)
        self._beside = None

    # ------------------------------------------------------------------ what others say

    @property
    def zero_in_use(self) -> Estimate | None:
        """What the compensation's engine had estimated at a zero on a warm machine since this jump; None without."""
        return self._engines.zero_in_use if self._engines is not None else None

    def receive_probe(self, grown_um: float, std_um: float) -> None:
        """Compare both engines with the deformation since the zero by a probe, and its standard deviation, µm."""
        if self._engines is not None:
            weigh_probe(self.state, self._engines, grown_um, std_um)
        if self._beside is not None:
            self._beside.receive_probe(grown_um, std_um)

    def release(self, engine: Engine, used: Estimate | None, *, new_zero: bool) -> Judgement:
        """Use suspect channels again because an operator says so, see `JumpWatch.release`."""
        engines, state, before = self._engines, self.state, self.zero_in_use
        if engines is None:
            return Judgement()
        new_zero = new_zero and self._setup.model.inputs == "changes"
        estimate: Estimate | None = None
        accepted: dict[str, float] = {}
        if state.is_suspect and new_zero:
            accepted, estimate = self._take_as_zero(engine, engines, used)
        elif state.is_suspect:
            accepted = dict.fromkeys(self.suspects, NAN)
            estimate = engines.give(engine, engines.believing)
            self.end()
        elif not new_zero and state.is_unconfirmed:
            if state.phase == Phase.AIR_RETURNED:  # it was the air: the engine that has believed it was right
                estimate = engines.give(engine, engines.shifted)
            self.end()
        return Judgement(estimate, accepted=accepted, zeros=_moved(before, engines.zero_in_use))

    @property
    def stays(self) -> bool:
        """Whether channels have jumped once, and stay there: none is where it was before, or exchanged, or loose."""
        state = self.state
        is_back = state.at_held > 0 or any(jump.back for jump in state.jumps.values())
        return state.phase == Phase.SUSPECT and not (is_back or state.may_be_exchanged or is_unsteady(state))

    def believe(self, engine: Engine, *, is_confirmed: bool) -> Judgement:
        """Use suspect channels again as they are; others have shown that they are right, or may be."""
        engines, before = self._engines, self.zero_in_use
        if is_confirmed or engines is None:
            return self.release(engine, None, new_zero=False)
        accepted = dict.fromkeys(self.suspects, NAN)
        estimate = engines.give(engine, engines.believing)
        self._leave_beside()
        self.state.phase = Phase.UNCONFIRMED
        self.state.start_evidence()
        return Judgement(estimate, accepted=accepted, zeros=_moved(before, engines.zero_in_use))

    def _take_as_zero(
        self, engine: Engine, engines: JumpEngines, used: Estimate | None
    ) -> tuple[dict[str, float], Estimate | None]:
        """Give suspect channels another zero; the other one stays in question if it is."""
        state, beside = self.state, self._beside
        names, keeps = self.suspects, state.phase == Phase.SUSPECT_AFTER_USE or state.at_held > 0
        if state.at_held > 0:  # what it has shown was the air, and the engine without it goes on
            shifts = dict.fromkeys(state.jumps, 0.0)
        elif keeps:  # what the engine has gone on from after its use stays; its estimate does, too
            shifts = shifts_against(engine, state)
        else:
            shifts = state.kept_k()
        shifted = engines.shifted
        if beside is not None and beside.suspects and beside._engines is not None:
            # The watch beside takes both less their jumps.
            shifts, shifted, beside = shifts | beside.state.kept_k(), beside._engines.shifted, None
        estimate = None if keeps else engines.give(engine, shifted)
        moved = shifts.get("t_q_degc", 0.0), shifts.get("at_degc", 0.0)
        engine.shift_reference(*moved)
        if beside is not None and beside.is_open:
            if keeps or beside._engines is None:
                beside._begin_again(engine, used)
            else:
                beside._engines.shift_reference(*moved)
            self._go_on_with(beside)
        else:
            self.end()
        return dict.fromkeys(names, NAN), estimate

    # ------------------------------------------------------------------ one sample

    def judge(
        self,
        engine: Engine,
        measured: Mapping[str, float],
        fast: list[str],
        others: Mapping[str, float],
        grown_y: GrownY,
    ) -> Judgement:
        """Judge a sample before the step of the engine that it is for.

        Parameters
        ----------
        engine : Engine
            That of the compensation; of a watch beside: the shifted engine of the jump that it stands beside.
        measured : mapping of str to float
            T_Q and AT, °C; NaN where they cannot be used.
        fast : list of str
            Channels that have moved beyond their permitted rate.
        others : mapping of str to float
            Usable values of the auxiliary channels.
        grown_y : GrownY
            Deformation since the zero by measured Y.
        """
        before, was_unconfirmed, was_new = self.zero_in_use, self.state.is_unconfirmed, self._engines is None
        was_exchanged = self.state.may_be_exchanged
        if self._engines is not None:
            self._engines.has_given = False
        own = [name for name in fast if name in self._names and not self._is_for_beside(name)]
        # A channel that the watch beside takes as wrong, or will, is missing here.
        offered = {
            name: NAN if name in self._beside_suspects or (name in fast and name not in own) else value
            for name, value in measured.items()
        }
        unseen = self.state.unseen
        seen_again = self._seen_again(measured)
        jumped, notes = self._jumped(engine, offered, own, seen_again)
        engines = self._engines
        if engines is None:
            return Judgement()
        self.state.last |= {name: measured[name] for name in TEMPERATURES if not math.isnan(measured[name])}
        fed = engines.feed(self.state, offered, jumped, self._setup.change_k, self._setup.least_k)
        count_held(self.state, engine, offered["at_degc"], self._setup.least_k)
        count_as_used(self.state, engine, offered)
        new = [name for name in fed.jumped if was_new or name in seen_again]
        notes += self._entered(engine, engines, offered, fed, [name for name in jumped if name in fed.jumped], new)
        if fed.is_exchange:
            notes += [jump_note(name, jump.size_k, EXCHANGED) for name, jump in self.state.jumps.items()]
        engines.weigh(self.state, offered, fed)
        beside = self._judge_beside(engines, measured, fast, fed, others, grown_y, unseen)
        offered |= dict.fromkeys(self._beside_suspects, NAN)
        engines.step(offered, fed.values | dict.fromkeys(self._beside_suspects, NAN), others, beside.estimate)
        self.state.samples += 1
        self.state.age += 1
        weigh_y(self.state, engines, grown_y)
        estimate: Estimate | None = None
        if beside.gives:
            # What the other channel has shown is undone in the engine that goes on without this one, too.
            estimate = engines.give(engine, engines.shifted)
            self.state.phase = Phase.SUSPECT
        elif (was_unconfirmed or (was_new and self.state.may_be_exchanged)) and self.state.is_suspect:
            estimate = engines.go_without(engine, self.suspects, offered, others)
        verdict = self._verdict(engine, engines, offered, others, grown_y)
        estimate = verdict.estimate or estimate
        if verdict.ends:
            estimate = self._finish(engine, verdict, estimate, offered, others)
        elif not self.state.is_suspect:
            self._leave_beside()
        return Judgement(
            estimate,
            [*notes, *beside.notes, *verdict.notes],
            beside.accepted | verdict.accepted,
            _moved(before, engines.zero_in_use),
            engines.has_given,
            was_exchanged and verdict.has_returned,
        )

    def _jumped(
        self, engine: Engine, offered: Mapping[str, float], fast: list[str], seen_again: list[str]
    ) -> tuple[list[str], list[Note]]:
        """Return the channels that jump in this sample, and events; a watch begins with the first."""
        state, engines, jumped, notes = self.state, self._engines, fast, list[Note]()
        if engines is not None and is_unsteady(state) and set(fast) <= set(state.jumps):
            if fast or moves(state, offered, self._setup.change_k):
                notes = self._unsettle(engine, engines, offered)
        elif engines is not None and fast and not state.is_suspect:
            notes = [jump_note(name, jump.size_k) for name, jump in state.jumps.items() if name not in fast]
            self._use_no_longer(engine, engines, offered)
        elif fast and not state.is_suspect:
            self._begin(engine, Phase.SUSPECT, fast)
        elif not state.jumps:
            hidden = self._unexpected(engine, offered, seen_again)
            jumped = [*hidden, *(name for name in self._watchable(engine, offered) if name not in hidden)]
            if jumped:
                self._begin(engine, Phase.UNCONFIRMED if hidden else Phase.WATCHED)
        elif engines is not None and state.is_watched:
            jumped = self._going_on(engines, offered)
            if state.is_air and "t_q_degc" in self._watchable(engine, offered):
                self._question_both()
                jumped = ["t_q_degc", *jumped]
        if self.state.jumps:
            known = {*jumped, *self.state.jumps}
            unexpected = self._unexpected(engine, offered, seen_again)
            more = [name for name in unexpected if name not in known and not self._is_for_beside(name)]
            if more and self.state.is_watched:
                self._question_both()
            jumped = [*jumped, *more]
        return jumped, notes

    def _question_both(self) -> None:
        """Ask about both channels: one of them is wrong, so what T_Q has shown of AT counts no more, nor AT of T_Q."""
        self.state.phase = Phase.UNCONFIRMED
        self.state.start_evidence()

    def _entered(
        self,
        engine: Engine,
        engines: JumpEngines,
        offered: Mapping[str, float],
        fed: Fed,
        told: list[str],
        unseen: list[str],
    ) -> list[Note]:
        """Account for the jumps of a sample, and return the events of those that are `told`, some of them `unseen`."""
        state = self.state
        if not fed.jumped:
            return []
        if state.may_be_exchanged and not state.is_suspect:
            state.phase = Phase.SUSPECT
        if state.is_suspect:
            self._believe_anew(engine, engines, offered)
            state.start_evidence()
            return [jump_note(name, state.jumps[name].size_k) for name in told] if not fed.is_exchange else []
        if not state.is_unconfirmed:
            return []
        when = {name: UNSEEN if name in unseen else BESIDE for name in fed.jumped}
        if state.is_air:
            when["at_degc"] = AIR
        return [unconfirmed_note(name, state.jumps[name].size_k, when[name]) for name in fed.jumped]

    def _verdict(
        self,
        engine: Engine,
        engines: JumpEngines,
        offered: Mapping[str, float],
        others: Mapping[str, float],
        grown_y: GrownY,
    ) -> JumpFinding:
        judge = JumpJudge(engine, engines, self.state, offered)
        if not self.state.is_suspect:
            return judge.watched()
        is_alone = self._beside is None or not self._beside.is_open
        return judge.suspected(others, grown_y, is_alone=is_alone)

    def _finish(
        self,
        engine: Engine,
        verdict: JumpFinding,
        estimate: Estimate | None,
        offered: Mapping[str, float],
        others: Mapping[str, float],
    ) -> Estimate | None:
        """End the jump, and go on with that of the other channel if there is one; return the estimate of the sample."""
        beside = self._beside
        if beside is None or not beside.is_open:
            self.end()
            return estimate
        if not verdict.has_returned:
            # The engines beside have not seen what is believed now: they begin with it.
            estimate = estimate or engine.step(offered["t_q_degc"], offered["at_degc"], others)
            beside._begin_again(engine, estimate)
        self._go_on_with(beside)
        return estimate

    def _go_on_with(self, beside: OneJump) -> None:
        at_zero, before = self.zero_in_use, self.state
        self.state, self._engines, self._beside = beside.state, beside._engines, None
        self.state.again = before.again | self.state.again
        self.state.quiet = before.quiet | self.state.quiet | dict.fromkeys(before.jumps, 0)
        self.state.last, self.state.unseen = before.last, before.unseen
        if self._engines is not None:
            self._engines.take_zero(at_zero)

    def _begin(self, engine: Engine, phase: Phase, again: Sequence[str] = ()) -> None:
        self._engines = JumpEngines.begin(self._setup.model, engine.snapshot(), None, self._at_zero)
        self.state = self.state.begun(phase, again)

    def _begin_again(self, engine: Engine, estimate: Estimate | None) -> None:
        """Let both engines go on from another one: what is in question stays, what spoke for either does not."""
        self._engines = JumpEngines.begin(self._setup.model, engine.snapshot(), estimate, self._at_zero)
        self.state.start_evidence()

    # ------------------------------------------------------------------ the other channel

    @property
    def _beside_suspects(self) -> tuple[str, ...]:
        return self._beside.suspects if self._beside is not None else ()

    def _is_for_beside(self, name: str) -> bool:
        """Return whether the watch beside judges a channel: the other one, while one alone is suspect."""
        jumps = self.state.jumps
        return self.state.is_suspect and len(jumps) == 1 and name not in jumps

    def _judge_beside(
        self,
        engines: JumpEngines,
        measured: Mapping[str, float],
        fast: list[str],
        fed: Fed,
        others: Mapping[str, float],
        grown_y: GrownY,
        unseen: Mapping[str, int],
    ) -> Judgement:
        """Judge the other channel; `unseen` counts the samples without each channel before this one."""
        names = [name for name in self._names if self._is_for_beside(name)]
        if not names:
            self._leave_beside()
            return Judgement()
        if self._beside is None:
            self._beside = OneJump(self._setup, tuple(names))
            self._beside.state.unseen = {name: n for name, n in unseen.items() if name in names}
            self._beside.state.again = {name: n for name, n in self.state.again.items() if name in names}
            self._beside.state.quiet = {name: n for name, n in self.state.quiet.items() if name in names}
            self._beside._at_zero = engines.shifted.at_zero
        # What is left of a jump is a guess, by what was expected beside this very channel.
        as_measured = {*names, *(name for name, jump in self.state.jumps.items() if jump.back)}
        values = {name: (measured if name in as_measured else fed.values)[name] for name in TEMPERATURES}
        fast = [name for name in fast if name in names]
        if names == ["t_q_degc"] and not fast and not self._beside.is_open and self._is_expected(engines, measured):
            self._beside._seen_again(values)
            return Judgement()
        found = self._beside.judge(engines.shifted.engine, values, fast, others, grown_y)
        if not self._beside.is_open:
            self._beside.state.count_quiet()
        return found

    def _is_expected(self, engines: JumpEngines, measured: Mapping[str, float]) -> bool:
        """Return whether T_Q follows from AT if that was right: then it has not jumped beside it."""
        signs = self._setup.signs
        return signs is not None and "t_q_degc" not in signs.watchable(engines.believing.engine, measured)

    # ------------------------------------------------------------------ jumps again

    def _use_no_longer(self, engine: Engine, engines: JumpEngines, offered: Mapping[str, float]) -> None:
        """Suspect channels that jump again: what unconfirmed ones have shown is kept if nothing contradicts it."""
        state = self.state
        was_used = state.is_unconfirmed and state.age - state.loose > state.loose and not is_contradicted(state)
        if was_used:
            state.age = 0
        else:
            engines.give(engine, engines.shifted)
        state.suspect(Phase.SUSPECT_AFTER_USE if was_used else Phase.SUSPECT)
        self._believe_anew(engine, engines, offered)

    def _believe_anew(self, engine: Engine, engines: JumpEngines, offered: Mapping[str, float]) -> None:
        """Let the believing engine begin with this jump: what was wrong before it is undone."""
        self.state.loose = self.state.age
        if self.state.phase == Phase.SUSPECT_AFTER_USE and engines.fits(engine, self.state, offered):
            engines.believe_from_used(engine)
        else:
            engines.believe_from_shifted()

    def _unsettle(self, engine: Engine, engines: JumpEngines, offered: Mapping[str, float]) -> list[Note]:
        """Account for a further jump of a loose contact."""
        state = self.state
        if state.is_suspect and state.samples <= 1 and engines.goes_away(state, offered):
            # What goes on from sample to sample is one jump, or heat.
            state.samples = 0
            return []
        state.at_held = 0
        state.again |= {name: state.again.get(name, 0) + 1 for name in state.jumps}
        if state.is_suspect:
            self._believe_anew(engine, engines, offered)
            state.start_evidence()
            return []
        self._use_no_longer(engine, engines, offered)
        return [jump_note(name, jump.size_k) for name, jump in state.jumps.items() if not math.isnan(offered[name])]

    # ------------------------------------------------------------------ signs

    def _unexpected(self, engine: Engine, offered: Mapping[str, float], seen_again: list[str]) -> list[str]:
        """Return the channels that, seen again, differ from what one of the engines that may be right expects."""
        signs = self._setup.signs
        if signs is None:
            return []
        may_be_right = [engine]
        if self._engines is not None and not self.state.is_suspect:
            # An engine that believes air which is none explains a T_Q that is wrong by heat.
            may_be_right.append(self._engines.shifted.engine)
        found = {name for one in may_be_right for name in signs.unexpected(one, offered, seen_again)}
        return [name for name in self._names if name in found]

    def _watchable(self, engine: Engine, offered: Mapping[str, float]) -> list[str]:
        signs = self._setup.signs
        return [name for name in signs.watchable(engine, offered) if name in self._names] if signs else []

    def _going_on(self, engines: JumpEngines, offered: Mapping[str, float]) -> list[str]:
        """Return the watched channels that go on to move as nothing explains: a jump may take some samples."""
        jumps = self.state.jumps
        less = {name: value - (jumps[name].size_k if name in jumps else 0.0) for name, value in offered.items()}
        return [name for name in self._watchable(engines.shifted.engine, less) if name in jumps]

    def _seen_again(self, measured: Mapping[str, float]) -> list[str]:
        """Return the channels that are seen again after samples without them, and count such samples."""
        unseen = self.state.unseen
        self.state.unseen = {name: unseen.get(name, 0) + 1 for name in self._names if math.isnan(measured[name])}
        return [name for name, samples in unseen.items() if samples >= UNSEEN_SAMPLES and name not in self.state.unseen]


def _others(state: JumpState) -> tuple[str, ...]:
    return tuple(name for name in TEMPERATURES if name not in state.jumps)


def _moved(before: Estimate | None, now: Estimate | None) -> tuple[Estimate, Estimate] | None:
    """Return what the compensation's engine had estimated at the last zero, before and now; None if unchanged."""
    return (before, now) if before is not None and now is not None and now != before else None
