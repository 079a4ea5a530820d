"""How probable measured data are, given effects: the one criterion by which explanations are compared.

    residual = Σ effects + nuisances + own error of the base's paths + slow rest + noise

What is not known is integrated out: the zero and the initial state of each run (nuisances), the error of the base's
own paths (linear responses to heat and ambient temperature, of the size that the calibration states), and a slow rest
of unknown cause (an Ornstein–Uhlenbeck process, whose size and time constant are learned). The rest is what keeps
unknown slow influences from being forced onto the channels; it also says how many samples of a residual count.

For speed, blocks of samples are averaged to about `POINTS` points, and the Kalman filter of the rest whitens them.

Sources: MacKay, Bayesian interpolation (1992); Chen, Ohlsson, Ljung, On the estimation of transfer functions,
regularizations and Gaussian processes (Automatica 2012); Rasmussen and Williams, Gaussian Processes (2006), ch. 5.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dtbtrs
from scipy.optimize import minimize

from compensator.arrays import Indices, Matrix, Vector
from compensator.diagnose.evidence import Evidence
from compensator.model.effects.blocks import FilterBank
from compensator.model.effects.hypothesis import Context

#: Points that the samples are averaged to.
POINTS = 700
#: Lags of the paths' own error, and which of them are fast, min.
OWN_LAGS, FAST_MIN = 8, 25.0
#: Combinations of lagged inputs that differ less than this from others are left out.
DISTINCT = 3e-3
#: Own error where the calibration states none: a share of the noise.
EXACT_OWN = 0.3
#: Effects have their form only to this share of their size: where forms are exact, and on a real machine.
FORM_ERROR = (0.02, 0.1)
#: The zero of a run is free: this many times the spread of the deformation.
ZERO_TIMES = 10.0
#: Typical size of an initial state, as a share of the spread of the deformation.
START_SHARE = 0.1
#: Typical slow rest where nothing is known of the paths, as a share of the spread of the deformation.
SLOW_SHARE = 0.03
#: Typical time constant of the slow rest, min, and how far (in e-folds) noise, slow rest, its time constant, the
#: initial state and the paths' fast error may be from what is typical.
REST_MIN, REST_FOLDS = 60.0, (0.4, 1.0, 1.0, 2.0, 0.5)
#: Stretches of so few points are whitened in a loop.
FEW = 12
#: Furthest that the search of the rest goes, in e-folds.
FURTHEST = 6.0


@dataclass(frozen=True, slots=True)
class Rest:
    """What no effect explains.

    Parameters
    ----------
    noise_um : float
        White noise of one point, µm.
    slow_um, tau_min : float
        Standard deviation, µm, and time constant, min, of the slow rest.
    start_um : float
        What the unknown initial state of a run moves, µm.
    fast_um, own_um : float
        Fast and slow error of the base's paths, µm.
    forms : tuple of (str, float)
        Error of the form in which channels act, µm.
    """

    noise_um: float
    slow_um: float
    tau_min: float
    start_um: float
    fast_um: float
    own_um: float
    forms: tuple[tuple[str, float], ...] = ()


class Points:
    """The evidence, averaged to points.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals.
    """

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        noise, context = evidence.noise, evidence.context
        self.is_exact = not context.approximate or evidence.free_paths
        stride = max(1, math.ceil(evidence.count / POINTS))
        starts = np.cumsum([0, *[record.size for record in evidence.signals[:-1]]])
        # A value measured now and then is a point of its own.
        edges = [
            s + np.flatnonzero(evidence.used[s : s + record.size]) if sparse else np.arange(s, s + record.size, stride)
            for s, record, sparse in zip(starts.tolist(), evidence.signals, evidence.sparse, strict=True)
        ]
        self._edges = np.concatenate(edges)
        self._weights = evidence.used.astype(float)
        counts = np.add.reduceat(self._weights, self._edges)
        self._counts = np.maximum(counts, 1.0)
        is_value = np.repeat(evidence.sparse, [e.size for e in edges])
        self.used = counts >= np.where(is_value, 1.0, max(1.0, stride / 2.0))
        self.starts = np.cumsum([0, *[e.size for e in edges[:-1]]])
        self.period_min = context.period_min * stride
        self._minutes = self.period_min * np.ones(self._edges.size)
        if is_value.any():
            self._minutes[:-1] = np.where(is_value[:-1], context.period_min * np.diff(self._edges), self.period_min)
            self.period_min = max(self.period_min, float(np.median(self._minutes[:-1])))
        self.count = int(self.used.sum())
        #: Variance of the noise of each point, relative to a full one, infinite where it is not used; where runs begin;
        #: stretches of points with equal noise and times between them: begin, end, variance.
        self.relative_variance = np.where(self.used, stride / self._counts, np.inf)
        self.begins = frozenset(self.starts.tolist())
        self.stretches = _stretches(self.relative_variance, self._minutes, self.starts)
        self.spread_um = max(evidence.spread_um, 1e-9)
        self.residual = self.averaged(evidence.residual[:, None])[:, 0]
        self.own_um = (
            self.spread_um
            if evidence.free_paths
            else max(
                noise.own_error_um, (EXACT_OWN if self.is_exact or evidence.is_sparse else 1.0) * evidence.probe_um
            )
        )
        point_noise = evidence.probe_um / math.sqrt(stride)
        if not self.is_exact:
            # What a calibration missed is no slow process: it is largest right after the heat is switched.
            point_noise = math.hypot(point_noise, self.own_um)
        slow = SLOW_SHARE * self.spread_um if evidence.free_paths else self.own_um
        self._typical = np.log([max(point_noise, 1e-3), slow, REST_MIN, START_SHARE * self.spread_um, self.own_um])
        self.fast, self.slow = self._own_columns()
        self._forms: dict[str, Matrix] = {}
        nuisances = self.averaged(evidence.nuisances)
        is_zero = np.arange(nuisances.shape[1]) % (nuisances.shape[1] // len(evidence.signals)) == 0
        self.zeros, self.starts_of_modes = ZERO_TIMES * self.spread_um * nuisances[:, is_zero], nuisances[:, ~is_zero]

    def decays(self, tau_min: float) -> Vector:
        """Return what is left of a slow process from each point to the next, shape (points,)."""
        lengths, which = np.unique(self._minutes, return_inverse=True)
        return np.array([math.exp(-length / tau_min) for length in lengths.tolist()])[which]

    def averaged(self, table: Matrix) -> Matrix:
        """Return the means of columns over the samples used of each point, shape (points, columns)."""
        sums = np.add.reduceat(table * self._weights[:, None], self._edges, axis=0)
        return np.asarray(sums / self._counts[:, None])

    def scaled(self, points: Matrix, sizes: Sequence[float], together: int) -> tuple[Matrix, Vector]:
        """Return averaged columns of which one unit is what is expected of each amplitude, and their scales.

        That moves y by its spread, all amplitudes together, or is the size that the machine bounds it by.

        Parameters
        ----------
        points : numpy.ndarray, shape (points, k)
            One column for each amplitude.
        sizes : sequence of float
            Bounds of the amplitudes, repeated over the columns; none where there are none.
        together : int
            How many of the columns belong to one effect.
        """
        spread = np.std(points[self.used], axis=0)
        spread[spread < 1e-12] = 1.0
        scale = self.spread_um / spread
        if sizes:
            scale = np.minimum(scale, np.resize(sizes, scale.size))
        scale = scale / math.sqrt(together)
        return points * scale, scale

    def typical_rest(self) -> Rest:
        """Return a rest as it is expected before the data are seen."""
        return self._rest(self._typical, Rest(0.0, 0.0, 0.0, 0.0, 0.0, self.own_um))

    def with_forms_of(self, rest: Rest, sizes_um: Mapping[str, float]) -> Rest:
        """Return a rest with the errors that effects have whose form is not quite theirs.

        Parameters
        ----------
        rest : Rest
            Where the other values come from.
        sizes_um : mapping of str to float
            Standard deviation of what each channel adds by effects, µm; of the base's paths under an empty name.
        """
        share = FORM_ERROR[not self.is_exact]
        forms = tuple((channel, share * size) for channel, size in sizes_um.items() if channel)
        return dataclasses.replace(rest, own_um=math.hypot(self.own_um, share * sizes_um.get("", 0.0)), forms=forms)

    def random(self, rest: Rest) -> Matrix:
        """Return columns whose weights are unknown with standard deviation 1.

        Zeros, initial states, fast and slow own error, errors of form.
        """
        starts, forms = rest.start_um * self.starts_of_modes, [size * self.form(name) for name, size in rest.forms]
        return np.concatenate([self.zeros, starts, rest.fast_um * self.fast, rest.own_um * self.slow, *forms], axis=1)

    def form(self, channel: str) -> Matrix:
        """Return responses of any linear path from a channel, of size 1 together."""
        if channel not in self._forms:
            self._forms[channel] = self._responses([record.channels[channel] for record in self.evidence.signals])[2]
        return self._forms[channel]

    def log_prior(self, rest: Rest) -> float:
        """Return the logarithm of the prior of a rest."""
        return -0.5 * float(np.sum(((_logs(rest) - self._typical) / REST_FOLDS) ** 2))

    def settled(self, columns: Matrix, fixed: Vector, start: Rest, steps: int = 12) -> Rest:
        """Return the rest with which data are most probable, given what effects may add.

        Parameters
        ----------
        columns : numpy.ndarray, shape (points, ·)
            Scaled columns of effects.
        fixed : numpy.ndarray, shape (points,)
            What effects without a free amplitude add, µm.
        start : Rest
            Where to begin; its own error is kept.
        steps : int
            Most evaluations of the gradient.
        """
        unit = dataclasses.replace(start, start_um=1.0, fast_um=1.0)
        table = np.column_stack([self.residual - fixed, self.random(unit), columns])
        ends = np.cumsum([self.zeros.shape[1], self.starts_of_modes.shape[1], self.fast.shape[1]]).tolist()
        sized = [slice(ends[0], ends[1]), slice(ends[1], ends[2])]
        # The noise of values measured now and then is stated.
        searched = np.arange(0 if self.is_exact and not self.evidence.is_sparse else 1, 5)
        at = np.clip(_logs(start), self._typical - FURTHEST, self._typical + FURTHEST)

        def solved(logs: Vector) -> RandomColumns:
            rest = self._rest(logs, start)
            whitening = Whitening(self, rest)
            white = whitening.of(table)
            for where, size in zip(sized, (rest.start_um, rest.fast_um), strict=True):
                white[:, 1:][:, where] *= size
            return RandomColumns(white[:, 1:], white[:, 0], whitening.log_det)

        def with_gradient(some: Vector) -> tuple[float, Vector]:
            logs = at.copy()
            logs[searched] = some
            model, slopes = solved(logs), np.zeros(5)
            here, surplus = model.surprise, model.surplus(ends[2])
            slopes[3:] = [-surplus[where].sum() for where in sized]
            for i in searched[searched < 3].tolist():
                moved = logs.copy()
                moved[i] += 1e-3
                slopes[i] = (solved(moved).surprise - here) / 1e-3
            off = (logs - self._typical) / REST_FOLDS
            return here + 0.5 * float(off @ off), (slopes + off / REST_FOLDS)[searched]

        bounds = [(t - FURTHEST, t + FURTHEST) for t in self._typical[searched].tolist()]
        options = {"maxfun": steps, "ftol": 1e-5}
        found = minimize(with_gradient, at[searched], jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        at[searched] = found.x
        return self._rest(at, start)

    def _rest(self, logs: Vector, other: Rest) -> Rest:
        noise_um, slow_um, tau_min, start_um, fast_um = np.exp(logs).tolist()
        return Rest(noise_um, slow_um, tau_min, start_um, fast_um, other.own_um, other.forms)

    def _own_columns(self) -> tuple[Matrix, Matrix]:
        """Return fast and slow responses of any linear paths to heat and ambient temperature, of size 1 each."""
        records = self.evidence.signals
        both = [self._responses([record.source(path) for record in records]) for path in self.evidence.context.paths]
        fast, slow, _ = zip(*both, strict=True)
        return np.concatenate(fast, axis=1), np.concatenate(slow, axis=1)

    def _responses(self, drives: Sequence[Vector]) -> tuple[Matrix, Matrix, Matrix]:
        """Return fast, slow, and all responses to a drive."""
        context = self.evidence.context
        taus = np.array(lags_of_paths(context))
        bank = FilterBank(taus.tolist(), [(1.0,) * taus.size], context.period_min)
        table = self.averaged(np.concatenate([bank.columns(drive) for drive in drives]))
        slow = table[:, taus >= FAST_MIN]
        # Without a gain at rest, a fast response is one of timing.
        fast = table[:, taus < FAST_MIN] - slow[:, :1]
        return self._orthogonal(fast), self._orthogonal(slow), self._orthogonal(table)

    def _orthogonal(self, table: Matrix) -> Matrix:
        """Return combinations of columns that are orthogonal on the points used and together of size 1."""
        if not table.shape[1]:
            return table
        table = table / np.maximum(np.std(table[self.used], axis=0), 1e-12)
        _, sizes, directions = np.linalg.svd(table[self.used] - table[self.used].mean(axis=0), full_matrices=False)
        kept = sizes > DISTINCT * sizes[0]
        return np.asarray(table @ directions[kept].T / sizes[kept] * math.sqrt(self.count / kept.sum()))


class Whitening:
    """The Kalman filter of the slow rest with noise: turns both into white noise of size 1.

    Parameters
    ----------
    points : Points
        Which points are used, and where runs begin.
    rest : Rest
        Noise, and size and time constant of the slow rest.
    """

    def __init__(self, points: Points, rest: Rest) -> None:
        self._used = points.used
        phis = points.decays(rest.tau_min)
        stationary = (rest.slow_um / rest.noise_um) ** 2
        predicted, p = np.empty(points.used.size), stationary
        for begin, end, noise in points.stretches:
            if begin in points.begins:
                p = stationary
            predicted[begin:end], p = _predicted_variances(p, end - begin, noise, float(phis[begin]), stationary)
        variances = predicted + points.relative_variance
        gains = predicted / variances
        self._into = phis * gains
        self._into[points.starts[1:] - 1] = 0.0
        self._bands = np.ones((2, points.used.size))
        self._bands[1] = -phis * (1.0 - gains)
        self._bands[1, points.starts[1:] - 1] = 0.0
        self._scale = 1.0 / (np.sqrt(variances[points.used]) * rest.noise_um)
        self.log_det = float(np.log(variances[points.used]).sum()) + 2.0 * points.count * math.log(rest.noise_um)

    def of(self, table: Matrix) -> Matrix:
        """Return columns as the filter leaves them, on the points used."""
        if not table.shape[1]:
            return np.zeros((self._scale.size, 0))  # LAPACK must not be called with nothing
        driven = np.zeros(table.shape, order="F")
        driven[1:] = self._into[:-1, None] * table[:-1]
        predicted, _ = dtbtrs(self._bands, driven, uplo="L", diag="U", overwrite_b=1)
        return np.asarray((table - predicted)[self._used] * self._scale[:, None])


class RandomColumns:
    """White noise of size 1 and columns whose weights are unknown with standard deviation 1.

    Parameters
    ----------
    columns : numpy.ndarray, shape (m, k)
        Whitened.
    target : numpy.ndarray, shape (m,)
        What they and the noise add up to.
    log_det : float
        Logarithm of the determinant of the covariance without them.

    Attributes
    ----------
    mean : numpy.ndarray, shape (k,)
        Most probable weights.
    surprise : float
        Half the squares and half the logarithm of the determinant: less the logarithm of the evidence.
    """

    def __init__(self, columns: Matrix, target: Vector, log_det: float = 0.0) -> None:
        moment = columns.T @ target
        self._factor = factored(columns.T @ columns)
        self.mean = cho_solve(self._factor, moment, check_finite=False)
        self.surprise = 0.5 * float(target @ target - moment @ self.mean + log_det + log_det_of(self._factor))

    def surplus(self, count: int) -> Vector:
        """Return the slope of the log evidence by the logarithm of the size of each of the first columns."""
        known = np.diag(cho_solve(self._factor, np.eye(self.mean.size)[:, :count], check_finite=False))
        return np.asarray(self.mean[:count] ** 2 + known - 1.0)


class Likelihood:
    """The data with a given rest: columns are projected to where the residual is white noise of size 1.

    Parameters
    ----------
    points : Points
        The evidence.
    rest : Rest
        What no effect explains.

    Attributes
    ----------
    target : numpy.ndarray, shape (m,)
        The residual, projected.
    log_det : float
        Logarithm of the determinant of the covariance without effects.
    """

    def __init__(self, points: Points, rest: Rest) -> None:
        self.points, self.rest = points, rest
        self._whitening = Whitening(points, rest)
        self._random = self._whitening.of(points.random(rest))
        self._factor = factored(self._random.T @ self._random)
        self.log_det = self._whitening.log_det + log_det_of(self._factor)
        self.log_prior = points.log_prior(rest)
        self.target = self.projected(points.residual[:, None])[:, 0]

    def left_by(self, added: Vector) -> Vector:
        """Return what effects that add so much to the points leave of the target."""
        return self.target - self.projected(added[:, None])[:, 0]

    def projected(self, table: Matrix) -> Matrix:
        """Return averaged columns without noise correlation, nuisances and own error."""
        white = self._whitening.of(table)
        weights = cho_solve(self._factor, self._random.T @ white)
        return np.concatenate([white - self._random @ weights, -weights])


def dense(likelihood: Likelihood) -> Matrix:
    """Return the projection as one matrix, for many columns at once."""
    return likelihood.projected(np.eye(likelihood.points.used.size))


def _stretches(variance: Vector, minutes: Vector, starts: Indices) -> list[tuple[int, int, float]]:
    """Return where equal variances and times to the next point begin and end, cut where runs begin."""
    changes = np.flatnonzero((variance[1:] != variance[:-1]) | (minutes[1:] != minutes[:-1])) + 1
    edges = np.unique(np.concatenate([starts, changes, [variance.size]])).tolist()
    return [(a, b, float(variance[a])) for a, b in itertools.pairwise(edges)]


def _predicted_variances(first: float, count: int, noise: float, phi: float, stationary: float) -> tuple[Vector, float]:
    """Return the variances of a slow rest before each of some points with equal noise, and after them.

    What the Kalman filter makes of a variance is a linear fraction of it, so that many points need no loop.
    """
    if count <= FEW:
        values = []
        for _ in range(count):
            values.append(first)
            left = first if noise == math.inf else first * noise / (first + noise)
            first = stationary + phi * phi * (left - stationary)
        return np.array(values), first
    n = np.arange(count + 1, dtype=np.float64)
    course: Vector
    if noise == math.inf:
        course = stationary + np.power(phi, 2.0 * n) * (first - stationary)
        return course[:-1], float(course[-1])
    driven = stationary * (1.0 - phi * phi)
    half = 0.5 * (noise * (1.0 - phi * phi) - driven)
    root = math.sqrt(half * half + driven * noise)
    # The larger of both fixed points, without cancellation, and the other, which is negative.
    settled = driven * noise / (half + root) if half > 0.0 else root - half
    other = settled - 2.0 * root
    odds = np.power(phi * noise / (settled + noise), 2.0 * n) * (first - settled) / (first - other)
    course = (settled - other * odds) / (1.0 - odds)
    return course[:-1], float(course[-1])


def lags_of_paths(context: Context) -> tuple[float, ...]:
    """Return lags that any linear path is made of, min."""
    longest = min(600.0, max(context.minutes / 3.0, 20.0 * context.period_min))
    return (0.0, *np.geomspace(context.period_min, longest, OWN_LAGS).tolist())


def factored(gram: Matrix) -> tuple[Matrix, bool]:
    """Return the Cholesky factor of a Gram matrix and the unit matrix, which rounding must not take away."""
    unit = 1.0 + 1e-12 * float(np.trace(gram))
    matrix, lower = cho_factor(gram + unit * np.eye(gram.shape[0]), lower=True, check_finite=False)
    return np.asarray(matrix), bool(lower)


def without_own_error(rest: Rest) -> Rest:
    """Return a rest for a base whose paths are exact."""
    return dataclasses.replace(rest, fast_um=0.0, own_um=0.0, forms=())


def _logs(rest: Rest) -> Vector:
    return np.log([rest.noise_um, rest.slow_um, rest.tau_min, rest.start_um, max(rest.fast_um, 1e-9)])


def log_det_of(factor: tuple[Matrix, bool]) -> float:
    """Return the logarithm of the determinant of a matrix from its Cholesky factor."""
    return 2.0 * float(np.log(np.diag(factor[0])).sum())
