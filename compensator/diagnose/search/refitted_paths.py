"""Paths of the base that were fitted anew, as filter banks of a regression: as transfer functions of a model."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from compensator.arrays import Mask, Matrix, Vector
from compensator.model.effects.blocks import Lag
from compensator.model.effects.regression import AMBIENT, DRIVE, Regression
from compensator.model.thermal_model import Path, ThermalModel
from compensator.model.transfer_function import SampledTransferFunction

#: A fitted path has no more lags than this, and fewer where this share of its responses is all that it loses.
PATH_LAGS, PATH_EXACT = 4, 0.003


def with_paths(model: ThermalModel, found: Regression) -> tuple[ThermalModel, Regression | None]:
    """Return a model whose own paths are those of a regression, and what is left of the regression."""
    drive = found.channels.index(DRIVE[model.kind])
    dtf = Path(sampled=_function(found, drive, model.period_s), unit=model.dtf.unit)
    tdtf, gone = model.tdtf, {drive}
    if tdtf is not None and AMBIENT in found.channels:
        ambient = found.channels.index(AMBIENT)
        tdtf = Path(sampled=_function(found, ambient, model.period_s), unit=tdtf.unit)
        gone.add(ambient)
    kept = [i for i in range(len(found.channels)) if i not in gone]
    changed = dataclasses.replace(model, dtf=dtf, tdtf=tdtf, alternatives={}, sha256="")
    if not kept:
        return changed, None
    lags = len(found.taus_min)
    rest = dataclasses.replace(
        found,
        channels=tuple(found.channels[i] for i in kept),
        exponents=tuple(found.exponents[i] for i in kept),
        gains=tuple(found.gains[i] for i in kept),
        std_factor=tuple(tuple(v for i in kept for v in row[i * lags : (i + 1) * lags]) for row in found.std_factor),
    )
    return changed, rest


def with_fewer_lags(gains: Vector, taus_min: Sequence[float], period_min: float, response: Matrix) -> Vector:
    """Return gains of a path's filter bank with as few lags as its response needs.

    With all of them poles lie so close that the observer's covariance has no valid digit. What is left out shows in the
    step response or on the record, where heat and ambient may nearly cancel.

    Parameters
    ----------
    gains : numpy.ndarray, shape (lags,)
        The gain behind each lag.
    taus_min : sequence of float
        The lags, min; 0 is undelayed.
    period_min : float
        Sample period, min.
    response : numpy.ndarray, shape (n, lags)
        The record behind each lag.
    """
    if not np.any(gains):
        return gains
    poles, is_lag = _poles(taus_min, period_min), np.array(taus_min) > 0.0
    count = np.arange(round(3.0 * max(taus_min) / period_min))[:, None]
    steps = np.where(is_lag, 1.0 - poles**count * (1.0 + poles) / 2.0, 1.0)
    sizes = [max(float(np.linalg.norm(each @ gains)), 1e-12) for each in (steps, response)]
    table = np.concatenate([each / size for each, size in zip((steps, response), sizes, strict=True)])
    wanted = table @ gains
    lagged, direct = np.flatnonzero(is_lag).tolist(), np.flatnonzero(~is_lag).tolist()
    square, products = table.T @ table, table.T @ wanted
    kept: tuple[float, tuple[int, ...], Vector] = (np.inf, (), np.zeros(0))
    for size in range(1, min(PATH_LAGS, len(lagged)) + 1):
        for some in itertools.combinations(lagged, size):
            which = (*direct, *some)
            # Lags well below a sample are all the same; solve() would refuse two of them.
            fewer = np.linalg.lstsq(square[np.ix_(which, which)], products[list(which)], rcond=None)[0]
            left = float(np.linalg.norm(wanted - table[:, which] @ fewer))
            kept = min(kept, (left, which, fewer), key=lambda each: each[0])
        if kept[0] <= PATH_EXACT * float(np.linalg.norm(wanted)):
            break
    found = np.zeros(gains.size)
    found[list(kept[1])] = kept[2]
    return found


def _poles(taus_min: Sequence[float], period_min: float) -> Vector:
    return np.array([Lag(tau, period_min).pole if tau > 0.0 else 0.0 for tau in taus_min])


def _function(found: Regression, channel: int, period_s: float) -> SampledTransferFunction:
    """Return a channel's filter bank as one transfer function of the lags that have a gain."""
    gains = np.array(found.gains[channel])
    is_lag = np.array(found.taus_min) > 0.0
    which = [i for i in range(gains.size) if gains[i] or not is_lag[i]]
    return _summed(_poles(found.taus_min, period_s / 60.0), is_lag, which, gains[which], period_s)


def _summed(
    poles: Vector, is_lag: Mask, which: Sequence[int], gains: Vector, period_s: float
) -> SampledTransferFunction:
    """Return a sum of lags and a direct part as one transfer function."""
    lags = [i for i in which if is_lag[i]]
    denominator = np.atleast_1d(np.poly(poles[lags]))
    numerator = np.zeros(len(lags) + 1)
    for i, gain in zip(which, gains, strict=True):
        if not is_lag[i]:
            numerator += gain * denominator
        else:
            others = np.poly(poles[[other for other in lags if other != i]])
            numerator += gain * (1.0 - poles[i]) / 2.0 * np.convolve([1.0, 1.0], others)
    return SampledTransferFunction(b=tuple(numerator.tolist()), a=tuple(denominator.tolist()), period_s=period_s)
