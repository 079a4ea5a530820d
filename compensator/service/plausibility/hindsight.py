"""Whether a suspect channel is wrong since its jump, or was wrong before it and is right now: measured Y decides.

Both look alike in the temperatures: the end of a drift, of a couple that stuck or came off, or of exchanged wires is a
jump. What the channel showed before is then in the state of every engine, for hours. Here Y is a measurement of that
state, in two engines that begin with the jump. Both doubt what the channel has shown before, by its jump, in each of
some past times independently: so Y tells them what was wrong. The *mended* one takes the channel as it is. The *broken*
one takes it less its jump, and Y by how it stood to the prediction before: then that was the model's error, which is
the less likely the larger it is. The one that expects Y, the temperatures and the heat better is right. A third engine
goes on by Y without the channel: from there both begin again, both with Y since the zero, when it jumps again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import msgspec

from compensator.arrays import NAN, Vector
from compensator.messages import Count, Number
from compensator.model.engine import Engine, EngineState, Estimate, wrong_histories
from compensator.model.thermal_model import ThermalModel
from compensator.service.plausibility.grown_y import GrownY
from compensator.service.plausibility.guards import TEMPERATURES

#: Limits of the past times that a channel may have been wrong in, samples before its jump.
_AGES = (0, 10, 20, 40, 80, 160, 320, 640)
#: Least jump that is doubted, K: a small one may be the end of a larger fault.
_LEAST_K = 2.0
#: Log likelihood ratio and samples after which the mended engine is believed; the ratio goes no further than the most.
_DECIDES, _SAMPLES, _MOST = 12.0, 10, 30.0
#: A value of Y counts for no more than this many squared deviations, and half: errors of Y last some samples.
_CLIP2, _WEIGHT = 25.0, 0.5
#: A model may err by this many times what it states, before more speaks for a sensor that was wrong; so much at most.
_MODEL_ERRS, _MOST_BEFORE = 15.0, 15.0
#: No machine is deformed by so much, µm.
_MOST_UM = 1e4
#: Least variance of a value of Y, µm².
_LEAST_UM2 = 0.01


class HindsightState(msgspec.Struct, kw_only=True):
    """State of the engines, and what has spoken for the mended one.

    Parameters
    ----------
    broken, mended, without : EngineState
        The engines.
    jumps_k : dict of str to float
        The jumps that they began with, by channel, K.
    ratio : float
        Log likelihood ratio of the mended engine over the broken one.
    samples : int
        Samples with Y since they began.
    again : bool
        Whether they have begun again.
    """

    broken: EngineState
    mended: EngineState
    without: EngineState
    jumps_k: dict[str, Number]
    ratio: Number = 0.0
    samples: Count = 0
    again: bool = False


class Hindsight:
    """Compares both engines of a machine, while channels are suspect and Y is measured.

    Parameters
    ----------
    model : ThermalModel
        The model; one whose T_Q is late by a dead time is not judged.
    y_std_um : float
        Standard deviation of Y − prediction that is stated, µm.
    """

    def __init__(self, model: ThermalModel, y_std_um: float) -> None:
        self._model = model
        self._y_std_um = max(y_std_um, math.sqrt(_LEAST_UM2))
        self._histories: dict[str, list[Vector]] = {}
        self._jumps_k: dict[str, float] = {}
        self._ratio, self._samples, self._again = 0.0, 0, False

    @functools.cached_property
    def _broken(self) -> Engine:
        return Engine(self._model)

    @functools.cached_property
    def _mended(self) -> Engine:
        return Engine(self._model)

    @functools.cached_property
    def _without(self) -> Engine:
        return Engine(self._model)

    @property
    def state(self) -> HindsightState | None:
        """State after the last sample; None while nothing is compared."""
        if not self._jumps_k:
            return None
        return HindsightState(
            broken=self._broken.snapshot(),
            mended=self._mended.snapshot(),
            without=self._without.snapshot(),
            jumps_k=dict(self._jumps_k),
            ratio=self._ratio,
            samples=self._samples,
            again=self._again,
        )

    def restore(self, state: HindsightState | None) -> None:
        """Continue from a state.

        Raises
        ------
        ValueError
            If it does not belong to the model; nothing is changed then.
        """
        if state is not None:
            if not state.jumps_k or not set(state.jumps_k) <= set(TEMPERATURES):
                raise ValueError(f"state of a hindsight of {list(state.jumps_k)}, expected {' or '.join(TEMPERATURES)}")
            pairs = (self._broken, state.broken), (self._mended, state.mended), (self._without, state.without)
            for engine, one in pairs:
                engine.check(one)
            for engine, one in pairs:
                engine.restore(one)
        self._jumps_k = dict(state.jumps_k) if state is not None else {}
        kept = (state.ratio, state.samples, state.again) if state is not None else (0.0, 0, False)
        self._ratio, self._samples, self._again = kept

    def end(self) -> None:
        """Compare nothing any more."""
        self._jumps_k, self._ratio, self._samples, self._again = {}, 0.0, 0, False

    def judge(
        self,
        before: EngineState,
        jumps_k: Mapping[str, float],
        measured: Mapping[str, float],
        others: Mapping[str, float],
        grown: GrownY,
    ) -> tuple[EngineState, Estimate] | None:
        """Compare both engines on a sample.

        Parameters
        ----------
        before : EngineState
            That of the compensation's engine before this sample, from which both begin.
        jumps_k : mapping of str to float
            Suspect channels and their jumps, K.
        measured : mapping of str to float
            T_Q and AT, °C; NaN where missing.
        others : mapping of str to float
            Usable values of the auxiliary channels.
        grown : GrownY
            Measured deformation since the zero.

        Returns
        -------
        EngineState, Estimate
            Those of the mended engine, if the channels were wrong before and are right now; None otherwise.
        """
        if (not self._jumps_k and math.isnan(grown.by_zero)) or not self._mended.takes_y:
            return None
        if self._jumps_k != dict(jumps_k):
            self._again, doubts = bool(self._jumps_k), self._doubts(jumps_k)
            begun = self._without.snapshot() if self._again else before
            for engine in (self._broken, self._mended):
                engine.restore(begun)
                engine.doubt(doubts)
            if not self._again:
                self._without.restore(self._mended.snapshot())
            self._jumps_k, self._ratio, self._samples = dict(jumps_k), 0.0, 0
            if not self._again and not math.isnan(grown.by_level):
                missed = (grown.by_zero - grown.by_level) / (_MODEL_ERRS * self._y_std_um)
                self._ratio = min(0.5 * missed * missed, _MOST_BEFORE)
        t_q, at = measured["t_q_degc"], measured["at_degc"]
        t_q_less, at_less = (value - jumps_k.get(name, 0.0) for name, value in (("t_q_degc", t_q), ("at_degc", at)))
        t_q_else, at_else = (NAN if name in jumps_k else measured[name] for name in ("t_q_degc", "at_degc"))
        by_zero = (grown.by_zero, max(grown.zero_std_um**2, _LEAST_UM2))
        by_level = (grown.by_level, max(grown.level_std_um**2, _LEAST_UM2))
        mended_cost, mended = _stepped(self._mended, t_q, at, others, by_zero)
        as_before = by_zero if self._again or math.isnan(grown.by_level) else by_level
        broken_cost, broken = _stepped(self._broken, t_q_less, at_less, others, as_before)
        _, without = _stepped(self._without, t_q_else, at_else, others, by_zero)
        if not all(abs(one.y_um) < _MOST_UM for one in (mended, broken, without)):
            # Y has led a state astray by an effect that grows with it: nothing is known of either.
            self.end()
            return None
        if math.isnan(grown.by_zero):
            return None
        self._samples += 1
        self._ratio = max(-_MOST, min(_MOST, self._ratio + 0.5 * _WEIGHT * (broken_cost - mended_cost)))
        decides = self._samples >= _SAMPLES and self._ratio >= _DECIDES and not math.isnan(t_q + at)
        return (self._mended.snapshot(), mended) if decides else None

    def _doubts(self, jumps_k: Mapping[str, float]) -> list[Vector]:
        if not self._histories:
            t_q, at = wrong_histories(self._model, _AGES)
            self._histories = {"t_q_degc": t_q, "at_degc": at}
        sizes = {name: max(abs(size), _LEAST_K) for name, size in jumps_k.items()}
        return [size * change for name, size in sizes.items() for change in self._histories[name]]


def _stepped(
    engine: Engine, t_q: float, at: float, others: Mapping[str, float], y: tuple[float, float]
) -> tuple[float, Estimate]:
    """Step an engine by a sample with Y and its variance; return −2 times the log likelihood, and its estimate.

    That of a heat counts, too: there is none below and above what the machine was calibrated with.
    """
    cost = 0.0
    expected = engine.forecast(at)
    for value, mean, std in (
        (at, expected.at_k, expected.at_std_k),
        (t_q, expected.t_q_k, expected.t_q_std_k),
    ):
        if not math.isnan(value):
            cost += _cost(value - mean, std * std)
    estimate = engine.step(t_q, at, others)
    grown_um, variance_um2 = y
    if not math.isnan(grown_um):
        residual_um = grown_um - estimate.y_um
        expected_um2 = variance_um2 + engine.y_noise_std_um**2
        # A value that is no measurement (a chip, a hand) would lead the state astray for hours.
        if residual_um * residual_um < _CLIP2 * expected_um2:
            expected_um2 = engine.measure_y(residual_um, variance_um2)
        cost += _cost(residual_um, expected_um2)
    return cost + min(beyond_heat(engine.model, estimate) ** 2, _CLIP2), estimate


def beyond_heat(model: ThermalModel, estimate: Estimate) -> float:
    """Return by how many standard deviations an estimated heat is outside of what the model is valid for."""
    low, high = model.validity.get("heat_w", (-math.inf, math.inf))
    beyond_w = max(low - estimate.heat_w, estimate.heat_w - high, 0.0)
    return beyond_w / estimate.heat_std_w if beyond_w > 0.0 else 0.0


def _cost(residual: float, variance: float) -> float:
    return min(residual * residual / variance, _CLIP2) + math.log(variance)
