"""Output error with projected amplitudes: the fit of every path.

A path from input *u_j* is a rational function with real poles, as heat conduction has. Every time constant *τ_i* is
positive, so that it is stable by construction. With
Tustin's pole *p = (2τ − T) / (2τ + T)* and *Δ = 1 − z⁻¹*,

    y = Σ_j Σ_k c_jk Δᵏ z^(−nk_j) G u_j  +  Σ_k s_k Δᵏ G δ  +  o  +  e,      G = Π_i (1 − p_i) / (1 − p_i z⁻¹)

The amplitudes *c* (numerators), *s* (the unknown initial state of each record) and *o* (its offset) enter
linearly and are solved for exactly at every step, so that only the few log time constants are searched
(variable projection). Their sensitivities are filters too, ∂G/∂p_i = −Δ G / ((1 − p_i)(1 − p_i z⁻¹)), so the
Jacobian is analytic.

*e* is the error of the free run: measured *y* is never fed back, unlike in ARX.

Source: Golub and Pereyra, The differentiation of pseudo-inverses and nonlinear least squares problems whose
variables separate (1973), with Kaufman's Jacobian (1975); Ljung, System Identification
(1999), chapter 4 (output error).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.signal import lfilter

from compensator.arrays import Mask, Matrix, Vector
from compensator.errors import DataError
from compensator.model.transfer_function import SampledTransferFunction

#: Directions of the amplitudes with less than this share of the largest singular value are set to zero.
RANK_TOLERANCE = 1e-10
#: Prior of an unknown initial state: no larger than the output's spread, with the weight of one sample whose noise is
#: this share of that spread. It matters only if the data do not determine the state.
STATE_PRIOR = 1e-3
#: Relative change of the cost at which a search ends; another start must gain more.
_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """An interval of measured data without a gap.

    Parameters
    ----------
    inputs : numpy.ndarray, shape (k, n)
        Each input at each sample, finite.
    y : numpy.ndarray, shape (n,)
        Measured output; NaN where missing.
    used : numpy.ndarray of bool, shape (n,)
        Samples of y that are fitted; inputs are always used, because the model runs through.
    rest : bool
        Whether it is known to start at rest; otherwise its initial state is fitted.
    """

    inputs: Matrix
    y: Vector
    used: Mask
    rest: bool = False

    @classmethod
    def of(
        cls, inputs: npt.ArrayLike, y: npt.ArrayLike, used: npt.ArrayLike | None = None, *, rest: bool = False
    ) -> Segment:
        """Make a segment; by default every finite sample of y is used."""
        u, values = np.atleast_2d(np.asarray(inputs, dtype=float)), np.asarray(y, dtype=float)
        finite = np.isfinite(values)
        mask = finite if used is None else finite & np.asarray(used, dtype=bool)
        return cls(inputs=u, y=values, used=mask, rest=rest)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """What is known of the amplitudes before few or noisy data: what these do not determine stays near it.

    The gain of an input at rest has a normal distribution about 0 with a standard deviation that no machine exceeds by
    much; what each further amplitude adds to the output is about as large as the output at most.

    Parameters
    ----------
    noise : float
        Standard deviation of one measured output, which weighs the prior against the data.
    gains : tuple of float
        Standard deviation of the gain at rest of each input.
    spread : float
        Standard deviation of the measured output.
    """

    noise: float
    gains: tuple[float, ...]
    spread: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """Structure of a fit: common denominator order, and numerator terms of each input.

    Parameters
    ----------
    order : int
        Number of poles, nf.
    terms : tuple of int
        Numerator terms of each input, nb.
    prior : Prior, optional
        What is known of the amplitudes; by default nothing.
    """

    order: int
    terms: tuple[int, ...]
    prior: Prior | None = None

    def __post_init__(self) -> None:
        if self.order < 0 or not self.terms or min(self.terms) < 1:
            raise DataError(f"structure nb {self.terms} nf {self.order}: expected nb > 0, nf >= 0")

    @property
    def amplitudes(self) -> int:
        """Number of numerator coefficients."""
        return sum(self.terms)

    @property
    def parameters(self) -> int:
        """Number of parameters of the dynamics: poles and numerators."""
        return self.order + self.amplitudes

    def __str__(self) -> str:
        nb, nk = " ".join(map(str, self.terms)), " ".join("0" for _ in self.terms)
        return f"nb {nb}, nf {self.order}, nk {nk}"


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputErrorFit:
    """Result of a fit.

    Parameters
    ----------
    structure : Structure
        Orders.
    period_s : float
        Sample period, s.
    taus_min : numpy.ndarray, shape (order,)
        Time constants, ascending, min.
    longest_min : float
        Bound of the time constants: the longest stretch of data, min.
    amplitudes : numpy.ndarray, shape (structure.amplitudes,)
        *c_jk*, input by input.
    nuisances : tuple of numpy.ndarray
        For each segment: initial state *s* (if fitted), then the offset (if fitted).
    covariance : numpy.ndarray
        Covariance of (log τ, c), times the variance inflation.
    residuals : tuple of numpy.ndarray
        y − ŷ of each segment, also where y was not fitted; NaN where it is missing.
    sigma : float
        Standard deviation of the residual on the samples used.
    variance_inflation : float
        Spectral density of the residual at low frequencies over its variance: 1 for white noise. The effective sample
        size is the number of samples over it.
    rank_deficit : int
        Directions of the amplitudes that the data does not determine.
    """

    structure: Structure
    period_s: float
    taus_min: Vector
    longest_min: float
    amplitudes: Vector
    nuisances: tuple[Vector, ...]
    covariance: Matrix
    residuals: tuple[Vector, ...]
    sigma: float
    variance_inflation: float
    rank_deficit: int

    @property
    def taus_std_min(self) -> Vector:
        """Standard errors of the time constants, min."""
        return self.taus_min * np.sqrt(np.diag(self.covariance)[: self.taus_min.size])

    def function(self, j: int = 0) -> SampledTransferFunction:
        """Return the transfer function of input `j`."""
        b, a, _ = self._coefficients(j)
        return SampledTransferFunction(b=tuple(b.tolist()), a=(1.0, *a.tolist()), period_s=self.period_s)

    def coefficient_covariance(self, j: int = 0) -> Matrix:
        """Return the covariance of `b_0 … b_m, a_1 … a_n` of input `j`."""
        jacobian = self._coefficients(j)[2]
        return np.asarray(jacobian @ self.covariance @ jacobian.T)

    def gain(self, j: int = 0) -> tuple[float, float]:
        """Return the gain at rest of input `j` and its standard error: *c_j0*, because Δ is 0 at rest."""
        i = self._first(j)
        k = self.structure.order + i
        return float(self.amplitudes[i]), float(np.sqrt(self.covariance[k, k]))

    def simulate(self, inputs: npt.ArrayLike) -> Vector:
        """Compute the response of all inputs together from rest, shape (n,)."""
        return self.simulate_with_std(inputs)[0]

    def simulate_with_std(self, inputs: npt.ArrayLike) -> tuple[Vector, Vector]:
        """Compute the response from rest and its standard error, shape (n,) each."""
        u = np.atleast_2d(np.asarray(inputs, dtype=float))
        poles = poles_of(self.taus_min, self.period_s)
        columns = _input_columns(u, poles, self.structure)
        response: Vector = np.asarray(columns @ self.amplitudes)
        slopes = pole_slopes(self.taus_min, self.period_s)
        gradient = np.column_stack((_sensitivities(response, poles, slopes), columns))
        variance = np.einsum("ij,jk,ik->i", gradient, self.covariance, gradient)
        return response, np.sqrt(np.maximum(variance, 0.0))

    def free_decay(self, segment: int, n: int) -> Vector:
        """Return the share of a segment's fitted initial state in `n` samples, without its offset."""
        own = self.nuisances[segment]
        states = own[:-1]
        if states.size == 0:
            return np.zeros(n)
        blank = Segment.of(np.zeros((1, n)), np.zeros(n))
        poles = poles_of(self.taus_min, self.period_s)
        return np.asarray(_nuisance_columns(blank, poles, self.structure)[:, : states.size] @ states)

    def offset(self, segment: int) -> float:
        """Return the fitted zero of a segment's output."""
        return float(self.nuisances[segment][-1])

    def about_own_start(self, residual: Vector, segment: Segment) -> Vector:
        """Return the residual of a segment less what its zero and initial state explain of its samples used."""
        table = _nuisance_columns(segment, poles_of(self.taus_min, self.period_s), self.structure)
        own = np.linalg.lstsq(table[segment.used], residual[segment.used], rcond=None)[0]
        return np.asarray(residual - table @ own)

    def _first(self, j: int) -> int:
        return sum(self.structure.terms[:j])

    def _coefficients(self, j: int) -> tuple[Vector, Vector, Matrix]:
        """Return b, a_1 …, and their derivatives by (log τ, c)."""
        poles = poles_of(self.taus_min, self.period_s)
        n, m = poles.size, self.structure.terms[j]
        differences = np.zeros((m, m))
        row = np.array([1.0])
        for k in range(m):
            differences[: row.size, k] = row
            row = np.convolve(row, [1.0, -1.0])
        scale = float(np.prod(1.0 - poles))
        first = self._first(j)
        b = scale * differences @ self.amplitudes[first : first + m]
        a = np.poly(poles) if n else np.ones(1)
        jacobian = np.zeros((b.size + n, self.covariance.shape[0]))
        jacobian[: b.size, n + first : n + first + m] = scale * differences
        slopes = pole_slopes(self.taus_min, self.period_s)
        for i in range(n):
            others = np.poly(np.delete(poles, i)) if n > 1 else np.ones(1)
            jacobian[: b.size, i] = -b / (1.0 - poles[i]) * slopes[i]
            jacobian[b.size :, i] = -others * slopes[i]
        return b, np.asarray(a[1:]), jacobian


def poles_of(taus_min: Vector, period_s: float) -> Vector:
    """Return Tustin's poles of time constants, *p = (2τ − T) / (2τ + T)*."""
    period = period_s / 60.0
    return np.asarray((2.0 * taus_min - period) / (2.0 * taus_min + period))


def pole_slopes(taus_min: Vector, period_s: float) -> Vector:
    """Return dp / d log τ."""
    period = period_s / 60.0
    return np.asarray(4.0 * period * taus_min / (2.0 * taus_min + period) ** 2)


def _through(poles: Vector, u: Matrix) -> Matrix:
    """Filter by G, section by section: the expanded polynomial of slow poles is ill-conditioned."""
    out = u
    for p in poles:
        out = lfilter([1.0 - p], [1.0, -p], out, axis=-1)
    return np.asarray(out, dtype=np.float64)


def _differences(signal: Vector, count: int, table: Matrix) -> None:
    """Write a signal and its differences of the orders below `count` into the columns of a table."""
    for k in range(count):
        if k:
            # As `np.diff` with a 0 before it, in a fraction of its time: a search takes thousands of them.
            before, signal = signal, signal.copy()
            signal[1:] -= before[:-1]
        table[:, k] = signal


def _input_columns(u: Matrix, poles: Vector, structure: Structure) -> Matrix:
    table, first = np.empty((u.shape[-1], structure.amplitudes)), 0
    for signal, terms in zip(_through(poles, u), structure.terms, strict=True):
        _differences(signal, terms, table[:, first : first + terms])
        first += terms
    return table


def _nuisance_columns(segment: Segment, poles: Vector, structure: Structure) -> Matrix:
    n, states = segment.y.size, 0 if segment.rest else poles.size
    table = np.ones((n, states + 1))
    if states:
        impulse = np.zeros(n)
        impulse[0] = 1.0
        _differences(_through(poles, impulse), states, table)
    return table


def _prior_weights(prior: Prior, terms: Sequence[int], columns: Matrix) -> Vector:
    """Return the noise over the standard deviation of each amplitude; columns are those on the samples used."""
    weights: Vector = prior.noise * np.sqrt(np.mean(columns**2, axis=0)) / prior.spread
    weights[np.cumsum([0, *terms[:-1]])] = prior.noise / np.array(prior.gains)
    return weights


def _sensitivities(output: Vector, poles: Vector, slopes: Vector) -> Matrix:
    """Return ∂ŷ / ∂ log τ at fixed amplitudes of a whole dynamic output, shape (n, order)."""
    table = np.empty((output.size, poles.size))
    for i, (p, slope) in enumerate(zip(poles, slopes, strict=True)):
        step = slope / (1.0 - p)
        table[:, i] = lfilter([-step, step], [1.0, -p], output)
    return table


class _Problem:
    """The projected least-squares problem of some segments and a structure."""

    residual: Vector

    def __init__(self, segments: Sequence[Segment], structure: Structure, period_s: float) -> None:
        self.segments, self.structure, self.period_s = segments, structure, period_s
        self.rows = [int(segment.used.sum()) for segment in segments]
        #: Rows of each segment that are used; where all are, nothing is picked out of them.
        self.used = [slice(None) if segment.used.all() else np.flatnonzero(segment.used) for segment in segments]
        self.states = [0 if segment.rest else structure.order for segment in segments]
        prior = np.zeros(sum(self.states) + (structure.amplitudes if structure.prior else 0))
        self.y = np.concatenate([*(segment.y[segment.used] for segment in segments), prior])
        self.count = self.y.size - prior.size
        self._at: Vector | None = None

    def columns(self, poles: Vector) -> list[tuple[Matrix, Matrix]]:
        """Return for each segment the columns of the amplitudes and of its nuisances."""
        return [
            (
                _input_columns(segment.inputs, poles, self.structure),
                _nuisance_columns(segment, poles, self.structure),
            )
            for segment in self.segments
        ]

    def stacked(self, parts: Sequence[tuple[Matrix, Matrix]]) -> Matrix:
        """Return the columns of all segments on the samples used, followed by the rows of the prior."""
        width = self.structure.amplitudes
        own = [nuisance.shape[1] for _, nuisance in parts]
        table = np.zeros((self.y.size, width + sum(own)))
        row, column, prior = 0, width, sum(self.rows)
        each = zip(self.used, parts, self.rows, self.states, strict=True)
        for used, (inputs, nuisance), count, states in each:
            table[row : row + count, :width] = inputs[used]
            table[row : row + count, column : column + nuisance.shape[1]] = nuisance[used]
            for k in range(states):
                table[prior, column + k] = STATE_PRIOR * np.max(np.abs(nuisance[:, k]))
                prior += 1
            row, column = row + count, column + nuisance.shape[1]
        if self.structure.prior is not None:
            measured = table[: self.count, :width]
            table[prior:, :width] = np.diag(_prior_weights(self.structure.prior, self.structure.terms, measured))
        return table

    def solve(self, log_taus: Vector) -> None:
        """Project at these log time constants; a repeated call costs nothing."""
        if self._at is not None and np.array_equal(log_taus, self._at):
            return
        self._at = log_taus.copy()
        self.taus = np.exp(log_taus)
        self.poles = poles_of(self.taus, self.period_s)
        self.parts = self.columns(self.poles)
        table = self.stacked(self.parts)
        self.scale = np.linalg.norm(table, axis=0)
        self.scale[self.scale == 0.0] = 1.0
        q, s, vt = np.linalg.svd(table / self.scale, full_matrices=False)
        keep = s > RANK_TOLERANCE * s[0] if s.size else np.zeros(0, dtype=bool)
        self.q = q[:, keep]
        self.deficit = int(table.shape[1] - keep.sum())
        projected = self.q.T @ self.y
        self.coefficients = (vt[keep].T @ (projected / s[keep])) / self.scale
        self.residual = self.y - self.q @ projected

    def outputs(self) -> list[Vector]:
        """Return the dynamic part of the prediction (without offset) of each segment, on every sample."""
        width = self.structure.amplitudes
        result, column = [], width
        for inputs, nuisance in self.parts:
            states = nuisance.shape[1] - 1
            free = nuisance[:, :states] @ self.coefficients[column : column + states]
            result.append(inputs @ self.coefficients[:width] + free)
            column += nuisance.shape[1]
        return result

    def sensitivities(self) -> Matrix:
        """Return ∂ŷ / ∂ log τ at fixed amplitudes on the samples used."""
        slopes = pole_slopes(self.taus, self.period_s)
        parts = zip(self.outputs(), self.used, strict=True)
        tables: list[Matrix] = [_sensitivities(out, self.poles, slopes)[used] for out, used in parts]
        prior = np.zeros((self.y.size - self.count, self.poles.size))
        stacked: Matrix = np.concatenate([*tables, prior])
        return stacked

    def fun(self, log_taus: Vector) -> Vector:
        """Return the projected residual."""
        self.solve(log_taus)
        return np.asarray(self.residual)

    def jac(self, log_taus: Vector) -> Matrix:
        """Return Kaufman's Jacobian of the projected residual."""
        self.solve(log_taus)
        table = self.sensitivities()
        return np.asarray(-(table - self.q @ (self.q.T @ table)))


def fit_output_error(
    segments: Sequence[Segment], structure: Structure, *, period_s: float, starts: Sequence[Sequence[float]]
) -> OutputErrorFit:
    """Fit by output error.

    Parameters
    ----------
    segments : sequence of Segment
        One or several intervals of data; time constants and numerators are common, initial state and
        offset are fitted for each interval.
    structure : Structure
        Orders.
    period_s : float
        Sample period, s.
    starts : sequence of sequence of float
        Initial time constants, min, each of length `structure.order`; the best result is returned.

    Returns
    -------
    OutputErrorFit
        Result with residuals of every sample, also of those that were not fitted.

    Raises
    ------
    DataError
        If there are fewer samples than parameters.

    Examples
    --------
    >>> u = np.repeat([0.0, 1.0, 0.0], 60)
    >>> y = lfilter([0.2], [1.0, -0.9], u)
    >>> fit = fit_output_error([Segment.of(u, y)], Structure(order=1, terms=(1,)), period_s=60.0, starts=[[3.0]])
    >>> round(fit.gain()[0], 6), [round(float(t), 6) for t in fit.taus_min]
    (2.0, [9.5])
    """
    problem = _Problem(segments, structure, period_s)
    needed = structure.parameters + sum(structure.order * (not s.rest) + 1 for s in segments)
    if problem.count <= needed:
        raise DataError(f"{problem.count} measured sample(s) for {needed} parameters ({structure})")
    search(problem, starts, bounds_of(problem, period_s))
    return result_of(problem)


class Projected(Protocol):
    """A least-squares problem in log time constants from which the amplitudes are projected out."""

    structure: Structure

    @property
    def residual(self) -> Vector:
        """Projected residual where it was solved last."""

    def solve(self, log_taus: Vector) -> None:
        """Project at these log time constants."""

    def fun(self, log_taus: Vector) -> Vector:
        """Return the projected residual."""

    def jac(self, log_taus: Vector) -> Matrix:
        """Return its Jacobian."""


def search(problem: Projected, starts: Sequence[Sequence[float]], bounds: tuple[float, float]) -> None:
    """Solve a problem at the best log time constants between two bounds, searched from several starts."""
    low, high = bounds
    best: tuple[float, Vector] | None = None
    for start in starts if problem.structure.order else [()]:
        at = np.clip(np.log(np.sort(np.asarray(start, dtype=float))), low + 1e-6, high - 1e-6)
        if problem.structure.order:
            found = least_squares(
                problem.fun,
                at,
                jac=problem.jac,
                bounds=(low, high),
                method="trf",
                x_scale="jac",
                xtol=1e-7,
                ftol=_TOLERANCE,
                gtol=1e-12,
                max_nfev=60,
            )
            at = np.sort(np.asarray(found.x))
        problem.solve(at)
        cost = float(problem.residual @ problem.residual)
        if best is None or cost < best[0] * (1.0 - _TOLERANCE):
            best = (cost, at)
    assert best is not None
    problem.solve(best[1])


def bounds_of(problem: _Problem, period_s: float) -> tuple[float, float]:
    """Return bounds of log τ: from where the pole would turn negative to the longest stretch that is used.

    A mode slower than the data cannot be distinguished from a ramp, and in free run a ramp grows without limit.
    """
    longest = max(_span(segment.used) for segment in problem.segments) * period_s / 60.0
    low = 0.51 * period_s / 60.0
    return float(np.log(low)), float(np.log(max(longest, 10.0 * low)))


def _span(used: Mask) -> int:
    at = np.flatnonzero(used)
    return int(at[-1] - at[0]) + 1 if at.size else 0


def result_of(problem: _Problem) -> OutputErrorFit:
    """Return the fit where a problem was solved last."""
    structure = problem.structure
    width = structure.amplitudes
    coefficients = problem.coefficients
    nuisances, residuals, column = [], [], width
    for segment, (inputs, nuisance) in zip(problem.segments, problem.parts, strict=True):
        own = coefficients[column : column + nuisance.shape[1]]
        nuisances.append(own)
        residuals.append(segment.y - inputs @ coefficients[:width] - nuisance @ own)
        column += nuisance.shape[1]
    freedom = problem.count - coefficients.size - structure.order
    error = problem.residual[: problem.count]
    sigma = float(np.sqrt(error @ error / freedom))
    inflation = max(1.0, low_frequency_ratio([r[s.used] for r, s in zip(residuals, problem.segments, strict=True)]))
    covariance = _covariance(problem, sigma * float(np.sqrt(inflation)))
    keep = structure.order + width
    return OutputErrorFit(
        structure=structure,
        period_s=problem.period_s,
        taus_min=problem.taus.copy(),
        longest_min=float(np.exp(bounds_of(problem, problem.period_s)[1])),
        amplitudes=coefficients[:width].copy(),
        nuisances=tuple(nuisances),
        covariance=covariance[:keep, :keep],
        residuals=tuple(residuals),
        sigma=sigma,
        variance_inflation=inflation,
        rank_deficit=problem.deficit,
    )


def _covariance(problem: _Problem, sigma: float) -> Matrix:
    """Return σ² (JᵀJ)⁻¹ of (log τ, amplitudes, nuisances), scaled so that it can be inverted."""
    jacobian = np.concatenate((problem.sensitivities(), problem.stacked(problem.parts)), axis=1)
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    inverse = vt.T / np.maximum(s, 1e-7 * s[0]) / scale[:, None]
    return np.asarray(sigma**2 * inverse @ inverse.T)


def low_frequency_ratio(residuals: Sequence[Vector]) -> float:
    """Return the spectral density at low frequencies over the variance: the variance inflation of a coloured residual.

    Standard errors assume white residuals. Slow parameters are determined by the low frequencies of the data, where a
    coloured residual has more power than its variance suggests, by this ratio. It is 1 + 2 Σ ρ_k with Bartlett weights
    up to the lag where the correlation first becomes insignificant.
    """
    total = float(sum(r @ r for r in residuals))
    if total == 0.0:
        return 1.0
    longest = min(max(r.size for r in residuals) // 4, 2000)
    size = 1 << int(np.ceil(np.log2(2 * max(r.size for r in residuals))))
    power = np.zeros(size // 2 + 1)
    for r in residuals:
        power += np.abs(np.fft.rfft(r, size)) ** 2
    correlation = np.fft.irfft(power, size)[: longest + 1] / total
    count = sum(r.size for r in residuals)
    below = np.flatnonzero(correlation < 2.0 / np.sqrt(count))
    last = int(below[0]) if below.size else longest
    lags = np.arange(1, last)
    return float(1.0 + 2.0 * np.sum((1.0 - lags / (2.0 * max(last, 1))) * correlation[1:last]))
