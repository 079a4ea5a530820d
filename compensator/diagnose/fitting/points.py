"""Measured data averaged to points, and what no effect explains in them.

For speed, blocks of samples are averaged to about `POINTS` points; a value that was measured now and then is a point of
its own.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from compensator.arrays import Indices, Mask, Matrix, Vector
from compensator.diagnose.residual.evidence import Evidence
from compensator.model.effects.blocks import FilterBank, Lag, lag_or_none
from compensator.model.effects.hypothesis import Context, Hypothesis

#: Points that the samples are averaged to.
POINTS = 700
#: Averaged columns that are kept.
MOST_KNOWN = 3000
#: Last minutes of a run that are compared with nothing, and at most this share of it.
ENDS_MIN, ENDS_SHARE = 10.0, 0.05
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
STATE_SHARE = 0.1
#: Typical slow rest where nothing is known of the paths, as a share of the spread of the deformation.
SLOW_SHARE = 0.03
#: Typical time constant of the slow rest, min, and how far (in e-folds) noise, slow rest, its time constant, the
#: initial state and the paths' fast error may be from what is typical.
REST_MIN, REST_FOLDS = 60.0, (0.4, 1.0, 1.0, 2.0, 0.5)


@dataclass(frozen=True, slots=True)
class SlowRest:
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

    @property
    def logs(self) -> Vector:
        """Logarithms of what is learned: noise, slow rest, its time constant, initial state, fast error, shape (5,)."""
        return np.log([self.noise_um, self.slow_um, self.tau_min, self.start_um, max(self.fast_um, 1e-9)])

    def with_logs(self, logs: Vector) -> SlowRest:
        """Return the rest with other values of what is learned."""
        noise_um, slow_um, tau_min, start_um, fast_um = np.exp(logs).tolist()
        return SlowRest(noise_um, slow_um, tau_min, start_um, fast_um, self.own_um, self.forms)

    def without_own_error(self) -> SlowRest:
        """Return the rest for a base whose paths are exact."""
        return dataclasses.replace(self, fast_um=0.0, own_um=0.0, forms=())


class Points:
    """The evidence, averaged to points.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals.
    foretells : bool
        Whether the fit is to foretell other days: then each lag of an own error, and of an effect with several, has a
        gain at rest of one expected size, so that what moved little in the record is expected to be small. Otherwise
        every distinct response of the own error may be as large as any other: what the base may miss has no name.

    Attributes
    ----------
    residual : numpy.ndarray, shape (points,)
        Residual, µm.
    count : int
        Number of points.
    first : numpy.ndarray of int, shape (points,)
        First sample of each point.
    starts : numpy.ndarray of int
        First point of each run that has any.
    period_min : float
        Time between two points, min; where Y was measured now and then the median.
    alike : list of (int, int)
        Stretches of points with one noise and one time to the next, from the first to behind the last.
    relative_variance : numpy.ndarray, shape (points,)
        Variance of the noise of each point, relative to a full one.
    is_exact : bool
        Whether effects have their form exactly: no error of the calibration is stated, or the paths are free.
    spread_um, own_um : float
        Standard deviation of the deformation, and the own error of the base's paths, µm.
    typical_logs : numpy.ndarray, shape (5,)
        `SlowRest.logs` as it is expected before the data are seen.
    zeros, starts_of_modes, fast, slow : numpy.ndarray, shape (points, ·)
        Columns of the zeros and initial states of runs, and of the fast and slow error of the base's paths.
    """

    def __init__(self, evidence: Evidence, *, foretells: bool = False) -> None:
        self.evidence, self.foretells = evidence, foretells
        context = evidence.context
        self.is_exact = not context.approximate or evidence.free_paths
        # The same for all data and for what is left where something is held out.
        # A value that was measured now and then is a point of its own.
        stride = 1 if evidence.is_sparse else max(1, math.ceil(int(np.isfinite(evidence.y_um).sum()) / POINTS))
        edges = _edges(evidence, stride)
        first = np.concatenate(edges)
        used = evidence.used & ~_ends(evidence)
        counts = np.add.reduceat(used.astype(float), first)
        is_value, run = (np.repeat(each, [e.size for e in edges]) for each in (evidence.sparse, range(len(edges))))
        kept = counts >= np.where(is_value, 1.0, max(1.0, stride / 2.0))
        self.count, self.first = int(kept.sum()), first[kept]
        self.starts = np.flatnonzero(np.diff(run[kept], prepend=-1))
        minutes = context.period_min * np.diff(self.first, append=first[-1] + stride)
        self.period_min = context.period_min * stride
        if is_value.any():
            self.period_min = max(self.period_min, float(np.median(minutes[:-1])))
        self._lengths = np.unique(minutes, return_inverse=True)
        self.relative_variance = stride / counts[kept]
        self.alike = self._alike()
        self._mean = _means(used, first, kept)
        self.residual = self.averaged(evidence.residual[:, None])[:, 0]
        self.spread_um = max(evidence.spread_um, 1e-9)
        self.own_um = self._own_um()
        self.typical_logs = self._typical_logs(stride)
        self.fast, self.slow, self._by_paths = self._own_columns()
        self._forms: dict[str, tuple[Matrix, Matrix]] = {}
        self._known: dict[tuple[Hypothesis, tuple[float, ...]], Matrix] = {}
        self.zeros = ZERO_TIMES * self.spread_um * self.averaged(evidence.zeros)
        self.starts_of_modes = self.averaged(evidence.decays)

    def of(self, evidence: Evidence, *, foretells: bool | None = None) -> Points:
        """Return the points of other evidence, or those of it that foretell."""
        return Points(evidence, foretells=self.foretells if foretells is None else foretells)

    def _own_um(self) -> float:
        evidence = self.evidence
        if evidence.free_paths:
            return self.spread_um
        share = EXACT_OWN if self.is_exact or evidence.is_sparse else 1.0
        return max(evidence.noise.own_error_um, share * evidence.probe_um)

    def _typical_logs(self, stride: int) -> Vector:
        noise_um = self.evidence.probe_um / math.sqrt(stride)
        # What a calibration or the form of a path misses is no slow process: it is largest right after a change.
        if self.evidence.free_paths:
            noise_um = math.hypot(noise_um, FORM_ERROR[1] * self.spread_um)
        elif not self.is_exact:
            noise_um = math.hypot(noise_um, self.own_um)
        slow_um = SLOW_SHARE * self.spread_um if self.evidence.free_paths else self.own_um
        return np.log([max(noise_um, 1e-3), slow_um, REST_MIN, STATE_SHARE * self.spread_um, self.own_um])

    def _alike(self) -> list[tuple[int, int]]:
        """Return stretches of points with one noise and one time to the next; the last of a run is by itself."""
        what = np.column_stack([self.relative_variance, self._lengths[1]])
        new = np.any(np.diff(what, axis=0) != 0.0, axis=1)
        last = self.starts[1:] - 1
        edges = np.unique(np.concatenate([[0], np.flatnonzero(new) + 1, last, last + 1, [self.count]]))
        return list(itertools.pairwise(edges.tolist()))

    def decays(self, tau_min: float) -> Vector:
        """Return what is left of a slow process from each point to the next, shape (points,)."""
        lengths, which = self._lengths
        return np.array([math.exp(-length / tau_min) for length in lengths.tolist()])[which]

    def averaged(self, table: Matrix) -> Matrix:
        """Return the means of columns over the samples used of each point, shape (points, columns)."""
        return np.asarray(self._mean @ table)

    def columns_of(self, hypothesis: Hypothesis, values: tuple[float, ...]) -> Matrix:
        """Return the averaged columns of a hypothesis; one fit after another asks for the same."""
        known = self._known.get((hypothesis, values))
        if known is None:
            known = self.averaged(raw_columns(self.evidence, hypothesis, values))
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[hypothesis, values] = known
        return known

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
        about_mean = points - points.mean(axis=0)
        spread = np.sqrt(np.einsum("ij,ij->j", about_mean, about_mean) / max(len(points), 1))
        if self.foretells:
            spread = np.full(spread.shape, np.max(spread, initial=0.0))
        spread[spread < 1e-12] = 1.0
        scale = self.spread_um / spread
        if sizes:
            scale = np.minimum(scale, np.resize(sizes, scale.size))
        scale = scale / math.sqrt(together)
        return points * scale, scale

    def typical_rest(self) -> SlowRest:
        """Return a rest as it is expected before the data are seen."""
        return SlowRest(0.0, 0.0, 0.0, 0.0, 0.0, self.own_um).with_logs(self.typical_logs)

    def with_forms_of(self, rest: SlowRest, sizes_um: Mapping[str, float]) -> SlowRest:
        """Return a rest with the errors that effects have whose form is not quite theirs.

        Parameters
        ----------
        rest : SlowRest
            Where the other values come from.
        sizes_um : mapping of str to float
            Standard deviation of what each channel adds by effects, µm; of the base's paths under an empty name.
        """
        share = FORM_ERROR[0 if self.is_exact else 1]
        forms = tuple((channel, share * size) for channel, size in sizes_um.items() if channel)
        return dataclasses.replace(rest, own_um=math.hypot(self.own_um, share * sizes_um.get("", 0.0)), forms=forms)

    def zeros_and_starts(self, rest: SlowRest) -> Matrix:
        """Return the first columns of `random`, zeros and initial states, on every sample."""
        zeros_um = ZERO_TIMES * self.spread_um * self.evidence.zeros
        return np.concatenate([zeros_um, rest.start_um * self.evidence.decays], axis=1)

    def random(self, rest: SlowRest) -> Matrix:
        """Return columns whose weights are unknown with standard deviation 1.

        Zeros, initial states, fast and slow own error, errors of form.
        """
        starts, forms = rest.start_um * self.starts_of_modes, [size * self.form(name) for name, size in rest.forms]
        return np.concatenate([self.zeros, starts, rest.fast_um * self.fast, rest.own_um * self.slow, *forms], axis=1)

    def made_of(self, rest: SlowRest) -> list[tuple[str, Matrix]]:
        """Return what the columns of `random` behind the initial states are made of, in their order.

        For each input its name, a path or a channel, and the gains behind `lags_of_paths`, shape (lags, columns).
        """
        sizes = (rest.fast_um, rest.own_um)
        paths = [(name, size * gains) for by, size in zip(self._by_paths, sizes, strict=True) for name, gains in by]
        return paths + [(name, size * self._form(name)[1]) for name, size in rest.forms]

    def form(self, channel: str) -> Matrix:
        """Return responses of any linear path from a channel, of size 1 together."""
        return self._form(channel)[0]

    def _form(self, channel: str) -> tuple[Matrix, Matrix]:
        if channel not in self._forms:
            lags, table = self._lagged([record.channels[channel] for record in self.evidence.signals])
            self._forms[channel] = self._distinct(table, np.eye(lags.size))
        return self._forms[channel]

    def log_prior(self, rest: SlowRest) -> float:
        """Return the logarithm of the prior of a rest."""
        return -0.5 * float(np.sum(((rest.logs - self.typical_logs) / REST_FOLDS) ** 2))

    def _own_columns(self) -> tuple[Matrix, Matrix, tuple[list[tuple[str, Matrix]], list[tuple[str, Matrix]]]]:
        """Return fast and slow responses of any linear paths to heat and ambient temperature, of size 1 each.

        And what they are made of: gains of each path.
        """
        paths, records = self.evidence.context.paths, self.evidence.signals
        fast, slow = list[tuple[Matrix, Matrix]](), list[tuple[Matrix, Matrix]]()
        for path in paths:
            lags, table = self._lagged([record.source(path) for record in records])
            each, is_slow = np.eye(lags.size), lags >= FAST_MIN
            # Without a gain at rest, a fast response is one of timing; in about an hour every lag is fast.
            reference = each[:, np.flatnonzero(is_slow)[:1]] if is_slow.any() else each[:, -1:]
            fast.append(self._distinct(table, each[:, ~is_slow] - reference))
            slow.append(self._distinct(table, each[:, is_slow]))
        by_paths = [list(zip(paths, (gains for _, gains in each), strict=True)) for each in (fast, slow)]
        columns = [np.concatenate([table for table, _ in each], axis=1) for each in (fast, slow)]
        return columns[0], columns[1], (by_paths[0], by_paths[1])

    def _lagged(self, drives: Sequence[Vector]) -> tuple[Vector, Matrix]:
        """Return the lags of any linear path, and a drive behind each of them."""
        context = self.evidence.context
        lags = lags_of_paths(context)
        lag = lag_or_none if self.foretells else Lag
        bank = FilterBank(lags, [(1.0,) * len(lags)], context.period_min, lag)
        return np.array(lags), self.averaged(np.concatenate([bank.columns(drive) for drive in drives]))

    def _distinct(self, table: Matrix, gains: Matrix) -> tuple[Matrix, Matrix]:
        """Return distinct combinations of responses, orthogonal and together of size 1, and their gains."""
        table = table @ gains
        if not table.shape[1]:
            return table, gains
        scale = 1.0 if self.foretells else 1.0 / np.maximum(np.std(table, axis=0), 1e-12)
        table, gains = table * scale, gains * scale
        _, sizes, directions = np.linalg.svd(table - table.mean(axis=0), full_matrices=False)
        kept = sizes > DISTINCT * sizes[0]
        together = np.linalg.norm(sizes) if self.foretells else sizes[kept] * math.sqrt(kept.sum())
        combined = directions[kept].T / np.maximum(together, 1e-12) * math.sqrt(self.count)
        return table @ combined, gains @ combined


def raw_columns(evidence: Evidence, hypothesis: Hypothesis, values: Sequence[float]) -> Matrix:
    """Return the columns of a hypothesis on every sample."""
    return np.concatenate([hypothesis.columns(record, values) for record in evidence.signals])


def _ends(evidence: Evidence) -> Mask:
    """Return the last minutes of each run: of a late T_Q only what comes after them says what acted in them.

    They take part in no comparison, so that every explanation is compared on the same samples. A value that was
    measured now and then is not given up, and where the model corrects a late T_Q already the engine uses no future.
    """
    ends = np.zeros(evidence.used.size, dtype=bool)
    for record, run, is_sparse in zip(evidence.signals, evidence.samples_of_runs(), evidence.sparse, strict=True):
        minutes = min(ENDS_MIN, ENDS_SHARE * record.size * record.period_min)
        if not is_sparse and evidence.model.late_t_q is None:
            ends[run.stop - round(minutes / record.period_min) : run.stop] = True
    return ends


def _edges(evidence: Evidence, stride: int) -> list[Indices]:
    """Return the first sample of each point, for each run; a value measured now and then is a point of its own."""
    return [
        run.start + np.flatnonzero(evidence.used[run]) if sparse else np.arange(run.start, run.stop, stride)
        for run, sparse in zip(evidence.samples_of_runs(), evidence.sparse, strict=True)
    ]


def _means(used: Mask, first: Indices, kept: Mask) -> csr_array:
    """Return what takes samples to the means of those that are used, for the points that are kept."""
    point = np.searchsorted(first, np.flatnonzero(used), side="right") - 1
    number = np.cumsum(kept) - 1
    columns, rows = np.flatnonzero(used)[kept[point]], number[point[kept[point]]]
    counts = np.bincount(rows)
    return csr_array((1.0 / counts[rows], (rows, columns)), shape=(counts.size, used.size))


def lags_of_paths(context: Context) -> tuple[float, ...]:
    """Return lags that any linear path is made of, min."""
    return (0.0, *context.lags_min(OWN_LAGS))
