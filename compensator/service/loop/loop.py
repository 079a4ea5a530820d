"""The loop: decides when to diagnose, what runs in shadow, and which model comes next.

    idle → diagnosis → shadow → proposed → adopted → watching the model before → idle

Two other models run in shadow at most, each in a place of its own: what a diagnosis has found, and the model before the
last adoption. Either replaces the present model once measured Y after its beginning shows clearly that it is better:
adopting and going back are one rule. No clock, socket or file: a replay of the recorded samples and diagnoses decides
the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.errors import ServiceError
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData, EventKind, LoopAction, LoopData, Note
from compensator.service.loop.avoided import avoid, avoid_after_back, is_avoided
from compensator.service.loop.compared import Compared
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.place import (
    ADOPTION_H,
    falls,
    is_asked,
    keeps_place,
    leads,
    place_of_outgoing,
    rival_of,
    takes_over,
    why_nothing,
)
from compensator.service.loop.proof import is_limited
from compensator.service.loop.schedule import begin_again, begin_if_due, pass_planned
from compensator.service.loop.shadow import Role
from compensator.service.loop.state import Exchange, LoopState, Place, PlaceName
from compensator.service.loop.trust import all_suspect_a_sensor, is_alarmed, is_contradicted, is_disturbed
from compensator.service.loop.words import begins, ended, named, nothing_follows, replaced
from compensator.service.outcome import Outcome
from compensator.service.transfer.comparison import BLOCK_MIN, Comparison
from compensator.service.transfer.second_opinion import described, is_unusable

#: No decision before no sensor has been suspected for so long, min.
CLEAN_MIN = BLOCK_MIN
#: Why a newcomer gets the place of a candidate, does not get it, or waits for a person's answer; each with its
#: comparison with that candidate.
BESIDE = ("replaced", "shown_less", "waits")
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

    @property
    def wanted(self) -> StartDiagnosis | None:
        """The diagnosis that is under way, to be begun or begun again; None if there is none."""
        running = self.state.diagnosis
        if running is None or running.candidate_sha256:
            return None
        return StartDiagnosis(from_utc_ns=running.from_utc_ns, to_utc_ns=running.to_utc_ns, why=running.why)

    def judged_h(self, place: Place) -> float:
        """Return the time of the usable blocks of measured Y in a comparison, h."""
        return self._compared(place).judged_h

    def _compared(self, place: Place) -> Compared:
        return Compared(place, self._settings, self._period_s, self.state.error)

    # ------------------------------------------------------------------ one sample

    def step(self, present: Outcome, others: Mapping[PlaceName, Outcome]) -> list[Note]:
        """Process a sample.

        Parameters
        ----------
        present : Outcome
            Of the present model, with the compared probes alone.
        others : mapping of str to Outcome
            Those of the models in shadow, by place.

        Returns
        -------
        list of Note
            The decisions, each with the figures on which it rests.
        """
        state, now_ns, reasons = self.state, present.sample.time_utc_ns, present.offset.reasons
        minutes, suspected = self._period_s / 60.0, is_contradicted(reasons)
        if others:
            suspected = suspected or all_suspect_a_sensor([present, *others.values()])
        disturbed = suspected or is_disturbed(reasons) or is_unusable(present)
        state.clean_min = 0.0 if disturbed else state.clean_min + minutes
        state.misfit_min = state.misfit_min + minutes if is_alarmed(reasons) else 0.0
        state.error.update(present)
        notes: list[Note] = []
        for name, place in state.taken.items():
            compared, judge = self._compared(place), False
            if suspected:
                begins_anew = compared.add_suspected(others[name])
                if begins_anew and place.is_proposed and not state.exchange:
                    notes += self._withdraw(place, "a sensor is suspected, so what was compared does not count")
            else:
                judge = compared.add(present, others[name])
            if not state.exchange and not (name == "found" and state.has_next):
                notes += self._decide(name, place, now_ns, present, others[name], judge=judge)
        return notes + self._schedule(now_ns)

    # ------------------------------------------------------------------ decisions about a shadow

    def _decide(
        self, name: PlaceName, place: Place, now_ns: int, present: Outcome, other: Outcome, *, judge: bool
    ) -> list[Note]:
        state, is_candidate = self.state, place.role == "candidate"
        if is_candidate and is_limited(other) and not is_limited(present):
            return self._end(name, "limits")
        if now_ns - place.since_utc_ns >= self._settings.watch_h * _HOUR_NS:
            unshown = "no_answer" if place.is_proposed else "no_difference"
            return self._end(name, unshown if is_candidate else "watched")
        is_waiting = is_candidate and not place.is_proposed
        if state.clean_min < CLEAN_MIN or not (judge or is_waiting):
            return []
        verdict = place.verdict.verdict
        if not is_candidate:
            return self._go_back(name, place) if verdict == ComparisonVerdict.BETTER else []
        if verdict == ComparisonVerdict.WORSE:
            return self._end(name, "worse")
        if place.is_proposed and falls(place.verdict, self._settings):
            return self._withdraw(place, described(place.verdict))
        if self._compared(place).is_better(now_ns) and (not place.is_proposed or self._may_adopt(place, now_ns)):
            return self._accept(place, now_ns)
        return []

    def _may_adopt(self, place: Place, now_ns: int) -> bool:
        """Return whether a candidate that is better is adopted without a person.

        Not while the model before the last adoption is better so far: it would give its place to the present one.
        """
        state = self.state
        if self._settings.policy != "adopt" or self._compared(place).level_um is None:
            return False
        if state.watched is not None and leads(state.watched.verdict, self._settings):
            return False
        return not state.adopted_utc_ns or now_ns - state.adopted_utc_ns >= ADOPTION_H * _HOUR_NS

    def _accept(self, place: Place, now_ns: int) -> list[Note]:
        """Adopt or propose a candidate."""
        by_hand = self._settings.policy == "propose"
        if self._may_adopt(place, now_ns):
            self._exchange("adopt", "found", place)
            text = f"a better model is adopted: {_named(place)}; {described(place.verdict)}"
            if self.state.level_um:
                text += f"; its level is raised by {self.state.level_um:+.1f} µm to that of measured Y"
            return [self._note(place, LoopAction.ADOPT, text)]
        is_level = self._compared(place).level_um is not None
        if not by_hand and is_level:
            return []  # the last adoption is too short a time ago, or the model before it is better so far
        place.is_proposed = True
        text = f"a better model is proposed: {_named(place)}; {described(place.verdict)}"
        if not is_level:
            text += "; its level is not confirmed: set a zero, and adopt it then"
        return [self._note(place, LoopAction.PROPOSE, text)]

    def _withdraw(
        self, place: Place, text: str, *, why: str = "", comparison: ComparisonData | None = None
    ) -> list[Note]:
        place.is_proposed = False
        text = f"the proposal is withdrawn: {text}"
        return [self._note(place, LoopAction.WITHDRAW, text, why=why, comparison=comparison)]

    def _go_back(self, name: PlaceName, place: Place) -> list[Note]:
        self._exchange("back", name, place)
        text = f"back to the model before, which is better: {_named(place)}; {described(place.verdict)}"
        return [self._note(place, LoopAction.BACK, text)]

    def _exchange(self, action: Exchange, name: PlaceName, place: Place) -> None:
        """Decide an exchange, and the level of the other model: where it is not known, only its changes are new."""
        state, compared = self.state, self._compared(place)
        state.exchange, state.incoming = action, name
        state.level_um = self.level_at_adoption_um(place) if action == "adopt" else compared.unknown_level_um
        if action == "adopt" and compared.shown_level_um is not None:
            place.verdict = msgspec.structs.replace(place.verdict, y_moved=False)  # the effect has moved it

    def level_at_adoption_um(self, place: Place) -> float:
        """Return by how much the level of a candidate is raised if it is adopted now, µm."""
        compared = self._compared(place)
        known_um = compared.level_um
        return known_um if known_um is not None else compared.unknown_level_um

    def _end(self, name: PlaceName, why: str, text: str = "") -> list[Note]:
        """End a shadow, and an exchange with it."""
        state, place = self.state, self.state.place(name)
        if place is None:
            return []
        notes = [self._note(place, LoopAction.END, text or ended(why, place.verdict), why=why)]
        place.begin_anew()
        state.put(name, None)
        if state.incoming == name:
            state.exchange = ""
        return notes

    def _note(
        self, place: Place, step: LoopAction, text: str, why: str = "", comparison: ComparisonData | None = None
    ) -> Note:
        data = LoopData(
            step=step,
            why=why,
            role=place.role,
            model_sha256=place.sha256,
            effects=place.effects,
            since_utc_ns=place.since_utc_ns,
            comparison=comparison if comparison is not None else place.verdict,
            level_um=self.state.level_um if self.state.exchange else None,
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
        """Decide what follows from a diagnosis; a candidate is then warmed up (`prefer`)."""
        state = self.state
        running, state.diagnosis = state.diagnosis, None
        if running is None:
            return []
        why = why_nothing(state, self._settings, found, now_ns)
        if not why:
            state.diagnosis = msgspec.structs.replace(running, candidate_sha256=found.candidate_sha256, found=found)
        return [nothing_follows(why, found)] if why else []

    def prefer(self, beside: ComparisonData | None) -> list[Note]:
        """Decide whether what is warmed up gets its place before the next sample.

        Parameters
        ----------
        beside : ComparisonData, optional
            It, compared with its rival as the present model (`place.rival_of`, `Newcomer.beside`).
        """
        state, rival, running = self.state, rival_of(self.state, self._settings), self.state.diagnosis
        if running is None or running.found is None or running.is_next or state.exchange:
            return []
        found = running.found
        if rival is None:
            said = [begins(found)]
        elif beside is None:
            return []  # a recording that lacks the figures
        elif keeps_place(rival, beside, self._settings):
            state.diagnosis = None
            why = BESIDE[2 if is_asked(rival, self._settings) else 1]
            return [nothing_follows(why, found, beside, is_proposed=rival.is_proposed)]
        elif rival.is_proposed:
            said = self._withdraw(rival, replaced(found, beside), why=BESIDE[0], comparison=beside)
            said.append(begins(found))
        else:
            said = [begins(found, beside, why=BESIDE[0])]
        state.diagnosis = msgspec.structs.replace(running, is_next=True)
        return said

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
        """Begin to compare what a diagnosis has found, whose error on the record is given where it is known."""
        state, before = self.state, self.state.candidate
        place = Place(sha256=sha256, effects=list(effects), role=role, since_utc_ns=now_ns)
        place.error = error if error is not None else ErrorBlocks()
        if before is not None and takes_over(state, role, effects):
            place.comparison, place.verdict = before.comparison, before.verdict
            Comparison(self._period_s, place.comparison).go_on_with(now_ns)
        state.found, state.diagnosis = place, None

    def exchanged(self, now_ns: int, sha256_before: str) -> PlaceName | None:
        """Go on after a model in shadow has replaced the present one, whose hash was `sha256_before`.

        Returns
        -------
        str or None
            The place of the model that was replaced; None if it is gone.
        """
        state, name, back = self.state, self.state.incoming, self.state.exchange == "back"
        incoming = state.place(name)
        assert incoming is not None
        before, state.effects, state.exchange = state.effects, incoming.effects, ""
        state.error.clear()
        state.put(name, None)
        if state.diagnosis is not None and state.diagnosis.candidate_sha256:
            state.diagnosis = None  # a candidate that is warmed up was weighed beside the model that has gone
        if back:
            longest_h = self._settings.watch_h
            avoid_after_back(state, before, now_ns, first_h=ADOPTION_H, longest_h=longest_h)
            state.watched = None
            if state.found is not None and not self._is_of_use(state.found, incoming, now_ns):
                state.found = None
            self._compare_anew(state.found, now_ns)
            return None
        state.adopted_utc_ns = now_ns
        outgoing = place_of_outgoing(state, before, incoming.effects)
        state.put(outgoing, Place(sha256=sha256_before, effects=before, role="before", since_utc_ns=now_ns))
        self._compare_anew(state.watched, now_ns)
        return outgoing

    def _is_of_use(self, found: Place, present: Place, now_ns: int) -> bool:
        """Return whether what is in shadow can still replace the present model after a way back."""
        return found.sha256 != present.sha256 and not is_avoided(self.state, found.effects, now_ns)

    def _compare_anew(self, place: Place | None, now_ns: int) -> None:
        """Compare a model with another present one from now on."""
        if place is not None:
            place.begin_anew()
            place.since_utc_ns, place.is_proposed = now_ns, False

    def accept(self, sha256: str = "") -> list[Note]:
        """Adopt the candidate before the next sample: an operator has agreed.

        Parameters
        ----------
        sha256 : str
            Hash of the candidate that is meant; empty: whichever there is.

        Raises
        ------
        ServiceError
            If there is none, or another one.
        """
        candidate = self._meant(sha256, "adopt --candidate")
        if self.state.exchange:
            return []
        self._exchange("adopt", "found", candidate)
        text = f"an operator adopts the candidate: {_named(candidate)}; {described(candidate.verdict)}"
        return [self._note(candidate, LoopAction.ADOPT, text, why="by_hand")]

    def dismiss(self, now_ns: int, sha256: str = "") -> list[Note]:
        """End a candidate: an operator has refused it. Its effects are avoided for some time.

        Raises
        ------
        ServiceError
            As `accept`.
        """
        candidate = self._meant(sha256, "dismiss")
        if self.state.exchange:
            return []
        avoid(self.state, candidate.effects, now_ns, self._settings.watch_h)
        return self._end("found", "dismissed")

    def _meant(self, sha256: str, command: str) -> Place:
        """Return the candidate that an operator's answer is about."""
        candidate = self.state.candidate
        if candidate is None:
            raise ServiceError(f"{command}: there is no candidate now; see `compensator watch`")
        if sha256 and candidate.sha256 != sha256:
            raise ServiceError(
                f"{command}: candidate {sha256[:12]} has given its place to {_named(candidate)}; "
                "see `compensator watch`"
            )
        return candidate

    def model_changed(self, effects: Sequence[str], now_ns: int, *, back: bool = False) -> list[Note]:
        """Begin anew: an operator has changed the model; a diagnosis under way is of no use."""
        state = self.state
        if back:
            avoid(state, state.effects, now_ns, self._settings.watch_h)
        state.effects = list(effects)
        state.error.clear()
        return self.give_up("by_hand", "a person has changed the model or the configuration")

    def give_up(self, why: str, text: str) -> list[Note]:
        """End everything that is in shadow, and a diagnosis, for a cause outside of the loop."""
        self.state.diagnosis = None
        return [note for name in self.state.taken for note in self._end(name, why, text)]

    def give_up_one(self, sha256: str, why: str, text: str) -> list[Note]:
        """End a diagnosis, and the shadow with this hash if there is one, for a cause outside of the loop."""
        self.state.diagnosis = None
        names = [name for name, place in self.state.taken.items() if place.sha256 == sha256]
        return [note for name in names for note in self._end(name, why, text)]

    def restarted(self) -> list[Note]:
        """Go on after the service was away: a diagnosis that was interrupted is begun once more."""
        return begin_again(self.state)


def _named(place: Place) -> str:
    return f"{place.sha256[:12]} with {named(place.effects)}"
