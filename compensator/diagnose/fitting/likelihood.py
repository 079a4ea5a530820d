"""How probable measured data are, given effects: the one criterion by which explanations are compared.

    residual = Σ effects + nuisances + own error of the base's paths + slow rest + noise

What is not known is integrated out: the zero and the initial state of each run (nuisances), the error of the base's
own paths (linear responses to heat and ambient temperature, of the size that the calibration states), and a slow rest
of unknown cause (an Ornstein–Uhlenbeck process, whose size and time constant are learned). The rest is what keeps
unknown slow influences from being forced onto the channels; it also says how many samples of a residual count.

Sources: MacKay, Bayesian interpolation (1992); Chen, Ohlsson, Ljung, On the estimation of transfer functions,
regularizations and Gaussian processes (Automatica 2012); Rasmussen and Williams, Gaussian Processes (2006), ch. 5.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs
from scipy.optimize import minimize

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fitting.points import REST_FOLDS, Points, SlowRest
from compensator.diagnose.fitting.whitening import Whitening

#: Furthest that the search of the rest goes, in e-folds.
FURTHEST = 6.0
#: Step of a logarithm for its slope.
STEP = 1e-3
#: Most evaluations of the gradient in the search of the rest.
EVALUATIONS = 12


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
        self._columns, self._target, self._log_det = columns, target, log_det
        moment = columns.T @ target
        self._factor = factored(columns.T @ columns)
        self.mean = solution(self._factor, moment)
        self.surprise = 0.5 * float(target @ target - moment @ self.mean + log_det + log_det_of(self._factor))

    def surplus(self, count: int) -> Vector:
        """Return the slope of the log evidence by the logarithm of the size of each of the first columns."""
        known = np.diag(solution(self._factor, np.eye(self.mean.size)[:, :count]))
        return np.asarray(self.mean[:count] ** 2 + known - 1.0)

    def slopes(self, moved: Iterable[tuple[Matrix, Vector, float]], step: float) -> Vector:
        """Return the slopes of the surprise by what the whitening depends on.

        Parameters
        ----------
        moved : iterable of (numpy.ndarray, numpy.ndarray, float)
            Columns, target and logarithm of the determinant after a small step of each.
        step : float
            The step.
        """
        left = self._target - self._columns @ self.mean
        spread = solution(self._factor, self._columns.T).T
        found = []
        for columns, target, log_det in moved:
            change = columns - self._columns
            by_mean = left @ (target - self._target - change @ self.mean)
            found.append((by_mean + np.vdot(spread, change) + 0.5 * (log_det - self._log_det)) / step)
        return np.array(found)


class Likelihood:
    """The data with a given rest: columns are projected to where the residual is white noise of size 1.

    Parameters
    ----------
    points : Points
        The evidence.
    rest : SlowRest
        What no effect explains.

    Attributes
    ----------
    target : numpy.ndarray, shape (m,)
        The residual, projected.
    log_det : float
        Logarithm of the determinant of the covariance without effects.
    """

    def __init__(self, points: Points, rest: SlowRest) -> None:
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

    def weights(self, added: Vector) -> Vector:
        """Return the most probable weights of `Points.random` beside effects that add so much to the points."""
        return -self.left_by(added)[self.points.count :]

    def weights_root(self) -> Matrix:
        """Return a root of the covariance of these weights, beside effects that are as they are."""
        return np.asarray(np.linalg.inv(self._factor).T)

    def projected(self, table: Matrix) -> Matrix:
        """Return averaged columns without noise correlation, nuisances and own error."""
        white = self._whitening.of(table)
        weights = solution(self._factor, self._random.T @ white)
        return np.concatenate([white - self._random @ weights, -weights])

    def whitened(self, table: Matrix) -> tuple[Matrix, Matrix]:
        """Return averaged columns without noise correlation, and what nuisances and own error have of them.

        The products of projected columns are those of the first less those of the second: for very many columns that is
        cheaper than to project them.
        """
        white = self._whitening.of(table)
        taken, _ = dtrtrs(self._factor, self._random.T @ white, lower=1)
        return white, np.asarray(taken)


def learned_rest(points: Points, columns: Matrix, fixed: Vector, start: SlowRest) -> SlowRest:
    """Return the rest with which data are most probable, given what effects may add.

    Parameters
    ----------
    points : Points
        The evidence.
    columns : numpy.ndarray, shape (points, ·)
        Scaled columns of effects.
    fixed : numpy.ndarray, shape (points,)
        What effects without a free amplitude add, µm.
    start : SlowRest
        Where to begin; its own error is kept.
    """
    unit = dataclasses.replace(start, start_um=1.0, fast_um=1.0)
    table = np.asfortranarray(np.column_stack([points.residual - fixed, points.random(unit), columns]))
    ends = np.cumsum([points.zeros.shape[1], points.starts_of_modes.shape[1], points.fast.shape[1]]).tolist()
    sized = [slice(ends[0], ends[1]), slice(ends[1], ends[2])]
    # The noise of values measured now and then is stated.
    searched = np.arange(0 if points.is_exact and not points.evidence.is_sparse else 1, 5)
    at = np.clip(start.logs, points.typical_logs - FURTHEST, points.typical_logs + FURTHEST)

    def whitened(logs: Vector) -> tuple[Matrix, Vector, float]:
        rest = start.with_logs(logs)
        whitening = Whitening(points, rest)
        white = whitening.of(table)
        for where, size in zip(sized, (rest.start_um, rest.fast_um), strict=True):
            white[:, 1:][:, where] *= size
        return white[:, 1:], white[:, 0], whitening.log_det

    def with_gradient(some: Vector) -> tuple[float, Vector]:
        logs = at.copy()
        logs[searched] = some
        model, slopes = RandomColumns(*whitened(logs)), np.zeros(5)
        here, surplus = model.surprise, model.surplus(ends[2])
        slopes[3:] = [-surplus[where].sum() for where in sized]
        of_noise = searched[searched < 3]
        slopes[of_noise] = model.slopes((whitened(logs + STEP * (np.arange(5) == i)) for i in of_noise), STEP)
        off = (logs - points.typical_logs) / REST_FOLDS
        return here + 0.5 * float(off @ off), (slopes + off / REST_FOLDS)[searched]

    bounds = [(t - FURTHEST, t + FURTHEST) for t in points.typical_logs[searched].tolist()]
    options = {"maxfun": EVALUATIONS, "ftol": 1e-5}
    found = minimize(with_gradient, at[searched], jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    at[searched] = found.x
    return start.with_logs(at)


def rest_without_effects(points: Points) -> SlowRest:
    """Return the rest with which data are most probable if nothing acts."""
    nothing = np.zeros(points.count)
    return learned_rest(points, np.zeros((points.count, 0)), nothing, points.typical_rest())


def dense(likelihood: Likelihood) -> Matrix:
    """Return the projection as one matrix, for many columns at once."""
    return likelihood.projected(np.eye(likelihood.points.count))


def factored(gram: Matrix) -> Matrix:
    """Return the Cholesky factor of a Gram matrix and the unit matrix, which rounding must not take away.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """
    unit = 1.0 + 1e-12 * float(np.trace(gram))
    return factor_of(gram + unit * np.eye(gram.shape[0]))


def factor_of(matrix: Matrix) -> Matrix:
    """Return the lower Cholesky factor of a matrix: LAPACK by itself, the checks around it cost more than it.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """
    factor, info = dpotrf(matrix, lower=1)
    if info:
        raise np.linalg.LinAlgError(f"not positive definite at {info}")
    return np.asarray(factor)


def solution(factor: Matrix, right: Matrix | Vector) -> Matrix:
    """Return the solution of equations by the Cholesky factor of their matrix."""
    return np.asarray(dpotrs(factor, right, lower=1)[0]) if right.size else np.zeros(right.shape)


def log_det_of(factor: Matrix) -> float:
    """Return the logarithm of the determinant of a matrix from its Cholesky factor."""
    return 2.0 * float(np.log(np.diag(factor)).sum())
