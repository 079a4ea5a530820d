"""Settings of the lines: a serial port or a network address, and how long to wait."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from drivers.settings import Name, Where, one_of, settings

TimeoutS = Annotated[float, msgspec.Meta(ge=0.02, le=2.0)]
TcpPort = Annotated[int, msgspec.Meta(ge=1, le=65535)]


class SerialLine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A serial port with one or several modules.

    Parameters
    ----------
    name, protocol : str
        `modbus-rtu` or `dcon`.
    port : str
        Device file, such as `/dev/ttyUSB0`.
    baudrate : int
        Bit/s; modules are delivered with 9600.
    parity : str
        N, E or O.
    stopbits : int
        1 or 2.
    timeout_s : float
        Time for one request and its reply, s.
    """

    name: Name
    protocol: Literal["modbus-rtu", "dcon"]
    port: Name
    baudrate: Annotated[int, msgspec.Meta(ge=1200, le=921600)] = 9600
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    timeout_s: TimeoutS = 0.3

    def endpoints(self) -> tuple[str, ...]:
        """Name the port or addresses of the line, so that no two lines share one."""
        try:
            return (str(Path(self.port).resolve()),)
        except (OSError, RuntimeError, ValueError):  # a loop of links, or no path at all: it is refused at opening
            return (self.port,)


class TcpLine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A TCP connection to a module, or to a gateway with modules behind it.

    Parameters
    ----------
    name, protocol : str
        `modbus-tcp`, or `modbus-rtu-over-tcp` for a gateway that passes serial frames on unchanged.
    host : str
        Name or address.
    tcp_port : int
        Port number.
    timeout_s : float
        Time to connect, and time for one request and its reply, s.
    """

    name: Name
    protocol: Literal["modbus-tcp", "modbus-rtu-over-tcp"]
    host: Name
    tcp_port: TcpPort = 502
    timeout_s: TimeoutS = 0.3

    def endpoints(self) -> tuple[str, ...]:
        """Name the port or addresses of the line, so that no two lines share one."""
        return (f"{self.host.lower()}:{self.tcp_port}",)


class CapancdtLine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The two TCP ports of a capaNCDT controller.

    Parameters
    ----------
    name, protocol : str
        `capancdt`.
    host : str
        Name or address.
    data_port, command_port : int
        Port that streams measurements, and port that answers commands.
    timeout_s : float
        Time to connect, for one command, and for a new measurement to come, s.
    """

    name: Name
    protocol: Literal["capancdt"]
    host: Name
    data_port: TcpPort = 10001
    command_port: TcpPort = 23
    timeout_s: TimeoutS = 0.3

    def endpoints(self) -> tuple[str, ...]:
        """Name the port or addresses of the line, so that no two lines share one."""
        host = self.host.lower()
        return (f"{host}:{self.data_port}", f"{host}:{self.command_port}")


LineSettings = SerialLine | TcpLine | CapancdtLine

PROTOCOLS: Mapping[str, type[SerialLine] | type[TcpLine] | type[CapancdtLine]] = {
    "modbus-tcp": TcpLine,
    "modbus-rtu": SerialLine,
    "modbus-rtu-over-tcp": TcpLine,
    "dcon": SerialLine,
    "capancdt": CapancdtLine,
}


def line_settings(table: Mapping[str, object], where: Where) -> LineSettings:
    """Convert a `[[line]]` table.

    Raises
    ------
    DriverConfigError
        The protocol is not known, or a key is wrong for it.
    """
    if "protocol" not in table:
        raise where.error(f"key 'protocol' is missing, expected {one_of(tuple(PROTOCOLS))}")
    protocol = table["protocol"]
    kind = PROTOCOLS.get(protocol) if isinstance(protocol, str) else None
    if kind is None:
        raise where.wrong("protocol", protocol, one_of(tuple(PROTOCOLS)))
    return settings(table, kind, where)
