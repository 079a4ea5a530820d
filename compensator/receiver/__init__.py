"""Apply the published offset in a control: check, follow, limit, hold, and report the reasons.

This folder needs Python 3.11 and `eclipse-zenoh` and nothing else of the package, so it can be copied into a control's
own program. `Follower` implements the behaviour, without clock, thread or socket; `Receiver` is the Zenoh client around
it.

```
ReceiverError            the receiver cannot be started: one line with file, key, value and what was expected
```
"""

# Imports within this folder are relative, so that a copy of it works under any name.
from .errors import ReceiverError
from .follower import Applied, Follower, Limits
from .message import OffsetMessage, ProbeWanted, Rejected, parse_offset
from .reasons import WORDS, Reason
from .settings import Settings, load_settings, settings_from
from .subscriber import Receiver

__all__ = [
    "WORDS",
    "Applied",
    "Follower",
    "Limits",
    "OffsetMessage",
    "ProbeWanted",
    "Reason",
    "Receiver",
    "ReceiverError",
    "Rejected",
    "Settings",
    "load_settings",
    "parse_offset",
    "settings_from",
]
