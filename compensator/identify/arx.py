"""ARX by least squares: starting values of the search, and a comparison with common tools.

    A(z) y = Σ_j B_j(z) u_j + e

It minimises the one-step prediction error. White noise on the output biases it, so it is a starting value here and
not a result.

Source: Ljung, System Identification (1999), section 4.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compensator.identify.output_error import Segment, Structure
from compensator.model.transfer_function import SampledTransferFunction


def fit_arx(segments: Sequence[Segment], structure: Structure, *, period_s: float) -> list[SampledTransferFunction]:
    """Fit A and every B_j by least squares.

    Parameters
    ----------
    segments : sequence of Segment
        Data; rows that need a missing y are left out.
    structure : Structure
        Orders; an offset is fitted too.
    period_s : float
        Sample period, s.

    Returns
    -------
    list of SampledTransferFunction
        One for each input, with the common denominator.

    Examples
    --------
    >>> u = np.random.default_rng(0).normal(size=200)
    >>> y = np.zeros(200)
    >>> for k in range(1, 200):
    ...     y[k] = 0.9 * y[k - 1] + 0.2 * u[k]
    >>> fit = fit_arx([Segment.of(u, y)], Structure(order=1, terms=(1,)), period_s=60.0)[0]
    >>> [round(c, 6) for c in (*fit.b, *fit.a)]
    [0.2, 1.0, -0.9]
    """
    n = structure.order
    rows, targets = [], []
    for segment in segments:
        size = segment.y.size
        reach = max(n, *(terms - 1 for terms in structure.terms))
        index = np.arange(reach, size)
        y = np.where(segment.used, segment.y, np.nan)
        columns = [-y[index - i] for i in range(1, n + 1)]
        for u, terms in zip(segment.inputs, structure.terms, strict=True):
            columns += [u[index - i] for i in range(terms)]
        columns.append(np.ones(index.size))
        table = np.stack(columns, axis=1)
        good = np.isfinite(table).all(axis=1) & np.isfinite(y[index])
        rows.append(table[good])
        targets.append(y[index][good])
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=None)[0]
    a = (1.0, *solution[:n].tolist())
    functions, at = [], n
    for terms in structure.terms:
        b = tuple(solution[at : at + terms].tolist())
        functions.append(SampledTransferFunction(b=b, a=a, period_s=period_s))
        at += terms
    return functions


def free_run_rms(segments: Sequence[Segment], structure: Structure, *, period_s: float) -> float:
    """Return the rms of an ARX's free-run error without its mean; infinite if the ARX is unstable.

    Parameters
    ----------
    segments, structure, period_s
        As :func:`fit_arx`.
    """
    functions = fit_arx(segments, structure, period_s=period_s)
    if not functions[0].is_stable():
        return float("inf")
    errors = []
    for segment in segments:
        predicted = sum(f.response(u) for f, u in zip(functions, segment.inputs, strict=True))
        error = (segment.y - predicted)[segment.used]
        errors.append(error - error.mean())
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def starts(segments: Sequence[Segment], structure: Structure, *, period_s: float) -> list[list[float]]:
    """Return starting values of the time constants, min: ARX's poles, and two spreads over the record's length.

    Parameters
    ----------
    segments, structure, period_s
        As :func:`fit_arx`.
    """
    n = structure.order
    if n == 0:
        return [[]]
    period = period_s / 60.0
    longest = max(segment.y.size for segment in segments) * period
    spread = [list(np.geomspace(2.0 * period, max(longest / 3.0, 8.0 * period), n + 2)[1:-1])]
    spread.append(list(np.geomspace(1.5 * period, max(longest / 2.0, 8.0 * period), n)) if n > 1 else [longest / 6.0])
    a = fit_arx(segments, structure, period_s=period_s)[0].a
    poles = np.roots(a) if np.isfinite(a).all() else np.zeros(0)
    # Inverse of Tustin's rule; a pole that is not a relaxation (negative, unstable) is replaced.
    inside = [float(p.real) for p in poles if 0.05 < p.real < 0.9995]
    taus = sorted(period / 2.0 * (1.0 + p) / (1.0 - p) for p in inside)
    for tau in spread[0]:
        if len(taus) < n:
            taus.append(tau)
    taus = sorted(taus)
    # Equal time constants are a saddle point of the search: separate them.
    for i in range(1, n):
        taus[i] = max(taus[i], 1.3 * taus[i - 1])
    return [taus, *spread]
