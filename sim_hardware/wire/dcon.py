"""A serial line of DCON (ADAM ASCII) modules: I-7017, 7018, 7018R, 7019R, ADAM-4018+, 4117, 4118.

Sources: ICP DAS I-7018 and Advantech ADAM-4000 user's manuals.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping

from sim_hardware.wire.adam import Adam
from sim_hardware.wire.dcon_slave import DconSettings, DconSlave
from sim_hardware.wire.dcon_text import checksum
from sim_hardware.wire.faults import Layers
from sim_hardware.wire.icpdas import IcpDas
from sim_hardware.wire.outlet import BYTE_FAULTS, Outlet
from sim_hardware.wire.pty_port import PtyPort
from sim_hardware.wire.rack import Server

DCON_FAULTS = BYTE_FAULTS | {"exception", "wrong_length", "disconnect"}
LONGEST_COMMAND = 64
_SPEAKS = ("i-", "m-", "adam-41", "adam-40")


class DconLine(Server):
    """Serve modules by DCON on a serial line.

    There is no reply to a wrong syntax, a wrong checksum or an address without a module; the reply `?AA` means
    that a command was understood but is not allowed.

    Parameters
    ----------
    modules : Mapping[int, IcpDas or Adam]
        Modules by address, 0..255.
    settings : Mapping[int, DconSettings], optional
        Settings of the modules that differ from the factory settings.
    baud : float, optional
        Pace of the replies; without it they come at once.

    Raises
    ------
    ValueError
        If a module does not support the protocol.
    """

    def __init__(
        self,
        modules: Mapping[int, IcpDas | Adam],
        *,
        settings: Mapping[int, DconSettings] | None = None,
        baud: float | None = None,
    ) -> None:
        super().__init__()
        for module in modules.values():
            if not module.model.startswith(_SPEAKS):
                raise ValueError(f"{module.model} does not support DCON")
        self.modules = dict(modules)
        chosen = settings or {}
        self._slaves = {a: DconSlave(m, chosen.get(a, DconSettings())) for a, m in modules.items()}
        self._pty = PtyPort(self._received, baud)
        self._outlet: Outlet | None = None
        self._buffer = b""
        for address, module in modules.items():
            summed = self._slaves[address].settings.checksum
            self.watch(module.faults, supported=DCON_FAULTS | ({"bad_crc"} if summed else set()))
        any_summed = any(slave.settings.checksum for slave in self._slaves.values())
        self.watch(self.faults, supported=DCON_FAULTS | ({"bad_crc"} if any_summed else set()))

    @property
    def port(self) -> str:
        """Path of the serial port to open."""
        return self._pty.path

    def module(self, address: int) -> IcpDas | Adam:
        """Return the module with an address."""
        return self.modules[address]

    async def start(self) -> None:
        """Open the line."""
        self._pty.open()
        self._outlet = Outlet(asyncio.get_running_loop(), self._pty.write)
        await self.apply_faults()

    async def stop(self) -> None:
        """Close the line."""
        if self._outlet is not None:
            self._outlet.close()
        self._pty.close()

    async def apply_faults(self) -> None:
        """Unplug the line while "disconnect" is on."""
        every = [self.faults, *(module.faults for module in self.modules.values())]
        if any(faults.active("disconnect") for faults in every):
            self._pty.unplug()
        else:
            self._pty.plug()

    def _received(self, data: bytes) -> None:
        *commands, self._buffer = (self._buffer + data).split(b"\r")
        self._buffer = self._buffer[-LONGEST_COMMAND:]
        for command in commands:
            self._command(command.decode("latin-1"))

    def _command(self, text: str) -> None:
        if not re.match(r"[#$%@~][0-9A-F]{2}", text):
            return
        address = int(text[1:3], 16)
        slave = self._slaves.get(address)
        if slave is None:
            return
        if slave.settings.checksum:
            if len(text) < 5 or checksum(text[:-2]) != text[-2:]:
                return
            text = text[:-2]
        layers = Layers(self.faults, self.modules[address].faults)
        summed = slave.settings.checksum
        reply = slave.reply(text[0], text[1:3], text[3:])
        if reply is not None:
            self._send(reply, address, layers, summed=summed)
        if slave.new_address is not None:
            self._move(address, slave)

    def _send(self, reply: str, address: int, layers: Layers, *, summed: bool) -> None:
        assert self._outlet is not None
        if layers.use("exception") is not None:
            reply = f"?{address:02X}"
        if layers.use("wrong_length") is not None:
            reply = reply[:-1]
        if summed:
            digits = checksum(reply)
            if layers.use("bad_crc") is not None:
                digits = f"{int(digits, 16) ^ 0xFF:02X}"
            reply += digits
        self._outlet.send(reply.encode("latin-1") + b"\r", layers)

    def _move(self, old: int, slave: DconSlave) -> None:
        assert slave.new_address is not None
        new, slave.new_address = slave.new_address, None
        if new != old:
            self._slaves[new] = self._slaves.pop(old)
            self.modules[new] = self.modules.pop(old)
