"""The receiver's reasons, in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

#: code → (what it means, what to do)
WORDS: Mapping[str, tuple[str, str]] = {
    "no_message": (
        "No usable offset has been received since the start; the offset applied before stays.",
        "Check that service and router run, and that machine and prefix are the service's.",
    ),
    "expired": (
        "The newest offset is older than its valid_for_s; the applied offset stays and no longer follows the machine.",
        "Look for the service, the router and the network.",
    ),
    "service_starting": ("The service has no offset yet; the applied one stays.", "Wait for its first good sample."),
    "service_hold": ("The service holds its last good offset, and the receiver too.", "Look at the service's reasons."),
    "service_fault": (
        "The service has no reliable offset; the applied one stays.",
        "Look at the service's reasons.",
    ),
    "service_degraded": (
        "The service compensates with reduced information; the offset is followed.",
        "Look at the service's reasons.",
    ),
    "service_gone": (
        "The service's liveliness token is gone; the last offset is used while it is valid, then held.",
        "Look for the service, the router and the network.",
    ),
    "malformed": (
        "A message was dropped: it is not a valid offset message.",
        "Find out who publishes below the prefix.",
    ),
    "other_schema": ("A message of another version was dropped.", "Bring service and receiver to the same version."),
    "other_machine": ("A message of another machine was dropped.", "Check machine and prefix on both sides."),
    "replayed": (
        "A message whose number was used before, or an older one, was dropped.",
        "Find out who publishes below the prefix. Where the machine's service was newly installed and counts "
        "from a lower number, stop the receiver and delete its state file.",
    ),
    "beyond_limit": (
        "An offset beyond the receiver's offset_max_um was dropped.",
        "Check sensors and model, and that the limits of service and receiver match.",
    ),
    "late": ("An offset was dropped because it was too old when it arrived.", "Look at the network and the service."),
    "clock_disagrees": (
        "An offset was dropped because it comes from the future: the clocks of service and receiver disagree.",
        "Set both clocks (NTP).",
    ),
    "catching_up": (
        "The offset is still moving to its value at the permitted rate.",
        "Wait before the next precise cut.",
    ),
    "limit_reached": ("The followed offset has reached offset_max_um.", "Check sensors and model."),
    "held_here": ("Somebody has frozen the offset here.", "Let it follow again."),
    "fading": (
        "On request the receiver moves the offset to zero.",
        "Let it follow again when wanted.",
    ),
    "faded": ("On request the receiver applies an offset of zero.", "Let it follow again when wanted."),
    "state_not_saved": (
        "The number of the last message cannot be saved for a restart.",
        "Check the state file's folder: space, permissions, disk.",
    ),
    "state_damaged": (
        "The state file could not be read; replayed messages from before the start are not recognised.",
        "It is rewritten with the next offset; check the disk.",
    ),
    "not_connected": ("No router or service has been reached yet.", "Check address, certificates and network."),
}


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
        """Return the reason in words, one line."""
        meaning = WORDS[self.code][0]
        return f"{meaning} ({self.detail})" if self.detail else meaning

    @property
    def marked(self) -> str:
        """Return the reason in words with its code, for `compensator explain`."""
        return f"{self.text} [{self.code}]"

    def __str__(self) -> str:
        return self.text
