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
import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_banded
from scipy.optimize import minimize

from compensator.arrays import Matrix, Vector
from compensator.diagnose.evidence import Evidence
from compensator.model.effects.blocks import FilterBank

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
ZERO_TIMES = 100.0
#: Typical size of an initial state, as a share of the spread of the deformation.
START_SHARE = 0.1
#: Typical slow rest where nothing is known of the paths, as a share of the spread of the deformation.
SLOW_SHARE = 0.03
#: Typical time constant of the slow rest, min, and how far (in e-folds) noise, slow rest, its time constant and the
#: initial state may be from what is typical.
REST_MIN, REST_FOLDS = 60.0, (0.4, 1.0, 1.0, 2.0)
#: Furthest that the search of the rest goes, in e-folds.
FURTHEST = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
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
    own_um : float
        Error of the base's paths, µm.
    """

    noise_um: float
    slow_um: float
    tau_min: float
    start_um: float
    own_um: float


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
        self.is_exact = not context.approximate
        stride = max(1, math.ceil(evidence.count / POINTS))
        starts = np.cumsum([0, *[record.size for record in evidence.signals[:-1]]])
        edges = [np.arange(s, s + record.size, stride) for s, record in zip(starts, evidence.signals, strict=True)]
        self._edges = np.concatenate(edges)
        self._weights = evidence.used.astype(float)
        counts = np.add.reduceat(self._weights, self._edges)
        self._counts = np.maximum(counts, 1.0)
        self.used = counts >= max(1.0, stride / 2.0)
        self.starts = np.cumsum([0, *[e.size for e in edges[:-1]]])
        self.period_min = context.period_min * stride
        self.count = int(self.used.sum())
        #: Variance of the noise of each point, relative to a full one.
        self.relative_variance = stride / self._counts
        self.spread_um = max(evidence.spread_um, 1e-9)
        self.residual = self.averaged(evidence.residual[:, None])[:, 0]
        self.is_exact = self.is_exact or evidence.free_paths
        self.own_um = (
            self.spread_um
            if evidence.free_paths
            else max(noise.own_error_um, (EXACT_OWN if self.is_exact else 1.0) * evidence.probe_um)
        )
        point_noise = evidence.probe_um / math.sqrt(stride)
        if not self.is_exact:
            # What a calibration missed is no slow process: it is largest right after the heat is switched.
            point_noise = math.hypot(point_noise, self.own_um)
        slow = SLOW_SHARE * self.spread_um if evidence.free_paths else self.own_um
        self._typical = np.log([max(point_noise, 1e-3), slow, REST_MIN, START_SHARE * self.spread_um])
        self._own = self._own_columns()
        nuisances = self.averaged(evidence.nuisances)
        is_zero = np.arange(nuisances.shape[1]) % (nuisances.shape[1] // len(evidence.signals)) == 0
        self.zeros, self.starts_of_modes = ZERO_TIMES * self.spread_um * nuisances[:, is_zero], nuisances[:, ~is_zero]

    def averaged(self, table: Matrix) -> Matrix:
        """Return the means of columns over the samples used of each point, shape (points, columns)."""
        sums = np.add.reduceat(table * self._weights[:, None], self._edges, axis=0)
        return np.asarray(sums / self._counts[:, None])

    def scaled(self, table: Matrix) -> tuple[Matrix, Vector]:
        """Return averaged columns of which one unit in each moves y by its spread in all, and their scales."""
        points = self.averaged(table)
        spread = np.std(points[self.used], axis=0)
        spread[spread < 1e-12] = 1.0
        scale = self.spread_um / spread / math.sqrt(table.shape[1])
        return points * scale, scale

    def typical_rest(self) -> Rest:
        """Return a rest as it is expected before the data are seen."""
        return self._rest(self._typical, self.own_um)

    def own_error_with(self, effects_um: float) -> float:
        """Return the paths' own error, and that of the form of effects of a size, µm."""
        return math.hypot(self.own_um, FORM_ERROR[not self.is_exact] * effects_um)

    def random(self, rest: Rest) -> Matrix:
        """Return columns whose weights are unknown with standard deviation 1: zeros, initial states and own error."""
        return np.concatenate([self.zeros, rest.start_um * self.starts_of_modes, rest.own_um * self._own], axis=1)

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
        unit = dataclasses.replace(start, start_um=1.0)
        table = np.column_stack([self.residual - fixed, self.random(unit), columns])
        first = 1 + self.zeros.shape[1]
        of_start = slice(first, first + self.starts_of_modes.shape[1])
        searched = np.array([0, 1, 2, 3] if self.is_exact else [1, 2, 3])
        at = np.clip(_logs(start), self._typical - FURTHEST, self._typical + FURTHEST)

        def value(logs: Vector) -> float:
            rest = self._rest(logs, start.own_um)
            whitening = Whitening(self, rest)
            white = whitening.of(table)
            white[:, of_start] *= rest.start_um
            gram = white[:, 1:].T @ white
            factor = cho_factor(np.eye(gram.shape[0]) + gram[:, 1:], lower=True, check_finite=False)
            explained = gram[:, 0] @ cho_solve(factor, gram[:, 0], check_finite=False)
            surprise = white[:, 0] @ white[:, 0] - explained + whitening.log_det + _log_det(factor)
            return 0.5 * float(surprise) - self.log_prior(rest)

        def with_gradient(some: Vector) -> tuple[float, Vector]:
            logs = at.copy()
            logs[searched] = some
            here, slopes = value(logs), []
            for i in searched.tolist():
                moved = logs.copy()
                moved[i] += 1e-3
                slopes.append((value(moved) - here) / 1e-3)
            return here, np.array(slopes)

        bounds = [(t - FURTHEST, t + FURTHEST) for t in self._typical[searched].tolist()]
        options = {"maxfun": steps, "ftol": 1e-5}
        found = minimize(with_gradient, at[searched], jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        at[searched] = found.x
        return self._rest(at, start.own_um)

    def _rest(self, logs: Vector, own_um: float) -> Rest:
        noise_um, slow_um, tau_min, start_um = np.exp(logs).tolist()
        return Rest(noise_um=noise_um, slow_um=slow_um, tau_min=tau_min, start_um=start_um, own_um=own_um)

    def _own_columns(self) -> Matrix:
        """Return responses of any linear paths to heat and ambient temperature, fast and slow ones of size 1 each."""
        context, records = self.evidence.context, self.evidence.signals
        longest = min(600.0, max(context.minutes / 3.0, 20.0 * context.period_min))
        taus = np.array([0.0, *np.geomspace(context.period_min, longest, OWN_LAGS)])
        bank = FilterBank(taus.tolist(), [(1.0,) * taus.size], context.period_min)
        groups = [np.zeros((self.used.size, 0))]
        for path in context.paths:
            table = self.averaged(np.concatenate([bank.columns(record.source(path)) for record in records]))
            groups += [self._orthogonal(table[:, some]) for some in (taus < FAST_MIN, taus >= FAST_MIN) if some.any()]
        return np.concatenate(groups, axis=1)

    def _orthogonal(self, table: Matrix) -> Matrix:
        """Return combinations of columns that are orthogonal on the points used and together of size 1."""
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
        phi = math.exp(-points.period_min / rest.tau_min)
        stationary = (rest.slow_um / rest.noise_um) ** 2
        gains, variances = np.zeros(points.used.size), np.ones(points.used.size)
        begins, p = set(points.starts.tolist()), stationary
        noises = points.relative_variance.tolist()
        for i, used in enumerate(points.used.tolist()):
            if i in begins:
                p = stationary
            if used:
                variances[i] = p + noises[i]
                gains[i] = p / variances[i]
                p *= 1.0 - gains[i]
            p = phi * phi * p + stationary * (1.0 - phi * phi)
        self._into = phi * gains
        self._into[points.starts[1:] - 1] = 0.0
        self._bands = np.ones((2, points.used.size))
        self._bands[1] = -phi * (1.0 - gains)
        self._bands[1, points.starts[1:] - 1] = 0.0
        self._scale = 1.0 / (np.sqrt(variances[points.used]) * rest.noise_um)
        self.log_det = float(np.log(variances[points.used]).sum()) + 2.0 * points.count * math.log(rest.noise_um)

    def of(self, table: Matrix) -> Matrix:
        """Return columns as the filter leaves them, on the points used."""
        driven = np.zeros(table.shape)
        driven[1:] = self._into[:-1, None] * table[:-1]
        predicted = solve_banded((1, 0), self._bands, driven, check_finite=False)
        return np.asarray((table - predicted)[self._used] * self._scale[:, None])


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
        self._factor = cho_factor(np.eye(self._random.shape[1]) + self._random.T @ self._random, lower=True)
        self.log_det = self._whitening.log_det + _log_det(self._factor)
        self.log_prior = points.log_prior(rest)
        self.target = self.projected(points.residual[:, None])[:, 0]

    def projected(self, table: Matrix) -> Matrix:
        """Return averaged columns without noise correlation, nuisances and own error."""
        white = self._whitening.of(table)
        weights = cho_solve(self._factor, self._random.T @ white)
        return np.concatenate([white - self._random @ weights, -weights])


def dense(likelihood: Likelihood) -> Matrix:
    """Return the projection as one matrix, for many columns at once."""
    return likelihood.projected(np.eye(likelihood.points.used.size))


def with_own_error(rest: Rest, own_um: float) -> Rest:
    """Return a rest with another own error of the base."""
    return dataclasses.replace(rest, own_um=own_um)


def _logs(rest: Rest) -> Vector:
    return np.log([rest.noise_um, rest.slow_um, rest.tau_min, rest.start_um])


def _log_det(factor: tuple[Matrix, bool]) -> float:
    return 2.0 * float(np.log(np.diag(factor[0])).sum())
