"""From the predictions of further outputs to their messages: limits, reasons and states of each axis."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from compensator.arrays import NAN
from compensator.axes import FIRST
from compensator.codes import Reason, State, worst_state
from compensator.messages import Offset
from compensator.messages_axes import OFFSETS, AxisOffset
from compensator.model.thermal_model import ThermalModel
from compensator.service.axes import FurtherOutputs, OutputPrediction, PlannedOutput
from compensator.service.decision import Condition, Decision, OffsetDecision, OffsetLimiter
from compensator.service.outcome import Prediction, Values


class FurtherDecision:
    """Decides the further outputs of each sample, and makes the messages of all axes.

    Parameters
    ----------
    outputs : FurtherOutputs
        The further outputs, whose states keep the published values.
    model : ThermalModel
        The model with their parts.
    decision : OffsetDecision
        Decides what is the same for all axes.
    """

    def __init__(self, outputs: FurtherOutputs, model: ThermalModel, decision: OffsetDecision) -> None:
        self._outputs, self._model, self._decision = outputs, model, decision
        self._period_min = model.period_s / 60.0
        parts = {part.axis: part for part in (model, *model.parts)}
        self._limiters = {one.name: OffsetLimiter(one.bounds, self._period_min) for one in outputs.planned}
        self._others = tuple(name for name in outputs.names if name != FIRST)
        self._channels = {
            one.name: tuple(
                dict.fromkeys(
                    channel
                    for name, _ in one.output.weights
                    for effect in parts[name].effects
                    for channel in effect.measured
                )
            )
            for one in outputs.planned
        }

    def decide(
        self,
        offset: Offset,
        condition: Condition,
        values: Values,
        predictions: Sequence[OutputPrediction] | None,
        doubts: Sequence[float],
    ) -> tuple[AxisOffset, ...]:
        """Return the messages of all axes, that of Y first.

        Parameters
        ----------
        offset : Offset
            Of Y.
        condition : Condition
            What the sample means for every axis.
        values : Values
            Its usable values.
        predictions : sequence of OutputPrediction, optional
            In the order of the outputs; None before the first zero.
        doubts : sequence of float
            Standard deviations by sensors that may have jumped, in the same order; empty where there are none.
        """
        decided, stds = {}, {}
        for number, one in enumerate(self._outputs.planned):
            predicted = None
            if predictions is not None:
                found = predictions[number]
                predicted = Prediction(found.value, found.std, found.rate_per_min)
            state = self._outputs.states[one.name]
            decided[one.name] = self._decision.decided(
                condition, values, self._channels[one.name], predicted, self._limiter(one), state
            )
            stds[one.name] = math.hypot(predicted.std_um, *doubts[number : number + 1]) if predicted else NAN
            limited = decided[one.name].limited
            if limited is not None:
                state.offset = limited.offset_um
        return self._messages(offset, decided, stds)

    def hold(self, offset: Offset, *, known: bool) -> tuple[AxisOffset, ...]:
        """Return the messages of all axes for a sample that could not be processed: the last values are held.

        Parameters
        ----------
        offset : Offset
            Of Y.
        known : bool
            Whether there was a zero before.
        """
        decided = {
            one.name: Decision(
                State.HOLD if known else State.FAULT,
                [Reason.INTERNAL_ERROR],
                self._limiter(one).hold() if known else None,
            )
            for one in self._outputs.planned
        }
        return self._messages(offset, decided, dict.fromkeys(decided, NAN))

    def _limiter(self, one: PlannedOutput) -> OffsetLimiter:
        limiter = self._limiters[one.name]
        limiter.offset_um = self._outputs.states[one.name].offset
        return limiter

    def _messages(self, offset: Offset, decided: dict[str, Decision], stds: dict[str, float]) -> tuple[AxisOffset, ...]:
        found = []
        for axis in (FIRST, *self._others):
            slope = decided.get(f"{axis}_slope")
            own = offset
            if axis != FIRST:
                own = decided[axis].message(self._model, offset.machine, offset.seq, offset.time_utc_ns, stds[axis])
            fields = self._outputs.constants(axis)
            if slope is not None:
                own, limited = _with(own, slope), slope.limited
                fields = fields | {
                    "y_slope_um_per_m": limited.offset_um if limited is not None else NAN,
                    "y_slope_rate_um_per_m_per_min": limited.rate_um_per_min if limited is not None else NAN,
                    "y_slope_std_um_per_m": stds[f"{axis}_slope"],
                }
            found.append(OFFSETS[axis](**msgspec.structs.asdict(own), **fields))
        return tuple(found)


def _with(offset: Offset, slope: Decision) -> Offset:
    """Return the offset of an axis with the worse state of it and its slope, and the reasons of both."""
    state = worst_state([offset.state, slope.state])
    reasons = list(dict.fromkeys([*offset.reasons, *slope.reasons]))
    return msgspec.structs.replace(offset, state=state, reasons=reasons)
