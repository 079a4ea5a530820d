"""What a jump turns out to be, sample by sample: one of the sensor, or of the temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from compensator.events import Note
from compensator.model.engine import Engine, Estimate
from compensator.service.plausibility.grown_y import GrownY
from compensator.service.plausibility.jump_engines import (
    EngineRun,
    JumpEngines,
    contradicts,
    expected_value,
    is_unsteady,
    needed_samples,
)
from compensator.service.plausibility.jump_evidence import (
    MODEL_AGREES,
    confirmed_by,
    is_contradicted,
    is_good_enough,
    is_unlikely,
)
from compensator.service.plausibility.jump_signs import (
    AIR,
    AS_USED,
    FITS,
    LEFT,
    NEAR,
    RESTED,
    accepted_note,
    jump_note,
    unconfirmed_note,
)
from compensator.service.plausibility.jump_state import JumpState, Phase

#: A jump within the permitted rate is watched for this number of samples.
WATCHED_SAMPLES = 15


class JumpFinding(msgspec.Struct, frozen=True):
    """What a sample has shown of the channels that have jumped.

    Parameters
    ----------
    estimate : Estimate, optional
        The estimate after this sample, if the engine was given another state; None if it is still to be stepped.
    notes : list of Note
        Events.
    accepted : dict of str to float
        Channels that are used again, with their values, °C.
    ends : bool
        Whether the jump is over: they are used as they are.
    has_returned : bool
        Whether that is because they are where the shifted engine expects them.
    """

    estimate: Estimate | None = None
    notes: list[Note] = []
    accepted: dict[str, float] = {}
    ends: bool = False
    has_returned: bool = False


class JumpJudge:
    """Decides what a sample has shown.

    Parameters
    ----------
    engine : Engine
        Engine of the compensation; it may be given the state of one of the two engines.
    engines : JumpEngines
        The engine that believes the channels, and the one that takes them less their jump.
    state : JumpState
        State of the watch.
    offered : mapping of str to float
        Measured temperatures, °C.
    """

    def __init__(self, engine: Engine, engines: JumpEngines, state: JumpState, offered: Mapping[str, float]) -> None:
        self._engine, self._engines, self._state, self._offered = engine, engines, state, offered

    def suspected(self, others: Mapping[str, float], grown_y: GrownY, *, is_alone: bool) -> JumpFinding:
        """Decide whether channels that are not used are used again, and from which engine on.

        Parameters
        ----------
        others : mapping of str to float
            Usable values of the auxiliary channels.
        grown_y : GrownY
            Deformation by measured Y.
        is_alone : bool
            Whether the other channel is not in question: beside one that is, nothing is used unconfirmed.
        """
        engines, state, offered = self._engines, self._state, self._offered
        needed = needed_samples(state)
        was_used = is_alone and state.phase == Phase.SUSPECT_AFTER_USE
        if was_used and state.as_used >= needed and any(state.kept_k().values()):
            used = self._use_as_before(others, grown_y)
            if used is not None:
                return used
        if state.is_back(needed) and not any(math.isnan(offered[name]) for name in state.jumps):
            if state.leaves_something and is_unsteady(state):
                return self._settle() if is_alone else JumpFinding()
            if state.leaves_something:
                return self._keep_what_is_left(is_alone=is_alone)
            found = self._accept(engines.shifted, "has returned to what was expected before")
            return msgspec.structs.replace(found, has_returned=True)
        if state.at_held >= needed and state.phase != Phase.SUSPECT_AFTER_USE:
            return self._accept(None, "has returned to where it was before")
        by = confirmed_by(state)
        if by and not (by == MODEL_AGREES and self._is_believing_contradicted(grown_y)):
            return self._accept(engines.believing, f"is used again: {by} with it")
        if is_alone and is_unsteady(state) and state.samples >= needed and engines.may_be(state, offered):
            return self._settle()
        if is_alone and is_good_enough(state) and not any(map(math.isnan, offered.values())):
            return self._settle(FITS)
        return JumpFinding()

    def watched(self) -> JumpFinding:
        """Decide whether a jump within the permitted rate, or one that nobody saw, was one of the sensor."""
        engines, state, offered = self._engines, self._state, self._offered
        is_refuted, only_at = is_unlikely(state), state.is_at_alone
        # What is used may be where it was for a moment because heat is switched; a watched jump is over at once.
        is_back = state.is_back(needed_samples(state) if state.phase == Phase.UNCONFIRMED else 1)
        if only_at and is_refuted and not is_back and not state.is_unconfirmed:
            state.phase = Phase.AIR
            return JumpFinding(notes=[unconfirmed_note("at_degc", state.jumps["at_degc"].size_k, AIR)])
        # T_Q follows the air as slowly as the machine does: that it has not followed AT shows nothing against AT.
        is_refuted &= not state.is_air or (is_back and state.phase == Phase.AIR)
        if state.is_unconfirmed:
            by = confirmed_by(state)
            if by:
                return self._accept(None, f"is confirmed: {by} with it")
            if state.is_back(needed_samples(state)):
                if only_at and state.leaves_something:
                    state.keep_what_is_left()
                elif (only_at or not is_unsteady(state)) and not state.leaves_something and engines.agree():
                    return self._accept(None, "has returned to what was expected before")
            # Of a loose contact the shifted engine is no hypothesis: where it agrees with Y, it does by chance.
            is_refuted |= is_contradicted(state) and not is_unsteady(state)
        if is_refuted:
            estimate = engines.give(self._engine, engines.shifted)
            if not is_back:
                notes = [jump_note(name, jump.size_k) for name, jump in state.jumps.items()]
                state.suspect()
                return JumpFinding(estimate, notes)
            if state.leaves_something and not only_at:
                return self._keep_what_is_left()
            notes = [jump_note(name, jump.size_k, "and has returned") for name, jump in state.jumps.items()]
            if not only_at or (engines.agree() and not state.leaves_something):
                return JumpFinding(estimate, notes, ends=True)
            # Or a door was open: what the air has done meanwhile stays in the deviation until it is forgotten.
            engines.swap()
            state.keep_what_is_left()
            state.phase = Phase.AIR_RETURNED
            state.start_evidence()
            return JumpFinding(estimate, notes)
        if math.isnan(offered["t_q_degc"]):
            state.samples -= 1  # nothing but T_Q speaks for or against AT
        return JumpFinding(ends=state.samples >= WATCHED_SAMPLES and not state.is_unconfirmed)

    def _is_believing_contradicted(self, grown_y: GrownY) -> bool:
        """Return whether measured Y contradicts the believing engine, by how it stood before the jump and by the zero.

        Either alone may be what a fault had done before that the jump has mended.
        """
        believing = self._engines.believing
        estimate, at_zero = believing.estimate, believing.at_zero
        return (
            estimate is not None
            and contradicts(grown_y.by_level, grown_y.level_std_um, estimate, at_zero)
            and contradicts(grown_y.by_zero, grown_y.zero_std_um, estimate, at_zero)
        )

    def _use_as_before(self, others: Mapping[str, float], grown_y: GrownY) -> JumpFinding | None:
        """Use channels again that are back to what they showed while they were used: they are unconfirmed, as then.

        Not where measured Y contradicts them: it may show in hindsight what was wrong. Then nothing is changed.
        """
        engine, engines, state, offered = self._engine, self._engines, self._state, self._offered
        before = engine.snapshot()
        estimate = engine.step(offered["t_q_degc"], offered["at_degc"], others)
        if contradicts(grown_y.by_level, grown_y.level_std_um, estimate, engines.zero_in_use):
            engine.restore(before)
            return None
        names = list(state.jumps)
        state.keep_as_used()
        state.phase = Phase.UNCONFIRMED
        state.start_evidence()
        engines.believe_from_used(engine)
        engines.believing.estimate = estimate
        notes = [unconfirmed_note(name, jump.size_k, AS_USED) for name, jump in state.jumps.items()]
        return JumpFinding(estimate, notes, {name: offered[name] for name in names})

    def _keep_what_is_left(self, *, is_alone: bool = True) -> JumpFinding:
        """Begin a smaller jump where a channel has returned by most of one: a couple that was pushed in halfway."""
        engines, state, offered = self._engines, self._state, self._offered
        used = {name: offered[name] for name, jump in state.jumps.items() if not jump.left_k}
        # How far it had jumped was as uncertain as what was expected then.
        is_certain = any(abs(jump.left_k) > NEAR * jump.std_k for jump in state.jumps.values())
        state.keep_what_is_left()
        engines.believing.estimate = estimate = engines.give(self._engine, engines.shifted)
        engines.believe_from_shifted()
        state.suspect()
        if is_alone and not is_certain:
            state.phase = Phase.UNCONFIRMED
            notes = [unconfirmed_note(name, jump.size_k, LEFT) for name, jump in state.jumps.items()]
            return JumpFinding(estimate, notes, {name: offered[name] for name in state.jumps} | used)
        then = f"{LEFT}, and is not used until its new value is confirmed"
        notes = [jump_note(name, jump.size_k, then) for name, jump in state.jumps.items()]
        return JumpFinding(estimate, notes, used)

    def _settle(self, when: str = RESTED) -> JumpFinding:
        """Use a channel of which it is not known whether it is right: it is unconfirmed."""
        engines, state, offered = self._engines, self._state, self._offered
        notes = []
        for name, jump in state.jumps.items():
            expected, _ = expected_value(engines.shifted.engine, name, offered["at_degc"])
            jump.size_k = offered[name] - expected
            notes.append(unconfirmed_note(name, jump.size_k, when))
        estimate = engines.give(self._engine, engines.believing)
        state.phase = Phase.UNCONFIRMED
        state.start_evidence()
        return JumpFinding(estimate, notes, {name: offered[name] for name in state.jumps})

    def _accept(self, run: EngineRun | None, how: str) -> JumpFinding:
        engines, state, offered = self._engines, self._state, self._offered
        names = list(state.jumps)
        notes = [accepted_note(name, state.jumps[name].size_k, how) for name in names]
        estimate = engines.give(self._engine, run) if run is not None else None
        return JumpFinding(estimate, notes, {name: offered[name] for name in names}, ends=True)
