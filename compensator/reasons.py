"""States, reasons and warnings in words: what each means, and what to do."""

from __future__ import annotations

from collections.abc import Mapping

#: code → (what it means, what to do)
WORDS: Mapping[str, tuple[str, str]] = {
    "starting": (
        "The service runs but has no zero yet, so there is no offset.",
        "Wait for the first good sample of T_Q and AT; if it does not come, run `compensator probe`.",
    ),
    "ok": ("Everything is measured and the offset is the model's.", "Nothing."),
    "degraded": (
        "The service compensates with less than everything; the reasons say what is missing or limited.",
        "Look at the reasons.",
    ),
    "hold": (
        "The last good offset stands and does not follow the machine.",
        "Look at the reasons; find the cause before the next precise cut.",
    ),
    "fault": ("There is no offset to rely on.", "Do not rely on compensation; look at the reasons and the events."),
    "no_zero": ("No zero has been set yet.", "Bring T_Q and AT back, or send the command zero."),
    "t_q_missing": ("T_Q cannot be used in this sample.", "See the quality of t_q_degc: check couple and module."),
    "at_missing": ("AT cannot be used in this sample.", "See the quality of at_degc: check couple, module and line."),
    "channel_missing": (
        "A channel that an effect of the model uses is missing; its last good value stands in.",
        "Check the sensor of that channel.",
    ),
    "predicting": (
        "A temperature is missing and the model predicts with the heat as it last was.",
        "Bring the sensor back before loss.predict_for_min is over; then the offset is held.",
    ),
    "prediction_expired": (
        "A temperature has been missing for longer than the model may predict.",
        "Repair the sensor; the offset then moves to its right value at the permitted rate.",
    ),
    "outside_validity": (
        "T_Q, AT or the heat lies outside the range on which the model was made.",
        "Calibrate on a wider range, or bring the machine back into it.",
    ),
    "offset_limited": (
        "The offset has reached its largest permitted value.",
        "Check sensors and model before raising limits.offset_max_um.",
    ),
    "rate_limited": (
        "The offset moves at its largest permitted rate and has not arrived yet.",
        "Wait; if it stays so, check sensors and limits.offset_rate_max_um_per_min.",
    ),
    "model_changed": (
        "Another model was taken over, and the offset is still under way to its value at the permitted rate.",
        "Wait until it has arrived; `compensator back` returns to the model before.",
    ),
    "cold_start": (
        "What the machine had stored is not known from a record, so the model began with how it was found.",
        "Allow for the standard deviation, or let the machine come to rest and send the command zero.",
    ),
    "t_q_at_exchanged": (
        "T_Q has been below AT for longer than any machine is: the two are exchanged, or a couple has come off.",
        "Check wires, terminals and addresses of both; let the machine rest and send the command zero, or resume.",
    ),
    "t_q_at_apart": (
        "T_Q and AT did not come together at rest as they were at the zero.",
        "Compare both couples; where they are good, send the command zero at rest.",
    ),
    "implausible": (
        "Measured and predicted Y drift apart; what stands behind the colon fits best: a sensor, or the model.",
        "Check that sensor, its wire and its seat; for the model, run `compensator diagnose` on the recordings.",
    ),
    "residual_too_large": (
        "Measured and predicted Y are farther apart than plausibility.residual_hold_um.",
        "Find the sensor that the reasons suspect; then send the command zero at rest.",
    ),
    "operator_hold": ("An operator has frozen the offset.", "Send the command resume."),
    "recording_failed": (
        "The sample could not be written to disk and waits for it; compensation goes on.",
        "Check free space, permissions and the disk.",
    ),
    "recording_late": (
        "The disk is so slow that the offset went out before its sample was written; that follows.",
        "Check the disk: its health, other programs that write to it, a network share.",
    ),
    "internal_error": ("The service met an error of its own and holds the offset.", "Report the event with its text."),
    "good": ("The value can be used.", "Nothing."),
    "open_circuit": ("The thermocouple or its wiring is broken.", "Check couple and terminals."),
    "over_range": ("The value is above what device or sensor can measure.", "Check sensor, range and wiring."),
    "under_range": ("The value is below what device or sensor can measure.", "Check sensor, range and wiring."),
    "stale": ("The device gives no new values.", "Check device and connection."),
    "invalid": ("The device marks the value as invalid.", "Check the device."),
    "too_few": ("Too few good readings in the sample.", "Look at the errors of the channel: line, module, noise."),
    "device_timeout": ("The device did not answer in time.", "Check power, address and line."),
    "device_disconnected": ("The port, adapter or socket of the device is gone.", "Check cable, adapter and network."),
    "device_refused": ("The device answered with an error.", "Check address, registers and its configuration."),
    "device_garbled": ("What the device sent is no valid frame.", "Check line settings, termination and shielding."),
    "device_error": ("The device could not be read.", "See the events for its message."),
    "device_config": ("The configuration of the device cannot be used.", "Run `compensator check`."),
    "out_of_range": ("The value lies outside the plausible range of the channel.", "Check sensor and range."),
    "too_fast": ("The value changed faster than the sensor's place can.", "Check for a loose sensor or a noisy line."),
    "stuck": ("The value has not moved at all for longer than it may.", "Check that sensor and module still measure."),
    "t_q_below_at": ("T_Q lies below AT although the machine is heated.", "Check for exchanged or fallen-off sensors."),
    # Warnings of identify and diagnose.
    "worse_than_nothing": (
        "On a run that took no part in the fit the model is worse than none.",
        "Do not use it there; see how that run differs from the fitted ones, and fit both together.",
    ),
    "quiet_ambient": (
        "The ambient hardly changed, so the TDTF's gain should not be trusted beyond what was seen.",
        "Add a record with a larger ambient change (an ETVE over a day).",
    ),
    "undetermined_ambient": (
        "The ambient's part is hardly determined, although the ambient moved.",
        "Add a record in which the ambient moves while the heat is steady.",
    ),
    "short_record": (
        "The record is short beside the slowest time constant: what it settles to is extrapolated.",
        "Record at least three times the slowest time constant.",
    ),
    "drifting_mode": (
        "The slowest mode is slower than the record: something drifts that the inputs do not explain.",
        "Record longer, and let compensator diagnose look for what drifts.",
    ),
    "common_cause": (
        "Drive and ambient moved together: how the deformation divides between DTF and TDTF is ambiguous.",
        "Heat at another time of the day.",
    ),
    "undetermined_gain": (
        "The gain of a path at rest is hardly determined.",
        "Record a longer step of its input, until the deformation has settled.",
    ),
    "zero_outside": (
        "A path has a zero outside the unit circle: its response starts the wrong way.",
        "Look at its step response; where the machine does not start the wrong way, try a lower --order.",
    ),
    "turning_response": (
        "The step response of a path turns round before it settles.",
        "Ask whether the machine does that; where it does not, try a lower --order.",
    ),
    "twin_modes": (
        "Two time constants of a path coincide: their standard errors say nothing.",
        "Try one mode less with --order.",
    ),
    "inverse_noise": (
        "The thermocouples' noise becomes much noise in the heat.",
        "Average more readings, or place T_Q closer to the source.",
    ),
    "coloured_residual": (
        "What the model leaves is not noise alone: the model lacks something.",
        "Let compensator diagnose look for what it is.",
    ),
    "validity_range": (
        "The model is valid for the temperatures that were seen, and a third more; outside, the service holds.",
        "Calibrate over the whole range in which the machine works, where that is wider.",
    ),
    "made_worse": (
        "On held-out data the effects that were found make it worse, so the model was left as it was.",
        "Record longer, with more change in the inputs.",
    ),
    "hardly_determined": (
        "The standard error of a parameter is larger than the parameter.",
        "Record more change of what the effect follows before relying on it.",
    ),
    "nearly_as_good": (
        "Another explanation leaves hardly more error.",
        "Make the experiment that is named with it: it tells them apart.",
    ),
    "rounded_off": (
        "Something without a name of its own is deployed beside the effect that was found.",
        "Judge the extended model on another day before relying on it.",
    ),
    "fitted_anew": (
        "The first model was calibrated while the effect acted, so its paths were fitted anew beside it.",
        "Judge the extended model on another day before relying on it.",
    ),
    # Warnings of check, run and router.
    "numbered_port": (
        "A serial port goes by the order of plugging in, and may be another adapter's after a restart.",
        "Name the port by a link in /dev/serial/by-id, or by a udev rule.",
    ),
    "open_listen": (
        "Whoever reaches an endpoint of zenoh.listen can publish offsets and send commands in any name.",
        "Listen on loopback only; for others use a router with TLS and an access list (deploy/zenoh).",
    ),
    "unsecured_connect": (
        "The way to the router is neither encrypted, nor is it proven who is there.",
        "Connect to tls/HOST:PORT with tls_ca, tls_certificate and tls_key (deploy/zenoh).",
    ),
    "unproven_commands": (
        "Commands are taken of which nobody proves who sent them.",
        "Leave zenoh.unproven_commands out, and give operators certificates (deploy/zenoh).",
    ),
    "no_access_list": (
        "The router has no access list: whoever connects may publish and command everything.",
        "Take the access list of deploy/zenoh/access_list.py into its configuration.",
    ),
    "certificate_ends": (
        "A certificate ends within 30 days; from then on the router refuses its owner.",
        "Renew it now (deploy/zenoh/certificates.py --renew), and restart what uses it.",
    ),
    "certificates_unread": (
        "Certificates are not looked into, so one that has expired is not noticed before the router refuses it.",
        "Install what reads them: pip install quill-compensator[tls].",
    ),
    "service_runs": (
        "The service runs and has the devices, so a second program may be refused by them, or disturb its readings.",
        "Look at its readings with `compensator watch`, or stop it for the probe.",
    ),
    "adopted_unusable": (
        "The adopted model cannot be used, and the configured one stands in.",
        "Adopt it again from its file, or go on with the configured one: `compensator back`.",
    ),
    "not_locked": (
        "The lock beside the recordings cannot be taken, so a second service of this machine is not noticed here.",
        "Check space and permissions of the recording folder.",
    ),
    "others_unknown": (
        "No router is reached, so whether another service of this machine is alive elsewhere is not known.",
        "Look whether the router runs; it is asked at the start only.",
    ),
    "router_not_reached": (
        "There is no connection to the router yet; compensation and recording go on, and it is tried again.",
        "Look whether it runs at that address, and whether it takes this certificate.",
    ),
    "link_lost": (
        "The connection to a router or another participant has ended; it is tried again.",
        "Nothing, where it was ended on purpose or comes back; else look for the router and the network.",
    ),
    "note_not_kept": (
        "Where the offset stands cannot be noted in memory while the disk is late: a kill now would lose it.",
        "Look at free space and permissions of /dev/shm.",
    ),
    "note_not_removed": (
        "The note of the last offset cannot be removed although everything is on disk.",
        "Look at the permissions of /dev/shm; a note whose number is on disk does not count at the next start.",
    ),
    "note_refused": (
        "A note of the last offset in /dev/shm is none that this service can have left; it does not count.",
        "Find out who wrote it, where somebody else can log in to this computer.",
    ),
    "disk_finishing": (
        "The service ends and waits for the disk to take the rest of the recording.",
        "Wait; where it takes minutes, check the disk.",
    ),
    # Why a bridge writes nothing.
    "plc_not_reached": (
        "The PLC's server is not reached or refuses; what it holds stands, and it is tried again.",
        "Look at the server, the network and the node's access rights.",
    ),
    "plc_written_over": (
        "The PLC holds another value than was written, so somebody else writes there; the offset stands.",
        "Find out who writes there; once the value has stood for resume_after_s the offset goes on from it.",
    ),
    "plc_beyond_limit": (
        "The PLC holds what no offset can be; nothing is written over it.",
        "Put it right in the PLC, at the value that the axis has now.",
    ),
    # Remarks on tables and recordings that are read as data.
    "estimates_left_out": (
        "The table is an exported recording: what the service estimated and published in it counts as no measurement.",
        "Nothing; where the heat was measured it stands in heat_measured_w and is used.",
    ),
    "rows_sorted": (
        "Rows of the table stood out of order and were sorted by their time.",
        "Look why the logger wrote them so: clocks that were set, or files put together.",
    ),
    "gap_bridged": (
        "Samples are missing; the gap is short beside the machine's time constants and is bridged by a straight line.",
        "Nothing for one; look at the logger where there are many.",
    ),
    "gap_splits": (
        "Samples are missing; the gap is too long to bridge and splits the record into parts of their own.",
        "Look at the logger; give it data without such gaps where the fit needs long records.",
    ),
    "wild_readings": (
        "Single readings far off their neighbours were left out.",
        "Check the sensor for loose contacts and noise.",
    ),
    # What watch shows and no service says of itself.
    "silent": (
        "Nothing newer has come than an offset whose validity is over; the control holds.",
        "Look whether the service, the router and the network run; do not rely on compensation meanwhile.",
    ),
    "unknown": (
        "Nothing was received from which the state could be known.",
        "Wait for one sample; then look whether the service runs.",
    ),
    "token_gone": (
        "The liveliness token of the service is gone: it has ended, or is cut off from the network.",
        "Look whether the service, the router and the network run.",
    ),
    "alive_but_silent": (
        "The service is connected, for its liveliness token is there, but it publishes nothing that is newer.",
        "Look at the log of the service, and whether it still polls; restart it where it stands still.",
    ),
    "two_services": ("Two services publish below one prefix.", "Stop one of them, or correct its prefix."),
    "misfit": (
        "Measured and predicted Y differ by more than the service states: the model lacks something, or a sensor lies.",
        "Run `compensator diagnose` on the recordings; [plausibility] makes it an alarm of the service.",
    ),
    "clock_ahead": (
        "The machine's clock is ahead of this computer's.",
        "Check the time service (NTP) of both computers.",
    ),
    "old_messages": (
        "Messages arrive but carry an old time: one of the two clocks is wrong, or somebody repeats them.",
        "Check the time service (NTP) of both computers, then who publishes below the prefix.",
    ),
    "malformed_messages": (
        "Messages arrived that are none of the service's.",
        "Find out who publishes below the prefix.",
    ),
    "missed_messages": (
        "Messages of the service never arrived here.",
        "Look at the network and the router, where it goes on.",
    ),
    "repeated_numbers": (
        "Messages came with a number that was there already.",
        "Find out whether somebody repeats messages, or a second service publishes below the prefix.",
    ),
    # Ends of a recording, and what an audit can find or has to remark.
    "not_worked_out": (
        "Not every sample could be worked out again from what the recording carries.",
        "Audit with the version that wrote it; what is named beside it was not checked.",
    ),
    "samples_missing": (
        "Samples between others were not recorded.",
        "Look at the events before and behind them: pauses, the disk.",
    ),
    "published_early": (
        "Offsets were published before they were on disk, which was slow or failed.",
        "Check the disk of the machine: its health, free space, other programs that write to it.",
    ),
    "unsigned_behind": (
        "Records stand behind the last signature of the file; the signature says nothing of them.",
        "Audit it again once the file is finished, or the next one is there.",
    ),
    "begins_new_chain": (
        "The hash chain begins anew with this file, which says that no recording was there before it.",
        "Nothing, where the machine was set up anew; else find out where the recordings before it are.",
    ),
    "before_not_given": (
        "A recording before the first file that was given is not among them; what was before is not proven.",
        "Give it too, where it is still kept.",
    ),
    "begins_running": (
        "The comparison begins on a running machine, of which the other model knows no more than the zero.",
        "Leave the first hours out of the judgement, or compare from a recording on that begins at rest.",
    ),
    "signature_not_checked": (
        "The file is signed, and nobody said by whom it should be.",
        "Give the machine's key: --public-key FILE.",
    ),
    "left_beyond_stated": (
        "With the correction more is left in Y than the service's own standard deviation says.",
        "Look at the probe and the couples, then run `compensator diagnose` on these recordings.",
    ),
    "finished": ("The recording has its end: sealed, with checksums and index.", "Nothing."),
    "recovered": (
        "The service was ended hard; the next start kept every whole record and sealed the file.",
        "Nothing; see why the machine or the service went down.",
    ),
    "open": (
        "The recording has no end: it is still being written, or the service was ended hard.",
        "Audit it again once the next recording is there: that one names its last value.",
    ),
    "torn": (
        "The recording ends within a group of records: it is still being written, or the service was ended hard.",
        "Audit it again once the next recording is there: that one names its last value.",
    ),
    "truncated": (
        "The end of the recording was cut off.",
        "Find out who had access to it; take the file from a backup.",
    ),
    "damaged": (
        "The file is no recording from some byte on, or a checksum is wrong.",
        "Check disk and copy; take the file from a backup.",
    ),
    "altered": ("Something was changed after it was written.", "Find out who had access; take a copy from a backup."),
    "removed": ("Something that was written is gone.", "Find out who had access; take a copy from a backup."),
    "inserted": ("Something is there that the service did not write there.", "Find out who had access to the file."),
    "reordered": ("Something stands in another place than it was written.", "Check names and copies of the files."),
    "broken": (
        "Two parts of the hash chain do not belong together: one of them was rewritten.",
        "Compare with a backup of both files; a signature would tell which is the true one.",
    ),
    "missing_file": ("A recording between two others is not there.", "Add it and audit again."),
    "unsigned": ("There is no signature where there must be one.", "Check [recording] signing_key of the machine."),
    "false_signature": (
        "A signature is not of the key given.",
        "Check whether the key is this machine's; else trust nothing in it.",
    ),
    "state": (
        "A recording opens with another state than the one before ended with.",
        "Treat the offsets from there on as not proven, and report it.",
    ),
    "unreadable": ("A record is intact and yet not what its schema says.", "Audit with the version that wrote it."),
    "index": (
        "The index of the recording does not lead to all that is in it: readers that seek would miss records.",
        "Find out who had access; the records themselves stand, so a copy made by reading all of it has a right index.",
    ),
}


class Caution(str):
    """A warning: what is the matter, with its figures, and what to do; it knows its code.

    Parameters
    ----------
    code : str
        What `compensator explain` knows it by.
    figures : str
        What is the matter here; what to do is added.

    Examples
    --------
    >>> said = Caution("twin_modes", "Two time constants of the DTF coincide at 20 min.")
    >>> said, said.code
    ('Two time constants of the DTF coincide at 20 min. Try one mode less with --order.', 'twin_modes')
    """

    __slots__ = ("code",)
    code: str

    def __new__(cls, code: str, figures: str) -> Caution:
        """Put the sentences together."""
        words = super().__new__(cls, f"{figures} {WORDS[code][1]}")
        words.code = code
        return words

    @property
    def marked(self) -> str:
        """The warning with its code behind it, as it stands in a terminal or a log."""
        return f"{self} [{self.code}]"


def explain(code: str) -> tuple[str, str] | None:
    """Return what a code means and what to do, or None where it is unknown.

    Examples
    --------
    >>> explain("ok")[1]
    'Nothing.'
    """
    return WORDS.get(code.split(":", maxsplit=1)[0])
