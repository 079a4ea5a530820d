"""Every code with its words: what it means, and what to do.

Each domain has an enumeration of its own, derived from `Code`. A member is the code itself: it compares, formats and
encodes as the text in messages, recordings and JSON. A new code is a member here, and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from types import MappingProxyType


class Code(StrEnum):
    """A code of a domain; derive from it, and give each member its code, meaning and action.

    Attributes
    ----------
    meaning : str
        What it means, one sentence.
    action : str
        What to do, one sentence.

    Examples
    --------
    >>> class Valve(Code):
    ...     OPEN = "open", "Coolant flows.", "Nothing."
    >>> Valve.OPEN == "open", Valve.OPEN.action
    (True, 'Nothing.')
    """

    meaning: str
    action: str

    def __new__(cls, code: str, meaning: str, action: str) -> Code:
        """Make a member of its code, meaning and action."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.meaning, member.action = meaning, action
        return member


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


class ModelWarning(Code):
    """What identification and diagnosis warn of."""

    WORSE_THAN_NOTHING = (
        "worse_than_nothing",
        "On a run that was not used for the fit, the model is worse than no model.",
        "Do not use it there; find how that run differs from the fitted ones, and fit both together.",
    )
    QUIET_AMBIENT = (
        "quiet_ambient",
        "The ambient temperature changed too little to determine the TDTF's gain beyond this range.",
        "Add a record with a larger ambient change (an ETVE over a day).",
    )
    UNDETERMINED_AMBIENT = (
        "undetermined_ambient",
        "The ambient temperature moved, and yet the data do not determine its effect well.",
        "Add a record in which the ambient moves while the heat is steady.",
    )
    SHORT_RECORD = (
        "short_record",
        "The record is short compared with the slowest time constant: the steady state is extrapolated.",
        "Record at least three times the slowest time constant.",
    )
    DRIFTING_MODE = (
        "drifting_mode",
        "The slowest mode is slower than the record: there is a drift that the inputs do not explain.",
        "Record longer, and let compensator diagnose look for the cause of the drift.",
    )
    COMMON_CAUSE = (
        "common_cause",
        "Drive and ambient moved together: the data do not show which of DTF and TDTF caused the deformation.",
        "Heat at another time of the day.",
    )
    UNDETERMINED_GAIN = (
        "undetermined_gain",
        "The data do not determine the static gain of a path well.",
        "Record a longer step of its input, until the deformation has settled.",
    )
    ZERO_OUTSIDE = (
        "zero_outside",
        "A path has a zero outside the unit circle: its response starts the wrong way.",
        "Look at its step response; if the machine does not start the wrong way, try a lower --order.",
    )
    TURNING_RESPONSE = (
        "turning_response",
        "The step response of a path reverses before it settles.",
        "Check whether the machine does that; if not, try a lower --order.",
    )
    TWIN_MODES = (
        "twin_modes",
        "Two time constants of a path coincide: their standard errors mean nothing.",
        "Try one mode less with --order.",
    )
    INVERSE_NOISE = (
        "inverse_noise",
        "The noise of the thermocouples is strongly amplified in the heat estimate.",
        "Average more readings, or place T_Q closer to the source.",
    )
    COLOURED_RESIDUAL = (
        "coloured_residual",
        "The residual is not white noise: the model lacks something.",
        "Let compensator diagnose look for it.",
    )
    VALIDITY_RANGE = (
        "validity_range",
        "The model is valid for the measured temperatures plus a third of their range; outside, the service holds.",
        "Calibrate over the machine's whole working range if that is wider.",
    )
    MADE_WORSE = (
        "made_worse",
        "On held-out data the effects that were found increase the error, so the model was left unchanged.",
        "Record longer, with more change in the inputs.",
    )
    HARDLY_DETERMINED = (
        "hardly_determined",
        "The standard error of a parameter is larger than the parameter.",
        "Before relying on it, record more change of the input that drives the effect.",
    )
    NEARLY_AS_GOOD = (
        "nearly_as_good",
        "Another explanation leaves almost the same error.",
        "Run the experiment that is named with it: it tells them apart.",
    )
    ROUNDED_OFF = (
        "rounded_off",
        "A term without a name of its own is deployed together with the effect that was found.",
        "Check the extended model on another day before relying on it.",
    )
    FITTED_ANEW = (
        "fitted_anew",
        "The first model was calibrated while the effect acted, so its paths were fitted again together with it.",
        "Check the extended model on another day before relying on it.",
    )


class DataRemark(Code):
    """What was noticed in tables and recordings that are read as data."""

    ESTIMATES_LEFT_OUT = (
        "estimates_left_out",
        "The table is an exported recording; values that the service estimated or published are no measurements.",
        "Nothing; a measured heat is in heat_measured_w and is used.",
    )
    ROWS_SORTED = (
        "rows_sorted",
        "Rows of the table were out of order and have been sorted by time.",
        "Find out why the logger wrote them so: a clock that was set, or joined files.",
    )
    GAP_BRIDGED = (
        "gap_bridged",
        "Samples are missing; the gap is short compared with the machine's time constants and is interpolated.",
        "Nothing for one gap; check the logger if there are many.",
    )
    GAP_SPLITS = (
        "gap_splits",
        "Samples are missing; the gap is too long to interpolate and splits the record.",
        "Check the logger; use data without such gaps if the fit needs long records.",
    )
    TEMPERATURE_MISSING = (
        "temperature_missing",
        "T_Q or AT is missing for too long to interpolate: no model is fitted there, and predictions are less certain.",
        "Check the sensor and the logger.",
    )
    VARIABLES_LEFT_OUT = (
        "variables_left_out",
        "Variables of a MAT file that have not one value for each row, such as matrices, are not read.",
        "Nothing, unless they are needed: save each as a vector of the length of the time.",
    )
    WILD_READINGS = (
        "wild_readings",
        "Single readings far from their neighbours were left out.",
        "Check the sensor for loose contacts and noise.",
    )


class ServiceWarning(Code):
    """What check, run, probe and router warn of, in the terminal and the log."""

    NUMBERED_PORT = (
        "numbered_port",
        "The number of a serial port depends on the order of plugging in; after a restart it may be another adapter.",
        "Name the port by a link in /dev/serial/by-id, or by a udev rule.",
    )
    OPEN_LISTEN = (
        "open_listen",
        "Whoever reaches an endpoint of zenoh.listen can publish offsets and send commands in any name.",
        "Listen on loopback only; for others use a router with TLS and an access list (deploy/zenoh).",
    )
    UNSECURED_CONNECT = (
        "unsecured_connect",
        "The connection to the router is neither encrypted nor authenticated.",
        "Connect to tls/HOST:PORT with tls_ca, tls_certificate and tls_key (deploy/zenoh).",
    )
    UNPROVEN_COMMANDS = (
        "unproven_commands",
        "The service accepts commands whose sender is not authenticated.",
        "Leave zenoh.unproven_commands out, and give operators certificates (deploy/zenoh).",
    )
    NO_ACCESS_LIST = (
        "no_access_list",
        "The router has no access list: whoever connects may publish and command everything.",
        "Add the access list of deploy/zenoh/access_list.py to its configuration.",
    )
    CERTIFICATE_ENDS = (
        "certificate_ends",
        "A certificate expires within 30 days; after that the router refuses its owner.",
        "Renew it now (deploy/zenoh/certificates.py --renew), and restart what uses it.",
    )
    CERTIFICATES_UNREAD = (
        "certificates_unread",
        "Certificates are not checked, so an expired one is noticed only when the router refuses it.",
        "Install what reads them: pip install quill-compensator[tls].",
    )
    SERVICE_RUNS = (
        "service_runs",
        "The service is running and uses the devices; a second program may be refused or disturb its readings.",
        "Look at its readings with `compensator watch`, or stop it for the probe.",
    )
    ADOPTED_UNUSABLE = (
        "adopted_unusable",
        "The adopted model cannot be used; the service runs the configured one.",
        "Adopt it again from its file, or stay with the configured one: `compensator back`.",
    )
    NOT_LOCKED = (
        "not_locked",
        "The recording folder cannot be locked, so a second service of this machine is not noticed here.",
        "Check space and permissions of the recording folder.",
    )
    OTHERS_UNKNOWN = (
        "others_unknown",
        "No router is reached, so it is unknown whether another service of this machine runs elsewhere.",
        "Check that the router runs; the service asks at its start only.",
    )
    ROUTER_NOT_REACHED = (
        "router_not_reached",
        "There is no connection to the router yet; compensation and recording continue, and the service retries.",
        "Check that it runs at that address, and that it accepts this certificate.",
    )
    LINK_LOST = (
        "link_lost",
        "The connection to a router or another participant has ended; the service retries.",
        "Nothing, if it was ended on purpose or returns; otherwise check the router and the network.",
    )
    NOTE_NOT_KEPT = (
        "note_not_kept",
        "The last offset cannot be kept in memory while the disk is late; if the service is killed now, it is lost.",
        "Check free space and permissions of /dev/shm.",
    )
    NOTE_NOT_REMOVED = (
        "note_not_removed",
        "The last offset kept in memory cannot be removed although everything is on disk.",
        "Check the permissions of /dev/shm; the next start ignores it if its number is on disk.",
    )
    NOTE_REFUSED = (
        "note_refused",
        "The last offset found in /dev/shm was not written by this service; it is ignored.",
        "If others can log in to this computer, find out who wrote it.",
    )
    DISK_FINISHING = (
        "disk_finishing",
        "The service is stopping and waits for the disk to accept the rest of the recording.",
        "Wait; if it takes minutes, check the disk.",
    )


class BridgeTrouble(Code):
    """Why a bridge writes nothing."""

    PLC_NOT_REACHED = (
        "plc_not_reached",
        "The PLC's server cannot be reached or refuses access; the PLC keeps its value, and the bridge retries.",
        "Check the server, the network and the node's access rights.",
    )
    PLC_WRITTEN_OVER = (
        "plc_written_over",
        "The PLC holds another value than the bridge wrote, so something else writes there; the offset is held.",
        "Find out what writes there; once the value has stayed for resume_after_s the offset continues from it.",
    )
    PLC_BEYOND_LIMIT = (
        "plc_beyond_limit",
        "The PLC holds a value that no offset can have; the bridge does not overwrite it.",
        "Correct it in the PLC, to the value that the axis has now.",
    )


class WatchWarning(Code):
    """What watch shows and no service reports of itself."""

    SILENT = (
        "silent",
        "Nothing newer has arrived than an offset that has expired; the control holds.",
        "Check that service, router and network run; do not rely on compensation meanwhile.",
    )
    UNKNOWN = (
        "unknown",
        "Nothing was received that shows the state.",
        "Wait for one sample; then check that the service runs.",
    )
    TOKEN_GONE = (
        "token_gone",
        "The liveliness token of the service is gone: it has ended, or is cut off from the network.",
        "Check that service, router and network run.",
    )
    ALIVE_BUT_SILENT = (
        "alive_but_silent",
        "The service is connected (its liveliness token is there) but publishes nothing new.",
        "Check the log of the service, and whether it still polls; restart it if it hangs.",
    )
    TWO_SERVICES = "two_services", "Two services publish below one prefix.", "Stop one of them, or correct its prefix."
    MISFIT = (
        "misfit",
        "Measured and predicted Y differ by more than the service states: the model lacks something, or a sensor "
        "is wrong.",
        "Run `compensator diagnose` on the recordings; [plausibility] makes it an alarm of the service.",
    )
    CLOCK_AHEAD = (
        "clock_ahead",
        "The machine's clock is ahead of this computer's.",
        "Check the time service (NTP) of both computers.",
    )
    OLD_MESSAGES = (
        "old_messages",
        "Messages arrive with an old time: one of the two clocks is wrong, or they are replayed.",
        "Check the time service (NTP) of both computers, then who publishes below the prefix.",
    )
    MALFORMED_MESSAGES = (
        "malformed_messages",
        "Messages arrived that no service of ours sends.",
        "Find out who publishes below the prefix.",
    )
    MISSED_MESSAGES = (
        "missed_messages",
        "Messages of the service never arrived here.",
        "If it continues, check the network and the router.",
    )
    REPEATED_NUMBERS = (
        "repeated_numbers",
        "Messages arrived with a number that was used before.",
        "Find out whether messages are replayed, or a second service publishes below the prefix.",
    )


class AuditRemark(Code):
    """What an audit remarks on recordings that are in order."""

    NOT_WORKED_OUT = (
        "not_worked_out",
        "Not every sample could be recomputed from what the recording carries.",
        "Audit with the version that wrote it; the named part was not checked.",
    )
    SAMPLES_MISSING = (
        "samples_missing",
        "Samples between others were not recorded.",
        "Look at the events before and after them: pauses, the disk.",
    )
    PUBLISHED_EARLY = (
        "published_early",
        "Offsets were published before they were on disk, because the disk was slow or failed.",
        "Check the disk of the machine: its health, free space, other programs that write to it.",
    )
    UNSIGNED_BEHIND = (
        "unsigned_behind",
        "Records follow the last signature of the file, which does not cover them.",
        "Audit it again once the file is finished, or the next one is there.",
    )
    BEGINS_NEW_CHAIN = (
        "begins_new_chain",
        "The hash chain starts with this file: there was no recording before it when it was opened.",
        "Nothing, if the machine was newly installed; otherwise find the earlier recordings.",
    )
    BEFORE_NOT_GIVEN = (
        "before_not_given",
        "The recording before the first given file was not given; nothing is proven about it.",
        "Give it too, if it still exists.",
    )
    BEGINS_RUNNING = (
        "begins_running",
        "The comparison starts on a running machine, whose state the other model does not know beyond the zero.",
        "Ignore the first hours, or compare from a recording that starts at rest.",
    )
    SIGNATURE_NOT_CHECKED = (
        "signature_not_checked",
        "The file is signed, but no key was given to check the signature.",
        "Give the machine's key: --public-key FILE.",
    )
    LEFT_BEYOND_STATED = (
        "left_beyond_stated",
        "With the correction, Y still varies by more than the standard deviation that the service states.",
        "Check the probe and the thermocouples, then run `compensator diagnose` on these recordings.",
    )


class RecordingEnd(Code):
    """How a recording ends."""

    FINISHED = "finished", "The recording is complete: sealed, with checksums and index.", "Nothing."
    RECOVERED = (
        "recovered",
        "The service was killed; the next start kept every complete record and sealed the file.",
        "Nothing; find out why the machine or the service stopped.",
    )
    OPEN = (
        "open",
        "The recording has no end: it is still being written, or the service was killed.",
        "Audit it again once the next recording is there, which names its last value.",
    )
    TORN = (
        "torn",
        "The recording ends within a group of records: it is still being written, or the service was killed.",
        "Audit it again once the next recording is there, which names its last value.",
    )


class AuditFinding(Code):
    """What an audit finds wrong."""

    ALTERED = (
        "altered",
        "Something was changed after it was written.",
        "Find out who had access; use a copy from a backup.",
    )
    REMOVED = "removed", "Something that was written is gone.", "Find out who had access; use a copy from a backup."
    INSERTED = (
        "inserted",
        "There is something that the service did not write there.",
        "Find out who had access to the file.",
    )
    REORDERED = (
        "reordered",
        "Something is in another place than where it was written.",
        "Check names and copies of the files.",
    )
    TRUNCATED = (
        "truncated",
        "The end of the recording was cut off.",
        "Find out who had access to it; use a copy from a backup.",
    )
    BROKEN = (
        "broken",
        "Two parts of the hash chain do not match: one of them was rewritten.",
        "Compare with a backup of both files; a signature would show which one is genuine.",
    )
    DAMAGED = (
        "damaged",
        "From some byte on the file is no recording, or a checksum is wrong.",
        "Check disk and copy; use a copy from a backup.",
    )
    MISSING_FILE = "missing_file", "A recording between two others is missing.", "Add it and audit again."
    UNSIGNED = "unsigned", "A required signature is missing.", "Check [recording] signing_key of the machine."
    FALSE_SIGNATURE = (
        "false_signature",
        "A signature was not made with the given key.",
        "Check that the key is this machine's; if it is, trust nothing in the file.",
    )
    STATE = (
        "state",
        "A recording starts with another state than the previous one ended with.",
        "Treat the offsets from there on as not proven, and report it.",
    )
    UNREADABLE = (
        "unreadable",
        "A record is intact but does not match its schema.",
        "Audit with the version that wrote it.",
    )
    INDEX = (
        "index",
        "The index of the recording does not lead to all its records: readers that seek would miss some.",
        "Find out who had access; the records are intact, so a copy made by reading all of it has a correct index.",
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


def explain(code: str) -> tuple[str, str] | None:
    """Return what a code means and what to do, or None if it is unknown.

    Examples
    --------
    >>> explain("ok")[1]
    'Nothing.'
    """
    return WORDS.get(code.partition(":")[0])
