"""Status of a compensation between two samples: its zero, its target, and the handover to a successor."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from compensator.messages import EstimateMessage, number
from compensator.messages_axes import AxesEstimate, further_bases
from compensator.model.engine import Engine, EngineState
from compensator.service.axes import OutputState
from compensator.service.probing import ProbingHandover
from compensator.service.state import ZeroMode, ZeroState


class Zero(msgspec.Struct, frozen=True, kw_only=True):
    """Reference values of temperatures and deformation; NaN if unknown.

    Parameters
    ----------
    t_q_ref_degc, at_ref_degc : float
        Temperatures, °C.
    y_ref_um : float
        Measured deformation, µm.
    t_q_shift_k, at_shift_k : float
        By how much the sensors show more than those that the model was made with, K.
    y_base_um : float
        Predicted deformation at the last zero on a warm machine, µm; without a level to which a model was raised since.
    further : mapping of str to float
        Predicted value of each further output at that zero by its name, in its unit.
    """

    t_q_ref_degc: float
    at_ref_degc: float
    y_ref_um: float
    y_base_um: float
    t_q_shift_k: float = 0.0
    at_shift_k: float = 0.0
    further: Mapping[str, float] = {}

    @classmethod
    def of_estimate(cls, estimate: EstimateMessage) -> Zero:
        """Return the zero of a recorded estimate."""
        return cls(
            t_q_ref_degc=number(estimate.t_q_ref_degc),
            at_ref_degc=number(estimate.at_ref_degc),
            y_ref_um=number(estimate.y_ref_um),
            y_base_um=estimate.y_base_um + (estimate.level_um or 0.0),
            t_q_shift_k=estimate.t_q_shift_k or 0.0,
            at_shift_k=estimate.at_shift_k or 0.0,
            further=further_bases(estimate) if isinstance(estimate, AxesEstimate) else {},
        )

    @classmethod
    def set_in(cls, estimate: EstimateMessage | None) -> Zero | None:
        """Return the zero of a recorded estimate; None before the first one."""
        zero = cls.of_estimate(estimate) if estimate is not None else None
        return zero if zero is not None and not math.isnan(zero.t_q_ref_degc) else None

    @classmethod
    def of_references(cls, engine: Engine | EngineState, zero: ZeroState, axes: Mapping[str, OutputState]) -> Zero:
        """Return the zero of a state, from the engine's reference, those of Y, and further outputs by name."""
        reference, shifted_k = engine.reference, engine.shifted_k
        return cls(
            t_q_ref_degc=reference.t_q_degc,
            at_ref_degc=reference.at_degc,
            y_ref_um=zero.y_ref,
            y_base_um=zero.y_base + zero.level,
            t_q_shift_k=shifted_k[0],
            at_shift_k=shifted_k[1],
            further={name: one.base for name, one in axes.items()},
        )

    @property
    def is_absolute(self) -> bool:
        """Whether the model uses absolute temperatures, not changes."""
        return self.t_q_ref_degc == self.at_ref_degc == 0.0

    def equals(self, other: Zero) -> bool:
        """Return whether all values are equal; two unknown values count as equal."""
        *own, further = msgspec.structs.astuple(self)
        *others, other_further = msgspec.structs.astuple(other)
        pairs = zip(own, others, strict=True)
        return further == other_further and all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in pairs)


class Handover(msgspec.Struct, frozen=True, kw_only=True):
    """State that a compensation passes on to its successor, so that the published offset does not jump.

    Parameters
    ----------
    offset_um : float
        The last published offset, µm; 0 before the first, as the control then applies none.
    operator_hold, internal_error : bool
        Whether the offset is held until `resume`, and for which cause.
    waiting_zero : {"auto", "rest", "warm"} or None
        A requested zero that waits for both temperatures.
    model_changed : bool
        Whether the offset is still moving to that of another model.
    probing : ProbingHandover or None
        What the probes have shown; None if the successor keeps its own.
    further : mapping of str to float
        The last published values of further outputs by name; an output without one starts at 0.
    """

    offset_um: float = 0.0
    operator_hold: bool = False
    internal_error: bool = False
    waiting_zero: ZeroMode | None = None
    model_changed: bool = False
    probing: ProbingHandover | None = None
    further: Mapping[str, float] = {}


class CompensationStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A compensation after its last sample.

    Parameters
    ----------
    seq, time_utc_ns : int
        Number and time, ns since 1970 UTC, of the last sample; −1 and 0 before the first.
    zero : Zero or None
        The current zero; None before the first.
    is_known : bool
        Whether the thermal state is known: it started known, or long enough ago.
    target_um, std_um : float
        The offset by the model, before limits, and its standard deviation, µm; NaN without an estimate.
    handover : Handover
        State for a successor.
    """

    seq: int
    time_utc_ns: int
    zero: Zero | None
    is_known: bool
    target_um: float
    std_um: float
    handover: Handover
