"""The state of a compensation as JSON: everything that determines the next outcome, bit for bit.

A number that is not finite is a string (`"nan"`, `"inf"`, `"-inf"`), because JSON has no such numbers; every other
number has enough digits to restore the same bits.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec

from compensator.arrays import NAN
from compensator.errors import DataError
from compensator.messages import NUMBER_MAX, OFFSET_MAX, SEQ_MAX, UNREADABLE, Number, TimeNs, check_numbers
from compensator.model.covariance import may_be_covariance
from compensator.model.engine import EngineState, Estimate
from compensator.service.axes import OutputState
from compensator.service.plausibility import JumpState, PlausibilityState
from compensator.service.probing import ProbingState

#: Version of the state; a state of another version is refused.
STATE_SCHEMA = 1

#: Valid covariances are far smaller; products of larger ones would not be finite.
LARGEST_COVARIANCE = 1e60

ZeroMode = Literal["auto", "rest", "warm"]
Minutes = Annotated[float, msgspec.Meta(ge=0)]


@dataclass(slots=True)
class ZeroState:
    """References in addition to those of the engine, and a requested zero.

    Parameters
    ----------
    y_ref : float
        Measured deformation at the zero, µm.
    y_base : float
        Predicted deformation at the last zero on a warm machine less `level`, µm.
    level : float
        By how much the predicted deformation was raised since the zero, µm; omitted if it was not.
    wanted : bool
        Whether a zero was requested and waits for both temperatures.
    mode : {"auto", "rest", "warm"}
        Its mode.
    """

    y_ref: float = NAN
    y_base: Number = 0.0
    level: Number = 0.0
    wanted: bool = False
    mode: ZeroMode = "auto"


@dataclass(slots=True)
class Memory:
    """Values kept from sample to sample.

    Parameters
    ----------
    seq, time_utc_ns : int
        Number and time of the last sample, −1 and 0 before the first.
    estimate : Estimate, optional
        The engine's estimate after it.
    missing_min : float
        Time for which a temperature has been missing, min.
    rates, heats : list of float
        Rates of the deformation, µm/min, and heats, W, of the last samples.
    operator_hold, internal_error : bool
        Whether the offset is held for this cause.
    model_changed : bool
        Whether the offset is still moving to that of another model.
    cold_min : float
        Remaining time for which the state counts as unknown, min.
    """

    seq: Annotated[int, msgspec.Meta(ge=-1, le=SEQ_MAX)] = -1
    time_utc_ns: TimeNs = 0
    estimate: Estimate | None = None
    missing_min: float = 0.0
    rates: list[float] = field(default_factory=list)
    heats: list[float] = field(default_factory=list)
    operator_hold: bool = False
    internal_error: bool = False
    model_changed: bool = False
    cold_min: float = 0.0


class CompensationState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The complete state.

    Parameters
    ----------
    schema : int
        `STATE_SCHEMA`.
    model_sha256 : str
        Hash of the model file to which it belongs.
    alternative : str or None
        The alternative path used instead of the model's own.
    engine : EngineState
        Observer, effects, held channels, reference, current gap.
    guards : dict of str to four floats
        By channel: last good value, time since then (min), constant value, time for which it has been constant (min).
    offset_um : float
        The last offset, µm.
    zero : ZeroState
        References of Y.
    memory : Memory
        Values kept from sample to sample.
    plausibility : PlausibilityState, optional
        State of the checks between the sensors; omitted if none is on, as in versions without these checks.
    probing : ProbingState, optional
        State of the probes; omitted without `[probe]`, as in versions without probes.
    jumps : JumpState, optional
        State of the watch for jumps; omitted without `guards.suspect_jumps`, as in versions without it.
    axes : dict of str to OutputState, optional
        State of the further outputs by name; omitted on a machine with Y alone.
    """

    schema: int
    model_sha256: str
    alternative: str | None
    engine: EngineState
    guards: dict[str, tuple[float, Minutes, float, Minutes]]
    offset_um: float
    zero: ZeroState
    memory: Memory
    plausibility: PlausibilityState | None = None
    probing: ProbingState | None = None
    jumps: JumpState | None = None
    axes: dict[str, OutputState] | None = None


def frozen_state(state: CompensationState) -> Callable[[], bytes]:
    """Copy a state; return what encodes the copy as JSON, which few samples need: those that open a file."""
    table = msgspec.to_builtins(state)
    for name in ("plausibility", "probing", "jumps", "axes"):
        if table[name] is None:
            del table[name]
    if not table["zero"]["level"]:
        del table["zero"]["level"]
    # As in versions that knew Y alone.
    jumps = list(_jumps_of(table.get("jumps")))
    for jump in jumps:
        if not jump["in_force"]:
            del jump["in_force"]
    branches = [jump[name] for jump in jumps for name in ("believing", "shifted") if jump[name] is not None]
    estimates = [table["memory"]["estimate"], *(jump["zero_in_use"] for jump in jumps)]
    estimates += [branch[name] for branch in branches for name in ("estimate", "at_zero")]
    for estimate in filter(None, estimates):
        if not estimate.get("outputs", True):
            del estimate["outputs"]
    for engine in (table["engine"], *(branch["engine"] for branch in branches)):
        _leave_out_no_shift(engine)
    return lambda: json.dumps(_encodable(table), separators=(",", ":")).encode()


def _jumps_of(jump: dict[str, Any] | None) -> Iterator[dict[str, Any]]:
    """Yield the tables of a watch for jumps and of the watch beside it."""
    while jump is not None:
        yield jump
        jump = jump["beside"]


def _leave_out_no_shift(engine: dict[str, Any]) -> None:
    """Leave out that no sensor has another zero, as versions did that did not keep it."""
    if not any(engine["shifted_k"]):
        del engine["shifted_k"]
    if engine["gap"] is not None:
        _leave_out_no_shift(engine["gap"]["state"])


def _encodable(value: Any) -> Any:
    """Replace numbers that are not finite by strings."""
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, dict):
        return {key: _encodable(entry) for key, entry in value.items()}
    if not isinstance(value, (list, tuple)):
        return value
    with suppress(TypeError, ValueError, OverflowError):  # not numbers, or two infinite ones
        if math.isfinite(math.fsum(value)):  # a covariance has hundreds of numbers, nearly always all of them finite
            return value
    return [_encodable(entry) for entry in value]


def decode_state(data: bytes) -> CompensationState:
    """Read a state.

    Raises
    ------
    DataError
        If it is not a state of this version.
    """
    try:
        # Not strict, so that a string may be a number.
        state = msgspec.json.decode(data, type=CompensationState, strict=False)
        check_numbers(msgspec.to_builtins(state), most=LARGEST_COVARIANCE)
    except (*UNREADABLE, ValueError) as error:
        raise DataError(f"state: {error}") from error
    if state.schema != STATE_SCHEMA:
        raise DataError(f"state: schema = {state.schema}, expected {STATE_SCHEMA}")
    engines = [state.engine]
    if state.jumps is not None:
        engines += [branch.engine for branch in state.jumps.branches()]
    nested = [*engines, *(engine.gap.state for engine in engines if engine.gap is not None)]
    offsets = [state.offset_um, *(one.offset for one in (state.axes or {}).values())]
    if not all(-OFFSET_MAX <= value <= OFFSET_MAX for value in offsets):
        raise DataError(f"state: an offset is not finite, or above {OFFSET_MAX:g}")
    numbers = [value for one in nested for value in (*one.observer.x, *one.observer.p, *one.shifted_k)]
    # Before the first zero there is no reference, and without Y none of it.
    known = [(one.reference.t_q_degc, one.reference.at_degc) for one in nested] + [(state.zero.y_ref,)]
    recorded = [value for values in known for value in values if not all(map(math.isnan, values))]
    if not all(-NUMBER_MAX <= value <= NUMBER_MAX for value in recorded):
        raise DataError("state: a reference is not finite, or larger than what a message can hold")
    numbers += [one.base for one in (state.axes or {}).values()]
    if not all(-LARGEST_COVARIANCE < value < LARGEST_COVARIANCE for value in numbers):
        raise DataError("state: a number of the engine is not finite, or too large to be valid")
    if not all(may_be_covariance(one.observer.p) for one in nested):
        raise DataError("state: the covariance of the engine cannot be one")
    return state
