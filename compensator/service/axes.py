"""Further axes of a machine, its tilts and slopes: their zeros, limits and offsets beside those of Y.

Temperatures, heat and the conditions that hold an offset are the machine's and are decided once. Each further output
has its own prediction, zero and limiter. All of them are decided with the same sample as Y.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from compensator.arrays import NAN
from compensator.axes import FIRST, column_of
from compensator.config_axes import TILTS, Axes
from compensator.model.engine import Estimate
from compensator.model.outputs import Output, OutputEstimate

#: Values of a further output in the estimate's message, by the middle of their names; the one without is measured.
_VALUES = ("dtf", "tdtf", "effects", "base", "pred", "std", "ref", "", "residual")


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits of an output, in its unit and per min; the names are those of `Limits`."""

    offset_max_um: float
    offset_rate_max_um_per_min: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedOutput:
    """A further output as the configuration describes it.

    Parameters
    ----------
    output : Output
        Its name and the parts of the model that it consists of.
    axis : str
        The axis in whose message it is.
    bounds : Bounds
        Its limits.
    unit : str
        Its unit in names: `um`, `urad`, `um_per_m`.
    column : str
        Channel that measures it; empty for a tilt and a slope.
    sign : int
        −1 where its deformation was calibrated against the sense of the control's axis.
    """

    output: Output
    axis: str
    bounds: Bounds
    unit: str = "um"
    column: str = ""
    sign: int = 1

    @property
    def name(self) -> str:
        """Its name, such as `z`, `a` or `y_slope`."""
        return self.output.name

    def named(self, name: str) -> str:
        """Return the name of one of its values, such as `z_pred_um`; that of its measured value is `z_um`."""
        return "_".join(filter(None, (self.name, name, self.unit)))


def planned_outputs(axes: Axes | None) -> tuple[PlannedOutput, ...]:
    """Return the further outputs of a configuration; none where the machine has Y alone."""
    if axes is None:
        return ()
    found = []
    for name, axis in axes.linear().items():
        if name != FIRST:
            output = Output(name=name, weights=((axis.part_of(name), float(axis.sign)),))
            bounds = Bounds(axis.offset_max_um, axis.offset_rate_max_um_per_min)
            found.append(PlannedOutput(output=output, axis=name, bounds=bounds, column=column_of(name), sign=axis.sign))
        slope = axis.slope
        if slope is not None:
            part = slope.part_of(axis.part_of(name))
            output = Output(name=f"{name}_slope", weights=((part, float(axis.sign)),))
            bounds = Bounds(slope.slope_max_um_per_m, slope.slope_rate_max_um_per_m_per_min)
            found.append(PlannedOutput(output=output, axis=name, bounds=bounds, unit="um_per_m"))
    for name, tilt in axes.tilts().items():
        lower, upper = tilt.probes
        factor = tilt.sign * 1000.0 / tilt.distance_mm  # µm over mm, in µrad
        output = Output(name=name, weights=((upper, factor), (lower, -factor)))
        bounds = Bounds(tilt.offset_max_urad, tilt.offset_rate_max_urad_per_min)
        found.append(PlannedOutput(output=output, axis=name, bounds=bounds, unit="urad"))
    return tuple(found)


@dataclass(slots=True)
class OutputState:
    """What is kept of a further output from sample to sample, in its unit.

    Parameters
    ----------
    offset : float
        The last published value; 0 before the first, as the control then applies none.
    ref : float
        Measured deformation at the zero.
    base : float
        Predicted value at the last zero on a warm machine.
    rates : list of float
        Its rates in the last samples.
    model_changed : bool
        Whether the offset is still moving to that of another model.
    """

    offset: float = 0.0
    ref: float = NAN
    base: float = 0.0
    rates: list[float] = field(default_factory=list)
    model_changed: bool = False


@dataclass(frozen=True, slots=True)
class OutputPrediction:
    """A further output since the zero, in its unit; NaN before the first zero."""

    value: float = NAN
    std: float = NAN
    rate_per_min: float = NAN


class FurtherOutputs:
    """The further outputs of a machine: zeros and predictions.

    Parameters
    ----------
    axes : Axes, optional
        Tables of the configuration; None on a machine with Y alone.
    """

    def __init__(self, axes: Axes | None) -> None:
        self.axes = axes
        self.planned = planned_outputs(axes)
        self.states = {one.name: OutputState() for one in self.planned}
        self._names = [tuple(map(one.named, _VALUES)) for one in self.planned]
        #: Names of all axes, Y and tilts among them; empty on a machine with Y alone.
        self.names = axes.names() if axes is not None else ()
        self._constants = {axis: _constants(axes, axis) for axis in self.names} if axes is not None else {}

    def offsets(self) -> dict[str, float]:
        """Return the last published value of each output by name, in its unit."""
        return {name: state.offset for name, state in self.states.items()}

    def take_offsets(self, offsets: Mapping[str, float]) -> None:
        """Continue from published values; an output without one starts at 0, as the control applies none."""
        for name, state in self.states.items():
            state.offset = offsets.get(name, 0.0)

    def begin(self, bases: Mapping[str, float]) -> None:
        """Start with a zero that was set before the record; the next measured value is the reference.

        Parameters
        ----------
        bases : mapping of str to float
            Predicted value of each output at that zero by name; 0 without one, as at rest.
        """
        for name, state in self.states.items():
            state.ref, state.base, state.rates = NAN, bases.get(name, 0.0), []

    def set_zero(self, estimate: Estimate | None, measured: Mapping[str, float]) -> None:
        """Set the zero.

        Parameters
        ----------
        estimate : Estimate, optional
            That of the last sample, whose prediction is the zero on a warm machine; None for a zero at rest.
        measured : mapping of str to float
            Usable values of the channels; NaN where missing.
        """
        for number, one in enumerate(self.planned):
            state = self.states[one.name]
            state.base = estimate.outputs[number].value if estimate is not None and estimate.outputs else 0.0
            state.ref = one.sign * measured.get(one.column, NAN)
            if estimate is None:
                state.rates = []

    def move_zero(self, before: Estimate, now: Estimate) -> None:
        """Account for another estimate of what was predicted at the zero: its state was wrong then."""
        for one, old, new in zip(self.planned, before.outputs, now.outputs, strict=True):
            self.states[one.name].base += new.value - old.value

    def predictions(self, estimate: Estimate | None) -> list[OutputPrediction]:
        """Return the outputs since the zero."""
        if estimate is None or not self.planned:
            return [OutputPrediction() for _ in self.planned]
        return [
            OutputPrediction(found.value - self.states[one.name].base, found.std, found.rate_per_min)
            for one, found in zip(self.planned, estimate.outputs, strict=True)
        ]

    def remember(self, estimate: Estimate, samples: int) -> None:
        """Keep the rates of the last samples, which tell a machine at rest from a warm one."""
        for one, found in zip(self.planned, estimate.outputs, strict=True):
            state = self.states[one.name]
            state.rates = [*state.rates[1 - samples :], found.rate_per_min]

    def forget_rates(self) -> None:
        """Forget the rates from before a pause."""
        for state in self.states.values():
            state.rates = []

    def largest_rate_um_per_min(self) -> float:
        """Return the largest mean rate of an axis over the last samples, µm/min; 0 without further axes."""
        means = [
            abs(math.fsum(state.rates) / len(state.rates))
            for one in self.planned
            if one.unit == "um" and (state := self.states[one.name]).rates
        ]
        return max(means, default=0.0)

    def refer(self, predictions: list[OutputPrediction], measured: Mapping[str, float]) -> None:
        """Take the first value of an axis that was not measured at the zero as its reference.

        Its residual then starts at zero.
        """
        for one, predicted in zip(self.planned, predictions, strict=True):
            state = self.states[one.name]
            if math.isnan(state.ref) and one.column in measured:
                state.ref = one.sign * measured[one.column] - predicted.value

    def values(
        self, estimate: Estimate | None, predictions: list[OutputPrediction], measured: Mapping[str, float]
    ) -> dict[str, float | list[float] | None]:
        """Return what the estimate's message says of the further outputs, by name."""
        found: dict[str, float | list[float] | None] = {}
        nothing = OutputEstimate(NAN, NAN, (), NAN, NAN, NAN)
        own = estimate.outputs if estimate is not None else ()
        for number, one in enumerate(self.planned):
            share, predicted, state = own[number] if own else nothing, predictions[number], self.states[one.name]
            dtf, tdtf, effects, base, pred, std, ref, since, residual = self._names[number]
            found[dtf], found[tdtf], found[effects] = share.dtf, share.tdtf, list(share.effects)
            found[base], found[pred], found[std] = state.base, predicted.value, predicted.std
            if one.column in measured:
                value = one.sign * measured[one.column]
                found[ref], found[since] = state.ref, value - state.ref
                found[residual] = value - state.ref - predicted.value
        return found

    def constants(self, axis: str) -> dict[str, Any]:
        """Return what is the same in all messages of an axis."""
        return self._constants[axis]


def _constants(axes: Axes, axis: str) -> dict[str, Any]:
    found: dict[str, Any] = {"axis": axis, "axes": list(axes.names())}
    tilt, linear = axes.tilts().get(axis), axes.linear().get(axis)
    if tilt is not None:
        found |= {"acts_on": tilt.acts_on or TILTS[axis], "reference_mm": tilt.reference_mm}
    if linear is not None and linear.slope is not None:
        found["reference_mm"] = linear.slope.reference_mm
    if linear is not None and linear.sign != 1:
        found["sign"] = linear.sign
    return found
