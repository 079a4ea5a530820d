"""The loop: decides when to diagnose, what runs in shadow, and which model comes next.

    idle → diagnosis → shadow → proposed → adopted → watching the model before → idle

Other models run in shadow: a few that diagnoses have found, and the model before the last adoption, each compared with
the present one. One of them replaces it once measured Y after its beginning shows clearly that it is better: adopting
and going back are one rule. No clock, socket or file: a replay of the recorded samples and diagnoses decides the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from compensator.clock import HOUR_NS, NS
from compensator.config import LoopSettings
from compensator.diagnose.residual.change import BLOCK_MIN
from compensator.errors import ServiceError
from compensator.events import DiagnosisData, LoopAction, Note
from compensator.service.loop.avoided import avoid
from compensator.service.loop.choice import Choice
from compensator.service.loop.compared import Compared
from compensator.service.loop.ending import FAILED_OUTSIDE, end, end_diagnosis, note_of, withdraw
from compensator.service.loop.exchanging import decide_exchange, exchanged
from compensator.service.loop.level import ErrorBlocks, channels_at_zero, is_constant
from compensator.service.loop.place import (
    falls,
    gives_way,
    is_asked,
    role_of,
    why_nothing,
    with_effects,
)
from compensator.service.loop.schedule import begin_again, begin_if_due, count_misfit, pass_planned
from compensator.service.loop.state import InShadow, LoopState, Role, Running, same_effects
from compensator.service.loop.trust import (
    all_suspect_a_sensor,
    is_contradicted,
    is_disturbed,
    is_limited,
    is_lost,
    suspicions,
    was_wrong,
)
from compensator.service.loop.words import begins, named, nothing_follows, surpassed, wait_over, waits
from compensator.service.outcome import Outcome, sets_zero
from compensator.service.transfer.second_opinion import described

#: No decision before no sensor has been suspected for so long, no diagnosis before none has shown a fault by itself;
#: and a candidate ends that has been at a limit for so long, min.
CLEAN_MIN = BLOCK_MIN
#: A diagnosis sees whether measured Y has moved where this part of its record lies before that time, and after it.
_SEEN = 0.25


class LoopDecisions:
    """Decides about the models of one machine.

    Parameters
    ----------
    settings : config.LoopSettings
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
        self.state = state if state is not None else LoopState(base_effects=list(effects))
        self.state.effects = list(effects)

    @property
    def wanted(self) -> Running | None:
        """The diagnosis that is under way, to be begun or begun again; None if there is none."""
        running = self.state.diagnosis
        return None if running is None or running.candidate_sha256 else running

    def compared(self, place: InShadow) -> Compared:
        """Return what is compared of a model in shadow and the present one."""
        state = self.state
        alike = sum(one.role == place.role for one in state.taken)
        has_moved = state.y_moved_ns > 0
        return Compared(
            place,
            self._settings,
            self._period_s,
            state.error,
            alike=max(alike, 1),
            y_moved=has_moved,
            zero_channels=state.zero_channels,
            same=same_effects(place.effects, state.effects),
        )

    def pause(self, samples: int | None) -> None:
        """Account for samples that were not measured; None: it is not known how many, and they count as none."""
        self.state.missing += samples or 0

    # ------------------------------------------------------------------ one sample

    def step(self, present: Outcome, others: Mapping[str, Outcome]) -> list[Note]:
        """Process a sample.

        Parameters
        ----------
        present : Outcome
            Of the present model, with the compared probes alone.
        others : mapping of str to Outcome
            Those of the models in shadow, by hash.

        Returns
        -------
        list of Note
            The decisions, each with the figures on which it rests.
        """
        state, now_ns, reasons = self.state, present.sample.time_utc_ns, present.offset.reasons
        minutes, contradicted = self._period_s / 60.0, is_contradicted(reasons)
        record_ns = round(self._settings.record_h * HOUR_NS)
        state.follow_clock(now_ns, round(self._period_s * NS), record_ns)
        all_suspect = bool(others) and all_suspect_a_sensor([present, *others.values()])
        suspected = contradicted or (all_suspect and not any(is_constant(place.error.blocks) for place in state.taken))
        state.usable_min = _counted(state.usable_min, present, minutes, suspected=False)
        state.clean_min = _counted(state.clean_min, present, minutes, suspected=suspected)
        count_misfit(state, present, minutes, oldest_ns=now_ns - record_ns)
        state.error.update(present)
        if sets_zero(present):
            state.zero_utc_ns, state.y_moved_ns, state.zero_channels = now_ns, 0, channels_at_zero(present)
            state.level_um = 0.0  # that of a decided exchange is one about the zero before
        notes = self._forget_wrong() if was_wrong(present) else []
        notes += self._wait(present, others, is_suspected=suspected)
        judged: list[InShadow] = []
        for place in state.taken:
            compared, other = self.compared(place), others[place.sha256]
            beyond = is_limited(other) and not is_limited(present)
            place.limited_min = place.limited_min + minutes if beyond else 0.0
            # A newcomer that no sensor speaks against says nothing of two older models that both suspect one. Where a
            # model leaves a constant for hours, Y was shifted: its changes are judged, and no sensor falsifies them.
            is_suspected = all_suspect_a_sensor([present, other]) and not is_constant(place.error.blocks)
            if not (contradicted or is_suspected):
                judged += [place] if compared.add(present, other) else []
            elif compared.add_suspected(other, suspicions(present, other)) and place.is_proposed and not state.exchange:
                notes += withdraw(self.state, place, "a sensor is suspected, so what was compared does not count")
        for place in state.taken:
            # Until what is warmed up has its place, before the next sample, nothing that was found decides.
            if not state.exchange and (place is state.watched or not state.has_next):
                notes += self._decide(place, now_ns, is_judged=place in judged)
        judged = [place for place in judged if place in state.taken]
        if judged and not (state.exchange or state.clean_min < CLEAN_MIN):
            notes += self._choose(judged, now_ns)
        return notes + self._schedule(now_ns)

    def _forget_wrong(self) -> list[Note]:
        """Let go what was found and compared while a temperature was wrong, and nobody knew."""
        state, notes = self.state, end_diagnosis(self.state, "was_wrong")
        for place in state.found:
            if not same_effects(place.effects, state.base_effects):
                notes += end(state, place, "was_wrong")
        for place in state.taken:
            place.begin_anew()
        return notes

    def _wait(self, present: Outcome, others: Mapping[str, Outcome], *, is_suspected: bool) -> list[Note]:
        """Say that nothing is compared because all models suspect a sensor, once for `shadow_h`, and when it is over.

        It is over when decisions are made again: a suspicion that comes and goes lets nothing be compared either.
        """
        state, before_min, longest_min = self.state, self.state.uncompared_min, 60.0 * self._settings.shadow_h
        if others and (is_suspected or (before_min and state.clean_min < CLEAN_MIN)):
            state.uncompared_ns = state.uncompared_ns or present.sample.time_utc_ns
            state.uncompared_min += self._period_s / 60.0 if is_suspected else 0.0
            is_said = before_min <= longest_min < state.uncompared_min
            return [waits(state.uncompared_ns, suspicions(present, *others.values()))] if is_said else []
        notes = [wait_over(state.uncompared_ns, is_compared=bool(others))] if before_min > longest_min else []
        state.uncompared_min, state.uncompared_ns = 0.0, 0
        return notes

    # ------------------------------------------------------------------ decisions about a shadow

    def _decide(self, place: InShadow, now_ns: int, *, is_judged: bool) -> list[Note]:
        """Decide about one model: whether it ends, or a proposal falls; the model before ends by its time only."""
        was_found = place is not self.state.watched
        if was_found and place.limited_min >= CLEAN_MIN:
            return end(self.state, place, "limits")
        if now_ns - place.since_utc_ns >= self._settings.watch_h * HOUR_NS:
            unshown = "no_answer" if place.is_proposed else "no_difference"
            return end(self.state, place, unshown if was_found else "watched")
        if not was_found or self.state.clean_min < CLEAN_MIN or not is_judged:
            return []
        if self.compared(place).is_worse:
            return end(self.state, place, "worse")
        if place.is_proposed and falls(place.verdict, self._settings):
            return withdraw(self.state, place, described(place.verdict))
        return []

    def _choose(self, judged: Sequence[InShadow], now_ns: int) -> list[Note]:
        """Go back, adopt or propose, after new verdicts: nothing else changes what is chosen."""
        choice = Choice(self.state, self._settings, self.compared)
        before = choice.gone_back_to(judged)
        if before is not None:
            return self._go_back(before)
        if self.state.has_next:
            return []
        better = choice.better(judged, now_ns)
        adopted = choice.adopted(better, now_ns)
        if adopted is not None:
            return self._adopt(adopted)
        proposed = choice.proposed(better)
        return self._propose(proposed, choice) if proposed is not None else []

    def _adopt(self, place: InShadow) -> list[Note]:
        notes = decide_exchange(self.state, "adopt", place, self.compared)
        text = f"a better model is adopted: {self._what(place)}; {described(place.verdict)}"
        if self.state.level_um:
            kept = self.state.level_um == place.kept_level_um
            to = "what the present model subtracts at the zero" if kept else "that of measured Y"
            text += f"; its level is shifted by {self.state.level_um:+.1f} µm, to {to}"
        return [*notes, note_of(self.state, place, LoopAction.ADOPT, text)]

    def _propose(self, place: InShadow, choice: Choice) -> list[Note]:
        """Propose a candidate, in the place of one that is proposed already."""
        notes, before = [], self.state.proposed
        if before is not None:
            beside = choice.beside(place, before)
            notes = withdraw(self.state, before, surpassed(place.effects, beside), why="surpassed", comparison=beside)
        place.is_proposed = True
        text = f"a better model is proposed: {self._what(place)}; {described(place.verdict)}"
        if self.compared(place).level_um is None:
            text += "; its level is not confirmed: set a zero, and adopt it then"
        return [*notes, note_of(self.state, place, LoopAction.PROPOSE, text)]

    def _what(self, place: InShadow) -> str:
        """Return what a candidate is, in words."""
        is_known = same_effects(place.effects, self.state.effects)
        return f"{_named(place)}{', newer parameters of the present effects' if is_known else ''}"

    def _go_back(self, place: InShadow) -> list[Note]:
        ended = [one for one in self.state.effects if one not in place.effects]
        to = "the model before" if place is self.state.watched else f"the model without {named(ended)}"
        which = "which alone is right about the zero" if self.compared(place).is_alone_right else "which is better"
        text = f"back to {to}, {which}: {_named(place)}; {described(place.verdict)}"
        notes = decide_exchange(self.state, "back", place, self.compared)
        return [*notes, note_of(self.state, place, LoopAction.BACK, text)]

    # ------------------------------------------------------------------ diagnoses

    def _schedule(self, now_ns: int) -> list[Note]:
        """Begin a diagnosis if it is time, and nothing speaks against it."""
        state = self.state
        planned_ns = pass_planned(state, self._settings, now_ns)
        if state.diagnosis is not None or state.exchange or state.usable_min < CLEAN_MIN:
            return []
        return begin_if_due(state, self._settings, now_ns, planned_ns)

    def receive(self, found: DiagnosisData, now_ns: int, *, is_current: bool = True) -> list[Note]:
        """Decide what follows from a diagnosis; a candidate is then warmed up, and begins.

        Nothing does where it is not of the present model any longer (`is_current`).
        """
        state, running = self.state, self.state.diagnosis
        if running is None or running.candidate_sha256:
            return []  # what another one has found is warmed up, or begins
        state.diagnosis = None
        if not found.without:  # nothing was diagnosed then
            self._judge_y(found, running)
        why = why_nothing(state, self._settings, found, now_ns) if is_current else "replaced"
        if not why:
            state.diagnosis = msgspec.structs.replace(running, candidate_sha256=found.candidate_sha256, found=found)
        return [nothing_follows(why, found)] if why else []

    def _judge_y(self, found: DiagnosisData, running: Running) -> None:
        """Remember that measured Y has moved by itself, until a diagnosis that sees the time finds that it has not.

        Where an effect begins in a record, it may look like a step or a drift of Y until there is more of it. What had
        moved before the last zero is in that zero.
        """
        seen_ns, moved_ns = round(_SEEN * self._settings.record_h * HOUR_NS), self.state.y_moved_ns
        if found.y_moved_utc_ns > self.state.zero_utc_ns:
            self.state.y_moved_ns = min(found.y_moved_utc_ns, running.to_utc_ns)
        elif found.verdict != "failed" and running.from_utc_ns + seen_ns <= moved_ns <= running.to_utc_ns - seen_ns:
            self.state.y_moved_ns = 0

    def begin(self) -> list[Note]:
        """Say that what is warmed up gets a place before the next sample, and what gives its own for it; or nothing.

        Nothing follows where a person is asked about the same effects meanwhile.
        """
        state, running = self.state, self.state.diagnosis
        if running is None or running.found is None or running.is_next or state.exchange:
            return []
        found = running.found
        before = with_effects(state, role_of(found), found.effects)
        if before is not None and is_asked(before, self._settings):
            state.diagnosis = None
            return [nothing_follows("in_shadow", found)]
        is_another = before is None and role_of(found) == "candidate"
        last = gives_way(state, self._settings, state.time_utc_ns or running.to_utc_ns) if is_another else None
        notes = end(self.state, last, "gives_way") if last is not None else []
        state.diagnosis = msgspec.structs.replace(running, is_next=True)
        return [*notes, begins(found)]

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
        state, before = self.state, with_effects(self.state, role, effects)
        place = InShadow(sha256=sha256, effects=list(effects), role=role, since_utc_ns=now_ns)
        place.error = error if error is not None else ErrorBlocks()
        if state.diagnosis is not None and state.diagnosis.found is not None:
            place.off_at_zero = state.diagnosis.found.off_at_zero
        if before is not None:
            self.compared(place).go_on_with(before, now_ns)
            place.is_proposed = before.is_proposed  # a person is asked for the same: a zero
            state.remove(before)
        state.found, state.diagnosis = [*state.found, place], None

    def exchanged(self, now_ns: int, sha256_before: str) -> list[Note]:
        """Go on after a model in shadow has replaced the present one; see `exchanging.exchanged`."""
        return exchanged(self.state, self._settings, now_ns, sha256_before, self.compared)

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
        candidate = self.meant(sha256)
        if self.state.exchange:
            return []
        notes = decide_exchange(self.state, "adopt", candidate, self.compared)
        text = f"an operator adopts the candidate: {_named(candidate)}; {described(candidate.verdict)}"
        return [*notes, note_of(self.state, candidate, LoopAction.ADOPT, text, why="by_hand")]

    def dismiss(self, now_ns: int, sha256: str = "") -> list[Note]:
        """End a candidate: an operator has refused it. Its effects are avoided for some time.

        Raises
        ------
        ServiceError
            As `accept`.
        """
        candidate = self.meant(sha256)
        if self.state.exchange:
            return []
        avoid(self.state, candidate.effects, now_ns, self._settings.watch_h)
        running, notes = self.state.diagnosis, end(self.state, candidate, "dismissed")
        found = running.found if running is not None else None
        if found is not None and same_effects(found.effects, candidate.effects):
            notes += end_diagnosis(self.state, "dismissed")  # newer parameters of them are refused, too
        return notes

    def meant(self, sha256: str = "") -> InShadow:
        """Return the candidate that an operator's answer is about, by the beginning of its hash; empty: the first one.

        Raises
        ------
        ServiceError
            If there is none, or another one.
        """
        first = self.state.candidate
        if first is None:
            raise ServiceError("there is no candidate now; see `compensator watch`")
        meant = [place for place in self.state.candidates if place.sha256.startswith(sha256)] if sha256 else [first]
        if not meant:
            raise ServiceError(
                f"candidate {sha256[:12]} has given its place; now there is {_named(first)}; see `compensator watch`"
            )
        if len(meant) > 1:
            raise ServiceError(f"{len(meant)} candidates begin with {sha256}; expected more digits of the hash")
        return meant[0]

    def model_changed(
        self, effects: Sequence[str], now_ns: int, *, calibrated: Sequence[str], back: bool = False
    ) -> list[Note]:
        """Begin anew: an operator has changed the model; a diagnosis under way is of no use.

        Parameters
        ----------
        effects, calibrated : sequence of str
            Effects of the present model, and of the calibrated one.
        now_ns : int
            Time, ns since 1970 UTC.
        back : bool
            Whether the operator has gone back from the effects before.
        """
        state = self.state
        if back and state.effects:
            avoid(state, state.effects, now_ns, self._settings.watch_h)
        state.effects, state.base_effects = list(effects), list(calibrated)
        state.forget_errors()
        notes = self.give_up("by_hand", "a person has changed the model or the configuration")
        state.forget_left_out()
        return notes

    def give_up(self, why: str, text: str) -> list[Note]:
        """End everything that is in shadow, and a diagnosis, for a cause outside of the loop."""
        notes = [note for place in self.state.taken for note in end(self.state, place, why, text)]
        return notes + end_diagnosis(self.state, why, text)

    def give_up_one(self, sha256: str, text: str) -> list[Note]:
        """End a diagnosis, and the shadow with this hash if there is one, for a cause outside of the loop."""
        place = self.state.place(sha256)
        notes = end(self.state, place, FAILED_OUTSIDE, text) if place is not None else []
        return notes + end_diagnosis(self.state, FAILED_OUTSIDE, text)

    def restarted(self) -> list[Note]:
        """Go on after the service was away: a diagnosis that was interrupted is begun once more."""
        return begin_again(self.state)


def _named(place: InShadow) -> str:
    return f"{place.sha256[:12]} with {named(place.effects)}"


def _counted(before_min: float, present: Outcome, minutes: float, *, suspected: bool) -> float:
    """Return the time without a suspicion up to `CLEAN_MIN`, min.

    A lost sample takes back what a good one gives: where a line loses one reading in twenty, there are hardly ever
    thirty minutes without a loss, while a couple that is broken for so long leaves nothing. A state that is not known
    is no fault of a sensor: nothing is compared then, but a diagnosis starts from a state of its own.
    """
    reasons = present.offset.reasons
    if not suspected and is_lost(reasons):
        return max(before_min - minutes, 0.0)
    if suspected or is_disturbed(reasons):
        return 0.0
    return min(before_min + minutes, CLEAN_MIN)
