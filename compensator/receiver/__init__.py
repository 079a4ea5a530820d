"""Apply the published offset in a control: check, follow, limit, hold, and report the reasons.

This folder needs Python 3.11 and `eclipse-zenoh` and nothing else of the package, so it can be copied into a control's
own program. `Follower` implements the behaviour, without clock, thread or socket; `Receiver` is the Zenoh client around
it. `AxesFollower` and `AxesReceiver` are the same for several axes.

```
ReceiverError            the receiver cannot be started: one line with file, key, value and what was expected
```
"""

# Imports within this folder are relative, so that a copy of it works under any name.
from .axes_applied import AppliedAxes, AppliedAxis, ControlState
from .axes_follower import AxesFollower
from .axes_receiver import AxesReceiver
from .axes_settings import AxesSettings, load_any
from .errors import ReceiverError
from .follower import Applied, Follower
from .limits import AxisLimits, Limits, TiltLimits, ToolLimits
from .message import OffsetMessage, ProbeWanted, Rejected, parse_offset
from .reasons import WORDS, Reason
from .settings import Settings, load_settings, settings_from
from .subscriber import Receiver

__all__ = [
    "WORDS",
    "Applied",
    "AppliedAxes",
    "AppliedAxis",
    "AxesFollower",
    "AxesReceiver",
    "AxesSettings",
    "AxisLimits",
    "ControlState",
    "Follower",
    "Limits",
    "OffsetMessage",
    "ProbeWanted",
    "Reason",
    "Receiver",
    "ReceiverError",
    "Rejected",
    "Settings",
    "TiltLimits",
    "ToolLimits",
    "load_any",
    "load_settings",
    "parse_offset",
    "settings_from",
]
