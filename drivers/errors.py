"""Errors of the drivers.

```
DriverError                 names the device (or line) and the fault
├── DriverConfigError       a table of the configuration is wrong: key, value, what was expected
├── DeviceTimeout           no reply in time
├── DeviceDisconnected      the port, adapter or socket is lost
├── DeviceRefused           the device answered with an exception or error reply
└── DeviceGarbled           the reply is not a valid frame: checksum, length, text
```

A faulty sensor of a working device is not an error: it gives a `Reading` with a quality.
"""

from __future__ import annotations

import errno
import os


class DriverError(Exception):
    """Base of all errors of the drivers.

    Parameters
    ----------
    device : str
        Name of the device or line, as in the configuration.
    message : str
        The fault, with value, limit and unit if applicable.
    """

    code = "device_error"

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"{device}: {message}")
        self.device = device
        self.message = message


class DriverConfigError(DriverError):
    """A table of the configuration cannot be used."""

    code = "device_config"


class DeviceTimeout(DriverError):
    """No reply in time."""

    code = "device_timeout"


class DeviceDisconnected(DriverError):
    """The port, adapter or socket is lost."""

    code = "device_disconnected"


class DeviceRefused(DriverError):
    """The device answered with an exception or an error reply."""

    code = "device_refused"


class DeviceGarbled(DriverError):
    """The reply is not a valid frame."""

    code = "device_garbled"


def failure_text(error: Exception) -> str:
    """Return why a port or connection cannot be opened, without its name, which the caller gives.

    Examples
    --------
    >>> failure_text(OSError(2, "could not open port /dev/ttyUSB0: [Errno 2] No such file or directory"))
    'No such file or directory'
    """
    number = error.args[0] if error.args else None
    if number == errno.EAGAIN:  # pyserial locks the port
        return "in use by another program"
    if isinstance(number, int) and number > 0:
        return os.strerror(number)
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
