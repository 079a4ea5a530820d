"""State of the loop as JSON, `loop.json` in a recording: everything that determines its next decision."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal

import msgspec

from compensator.errors import DataError
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData, NotJudged
from compensator.messages import UNREADABLE, check_numbers
from compensator.service.loop.level import ErrorBlocks
from compensator.service.transfer.two_models import ComparisonState, moved

#: Version of the state, and of the rules that decide on it: other rules get a new one. Another one is refused.
STATE_SCHEMA = 10

#: A candidate may be adopted; to a model from before, or with fewer effects, the service goes back.
Role = Literal["candidate", "before"]
Phase = Literal["idle", "shadow", "proposed", "watching"]
Exchange = Literal["", "adopt", "back"]
#: Before the first value.
NO_VERDICT = ComparisonData(verdict=ComparisonVerdict.NOT_JUDGED, why=NotJudged.NOT_YET)


def same_effects(a: Sequence[str], b: Sequence[str]) -> bool:
    """Return whether two models have the same effects: a diagnosis lists them by what they remove, so in any order."""
    return sorted(a) == sorted(b)


def is_fewer(effects: Sequence[str], of: Sequence[str]) -> bool:
    """Return whether some effects are a part of others, and not all of them.

    Examples
    --------
    >>> is_fewer(["a"], ["a", "b"]), is_fewer([], ["a"]), is_fewer(["a"], ["a"]), is_fewer(["c"], ["a", "b"])
    (True, True, False, False)
    """
    return Counter(effects) < Counter(of)


class Running(msgspec.Struct, frozen=True, kw_only=True):
    """A diagnosis: of what is on record between two times, why, how often begun, and the candidate that is warmed up.

    `found` is its result then. `is_next`: the candidate gets its place before the next sample. `without`: nothing is
    diagnosed, the candidate is the present model without this effect.
    """

    from_utc_ns: int
    to_utc_ns: int
    why: str
    attempts: int = 1
    candidate_sha256: str = ""
    found: DiagnosisData | None = None
    is_next: bool = False
    without: str = ""


class InShadow(msgspec.Struct, kw_only=True):
    """A model in shadow, and what was compared of it and the present model.

    Parameters
    ----------
    sha256 : str
        Hash of its file.
    effects : list of str
        Its effects.
    role : {"candidate", "before"}
        Whether it may be adopted, or is a model that the service goes back to; beside the present model.
    since_utc_ns : int
        When the comparison began, ns since 1970 UTC.
    level_utc_ns : int
        Since when its level is judged, ns since 1970 UTC, where it goes on with what another one with the same effects
        has shown of it; 0: since `since_utc_ns`.
    is_proposed : bool
        Whether a person was asked to adopt it.
    comparison : ComparisonState
        What was compared since then.
    verdict : ComparisonData
        The last verdict on it.
    error : ErrorBlocks
        Its errors since the last zero, on the record before the comparison, too.
    limited_min : float
        For how long it has been at a limit that the present model keeps, min.
    off_at_zero : list of str, optional
        `DiagnosisData.off_at_zero`.
    kept_level_um : float
        At this level it predicts what the present model does at the last zero, µm: nothing of what it adds acted there.
    """

    sha256: str
    effects: list[str]
    role: Role
    since_utc_ns: int
    level_utc_ns: int = 0
    is_proposed: bool = False
    comparison: ComparisonState = msgspec.field(default_factory=ComparisonState)
    verdict: ComparisonData = NO_VERDICT
    error: ErrorBlocks = msgspec.field(default_factory=ErrorBlocks)
    limited_min: float = 0.0
    off_at_zero: list[str] | None = None
    kept_level_um: float = 0.0

    def begin_anew(self) -> None:
        """Forget what was compared."""
        self.comparison, self.verdict = ComparisonState(), NO_VERDICT

    @property
    def shows(self) -> float:
        """How strongly measured Y speaks for it so far, standard deviations; 0 while there is too little."""
        return self.verdict.deviations or 0.0

    @property
    def promise(self) -> float:
        """How much measured Y speaks for it in each hour so far, 2 log L / h; a right one's L grows with the hours."""
        return self.shows * abs(self.shows) / self.verdict.hours if self.verdict.hours > 0.0 else 0.0


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
    time_utc_ns, missing : int
        Time of the last sample, ns since 1970 UTC; 0 before. And how many have been missed since then.
    exchange : {"", "adopt", "back"}
        An exchange that was decided and happens before the next sample.
    incoming : str
        Hash of the model in shadow that then replaces the present one.
    level_um : float
        By how much the level of the other model is raised at it, µm.
    diagnosis : Running, optional
        A diagnosis that was begun.
    left_out_utc_ns, to_leave_out : int, list of str
        When it was last decided to compare the present model without each effect that the loop has added, ns since 1970
        UTC; 0 before. And those that are still to be left out.
    planned_utc_ns, diagnosed_utc_ns : int
        The last planned time that is done, and begin of the last diagnosis, ns since 1970 UTC; 0 before.
    misfit_min : float
        For how long the model has been suspected, min.
    probes_shown : list of (int, float)
        What the last probes since the zero have shown beyond the prediction, standard deviations, and when, ns since
        1970 UTC.
    clean_min, usable_min : float
        For how long no sensor has been suspected, and no sensor has shown a fault by itself, as far as that is counted,
        min: decisions wait for the first, diagnoses for the second.
    uncompared_min : float
        For how long nothing has been compared because all models that run suspect a sensor, min.
    uncompared_ns : int
        Since when, ns since 1970 UTC.
    found : list of InShadow
        What diagnoses have found: candidates, and ways back; and the present model without an effect.
    watched : InShadow, optional
        The model before the last adoption.
    adopted_utc_ns : int
        Time of the last adoption; 0 before.
    effects, base_effects : list of str
        Effects of the present and of the calibrated model.
    error : ErrorBlocks
        Errors of the present model since the last zero.
    zero_utc_ns : int
        Time of the last zero, ns since 1970 UTC; 0 before.
    zero_channels : list of str, optional
        Channels that read 0 at that zero; None where it was none at rest.
    y_moved_ns : int
        When measured Y has moved by itself since then, as a diagnosis has found, ns since 1970 UTC; 0: none has, or a
        later one that sees that time has not.
    avoided : list of Avoided
        Models that were gone back from or dismissed.
    """

    schema: int = STATE_SCHEMA
    time_utc_ns: int = 0
    missing: int = 0
    exchange: Exchange = ""
    incoming: str = ""
    level_um: float = 0.0
    diagnosis: Running | None = None
    left_out_utc_ns: int = 0
    to_leave_out: list[str] = []
    planned_utc_ns: int = 0
    diagnosed_utc_ns: int = 0
    misfit_min: float = 0.0
    probes_shown: list[tuple[int, float]] = []
    clean_min: float = 0.0
    usable_min: float = 0.0
    uncompared_min: float = 0.0
    uncompared_ns: int = 0
    found: list[InShadow] = []
    watched: InShadow | None = None
    adopted_utc_ns: int = 0
    effects: list[str] = []
    base_effects: list[str] = []
    error: ErrorBlocks = msgspec.field(default_factory=ErrorBlocks)
    zero_utc_ns: int = 0
    zero_channels: list[str] | None = None
    y_moved_ns: int = 0
    avoided: list[Avoided] = []

    @property
    def taken(self) -> list[InShadow]:
        """The models in shadow, the way back first."""
        return [*([self.watched] if self.watched is not None else []), *self.found]

    def place(self, sha256: str) -> InShadow | None:
        """Return the model in shadow with a hash."""
        return next((place for place in self.taken if place.sha256 == sha256), None)

    def follow_clock(self, now_ns: int, period_ns: int, record_ns: int) -> None:
        """Go on at the time of a sample: where the clock was set since the last one, every time moves with it.

        So what has lasted for some hours has lasted as long after it. Where nothing is left of the record that is
        diagnosed, by that or after a long time off, what the model has erred by is forgotten, and the next planned time
        is waited for.

        Parameters
        ----------
        now_ns, period_ns : int
            Time of the sample, ns since 1970 UTC, and length of one, ns.
        record_ns : int
            Length of the record that is diagnosed, ns.
        """
        last_ns, off_ns = self.time_utc_ns, self.missing * period_ns
        self.time_utc_ns, self.missing = now_ns, 0
        set_ns = now_ns - last_ns - off_ns - period_ns if last_ns else 0
        if abs(set_ns) >= period_ns:
            self._move_clock(set_ns)
        if max(abs(set_ns), off_ns) >= record_ns:
            self.planned_utc_ns, self.usable_min, self.misfit_min = 0, 0.0, 0.0

    def _move_clock(self, by_ns: int) -> None:
        self.diagnosed_utc_ns = moved(self.diagnosed_utc_ns, by_ns)
        self.left_out_utc_ns = moved(self.left_out_utc_ns, by_ns)
        self.zero_utc_ns = moved(self.zero_utc_ns, by_ns)
        self.y_moved_ns = moved(self.y_moved_ns, by_ns)
        self.uncompared_ns = moved(self.uncompared_ns, by_ns)
        self.adopted_utc_ns = moved(self.adopted_utc_ns, by_ns)
        self.probes_shown = [(at_ns + by_ns, shown) for at_ns, shown in self.probes_shown]
        self.error.move_clock(by_ns)
        for place in self.taken:
            place.since_utc_ns = moved(place.since_utc_ns, by_ns)
            place.level_utc_ns = moved(place.level_utc_ns, by_ns)
            place.comparison.move_clock(by_ns)
            place.error.move_clock(by_ns)
        self.avoided = [
            msgspec.structs.replace(one, until_utc_ns=moved(one.until_utc_ns, by_ns)) for one in self.avoided
        ]

    def remove(self, place: InShadow) -> None:
        """Let a model go."""
        self.watched = None if place is self.watched else self.watched
        self.found = [one for one in self.found if one is not place]

    def forget_left_out(self) -> None:
        """Begin anew to leave out effects, with another model."""
        self.left_out_utc_ns, self.to_leave_out = 0, []

    def forget_errors(self) -> None:
        """Forget what was wrong with the model before."""
        self.error.clear()
        self.probes_shown = []

    @property
    def candidates(self) -> list[InShadow]:
        """The models in shadow that may be adopted."""
        return [place for place in self.found if place.role == "candidate"]

    @property
    def ways_back(self) -> list[InShadow]:
        """The models in shadow that the service goes back to where they are better."""
        return [place for place in self.taken if place.role == "before"]

    @property
    def candidate(self) -> InShadow | None:
        """The candidate that concerns a person: that is proposed, or else shows most."""
        return max(self.candidates, key=lambda place: (place.is_proposed, place.shows), default=None)

    @property
    def proposed(self) -> InShadow | None:
        """The candidate that is proposed, if there is one."""
        return next((place for place in self.candidates if place.is_proposed), None)

    @property
    def has_next(self) -> bool:
        """Whether what a diagnosis has found gets its place before the next sample."""
        return self.diagnosis is not None and self.diagnosis.is_next

    @property
    def shown(self) -> InShadow | None:
        """The model in shadow that concerns a person first: the candidate, or else a model that was in force."""
        return self.candidate or next(iter(self.taken), None)

    @property
    def phase(self) -> Phase:
        """What a person may have to answer to."""
        if self.candidates:
            return "proposed" if self.proposed is not None else "shadow"
        return "watching" if self.taken else "idle"


class _Version(msgspec.Struct):
    schema: int


def decode_loop(data: bytes) -> LoopState:
    """Read a state.

    Raises
    ------
    DataError
        If it is not a state of this version.
    """
    try:
        schema = msgspec.json.decode(data, type=_Version).schema
        if schema != STATE_SCHEMA:
            raise DataError(f"loop.json: schema = {schema}, expected {STATE_SCHEMA}")
        state = msgspec.json.decode(data, type=LoopState)
        check_numbers(msgspec.to_builtins(state))
        return state
    except UNREADABLE as error:
        raise DataError(f"loop.json: {error}") from error
