"""The receiver's reasons and their texts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

#: code → (meaning, action)
WORDS: Mapping[str, tuple[str, str]] = {
    "no_message": (
        "No usable offset has been received since the start; the offset applied before is held.",
        "Check that service and router are running, and that machine and prefix are those of the service.",
    ),
    "expired": (
        "The newest offset is older than its valid_for_s; the applied offset is held and does not follow the machine.",
        "Check the service, the router and the network.",
    ),
    "service_starting": (
        "The service has no offset yet; the applied offset is held.",
        "Wait for its first good sample.",
    ),
    "service_hold": ("The service holds its last good offset, so the receiver holds.", "See the service's reasons."),
    "service_fault": (
        "The service has no reliable offset; the applied offset is held.",
        "See the service's reasons.",
    ),
    "service_degraded": (
        "The service compensates with a restriction; the offset is followed.",
        "See the service's reasons.",
    ),
    "service_gone": (
        "The service's liveliness token is gone; the last offset is used while it is valid, then held.",
        "Check the service, the router and the network.",
    ),
    "malformed": (
        "A message was dropped: it is not a valid offset message.",
        "Find out which programs publish below the prefix.",
    ),
    "other_schema": ("A message of another version was dropped.", "Install the same version of service and receiver."),
    "other_machine": ("A message of another machine was dropped.", "Check machine and prefix on both sides."),
    "replayed": (
        "A message whose number was used before, or an older one, was dropped.",
        "Find out which programs publish below the prefix. If the machine's service was newly installed and counts "
        "from a lower number, wait: the count restarts after the newest offset has expired.",
    ),
    "count_restarted": (
        "The offset is followed again from a lower number: the highest one had expired, and three offsets in a row "
        "followed each other as a service publishes them.",
        "If the machine's service was not newly installed, find out which programs publish below the prefix.",
    ),
    "beyond_limit": (
        "An offset beyond the receiver's offset_max_um was dropped.",
        "Check sensors and model, and that the limits of service and receiver match.",
    ),
    "late": ("An offset was dropped because it was too old when it arrived.", "Check the network and the service."),
    "clock_disagrees": (
        "An offset was dropped because its time is in the future: the clocks of service and receiver disagree.",
        "Synchronise both clocks (NTP).",
    ),
    "catching_up": (
        "The offset is still moving to its value at the permitted rate.",
        "Wait before the next precise cut.",
    ),
    "limit_reached": ("The followed offset has reached offset_max_um.", "Check sensors and model."),
    "held_here": ("The offset was frozen at this receiver.", "Let it follow again."),
    "fading": (
        "On request the receiver moves the offset to zero.",
        "Let it follow again when required.",
    ),
    "faded": ("On request the receiver applies an offset of zero.", "Let it follow again when required."),
    "state_not_saved": (
        "The number of the last message cannot be saved for a restart.",
        "Check the state file's folder: space, permissions, disk.",
    ),
    "state_damaged": (
        "The state file could not be read; replayed messages from before the start are not recognised.",
        "Check the disk; the file is rewritten with the next offset.",
    ),
    "applied_not_recorded": (
        "The applied offset cannot be recorded, so probes without an offset of their own are refused.",
        "Check the folder of applied_file: space, permissions, disk.",
    ),
    "incomplete": (
        "Not all axes of the newest sample have arrived; no axis uses it, and the previous sample is used while it is "
        "valid.",
        "Check that the service publishes every axis, and the access rights of the receiver.",
    ),
    "axes_disagree": (
        "A sample was dropped: its axes contradict each other, or an axis was published twice.",
        "Find out which programs publish below the prefix.",
    ),
    "axis_not_published": (
        "The service does not publish an axis that this receiver applies; no axis is moved.",
        "Compare the axes of the service and of this receiver.",
    ),
    "axis_not_applied": (
        "An angle acts on an axis that this receiver does not apply; no axis is moved.",
        "Add the table of that axis to the receiver's settings, or remove that of the angle.",
    ),
    "further_axes": (
        "The service publishes further axes, which this receiver does not apply.",
        "Add their tables to the receiver's settings if the control is to apply them.",
    ),
    "signs_cancel": (
        "The service and this side both turn the direction of an axis, so that in effect neither does.",
        "Remove sign = -1 on both sides if a dial gauge shows the right direction, else on one.",
    ),
    "slope_not_applied": (
        "The service publishes a slope over the position, which this receiver does not apply.",
        "Set slope_max_um_per_m and the axis' travel in the receiver's settings.",
    ),
    "no_position": (
        "The position of the axis is not known; the offset stays the one of the last known position.",
        "Check that the control shows its position to the receiver.",
    ),
    "position_beyond": (
        "The position is outside the travel in the settings; the offset is the one at the end of the travel.",
        "Check position_min_mm and position_max_mm, and that the position is in machine coordinates.",
    ),
    "position_jumped": (
        "The position has changed faster than the axis can move; the offset stays and moves on at the permitted rate.",
        "Check the wiring of the position, and whether the machine was homed again.",
    ),
    "no_tool_length": (
        "The length of the tool is not known; the offset is the one for the reference length.",
        "Check that the control shows the length to the receiver.",
    ),
    "tool_length_beyond": (
        "The length of the tool is outside its bounds; the offset is the one for the reference length.",
        "Check the tool table, and length_min_mm and length_max_mm.",
    ),
    "tool_changed": (
        "The tool was changed while the offset is held; for this tool the offset is wrong by the stated amount.",
        "Wait for the service, or correct the tool by that amount.",
    ),
    "not_connected": ("No router or service has been reached yet.", "Check address, certificates and network."),
}


def printable(text: str, length: int) -> str:
    r"""Return a text that a stranger wrote, shortened, so that it can be shown on every terminal.

    Examples
    --------
    >>> printable("a\nb\ud800", 40)
    'a\\nb\\ud800'
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[:length])


@dataclass(frozen=True, slots=True)
class Reason:
    """One reason.

    Parameters
    ----------
    code : str
        One of `WORDS`.
    detail : str
        The figures of this case.
    """

    code: str
    detail: str = ""

    @property
    def text(self) -> str:
        """Return the reason as one line of text."""
        meaning = WORDS[self.code][0]
        return f"{meaning} ({self.detail})" if self.detail else meaning

    @property
    def marked(self) -> str:
        """Return the text with the code, for `compensator explain`."""
        return f"{self.text} [{self.code}]"

    def __str__(self) -> str:
        return self.text


#: Reasons whose figures change at every call.
_CHANGING = ("catching_up", "expired", "position_beyond", "position_jumped")


def steady(reasons: Iterable[Reason]) -> str:
    """Return reasons as one line of text without the figures that change at every call, each once.

    Examples
    --------
    >>> steady([Reason("expired", "91 s old"), Reason("expired", "92 s old")]) == Reason("expired").marked
    True
    """
    without = (Reason(reason.code) if reason.code in _CHANGING else reason for reason in reasons)
    return " ".join(reason.marked for reason in dict.fromkeys(without))
