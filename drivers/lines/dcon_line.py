"""A DCON line: one serial port, shared by its modules, one command at a time.

Data replies contain no address, so a late one could be taken for another module's. They are distinguished as follows:

- Before each command all received bytes are dropped, and only one command is sent at a time.
- After a missing or broken data reply the module is *out of sync*. The line first waits until it is quiet,
  and the module is asked for its name (`$AAM`) until it answers: name replies contain the address, and a module
  answers in order, so after its name no data reply of it is pending.
- For `LOOSE_S` after a missing data reply the *other* modules' data are confirmed: each is asked for
  its name right after its data. With the late reply there would be two data replies before the name; then
  both are dropped.
"""

from __future__ import annotations

import asyncio

from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout
from drivers.lines.serial_port import PortLostError, SerialPort
from drivers.lines.settings import SerialLine
from drivers.lines.shared_line import LineMember, SharedLine
from drivers.protocols.dcon import BadTextError, Reply, command, reply

# Longer than any module or converter delays a reply, s.
LOOSE_S = 10.0


class DconMember(LineMember):
    """A module on a DCON line.

    Parameters
    ----------
    line : DconLine
        Its line.
    name : str
        Of the device, for messages.
    address : int
        0..255.
    with_checksum : bool
        Whether commands and replies have one.
    """

    line: DconLine

    def __init__(self, line: DconLine, name: str, address: int, *, with_checksum: bool) -> None:
        super().__init__(line, name, address)
        self.with_checksum = with_checksum

    async def ask(self, text: str) -> str:
        """Send a `$AA…` or `@AA…` command; return the reply after its address. Only within `serve`."""
        return await self.line.ask(self, f"{text[0]}{self.address:02X}{text[1:]}", "!")

    async def data(self, text: str) -> str:
        """Send a command whose reply is data; return them. Only within `serve`."""
        return await self.line.data(self, f"{text[0]}{self.address:02X}{text[1:]}")


class DconLine(SharedLine[DconMember]):
    """One serial port and the modules on it.

    Parameters
    ----------
    config : SerialLine
        Settings; nothing is opened before the first command.
    """

    def __init__(self, config: SerialLine) -> None:
        super().__init__(config.timeout_s)
        self.config = config
        self._port: SerialPort | None = None
        # Until when a missing data reply may still come, by address.
        self._loose_until_s: dict[int, float] = {}

    def join(self, name: str, address: int, *, with_checksum: bool) -> DconMember:
        """Add a module to the line."""
        member = DconMember(self, name, address, with_checksum=with_checksum)
        self._members.append(member)
        return member

    def close(self) -> None:
        """Close the port; a waiting command fails at once."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _received_at_s(self) -> float | None:
        return self._port.received_at_s if self._port is not None else None

    async def _open(self, member: DconMember) -> None:
        if member.closed:
            raise DeviceDisconnected(member.name, "is closed")
        if self._port is not None and not self._port.lost:
            return
        try:
            self._port = SerialPort(self.config)
        except PortLostError as error:
            raise DeviceDisconnected(member.name, f"cannot open {self.config.port}: {error}") from None
        self.generation += 1

    async def _resynchronise(self, member: DconMember) -> None:
        await self._be_quiet()
        await self.ask(member, f"${member.address:02X}M", "!")
        member.out_of_sync = False
        member.resynchronisations += 1
        self._loose_until_s.pop(member.address, None)

    async def data(self, member: DconMember, text: str) -> str:
        """Query data, and confirm their sender while another module's late data may still arrive."""
        now_s = asyncio.get_running_loop().time()
        member.out_of_sync = True
        try:
            body = await self.ask(member, text, ">")
        except DeviceRefused:
            member.out_of_sync = False
            raise
        except BaseException:
            self._loose_until_s[member.address] = now_s + LOOSE_S
            raise
        if any(until_s > now_s for until_s in self._loose_until_s.values()):
            await self.ask(member, f"${member.address:02X}M", "!", nothing_before=True)
        else:
            self._loose_until_s.clear()
        member.out_of_sync = False
        return body

    async def ask(self, member: DconMember, text: str, lead: str, *, nothing_before: bool = False) -> str:
        """Send one command and wait for the reply that answers it.

        Replies to other commands are skipped, or are an error with `nothing_before`.
        """
        port = self._port
        if port is None:
            raise DeviceDisconnected(member.name, "is closed")
        heard: list[bytes] = []
        try:
            if not nothing_before:
                port.discard_input()
            port.write(command(text, with_checksum=member.with_checksum))
            async with asyncio.timeout(self.timeout_s):
                while True:
                    heard.append(await port.line())
                    found = self._answer(member, heard[-1], lead)
                    if found is not None:
                        return found
                    if nothing_before:
                        raise DeviceGarbled(member.name, "dropped: more than one data reply on the line")
        except PortLostError as error:
            raise DeviceDisconnected(member.name, f"{self.config.port}: {error}") from None
        except TimeoutError:
            if heard or port.rest:
                what = b" ".join((*heard, port.rest))[:60]
                raise DeviceGarbled(member.name, f"no valid reply to {text!r} in {what!r}") from None
            where = f"address {member.address:02X} on {self.config.port}"
            raise DeviceTimeout(member.name, f"no reply to {text!r} from {where} within {self.timeout_s} s") from None

    def _answer(self, member: DconMember, line: bytes, lead: str) -> str | None:
        """Return the body where a line answers the command, None where it answers another one."""
        try:
            found: Reply = reply(line, with_checksum=member.with_checksum)
        except BadTextError as error:
            if lead == "!":  # may be the rest of a late reply; the reply itself is unmistakable
                return None
            raise DeviceGarbled(member.name, str(error)) from None
        if found.lead == "?" and found.address() == member.address:
            raise DeviceRefused(member.name, f"address {member.address:02X} refuses the command (?{found.body})")
        if found.lead != lead:
            return None
        if lead == ">":
            return found.body
        return found.body[2:] if found.address() == member.address else None
