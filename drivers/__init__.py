"""Device drivers: protocols of thermocouple modules and displacement controllers."""

from __future__ import annotations

from drivers.catalog import MODELS, Fleet, build
from drivers.errors import (
    DeviceDisconnected,
    DeviceGarbled,
    DeviceRefused,
    DeviceTimeout,
    DriverConfigError,
    DriverError,
)
from drivers.reading import Device, Quality, Reading

__all__ = [
    "MODELS",
    "Device",
    "DeviceDisconnected",
    "DeviceGarbled",
    "DeviceRefused",
    "DeviceTimeout",
    "DriverConfigError",
    "DriverError",
    "Fleet",
    "Quality",
    "Reading",
    "build",
]
