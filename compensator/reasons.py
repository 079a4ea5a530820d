"""States, reasons and qualities of the service, and the words of every code: what it means, and what to do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from compensator.codes import Code
from compensator.remarks import (
    AuditFinding,
    AuditRemark,
    BridgeTrouble,
    DataRemark,
    ModelWarning,
    RecordingEnd,
    ServiceWarning,
    WatchWarning,
)


class State(Code):
    """How far the published offset can be relied on."""

    STARTING = (
        "starting",
        "The service runs but has no zero yet, so there is no offset.",
        "Wait for the first good sample of T_Q and AT; if none comes, run `compensator probe`.",
    )
    OK = "ok", "Everything is measured and the offset follows the model.", "Nothing."
    DEGRADED = (
        "degraded",
        "The service compensates, but something is missing or limited; the reasons say what.",
        "Look at the reasons.",
    )
    HOLD = (
        "hold",
        "The last good offset stays as it is and does not follow the machine.",
        "Look at the reasons; find the cause before the next precise cut.",
    )
    FAULT = "fault", "There is no reliable offset.", "Do not rely on compensation; look at the reasons and the events."


class Reason(Code):
    """Why the state is not `ok`; some carry a channel after a colon."""

    NO_ZERO = "no_zero", "No zero has been set yet.", "Restore T_Q and AT, or send the command zero."
    T_Q_MISSING = (
        "t_q_missing",
        "T_Q cannot be used in this sample.",
        "See the quality of t_q_degc; check the thermocouple and its module.",
    )
    AT_MISSING = (
        "at_missing",
        "AT cannot be used in this sample.",
        "See the quality of at_degc; check the thermocouple, its module and the line.",
    )
    CHANNEL_MISSING = (
        "channel_missing",
        "A channel that an effect of the model uses is missing; its last good value is used instead.",
        "Check the sensor of that channel.",
    )
    PREDICTING = (
        "predicting",
        "A temperature is missing; the model predicts with the last known heat.",
        "Restore the sensor within loss.predict_for_min; after that the offset is held.",
    )
    PREDICTION_EXPIRED = (
        "prediction_expired",
        "A temperature has been missing for longer than the model may predict.",
        "Repair the sensor; the offset then moves to its correct value at the permitted rate.",
    )
    OUTSIDE_VALIDITY = (
        "outside_validity",
        "T_Q, AT or the heat is outside the range that the model was made for.",
        "Calibrate on a wider range, or bring the machine back into it.",
    )
    OFFSET_LIMITED = (
        "offset_limited",
        "The offset has reached its largest permitted value.",
        "Check sensors and model before raising limits.offset_max_um.",
    )
    RATE_LIMITED = (
        "rate_limited",
        "The offset moves at its largest permitted rate and has not reached its value yet.",
        "Wait; if it persists, check sensors and limits.offset_rate_max_um_per_min.",
    )
    MODEL_CHANGED = (
        "model_changed",
        "Another model was adopted; the offset is still moving to its new value at the permitted rate.",
        "Wait until it has arrived; `compensator back` returns to the previous model.",
    )
    COLD_START = (
        "cold_start",
        "No record shows how much heat the machine had stored, so the model started from the temperatures it found.",
        "Allow for the standard deviation, or let the machine come to rest and send the command zero.",
    )
    T_Q_AT_EXCHANGED = (
        "t_q_at_exchanged",
        "T_Q has been below AT for too long: the two are exchanged, or a thermocouple has come off.",
        "Check wires, terminals and addresses of both; let the machine rest and send the command zero, or resume.",
    )
    T_Q_AT_APART = (
        "t_q_at_apart",
        "At rest, T_Q and AT did not return to the difference they had at the zero.",
        "Compare both thermocouples; if they are good, send the command zero at rest.",
    )
    IMPLAUSIBLE = (
        "implausible",
        "Measured and predicted Y drift apart; the likeliest cause follows the colon: a sensor, or the model.",
        "Check that sensor, its wire and its seat; for the model, run `compensator diagnose` on the recordings.",
    )
    RESIDUAL_TOO_LARGE = (
        "residual_too_large",
        "Measured and predicted Y differ by more than plausibility.residual_hold_um.",
        "Find the sensor that the reasons suspect; then send the command zero at rest.",
    )
    OPERATOR_HOLD = "operator_hold", "An operator has frozen the offset.", "Send the command resume."
    RECORDING_FAILED = (
        "recording_failed",
        "The disk refused the sample, which waits to be written; compensation continues.",
        "Check free space, permissions and the disk.",
    )
    RECORDING_LATE = (
        "recording_late",
        "The disk is slow: the offset was published before its sample was written; the sample follows.",
        "Check the disk: its health, other programs that write to it, a network share.",
    )
    INTERNAL_ERROR = (
        "internal_error",
        "An internal error occurred in the service; it holds the offset.",
        "Report the event with its text.",
    )


class SampleQuality(Code):
    """Whether a channel's value can be used in a sample; qualities and errors of devices, and checks of the service."""

    GOOD = "good", "The value can be used.", "Nothing."
    OPEN_CIRCUIT = "open_circuit", "The thermocouple or its wiring is broken.", "Check thermocouple and terminals."
    OVER_RANGE = (
        "over_range",
        "The value is above the range of the device or sensor.",
        "Check sensor, range and wiring.",
    )
    UNDER_RANGE = (
        "under_range",
        "The value is below the range of the device or sensor.",
        "Check sensor, range and wiring.",
    )
    STALE = "stale", "The device gives no new values.", "Check device and connection."
    INVALID = "invalid", "The device marks the value as invalid.", "Check the device."
    TOO_FEW = "too_few", "Too few good readings in the sample.", "See the channel's errors: line, module, noise."
    OUTLIER = (
        "outlier",
        "A single reading far from the others of its sample was left out.",
        "Nothing for a few; check the line for noise if there are many.",
    )
    OUT_OF_RANGE = "out_of_range", "The value is outside the channel's plausible range.", "Check sensor and range."
    TOO_FAST = (
        "too_fast",
        "The value changed faster than is possible where the sensor sits.",
        "Check for a loose sensor or a noisy line.",
    )
    STUCK = "stuck", "The value has not changed for too long.", "Check that sensor and module still measure."
    T_Q_BELOW_AT = (
        "t_q_below_at",
        "T_Q is below AT although the machine is heated.",
        "Check for exchanged sensors, or one that has come off.",
    )
    DEVICE_TIMEOUT = "device_timeout", "The device did not answer in time.", "Check power, address and line."
    DEVICE_DISCONNECTED = (
        "device_disconnected",
        "The port, adapter or socket of the device is gone.",
        "Check cable, adapter and network.",
    )
    DEVICE_REFUSED = (
        "device_refused",
        "The device answered with an error.",
        "Check address, registers and its configuration.",
    )
    DEVICE_GARBLED = (
        "device_garbled",
        "The device sent no valid frame.",
        "Check line settings, termination and shielding.",
    )
    DEVICE_ERROR = "device_error", "The device could not be read.", "See the message in the events."
    DEVICE_CONFIG = (
        "device_config",
        "The configuration of the device cannot be used.",
        "Run `compensator check`.",
    )


#: Every domain; no code occurs in two of them.
DOMAINS: tuple[type[Code], ...] = (
    *(State, Reason, SampleQuality, ModelWarning, ServiceWarning, BridgeTrouble),
    *(DataRemark, WatchWarning, AuditRemark, RecordingEnd, AuditFinding),
)

#: code → (what it means, what to do)
WORDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {str(code): (code.meaning, code.action) for domain in DOMAINS for code in domain}
)


class Remark(str):
    """A warning or remark: what was noticed, with its figures, and what to do; it knows its code.

    Parameters
    ----------
    code : Code
        Its code; `compensator explain` explains it.
    figures : str
        What was noticed here; what to do is appended.

    Examples
    --------
    >>> remark = Remark(ModelWarning.TWIN_MODES, "Two time constants of the DTF coincide at 20 min.")
    >>> remark
    'Two time constants of the DTF coincide at 20 min. Try one mode less with --order.'
    >>> remark.code
    <ModelWarning.TWIN_MODES: 'twin_modes'>
    """

    __slots__ = ("code",)
    code: Code

    def __new__(cls, code: Code, figures: str) -> Remark:
        """Append what to do to what was noticed."""
        remark = super().__new__(cls, f"{figures} {code.action}")
        remark.code = code
        return remark

    def __reduce__(self) -> tuple[Callable[[Code, str], Remark], tuple[Code, str]]:
        return _restored, (self.code, str(self))

    @property
    def marked(self) -> str:
        """The remark followed by its code, for a terminal or a log."""
        return f"{self} [{self.code}]"


def _restored(code: Code, words: str) -> Remark:
    """Return a remark that was pickled or copied."""
    remark = str.__new__(Remark, words)
    remark.code = code
    return remark


def explain(code: str) -> tuple[str, str] | None:
    """Return what a code means and what to do, or None if it is unknown.

    Examples
    --------
    >>> explain("ok")[1]
    'Nothing.'
    """
    return WORDS.get(code.partition(":")[0])
