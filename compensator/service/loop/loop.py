"""The loop: decides when to diagnose, what runs in shadow, and which model comes next.

    idle → diagnosis → shadow → proposed → adopted → watching the model before → idle

At most one other model runs in shadow: before an adoption the candidate, after it the model from before, which keeps
its place from candidates until it is no longer needed (`place`). In both cases
it replaces the present model once measured Y after its beginning shows clearly that it is better: adopting and going
back are one rule. No clock, socket or file: a replay of the recorded samples and diagnoses decides the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from compensator.clock import NS
from compensator.codes import Reason
from compensator.config import Loop as LoopSettings
from compensator.errors import ServiceError
from compensator.events import ComparisonVerdict, DiagnosisData, EventKind, LoopAction, LoopData, Note
from compensator.service.loop.avoided import avoid, avoid_after_back
from compensator.service.loop.level import ErrorBlocks, level_um
from compensator.service.loop.place import ADOPTION_H, remembered_h, role_of, takes_over, why_nothing
from compensator.service.loop.proof import (
    BETTER_PART,
    LEVEL_PART,
    is_better_about_zero,
    is_clearly_better,
    is_enough,
    is_limited,
)
from compensator.service.loop.schedule import begin_again, begin_if_due, pass_planned
from compensator.service.loop.shadow import Role
from compensator.service.loop.state import Compared, Exchange, LoopState, fresh
from compensator.service.loop.trust import both_suspect_a_sensor, is_alarmed, is_contradicted, is_disturbed
from compensator.service.loop.words import ended, nothing_follows
from compensator.service.outcome import Outcome
from compensator.service.transfer.comparison import BLOCK_MIN, Comparison
from compensator.service.transfer.second_opinion import described, is_unusable

#: No decision before no sensor has been suspected for so long, min.
CLEAN_MIN = BLOCK_MIN
_HOUR_NS = 3600 * NS


@dataclass(frozen=True, slots=True, kw_only=True)
class StartDiagnosis:
    """A diagnosis is wanted: of what is on record between two times, ns since 1970 UTC."""

    from_utc_ns: int
    to_utc_ns: int
    why: str


class Loop:
    """Decides about the models of one machine.

    Parameters
    ----------
    settings : config.Loop
        `[loop]`.
    period_s : float
        Length of a sample, s.
    effects : sequence of str
        Effects of the present model.
    state : LoopState, optional
        State to continue from.
    """

    def __init__(
        self, settings: LoopSettings, period_s: float, effects: Sequence[str], state: LoopState | None = None
    ) -> None:
        self._settings = settings
        self._period_s = period_s
        self.state = state if state is not None else LoopState(effects=list(effects))
        self.state.effects = list(effects)
        self._comparison = self._compared()

    @property
    def wanted(self) -> StartDiagnosis | None:
        """The diagnosis that is under way, to be begun or begun again; None if there is none."""
        running = self.state.diagnosis
        if running is None or running.candidate_sha256:
            return None
        return StartDiagnosis(from_utc_ns=running.from_utc_ns, to_utc_ns=running.to_utc_ns, why=running.why)

    @property
    def judged_h(self) -> float:
        """Time of the usable blocks of measured Y, h."""
        return self._comparison.judged_h

    # ------------------------------------------------------------------ one sample

    def step(self, present: Outcome, other: Outcome | None) -> list[Note]:
        """Process a sample.

        Parameters
        ----------
        present : Outcome
            Of the present model, with the compared probes alone.
        other : Outcome or None
            That of the shadow; None without one.

        Returns
        -------
        list of Note
            The decisions, each with the figures on which it rests.
        """
        state, now_ns, reasons = self.state, present.sample.time_utc_ns, present.offset.reasons
        minutes, suspected = self._period_s / 60.0, is_contradicted(reasons)
        if other is not None:
            suspected = suspected or both_suspect_a_sensor(present, other)
        disturbed = suspected or is_disturbed(reasons) or is_unusable(present)
        state.clean_min = 0.0 if disturbed else state.clean_min + minutes
        state.misfit_min = state.misfit_min + minutes if is_alarmed(reasons) else 0.0
        state.error.update(present)
        notes: list[Note] = []
        if other is not None and state.shadow is not None:
            state.other_error.update(other)
            may_have_changed = self._compare(present, other, suspected=suspected)
            if not state.exchange:
                notes += self._decide(now_ns, present, other, judge=may_have_changed)
        return notes + self._schedule(now_ns)

    def _compare(self, present: Outcome, other: Outcome, *, suspected: bool) -> bool:
        """Add a sample to the comparison, unless it must not judge; return whether the verdict was made anew."""
        state, found = self.state, self._comparison
        if any(note.kind == EventKind.ZERO for note in present.notes):
            found.set_zero()
        if suspected:
            # Before it is suspected a faulty sensor has been wrong for a while: what was compared does not count.
            if state.comparison.first_ns:
                self._begin_comparison()
            return False
        reasons = [*present.offset.reasons, *other.offset.reasons]
        missing = any(reason.startswith(Reason.CHANNEL_MISSING) for reason in reasons)
        if missing or is_unusable(present, other) or is_disturbed(reasons):
            return False
        if not found.add(present, other, suspected=False):
            return False
        is_candidate = state.shadow is not None and state.shadow.role == "candidate"
        hours = remembered_h(self._settings)
        hours = max(self._settings.record_h, hours) if is_candidate else hours
        oldest_ns = present.sample.time_utc_ns - round(hours * _HOUR_NS)
        found.forget_before(oldest_ns, 2 * self._settings.probes)
        state.verdict = found.verdict(deviations=self._settings.deviations)
        return True

    def _begin_comparison(self) -> None:
        self.state.comparison, self.state.verdict = fresh()
        self._comparison = self._compared()

    def _compared(self) -> Comparison:
        return Comparison(self._period_s, self.state.comparison, by_likelihood=True)

    # ------------------------------------------------------------------ decisions about the shadow

    def _decide(self, now_ns: int, present: Outcome, other: Outcome, *, judge: bool) -> list[Note]:
        state, shadow = self.state, self.state.shadow
        assert shadow is not None
        if shadow.role == "candidate" and is_limited(other) and not is_limited(present):
            return self._end("limits")
        if now_ns - shadow.since_utc_ns >= self._settings.watch_h * _HOUR_NS:
            return self._end("watched" if shadow.role == "before" else "no_difference")
        if state.clean_min < CLEAN_MIN or not (judge or state.phase == "shadow"):
            return []
        verdict = state.verdict.verdict
        if shadow.role == "before":
            return self._go_back() if verdict == ComparisonVerdict.BETTER else []
        if verdict == ComparisonVerdict.WORSE:
            return self._end("worse")
        compared_h = (now_ns - shadow.since_utc_ns) / _HOUR_NS
        is_better = is_clearly_better(state.verdict) and is_enough(
            state.verdict, self._settings, judged_h=self.judged_h, compared_h=compared_h
        )
        if is_better and state.comparison.model_ns:
            is_better = self._comparison.is_itself_better()
        if state.phase == "proposed" and verdict != ComparisonVerdict.BETTER:
            state.phase = "shadow"
            return [self._note(LoopAction.WITHDRAW, f"the proposal is withdrawn: {described(state.verdict)}")]
        if is_better and (state.phase == "shadow" or self._may_adopt(now_ns)):
            return self._accept(now_ns)
        return []

    def _shown_level_um(self) -> float | None:
        """Return the level of the other model that measured Y shows, µm; None if it shows none (`level`)."""
        shadow = self.state.shadow
        since_ns = shadow.since_utc_ns if shadow is not None else 0
        return level_um(self.state.error.blocks, self.state.other_error.blocks, since_ns=since_ns)

    def _level_um(self) -> float | None:
        """Return by how much a candidate's level is raised at its adoption, µm; None if its level is not known.

        Where measured Y does not show it, the candidate must be better about the zero, too, and not by little: a level
        that contradicts measured Y counts from a zero that was set before its effect acted, or measured Y has moved;
        which of them is seen at the next zero.
        """
        shown_um, verdict = self._shown_level_um(), self.state.verdict
        part = BETTER_PART if verdict.measured_by == "probe" else LEVEL_PART
        if shown_um is None and is_better_about_zero(verdict, part):
            return self._comparison.level_um if verdict.y_moved else 0.0
        return shown_um

    def _may_adopt(self, now_ns: int) -> bool:
        """Return whether a candidate that is better is adopted without a person."""
        state = self.state
        if self._settings.policy != "adopt" or self._level_um() is None:
            return False
        return not state.adopted_utc_ns or now_ns - state.adopted_utc_ns >= ADOPTION_H * _HOUR_NS

    def _accept(self, now_ns: int) -> list[Note]:
        """Adopt or propose a candidate."""
        state, by_hand = self.state, self._settings.policy == "propose"
        if self._may_adopt(now_ns):
            self._exchange("adopt")
            text = f"a better model is adopted: {self._named()}; {described(state.verdict)}"
            if state.level_um:
                text += f"; its level is raised by {state.level_um:+.1f} µm to that of measured Y"
            return [self._note(LoopAction.ADOPT, text)]
        if not by_hand and self._level_um() is not None:
            return []  # the last adoption is too short a time ago
        state.phase = "proposed"
        text = f"a better model is proposed: {self._named()}; {described(state.verdict)}"
        if self._level_um() is None:
            text += "; its level is not confirmed: set a zero, and adopt it then"
        return [self._note(LoopAction.PROPOSE, text)]

    def _go_back(self) -> list[Note]:
        self._exchange("back")
        text = f"back to the model before, which is better: {self._named()}; {described(self.state.verdict)}"
        return [self._note(LoopAction.BACK, text)]

    def _exchange(self, action: Exchange) -> None:
        """Decide an exchange, and the level of the other model: where it is not known, only its changes are new."""
        state = self.state
        known_um = self._level_um() if action == "adopt" else None
        unknown_um = self._comparison.level_um if state.verdict.y_moved else 0.0
        state.exchange, state.level_um = action, known_um if known_um is not None else unknown_um
        if action == "adopt" and self._shown_level_um() is not None:
            state.verdict = msgspec.structs.replace(state.verdict, y_moved=False)  # the effect has moved it

    def _end(self, why: str, text: str = "") -> list[Note]:
        """End the shadow."""
        state = self.state
        note = self._note(LoopAction.END, text or ended(why, state.verdict), why=why)
        state.phase, state.shadow, state.exchange = "idle", None, ""
        self._begin_comparison()
        return [note]

    def _named(self) -> str:
        shadow = self.state.shadow
        assert shadow is not None
        return f"{shadow.sha256[:12]} with {', '.join(shadow.effects) or 'no added effect'}"

    def _note(self, step: LoopAction, text: str, *, why: str = "") -> Note:
        state, shadow = self.state, self.state.shadow
        data = LoopData(
            step=step,
            why=why,
            role=shadow.role if shadow is not None else "",
            model_sha256=shadow.sha256 if shadow is not None else "",
            effects=shadow.effects if shadow is not None else [],
            since_utc_ns=shadow.since_utc_ns if shadow is not None else 0,
            comparison=state.verdict if shadow is not None else None,
            level_um=state.level_um if state.exchange else None,
        )
        return Note(EventKind.LOOP, text, data.table())

    # ------------------------------------------------------------------ diagnoses

    def _schedule(self, now_ns: int) -> list[Note]:
        """Begin a diagnosis if it is time, and nothing speaks against it."""
        state = self.state
        planned_ns = pass_planned(state, self._settings, now_ns)
        if state.diagnosis is not None or state.exchange or state.clean_min < CLEAN_MIN:
            return []
        return begin_if_due(state, self._settings, now_ns, planned_ns)

    def receive(self, found: DiagnosisData, now_ns: int) -> list[Note]:
        """Decide what follows from a diagnosis; a candidate is then warmed up (`shadow_begins`)."""
        state = self.state
        running, state.diagnosis = state.diagnosis, None
        if running is None:
            return []
        why = why_nothing(state, self._settings, found, now_ns)
        if why:
            data = LoopData(
                step=LoopAction.NOTHING, why=why, effects=found.effects, model_sha256=found.candidate_sha256
            )
            return [Note(EventKind.LOOP, nothing_follows(why, found), data.table())]
        state.diagnosis = msgspec.structs.replace(running, candidate_sha256=found.candidate_sha256)
        text = f"a candidate is compared with the present model: {', '.join(found.effects) or 'no added effect'}"
        role = role_of(found)
        if role == "before":
            found_again = "nothing is found that the calibrated model lacks"
            if found.verdict != "adequate":
                found_again = f"the effects of the present model are not found again ({found.verdict})"
            text = f"{found_again}: the calibrated model is compared with the present one"
        data = LoopData(step=LoopAction.SHADOW, role=role, model_sha256=found.candidate_sha256, effects=found.effects)
        return [Note(EventKind.LOOP, text, data.table())]

    # ------------------------------------------------------------------ between two samples

    def shadow_begins(
        self,
        sha256: str,
        effects: Sequence[str],
        now_ns: int,
        role: Role = "candidate",
        *,
        error: ErrorBlocks | None = None,
    ) -> None:
        """Begin to compare another model, whose error on the record is given where it is known."""
        state, goes_on = self.state, takes_over(self.state, role, effects)
        state.other_error = error if error is not None else ErrorBlocks()
        state.diagnosis = None
        state.phase = "shadow" if role == "candidate" else "watching"
        state.shadow = Compared(sha256=sha256, effects=list(effects), role=role, since_utc_ns=now_ns)
        state.exchange = ""
        if goes_on:
            self._comparison.go_on_with(now_ns)
        else:
            self._begin_comparison()

    def exchanged(self, now_ns: int, sha256_before: str) -> None:
        """Go on after the shadow has replaced the present model, whose hash was `sha256_before`."""
        state, back = self.state, self.state.exchange == "back"
        assert state.shadow is not None
        before, state.effects = state.effects, state.shadow.effects
        state.error.clear()
        if state.diagnosis is not None and state.diagnosis.candidate_sha256:
            state.diagnosis = None  # a candidate that is warmed up was weighed beside the model that has gone
        if back:
            longest_h = self._settings.watch_h
            avoid_after_back(state, before, now_ns, first_h=ADOPTION_H, longest_h=longest_h)
            state.phase, state.shadow, state.exchange = "idle", None, ""
            self._begin_comparison()
            return
        state.adopted_utc_ns = now_ns
        diagnosis = state.diagnosis
        self.shadow_begins(sha256_before, before, now_ns, "before")
        state.diagnosis = diagnosis

    def accept(self) -> list[Note]:
        """Adopt the candidate before the next sample: an operator has agreed.

        Raises
        ------
        ServiceError
            If there is none.
        """
        shadow = self.state.shadow
        if shadow is None or shadow.role != "candidate":
            raise ServiceError("adopt --candidate: there is no candidate now; see `compensator watch`")
        if self.state.exchange:
            return []
        self._exchange("adopt")
        text = f"an operator adopts the candidate: {self._named()}; {described(self.state.verdict)}"
        return [self._note(LoopAction.ADOPT, text, why="by_hand")]

    def dismiss(self, now_ns: int) -> list[Note]:
        """End a candidate: an operator has refused it. Its effects are avoided for some time."""
        shadow = self.state.shadow
        if shadow is None or shadow.role != "candidate" or self.state.exchange:
            return []
        avoid(self.state, shadow.effects, now_ns, self._settings.watch_h)
        return self._end("dismissed")

    def model_changed(self, effects: Sequence[str], now_ns: int, *, back: bool = False) -> list[Note]:
        """Begin anew: an operator has changed the model; a diagnosis under way is of no use."""
        state = self.state
        if back:
            avoid(state, state.effects, now_ns, self._settings.watch_h)
        state.effects, state.diagnosis = list(effects), None
        state.error.clear()
        words = "a person has changed the model or the configuration"
        return self.give_up("by_hand", words) if state.shadow is not None else []

    def give_up(self, why: str, text: str) -> list[Note]:
        """End the shadow for a cause outside of the loop, or a candidate that could not be warmed up."""
        self.state.diagnosis = None
        return self._end(why, text)

    def restarted(self) -> list[Note]:
        """Go on after the service was away: a diagnosis that was interrupted is begun once more."""
        return begin_again(self.state)
