"""What all logged channels together explain, in a regularised way and without naming anything.

Every channel acts on Y through a filter bank; the gains of a channel have a Gaussian prior of a common size, the sizes
of all channels are nearly the same and learned from the data with the slow rest (empirical Bayes). Nothing is chosen,
so nothing is chosen wrongly: it is the best linear use of the channels, a *ceiling* for what named effects explain,
and a *remainder* that can be deployed beside them. Where the data say little its gains stay near zero, and their
covariance says so.

Sources: Tipping, Sparse Bayesian learning (2001); Pillonetto, Dinuzzo, Chen, De Nicolao, Ljung, Kernel methods in
system identification (Automatica 2014).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fitting.likelihood import STEP, RandomColumns
from compensator.diagnose.fitting.points import Points, SlowRest, lags_of_paths
from compensator.diagnose.fitting.whitening import Whitening
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.refitted_paths import with_fewer_lags
from compensator.model.effects.blocks import FilterBank
from compensator.model.effects.hypothesis import Context
from compensator.model.effects.regression import AMBIENT, DRIVE, MOST_CHANNELS, MOST_ROWS, Regression

#: Lags of the filter bank, min; those that are longer than a third of the record are left out.
LAGS_MIN = (0.0, 4.0, 12.0, 35.0, 100.0, 300.0)
#: Those of a response to the last minutes alone: the gains of a channel add up to zero.
RECENT_MIN = (0.0, 4.0, 12.0, 35.0)
#: Standard deviation of the logarithm of a channel's size about their mean: nearly one size for all.
ALIKE = 0.2
#: Typical size of a channel, as a share of the deformation's spread.
SIZE_SHARE = 0.1
#: Standard deviation of the logarithm of the mean size about that, and of the sizes of the base's own paths.
MEAN_FOLDS, PATH_FOLDS = 2.0, 1.0
#: A column that moves by less than this share of its largest value is one of rounding.
STILL = 1e-9
#: Most evaluations of the gradient in the search of the rest and of the sizes.
EVALUATIONS = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class Regressed:
    """A regularised linear response of all channels.

    Parameters
    ----------
    effect : Regression
        With the covariance of its gains.
    added : numpy.ndarray, shape (n,)
        What it adds to y on every sample, µm.
    log_evidence : float
        Logarithm of the probability of the data with it.
    rest : SlowRest
        What it leaves unexplained.
    """

    effect: Regression
    added: Vector
    log_evidence: float
    rest: SlowRest

    def times(self, share: float) -> Regressed:
        """Return a share of the response; what is open of it stays as it is."""
        gains = tuple(tuple(share * gain for gain in row) for row in self.effect.gains)
        return dataclasses.replace(self, effect=dataclasses.replace(self.effect, gains=gains), added=share * self.added)


class Background:
    """All channels through filter banks.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals.
    channels : bool
        Whether channels act, or only the base's own paths.
    recent : bool
        Whether only channels act, and only by what they have shown in the last minutes.
    """

    def __init__(self, evidence: Evidence, *, channels: bool = True, recent: bool = False) -> None:
        context = evidence.context
        base = _inputs_of_base(context)
        base = () if recent else base
        paths, inputs = len(base), [(name, 1.0) for name in base]
        if channels:
            named = most_alike(evidence, MOST_CHANNELS - paths)
            inputs += [(name, 1.0) for name in named]
            inputs += [(name, 2.0) for name in named if name in context.zeroed]
        inputs = inputs[:MOST_CHANNELS]
        taus = tuple(tau for tau in LAGS_MIN if tau <= context.minutes / 3.0) if channels else lags_of_paths(context)
        taus = RECENT_MIN if recent else taus
        self.template = Regression(
            channels=tuple(name for name, _ in inputs),
            exponents=tuple(exponent for _, exponent in inputs),
            taus_min=taus,
            gains=((0.0,) * len(taus),) * len(inputs),
            std_factor=(),
        )
        blocks = self.template.blocks(context.period_min)
        of_gains = np.concatenate([self.template.columns(record, blocks) for record in evidence.signals])
        #: The gains of the free weights, and the columns of these.
        self.made_of: Matrix = np.eye(of_gains.shape[1])
        if recent:
            self.made_of = np.asarray(
                np.kron(np.eye(len(inputs)), np.vstack([np.eye(len(taus) - 1), -np.ones(len(taus) - 1)]))
            )
        self.columns = of_gains @ self.made_of if recent else of_gains
        self._of_gains, self._period_min = of_gains, context.period_min
        self.groups = np.repeat(np.arange(len(inputs)), len(taus) - recent)
        # The sizes of the base's own paths are known apart from those of channels.
        self.is_path = np.arange(len(inputs)) < paths

    def fitted(self, points: Points, explained: Vector, start: SlowRest) -> Regressed:
        """Fit to what named effects leave.

        Parameters
        ----------
        points : Points
            Which samples take part.
        explained : numpy.ndarray, shape (points,)
            What the named effects add, µm.
        start : SlowRest
            Where the search of the rest begins.
        """
        return _Problem(self, points, explained).solved(start)

    def as_paths(self, banks: Matrix) -> Matrix:
        """Return gains, shape (inputs, lags), with those of the base's own paths as a model can have them."""
        taus_min, period_min = self.template.taus_min, self._period_min
        found = banks.copy()
        for i in np.flatnonzero(self.is_path).tolist():
            own = self._of_gains[:, i * len(taus_min) : (i + 1) * len(taus_min)]
            found[i] = with_fewer_lags(banks[i], taus_min, period_min, own)
        return found

    def response(self, effect: Regression) -> Vector:
        """Return what a regression over these channels adds to y on every sample, µm."""
        return np.asarray(self._of_gains @ np.ravel(effect.gains))

    def directions(self, points: Points, root: Matrix) -> tuple[tuple[float, ...], ...]:
        """Return what the data leave open of the gains, from a root of the covariance of the free weights."""
        return strongest(self.made_of @ root, points.averaged(self._of_gains))


class _Problem:
    """The search of the rest and of the sizes of all channels: their logarithms, in this order."""

    def __init__(self, background: Background, points: Points, explained: Vector) -> None:
        self.background, self.points = background, points
        table = points.averaged(background.columns)
        moves = self.scale = np.std(table, axis=0)
        if not points.evidence.free_paths:
            # All lags of a channel have gains of one expected size: what moved little in the record is to be small.
            self.scale = np.array([np.max(moves[background.groups == group]) for group in background.groups])
        # What is left of a channel that moves only in what is held out says nothing.
        still = moves < np.maximum(STILL * np.max(np.abs(background.columns), axis=0), 1e-12)
        self.scale = np.where(still, np.inf, self.scale)
        self.table = table / self.scale
        random = np.concatenate([points.zeros, points.starts_of_modes], axis=1)
        self._fixed = random.shape[1]
        self._all = np.asfortranarray(np.column_stack([random, self.table, points.residual - explained]))
        self.groups, self.is_path = background.groups, background.is_path
        size, unknown = SIZE_SHARE * points.spread_um, points.evidence.free_paths
        self.typical_size, self.typical_path = np.log([size, size if unknown else points.own_um]).tolist()
        self.path_folds = MEAN_FOLDS if unknown else PATH_FOLDS
        typical = points.typical_rest()
        self.typical_rest = np.log([typical.slow_um, typical.tau_min, typical.start_um])

    def solved(self, start: SlowRest) -> Regressed:
        """Return the regression with the most probable sizes."""
        sizes = np.where(self.is_path, self.typical_path, self.typical_size - 1.0)
        begin = np.concatenate([np.log([start.slow_um, start.tau_min, start.start_um]), sizes])
        bounds = [(np.log(1e-3), np.log(1e3)), (np.log(3.0), np.log(3e3)), *[(-12.0, 8.0)] * (sizes.size + 1)]
        begin = np.clip(begin, *np.array(bounds).T)
        options = {"maxfun": EVALUATIONS}
        found = minimize(self._with_gradient, begin, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return self._result(np.asarray(found.x), -float(found.fun))

    def _rest(self, x: Vector) -> SlowRest:
        slow_um, tau_min, start_um = np.exp(x[:3]).tolist()
        typical = self.points.typical_rest()
        return dataclasses.replace(typical.without_own_error(), slow_um=slow_um, tau_min=tau_min, start_um=start_um)

    def _white(self, x: Vector) -> tuple[Matrix, Vector, float]:
        """Return zeros, initial states and channels of their sizes, and the target, whitened; the log determinant."""
        whitening = Whitening(self.points, self._rest(x))
        white = whitening.of(self._all)
        first = self.points.zeros.shape[1]
        white[:, first : self._fixed] *= np.exp(x[2])
        white[:, self._fixed : -1] *= np.exp(x[3:])[self.groups]
        return white[:, :-1], white[:, -1], whitening.log_det

    def _prior(self, x: Vector) -> tuple[float, Vector]:
        sizes, channels, slopes = x[3:], ~self.is_path, np.zeros(x.size)
        folds = np.array([1.0, 1.0, MEAN_FOLDS])
        off = (x[:3] - self.typical_rest) / folds
        value = -0.5 * float(off @ off)
        slopes[:3] -= off / folds
        if channels.any():
            mean = sizes[channels].mean()
            apart = sizes[channels] - mean
            far = (mean - self.typical_size) / MEAN_FOLDS
            value -= 0.5 * float(np.sum(apart**2)) / ALIKE**2 + 0.5 * far**2
            slopes[3:][channels] -= apart / ALIKE**2 + far / MEAN_FOLDS / channels.sum()
        path = (sizes[self.is_path] - self.typical_path) / self.path_folds
        value -= 0.5 * float(path @ path)
        slopes[3:][self.is_path] -= path / self.path_folds
        return value, slopes

    def _with_gradient(self, x: Vector) -> tuple[float, Vector]:
        model = RandomColumns(*self._white(x))
        prior, slopes = self._prior(x)
        surplus = model.surplus(model.mean.size)
        slopes[2] += surplus[self.points.zeros.shape[1] : self._fixed].sum()
        slopes[3:] += np.bincount(self.groups, weights=surplus[self._fixed :], minlength=self.is_path.size)
        slopes[:2] -= model.slopes((self._white(x + STEP * (np.arange(x.size) == i)) for i in range(2)), STEP)
        return model.surprise - prior, -slopes

    def _result(self, x: Vector, log_evidence: float) -> Regressed:
        white, target, _ = self._white(x)
        gram = np.eye(white.shape[1]) + white.T @ white
        weights = np.exp(x[3:])[self.groups] / self.scale
        covariance = np.linalg.inv(gram)[self._fixed :, self._fixed :]
        gains = (np.linalg.solve(gram, white.T @ target)[self._fixed :]) * weights
        sizes, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
        root = axes * np.sqrt(np.maximum(sizes, 0.0)) * weights[:, None]
        background = self.background
        banks = (background.made_of @ gains).reshape(-1, len(background.template.taus_min))
        if self.points.evidence.free_paths:
            banks = background.as_paths(banks)
        effect = dataclasses.replace(
            background.template,
            gains=tuple(map(tuple, banks.tolist())),
            std_factor=background.directions(self.points, root),
        )
        return Regressed(
            effect=effect,
            added=self.background.response(effect),
            log_evidence=log_evidence,
            rest=self._rest(x),
        )


def room_for_channels(context: Context) -> int:
    """Return how many channels there may be beside the inputs of the base's own paths."""
    return MOST_CHANNELS - len(_inputs_of_base(context))


def most_alike(evidence: Evidence, count: int) -> tuple[str, ...]:
    """Return at most so many of the channels that move, in their order: those whose best lag is most like the residual.

    Parameters
    ----------
    evidence : Evidence
        Residual and channels.
    count : int
        Most channels.
    """
    names = evidence.context.channels
    if len(names) <= count:
        return names
    residual = evidence.without_nuisances(evidence.residual)
    bank = FilterBank(LAGS_MIN, [(1.0,) * len(LAGS_MIN)], evidence.context.period_min)

    def likeness(name: str) -> float:
        courses = [record.channels[name] for record in evidence.signals]
        table = np.concatenate([bank.columns(u - u[0]) for u in courses]) * evidence.used[:, None]
        table = evidence.without_nuisances(table)
        return float(np.max(np.abs(residual @ table) / np.maximum(np.linalg.norm(table, axis=0), 1e-12)))

    kept = sorted(names, key=likeness, reverse=True)[:count]
    return tuple(name for name in names if name in kept)


def _inputs_of_base(context: Context) -> tuple[str, ...]:
    """Return the inputs of the base's own paths."""
    return DRIVE["heat" if context.has_ttf else "direct"], *([AMBIENT] if context.has_ambient else [])


def strongest(root: Matrix, seen: Matrix) -> tuple[tuple[float, ...], ...]:
    """Return the rows of `Regression.std_factor`: the directions of a covariance that matter most for y.

    Parameters
    ----------
    root : numpy.ndarray, shape (gains, k)
        A root of the covariance of the gains.
    seen : numpy.ndarray, shape (points, gains)
        What each gain moves, over what was seen.
    """
    _, _, directions = np.linalg.svd((seen - seen.mean(axis=0)) @ root, full_matrices=False)
    return tuple(map(tuple, (root @ directions[:MOST_ROWS].T).T.tolist()))
