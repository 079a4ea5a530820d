"""A probe as it arrives: read strictly, and written into the recording with its verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec

from compensator.arrays import NAN
from compensator.codes import ProbeCode, Reason
from compensator.errors import ServiceError
from compensator.messages import SCHEMA, UNREADABLE, Probe, ProbeRequest, number
from compensator.model.correction import ProbeVerdict

_REQUEST = msgspec.json.Decoder(ProbeRequest)
_WORDS = {"": "taken", ProbeCode.OUTLIER: "refused", ProbeCode.BELIEVED: "taken against earlier ones"}
#: From this standard deviation on nothing was known about the value: it is the first of its feature, µm.
UNKNOWN_UM = 200.0


class ProbeRefused(ServiceError):
    """A probe that is refused.

    Parameters
    ----------
    code : ProbeCode
        Why.
    text : str
        The same in words.
    is_comparable : bool
        Whether it is right all the same, and can be compared with predictions.
    """

    def __init__(self, code: ProbeCode, text: str, *, is_comparable: bool = False) -> None:
        super().__init__(text)
        self.code, self.is_comparable = code, is_comparable


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedProbe:
    """A probe with its arrival.

    Parameters
    ----------
    request : ProbeRequest
        What was measured.
    received_utc_ns : int
        When it arrived, ns since 1970 UTC.
    by, by_proof : str
        The sender.
    is_checked : bool
        Whether it passed the checks already, in a run of another model, which did not publish the offset.
    """

    request: ProbeRequest
    received_utc_ns: int
    by: str = "unnamed"
    by_proof: str = "none"
    is_checked: bool = False

    @classmethod
    def of(cls, recorded: Probe, *, is_checked: bool = False) -> ReceivedProbe | None:
        """Return a recorded probe as it arrived; None for one that was not decided."""
        if not recorded.is_read:
            return None
        request = ProbeRequest(
            schema=recorded.schema,
            time_utc_ns=recorded.time_utc_ns,
            axis=recorded.axis,
            measured_um=number(recorded.measured_um),
            offset_applied_um=number(recorded.offset_applied_um),
            std_um=recorded.std_um,
            feature=recorded.feature,
            tool=recorded.tool,
            stopped_s=recorded.stopped_s,
        )
        return cls(
            request=request,
            received_utc_ns=recorded.received_utc_ns,
            by=recorded.by,
            by_proof=recorded.by_proof,
            is_checked=is_checked,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What was made of a probe; NaN where it was refused before it was compared with the prediction.

    `shown_um` is what it shows beyond the prediction, whether it was taken or not; NaN where that is not known.
    """

    taken: bool
    code: str
    text: str
    predicted_um: float = NAN
    innovation_um: float = NAN
    innovation_std_um: float = NAN
    shown_um: float = NAN

    @classmethod
    def of(cls, found: ProbeVerdict, deformation_um: float, predicted_um: float) -> Verdict:
        """Return the verdict on a probe that was compared with the prediction."""
        std_um = found.innovation_std_um
        known = f"±{std_um:.2f} µm" if std_um < UNKNOWN_UM else "anything: the first of this feature"
        text = (
            f"probe {_WORDS[found.reason or '']}: deformation {deformation_um:.2f} µm, "
            f"{found.innovation_um:+.2f} µm from the prediction (expected {known})"
        )
        return cls(
            taken=found.taken,
            code=found.reason or "",
            text=text,
            predicted_um=predicted_um,
            innovation_um=found.innovation_um,
            innovation_std_um=std_um,
            shown_um=found.innovation_um,
        )


def read_probe(payload: bytes) -> ProbeRequest:
    """Read the payload of the command.

    Raises
    ------
    ProbeRefused
        If it is not a probe; the message names key and value.
    """
    try:
        request = _REQUEST.decode(payload)
    except (*UNREADABLE, ValueError, OverflowError) as error:
        raise ProbeRefused(ProbeCode.MALFORMED, f"probe: {error}") from error
    if request.schema != SCHEMA:
        raise ProbeRefused(ProbeCode.MALFORMED, f"probe: schema = {request.schema}, expected {SCHEMA}")
    for name in ("measured_um", "offset_applied_um", "std_um", "stopped_s"):
        value = getattr(request, name)
        if value is not None and not math.isfinite(value):
            raise ProbeRefused(ProbeCode.MALFORMED, f"probe: {name} = {value}, expected a finite number")
    return request


def recorded_probe(machine: str, seq: int, probe: ReceivedProbe, verdict: Verdict) -> Probe:
    """Return the message for the recording."""
    request = probe.request
    return Probe(
        schema=request.schema,
        machine=machine,
        seq=seq,
        time_utc_ns=request.time_utc_ns,
        axis=request.axis,
        measured_um=request.measured_um,
        std_um=request.std_um,
        offset_applied_um=request.offset_applied_um,
        feature=request.feature,
        tool=request.tool,
        stopped_s=request.stopped_s,
        received_utc_ns=probe.received_utc_ns,
        by=probe.by,
        by_proof=probe.by_proof,
        taken=verdict.taken,
        code=verdict.code,
        text=verdict.text,
        deformation_um=request.measured_um - request.offset_applied_um,
        predicted_um=verdict.predicted_um,
        innovation_um=verdict.innovation_um,
        innovation_std_um=verdict.innovation_std_um,
    )


def unused_probe(
    machine: str, probe_utc_ns: int, code: ProbeCode, text: str, by: str = "", by_proof: str = "none"
) -> Probe:
    """Return the message for a payload that could not be read, or for which there was no room.

    It has no measured value, so that a replay does not decide it; its number is set when it is written.
    """
    return Probe(
        schema=SCHEMA,
        machine=machine,
        seq=0,
        time_utc_ns=probe_utc_ns,
        axis="",
        measured_um=None,
        std_um=None,
        offset_applied_um=None,
        feature="",
        tool="",
        stopped_s=None,
        received_utc_ns=probe_utc_ns,
        by=by,
        by_proof=by_proof,
        taken=False,
        code=code,
        text=text,
        deformation_um=None,
        predicted_um=None,
        innovation_um=None,
        innovation_std_um=None,
    )


def undecided_probe(machine: str, seq: int, probe: ReceivedProbe, *, ends: bool = False) -> Probe:
    """Return the message for a probe whose sample could not be processed, or does not come because the service ends."""
    code: str = ProbeCode.TIME_UNKNOWN if ends else Reason.INTERNAL_ERROR
    why = "because the service ended before the next sample" if ends else "because of an internal error"
    return recorded_probe(machine, seq, probe, Verdict(taken=False, code=code, text=f"probe: not decided, {why}"))
