"""Channels that are not searched: without values for some time, copies of others, counts, measurements of Y itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.codes import DataRemark, Remark
from compensator.data.runs import Run, noise_std
from compensator.data.screening import LIVELY_STILL
from compensator.model.effects.hypothesis import DEGC

#: A displacement or tilt is an effect, never a cause: another probe follows Y whatever moves it.
DISPLACEMENT = ("_um", "_urad")
#: Correlation of the noise of a channel with that of Y above which it measures Y, and the least number of samples. Of
#: temperatures, speeds and loads of the measured spindle and of every eighth drawn development machine it is at most
#: 0.22, of the spindle's probes beside each other 0.47 to 0.95, but for two pairs that tilt apart (0.25 to 0.34).
SAME_NOISE, LEAST = 0.4, 300
#: Second differences of more than so many times the noise are of steps, which a cause shares with Y, and do not count;
#: a sample later, less than this share of the correlation of noise is left.
QUIET, SHARP = 3.0, 0.3
#: A channel is Y times a constant where it differs from it by so many times the noise of both, and moves by so many.
ALIKE, MOVES = 2.0, 30.0
#: Two columns with at least so many values each are the same measurement where one is the other times a constant to
#: within half a digit of both; what takes as many and only ever rises may be a count.
DISTINCT, SAME = 20, 1e-9
#: A count differs from a straight line over time by no more than this share of its span, standard deviation.
STEADY = 0.05
#: Units of what rises by itself or is commanded, and is no count.
_NO_COUNTS = (DEGC, "_k", "_rpm", "_pct", "_w", "_kw", "_lpm", "_bar", "_a", "_v", "_hz")
#: Values are the same to so many digits after the point: T_Q is stored as its difference from AT.
_DIGITS = 9


def no_causes(name: str, runs: Sequence[Run]) -> dict[str, Remark]:
    """Return the channels that are not searched by name, each with a remark: no causes of Y, or missing for hours.

    Parameters
    ----------
    name : str
        Name of the data, for the remarks.
    runs : sequence of Run
        Measured data.
    """
    found: dict[str, Remark] = {}
    every = dict.fromkeys(channel for run in runs for channel in run.channels)
    y = [run.y_um for run in runs]
    roles = {"t_q_degc": [run.t_q_degc for run in runs], "at_degc": [run.at_degc for run in runs]}
    first = {np.round(np.concatenate(parts), _DIGITS).tobytes(): role for role, parts in roles.items()}
    for channel in (one for one in every if not one.endswith(DISPLACEMENT)):
        parts = [run.channels.get(channel, np.full(run.t_s.size, np.nan)) for run in runs]
        values = np.concatenate(parts)
        missing_h = float(np.sum(np.isnan(values))) * runs[0].period_s / 3600.0
        if np.isnan(values).all():
            found[channel] = Remark(DataRemark.COLUMN_EMPTY, f"{name}: {channel} has no value.")
        elif missing_h > 0.0:
            words = f"{name}: {channel} is missing for {missing_h:.1f} h; not searched."
            found[channel] = Remark(DataRemark.COLUMN_MISSING, words)
        elif np.ptp(values) > 0.0:
            other = first.setdefault(np.round(values, _DIGITS).tobytes(), channel)
            if other != channel:
                words = f"{name}: {channel} has the values of {other} in every row; {other} alone is searched."
                found[channel] = Remark(DataRemark.COLUMN_COPY, words)
            elif counts(channel, parts):
                words = f"{name}: {channel} rises steadily and never falls: taken for a count; log its rate."
                found[channel] = Remark(DataRemark.COLUMN_COUNTS, words)
            elif measures_y(parts, y, is_temperature=channel.endswith(DEGC)):
                words = f"{name}: {channel} follows y_um without delay: a second measurement of Y, not a cause."
                found[channel] = Remark(DataRemark.FOLLOWS_Y, words)
    return found


def counts(name: str, channel: Sequence[Vector]) -> bool:
    """Whether a channel seems to count something, such as rows, parts, hours or energy.

    It takes many values, never falls and rises steadily: what it says is how late it is, and a drift of Y that is
    called by its name goes on for ever. A temperature may do so as long as a record lasts, and what is commanded too.
    """
    if name.endswith(_NO_COUNTS) or np.unique(np.concatenate(list(channel))).size < DISTINCT:
        return False

    def is_steady(part: Vector) -> bool:
        times = np.arange(part.size)
        left = part - np.polyval(np.polyfit(times, part, 1), times)
        return bool(np.all(np.diff(part) >= 0.0)) and float(np.std(left)) <= STEADY * float(np.ptp(part))

    return all(is_steady(part) for part in channel if part.size > 1)


def measures_y(channel: Sequence[Vector], y: Sequence[Vector], *, is_temperature: bool) -> bool:
    """Whether a channel measures Y: it has the noise of Y, or is Y times a constant to within the noise of both.

    Whatever noise it has, it measures Y where it is Y times a constant to the digit. Heat moves no temperature from one
    sample to the next as noise moves a probe, so what a channel shares with Y there is Y. A temperature may be
    proportional to Y; what is commanded has no noise.

    Parameters
    ----------
    channel, y : sequence of numpy.ndarray
        A channel and Y of each run; NaN where missing.
    is_temperature : bool
        Whether the name of the channel says that it is one.
    """
    both = [np.column_stack([u, v])[np.isfinite(u) & np.isfinite(v)] for u, v in zip(channel, y, strict=True)]
    table = np.concatenate(both)
    if not is_temperature and _is_a_multiple(*table.T):
        return True
    steps = np.diff(table[:, 0])
    if len(table) < LEAST or not np.ptp(table, axis=0).all() or float(np.mean(steps == 0.0)) > LIVELY_STILL:
        return False
    if _noise_correlation(np.concatenate([np.diff(part, 2, axis=0) for part in both])) > SAME_NOISE:
        return True
    u, v = table.T
    gain, level = np.polyfit(v, u, 1)
    noise = float(np.hypot(noise_std(u), gain * noise_std(v)))
    left = float(np.std(u - gain * v - level))
    return not is_temperature and 0.0 < left < ALIKE * noise and float(np.ptp(u)) > MOVES * noise


def _is_a_multiple(u: Vector, v: Vector) -> bool:
    """Return whether one column is the other times a constant and a level, to within half a digit of both."""
    values = [np.unique(one) for one in (u, v)]
    if min(one.size for one in values) < DISTINCT:
        return False
    digit_u, digit_v = (float(np.min(np.diff(one))) for one in values)
    gain, level = np.polyfit(v, u, 1)
    digits = 0.51 * (digit_u + abs(float(gain)) * digit_v)
    return float(np.max(np.abs(u - gain * v - level))) <= max(digits, SAME * float(np.ptp(u)))


def _noise_correlation(second: Matrix) -> float:
    """Return the correlation of two columns of second differences at no delay; 0 where it is one of smooth signals.

    Two smooth signals resemble each other a sample later as well, noise does not.
    """
    noise = np.median(np.abs(second), axis=0) / 0.6745  # of normal noise
    quiet = np.all(np.abs(second) < QUIET * noise, axis=1)
    if np.count_nonzero(quiet) < LEAST:
        return 0.0
    known = np.where(quiet[:, None], second, np.nan)
    u, v = ((known - np.nanmean(known, axis=0)) / np.nanstd(known, axis=0)).T
    now, beside = float(np.nanmean(u * v)), float(np.nanmean(u[1:] * v[:-1]) + np.nanmean(u[:-1] * v[1:])) / 2.0
    return abs(now) if beside * np.sign(now) < SHARP * abs(now) else 0.0
