"""The observer of a model whose T_Q is late by a dead time.

The filter runs in the past, at the time that T_Q shows: it is given T_Q as it is now and AT as it was then. From there
it is run on to the present with the AT that was measured since and the last heat held, which is what the optimal
filter does with a T_Q that is missing; the covariance grows by as much. A lag, and a part of a sample, are states of
the filter (`Observer`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from compensator.arrays import NAN, Matrix, Vector
from compensator.model.observer import Forecast, Observer, ObserverState
from compensator.model.thermal_model import ThermalModel

#: Samples after which the variance of y is steady, whatever the slowest modes still do.
_STEADY_AFTER = 120
#: Additional variance that stands for an AT that is missing.
_MISSING = -1.0
#: Value of AT and additional variance, K and K²; −1 where it is missing.
_Ambient = tuple[float, float]


class LateObserver(Observer):
    """An observer whose states are those of the present, run on from a filter in the past.

    Parameters
    ----------
    model : ThermalModel
        With a late T_Q.
    """

    def __init__(self, model: ThermalModel) -> None:
        late = model.late_t_q
        assert late is not None
        self._samples = late.samples(model.period_s)
        self._of_ambient = late.of_ambient
        self._past = Observer(model)
        super().__init__(model)

    def reset(self) -> None:
        """Return to rest: every state zero and known."""
        super().reset()
        self._past.reset()
        self._ambients: tuple[_Ambient, ...] = ((0.0, 0.0),) * self._samples
        self._steady_for: Matrix | None = None
        self._steady_ahead: list[list[float]] = []

    def step(self, t_q_k: float, at_k: float, *, extra_t_q_k2: float = 0.0, extra_at_k2: float = 0.0) -> None:
        """Advance by one sample and its measurements (as `Observer.step`)."""
        now = (0.0, _MISSING) if math.isnan(at_k) else (at_k, extra_at_k2)
        then, *later = (*self._ambients, now)
        self._ambients = tuple(later)
        at_then, extra_then = (NAN, 0.0) if then[1] == _MISSING else then
        if not self._of_ambient:
            # T_Q shows the heat as it was and the ambient as it is.
            t_q_k = t_q_k - at_k + at_then
        self._past.step(t_q_k, at_then, extra_t_q_k2=extra_t_q_k2, extra_at_k2=extra_then)
        self._run_on()

    def forecast(self, at_k: float) -> Forecast:
        """Return what the next sample is expected to measure, without advancing (as `Observer.forecast`)."""
        then_k, extra = self._ambients[0]
        at_then = NAN if extra == _MISSING else then_k
        past, here = self._past.forecast(at_then), super().forecast(at_k)
        t_q_k = past.t_q_k
        if not self._of_ambient:
            now = here.at_k if math.isnan(at_k) else at_k
            t_q_k += now - (past.at_k if math.isnan(at_then) else at_then)
        return Forecast(t_q_k, past.t_q_std_k, here.at_k, here.at_std_k)

    def _run_on(self) -> None:
        """Continue from the past to the present without T_Q."""
        past, covariance = self._past, self._covariance
        complete = past.settled and all(extra == 0.0 for _, extra in self._ambients)
        self._x = past.x
        if complete and self._steady_for is past.covariance:
            covariance.started = past.started
            for (at_k, _), gain in zip(self._ambients, self._steady_ahead, strict=True):
                self._x = self._moved(self._x)
                self._correct(gain, at_k - self._x[self._a])
            return
        extras = tuple(None if extra == _MISSING else extra for _, extra in self._ambients)
        gains = covariance.run_on(past._covariance, extras)
        for (at_k, extra), gain in zip(self._ambients, gains, strict=True):
            self._x = self._moved(self._x)
            if extra != _MISSING:
                self._correct(gain, at_k - self._x[self._a])
        self._steady_for, self._steady_ahead = (past.covariance, gains) if complete else (None, [])

    def covariance_ahead(self) -> Matrix:
        """Return the covariance of the past one sample ahead, before its measurements."""
        return self._past.covariance_ahead()

    def widen(self, ahead: Matrix) -> None:
        """Set the covariance after a gap whose inputs were interpolated (as `Observer.widen`)."""
        self._past.widen(ahead)
        self._run_on()

    def snapshot(self) -> ObserverState:
        """Return what must be kept to continue from here with the same bits: the past, and AT since then."""
        past = self._past.snapshot()
        ambients = tuple(value for ambient in self._ambients for value in ambient)
        return ObserverState(x=(*past.x, *ambients), p=past.p, settled=past.settled, started=past.started)

    def restore(self, state: ObserverState) -> None:
        """Go on from a snapshot.

        Raises
        ------
        ValueError
            If the snapshot belongs to a model of another size.
        """
        if len(state.x) != self.size + 2 * self._samples:
            raise ValueError(f"snapshot of {len(state.x)} states, the model has {self.size + 2 * self._samples}")
        x, kept = state.x[: self.size], np.reshape(state.x[self.size :], (-1, 2)).tolist()
        self._past.restore(ObserverState(x=x, p=state.p, settled=state.settled, started=state.started))
        self._ambients = tuple((float(value), float(extra)) for value, extra in kept)
        self._steady_for = None
        self._run_on()


def observer_of(model: ThermalModel) -> Observer:
    """Return the observer that a model needs."""
    late = model.late_t_q
    return Observer(model) if late is None or late.samples(model.period_s) == 0 else LateObserver(model)


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """What an observer makes of a record.

    Parameters
    ----------
    drive, ambient_k : numpy.ndarray, shape (n,)
        Heat, W (T_Q − AT, K, in a direct model), and change of the ambient, K.
    t_q_k : numpy.ndarray, shape (n,)
        T_Q without its dead time, as a change from its reference, K.
    y_dtf_um, y_tdtf_um : numpy.ndarray, shape (n,)
        Share of each path, µm.
    """

    drive: Vector
    ambient_k: Vector
    t_q_k: Vector
    y_dtf_um: Vector
    y_tdtf_um: Vector


def observe(model: ThermalModel, t_q_k: Vector, at_k: Vector) -> Observed:
    """Run the observer of a model over a record from rest, with the bits of the engine.

    Parameters
    ----------
    model : ThermalModel
        The model.
    t_q_k, at_k : numpy.ndarray, shape (n,)
        T_Q and AT as changes from their reference, K; NaN where missing.
    """
    observer = observer_of(model)
    rows = []
    for t_q, at in zip(t_q_k.tolist(), at_k.tolist(), strict=True):
        observer.step(t_q, at)
        rows.append((observer.drive, observer.ambient_k, observer.t_q_k, *observer.shares_um()))
    drive, ambient_k, t_q_k, dtf, tdtf = np.array(rows).T
    return Observed(drive=drive, ambient_k=ambient_k, t_q_k=t_q_k, y_dtf_um=dtf, y_tdtf_um=tdtf)


def late_variance_um2(model: ThermalModel) -> float:
    """Return by how much the correction of a late T_Q raises the steady variance of y, µm²."""
    if model.late_t_q is None:
        return 0.0
    return max(steady_variance_um2(model) - steady_variance_um2(model.with_prompt_t_q()), 0.0)


def steady_variance_um2(model: ThermalModel) -> float:
    """Return the variance of y that the observer of a model states where nothing is missing, µm²."""
    observer = observer_of(model)
    for _ in range(_STEADY_AFTER):
        observer.step(0.0, 0.0)
    return observer.y_variance_um2
