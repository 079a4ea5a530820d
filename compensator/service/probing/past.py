"""The last samples: what was predicted at the time of a probe, and which offset was published then.

A probe is a point in time. A sample is a mean of polls, and its prediction belongs to the middle of them. At its end
its offset is published, which is then followed with its rate (`compensator.receiver`): a probe shows what this offset
leaves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from compensator.clock import NS
from compensator.service.probing.state import PastSample

#: Two samples further apart than this many periods have a gap between them.
_GAP = 1.5
#: A receiver follows the rate for this many periods, and holds the offset after twice as many.
_FOLLOWED = 1.25


@dataclass(frozen=True, slots=True)
class Predicted:
    """Prediction at the time of a probe: by the model alone, µm, its shares, and its standard deviation."""

    y_um: float
    contributions_um: tuple[float, ...]
    noise_um: float


def predicted_at(samples: Sequence[PastSample], time_ns: int, period_s: float) -> Predicted | None:
    """Return what the model predicted for a time; None if there is no prediction for it."""
    period_ns = round(period_s * NS)
    after = next((i for i, sample in enumerate(samples) if sample.middle_ns > time_ns), len(samples))
    if after == 0:
        return None
    before = samples[after - 1]
    later = samples[after] if after < len(samples) else None
    has_gap = later is not None and later.time_ns - before.time_ns > _GAP * period_ns
    if later is not None and not has_gap:
        part = (time_ns - before.middle_ns) / (later.middle_ns - before.middle_ns)
        pairs = zip(before.contributions_um, later.contributions_um, strict=True)
        return Predicted(
            before.y_um + part * (later.y_um - before.y_um),
            tuple(then + part * (now - then) for then, now in pairs),
            max(before.noise_um, later.noise_um),
        )
    if time_ns - before.time_ns > (1.0 if has_gap else _GAP) * period_ns:
        return None
    ahead_ns = time_ns - before.middle_ns
    return Predicted(
        before.y_um + before.rate_um_per_min * ahead_ns / (60.0 * NS), before.contributions_um, before.noise_um
    )


def published_at(samples: Sequence[PastSample], time_ns: int, period_s: float) -> PastSample | None:
    """Return the sample whose offset the control followed at a time; None if there is none, or it had expired."""
    found = _published_until(samples, time_ns)
    return found[-1] if found and time_ns - found[-1].time_ns <= 2.0 * _FOLLOWED * period_s * NS else None


def offsets_at(samples: Sequence[PastSample], time_ns: int, period_s: float) -> tuple[float, float]:
    """Return the smallest and the largest offset that a control may have applied at a time, µm.

    A control follows the rate or only the offset, receives it some time after the end of the sample, and moves at its
    own permitted rate: it is between the last two.
    """
    values = []
    for sample in _published_until(samples, time_ns)[-2:]:
        minutes = min((time_ns - sample.time_ns) / NS, _FOLLOWED * period_s) / 60.0
        values += [sample.offset_um, sample.offset_um + sample.offset_rate_um_per_min * minutes]
    return min(values), max(values)


def _published_until(samples: Sequence[PastSample], time_ns: int) -> list[PastSample]:
    return [sample for sample in samples if sample.time_ns <= time_ns and not math.isnan(sample.offset_um)]
