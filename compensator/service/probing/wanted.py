"""Whether, by when and why a probe is wanted: the standard deviation against the tolerance set by the operator."""

from __future__ import annotations

import math
from dataclasses import dataclass

from compensator.clock import NS
from compensator.codes import ProbeCode
from compensator.model.correction import ProbeCorrection
from compensator.service.probing.state import ProbingState

#: How far ahead the next probe is foreseen, min.
_AHEAD_MIN = 1440.0

#: From this probability on that a probe which was taken was wrong, another one is wanted.
_DOUBTED = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """Whether, by when and why a probe is wanted; see `messages.Status`."""

    is_wanted: bool
    by_ns: int | None
    why: str
    std_um: float
    tolerance_um: float | None


def wanted_after(
    state: ProbingState, correction: ProbeCorrection, y_std_um: float, tolerance_um: float | None
) -> Wanted:
    """Return whether a probe is wanted after the last sample.

    Parameters
    ----------
    state : ProbingState
        The last samples, and whether the last probe was refused.
    correction : ProbeCorrection
        What the probes have shown.
    y_std_um : float
        Standard deviation of the prediction, µm.
    tolerance_um : float, optional
        The tolerance, µm; without it only the first probe and the one after a refused or doubtful one are wanted.
    """
    samples = state.samples
    if not samples or math.isnan(samples[-1].offset_um) or samples[-1].is_held:
        # A probe could not be used now.
        return Wanted(is_wanted=False, by_ns=None, why="", std_um=y_std_um, tolerance_um=tolerance_um)
    why: str = ""
    if state.refused:
        why = state.refused
    elif not correction.is_probed:
        why = ProbeCode.FIRST
    elif _is_doubted(correction, samples[-1].contributions_um):
        why = ProbeCode.DOUBTED
    elif tolerance_um is not None and y_std_um > tolerance_um:
        why = ProbeCode.DEVIATION
    by_ns = samples[-1].time_ns if why else _exceeded_ns(state, correction, y_std_um, tolerance_um)
    return Wanted(is_wanted=bool(why), by_ns=by_ns, why=why, std_um=y_std_um, tolerance_um=tolerance_um)


def _is_doubted(correction: ProbeCorrection, contributions_um: tuple[float, ...]) -> bool:
    """Return whether the doubt of a probe that was taken is most of what is not known now.

    A doubt that later probes cannot decide, because both hypotheses say the same by now, asks for none.
    """
    doubted_um = correction.doubted_um(contributions_um)
    return correction.doubt > _DOUBTED and 2.0 * doubted_um**2 > correction.std_um(contributions_um) ** 2


def _exceeded_ns(
    state: ProbingState, correction: ProbeCorrection, y_std_um: float, tolerance_um: float | None
) -> int | None:
    """Return when the standard deviation will exceed the tolerance; None if not within a day."""
    if tolerance_um is None:
        return None
    last = state.samples[-1]
    growth = correction.growth_um2_per_min(last.contributions_um)
    if growth <= 0.0:
        return None
    minutes = max(tolerance_um**2 - y_std_um**2, 0.0) / growth
    return last.time_ns + round(minutes * 60.0 * NS) if minutes <= _AHEAD_MIN else None
