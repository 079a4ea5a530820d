"""What of the findings is deployed: effects, a remainder beside them or in their place, or nothing.

The rules stand in their order in `deployment_of`. Two errors decide: that on held-out blocks, and that in free run on
the data that were searched.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import rms_of
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.choice.held_out import HeldOut
from compensator.diagnose.fitting.fit import late_term
from compensator.diagnose.search.findings import Findings, by_channels, in_free_run

#: Nothing is deployed where held-out blocks are predicted worse with it by more than this factor. It is not near 1:
#: each block may hold an event of its own, and the others then know less of an effect, and may name it otherwise. But
#: what leaves more of them than both the base and no compensation foretells nothing.
CONTRADICTS = 2.5
#: Nor where the data that were searched are predicted worse with it in free run by more than this factor.
WORSE = 1.25
#: From few values a remainder is deployed only where it leaves less than this share of the error on held-out ones.
LOWERS = 0.97
#: The same of many values in two cases. Beside a late T_Q a remainder is for the minutes that a dead time hides: they
#: are most of what is left, or something else is (set on 8 drawn machines, where less than this made the fresh run no
#: better, and on 2 of another simulator). All channels that take the place of names have nothing but this to show, nor
#: have paths that take the place of those of a calibration on other data.
LOWERS_CLEARLY = 0.75
#: All channels where nothing has a name, or only an error of the measurement, leave less than this many times as much:
#: a drift of a short record, or what the form of one misses, looks like any slow channel.
LOWERS_BY_FAR = 0.6
#: In the place of a source that no channel shows, or of names that are refused, they leave less than this share of the
#: error in free run: where it acts once in each block, held-out blocks refute everything. In less than a day, h,
#: whatever is slow happens once, and held-out blocks must confirm them, too.
SHOWS_HIDDEN, DAY_H = 0.4, 23.0
#: From a record shorter than this, h, a model with an error of its own is extended only by names that leave noise, or
#: that held-out blocks confirm with no parameter smaller than its error.
SHORT_H = 8.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Deployment:
    """What would be deployed, and why it is not.

    Parameters
    ----------
    found : Findings
        Without a remainder that does not help, or with all channels in the place of names that do not.
    effects : tuple of FoundEffect
        Named effects, with whether a remainder takes their place.
    held_out : HeldOut
        Errors on held-out blocks; `whole` is that of what would be deployed.
    contradicted : bool
        Whether held-out blocks are predicted clearly worse with it.
    worse_um : tuple of (float, float), optional
        What is left in free run without and with it, µm rms, where that is worse.
    too_short_h : float, optional
        Length of the record, h, where that is too short for what it explains.
    """

    found: Findings
    effects: tuple[FoundEffect, ...]
    held_out: HeldOut
    contradicted: bool
    worse_um: tuple[float, float] | None
    too_short_h: float | None

    @property
    def reverses_path(self) -> bool:
        """Whether an effect turns the sense of a path, which no machine does."""
        return any(effect.reverses_path for effect in self.effects)

    @property
    def explains_nothing(self) -> bool:
        """Whether paths that were fitted anew are all that was found: a record alone does not show them."""
        found = self.found
        return not found.terms and found.remainder is None and found.refitted is not None

    @property
    def refused(self) -> str:
        """Why nothing is deployed, in words; empty where something is."""
        if self.reverses_path:
            return "a path would act the other way round"
        if self.worse_um is not None:
            return "the model with all that was found is worse in free run over the same data"
        if self.too_short_h is not None:
            return f"{self.too_short_h:.1f} h are too short for what they explain"
        if self.contradicted:
            return "held-out blocks contradict what was found"
        return "paths fitted anew are all that was found" if self.explains_nothing else ""

    @property
    def is_refused(self) -> bool:
        """Whether nothing is deployed."""
        return self.refused != ""

    @property
    def foretold_um(self) -> float:
        """What is left of held-out blocks with what is deployed, µm rms."""
        return rms_of(self.held_out.nothing if self.is_refused else self.held_out.whole)

    def surpasses(self, kept: Deployment) -> bool:
        """Return whether paths fitted anew foretell held-out blocks clearly better than those of the base.

        Than its paths alone, and than all that was found with them (`kept`). A calibration on other data knows more
        than this record, and what is bent to the record has nothing but this to show for it.
        """
        kept_um = min(kept.foretold_um, rms_of(kept.held_out.nothing))
        return not self.is_refused and self.foretold_um < LOWERS_CLEARLY * kept_um


def deployment_of(
    found: Findings, effects: tuple[FoundEffect, ...], held_out: HeldOut, *, contradicts: float = CONTRADICTS
) -> Deployment:
    """Decide what of the findings is deployed.

    Parameters
    ----------
    found : Findings
        Effects and remainder.
    effects : tuple of FoundEffect
        The named effects.
    held_out : HeldOut
        Errors on held-out blocks.
    contradicts : float
        Factor by which these may be larger with what is deployed.
    """
    decided = _decided(*_with_remainder_that_helps(found, effects, held_out), contradicts)
    decided = _by_channels(decided, contradicts) or decided
    if not decided.is_refused:
        return decided
    effects = _not_replaced(decided.effects)
    return dataclasses.replace(
        decided, effects=tuple(dataclasses.replace(effect, refused=decided.refused) for effect in effects)
    )


def _decided(found: Findings, effects: tuple[FoundEffect, ...], held_out: HeldOut, contradicts: float) -> Deployment:
    return Deployment(
        found=found,
        effects=effects,
        held_out=held_out,
        contradicted=_is_contradicted(found, held_out, contradicts),
        worse_um=_worse_in_free_run(found),
        too_short_h=_too_short_h(found, effects, held_out),
    )


def is_adequate(found: Findings, held_out: HeldOut) -> bool:
    """Return whether the base model needs nothing.

    It leaves noise with zero and initial state fitted, and little more on held-out blocks: an initial state that
    takes in most of an effect does not foretell the rest of the record.
    """
    evidence = found.search.evidence
    if found.terms or found.remainder is not None or evidence.free_paths or not found.leaves_noise:
        return False
    return evidence.is_sparse or evidence.noise.is_foretold(rms_of(held_out.nothing))


def _with_remainder_that_helps(
    found: Findings, effects: tuple[FoundEffect, ...], held_out: HeldOut
) -> tuple[Findings, tuple[FoundEffect, ...], HeldOut]:
    """Leave out a remainder that held-out data do not confirm: what explains nothing has to show that it helps."""
    evidence = found.search.evidence
    if not effects and not evidence.free_paths:
        # Nothing has a name: what the searches for the blocks named is not deployed and credits nothing.
        whole = held_out.whole if found.remainder is not None else held_out.nothing
        held_out = dataclasses.replace(held_out, named=held_out.nothing, whole=whole)
    if found.is_own_error and not evidence.free_paths:
        return _as_far_as_confirmed(found, effects, held_out)
    if found.remainder is None or found.is_own_error:
        return found, effects, held_out
    whole_um, named_um, nothing_um = (rms_of(each) for each in (held_out.whole, held_out.named, held_out.nothing))
    if evidence.is_sparse:
        # Few values: chance lowers the error of no remainder by much.
        helps = whole_um < LOWERS * min(named_um, nothing_um)
    elif late_term(found.selection.fit):
        helps = whole_um < LOWERS_CLEARLY * named_um
    elif found.is_of_measurement:
        helps = whole_um < LOWERS_BY_FAR * named_um
    else:
        helps = evidence.free_paths or whole_um <= (named_um if found.deploys_names else min(named_um, nothing_um))
    if helps:
        return found, effects, held_out
    without = dataclasses.replace(held_out, whole=held_out.named)
    return dataclasses.replace(found, remainder=None, deploys_names=True), _not_replaced(effects), without


def _as_far_as_confirmed(
    found: Findings, effects: tuple[FoundEffect, ...], held_out: HeldOut
) -> tuple[Findings, tuple[FoundEffect, ...], HeldOut]:
    """Deploy of the own error the share with which held-out blocks are predicted best: stacking.

    What a short record says of the base's own error may be true of that record only.
    """
    remainder = found.remainder
    assert remainder is not None
    without = held_out.nothing if found.is_own_error_alone else held_out.named
    gained = without - held_out.whole
    known = np.isfinite(gained)
    helped, size = float(without[known] @ gained[known]), float(gained[known] @ gained[known])
    share = min(max(helped / max(size, 1e-30), 0.0), 1.0)
    whole = without - share * gained
    if share > 0.0:
        found = dataclasses.replace(found, remainder=remainder.times(share), confirmed=share)
    elif found.deploys_names:
        found = dataclasses.replace(found, remainder=None, is_own_error=False)
    else:
        # The name was for an own error that held-out blocks do not confirm.
        found, effects, held_out = found.without_names(), (), dataclasses.replace(held_out, named=held_out.nothing)
    return found, effects, dataclasses.replace(held_out, whole=whole)


def _by_channels(decided: Deployment, contradicts: float) -> Deployment | None:
    """Deploy all channels in the place of useless names, of a source, or of none, where the data clearly confirm it."""
    # Paths that were fitted anew would stay, and they are what is contradicted.
    is_refuted = decided.contradicted and not decided.found.search.evidence.free_paths
    useless = is_refuted or decided.found.is_hidden
    found = by_channels(decided.found, names_are_useless=useless)
    if found is None or not _is_confirmed(found, decided, names_are_useless=useless):
        return None
    effects = tuple(dataclasses.replace(effect, replaced=True, left_in=False) for effect in decided.effects)
    held_out = dataclasses.replace(decided.held_out, whole=decided.held_out.ceiling)
    instead = _decided(found, effects, held_out, contradicts)
    return None if instead.is_refused else instead


def _is_confirmed(instead: Findings, decided: Deployment, *, names_are_useless: bool) -> bool:
    """Return whether all channels, in the place of what was found, are confirmed clearly."""
    found, held_out = decided.found, decided.held_out
    base_um, own_um = in_free_run(found)
    if names_are_useless:
        is_shown = in_free_run(instead)[1] < SHOWS_HIDDEN * (base_um if decided.is_refused else min(base_um, own_um))
        if _hours(found) >= DAY_H or not is_shown:
            return is_shown
    whole_um, nothing_um = rms_of(held_out.whole), rms_of(held_out.nothing)
    lowers = LOWERS_CLEARLY if instead.terms else LOWERS_BY_FAR
    if found.corrects_late_t_q and own_um <= base_um:
        # Its correction gains something, and what the channels gain before it must be more by far.
        whole_um *= LOWERS_CLEARLY
    # What is not known, in a record without a block to hold out, confirms nothing.
    return rms_of(held_out.ceiling) <= min(whole_um, lowers * nothing_um)


def _too_short_h(found: Findings, effects: Sequence[FoundEffect], held_out: HeldOut) -> float | None:
    """Return the length of a record, h, that is too short for what would be deployed; None if it is not.

    In the few hours of one warm-up the own error of an approximate model looks like a missing effect, on held-out
    blocks, too, and so does noise where forms are exact; paths are not known from it. Names that leave noise are those
    of what acts; what held-out blocks confirm, with no parameter smaller than its error, is near enough to it.
    """
    evidence, hours = found.search.evidence, _hours(found)
    deploys = found.remainder is not None or any(effect.deployable for effect in effects)
    if hours >= SHORT_H or not deploys or evidence.is_sparse:
        return None
    if not (found.terms and found.deploys_names) or evidence.free_paths:
        return hours
    left = evidence.left(found.named)[evidence.used]
    is_confirmed = rms_of(held_out.whole) < rms_of(held_out.nothing)
    is_known = is_confirmed and not any(effect.hardly_determined for effect in effects)
    return None if is_known or evidence.noise.is_explained(float(left @ left)) else hours


def _hours(found: Findings) -> float:
    """Return the time from the first to the last measured Y of all runs, both samples whole, h."""
    evidence, period_s = found.search.evidence, found.search.evidence.model.period_s
    seen = [run.t_s[evidence.used[part]] for run, part in zip(evidence.runs, evidence.samples_of_runs(), strict=True)]
    return sum(float(np.ptp(t_s)) + period_s for t_s in seen if t_s.size) / 3600.0


def _not_replaced(effects: Sequence[FoundEffect]) -> tuple[FoundEffect, ...]:
    """Return effects in whose place no remainder is deployed."""
    return tuple(dataclasses.replace(effect, replaced=False) for effect in effects)


def _is_contradicted(found: Findings, held_out: HeldOut, contradicts: float) -> bool:
    """Return whether held-out blocks contradict what was found; few values do not decide that."""
    evidence, whole_um, nothing_um = found.search.evidence, rms_of(held_out.whole), rms_of(held_out.nothing)
    # Worse than the base and than no compensation: they foretell nothing.
    is_useless = whole_um >= max(nothing_um, evidence.spread_um)
    return not evidence.is_sparse and (is_useless or whole_um > contradicts * nothing_um)


def _worse_in_free_run(found: Findings) -> tuple[float, float] | None:
    """Return what is left in free run without and with what would be deployed, µm rms, if that is clearly worse.

    With a late T_Q, if it is worse at all: that acts at every change of the heat, so on this record as on others. Where
    noise and the minutes that T_Q hides leave the engine nothing of it, its correction is noise.
    """
    base_um, own_um = in_free_run(found)
    is_late = found.deploys_names and found.corrects_late_t_q
    is_worse = not found.search.evidence.is_sparse and own_um > (1.0 if is_late else WORSE) * base_um
    return (base_um, own_um) if is_worse else None
