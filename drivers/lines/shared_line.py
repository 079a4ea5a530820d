"""Base classes of lines with several devices: one job at a time, time limits, back-off, late answers."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from typing import Any, Generic, TypeVar

from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceTimeout, DriverError
from drivers.lines.backoff import Backoff

ResultT = TypeVar("ResultT")
MemberT = TypeVar("MemberT", bound="LineMember")

#: Silence after which a serial line counts as quiet, s. Adapters deliver in pieces up to 16 ms apart.
QUIET_S = 0.02


class LineMember:
    """A device on a line.

    Parameters
    ----------
    line : SharedLine
        Its line.
    name : str
        Of the device, for messages.
    address : int
        On the line.
    """

    def __init__(self, line: SharedLine[Any], name: str, address: int) -> None:
        self.line = line
        self.name = name
        self.address = address
        self.backoff = Backoff(line.timeout_s)
        #: Whether a late answer of this device may be pending; how often the line was cleared of such answers.
        self.out_of_sync = False
        self.resynchronisations = 0
        self.closed = False

    async def serve(self, job: Callable[[], Awaitable[ResultT]]) -> ResultT:
        """Run a job of requests with exclusive use of the line; see `SharedLine.serve`."""
        return await self.line.serve(self, job)

    @property
    def generation(self) -> tuple[int, int]:
        """Number of times the line was connected or cleared; after each the device may be another one."""
        return self.line.generation, self.resynchronisations

    async def close(self) -> None:
        """Release the line; the last device closes it."""
        self.closed = True
        self.line.left()


class SharedLine(ABC, Generic[MemberT]):
    """A line and the devices on it.

    Parameters
    ----------
    timeout_s : float
        Time limit for one answer, s.
    """

    def __init__(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        #: Connections so far.
        self.generation = 0
        self._members: list[MemberT] = []
        self._lock = asyncio.Lock()

    def left(self) -> None:
        """Close the line when no device is left."""
        if all(member.closed for member in self._members):
            self.close()

    @abstractmethod
    def close(self) -> None:
        """Close the line; a pending request fails at once."""

    async def serve(self, member: MemberT, job: Callable[[], Awaitable[ResultT]]) -> ResultT:
        """Run a job of one device, with exclusive use of the line.

        The time limit, twice the line's, starts when the device gets the line.

        Raises
        ------
        DriverError
            Naming the device.
        """
        loop = asyncio.get_running_loop()
        self._check_backoff(member, loop.time())
        asked_at_s = loop.time()
        async with self._lock:
            self._check_turn(member, asked_at_s)
            began_s = loop.time()
            try:
                async with asyncio.timeout(2.0 * self.timeout_s):
                    await self._open(member)
                    if member.out_of_sync:
                        await self._resynchronise(member)
                    result = await job()
            except TimeoutError:
                member.backoff.failed(loop.time())
                raise DeviceTimeout(member.name, f"not finished within {2.0 * self.timeout_s} s") from None
            except (DeviceTimeout, DeviceGarbled):
                member.backoff.failed(loop.time())
                raise
            except DriverError:
                # A gateway may be slow to report that a device is missing.
                if loop.time() - began_s > self.timeout_s / 2.0:
                    member.backoff.failed(loop.time())
                else:
                    member.backoff.succeeded()
                raise
        member.backoff.succeeded()
        return result

    def _check_backoff(self, member: MemberT, now_s: float) -> None:
        """Refuse at once while no attempt is due."""
        if member.closed:
            raise DeviceDisconnected(member.name, "is closed")
        wait_s, failures = max((backoff.wait_s(now_s), backoff.failures) for backoff in self._backoffs(member))
        if wait_s > 0.0:
            raise DeviceTimeout(member.name, f"no answer {failures} times, next attempt in {wait_s:.1f} s")

    def _backoffs(self, member: MemberT) -> list[Backoff]:
        """Return the back-offs that delay an attempt."""
        return [member.backoff]

    def _check_turn(self, member: MemberT, asked_at_s: float) -> None:
        """Refuse a waiting device if another one has meanwhile found the host unreachable."""

    @abstractmethod
    async def _open(self, member: MemberT) -> None:
        """Open the line if it is not open."""

    @abstractmethod
    async def _resynchronise(self, member: MemberT) -> None:
        """Ensure that no late answer of a device is pending on the line."""

    @abstractmethod
    def _received_at_s(self) -> float | None:
        """Return the time of the last bytes received, s of the loop's clock; None if the line is not open."""

    async def _be_quiet(self) -> None:
        """Wait until the line is quiet, for at most half the time limit."""
        loop = asyncio.get_running_loop()
        give_up_s = loop.time() + self.timeout_s / 2.0
        while (received_at_s := self._received_at_s()) is not None and loop.time() < give_up_s:
            quiet_s = loop.time() - received_at_s
            if quiet_s >= QUIET_S:
                break
            await asyncio.sleep(QUIET_S - quiet_s)
