"""Events: their kinds, the data of each, and how programs read them.

`Event.text` is one line for people, and its wording may change. Programs read only `kind` and `data`. Version
0.1.0 recorded some events with a text only; the functions to read those are at the end of this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Literal, NamedTuple, TypeVar

import msgspec

from compensator.axes import FIRST
from compensator.messages import Event


class EventKind(StrEnum):
    """Kinds of events, as in `Event.kind`."""

    START = "start"
    STOP = "stop"
    #: The state found on disk at the start of the service; the pause since then, or a later one (`PauseData`).
    RESTART = "restart"
    #: A new state, or new reasons.
    STATE = "state"
    #: A zero was set (`ZeroData`).
    ZERO = "zero"
    #: A command that acts with the sample of the same number, see `command_of`.
    COMMAND = "command"
    COMMAND_REFUSED = "command_refused"
    #: Another model was adopted or refused, with `comparison` in its data (`ComparisonData`).
    ADOPT = "adopt"
    #: A probe was taken or refused (`ProbeData`).
    PROBE = "probe"
    #: Result of a diagnosis (`DiagnosisData`).
    DIAGNOSIS = "diagnosis"
    #: A decision about the model (`LoopData`).
    LOOP = "loop"
    #: A device stopped answering, or answers again.
    DEVICE = "device"
    #: The wall clock was set.
    CLOCK = "clock"
    #: A fault or action of the recording (`RecordingData`).
    RECORDING = "recording"
    #: Sensors that contradict each other or the model, see `Implausibility`.
    PLAUSIBILITY = "plausibility"
    #: An internal error; the offset is held.
    ERROR = "error"


class CommandName(StrEnum):
    """Commands to the service, as in the key and in the event."""

    ZERO = "zero"
    HOLD = "hold"
    RESUME = "resume"
    ADOPT = "adopt"
    BACK = "back"
    #: What a touch probe measured (`ProbeRequest`).
    PROBE = "probe"
    #: Ends a proposed model.
    DISMISS = "dismiss"


class Note(NamedTuple):
    """An event before it gets its number and time.

    Parameters
    ----------
    kind : EventKind
        Its kind.
    text : str
        One line for people.
    data : mapping of str to Any
        Data for programs.
    """

    kind: EventKind
    text: str
    data: Mapping[str, Any]


class _Data(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Data of one kind of event."""

    def table(self) -> dict[str, Any]:
        """Return the data as stored in `Event.data`."""
        table: dict[str, Any] = msgspec.to_builtins(self)
        return table


#: Begins what the text of a zero says against it.
DOUBT = "; warning: "


class ZeroData(_Data, frozen=True, kw_only=True):
    """A zero that was set: on a machine at rest or a warm one, T_Q, AT (°C) and Y (µm) at that time.

    Where a rest was ordered and the model clearly contradicts it, `warm_um` is the deformation by stored heat, µm.
    """

    mode: Literal["rest", "warm"]
    t_q_degc: float
    at_degc: float
    y_um: float | None
    warm_um: float | None = None


class PauseData(_Data, frozen=True, kw_only=True):
    """A pause: before the first sample of a service, or of a service that stood still.

    Parameters
    ----------
    missing : int or None
        Number of samples that were not measured; None if unknown.
    minutes : float or None
        The same, min.
    bridged : bool
        Whether the pause is short enough to be interpolated.
    y_std_um : float or None
        Standard deviation of the prediction after it, µm.
    """

    missing: int | None
    minutes: float | None
    bridged: bool
    y_std_um: float | None


class ProbeData(_Data, frozen=True, kw_only=True):
    """A probe that was taken or refused; the recording contains all of it (`/probe`).

    Parameters
    ----------
    taken : bool
        Whether it corrects the prediction.
    code : str
        Why it was refused, or a remark.
    probe_utc_ns : int
        When it was measured, ns since 1970 UTC.
    feature : str
        The feature.
    innovation_um, innovation_std_um : float, optional
        Measured less predicted deformation, and the standard deviation expected of it, µm.
    by, by_proof : str
        The sender, as in the event of a command.
    """

    taken: bool
    code: str = ""
    probe_utc_ns: int
    feature: str = ""
    innovation_um: float | None = None
    innovation_std_um: float | None = None
    by: str
    by_proof: str


class ComparisonVerdict(StrEnum):
    """Verdict on another model by the measured Y on record."""

    BETTER = "better"
    ALIKE = "alike"
    WORSE = "worse"
    NOT_JUDGED = "not_judged"


class NotJudged(StrEnum):
    """Why measured Y does not judge another model, `why` in the data of a comparison."""

    NO_ZERO = "no_zero"
    NO_RECORD = "no_record"
    NO_Y = "no_y"
    #: Nothing has been compared yet, for whatever reason.
    NOT_YET = "not_yet"
    TOO_LITTLE = "too_little"
    SUSPECT = "suspect"
    UNRELATED = "unrelated"


class ComparisonData(_Data, frozen=True, kw_only=True):
    """Another model compared with the present one by the measured Y on record.

    Parameters
    ----------
    verdict : ComparisonVerdict
        The verdict.
    why : NotJudged, optional
        Why it could not be judged.
    remark : str
        Why the recordings could not be replayed, in words; or of what sensors are suspected while nothing is compared.
    measured_by : {"sensor", "probe", ""}
        What measured Y; empty if nothing did.
    hours : float
        Time from the first compared value to the end of the recordings, h.
    samples, probes : int
        Number of compared samples of a displacement sensor, or of compared probes.
    present_rms_um, candidate_rms_um : float, optional
        Root mean square of measured − predicted Y: of the present model and of the other one, µm.
    deviations : float, optional
        By how many standard deviations the present model is refuted; negative if the other one is.
    effective : float, optional
        Number of independent values that this rests on.
    ratio : float, optional
        Root mean square of the changes of the other model's residual over that of the present one's.
    y_moved : bool
        Whether the errors about the zero contradict the verdict: measured Y has moved by itself, or an effect has moved
        it since the zero that the other model counts otherwise.
    offset_change_um : float, optional
        By how much the offset would move at the end of the recordings, µm.
    axes : dict of str to ComparisonData
        On a machine of several axes, each further axis that is measured, by its own values; the other fields are of Y.
    """

    verdict: ComparisonVerdict
    why: NotJudged | None = None
    remark: str = ""
    measured_by: Literal["sensor", "probe", ""] = ""
    hours: float = 0.0
    samples: int = 0
    probes: int = 0
    present_rms_um: float | None = None
    candidate_rms_um: float | None = None
    deviations: float | None = None
    effective: float | None = None
    ratio: float | None = None
    y_moved: bool = False
    offset_change_um: float | None = None
    axes: dict[str, ComparisonData] = {}

    def by_axis(self) -> dict[str, ComparisonData]:
        """Return the comparison of each axis, that of Y first."""
        return {FIRST: self, **self.axes}


class LoopAction(StrEnum):
    """Decisions about the model, `step` in the data of such an event."""

    #: A diagnosis begins.
    DIAGNOSE = "diagnose"
    #: What the diagnosis found begins to run beside the present model.
    SHADOW = "shadow"
    #: Nothing follows from the diagnosis.
    NOTHING = "nothing"
    PROPOSE = "propose"
    #: A proposal does not stand any longer.
    WITHDRAW = "withdraw"
    ADOPT = "adopt"
    BACK = "back"
    #: The comparison ends without another model.
    END = "end"
    #: Nothing has been compared for long: a sensor is suspected under all models.
    WAIT = "wait"
    #: That is over.
    WAIT_OVER = "wait_over"


class DiagnosisData(_Data, frozen=True, kw_only=True):
    """What a diagnosis has found, and how that differs from the present model.

    Parameters
    ----------
    verdict : str
        As in `diagnosis.json`; `failed` if there is none; empty where nothing was diagnosed (`without`).
    effects : list of str
        Effects of the candidate, each with its kind and place.
    candidate_sha256, candidate : str
        Hash and name of the candidate's model file; empty if there is none.
    calibrated : bool
        Whether the candidate is the calibrated model itself.
    without : str
        The effect that the candidate, the present model otherwise, does not have: it may have ended.
    fewer : bool
        Whether it is a way back: the present model has its effects and more, and no person decides about it.
    present_sha256 : str
        Hash of the present model that it was weighed beside; empty where there is no candidate.
    same_effects : bool
        Whether the present model has the same effects.
    change_deviations : float, optional
        If so, by how many standard deviations the parameter that differs most does.
    refused : str
        Why the candidate cannot be used.
    needs : str
        What a person has to do.
    off_at_zero : list of str, optional
        Channels at whose 0 all that the candidate adds to the calibrated model adds nothing on a machine at rest; None
        where it may.
    y_moved_utc_ns : int
        When measured Y last moved by itself, ns since 1970 UTC: a step of it was named, or a drift, which goes on to
        the end; 0 if none was.
    from_utc_ns, to_utc_ns : int
        What was diagnosed, ns since 1970 UTC.
    seconds : float
        How long it took.
    """

    verdict: str
    effects: list[str] = []
    candidate_sha256: str = ""
    candidate: str = ""
    calibrated: bool = False
    without: str = ""
    fewer: bool = False
    present_sha256: str = ""
    same_effects: bool = False
    change_deviations: float | None = None
    refused: str = ""
    needs: str = ""
    off_at_zero: list[str] | None = None
    y_moved_utc_ns: int = 0
    from_utc_ns: int = 0
    to_utc_ns: int = 0
    seconds: float = 0.0


class LoopData(_Data, frozen=True, kw_only=True):
    """A decision about the model, with the figures on which it rests.

    Parameters
    ----------
    step : LoopAction
        The decision.
    why : str
        Its reason in a word.
    role : {"candidate", "before", ""}
        What the compared model is.
    model_sha256 : str
        Hash of its file.
    effects : list of str
        Its effects.
    from_utc_ns, to_utc_ns : int
        What is diagnosed.
    since_utc_ns : int
        When the comparison began, or since when nothing is compared.
    comparison : ComparisonData, optional
        The comparison at that time.
    level_um : float, optional
        By how much the level of the other model is raised at the exchange, µm (`Compensation.raise_level`).
    reasons : list of str
        Codes of what is suspected while nothing is compared.
    """

    step: LoopAction
    why: str = ""
    role: Literal["candidate", "before", ""] = ""
    model_sha256: str = ""
    effects: list[str] = []
    from_utc_ns: int = 0
    to_utc_ns: int = 0
    since_utc_ns: int = 0
    comparison: ComparisonData | None = None
    level_um: float | None = None
    reasons: list[str] = []


class RecordingCode(StrEnum):
    """Faults and actions of the recording."""

    DISK_FAILED = "disk_failed"
    DISK_LATE = "disk_late"
    DISK_BACK = "disk_back"
    RECOVERED = "recovered"
    REMOVED = "removed"
    NOT_COMPACTED = "not_compacted"
    NOT_REMOVED = "not_removed"
    NOT_FINISHED = "not_finished"
    NOT_AS_WRITTEN = "not_as_written"
    HEAD_NOT_KEPT = "head_not_kept"


class RecordingData(_Data, frozen=True, kw_only=True):
    """Data of a fault or action of the recording.

    Parameters
    ----------
    code : RecordingCode, optional
        Code of the event; version 0.1.0 did not record it.
    published_early : int, optional
        Number of a sample whose offset was published while it was being written.
    reason : str, optional
        Reason with which that offset was published.
    lost : int, optional
        Samples that were given up before the disk accepted the recording again.
    file : str, optional
        The recording.
    removed : list of str
        Recordings that were removed by the retention limit.
    bytes : int, optional
        Their size.
    """

    code: RecordingCode | None = None
    published_early: int | None = None
    reason: str = ""
    lost: int | None = None
    file: str = ""
    removed: list[str] = []
    bytes: int | None = None

    @property
    def is_resolved(self) -> bool:
        """Whether no action is needed."""
        if self.code is None:
            return self.lost is not None or bool(self.removed)
        return self.code in (RecordingCode.DISK_BACK, RecordingCode.RECOVERED, RecordingCode.REMOVED)


class Implausibility(StrEnum):
    """Findings of the plausibility checks, `code` in the data of such an event."""

    EXCHANGED = "exchanged"
    APART = "apart"
    TOGETHER = "together"
    RESIDUAL = "residual"
    RESIDUAL_OVER = "residual_over"
    JUMPED = "jumped"
    UNCONFIRMED = "unconfirmed"
    ACCEPTED = "accepted"
    WAS_WRONG = "was_wrong"


_AnyData = TypeVar("_AnyData", bound=_Data)


def data_of(event: Event, kind: type[_AnyData]) -> _AnyData | None:
    """Return the data of an event; None if they are of another kind.

    Examples
    --------
    >>> event = Event(schema=1, machine="a", seq=1, time_utc_ns=0, kind="recording", text="", data={"lost": 3})
    >>> data_of(event, RecordingData).lost, data_of(event, ZeroData)
    (3, None)
    """
    try:
        return msgspec.convert(event.data, kind)
    except msgspec.ValidationError:
        return None


def pause_of(event: Event) -> PauseData | None:
    """Return the pause that an event records; None if it records none."""
    return data_of(event, PauseData) if event.kind == EventKind.RESTART else None


def command_of(event: Event) -> str:
    """Return the name of the command that an event records.

    Version 0.1.0 recorded the name as the text alone.
    """
    name = event.data.get("command")
    return name if isinstance(name, str) else event.text


def is_recorded(note: Note, event: Event) -> bool:
    """Return whether a recorded event agrees with a note.

    Version 0.1.0 recorded zeros and implausibilities without data: for those the texts are compared, so these two
    kinds of note keep the wording of that version. It did not doubt a zero at rest: what is said of that is left out.
    """
    if event.kind != note.kind:
        return False
    if not event.data:
        return event.text == note.text.partition(DOUBT)[0]
    return msgspec.json.encode(event.data) == msgspec.json.encode(note.data)
