"""State of the loop as JSON, `loop.json` in a recording: everything that determines its next decision."""

from __future__ import annotations

from typing import Literal

import msgspec

from compensator.errors import DataError
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData, NotJudged
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.shadow import Role
from compensator.service.transfer.comparison import ComparisonState

#: Version of the state, and of the rules that decide on it: other rules get a new one. Another one is refused.
STATE_SCHEMA = 1

Phase = Literal["idle", "shadow", "proposed", "watching"]
Exchange = Literal["", "adopt", "back"]
#: The two places beside the present model: for what a diagnosis has found, and for the model before an adoption.
PlaceName = Literal["found", "watched"]
#: Before the first value.
NO_VERDICT = ComparisonData(verdict=ComparisonVerdict.NOT_JUDGED, why=NotJudged.NO_Y)


class Running(msgspec.Struct, frozen=True, kw_only=True):
    """A diagnosis: what is diagnosed, why, how often it was begun, and whether its candidate is being warmed up.

    `found` is its result then. `is_next`: the candidate gets its place before the next sample.
    """

    from_utc_ns: int
    to_utc_ns: int
    why: str
    attempts: int = 1
    candidate_sha256: str = ""
    found: DiagnosisData | None = None
    is_next: bool = False


class Place(msgspec.Struct, kw_only=True):
    """A model in shadow, and what was compared of it and the present model.

    Parameters
    ----------
    sha256 : str
        Hash of its file.
    effects : list of str
        Its effects.
    role : {"candidate", "before"}
        Whether it may be adopted, or is a model that the service goes back to.
    since_utc_ns : int
        When the comparison began, ns since 1970 UTC.
    is_proposed : bool
        Whether a person was asked to adopt it.
    comparison : ComparisonState
        What was compared since then.
    verdict : ComparisonData
        The last verdict on it.
    error : ErrorBlocks
        Its errors since the last zero, on the record before the comparison, too.
    """

    sha256: str
    effects: list[str]
    role: Role
    since_utc_ns: int
    is_proposed: bool = False
    comparison: ComparisonState = msgspec.field(default_factory=ComparisonState)
    verdict: ComparisonData = NO_VERDICT
    error: ErrorBlocks = msgspec.field(default_factory=ErrorBlocks)

    def begin_anew(self) -> None:
        """Forget what was compared."""
        self.comparison, self.verdict = ComparisonState(), NO_VERDICT


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
    exchange : {"", "adopt", "back"}
        An exchange that was decided and happens before the next sample.
    incoming : {"found", "watched"}
        The place from which a model replaces the present one.
    level_um : float
        By how much the level of the other model is raised at it, µm.
    diagnosis : Running, optional
        A diagnosis that was begun.
    planned_utc_ns, diagnosed_utc_ns : int
        The last planned time that is done, and begin of the last diagnosis, ns since 1970 UTC; 0 before.
    misfit_min, clean_min : float
        For how long the model, and for how long no sensor, has been suspected, min.
    found : Place, optional
        What a diagnosis has found: a candidate, or the calibrated model.
    watched : Place, optional
        The model before the last adoption.
    adopted_utc_ns : int
        Time of the last adoption; 0 before.
    effects : list of str
        Effects of the present model.
    error : ErrorBlocks
        Errors of the present model since the last zero.
    avoided : list of Avoided
        Models that were gone back from or dismissed.
    """

    schema: int = STATE_SCHEMA
    exchange: Exchange = ""
    incoming: PlaceName = "found"
    level_um: float = 0.0
    diagnosis: Running | None = None
    planned_utc_ns: int = 0
    diagnosed_utc_ns: int = 0
    misfit_min: float = 0.0
    clean_min: float = 0.0
    found: Place | None = None
    watched: Place | None = None
    adopted_utc_ns: int = 0
    effects: list[str] = []
    error: ErrorBlocks = msgspec.field(default_factory=ErrorBlocks)
    avoided: list[Avoided] = []

    def place(self, name: PlaceName) -> Place | None:
        """Return the model in a place."""
        return self.found if name == "found" else self.watched

    def put(self, name: PlaceName, place: Place | None) -> None:
        """Put a model in a place, or empty it."""
        if name == "found":
            self.found = place
        else:
            self.watched = place

    @property
    def taken(self) -> dict[PlaceName, Place]:
        """The places that are taken, the way back first."""
        both: tuple[tuple[PlaceName, Place | None], ...] = (("watched", self.watched), ("found", self.found))
        return {name: place for name, place in both if place is not None}

    @property
    def candidate(self) -> Place | None:
        """The candidate, if there is one."""
        return self.found if self.found is not None and self.found.role == "candidate" else None

    @property
    def proposed(self) -> Place | None:
        """The candidate that is proposed, if there is one."""
        return self.candidate if self.candidate is not None and self.candidate.is_proposed else None

    @property
    def has_next(self) -> bool:
        """Whether what a diagnosis has found gets its place before the next sample."""
        return self.diagnosis is not None and self.diagnosis.is_next

    @property
    def shown(self) -> Place | None:
        """The model in shadow that concerns a person first: the candidate, or else a model that was in force."""
        return self.candidate or self.watched or self.found

    @property
    def phase(self) -> Phase:
        """What a person may have to answer to."""
        if self.candidate is not None:
            return "proposed" if self.proposed is not None else "shadow"
        return "watching" if self.taken else "idle"


def decode_loop(data: bytes) -> LoopState:
    """Read a state.

    Raises
    ------
    DataError
        If it is not a state of this version.
    """
    try:
        found = msgspec.json.decode(data, type=LoopState)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"loop.json: {error}") from error
    if found.schema != STATE_SCHEMA:
        raise DataError(f"loop.json: schema = {found.schema}, expected {STATE_SCHEMA}")
    return found
