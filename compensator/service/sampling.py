"""From single readings to the sample of a channel: robust mean, extremes, spread, count, quality."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import numpy as np

from compensator.arrays import Vector
from compensator.messages import ChannelSample
from drivers.reading import Quality, Reading

#: A reading farther from the median than this many robust standard deviations is left out.
OUTLIER_SIGMA = 6.0
#: Median absolute deviation of a normal distribution, as a part of its standard deviation.
_MAD_OF_SIGMA = 0.6745


class ChannelCollector:
    """Collects the readings of one channel over one sample.

    Parameters
    ----------
    min_good_fraction : float
        Part of the polls that must have given a good reading for the mean to count.
    """

    def __init__(self, min_good_fraction: float) -> None:
        self._min_good_fraction = min_good_fraction
        self._readings: list[Reading] = []
        self._errors: Counter[str] = Counter()
        self._polls = 0

    def add(self, reading: Reading | None, error: str | None = None) -> None:
        """Take the result of one poll: a reading, or the code of the error."""
        self._polls += 1
        if reading is not None and reading.quality is Quality.GOOD and math.isfinite(reading.value):
            self._readings.append(reading)
        elif reading is not None:
            self._errors[str(reading.quality)] += 1
        else:
            self._errors[error or "device_error"] += 1

    def close(self) -> ChannelSample:
        """Make the sample of what was collected and start the next one."""
        readings, errors, polls = self._readings, self._errors, self._polls
        self._readings, self._errors, self._polls = [], Counter(), 0
        kept, outliers = _without_outliers(readings)
        if outliers:
            errors["outlier"] += outliers
        enough = len(kept) >= max(1, math.ceil(self._min_good_fraction * polls))
        quality = "good" if enough else _worst(errors)
        values = [reading.value for reading in kept]
        mean = math.fsum(values) / len(values) if values else math.nan
        spread = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / len(values)) if values else math.nan
        return ChannelSample(
            mean=mean if enough else math.nan,
            min=min((r.minimum for r in kept), default=math.nan),
            max=max((r.maximum for r in kept), default=math.nan),
            spread=spread,
            count=len(kept),
            polls=polls,
            quality=quality,
            device_quality=quality,
            errors=dict(sorted(errors.items())),
        )


def _without_outliers(readings: list[Reading]) -> tuple[list[Reading], int]:
    """Leave single wild readings out; a slope over the minute is not wild."""
    if len(readings) < 5:
        return readings, 0
    values = np.array([reading.value for reading in readings])
    distance = np.abs(values - np.median(values))
    sigma = float(np.median(distance)) / _MAD_OF_SIGMA
    if sigma == 0.0:
        # Quantised and quiet: more than half are equal, and the step is the smallest distance there is.
        steps = distance[distance > 0.0]
        sigma = float(steps.min()) if steps.size > 1 else math.inf if _near(values) else 0.0
    kept = [reading for reading, d in zip(readings, distance, strict=True) if d <= OUTLIER_SIGMA * sigma]
    return kept, len(readings) - len(kept)


def _near(values: Vector) -> bool:
    """Tell whether one deviating reading among equal ones is a converter step rather than wild."""
    return bool(np.ptp(values) <= 1e-3 * max(1.0, abs(float(np.median(values)))))


def _worst(errors: Mapping[str, int]) -> str:
    """Name the most frequent cause."""
    causes = {code: n for code, n in errors.items() if code != "outlier"}
    return max(sorted(causes), key=lambda code: causes[code]) if causes else "too_few"
