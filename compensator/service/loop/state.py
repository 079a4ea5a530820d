"""State of the loop as JSON, `loop.json` in a recording: everything that determines its next decision."""

from __future__ import annotations

from typing import Literal

import msgspec

from compensator.errors import DataError
from compensator.events import ComparisonData, ComparisonVerdict, NotJudged
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.shadow import Role
from compensator.service.transfer.comparison import ComparisonState

#: Version of the state; a state of another version is refused.
STATE_SCHEMA = 1

Phase = Literal["idle", "shadow", "proposed", "watching"]
Exchange = Literal["", "adopt", "back"]
_NOTHING_YET = ComparisonData(verdict=ComparisonVerdict.NOT_JUDGED, why=NotJudged.NO_Y)


class Running(msgspec.Struct, frozen=True, kw_only=True):
    """A diagnosis: what is diagnosed, why, how often it was begun, and whether its candidate is being warmed up."""

    from_utc_ns: int
    to_utc_ns: int
    why: str
    attempts: int = 1
    candidate_sha256: str = ""


class Compared(msgspec.Struct, frozen=True, kw_only=True):
    """The model in shadow: hash, effects, role, and when the comparison began."""

    sha256: str
    effects: list[str]
    role: Role
    since_utc_ns: int


class Avoided(msgspec.Struct, frozen=True, kw_only=True):
    """Effects that are not adopted again before a time."""

    effects: list[str]
    until_utc_ns: int


class LoopState(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """The complete state.

    Parameters
    ----------
    schema : int
        `STATE_SCHEMA`.
    phase : {"idle", "shadow", "proposed", "watching"}
        What the shadow is for.
    exchange : {"", "adopt", "back"}
        An exchange that was decided and happens before the next sample.
    level_um : float
        By how much the level of the other model is raised at it, µm.
    diagnosis : Running, optional
        A diagnosis that was begun.
    planned_utc_ns, diagnosed_utc_ns : int
        The last planned time that is done, and begin of the last diagnosis, ns since 1970 UTC; 0 before.
    misfit_min, clean_min : float
        For how long the model, and for how long no sensor, has been suspected, min.
    shadow : Compared, optional
        The model in shadow.
    comparison : ComparisonState
        What was compared since it began.
    verdict : ComparisonData
        The last verdict on it.
    adopted_utc_ns : int
        Time of the last adoption; 0 before.
    effects : list of str
        Effects of the present model.
    error, other_error : ErrorBlocks
        Errors of the present model and of the one in shadow since the last zero, on the record before it, too.
    avoided : list of Avoided
        Models that were gone back from or dismissed.
    """

    schema: int = STATE_SCHEMA
    phase: Phase = "idle"
    exchange: Exchange = ""
    level_um: float = 0.0
    diagnosis: Running | None = None
    planned_utc_ns: int = 0
    diagnosed_utc_ns: int = 0
    misfit_min: float = 0.0
    clean_min: float = 0.0
    shadow: Compared | None = None
    comparison: ComparisonState = msgspec.field(default_factory=ComparisonState)
    verdict: ComparisonData = _NOTHING_YET
    adopted_utc_ns: int = 0
    effects: list[str] = []
    error: ErrorBlocks = msgspec.field(default_factory=ErrorBlocks)
    other_error: ErrorBlocks = msgspec.field(default_factory=ErrorBlocks)
    avoided: list[Avoided] = []


def fresh() -> tuple[ComparisonState, ComparisonData]:
    """Return a comparison before its first value."""
    return ComparisonState(), _NOTHING_YET


def decode_loop(data: bytes) -> LoopState:
    """Read a state.

    Raises
    ------
    DataError
        If it is not a state of this version.
    """
    try:
        state = msgspec.json.decode(data, type=LoopState)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"loop.json: {error}") from error
    if state.schema != STATE_SCHEMA:
        raise DataError(f"loop.json: schema = {state.schema}, expected {STATE_SCHEMA}")
    return state
