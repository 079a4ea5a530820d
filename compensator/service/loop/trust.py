"""Which samples may be diagnosed, and may judge a model.

Left out is what shows a fault by itself: a missing temperature, sensors that contradict each other, an offset that is
held by hand or by an internal error.

A residual alarm does not say whether a sensor or the model is wrong: to a check that knows one model, most effects that
the model lacks look like a sensor that drifts. It is a reason to diagnose, which tells the two apart. Two models are
compared unless a sensor is suspected under both, and nothing is decided while one is under every model: a fault of a
sensor stays under all of them, an effect that only one of them has does not.
"""

from __future__ import annotations

from collections.abc import Sequence

from compensator.codes import Reason
from compensator.events import Implausibility
from compensator.service.outcome import Outcome
from compensator.service.transfer.second_opinion import sensor_suspected

_CONTRADICTED = (Reason.T_Q_AT_EXCHANGED, Reason.T_Q_AT_APART)
_LOST = (Reason.T_Q_MISSING, Reason.AT_MISSING)
_FAULTS = (Reason.OPERATOR_HOLD, Reason.INTERNAL_ERROR, *_CONTRADICTED)
_DISTURBED = (*_LOST, *_FAULTS)
_ALARMS = (Reason.IMPLAUSIBLE, Reason.RESIDUAL_TOO_LARGE)
_LIMITS = (Reason.OUTSIDE_VALIDITY, Reason.OFFSET_LIMITED, Reason.CORRECTION_LIMITED)


def is_disturbed(reasons: Sequence[str]) -> bool:
    """Return whether a sample with these reasons shows a fault by itself."""
    return any(reason.startswith(_DISTURBED) for reason in reasons)


def is_lost(reasons: Sequence[str]) -> bool:
    """Return whether a sample lacks a temperature, and no channel is suspected: a line loses a reading now and then."""
    is_missing = any(reason.startswith(_LOST) for reason in reasons)
    return is_missing and not any(reason.startswith((Reason.SUSPECT_CHANNEL, *_FAULTS)) for reason in reasons)


def is_contradicted(reasons: Sequence[str]) -> bool:
    """Return whether T_Q and AT contradict each other: they have done so for a while when it shows."""
    return any(reason in _CONTRADICTED for reason in reasons)


def is_alarmed(reasons: Sequence[str]) -> bool:
    """Return whether measured and predicted Y diverge."""
    return any(reason.startswith(_ALARMS) for reason in reasons)


def is_limited(outcome: Outcome) -> bool:
    """Return whether a model has reached a limit."""
    return any(reason.startswith(_LIMITS) for reason in outcome.offset.reasons)


def suspicions(*outcomes: Outcome) -> list[str]:
    """Return for what reasons a sensor is suspected under models that processed a sample, each once."""
    reasons = (reason for outcome in outcomes for reason in outcome.offset.reasons)
    return list(dict.fromkeys(one for one in reasons if one.startswith((*_ALARMS, *_CONTRADICTED))))


def was_wrong(outcome: Outcome) -> bool:
    """Return whether a sample has shown that a temperature was wrong before anything suspected it."""
    return any(note.data.get("code") == Implausibility.WAS_WRONG for note in outcome.notes)


def all_suspect_a_sensor(outcomes: Sequence[Outcome]) -> bool:
    """Return whether a sensor, and not the model, is suspected under every model that processed a sample."""
    return all(
        sensor_suspected(one.offset.reasons) or Reason.RESIDUAL_TOO_LARGE in one.offset.reasons for one in outcomes
    )
