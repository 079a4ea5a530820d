"""What a candidate must show beside the present model before it is proposed or adopted."""

from __future__ import annotations

import math

from compensator.config import LoopSettings
from compensator.events import ComparisonData, ComparisonVerdict

#: A candidate must be wrong by less than this part of what the present model is wrong by.
BETTER_PART = 0.95
#: A candidate whose level nothing else shows must be wrong by less than this part about the zero of a displacement
#: sensor: a level of its own that is as wrong as the present one's gives a few percent by chance. Probes correct both.
LEVEL_PART = 0.8
#: One that adds nothing at rest, about a zero at rest, must be no more wrong about it than the present one; where
#: measured Y has moved by itself, which may hide the error of either, than so many times as much.
MOVED_PART = 2.0
#: Of what it leaves about that zero less than this part of what the present model does is its own misfit. The level of
#: the present model is nearer than its own by far if it leaves less than this part.
OWN_PART = 0.5
#: What diagnoses have found runs in so many places at once. The diagnoses of simulated weeks name two or three
#: explanations by turns; each costs processor time, and what the others must show (`shared`).
CANDIDATES = 3
#: A model that leaves less than this part of the present one's error about the zero is right, and that one is not.
ALONE_PART = 0.1
#: The service does not go back where the present model is wrong about the zero by less than this part.
_BACK_PART = 0.5


def shared(deviations: float, candidates: int) -> float:
    """Return by how many standard deviations one of so many candidates in shadow must refute the present model.

    If that is right, the likelihood ratio L of each has the expectation 1, and so has the mean of those that run
    together, whatever they have in common: it ever exceeds e^(deviations² / 2) as rarely as L of a single one does
    (`evidence`), and before that no L exceeds their number times as much. Candidates that come one after another share
    nothing: each is a case of its own, and so is one that is alone again. The bound holds for what is remembered.

    Examples
    --------
    >>> [round(shared(4.0, candidates), 2) for candidates in (1, 2, 3)]
    [4.0, 4.17, 4.27]
    """
    return math.sqrt(deviations**2 + 2.0 * math.log(candidates))


def is_enough(found: ComparisonData, settings: LoopSettings, *, judged_h: float, compared_h: float) -> bool:
    """Return whether there is enough to judge a candidate by that has been compared for so long, h."""
    if compared_h < settings.shadow_h:
        return False
    if found.measured_by == "probe":
        return found.probes >= settings.probes and found.hours >= settings.shadow_h
    return judged_h >= settings.shadow_h


def is_clearly_better(found: ComparisonData) -> bool:
    """Return whether measured Y changes clearly as the candidate predicts."""
    return found.verdict == ComparisonVerdict.BETTER and found.ratio is not None and found.ratio <= BETTER_PART


def is_better_about_zero(found: ComparisonData, part: float) -> bool:
    """Return whether the candidate is better about the zero, too: its level does not contradict measured Y."""
    if found.present_rms_um is None or found.candidate_rms_um is None:
        return False
    return found.candidate_rms_um <= part * found.present_rms_um


def is_better_to_go_back_to(found: ComparisonData) -> bool:
    """Return whether a model before is better: by the changes, and the zero does not speak strongly against it."""
    if found.verdict != ComparisonVerdict.BETTER or found.present_rms_um is None or found.candidate_rms_um is None:
        return False
    return found.present_rms_um >= _BACK_PART * found.candidate_rms_um
