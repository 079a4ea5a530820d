"""What the service records and publishes: JSON messages with a schema each.

A missing value is NaN in memory and null in JSON; the encoder turns one into the other, and `number` turns
it back. The types bound what a message can hold, so whoever reads one by `read_message` has the same bounds. The JSON
Schemas in `compensator/schemas` are made from these classes by `schemas()`; a test keeps the two together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib import resources
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, UnsetType

from compensator.codes import SampleQuality, State

#: Version of the messages.
SCHEMA = 1
#: Largest number of a sample, ten a second for 300 years, and latest time, in 2262. The receiver stands alone and has
#: the same bounds; a test compares them.
SEQ_MAX, TIME_MAX_NS = 100_000_000_000, 2**63 - 1
#: Largest magnitude of what is measured, and of any number. What a model makes of readings stays below the second, and
#: what a reader makes of that, squares for example, remains finite.
READING_MAX, NUMBER_MAX = 1e12, 1e30
#: Largest offset, µm, µrad or µm/m, that any configuration permits.
OFFSET_MAX = 5000.0

SampleNumber = Annotated[int, Meta(ge=0, le=SEQ_MAX)]
TimeNs = Annotated[int, Meta(ge=0, le=TIME_MAX_NS)]
Reading = Annotated[float, Meta(ge=-READING_MAX, le=READING_MAX)]
Number = Annotated[float, Meta(ge=-NUMBER_MAX, le=NUMBER_MAX)]
OffsetValue = Annotated[float, Meta(ge=-OFFSET_MAX, le=OFFSET_MAX)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
#: Number of a record in its file, −1 before the first.
RecordNumber = Annotated[int, Meta(ge=-1, le=2**32 - 1)]
#: Period of samples as a model file may have it, s.
PeriodS = Annotated[float, Meta(ge=0.1, le=3600.0)]
#: Validity of an offset, s: of the longest samples two and a half, and a margin. Beyond it nothing would ever expire.
ValidForS = Annotated[float, Meta(gt=0.0, le=10_000.0)]

#: Longest place of a number that is named, characters.
_PLACE = 80
#: What reading bytes as JSON raises that is not such a message: also nested thousands deep, which is no MsgspecError.
UNREADABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


class ChannelSample(msgspec.Struct, frozen=True, kw_only=True):
    """One channel over one sample.

    Parameters
    ----------
    mean, min, max : float or None
        Robust mean of the good readings and extremes of those that it is made of, in the channel's unit.
    spread : float or None
        Standard deviation of the same readings.
    count : int
        Number of readings that the mean is made of.
    polls : int
        Number of readings that were asked for.
    quality : str
        `good`, or the code of what makes it unusable.
    device_quality : str
        What the device alone said, before the guards.
    errors : dict of str to int
        Codes of bad readings and device errors in this sample, with their number.
    """

    mean: Number | None
    min: Number | None
    max: Number | None
    spread: Number | None
    count: Count
    polls: Count
    quality: str
    device_quality: str
    errors: dict[str, Count] = {}

    @property
    def is_good(self) -> bool:
        """Whether the value can be used."""
        return self.quality == SampleQuality.GOOD


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """A message of the service: version of its schema, machine, number of the sample, and time, ns since 1970 UTC."""

    schema: int
    machine: str
    seq: SampleNumber
    time_utc_ns: TimeNs


class Sample(Message, frozen=True, kw_only=True):
    """Every raw channel of one sample, `/sample` and `thermal/sample`.

    Parameters
    ----------
    seq : int
        Number of the sample; the estimate and the offset of the sample carry the same.
    time_utc_ns : int
        End of the sample, ns since 1970 UTC.
    period_s : float
        Length of the sample, s.
    channels : dict of str to ChannelSample
        By channel name, unit in the name.
    """

    period_s: PeriodS
    channels: dict[str, ChannelSample]

    @property
    def behind_ns(self) -> int:
        """How far before its end the middle of its polls is, ns; each is at the end of its part of the sample."""
        return self.behind_of(None)

    def behind_of(self, polls: int | None) -> int:
        """Return how far before its end the middle of its polls is, ns.

        Parameters
        ----------
        polls : int or None
            Number of polls of a whole sample; None if this is one. The first sample of a start has the last of them.
        """
        own = max([1, *(channel.polls for channel in self.channels.values())])
        return round(0.5 * (own - 1) / max(polls or 0, own) * self.period_s * 1e9)


class EstimateMessage(Message, frozen=True, kw_only=True):
    """What the model makes of one sample, `/estimate` and `thermal/estimate`.

    Parameters
    ----------
    t_q_ref_degc, at_ref_degc, y_ref_um : float or None
        Zero of the two temperatures and of the measured deformation.
    t_q_shift_k, at_shift_k : float, optional
        By how much the sensor of the temperature shows more than the one that the model was made with, K; only after
        a jump that was accepted as another zero of the sensor.
    heat_w, heat_std_w : float or None
        Estimated heat and its standard deviation, W.
    y_dtf_um, y_tdtf_um, y_effects_um
        Share of each path and effect, µm.
    y_base_um : float
        Predicted deformation at the last zero on a warm machine, less `level_um`, µm; it is subtracted from the sum of
        the shares.
    level_um : float, optional
        By how much the prediction was raised since the zero, to the level of measured Y, as the loop adopted the
        model, µm; only if it was.
    y_pred_um, y_std_um : float or None
        Predicted deformation since the zero and its standard deviation, µm.
    y_rate_um_per_min : float or None
        Growth over the next sample, µm/min.
    y_um, residual_um : float or None
        Measured deformation since the zero, and measured − predicted, µm.
    """

    t_q_ref_degc: Number | None
    at_ref_degc: Number | None
    y_ref_um: Number | None
    t_q_shift_k: Number | UnsetType = UNSET
    at_shift_k: Number | UnsetType = UNSET
    heat_w: Number | None
    heat_std_w: Number | None
    y_dtf_um: Number | None
    y_tdtf_um: Number | None
    y_effects_um: list[Number]
    y_base_um: Number
    level_um: Number | UnsetType = UNSET
    y_pred_um: Number | None
    y_std_um: Number | None
    y_rate_um_per_min: Number | None
    y_um: Number | None
    residual_um: Number | None


class Offset(Message, frozen=True, kw_only=True):
    """The correction, `/offset` and `thermal/y/offset`.

    Parameters
    ----------
    seq : int
        Never repeats for a machine.
    valid_for_s : float
        How long after `time_utc_ns` a receiver may use it, s.
    y_offset_um : float or None
        To be added to the commanded Y, µm; null while there is none yet.
    y_offset_rate_um_per_min : float or None
        How it is expected to move until the next sample, µm/min.
    y_offset_std_um : float or None
        Standard deviation, µm.
    state : str
        `starting`, `ok`, `degraded`, `hold` or `fault`.
    reasons : list of str
        Codes of why the state is not `ok`, see `compensator.codes`.
    model_sha256 : str
        Hash of the model file.
    """

    valid_for_s: ValidForS
    y_offset_um: OffsetValue | None
    y_offset_rate_um_per_min: Number | None
    y_offset_std_um: Number | None
    state: State
    reasons: list[str]
    model_sha256: str


class Event(Message, frozen=True, kw_only=True):
    """Something that happened, `/event` and `thermal/event`.

    Parameters
    ----------
    kind : str
        `start`, `stop`, `zero`, `command`, `state`, `device`, `clock`, `recording`, ….
    text : str
        One line for people.
    data : dict
        Numbers and names that belong to it.
    """

    kind: str
    text: str
    data: dict[str, Any] = {}


class LoopStatus(msgspec.Struct, frozen=True, kw_only=True):
    """How the loop is: what runs in shadow, and how it compares with the present model.

    Parameters
    ----------
    phase : {"idle", "shadow", "proposed", "watching"}
        What the shadow is for: nothing, a candidate, a proposed one, or the model from before the last adoption.
    diagnosing : bool
        Whether a diagnosis, or the warm-up of its candidate, is in progress.
    model_sha256 : str
        Hash of the file of the model in shadow; empty without one.
    effects : list of str
        Its effects.
    since_utc_ns : int
        When its comparison began, ns since 1970 UTC.
    y_pred_um : float or None
        Its predicted deformation, µm.
    verdict, text : str
        Verdict so far: `better`, `alike`, `worse` or `not_judged`; and in words.
    present_rms_um, candidate_rms_um, deviations : float or None
        Its figures, see `Candidate`.
    hours : float
        Hours of usable blocks of measured Y.
    probes : int
        Number of compared probes.
    adopted_utc_ns : int
        Time of the last adoption by the loop; 0 before.
    before_effects : list of str, optional
        Effects of the model before the last adoption, where it runs beside a candidate.
    before_text : str
        How it compares, in words.
    others : list of str
        The other candidates, each with its effects and how it compares, in words.
    """

    phase: Literal["idle", "shadow", "proposed", "watching"]
    diagnosing: bool
    model_sha256: str
    effects: list[str]
    since_utc_ns: TimeNs
    y_pred_um: Number | None
    verdict: str
    text: str
    present_rms_um: Number | None
    candidate_rms_um: Number | None
    deviations: Number | None
    hours: Number
    probes: Count
    adopted_utc_ns: TimeNs
    before_effects: list[str] | None = None
    before_text: str = ""
    others: list[str] = []


class Status(Message, frozen=True, kw_only=True):
    """How the service is, `thermal/status`.

    Parameters
    ----------
    devices : dict of str to str
        `ok` or the last error of each device.
    effects : list of str
        Names of the model's effects, in the order of `y_effects_um`.
    probe_wanted : bool, optional
        Whether a probe is wanted now; this and the following only with `[probe]` in the configuration.
    wanted_by_ns : int or None
        When the standard deviation exceeds the tolerance, ns since 1970 UTC; the time of the message if a probe is
        wanted already, null if none will be wanted within a day or there is no tolerance.
    wanted_why : str
        Code of why one is wanted (`compensator.codes.ProbeCode`), empty if none is.
    wanted_std_um : float or None
        The standard deviation that asks for it, µm.
    wanted_tolerance_um : float or None
        The tolerance with which it is compared, µm.
    loop : LoopStatus, optional
        How the loop is; only with `[loop]` in the configuration.
    predicts_until_utc_ns : int, optional
        Time of the sample from which on the offset is held if the missing temperature does not return, ns since 1970
        UTC; only while the model predicts.
    """

    state: State
    reasons: list[str]
    version: str
    model: str
    model_kind: str
    model_sha256: str
    started_utc_ns: TimeNs
    recording: str
    devices: dict[str, str]
    effects: list[str] = []
    probe_wanted: bool | UnsetType = UNSET
    wanted_by_ns: TimeNs | UnsetType | None = UNSET
    wanted_why: str | UnsetType = UNSET
    wanted_std_um: Number | UnsetType | None = UNSET
    wanted_tolerance_um: Number | UnsetType | None = UNSET
    loop: LoopStatus | UnsetType = UNSET
    predicts_until_utc_ns: TimeNs | UnsetType = UNSET


# No control characters, line ends or marks of the direction; `$` would accept a line end after the last character, and
# `\Z` is not known to readers of the schema.
_Label = Annotated[
    str,
    Meta(
        max_length=64,
        pattern=r"^[^\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]*(?![\s\S])",
    ),
]


class ProbeRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """What a touch probe measured, the payload of the command `thermal/command/probe`.

    Parameters
    ----------
    schema : int
        `SCHEMA`.
    time_utc_ns : int
        When it was measured, ns since 1970 UTC.
    axis : str
        The axis, `y`.
    measured_um : float
        Where the feature was found minus where it belongs, with the offset acting, µm.
    offset_applied_um : float
        The offset that the control had applied then, µm.
    std_um : float, optional
        Standard deviation of the measured value, µm; by default `[probe] std_um`.
    feature : str
        Name of the feature; each has its own zero.
    tool : str
        Name of the probe.
    stopped_s : float, optional
        How long the spindle had been standing, s.
    """

    schema: int
    time_utc_ns: TimeNs
    axis: _Label
    measured_um: Reading
    offset_applied_um: Reading
    std_um: Reading | None = None
    feature: _Label = ""
    tool: _Label = ""
    stopped_s: Annotated[float, Meta(ge=0, le=READING_MAX)] | None = None


class Probe(Message, frozen=True, kw_only=True):
    """A probe as it was received, and what was made of it, `/probe`; only with `[probe]` in the configuration.

    Parameters
    ----------
    seq : int
        Number of the sample with which it was decided; the record is before that `/sample`.
    time_utc_ns, axis, measured_um, std_um, offset_applied_um, feature, tool, stopped_s
        As received, see `ProbeRequest`; null or empty where the payload could not be read, with the time of arrival,
        and where there was no room for it (`probe_too_many`).
    received_utc_ns : int
        When it arrived, ns since 1970 UTC.
    by, by_proof : str
        The sender, see the event of a command.
    taken : bool
        Whether it corrects the prediction.
    code : str
        Why it was refused, or a remark; empty if there is none (`compensator.codes.ProbeCode`).
    text : str
        The verdict in one line.
    deformation_um : float or None
        Deformation that it shows: measured − applied offset, µm.
    predicted_um : float or None
        Deformation by the model alone at that time, µm; null if it was refused before it was compared.
    innovation_um, innovation_std_um : float or None
        Deformation less the corrected prediction, and the standard deviation expected of it, µm.
    """

    axis: str
    measured_um: Number | None
    std_um: Number | None
    offset_applied_um: Number | None
    feature: str
    tool: str
    stopped_s: Number | None
    received_utc_ns: TimeNs
    by: str
    by_proof: str
    taken: bool
    code: str
    text: str
    deformation_um: Number | None
    predicted_um: Number | None
    innovation_um: Number | None
    innovation_std_um: Number | None

    @property
    def is_read(self) -> bool:
        """Whether the payload was a probe that was decided."""
        return self.measured_um is not None


class Candidate(Message, frozen=True, kw_only=True):
    """What another model makes of the same sample, and how both compare so far, `/candidate`; only with `[loop]`.

    It is published to nobody; the record is between `/estimate` and `/offset` of the same `seq`.

    Parameters
    ----------
    model_sha256 : str
        Hash of its model file.
    role : {"candidate", "before"}
        Whether it may be adopted, or is the model from before the last adoption.
    y_pred_um, y_std_um : float or None
        Its predicted deformation since the zero and its standard deviation, µm.
    residual_um, present_residual_um : float or None
        Measured − predicted, µm: of this model, and of the present one.
    innovations_um : list of float or None
        What each compared probe of the sample showed beyond its prediction, µm, in their order.
    reasons : list of str
        Its reasons, as in `/offset`.
    verdict : str
        On the compared data so far: `better`, `alike`, `worse` or `not_judged`.
    present_rms_um, candidate_rms_um : float or None
        Root mean square of measured − predicted Y, µm.
    deviations : float or None
        By how many standard deviations the present model is refuted; negative if this one is.
    hours : float
        Hours of usable blocks of measured Y.
    probes : int
        Number of compared probes.
    """

    model_sha256: str
    role: Literal["candidate", "before"]
    y_pred_um: Number | None
    y_std_um: Number | None
    residual_um: Number | None
    present_residual_um: Number | None
    innovations_um: list[Number | None]
    reasons: list[str]
    verdict: str
    present_rms_um: Number | None
    candidate_rms_um: Number | None
    deviations: Number | None
    hours: Number
    probes: Count


class ChainPart(msgspec.Struct, frozen=True, kw_only=True):
    """One of the things that a recording opens with, in the first `/chain` message of the file.

    Parameters
    ----------
    name : str
        Such as `attachment model.toml`, `metadata run`, `channel /sample`.
    sha256 : str
        Its hash.
    """

    name: str
    sha256: str


class ChainLink(msgspec.Struct, frozen=True, kw_only=True):
    """Value of the hash chain at one record.

    Parameters
    ----------
    topic : str
        Its channel, without the slash.
    sequence : int
        Its number in the file.
    sha256 : str
        Hash over the record and the value before it, see `compensator.recording.chain`.
    """

    topic: str
    sequence: RecordNumber
    sha256: str


class Chain(msgspec.Struct, frozen=True, kw_only=True):
    """Values of the hash chain for the records since the last such message, `/chain`.

    Parameters
    ----------
    before : str
        Value before the first of them; in the first message of a file, the last value of the file before.
    parts : list of ChainPart
        What the file opens with; only in its first message.
    records : list of ChainLink
        One for each record, in the order of the file.
    """

    schema: int
    machine: str
    time_utc_ns: TimeNs
    before: str
    parts: list[ChainPart]
    records: list[ChainLink]


class Seal(msgspec.Struct, frozen=True, kw_only=True):
    """Says that a recording was whole up to here, `/seal`; the last record of a finished file.

    Parameters
    ----------
    reason : str
        `hour` within a file; `day`, `stop`, `new`, `failure` at its end; `recovered` where a torn end was finished
        afterwards.
    sequence : int
        Number of the last record before it, −1 where there is none.
    sha256 : str
        Value of the hash chain before it.
    public_key, signature : str
        Ed25519, hexadecimal; empty where no key is configured. Signed is this message with an empty signature.
    """

    schema: int
    machine: str
    time_utc_ns: TimeNs
    reason: str
    sequence: RecordNumber
    sha256: str
    public_key: str
    signature: str


#: Message of each recorded channel and Zenoh key, and the payload of the command `probe`.
MESSAGES: Mapping[str, type[msgspec.Struct]] = {
    "sample": Sample,
    "estimate": EstimateMessage,
    "offset": Offset,
    "event": Event,
    "status": Status,
    "probe": Probe,
    "probe_request": ProbeRequest,
    "candidate": Candidate,
    "chain": Chain,
    "seal": Seal,
}


AnyOffset = TypeVar("AnyOffset", bound=Offset)


def degraded(offset: AnyOffset, reason: str) -> AnyOffset:
    """Return an offset with one reason more; a state of `ok` becomes `degraded`."""
    state = State.DEGRADED if offset.state == State.OK else offset.state
    return msgspec.structs.replace(offset, state=state, reasons=[*offset.reasons, reason])


_ENCODER = msgspec.json.Encoder()


def encode(message: msgspec.Struct) -> bytes:
    """Encode a message as JSON; NaN becomes null, floats keep every bit."""
    return _ENCODER.encode(message)


_Decoded = TypeVar("_Decoded")


def read_message(decoder: msgspec.json.Decoder[_Decoded], data: bytes) -> _Decoded:
    """Decode a message that somebody else may have written; it holds no number that a message cannot hold.

    Raises
    ------
    msgspec.MsgspecError, UnicodeDecodeError, RecursionError
        As `UNREADABLE`, if it is not such a message.
    """
    message = decoder.decode(data)
    if isinstance(message, Event):
        check_numbers(message.data, "$.data")
    return message


def check_numbers(value: Any, place: str = "$", most: float = NUMBER_MAX) -> None:
    """Check every number in nested lists and tables that no type bounds; NaN and infinity may stand for themselves.

    Parameters
    ----------
    value : object
        Decoded JSON.
    place : str
        Where it stands, for the error.
    most : float
        Largest magnitude of a finite number; that of a whole number is `TIME_MAX_NS`.

    Raises
    ------
    msgspec.ValidationError
        If one is too large; the message names its place.
    """
    if isinstance(value, dict):
        for key, entry in value.items():
            check_numbers(entry, f"{place}.{key}"[:_PLACE], most)
    elif isinstance(value, (list, tuple)):
        for entry in value:
            check_numbers(entry, f"{place}[...]"[:_PLACE], most)
    elif isinstance(value, int) and abs(value) > TIME_MAX_NS:
        raise msgspec.ValidationError(f"Expected `int` <= {TIME_MAX_NS} - at `{place}`")
    elif isinstance(value, float) and most < abs(value) < math.inf:
        raise msgspec.ValidationError(f"Expected `float` <= {most:g} - at `{place}`")


def number(value: float | None) -> float:
    """Return a decoded number, NaN where it is missing."""
    return math.nan if value is None else value


def schemas(messages: Mapping[str, type[msgspec.Struct]] = MESSAGES) -> dict[str, dict[str, Any]]:
    """Make the JSON Schema of every message from its class."""
    made = {}
    for name, message in messages.items():
        definitions = msgspec.json.schema(message)["$defs"]
        definition = definitions.pop(message.__name__)
        if "state" in definition["properties"]:  # its codes are listed in place, without a reference
            definition["properties"]["state"] = {"enum": definitions[State.__name__]["enum"]}
            if f"#/$defs/{State.__name__}" not in str(definitions):
                del definitions[State.__name__]
        made[name] = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            **definition,
            "title": f"thermal.{name}",
            "$defs": definitions,
        }
    return made


def shipped_schema(name: str) -> bytes:
    """Return the JSON Schema of a message as it ships with the package."""
    return resources.files("compensator.schemas").joinpath(f"{name}.schema.json").read_bytes()
