"""Brings the published offset to a control: checks, follows, limits, holds, and says why.

Stands alone: this folder needs Python 3.11 and `eclipse-zenoh` and nothing else of the package, so it may be copied
beside a control's own program. `Follower` is the whole of the behaviour and knows no clock, thread or socket;
`Receiver` is the thin layer of Zenoh around it.

```
ReceiverError            one line: file, key, value, what was expected; the receiver cannot be started like this
```
"""

# Imports within this folder are relative, so that a copy of it works under any name.
from .errors import ReceiverError
from .follower import Applied, Follower, Limits
from .message import OffsetMessage, Rejected, parse_offset
from .reasons import WORDS, Reason
from .settings import Settings, load_settings, settings_from
from .subscriber import Receiver

__all__ = [
    "WORDS",
    "Applied",
    "Follower",
    "Limits",
    "OffsetMessage",
    "Reason",
    "Receiver",
    "ReceiverError",
    "Rejected",
    "Settings",
    "load_settings",
    "parse_offset",
    "settings_from",
]
