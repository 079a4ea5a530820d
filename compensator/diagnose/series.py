"""The curves of a diagnosis as columns, so that anybody can plot them again."""

from __future__ import annotations

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.outcome import Diagnosis


def series_of(diagnosis: Diagnosis) -> dict[str, Vector]:
    """Return the curves by name, each of shape (n,), one row for each sample; NaN where Y is missing or not searched.

    `run` counts from 1, `t_s` is the time in it. `residual_…` are of the fit to all data, `held_out_…` of searches that
    did not see the sample, `effect_1_um` is what the first effect adds to Y (0 where it is left in), `remainder_um`
    what the remainder adds to all of them and `paths_um` what paths do that were fitted anew (where there are any).
    Then come the channels of the effects.
    """
    evidence = diagnosis.evidence
    sizes = [run.t_s.size for run in evidence.runs]
    columns = {
        "run": np.repeat(np.arange(1.0, len(sizes) + 1.0), sizes),
        "t_s": np.concatenate([run.t_s for run in evidence.runs]),
        "y_um": evidence.y_um,
        "residual_before_um": diagnosis.residual_before,
        "residual_after_um": diagnosis.residual_after,
        "held_out_before_um": diagnosis.held_out_before,
        "held_out_named_um": diagnosis.held_out_named,
        "held_out_after_um": diagnosis.held_out_after,
        "t_q_degc": np.concatenate([run.t_q_degc for run in evidence.runs]),
        "at_degc": np.concatenate([run.at_degc for run in evidence.runs]),
    }
    for i, effect in enumerate(diagnosis.effects, start=1):
        columns[f"effect_{i}_um"] = effect.removed
    beside = {"remainder_um": diagnosis.remainder_um, "paths_um": diagnosis.paths_um}
    columns |= {name: values for name, values in beside.items() if values.any()}
    for name in dict.fromkeys(channel for effect in diagnosis.effects for channel in effect.channels):
        if all(name in run.channels for run in evidence.runs):
            columns[name] = np.concatenate([run.channels[name] for run in evidence.runs])
    return columns
