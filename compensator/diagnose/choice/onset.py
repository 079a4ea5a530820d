"""An effect that began within the record: it is looked for in the time since then.

No effect has an onset of its own, so one that began on the third day explains no whole record: a source that no channel
shows, or another channel, takes its place. Where the base model was right until some time and errs since, and the whole
of the record is not explained well, the search is done once more with measured Y of the time since. T_Q, AT and the
channels of the time before still set the state. What that finds is taken if it leaves clearly less of the held-out
samples since then, and all that it names can be deployed. So is a drift of the measurement in the place of names that
would be deployed: a channel that went the same way once must not be taken for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Vector, rms_of
from compensator.codes import ModelWarning, Remark
from compensator.data.runs import Run
from compensator.diagnose.choice.deployment import SHORT_H
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.choice.outcome import Diagnosis
from compensator.diagnose.fitting.prediction import FOLDS
from compensator.diagnose.residual.change import BLOCK_MIN, changed_at
from compensator.model.effects.passing import Periodic

#: A record is explained well if no more than this part of its error is left on held-out data.
WELL_EXPLAINED = 0.25
#: The time since then must leave less than this part of what all data leave of it.
BETTER_PART = 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class Onset:
    """The time since an effect began.

    Parameters
    ----------
    run : Run
        The data, without measured Y of the time before.
    since_h : float
        When that time begins, h after the start of the data.
    remark : Remark
        When, and by how much the model errs otherwise.
    """

    run: Run
    since_h: float
    remark: Remark


def onset_in(found: Diagnosis) -> Onset | None:
    """Return the time since an effect began, where all of the data are not explained well; None elsewhere.

    Behind a gap the zero and the state are unknown, which looks like an onset: data with one are searched as they are.
    """
    evidence = found.evidence
    if evidence.is_sparse or evidence.free_paths or len(evidence.runs) > 1 or _is_of_measurement(found):
        return None
    if left_part(found) <= WELL_EXPLAINED:
        return None
    (run,) = evidence.runs
    error = np.where(evidence.used, evidence.residual, np.nan)
    at_s = changed_at(run.t_s, error, found.noise_floor_um, from_quiet=True)
    if at_s is None:
        return None
    # It began at any time of a block, which would look like a step.
    since = run.t_s >= at_s + 60.0 * BLOCK_MIN
    if evidence.model.period_s * np.sum(evidence.used & since) < 3600.0 * SHORT_H:
        return None
    before_um, after_um = float(np.nanstd(error[run.t_s < at_s])), float(np.nanstd(error[since]))
    since_h = float(run.t_s[since][0]) / 3600.0
    text = (
        f"Something began {since_h:.1f} h after the start: the model's error varies by {after_um:.2f} µm rms since and "
        f"by {before_um:.2f} before. Only Y measured since then was searched."
    )
    return Onset(run=run.without_y(~since), since_h=since_h, remark=Remark(ModelWarning.BEGAN_WITHIN, text))


def explains_better(later: Diagnosis, all_data: Diagnosis) -> bool:
    """Return whether the time since an effect began explains itself better than all of the data explain it.

    By what each leaves of its samples where they were held out, about their mean in each block of that time.
    """
    blocks = list(later.evidence.blocks(FOLDS))

    def left_um(held_out: Vector) -> float:
        parts = [part for block in blocks if (part := held_out[block & np.isfinite(held_out)]).size]
        return rms_of(np.concatenate([part - np.mean(part) for part in parts])) if parts else math.inf

    if later.effects and all(map(_moves_y, later.effects)):
        if not any(effect.deployable for effect in all_data.effects):
            return False
        foretold = later.held_out_named
    elif _deploys(later) and all(_acts(effect) and effect.is_determined for effect in later.effects):
        foretold = later.held_out_after
    else:
        return False
    of_all = all_data.held_out_after if _deploys(all_data) else later.held_out_before
    return left_um(foretold) < BETTER_PART * min(left_um(of_all), left_um(later.held_out_before))


def _deploys(found: Diagnosis) -> bool:
    """Return whether the model is extended."""
    return len(found.model.effects) > len(found.evidence.model.effects)


def _moves_y(effect: FoundEffect) -> bool:
    """Return whether measured Y moves by itself; a period that has come once or twice looks like anything slow."""
    return effect.effect.of_measurement and not isinstance(effect.effect, Periodic)


def _acts(effect: FoundEffect) -> bool:
    """Return whether an effect of the machine is deployed, or a remainder in its place."""
    return effect.effect.deployable and not effect.left_in


def _is_of_measurement(found: Diagnosis) -> bool:
    """Return whether errors of the measurement explain all of it."""
    return found.verdict == "explained" and not any(effect.effect.deployable for effect in found.effects)


def left_part(found: Diagnosis) -> float:
    """Return which part of the error on held-out data a diagnosis leaves; infinite if nothing is deployed."""
    if found.shows_nothing:
        return 0.0
    if not _deploys(found):
        return math.inf
    before_um, after_um, floor_um = found.before.rms_um, found.after.rms_um, found.noise_floor_um
    if not before_um > floor_um:
        return 1.0
    return math.sqrt(max(after_um**2 - floor_um**2, 0.0) / (before_um**2 - floor_um**2))
