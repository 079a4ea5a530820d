"""All codes, each with its meaning and the recommended action.

Each domain has its own enumeration, derived from `Code`. A member is a string: it compares, formats and encodes as
the code in messages, recordings and JSON. To add a code, add a member here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from enum import StrEnum
from types import MappingProxyType


class Code(StrEnum):
    """Base class of the enumerations; each member consists of a code, its meaning and an action.

    Attributes
    ----------
    meaning : str
        What the code means, one sentence.
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
        """Create a member from its code, meaning and action."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.meaning, member.action = meaning, action
        return member


class Remark(str):
    """A warning or remark as text (the observation with its figures, then the action), with its code.

    Parameters
    ----------
    code : Code
        The code, which `compensator explain` explains.
    figures : str
        The observation with its figures; the action of the code is appended.

    Examples
    --------
    >>> remark = Remark(ModelWarning.TWIN_MODES, "Two time constants of the DTF coincide at 20 min.")
    >>> remark
    'Two time constants of the DTF coincide at 20 min. Try one mode fewer with --order, of the TTF with --ttf.'
    >>> remark.code
    <ModelWarning.TWIN_MODES: 'twin_modes'>
    """

    __slots__ = ("code",)
    code: Code

    def __new__(cls, code: Code, figures: str) -> Remark:
        """Append the action of the code to the figures."""
        remark = super().__new__(cls, f"{figures} {code.action}")
        remark.code = code
        return remark

    def __reduce__(self) -> tuple[Callable[[Code, str], Remark], tuple[Code, str]]:
        return _restored, (self.code, str(self))

    def worded(self, words: str) -> Remark:
        """Return the remark in other words, with the same code."""
        return _restored(self.code, words)

    @property
    def marked(self) -> str:
        """The remark followed by its code, for a terminal or a log."""
        return f"{self} [{self.code}]"


def _restored(code: Code, words: str) -> Remark:
    """Rebuild a remark that was pickled or copied."""
    remark = str.__new__(Remark, words)
    remark.code = code
    return remark


class State(Code):
    """State of the service: how reliable the published offset is."""

    STARTING = (
        "starting",
        "The service is running but has no zero yet, so there is no offset.",
        "Wait for the first good sample of T_Q and AT; if none comes, run `compensator probe`.",
    )
    OK = "ok", "Everything is measured and the offset follows the model.", "Nothing."
    DEGRADED = (
        "degraded",
        "The service compensates with a restriction, which the reasons name.",
        "See the reasons.",
    )
    HOLD = (
        "hold",
        "The offset is frozen at its last good value and does not follow the machine.",
        "See the reasons; correct the cause before the next precise cut.",
    )
    FAULT = "fault", "There is no reliable offset.", "Do not rely on compensation; see the reasons and the events."


#: From the best to the worst.
_STATES = (State.OK, State.DEGRADED, State.STARTING, State.HOLD, State.FAULT)


def worst_state(states: Iterable[State]) -> State:
    """Return the worst of several states, such as those of several axes."""
    return max(states, key=_STATES.index)


class Reason(Code):
    """Why the state is not `ok`; some reasons are followed by a colon and a channel."""

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
        "A channel used by an effect of the model is missing; its last good value is used instead.",
        "Check the sensor of that channel.",
    )
    PREDICTING = (
        "predicting",
        "A temperature is missing; the model predicts with the last known heat.",
        "Restore the sensor within loss.predict_for_min; after that the offset is held.",
    )
    PREDICTION_EXPIRED = (
        "prediction_expired",
        "A temperature has been missing for longer than loss.predict_for_min, so the offset is held.",
        "Repair the sensor; the offset then moves to its correct value at the permitted rate.",
    )
    SUSPECT_CHANNEL = (
        "suspect_channel",
        "A channel has jumped; it is not used until it returns, or the model or measured Y confirms its new value.",
        "Check that sensor and its plug; if it is right, send resume; if it was replaced, send zero.",
    )
    UNCONFIRMED_CHANNEL = (
        "unconfirmed_channel",
        "A channel reads otherwise than expected: heat, air or its zero has changed; it is used.",
        "If nothing was done at that sensor, send resume; else send zero with the machine at rest.",
    )
    OUTSIDE_VALIDITY = (
        "outside_validity",
        "T_Q, AT or the heat is outside the range of validity.",
        "Calibrate over a wider range, or bring the machine back into the range.",
    )
    OFFSET_LIMITED = (
        "offset_limited",
        "The offset has reached its limit, limits.offset_max_um.",
        "Check sensors and model before raising limits.offset_max_um.",
    )
    RATE_LIMITED = (
        "rate_limited",
        "The offset is changing at the maximum permitted rate and has not reached its target yet.",
        "Wait; if it persists, check sensors and limits.offset_rate_max_um_per_min.",
    )
    MODEL_CHANGED = (
        "model_changed",
        "Another model was adopted; the offset is still moving to its new value at the permitted rate.",
        "Wait until the offset has reached it; `compensator back` returns to the previous model.",
    )
    COLD_START = (
        "cold_start",
        "The heat stored in the machine was unknown at the start, so the model started from the measured temperatures.",
        "Allow for the larger standard deviation, or let the machine come to rest and send the command zero.",
    )
    T_Q_AT_EXCHANGED = (
        "t_q_at_exchanged",
        "T_Q has been below AT for too long: the two sensors are exchanged, or a thermocouple has come off.",
        "Check wires, terminals and addresses of both; then send the command zero with the machine at rest, or resume.",
    )
    T_Q_AT_APART = (
        "t_q_at_apart",
        "At rest, the difference T_Q − AT did not return to its value at the zero.",
        "Compare both thermocouples; if both are good, send the command zero at rest.",
    )
    IMPLAUSIBLE = (
        "implausible",
        "Measured and predicted Y diverge; the code ends with the most likely cause, a sensor or the model.",
        "Check that sensor, its wiring and its mounting; for the model, run `compensator diagnose` on the recordings.",
    )
    RESIDUAL_TOO_LARGE = (
        "residual_too_large",
        "Measured and predicted Y differ by more than plausibility.residual_hold_um.",
        "Check the sensor named in the reasons; then send the command zero at rest.",
    )
    OPERATOR_HOLD = "operator_hold", "An operator has frozen the offset.", "Send the command resume."
    RECORDING_FAILED = (
        "recording_failed",
        "The sample could not be written to disk and is queued; compensation continues.",
        "Check free space, permissions and the disk.",
    )
    RECORDING_LATE = (
        "recording_late",
        "The disk is slow: the offset was published before its sample was on disk; the sample is written later.",
        "Check the disk: its health, other programs that write to it, a network share.",
    )
    CORRECTION_LIMITED = (
        "correction_limited",
        "The correction that the probes ask for has reached its limit, probe.largest_um; the rest is not applied.",
        "Check probe, feature and sign; if they are right, run `compensator diagnose`: the model lacks something.",
    )
    INTERNAL_ERROR = (
        "internal_error",
        "An internal error occurred in the service; the offset is held.",
        "Report the error with the text of its event.",
    )


#: Reasons with a suffix after a colon, and the suffixes; none are listed where it is the name of any channel.
SUFFIXES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        Reason.CHANNEL_MISSING: (),
        Reason.SUSPECT_CHANNEL: ("t_q_degc", "at_degc"),
        Reason.UNCONFIRMED_CHANNEL: ("t_q_degc", "at_degc"),
        Reason.OUTSIDE_VALIDITY: ("t_q_degc", "at_degc", "heat_w"),
        Reason.IMPLAUSIBLE: ("t_q_degc", "at_degc", "y_um", "model"),
    }
)


class ProbeCode(Code):
    """Why a probe is refused, a remark on one that is taken, and why another one is wanted."""

    MALFORMED = (
        "probe_malformed",
        "The payload of the command is not a probe.",
        "Compare it with the command in deploy/OPERATING.md; the reply names key and value.",
    )
    NOT_CONFIGURED = (
        "probe_not_configured",
        "The configuration has no table [probe], so probes are not used.",
        "Add [probe] to the configuration (deploy/CONFIGURATION.md).",
    )
    TOO_MANY = (
        "probe_too_many",
        "More probes arrived between two samples than a machine can measure.",
        "Find the program that sends them; a probe is sent once.",
    )
    AXIS = "probe_axis", "The probe is of another axis than Y.", "Send probes of Y only."
    OUT_OF_BOUNDS = (
        "probe_out_of_bounds",
        "The measured value, its standard deviation or the applied offset is outside what is possible.",
        "Check unit, sign, feature and tool length; then probe again.",
    )
    FUTURE = (
        "probe_future",
        "The time of the probe is in the future.",
        "Check the time service (NTP) of the control and of this computer.",
    )
    TOO_OLD = (
        "probe_too_old",
        "The probe arrived later than probe.oldest_min, or is older than the 300 samples that are kept.",
        "Send probes at once; check the clocks of the control and of this computer.",
    )
    DUPLICATE = ("probe_duplicate", "The same probe was received before.", "Nothing, if it was sent again on purpose.")
    BEFORE_ZERO = (
        "probe_before_zero",
        "The probe was measured before the last zero, so it belongs to another reference.",
        "Probe again.",
    )
    NO_OFFSET = (
        "probe_no_offset",
        "No offset had been published at the time of the probe.",
        "Wait for the first zero; then probe again.",
    )
    TIME_UNKNOWN = (
        "probe_time_unknown",
        "The service has no prediction for the time of the probe: it was not running, samples are missing, or the "
        "clock was set.",
        "Probe again.",
    )
    DURING_HOLD = (
        "probe_during_hold",
        "The offset was held at the time of the probe: nothing is corrected by it, but it speaks for or against a "
        "suspect T_Q or AT.",
        "Correct the cause of the hold; then probe again. If a channel is suspect that is right, two probes show it.",
    )
    MISMATCH = (
        "probe_mismatch",
        "The control had applied another offset at the time of the probe than was published.",
        "Check that the control follows the offset, its sign and its unit, and the clocks.",
    )
    TOO_MANY_FEATURES = (
        "probe_features",
        "There are probes of more features than the service distinguishes.",
        "Use few features, always with the same names; a zero forgets them.",
    )
    OUTLIER = (
        "probe_outlier",
        "The probe does not fit the prediction: a chip, or another feature.",
        "Clean the feature and probe again; if the value is right, two more probes that agree confirm it.",
    )
    BELIEVED = (
        "probe_believed",
        "The probe contradicts earlier ones and is used: refused ones agree with it, or the last one used was wrong.",
        "Find out what moved: a clamping, a collision, the model (`compensator diagnose`).",
    )
    FIRST = (
        "probe_first",
        "No probe has been taken since the zero, so nothing shows how far the model is off.",
        "Probe once before the next tight feature.",
    )
    DOUBTED = (
        "probe_doubted",
        "A probe that is used may be wrong: until another probe confirms or refutes it, only part of it is applied.",
        "Clean the feature and probe again.",
    )
    DEVIATION = (
        "probe_deviation",
        "The standard deviation exceeds the tolerance, probe.tolerance_um.",
        "Probe before the next tight feature; other features need none.",
    )


class SampleQuality(Code):
    """Quality of a channel's value in a sample, from the device, its errors or the checks of the service."""

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
    STALE = "stale", "The device delivers no new values.", "Check device and connection."
    INVALID = "invalid", "The device marks the value as invalid.", "Check the device."
    TOO_FEW = "too_few", "The sample has too few good readings.", "See the channel's errors: line, module, noise."
    OUTLIER = (
        "outlier",
        "Single readings far from the others of their sample were left out.",
        "Nothing if this is rare; if it is frequent, check the line for noise.",
    )
    OUT_OF_RANGE = "out_of_range", "The value is outside the channel's plausible range.", "Check sensor and range."
    TOO_FAST = (
        "too_fast",
        "The value changed faster than rate_max_per_min of the channel.",
        "Check for a loose sensor or a noisy line.",
    )
    SUSPECT = (
        "suspect",
        "The channel has jumped, and nothing confirms its new value yet.",
        "Check for a loose sensor, an exchanged plug or a couple that was replaced.",
    )
    STUCK = "stuck", "The value has not changed for too long.", "Check that the sensor and its module work."
    T_Q_BELOW_AT = (
        "t_q_below_at",
        "T_Q is below AT although the machine is heated.",
        "Check whether the sensors are exchanged or one has come off.",
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
        "The device's reply was not a valid frame.",
        "Check line settings, termination and shielding.",
    )
    DEVICE_ERROR = "device_error", "The device could not be read.", "See the message in the events."
    DEVICE_CONFIG = (
        "device_config",
        "The configuration of the device cannot be used.",
        "Run `compensator check`.",
    )


class ModelWarning(Code):
    """Warnings of identification and diagnosis."""

    WORSE_THAN_NOTHING = (
        "worse_than_nothing",
        "On a run that was not used for the fit, the model is worse than no model.",
        "Do not use it there; find out how that run differs from the fitted runs, and fit them together.",
    )
    QUIET_AMBIENT = (
        "quiet_ambient",
        "The ambient temperature changed too little to determine the TDTF's gain beyond this range.",
        "Add a record with a larger ambient change (an ETVE over a day).",
    )
    UNDETERMINED_AMBIENT = (
        "undetermined_ambient",
        "The ambient temperature changed, but the data do not determine its effect well.",
        "Add a record in which the ambient temperature changes while the heat is steady.",
    )
    SHORT_RECORD = (
        "short_record",
        "The record is short compared with the slowest time constant: the steady state is extrapolated.",
        "Record at least three times the slowest time constant.",
    )
    DRIFTING_MODE = (
        "drifting_mode",
        "The slowest mode is slower than the record: there is a drift that the inputs do not explain.",
        "Record for longer, and run `compensator diagnose` to find the cause of the drift.",
    )
    COMMON_CAUSE = (
        "common_cause",
        "The heat and the ambient temperature changed together: the data do not separate the DTF from the TDTF.",
        "Add a record that is heated at another time of day.",
    )
    UNDETERMINED_GAIN = (
        "undetermined_gain",
        "The data do not determine the static gain of a path well.",
        "Record a longer step of its input, until the deformation has settled.",
    )
    ZERO_OUTSIDE = (
        "zero_outside",
        "A path has a zero outside the unit circle: its response starts in the wrong direction.",
        "Check its step response; if the machine does not respond like this, try a lower --order.",
    )
    TURNING_RESPONSE = (
        "turning_response",
        "The step response of a path reverses before it settles.",
        "Check its step response; if the machine does not respond like this, try a lower --order.",
    )
    TWIN_MODES = (
        "twin_modes",
        "Two time constants of a path coincide: their standard errors are meaningless.",
        "Try one mode fewer with --order, of the TTF with --ttf.",
    )
    INVERSE_NOISE = (
        "inverse_noise",
        "The noise of the thermocouples is strongly amplified in the heat estimate.",
        "Average more readings, or place T_Q closer to the source.",
    )
    COLOURED_RESIDUAL = (
        "coloured_residual",
        "The residual is not white noise: the model is incomplete.",
        "Run `compensator diagnose` to find what is missing.",
    )
    VALIDITY_RANGE = (
        "validity_range",
        "The model is valid for the measured temperatures plus a third of their range; outside, the offset is held.",
        "Calibrate over the machine's whole working range if that is wider.",
    )
    MADE_WORSE = (
        "made_worse",
        "The effects that were found increase the error on held-out data, so the model was left unchanged.",
        "Record for longer, with more change in the inputs.",
    )
    WORSE_IN_FREE_RUN = (
        "worse_in_free_run",
        "What would be deployed increases the error of its own data in free run, so the model was left unchanged.",
        "Record a run that begins at rest, with more change in the inputs.",
    )
    TOO_SHORT = (
        "too_short",
        "The record is too short to extend the model by something that explains it only in part.",
        "Record for 8 h or more: a day, with heating and cooling.",
    )
    BEGAN_WITHIN = (
        "began_within",
        "An effect began within the data, so it was looked for in measured Y since then.",
        "Find out what was changed on the machine at that time.",
    )
    NOT_CONFIRMED = (
        "not_confirmed",
        "What was found is clear in all data together, but a search without a block of time does not predict it.",
        "Check the extended model on another day: something in the data happened only once.",
    )
    PATH_REVERSED = (
        "path_reversed",
        "Measured Y moves against a path of the model; the effect that would reverse the path is not deployed.",
        "Check the sign of measured Y, and that the model is one of this machine.",
    )
    HARDLY_DETERMINED = (
        "hardly_determined",
        "The standard error of a parameter is larger than the parameter.",
        "Before relying on it, record data in which the input of the effect changes more.",
    )
    WARM_START = (
        "warm_start",
        "The record begins on a machine that is not at rest, and an effect depends on how warm the machine is.",
        "Confirm the effect with a record that begins at rest, and set the zero of the service at rest.",
    )
    NEARLY_AS_GOOD = (
        "nearly_as_good",
        "Another effect explains the residual almost as well.",
        "Run the experiment given with it, which distinguishes the two.",
    )
    FITTED_ANEW = (
        "fitted_anew",
        "The base model was calibrated while the effect acted, so its paths were refitted together with the effect.",
        "Check the extended model on another day before relying on it.",
    )
    PATHS_KEPT = (
        "paths_kept",
        "The base model misses much of its own calibration, and its paths were kept as they are.",
        "Calibrate it anew, or record for longer (--keep-paths keeps them in any case).",
    )
    DEVIATION_CONTRADICTED = (
        "deviation_contradicted",
        "The model states a smaller standard deviation of its own error than the data show.",
        "Find out what differs from the calibration; a new calibration states the deviation of its own data.",
    )
    CEILING_IN_PART = (
        "ceiling_in_part",
        "There are more channels than the ceiling and the remainder can have, so some are not in them.",
        "Leave out of the data the channels that cannot act on Y.",
    )


class DataRemark(Code):
    """Remarks on tables and recordings that are read as data."""

    ESTIMATES_LEFT_OUT = (
        "estimates_left_out",
        "The table is an exported recording; values that the service estimated or published are not measurements.",
        "Nothing; measured heat is read from heat_measured_w.",
    )
    MARKED_BAD = (
        "marked_bad",
        "Values are marked bad in the column <channel>_quality of the table and are not used.",
        "See the meaning of the mark; check the sensor.",
    )
    COLUMN_LEFT_OUT = (
        "column_left_out",
        "Many cells of a column are words, so it is taken as a column of words and left out.",
        "If it is a channel, leave the cells empty where its value is missing.",
    )
    COLUMN_UNNAMED = (
        "column_unnamed",
        "A column has no name, or one with characters that no message can show, and is left out.",
        "If it is a channel, name it in the header; of an index that pandas writes: to_csv(FILE, index=False).",
    )
    ROWS_SORTED = (
        "rows_sorted",
        "Rows of the table were out of order and have been sorted by time.",
        "Find out why the logger wrote them in this order: a clock that was set, or joined files.",
    )
    TIMES_EQUAL = (
        "times_equal",
        "Rows of the table have the time of another row; they are averaged like all rows of a sample.",
        "Find out why the logger wrote a time twice: joined files, a clock that stood still, or too few digits.",
    )
    GAP_BRIDGED = (
        "gap_bridged",
        "Samples are missing; the gap is short compared with the machine's time constants and is interpolated.",
        "Nothing for a single gap; check the logger if there are many.",
    )
    ROWS_APART = (
        "rows_apart",
        "Rows are further apart than the model's samples; the samples between them are interpolated.",
        "Log a row for each sample: what comes and goes between two rows is not seen.",
    )
    GAP_SPLITS = (
        "gap_splits",
        "Samples are missing; the gap is too long to interpolate and splits the record.",
        "Check the logger; use data without such gaps if the fit needs long records.",
    )
    TEMPERATURE_MISSING = (
        "temperature_missing",
        "T_Q or AT is missing for too long to interpolate; the record is split there, as where rows are missing. For a "
        "diagnosis it goes on as long as Y is measured: about one zero, from a state that is not known.",
        "Check the sensor and the logger.",
    )
    TEMPERATURE_SPARSE = (
        "temperature_sparse",
        "T_Q or AT is empty in many rows; a sample is the mean of the others, or interpolated between its neighbours.",
        "Check the sensor and the logger; a column that is logged less often than the others is in order.",
    )
    FEATURES_LEFT_OUT = (
        "features_left_out",
        "Probes of several features are in a recording; each has a zero of its own, so only one of them is used.",
        "Probe one feature in a calibration.",
    )
    ZEROS_LEFT_OUT = (
        "zeros_left_out",
        "A zero was set between probes; from there a feature counts anew, so only those about one zero are used; by a "
        "diagnosis all but those that are alone about theirs.",
        "To identify a model, export the recordings of each zero to a table of their own: each table has a zero of its "
        "own. For a diagnosis, probe at least twice about each zero.",
    )
    SEVERAL_ZEROS = (
        "several_zeros",
        "A zero was set between probes; from there a feature counts anew. A diagnosis uses the probes about each zero, "
        "in its curves set to one level; errors in free run are those about the zero with most of them.",
        "Nothing.",
    )
    VARIABLES_LEFT_OUT = (
        "variables_left_out",
        "Variables of a MAT file that do not have one value per row, such as matrices, are not read.",
        "If they are needed, save each as a vector with one value per row.",
    )
    WILD_READINGS = (
        "wild_readings",
        "Single readings far from their neighbours were left out.",
        "Check the sensor for loose contacts and noise.",
    )
    AT_LIMIT = (
        "at_limit",
        "A channel stands at exactly its largest or smallest value, and comes and leaves steeply: the end of a range.",
        "Widen the range of the sensor, its transmitter or the logger, and record again.",
    )
    UNIT_CHANGES = (
        "unit_changes",
        "A temperature jumps by what lies between two units, such as °C and °F, and goes on from there.",
        "Find out when the logger's unit was changed, and write the whole column in °C.",
    )
    COLUMN_EMPTY = (
        "column_empty",
        "A column has no value in any row.",
        "Check the sensor and the logger, or leave the column out.",
    )
    COLUMN_MISSING = (
        "column_missing",
        "A column has no value for longer than may be interpolated, so nothing is looked for in it.",
        "Diagnose the rows that have it: those since the sensor was added, or those before it failed.",
    )
    COLUMN_COPY = (
        "column_copy",
        "A channel has the values of another one in every row; only the first of them is searched.",
        "Give each sensor a column of its own; of two switches that always act together, no data can tell which acts.",
    )
    COLUMN_COUNTS = (
        "column_counts",
        "A channel takes many values, rises steadily and never falls: it is taken for a count, and left out.",
        "If what it counts may act, log its rate: a speed, a power, parts an hour.",
    )
    FOLLOWS_Y = (
        "follows_y",
        "A channel follows Y without delay, noise included, as no temperature can: it measures Y and is no cause.",
        "Nothing. If it is a displacement, let its name end in _um.",
    )
    PROBES_LEFT_OUT = (
        "probes_left_out",
        "Refused probes state that no offset was applied; other probes of the recording show that one was.",
        "Have the control send the offset that it had applied with each probe.",
    )
    Y_LEFT_OUT = (
        "y_left_out",
        "Measured values of Y do not agree with the other values and are left out.",
        "Check these measurements: a chip on the feature, or another feature.",
    )
    Y_REFUSED = (
        "y_refused",
        "Measured values of Y are further from the prediction than their noise allows, so they do not correct it.",
        "Check these measurements: a chip on the feature, or another feature.",
    )
    Y_BELIEVED = (
        "y_believed",
        "Measured values of Y were far from the prediction and agreed with each other; the prediction follows them.",
        "Find out what moved: a collision, a new clamping, or another feature.",
    )
    NOT_VALIDATED = (
        "not_validated",
        "The validation data lack a channel of the extended model; only the base model was validated on them.",
        "Validate on data with this channel.",
    )


class ServiceWarning(Code):
    """Warnings of check, run, probe and router, in the terminal and the log."""

    NUMBERED_PORT = (
        "numbered_port",
        "Serial ports are numbered in the order of connection; after a restart the name may be another adapter's.",
        "Name the port by a link in /dev/serial/by-id, or by a udev rule.",
    )
    OPEN_LISTEN = (
        "open_listen",
        "Any program that reaches an endpoint of zenoh.listen can publish offsets and send commands under any name.",
        "Listen on loopback only; for other computers use a router with TLS and an access list (deploy/zenoh).",
    )
    UNSECURED_CONNECT = (
        "unsecured_connect",
        "The connection to the router is neither encrypted nor authenticated.",
        "Connect to tls/HOST:PORT with tls_ca, tls_certificate and tls_key (deploy/zenoh).",
    )
    UNPROVEN_COMMANDS = (
        "unproven_commands",
        "The service accepts commands whose sender is not authenticated.",
        "Remove zenoh.unproven_commands, and give operators certificates (deploy/zenoh).",
    )
    NO_ACCESS_LIST = (
        "no_access_list",
        "The router has no access list: every client may publish messages and send commands for every machine.",
        "Add the access list of deploy/zenoh/access_list.py to its configuration.",
    )
    CERTIFICATE_ENDS = (
        "certificate_ends",
        "A certificate expires within 30 days; after that the router refuses connections with it.",
        "Renew it now (deploy/zenoh/certificates.py --renew), and restart the programs that use it.",
    )
    CERTIFICATES_UNREAD = (
        "certificates_unread",
        "Certificates are not checked, so an expired one is noticed only when the router refuses it.",
        "Install the extra that reads them: pip install quill-compensator[tls].",
    )
    LOOP_WITHOUT_CHECK = (
        "loop_without_check",
        "Measured and predicted Y are not compared sample by sample, so nothing but the clock begins a diagnosis.",
        "Set plausibility.false_alarm_days, such as 30: what has begun or ended is then answered sooner.",
    )
    PROBE_TOLERANCE = (
        "probe_tolerance",
        "The tolerance for probes is smaller than the standard deviation of one of them: one is wanted nearly always.",
        "Raise probe.tolerance_um, or lower probe.std_um if ten probes of one feature scatter less.",
    )
    PROBE_BOUNDS = (
        "probe_bounds",
        "Probes that show the largest permitted correction are refused: probe.measured_max_um is below it.",
        "Set probe.measured_max_um to about three times probe.largest_um.",
    )
    PROBE_OLDEST = (
        "probe_oldest",
        "A probe may be less old than probe.oldest_min says: only the last 300 samples are kept.",
        "Set probe.oldest_min to what the samples cover, and send probes at once.",
    )
    HEAD_NOT_WRITABLE = (
        "head_not_writable",
        "The head of the chain cannot be written by this user: after a kill, the end of a recording stays unsigned.",
        "Give the service's user a folder of its own for [recording] head, or run check as that user.",
    )
    SERVICE_RUNS = (
        "service_runs",
        "The service is running and uses the devices; a second program may be refused or disturb its readings.",
        "View its readings with `compensator watch`, or stop the service before probing.",
    )
    ADOPTED_UNUSABLE = (
        "adopted_unusable",
        "The adopted model cannot be used; the service runs the configured one.",
        "Adopt it again from its file, or keep the configured one with `compensator back`.",
    )
    NOT_LOCKED = (
        "not_locked",
        "The recording folder cannot be locked, so a second service for this machine would not be detected here.",
        "Check the free space and permissions of the recording folder.",
    )
    OTHERS_UNKNOWN = (
        "others_unknown",
        "No router is reached, so a second service for this machine on another computer would not be detected.",
        "Check that the router is running; the service checks for other services at its start only.",
    )
    ROUTER_NOT_REACHED = (
        "router_not_reached",
        "There is no connection to the router yet; compensation and recording continue, and the service retries.",
        "Check that the router is running at that address and accepts this certificate.",
    )
    LINK_LOST = (
        "link_lost",
        "The connection to a router or another participant has ended; the service retries.",
        "Nothing if it was closed on purpose or returns; otherwise check the router and the network.",
    )
    CHECKPOINT_NOT_KEPT = (
        "note_not_kept",
        "The last offset cannot be kept in memory while the disk is slow; if the service is killed now, it is lost.",
        "Check free space and permissions of /dev/shm.",
    )
    CHECKPOINT_NOT_REMOVED = (
        "note_not_removed",
        "The last offset kept in memory cannot be removed although everything is on disk.",
        "Check the permissions of /dev/shm; the next start ignores this offset if its sample is on disk.",
    )
    CHECKPOINT_REFUSED = (
        "note_refused",
        "The last offset found in /dev/shm was not written by this service; it is ignored.",
        "If other users can log in to this computer, find out who wrote it.",
    )
    DISK_FINISHING = (
        "disk_finishing",
        "The service is stopping and is still writing the rest of the recording to disk.",
        "Wait; if it takes minutes, check the disk.",
    )


class BridgeTrouble(Code):
    """Why a bridge does not write."""

    PLC_NOT_REACHED = (
        "plc_not_reached",
        "The PLC's server cannot be reached or refuses access; the PLC keeps its value, and the bridge retries.",
        "Check the server, the network and the node's access rights.",
    )
    PLC_WRITTEN_OVER = (
        "plc_written_over",
        "The PLC's value is not the one that the bridge wrote, so another program writes it; the offset is held.",
        "Find that program; once the value has not changed for resume_after_s, the offset continues from it.",
    )
    PLC_BEYOND_LIMIT = (
        "plc_beyond_limit",
        "The PLC's value is not a possible offset; the bridge does not overwrite it.",
        "Correct it in the PLC, to the offset that the axis has now.",
    )


class ProbeSourceRemark(Code):
    """Why a measured value of a touch probe is not sent to the service, and troubles of its sources."""

    SOURCE_LOST = (
        "source_lost",
        "A source of probes cannot be reached or read; the bridge retries.",
        "Check the cable, the network, the port and the rights of the file or folder.",
    )
    LINE_BROKEN = (
        "line_broken",
        "A line does not have the agreed form, so nothing of it is used.",
        "Probe again. If it happens often: check baud rate, parity, cable and macro.",
    )
    ROW_BROKEN = (
        "row_broken",
        "The header or a line of a CSV file does not have the agreed form, so it is not used.",
        "Correct the program that writes the file: a header row with the columns' names first, comma, dot, UTF-8.",
    )
    NO_FEATURE = (
        "no_feature",
        "A probe has no feature: each feature has its own zero, so a value without one cannot be used.",
        "Give the feature a name, always the same: in the line or, for one feature alone, in the settings.",
    )
    NO_OFFSET_SOURCE = (
        "no_offset_source",
        "For this source the offset at the time of the touch is unknown, unless each line states it.",
        "Set applied_file for the receiver and for the bridge, or let each line have the offset.",
    )
    LINE_INCOMPLETE = (
        "line_incomplete",
        "The last line of a file has no line end, so it may be half a line; it is not sent.",
        "Let the program that writes the file end each line.",
    )
    LINE_CHANGED = (
        "line_changed",
        "A probe that was handled before is now in the file with another value; the first one stands.",
        "Append new lines instead of changing old ones.",
    )
    LINE_AGE_UNKNOWN = (
        "line_age_unknown",
        "A line was delayed by an unknown time before it was read, so the time of the measurement is unknown.",
        "Probe again while the bridge is connected.",
    )
    LINE_CLOCK_DISAGREES = (
        "line_clock_disagrees",
        "The time in the line is not the time at which it arrived: it is late, or the control's clock is wrong.",
        "Set the control's clock and the key `zone`; probe again.",
    )
    LINE_AHEAD = (
        "line_ahead",
        "A line of a CSV file has a time that this computer's clock has not reached yet; it is sent once the clock has "
        "been set forward, and not if that time just passes: then it was the line's clock that was wrong.",
        "Nothing if this computer has just started; else check the time service (NTP) of whoever wrote it and of this "
        "computer, and the time zone of the lines; probe again.",
    )
    LINE_OFFSET_UNKNOWN = (
        "line_offset_unknown",
        "The offset that acted at the touch is neither in the line nor in the receiver's record.",
        "Let the macro print it, or set applied_file for the receiver and for the bridge.",
    )
    PROBE_NOT_SENT = (
        "probe_not_sent",
        "A probe did not reach the service in time and was given up; it was not sent with another time.",
        "Check the service, the router and the certificate; probe again.",
    )


class WatchWarning(Code):
    """Conditions that watch detects and a service cannot report about itself."""

    SILENT = (
        "silent",
        "The last offset received has expired; the control holds its offset.",
        "Check the service, the router and the network; until then, do not rely on compensation.",
    )
    UNKNOWN = (
        "unknown",
        "No message that shows the state has been received.",
        "Wait for one sample; then check that the service is running.",
    )
    TOKEN_GONE = (
        "token_gone",
        "The liveliness token of the service is gone: the service has ended, or is disconnected from the network.",
        "Check the service, the router and the network.",
    )
    ALIVE_BUT_SILENT = (
        "alive_but_silent",
        "The service is connected (its liveliness token is present) but publishes nothing new.",
        "Check the log of the service and whether it still polls; restart it if it hangs.",
    )
    TWO_SERVICES = "two_services", "Two services publish below the same prefix.", "Stop one, or correct its prefix."
    AXIS_MISSING = (
        "axis_missing",
        "Of a machine of several axes, an axis has no offset of the newest sample here, so its state is unknown.",
        "Check the network, and what the access list permits to read, before the next precise cut.",
    )
    MISFIT = (
        "misfit",
        "Measured and predicted Y differ by much more than the standard deviation that the service states: the model "
        "is incomplete, or a sensor is faulty.",
        "Run `compensator diagnose` on the recordings; with [plausibility] the service itself raises an alarm.",
    )
    CLOCK_AHEAD = (
        "clock_ahead",
        "The machine's clock is ahead of this computer's.",
        "Check the time service (NTP) of both computers.",
    )
    OLD_MESSAGES = (
        "old_messages",
        "Messages arrive with old times: one of the two clocks is wrong, or the messages are replayed.",
        "Check the time service (NTP) of both computers, then which programs publish below the prefix.",
    )
    MALFORMED_MESSAGES = (
        "malformed_messages",
        "Messages arrived that the service cannot have sent.",
        "Find out which programs publish below the prefix.",
    )
    MISSED_MESSAGES = (
        "missed_messages",
        "Messages of the service did not arrive here.",
        "If it continues, check the network and the router.",
    )
    REPEATED_NUMBERS = (
        "repeated_numbers",
        "Messages arrived with a number that was used before.",
        "Find out whether messages are replayed, or a second service publishes below the prefix.",
    )


class AuditRemark(Code):
    """Remarks of an audit on recordings that are in order, and of a comparison of models on recordings."""

    NOT_REPLAYED = (
        "not_worked_out",
        "Not every sample could be recomputed from the contents of the recording.",
        "Audit with the version that wrote it; the named part was not checked.",
    )
    SAMPLES_MISSING = (
        "samples_missing",
        "Samples between others were not recorded.",
        "See the events before and after them: pauses, the disk.",
    )
    PUBLISHED_EARLY = (
        "published_early",
        "Offsets were published before they were on disk, because the disk was slow or failed.",
        "Check the disk of the machine: its health, free space, other programs that write to it.",
    )
    UNSIGNED_BEHIND = (
        "unsigned_behind",
        "Records at the end of the newest file are not covered by a valid signature yet.",
        "Audit it again once the file is finished or the next one exists.",
    )
    OUTSIDE_CHAIN = (
        "outside_chain",
        "Bytes that carry no records differ from what the recorder writes; no record is affected.",
        "Find out which program has written the file again.",
    )
    BEGINS_NEW_CHAIN = (
        "begins_new_chain",
        "The hash chain starts with this file, which states that there was no record before; some may be missing.",
        "Nothing, if the machine was newly installed; otherwise find the earlier recordings.",
    )
    BEFORE_NOT_GIVEN = (
        "before_not_given",
        "The recording before the first file was not given, so nothing is proven about it.",
        "Give it as well, if it still exists.",
    )
    BEGINS_RUNNING = (
        "begins_running",
        "The comparison starts while the machine is running, and the other model has no state except the zero.",
        "Ignore the first hours, or compare from a recording that starts at rest.",
    )
    NOT_READ = (
        "not_read",
        "A recording is damaged or was cut off, so the figures are without the rest of it.",
        "Audit it without --model, and compare on a copy from a backup.",
    )
    SIGNATURE_NOT_CHECKED = (
        "signature_not_checked",
        "The file is signed, but no key was given to check the signature.",
        "Give the machine's key: --public-key FILE.",
    )
    LEFT_BEYOND_STATED = (
        "left_beyond_stated",
        "With the offset applied, Y still varies by more than the standard deviation that the service states.",
        "Check the probe and the thermocouples, then run `compensator diagnose` on these recordings.",
    )


class RecordingEnd(Code):
    """How a recording ends."""

    FINISHED = "finished", "The recording is complete: sealed, with checksums and index.", "Nothing."
    RECOVERED = (
        "recovered",
        "The file had no end, as after a kill or on a full disk: every complete record was kept and sealed later.",
        "Find out why the machine, the service or the disk stopped; the next recording has the events.",
    )
    OPEN = (
        "open",
        "The recording has no end: it is still being written, or as after a kill or on a full disk.",
        "Audit it again with the next recording, which contains the last value of its hash chain.",
    )
    TORN = (
        "torn",
        "The recording ends within a group of records: it is being written, or as after a kill or on a full disk.",
        "Audit it again with the next recording, which contains the last value of its hash chain.",
    )


class AuditFinding(Code):
    """Findings of an audit."""

    ALTERED = (
        "altered",
        "Data were changed after they were written.",
        "Find out who had access; use a copy from a backup.",
    )
    REMOVED = "removed", "Data that were written are missing.", "Find out who had access; use a copy from a backup."
    INSERTED = (
        "inserted",
        "There are data that the service did not write.",
        "Find out who had access to the file.",
    )
    REORDERED = (
        "reordered",
        "Data are not in the place where they were written.",
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
        "The file is not a valid recording from some byte on, or a checksum is wrong.",
        "Check disk and copy; use a copy from a backup.",
    )
    MISSING_FILE = "missing_file", "A recording between two others is missing.", "Add it, and audit again."
    UNSIGNED = (
        "unsigned",
        "Records are not covered by a valid signature: the service had no key, it was killed and had no head of the "
        "chain, or somebody has removed the signatures.",
        "Compare with the events and with a copy from a backup; check [recording] signing_key and head of the machine.",
    )
    FALSE_SIGNATURE = (
        "false_signature",
        "A signature was not made with the given key.",
        "Check that the key is this machine's; if it is, do not trust the file.",
    )
    STATE = (
        "state",
        "A recording does not start with the state at the end of the previous one.",
        "Treat the offsets from there on as not proven, and report it.",
    )
    EMPTY = (
        "empty",
        "No sample and no hash chain in any recording that was given: nothing is proven.",
        "Audit it together with the recordings before and after it; use a copy from a backup.",
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


#: All domains; each code occurs in only one of them.
DOMAINS: tuple[type[Code], ...] = (
    *(State, Reason, ProbeCode, SampleQuality, ModelWarning, ServiceWarning, BridgeTrouble, ProbeSourceRemark),
    *(DataRemark, WatchWarning, AuditRemark, RecordingEnd, AuditFinding),
)

#: code → (meaning, action)
WORDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {str(code): (code.meaning, code.action) for domain in DOMAINS for code in domain}
)


#: Code with its suffix → (meaning, action), where the suffix calls for words of its own.
SUFFIX_WORDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        f"{Reason.IMPLAUSIBLE}:t_q_degc": (
            "Measured and predicted Y diverge as they would if T_Q were wrong; the model, too, may lack something.",
            "Compare T_Q with a second thermometer at the same place; check couple, terminals and mounting. If it is "
            "right, run `compensator diagnose` on the recordings.",
        ),
        f"{Reason.IMPLAUSIBLE}:at_degc": (
            "Measured and predicted Y diverge as they would if AT were wrong; the model, too, may lack something.",
            "Compare AT with the air beside the machine; look for sun, draught or coolant mist on the sensor. If it is "
            "right, run `compensator diagnose` on the recordings.",
        ),
        f"{Reason.IMPLAUSIBLE}:y_um": (
            "Measured and predicted Y diverge as they would if the displacement sensor were wrong; the offset does not "
            "use it.",
            "Check the displacement sensor for chips, coolant and a loose mount; until then do not calibrate with it.",
        ),
        f"{Reason.IMPLAUSIBLE}:model": (
            "Measured and predicted Y diverge, and no sensor explains it: the model lacks an effect.",
            "With `[loop]` the service looks for it; else run `compensator diagnose` on the recordings, then "
            "`compensator adopt`.",
        ),
        f"{Reason.SUSPECT_CHANNEL}:t_q_degc": (
            "T_Q has jumped and is not used until it returns, or until the model or measured Y agrees with it.",
            "Check the couple of T_Q and its plug; if it is right, send resume; if it was replaced, send zero.",
        ),
        f"{Reason.SUSPECT_CHANNEL}:at_degc": (
            "AT has jumped and is not used until it returns, or until the model or measured Y agrees with it.",
            "Check the couple of AT and its plug; if it is right, send resume; if it was replaced, send zero.",
        ),
        f"{Reason.UNCONFIRMED_CHANNEL}:t_q_degc": (
            "T_Q reads otherwise than expected: heat or its zero has changed; it is used.",
            "If nothing was done at the couple of T_Q, send resume; else send zero with the machine at rest.",
        ),
        f"{Reason.UNCONFIRMED_CHANNEL}:at_degc": (
            "AT reads otherwise than expected: the air or its zero has changed; it is used.",
            "If nothing was done at the couple of AT, send resume; else send zero with the machine at rest.",
        ),
        f"{Reason.OUTSIDE_VALIDITY}:t_q_degc": (
            "T_Q is outside the range in which the machine was calibrated.",
            "Bring the machine back into the range, or calibrate over a wider one.",
        ),
        f"{Reason.OUTSIDE_VALIDITY}:at_degc": (
            "AT is outside the range in which the machine was calibrated.",
            "Bring the air of the shop back into the range, or calibrate over a wider one.",
        ),
        f"{Reason.OUTSIDE_VALIDITY}:heat_w": (
            "The heat is outside the range in which the machine was calibrated.",
            "Run slower, or calibrate at this speed and load.",
        ),
    }
)


def explained_by(code: str) -> str:
    """Return the code whose words explain another one: itself with its suffix where that has its own, or without it.

    Examples
    --------
    >>> explained_by("implausible:y_um"), explained_by("channel_missing:coolant_degc")
    ('implausible:y_um', 'channel_missing')
    """
    return code if code in SUFFIX_WORDS else code.partition(":")[0]


def explain(code: str) -> tuple[str, str] | None:
    """Return the meaning and the action of a code, or None if it is unknown.

    Examples
    --------
    >>> explain("ok")[1]
    'Nothing.'
    """
    return SUFFIX_WORDS.get(code) or WORDS.get(code.partition(":")[0])
