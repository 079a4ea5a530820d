"""Why a receiver does what it does, in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

#: code → (what it means, what to do)
WORDS: Mapping[str, tuple[str, str]] = {
    "no_message": (
        "No usable offset has been received since the start; what was applied before stands.",
        "Check that service and router run, and that machine and prefix are the service's.",
    ),
    "expired": (
        "The newest offset is older than its valid_for_s; the applied offset stands and no longer follows the machine.",
        "Look for the service, the router and the network.",
    ),
    "service_starting": ("The service has no offset yet; what was applied stands.", "Wait for its first good sample."),
    "service_hold": ("The service holds its last good offset; so does the receiver.", "Look at the service's reasons."),
    "service_fault": (
        "The service has no offset to rely on; what was applied stands.",
        "Look at the service's reasons.",
    ),
    "service_degraded": (
        "The service compensates with less than everything; the offset is followed.",
        "Look at the service's reasons.",
    ),
    "service_gone": (
        "The service's sign of life is gone; the last offset is used for as long as it is valid, then it stands.",
        "Look for the service, the router and the network.",
    ),
    "malformed": (
        "A message was dropped: it is not what an offset must be.",
        "Find out who publishes below the prefix.",
    ),
    "other_schema": ("A message of another version was dropped.", "Bring service and receiver to the same version."),
    "other_machine": ("A message of another machine was dropped.", "Check machine and prefix on both sides."),
    "replayed": (
        "A message whose number was used before, or an older one, was dropped.",
        "Find out who publishes below the prefix. Where the machine's service was set up anew and counts lower, stop "
        "the receiver and delete its state file.",
    ),
    "beyond_limit": (
        "An offset beyond the receiver's offset_max_um was dropped.",
        "Check sensors and model; the limits of service and receiver belong together.",
    ),
    "late": ("An offset was dropped because it was too old when it arrived.", "Look at the network and the service."),
    "clock_disagrees": (
        "An offset was dropped because it comes from the future: the clocks of service and receiver disagree.",
        "Set both clocks (NTP).",
    ),
    "catching_up": ("The offset is still under way at the permitted rate.", "Wait before the next precise cut."),
    "limit_reached": ("The followed offset has reached offset_max_um.", "Check sensors and model."),
    "held_here": ("Somebody has frozen the offset here.", "Allow it to follow again."),
    "fading": (
        "Asked to take the offset away, the receiver moves it to zero.",
        "Allow it to follow again when wanted.",
    ),
    "faded": ("Asked to take the offset away, the receiver applies zero.", "Allow it to follow again when wanted."),
    "state_not_saved": (
        "The number of the last message cannot be kept over a restart.",
        "Check the state file's folder: space, permissions, disk.",
    ),
    "state_damaged": (
        "The state file could not be read; replayed messages from before the start are not recognised.",
        "It is written anew with the next offset; check the disk.",
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
        The numbers of this case.
    """

    code: str
    detail: str = ""

    @property
    def text(self) -> str:
        """Return it in words, one line."""
        meaning = WORDS[self.code][0]
        return f"{meaning} ({self.detail})" if self.detail else meaning

    @property
    def marked(self) -> str:
        """Return it in words with its code, which `compensator explain` knows."""
        return f"{self.text} [{self.code}]"

    def __str__(self) -> str:
        return self.text
