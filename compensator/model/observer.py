"""Heat, path states and their uncertainty from T_Q and AT, one sample at a time.

The three paths form one state vector, each in observer canonical form, together with the drive *q* (heat, W, or
T_Q − AT, K, in a direct model) and the ambient change *a* as random walks:

    x[k+1] = F x[k] + w,   w_q ~ N(0, drive_walk²),  w_a ~ N(0, at_walk²)
    AT     = a + v_a
    T_Q    = C₁ x₁ + D₁ q + C₄ x₄ + D₄ a + v_q
    y      = C₂ x₂ + D₂ q + C₃ x₃ + D₃ a

The fourth path leads from the ambient to T_Q: 1, or the lag of a late T_Q, which is then in the first path, too.
In a direct model with a late T_Q the drive may be behind *q* by a lag, which is then in every path from the drive.
Further parts of a model, such as those of other axes, add a DTF and a TDTF each, driven by the same *q* and *a*;
nothing leads from them to T_Q, so they leave the estimates of the others as they are.

Both ways to estimate the heat are observers of this system; only their gains differ:

- `inverse`: a = AT and q = (T_Q − AT − C₁ x₁) / D₁, which is exactly the paper's TTF⁻¹;
- `kalman`: the optimal gains for white sensor noise.

A missing measurement skips its update: the drive keeps its value, the state moves on. The gains, and how uncertain the
state is, are those of its covariance (`covariance`), into which no measured value enters. Arithmetic is scalar float or
element-wise, never a matrix product of a BLAS, whose order of summation depends on the processor: the same inputs give
the same bits on every machine, which is what lets an audit compare bit by bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from compensator.arrays import Matrix, Vector
from compensator.model.covariance import Covariance, Design, Terms
from compensator.model.thermal_model import ThermalModel
from compensator.model.transfer_function import SampledTransferFunction

_UNITY = SampledTransferFunction(b=(1.0,), a=(1.0,), period_s=60.0)
_ZERO = SampledTransferFunction(b=(0.0,), a=(1.0,), period_s=60.0)


@dataclass(frozen=True, slots=True)
class ObserverState:
    """What the observer keeps between two samples.

    Parameters
    ----------
    x : tuple of float
        State vector after the last update.
    p : tuple of float
        Upper triangle of its covariance, row by row.
    settled : bool
        Whether the covariance has reached its steady value.
    started : bool
        Whether there was a sample since it was at rest.
    """

    x: tuple[float, ...]
    p: tuple[float, ...]
    settled: bool
    started: bool = True


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a sample is expected to measure.

    Parameters
    ----------
    t_q_k, t_q_std_k : float
        T_Q as a change from its reference, and the standard deviation of what is measured around it, K.
    at_k, at_std_k : float
        The same of AT.
    """

    t_q_k: float
    t_q_std_k: float
    at_k: float
    at_std_k: float


class Observer:
    """The augmented observer of a thermal model.

    Parameters
    ----------
    model : ThermalModel
        Paths, noise levels and the method of estimating the heat.
    """

    def __init__(self, model: ThermalModel) -> None:
        ttf = model.ttf.sampled if model.ttf else _UNITY
        ambient = _UNITY
        late, walk_std = model.late_t_q, model.drive_walk_std
        self._behind: SampledTransferFunction | None = None
        if late is not None:
            lag = late.within_a_sample(model.period_s, invertible=model.estimator.method == "inverse")
            ttf = ttf.times(lag)
            ambient = lag if late.of_ambient else _UNITY
            self._behind = late.behind(model.period_s)
        tdtf = model.tdtf.sampled if model.tdtf else _ZERO
        estimator = model.estimator
        further = [
            function
            for part in model.parts
            for function in (part.dtf.sampled, part.tdtf.sampled if part.tdtf else _ZERO)
        ]
        dtf = model.dtf.sampled
        if self._behind is not None:
            # What walks is before the drive: it leads to T_Q, to every DTF, and to the drive itself, which comes last.
            # The lag lets so much of a change through in its first sample.
            walk_std /= self._behind.b[0]
            ttf, dtf, nothing = self._behind.times(ttf), self._behind.times(dtf), _ZERO
            further = [self._behind.times(f) if i % 2 == 0 else f for i, f in enumerate(further)]
            further += [self._behind, nothing]
        t_q_var_k2 = estimator.t_q_noise_std_k**2
        if late is not None and not late.of_ambient and late.samples(model.period_s) and estimator.method == "kalman":
            # T_Q gets the change of AT over the dead time, with the noise of both ends (`LateObserver.step`); the
            # plain inverse takes that of the earlier one off again.
            t_q_var_k2 += 2.0 * estimator.at_noise_std_k**2
        self._lay_out(ttf, dtf, tdtf, ambient, *further)
        self._outputs = self._output_rows(model)
        self._covariance = Covariance(
            Design(
                rows=tuple(self._rows),
                first=tuple(self._first),
                feed=tuple(self._d),
                of_y=self._of_y(1.0, 1.0),
                walk=(*[0.0] * self._q, walk_std**2, estimator.at_walk_std_k**2),
                t_q_var_k2=t_q_var_k2,
                at_var_k2=estimator.at_noise_std_k**2,
                kalman=estimator.method == "kalman",
            )
        )
        #: Variances of the further outputs, and the covariance that they are of.
        self._output_vars: list[float] = []
        self._output_vars_of: Matrix | None = None
        self.reset()

    def _lay_out(self, *functions: SampledTransferFunction) -> None:
        """Give every state its number and write F as rows (next, first, source, a, B)."""
        orders = [f.order for f in functions]
        total = sum(orders)
        self._q, self._a, self.size = total, total + 1, total + 2
        nil = self.size  # index of a state that is always zero
        self._first: list[int] = []
        self._d: list[float] = []
        rows: list[tuple[int, int, int, float, float]] = []
        start = 0
        sources = (self._q, self._q, self._a, self._a) + (self._q, self._a) * ((len(functions) - 4) // 2)
        for function, source in zip(functions, sources, strict=True):
            a, b, d = function.observer_form()
            n = function.order
            self._first.append(start if n else nil)
            self._d.append(d)
            rows += [(start + i + 1 if i + 1 < n else nil, start, source, a[i], b[i]) for i in range(n)]
            start += n
        rows += [(self._q, nil, nil, 0.0, 0.0), (self._a, nil, nil, 0.0, 0.0)]
        self._rows = rows

    def _paths_of(self, part: int) -> tuple[int, int]:
        """Return the numbers of DTF and TDTF of a part of the model; 0 is the first."""
        return (1, 2) if part == 0 else (2 * part + 2, 2 * part + 3)

    def _output_rows(self, model: ThermalModel) -> list[Terms]:
        """Return for each further output the states that it consists of, with their factors."""
        numbers = {part.axis: i for i, part in enumerate((model, *model.parts))}
        rows = []
        for output in model.outputs:
            row: dict[int, float] = {}
            for name, weight in output.weights:
                for path, source in zip(self._paths_of(numbers[name]), (self._q, self._a), strict=True):
                    for index, factor in ((self._first[path], 1.0), (source, self._d[path])):
                        if index < self.size:
                            row[index] = row.get(index, 0.0) + weight * factor
            rows.append(list(row.items()))
        return rows

    def reset(self) -> None:
        """Return to rest: every state zero and known."""
        self._x = [0.0] * (self.size + 1)
        self._covariance.reset()

    # ------------------------------------------------------------------ one sample

    def step(self, t_q_k: float, at_k: float, *, extra_t_q_k2: float = 0.0, extra_at_k2: float = 0.0) -> None:
        """Advance by one sample and its measurements.

        Parameters
        ----------
        t_q_k, at_k : float
            T_Q and AT as changes from their reference, K; NaN where missing.
        extra_t_q_k2, extra_at_k2 : float
            Variance added to that of the sensor, K², for a value that was interpolated.
        """
        has_tq, has_at = not math.isnan(t_q_k), not math.isnan(at_k)
        if self._covariance.started:
            self._x = self._moved(self._x)
        gains = self._covariance.step(extra_at_k2 if has_at else None, extra_t_q_k2 if has_tq else None)
        if has_at:
            self._correct(gains.at, at_k - self._x[self._a])
        if has_tq:
            self._correct(gains.t_q, t_q_k - self._t_q_of(self._x))
        self._covariance.started = True

    def _moved(self, x: list[float]) -> list[float]:
        moved = [x[n] - a * x[f] + b * x[s] for n, f, s, a, b in self._rows]
        moved.append(0.0)
        return moved

    def _correct(self, gain: list[float], innovation: float) -> None:
        x = [value + k * innovation for value, k in zip(self._x, gain, strict=False)]
        x.append(0.0)
        self._x = x

    def _t_q_of(self, x: list[float]) -> float:
        expected = x[self._first[0]] + self._d[0] * x[self._q] + self._d[3] * x[self._a]
        return expected + x[self._first[3]]

    def forecast(self, at_k: float) -> Forecast:
        """Return what the next sample is expected to measure, without advancing.

        Parameters
        ----------
        at_k : float
            AT of that sample as a change from its reference, K, from which T_Q is then expected; NaN where missing.
        """
        x, has_at = self._moved(self._x) if self.started else self._x, not math.isnan(at_k)
        at_expected = x[self._a]
        if has_at:
            innovation = at_k - at_expected
            x = [value + k * innovation for value, k in zip(x, self._covariance.expected_gain_at(), strict=False)]
            x.append(0.0)
        t_q_std = self._covariance.expected_t_q_std_k(with_at=has_at)
        return Forecast(self._t_q_of(x), t_q_std, at_expected, self._covariance.expected_at_std_k())

    def drive_for(self, t_q_k: float) -> float:
        """Return the drive that would explain a difference of T_Q, K, from what is expected, within one sample."""
        feed = self._d[0] / (self._d[-2] if self._behind is not None else 1.0)
        return self.drive + (t_q_k / feed if feed != 0.0 else math.copysign(math.inf, t_q_k))

    # ------------------------------------------------------------------ estimates

    @property
    def x(self) -> list[float]:
        """State vector after the last update, and a zero."""
        return self._x

    @property
    def covariance(self) -> Matrix:
        """Its covariance."""
        return self._covariance.p

    @property
    def settled(self) -> bool:
        """Whether the covariance has reached its steady value."""
        return self._covariance.settled

    @property
    def started(self) -> bool:
        """Whether there was a sample since it was at rest."""
        return self._covariance.started

    @property
    def drive(self) -> float:
        """Estimated heat, W (T_Q − AT, K, in a direct model)."""
        if self._behind is not None:
            return self._x[self._first[-2]] + self._d[-2] * self._x[self._q]
        return self._x[self._q]

    @property
    def ambient_k(self) -> float:
        """Estimated change of the ambient, K."""
        return self._x[self._a]

    @property
    def t_q_k(self) -> float:
        """T_Q as its sensor shows it by the estimated state, K, as a change from its reference."""
        return self._t_q_of(self._x)

    @property
    def drive_std(self) -> float:
        """Standard deviation of the drive, in its unit."""
        if self._behind is not None:
            return math.sqrt(self._covariance.variances_of([[(self._first[-2], 1.0), (self._q, self._d[-2])]])[0])
        return math.sqrt(max(float(self._covariance.p[self._q, self._q]), 0.0))

    @property
    def y_variance_um2(self) -> float:
        """Variance of y that sensor noise and missing samples cause, µm²."""
        return self._covariance.y_var

    @property
    def output_variances(self) -> list[float]:
        """Variance of each further output that sensor noise and missing samples cause, in its unit squared."""
        if self._output_vars_of is not self._covariance.p:
            self._output_vars, self._output_vars_of = self._covariance.variances_of(self._outputs), self._covariance.p
        return self._output_vars

    def shares_um(self) -> tuple[float, float]:
        """Return the shares of DTF and TDTF in y, µm."""
        return self.shares_of(0, self._x)

    def ahead(self) -> list[float]:
        """Return the state vector one sample ahead, with drive and ambient as they are, and a zero."""
        return self._moved(self._x)

    def shares_of(self, part: int, x: list[float]) -> tuple[float, float]:
        """Return the shares of DTF and TDTF of a part of the model in a state, µm; part 0 gives y."""
        first, second = self._paths_of(part)
        dtf = x[self._first[first]] + self._d[first] * x[self._q]
        tdtf = x[self._first[second]] + self._d[second] * x[self._a]
        return dtf, tdtf

    # ------------------------------------------------------------------ after a gap

    def covariance_ahead(self) -> Matrix:
        """Return the covariance one sample ahead, before its measurements."""
        return self._covariance.ahead()

    def widen(self, ahead: Matrix) -> None:
        """Set the covariance after a gap whose inputs were interpolated.

        The errors of an interpolated drive are correlated over the whole gap and do not average out, as the repeated
        steps assume. A random walk that is measured again at the end of a gap has the straight line as its mean and the
        covariance of the optimal filter, which skipped the gap: that one is used, whatever the method, if it is larger.

        Parameters
        ----------
        ahead : numpy.ndarray, shape (n, n)
            Covariance before the measurements of the present sample, of an observer that skipped the gap.
        """
        self._covariance.widen(ahead)

    # ------------------------------------------------------------------ a measured deformation

    def _of_y(self, dtf: float, tdtf: float) -> tuple[tuple[int, float], ...]:
        """Return the states of y, and by how much it changes with each if with the shares of the paths by so much."""
        dtf_feed, tdtf_feed = self._d[1], self._d[2]
        weights = (
            *((self._first[1], dtf), (self._q, dtf * dtf_feed)),
            *((self._first[2], tdtf), (self._a, tdtf * tdtf_feed)),
        )
        return tuple((index, weight) for index, weight in weights if index < self.size)

    def gain_of_y(self, variance_um2: float, slopes: tuple[float, float]) -> tuple[list[float], float]:
        """Return the gain of a measured y after a sample, and the variance expected of its residual, µm².

        Parameters
        ----------
        variance_um2 : float
            Variance of the value itself, µm².
        slopes : tuple of two floats
            By how much y changes with the shares of DTF and TDTF: 1 without effects.
        """
        return self._covariance.gain_of_y(variance_um2, self._of_y(*slopes))

    def measure_y(self, residual_um: float, variance_um2: float, slopes: tuple[float, float]) -> None:
        """Correct the state by a measured y, whose gain is that of `gain_of_y`; the residual is measured − expected."""
        self._correct(self._covariance.measure_y(variance_um2, self._of_y(*slopes)), residual_um)

    def doubt(self, changes: Sequence[Sequence[float] | Vector]) -> None:
        """Widen the covariance by errors that the state may have, each one standard deviation of a change of it."""
        self._covariance.doubt(changes)

    # ------------------------------------------------------------------ state

    def snapshot(self) -> ObserverState:
        """Return what must be kept to continue from here with the same bits."""
        return ObserverState(
            x=tuple(self._x[: self.size]),
            p=self._covariance.upper_triangle(),
            settled=self.settled,
            started=self.started,
        )

    def restore(self, state: ObserverState) -> None:
        """Continue from a snapshot.

        Raises
        ------
        ValueError
            If the snapshot belongs to a model of another size.
        """
        if len(state.x) != self.size:
            raise ValueError(f"snapshot of {len(state.x)} states, the model has {self.size}")
        self._covariance.restore(state.p, started=state.started, settled=state.settled)
        self._x = [*state.x, 0.0]
