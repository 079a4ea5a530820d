"""The search of free parameters against a general solver, and at its bounds."""

import numpy as np
import pytest
from scipy import optimize

from compensator.diagnose.fitting.descent import least_squares

T = np.linspace(0.0, 5.0, 200)
LOW, HIGH = np.array([-3.0, -2.0]), np.array([3.0, 2.0])


def residuals(measured):
    """Of a response, by the logarithm of its time constant and by what moves it sideways."""

    def fun(x):
        return measured - np.exp(-T / np.exp(x[0])) - 0.3 * np.sin(T + x[1])

    return fun


def measured(x, noise=0.01):
    return -residuals(np.zeros(T.size))(x) + noise * np.random.default_rng(3).normal(size=T.size)


@pytest.mark.parametrize("begin", [(0.0, 0.0), (2.5, -1.9), (-1.0, 1.0)])
def test_it_finds_the_minimum_that_a_general_solver_finds(begin):
    fun = residuals(measured([0.7, -0.8]))
    x, slopes = least_squares(fun, np.array(begin), LOW, HIGH, 40)
    known = optimize.least_squares(fun, np.array(begin), bounds=(LOW, HIGH))
    assert x == pytest.approx(known.x, abs=2e-3)
    assert slopes == pytest.approx(known.jac, abs=2e-3)


def test_a_parameter_that_wants_to_leave_its_bounds_is_at_one_and_the_others_are_best_there():
    fun, low = residuals(measured([0.7, -0.8])), np.array([-3.0, -0.4])
    x, _ = least_squares(fun, np.array([2.0, 1.5]), low, HIGH, 40)
    assert x[1] == -0.4
    rest = optimize.least_squares(lambda one: fun(np.array([one[0], -0.4])), [0.0])
    assert x[0] == pytest.approx(rest.x[0], abs=2e-3)


def test_a_parameter_that_changes_nothing_stays_where_it_is():
    def fun(x):
        return residuals(target)(np.array([x[0], -0.8]))

    target = measured([0.7, -0.8])
    x, slopes = least_squares(fun, np.array([0.0, 0.3]), LOW, HIGH, 40)
    assert x[1] == 0.3 and x[0] == pytest.approx(0.7, abs=0.05) and not slopes[:, 1].any()


def test_one_evaluation_gives_the_slopes_where_it_begins():
    begin = np.array([0.4, HIGH[1]])  # at a bound the step goes inside
    fun = residuals(measured([0.7, -0.8]))
    x, slopes = least_squares(fun, begin, LOW, HIGH, 1)
    assert (x == begin).all()
    assert slopes == pytest.approx(optimize.approx_fprime(begin, fun, 1e-7), abs=2e-3)


def test_it_ends_no_worse_than_it_begins_whatever_the_slopes_say():
    """A function with a step, as a time of switching has."""

    def fun(x):
        return np.array([1.0 + x[0], 5.0 * (x[0] < -0.3)])

    x, _ = least_squares(fun, np.array([0.5]), np.array([-1.0]), np.array([1.0]), 8)
    assert fun(x) @ fun(x) < fun(np.array([0.5])) @ fun(np.array([0.5]))
