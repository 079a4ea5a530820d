"""An effect that began within the record: it is looked for in the time since then.

No effect has a beginning of its own, so one that began on the third day explains no whole record: a source that no
channel shows, or another channel, takes its place. Where the base model was right until some time and errs since, and
the whole of the record is not explained well, the search is done once more with measured Y of the time since. T_Q, AT
and the channels of the time before still set the state. What that finds is taken if it leaves clearly less of its own
held-out blocks, and all of it can be deployed.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from compensator.codes import ModelWarning, Remark
from compensator.data.runs import Run
from compensator.diagnose.change import BLOCK_MIN, changed_at
from compensator.diagnose.deployment import SHORT_H
from compensator.diagnose.outcome import Diagnosis

#: The model was right before if its error varied by less than this part of what it has varied by since.
QUIET = 0.5
#: A record is explained well if no more than this part of its error is left on held-out data.
WELL_EXPLAINED = 0.25
#: The time since then must leave less than this part of what the whole does.
CLEARLY_BETTER = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Began:
    """The time since an effect began.

    Parameters
    ----------
    runs : tuple of Run
        The data, without measured Y of the time before.
    since_h : float
        When that time begins, h after the start of the data.
    remark : Remark
        When, and by how much the model errs otherwise.
    """

    runs: tuple[Run, ...]
    since_h: float
    remark: Remark


def began_within(found: Diagnosis) -> Began | None:
    """Return the time since an effect began, where the whole of a recording is not explained well; None elsewhere."""
    evidence = found.evidence
    is_explained = found.verdict == "explained" and not any(effect.deployable for effect in found.effects)
    is_of_one = len({run.recording for run in evidence.runs}) == 1
    if evidence.is_sparse or evidence.free_paths or not is_of_one or is_explained or left_part(found) <= WELL_EXPLAINED:
        return None
    period_s = evidence.model.period_s
    t_s = period_s * np.arange(evidence.used.size, dtype=np.float64)
    error = np.where(evidence.used, evidence.residual, np.nan)
    at_s = changed_at(t_s, error, found.noise_floor_um, quiet=QUIET)
    if at_s is None or t_s[-1] - at_s < 3600.0 * SHORT_H:
        return None
    # It began at any time of a block, which would look like a step.
    since = t_s >= at_s + 60.0 * BLOCK_MIN
    before_um, after_um = float(np.nanstd(error[~since])), float(np.nanstd(error[since]))
    times_s = np.concatenate([run.t_s for run in evidence.runs])
    since_h = float(times_s[since][0] - times_s[0]) / 3600.0
    runs = [
        dataclasses.replace(run, y_um=np.where(since[part], run.y_um, np.nan))
        for run, part in zip(evidence.runs, evidence.samples_of_runs(), strict=True)
        if since[part].any()
    ]
    text = (
        f"Something began {since_h:.1f} h after the start: the model's error varies by {after_um:.2f} µm rms "
        f"since, and by {before_um:.2f} before. What is named was looked for in measured Y of the time since."
    )
    return Began(runs=tuple(runs), since_h=since_h, remark=Remark(ModelWarning.BEGAN_WITHIN, text))


def explains_better(later: Diagnosis, whole: Diagnosis) -> bool:
    """Return whether the time since an effect began explains itself clearly better than the whole of the data does."""
    is_deployed = all(effect.deployable for effect in later.effects)
    return is_deployed and bool(later.effects) and left_part(later) < CLEARLY_BETTER * min(left_part(whole), 1.0)


def left_part(found: Diagnosis) -> float:
    """Return which part of the error on held-out data a diagnosis leaves; infinite if nothing is deployed."""
    if found.shows_nothing:
        return 0.0
    before_um, after_um, floor_um = found.before.rms_um, found.after.rms_um, found.noise_floor_um
    if len(found.model.effects) == len(found.evidence.model.effects):
        return math.inf
    if not before_um > floor_um:
        return 1.0
    return math.sqrt(max(after_um**2 - floor_um**2, 0.0) / (before_um**2 - floor_um**2))
