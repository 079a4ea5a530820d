"""The loop as `thermal/status` shows it."""

from __future__ import annotations

from collections.abc import Sequence

from compensator.messages import Candidate, LoopStatus
from compensator.service.loop.core import ShadowedLoop
from compensator.service.loop.state import NO_VERDICT
from compensator.service.loop.words import named
from compensator.service.transfer.second_opinion import described


def loop_status(core: ShadowedLoop, candidates: Sequence[Candidate]) -> LoopStatus:
    """Return what the loop does.

    Parameters
    ----------
    core : ShadowedLoop
        The loop.
    candidates : sequence of Candidate
        Records of the last sample.
    """
    state, shown = core.state, core.state.shown
    verdict = shown.verdict if shown is not None else NO_VERDICT
    predicted = {one.model_sha256: one.y_pred_um for one in candidates}
    before = state.watched if state.watched is not shown else None
    return LoopStatus(
        phase=state.phase,
        diagnosing=state.diagnosis is not None and not state.diagnosis.without,
        model_sha256=shown.sha256 if shown is not None else "",
        effects=shown.effects if shown is not None else [],
        since_utc_ns=shown.since_utc_ns if shown is not None else 0,
        y_pred_um=predicted.get(shown.sha256) if shown is not None else None,
        verdict=verdict.verdict,
        text=described(verdict) if shown is not None else "",
        present_rms_um=verdict.present_rms_um,
        candidate_rms_um=verdict.candidate_rms_um,
        deviations=verdict.deviations,
        hours=core.loop.compared(shown).judged_h if shown is not None else 0.0,
        probes=len(shown.comparison.probes) if shown is not None else 0,
        adopted_utc_ns=state.adopted_utc_ns,
        before_effects=before.effects if before is not None else None,
        before_text=described(before.verdict) if before is not None else "",
        others=[f"{named(one.effects)}: {described(one.verdict)}" for one in state.found if one is not shown],
    )
