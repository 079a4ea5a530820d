"""One place beside the present model: what is compared, whether the other model is better, and at which level."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from compensator.arrays import rms_of
from compensator.clock import HOUR_NS
from compensator.codes import Reason
from compensator.config import LoopSettings
from compensator.diagnose.residual.change import QUIET
from compensator.events import ComparisonData, ComparisonVerdict, NotJudged
from compensator.messages import number
from compensator.service.loop.level import ErrorBlocks, level_um
from compensator.service.loop.place import remembered_h
from compensator.service.loop.proof import (
    ALONE_PART,
    BETTER_PART,
    LEVEL_PART,
    MOVED_PART,
    OWN_PART,
    is_better_about_zero,
    is_better_to_go_back_to,
    is_clearly_better,
    is_enough,
    shared,
)
from compensator.service.loop.state import NO_VERDICT, InShadow
from compensator.service.loop.trust import is_disturbed
from compensator.service.outcome import Outcome, sets_zero
from compensator.service.transfer.beside import beside
from compensator.service.transfer.second_opinion import is_unusable
from compensator.service.transfer.two_models import FEWEST_CHANGES, Comparison, changed


class Compared:
    """The model of a place and the present one.

    Parameters
    ----------
    place : InShadow
        The place; its comparison and verdict are kept up to date.
    settings : config.LoopSettings
        `[loop]`.
    period_s : float
        Length of a sample, s.
    present_error : ErrorBlocks
        Errors of the present model.
    alike : int
        Number of models in shadow with its role: they share the chance to be found better by accident.
    y_moved : bool
        Whether measured Y has moved by itself since the last zero: what is about the zero then shows no level.
    zero_channels : list of str, optional
        Channels that read 0 at the last zero; None where that was none at rest.
    same : bool
        Whether the present model has the same effects: what begins then is none of them, and shows no level of theirs.
    """

    def __init__(
        self,
        place: InShadow,
        settings: LoopSettings,
        period_s: float,
        present_error: ErrorBlocks,
        *,
        alike: int = 1,
        y_moved: bool = False,
        zero_channels: Sequence[str] | None = None,
        same: bool = False,
    ) -> None:
        self._place, self._settings, self._present_error = place, settings, present_error
        self._alike, self._y_moved, self._same, self._zero_channels = alike, y_moved, same, zero_channels
        self._period_s, self._comparison = period_s, Comparison(period_s, place.comparison)

    @property
    def judged_h(self) -> float:
        """Time of the usable blocks of measured Y, h."""
        return self._comparison.judged_h

    def add(self, present: Outcome, other: Outcome) -> bool:
        """Add a sample, unless it must not judge; return whether the verdict was made anew."""
        self._place.error.update(other)
        kept_um = number(other.estimate.y_base_um) - number(present.estimate.y_base_um)
        self._place.kept_level_um = kept_um if math.isfinite(kept_um) else 0.0
        found = self._comparison
        if self._place.verdict.why == NotJudged.SUSPECT:
            self._place.verdict = NO_VERDICT  # no longer
        if sets_zero(present):
            found.set_zero()
        reasons = [*present.offset.reasons, *other.offset.reasons]
        # A channel that only the model in force needs is no reason to stay with it.
        missing = any(reason.startswith(Reason.CHANNEL_MISSING) for reason in other.offset.reasons)
        if missing or is_unusable(present, other) or is_disturbed(reasons):
            return False
        if not found.add(present, other, suspected=False):
            return False
        hours = remembered_h(self._settings, self._place.role)
        oldest_ns = present.sample.time_utc_ns - round(hours * HOUR_NS)
        found.forget_before(oldest_ns, 2 * self._settings.probes)
        self.judge()
        return True

    def judge(self) -> None:
        """Make the verdict anew.

        One that has taken over is judged by all values or, once they judge, by its own alone, whichever show more. So
        it is one case more by itself.
        """
        place, has_taken_over = self._place, bool(self._place.comparison.model_ns)
        wanted = shared(self._settings.deviations, self._alike + has_taken_over)
        place.verdict = self._comparison.verdict(deviations=wanted)
        if place.role == "before" and place.verdict.verdict != ComparisonVerdict.BETTER:
            # Where an effect has ended, what was compared before says nothing.
            latest = self._comparison.latest(deviations=wanted)
            place.verdict = latest if latest and latest.verdict == ComparisonVerdict.BETTER else place.verdict
        if has_taken_over:
            own = self._comparison.of_itself().verdict(deviations=wanted)
            shows_more = own.deviations is not None and own.deviations > place.shows
            place.verdict = own if shows_more else place.verdict
        if place.verdict.why == NotJudged.NO_Y:
            place.verdict = changed(place.verdict, why=NotJudged.NOT_YET)  # Y may be there: nothing of it counts yet

    def add_suspected(self, other: Outcome, suspects: Sequence[str] = ()) -> bool:
        """Begin anew, and return whether something was compared: the sensor was wrong before it was suspected."""
        place = self._place
        place.error.update(other)
        was_compared = bool(place.comparison.first_ns)
        if was_compared:
            place.begin_anew()
        place.verdict = changed(NO_VERDICT, why=NotJudged.SUSPECT, remark=", ".join(suspects))
        return was_compared

    def is_better(self, now_ns: int) -> bool:
        """Return whether a candidate has shown enough, and in its own hours, too.

        Newer parameters of the present effects have, if they alone are right about the zero: nearly a constant, which
        the present ones leave, is shown by no change.
        """
        place = self._place
        compared_h = (now_ns - place.since_utc_ns) / HOUR_NS
        enough = is_enough(place.verdict, self._settings, judged_h=self.judged_h, compared_h=compared_h)
        if enough and self._same and not self._y_moved and self._is_alone_near_zero:
            return True
        return enough and is_clearly_better(place.verdict) and self._is_itself_better

    def is_better_to_go_back_to(self, *, is_new: bool) -> bool:
        """Return whether a way back is better, and in its own hours, too.

        Parameters
        ----------
        is_new : bool
            Whether it is not the model before the last adoption: it has fewer effects, or older parameters of the
            present ones. What it leaves about the zero then counts at the level of its return, unless it is the
            calibrated model, whose own level is right.
        """
        found, residuals_um = self._place.verdict, self._comparison.residuals_um
        if self.is_alone_right:
            return True
        if is_new and self._place.effects and residuals_um:
            left_um = [other - self.level_at_return_um for _, _, other in residuals_um]
            found = changed(found, candidate_rms_um=math.hypot(*left_um) / math.sqrt(len(left_um)))
        return is_better_to_go_back_to(found) and self._is_itself_better

    @property
    def is_alone_right(self) -> bool:
        """Whether only the other model is right about the zero, for hours in which its changes are no worse.

        Where an effect has ended on a machine at rest, nothing changes any longer. That measured Y had moved by itself
        to where the other model happens to be right is as unlikely as its error is small beside that of the present.
        Where the present model has been as wrong all the time, nothing has ended: it is the level that is wrong.
        """
        if not self._is_alone_near_zero:
            return False
        residuals_um = self._comparison.residuals_um
        own_um = rms_of(np.array(residuals_um).T[1])
        before = [mean for block, mean in self._present_error.blocks if block < residuals_um[0][0]]
        return len(before) < FEWEST_CHANGES or sum(abs(mean) < QUIET * own_um for mean in before) >= FEWEST_CHANGES

    @property
    def _is_alone_near_zero(self) -> bool:
        """Whether only the other model is right about the zero, and its changes are no worse."""
        shown, own_um = self._place.verdict.deviations, self._own_level_um
        is_no_worse = shown is None or shown >= 0.0
        return is_no_worse and self._left_um(own_um) > 0.0 and self._is_better_at(own_um, ALONE_PART)

    @property
    def _is_itself_better(self) -> bool:
        return not self._place.comparison.model_ns or self._comparison.is_itself_better()

    @property
    def is_worse(self) -> bool:
        """Whether the other model is worse, and in its own hours, too: one that took over has to be judged by them."""
        place = self._place
        if place.verdict.verdict != ComparisonVerdict.WORSE:
            return False
        return not place.comparison.model_ns or self._comparison.of_itself().verdict().deviations is not None

    @property
    def shown_level_um(self) -> float | None:
        """The level of the other model that measured Y shows, µm; None if it shows none (`level`)."""
        if self._same:
            return None
        since_ns = self._place.level_utc_ns or self._place.since_utc_ns
        return level_um(self._present_error.blocks, self._place.error.blocks, since_ns=since_ns)

    def go_on_with(self, before: InShadow, now_ns: int) -> None:
        """Take over what a candidate with the same effects has shown.

        Also of its level: hours that it did not know have shown it, and if the errors of this one stay in them, too,
        the two predictions differ by a constant, so they show the level of both. Where only one of them stays, or
        neither, the level is judged anew.
        """
        place, shown = self._place, Compared(before, self._settings, self._period_s, self._present_error)
        place.comparison, place.verdict = before.comparison, before.verdict
        self._comparison = Comparison(self._period_s, place.comparison)
        self._comparison.go_on_with(now_ns)
        place.level_utc_ns = before.level_utc_ns or before.since_utc_ns
        if shown.shown_level_um is None or self.shown_level_um is None:
            place.level_utc_ns = 0
        place.error.go_on_after(before.error)

    def beside(self, rival: InShadow) -> ComparisonData:
        """Compare the model with another one in shadow, as if that were the present one, on the hours of both."""
        state = beside(rival.comparison, self._place.comparison)
        return Comparison(self._period_s, state).verdict(deviations=self._settings.deviations)

    def go_on_beside(self, present: InShadow, level_um: float) -> None:
        """Go on after another model in shadow, raised by so much, has become the present one: the hours of both count.

        Nothing is proposed any longer.
        """
        place = self._place
        place.is_proposed, place.level_utc_ns = False, 0
        place.comparison = beside(present.comparison, place.comparison, level_um=level_um)
        self._comparison = Comparison(self._period_s, place.comparison)
        self.judge()

    @property
    def level_um(self) -> float | None:
        """By how much a candidate's level is raised at its adoption, µm; None if its level is not known.

        What adds nothing on a machine at rest has the level of a zero at rest, unless measured Y contradicts it and has
        not moved by itself. What little it leaves about that zero is its own misfit, whose level measured Y shows.
        Where measured Y does not show it, the candidate must be better about the zero, too, and not by little, at one
        of its own levels (`_own_level_um`); what measured Y shows is taken where that is clearly nearer. A level that
        contradicts measured Y counts from a zero that was set before its effect acted, or measured Y has moved; which
        of them is seen at the next zero. Where a mount creeps, being better about the zero is no sign of a right level:
        what follows the mount is better, too.
        """
        verdict, off = self._place.verdict, self._place.off_at_zero
        is_probed = verdict.measured_by == "probe"
        is_off = off is not None and self._zero_channels is not None and set(off) <= set(self._zero_channels)
        # Newer parameters must be clearly nearer than the present ones, which have that level, too.
        if is_off and not (is_probed or self._same or is_better_about_zero(verdict, OWN_PART)):
            return 0.0 if is_better_about_zero(verdict, MOVED_PART if self._y_moved else 1.0) else None
        shown_um = self.shown_level_um
        part = BETTER_PART if is_probed else LEVEL_PART
        # What creeps beside probes both models are corrected for, and few values often look like a drift.
        shows_level = is_probed or not self._y_moved
        if not shows_level:
            return shown_um
        own_um = self._own_level_um
        is_right = self._is_better_at(own_um, part) if own_um else is_better_about_zero(verdict, part)
        is_nearer = shown_um is not None and self._left_um(shown_um) <= LEVEL_PART * self._left_um(own_um)
        return own_um if is_right and not is_nearer else shown_um

    @property
    def _own_level_um(self) -> float:
        """The level at which the other model counts from the last zero, µm.

        What acted at a zero on a warm machine is in measured Y there, and what the model predicts then is subtracted,
        which is no level. What began later is not: where that is nearer to measured Y by far, what the present model
        predicts there is subtracted. By little it is nearer by chance, for each model has an error of its own there.
        """
        kept_um = self._place.kept_level_um
        return kept_um if self._left_um(kept_um) < OWN_PART * self._left_um(0.0) else 0.0

    def _left_um(self, level_um: float) -> float:
        """Return what the other model leaves about the last zero if it is raised by so much, as the root of a sum."""
        return math.hypot(*(other - level_um for _, _, other in self._comparison.residuals_um))

    def _is_better_at(self, level_um: float, part: float) -> bool:
        """Return whether the other model, raised by so much, is better about the last zero."""
        own_um = [own for _, own, _ in self._comparison.residuals_um]
        return len(own_um) >= FEWEST_CHANGES and self._left_um(level_um) <= part * math.hypot(*own_um)

    @property
    def unknown_level_um(self) -> float:
        """By how much it is raised where its level is not known, µm: only its changes are new."""
        return self._comparison.level_um if self._place.verdict.y_moved else 0.0

    @property
    def level_at_return_um(self) -> float:
        """By how much a model that the service goes back to is raised, µm.

        Its level is that of the zero, as if the other one had never been adopted: it is raised to the present level
        only where that is clearly nearer to measured Y, too.
        """
        raised_um = self.unknown_level_um
        own_um = self._own_level_um
        return raised_um if self._left_um(raised_um) <= LEVEL_PART * self._left_um(own_um) else own_um

    @property
    def level_at_adoption_um(self) -> float:
        """By how much it is raised if it is adopted now, whoever decides it, µm."""
        known_um = self.level_um
        return known_um if known_um is not None else self.unknown_level_um
