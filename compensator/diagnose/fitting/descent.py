"""Least squares within bounds, for a few parameters: the method of Levenberg and Marquardt.

Each step goes at most to the bounds, and where a parameter is at one that it wants to leave, the others are searched
without it. A general solver reaches the same minimum; around functions as cheap as these, its own work is a fifth of
the whole.

Sources: Levenberg, A method for the solution of certain non-linear problems in least squares (1944); Marquardt, An
algorithm for least-squares estimation of nonlinear parameters (1963).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from compensator.arrays import Matrix, Vector

#: Step of a parameter for its slope: a thousandth of its logarithm, or of its range.
SLOPE_STEP = 1e-3
#: Damping at first, and by how much it falls after a step that helps and grows after one that does not.
DAMPING, EASIER, HARDER = 1e-3, 0.2, 5.0
#: Relative fall of the squares, and share of a unit that a parameter moves, below which the search ends.
FALLS, MOVES = 1e-4, 1e-5


def least_squares(
    fun: Callable[[Vector], Vector], x: Vector, low: Vector, high: Vector, evaluations: int
) -> tuple[Vector, Matrix]:
    """Return where the sum of squares is least, and the slopes of the residuals there, shape (m, n).

    Parameters
    ----------
    fun : callable
        Gives the residuals, shape (m,).
    x : numpy.ndarray, shape (n,)
        Where to begin, within the bounds.
    low, high : numpy.ndarray, shape (n,)
        Bounds.
    evaluations : int
        Most evaluations, those for slopes not counted.
    """
    residual, damping = fun(x), DAMPING
    slopes = _slopes(fun, x, residual, high)
    squares = float(residual @ residual)
    for _ in range(evaluations - 1):
        gradient = slopes.T @ residual
        held = ((x <= low) & (gradient > 0.0)) | ((x >= high) & (gradient < 0.0))
        step = _step(slopes[:, ~held], gradient[~held], damping)
        moved = x.copy()
        moved[~held] = np.clip(x[~held] + step, low[~held], high[~held])
        if not np.any(np.abs(moved - x) > MOVES):
            break
        there = fun(moved)
        now = float(there @ there)
        if now >= squares:
            damping *= HARDER
            continue
        fell, damping = squares - now, damping * EASIER
        x, residual, squares = moved, there, now
        slopes = _slopes(fun, x, residual, high)
        if fell < FALLS * squares:
            break
    return x, slopes


def _step(slopes: Matrix, gradient: Vector, damping: float) -> Vector:
    """Return the step that the slopes foretell, damped; none of what they do not show."""
    gram = slopes.T @ slopes
    sizes = np.diag(gram)
    gram = gram + np.diag(damping * sizes + (sizes <= 0.0))
    return np.asarray(-np.linalg.solve(gram, gradient))


def _slopes(fun: Callable[[Vector], Vector], x: Vector, residual: Vector, high: Vector) -> Matrix:
    slopes = np.empty((residual.size, x.size))
    for i in range(x.size):
        moved = x.copy()
        moved[i] += SLOPE_STEP if x[i] + SLOPE_STEP <= high[i] else -SLOPE_STEP
        slopes[:, i] = (fun(moved) - residual) / (moved[i] - x[i])
    return slopes
