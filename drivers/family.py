"""What every family of devices registers: its models, their settings and how a device is made.

One file for each family. A family file defines `FAMILIES`, a list of `Family`; the catalogue gathers them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import msgspec
from msgspec import Meta

from drivers.reading import Device

Protocols = Literal["modbus-tcp", "modbus-rtu", "modbus-rtu-over-tcp", "dcon", "capancdt"]


class LineSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `[[line]]` of the configuration: a serial port or a host that one or more devices are reached by.

    Parameters
    ----------
    port, baudrate, parity, stopbits
        Of a serial line (`modbus-rtu`, `dcon`).
    host, tcp_port
        Of a network line; `tcp_port` defaults to 502 for Modbus.
    data_port, command_port
        Of a capaNCDT controller.
    timeout_s : float
        Longest wait for one answer, s.
    """

    name: str
    protocol: Protocols
    port: str | None = None
    baudrate: Annotated[int, Meta(ge=300, le=1_000_000)] = 9600
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    host: str | None = None
    tcp_port: Annotated[int, Meta(ge=1, le=65535)] = 502
    data_port: Annotated[int, Meta(ge=1, le=65535)] = 10001
    command_port: Annotated[int, Meta(ge=1, le=65535)] = 23
    timeout_s: Annotated[float, Meta(ge=0.02, le=2.0)] = 0.3


class Line(Protocol):
    """An open or closed line; opened by the first exchange."""

    @property
    def settings(self) -> LineSettings:
        """Its table of the configuration."""

    async def close(self) -> None:
        """Release port, socket and threads. May be called twice."""


class DeviceSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys that every `[[device]]` has; a family adds its own, among them `inputs`."""

    name: str
    line: str
    model: str
    address: Annotated[int, Meta(ge=0, le=255)] = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """One model of device.

    Parameters
    ----------
    model : str
        Name in the configuration.
    protocols : tuple of str
        Protocols of a line that it can hang on.
    settings : type
        Struct of its `[[device]]`; has `inputs`, a list of structs with an `input` number each.
    input_count : int
        Number of inputs it has; numbers start with 0.
    make : callable
        Makes the device of its settings and its line; opens nothing.
    address_matters : bool
        False where a line carries one device only (a capaNCDT controller).
    """

    model: str
    protocols: tuple[str, ...]
    settings: type[DeviceSettings]
    input_count: int
    make: Callable[[Any, Any], Device]
    address_matters: bool = True
