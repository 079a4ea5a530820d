"""The OPC UA client of a PLC: connects, runs the cycle, and connects again; with asyncua."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

from asyncua import Client, ua
from asyncua.crypto import security_policies
from cryptography import x509

from compensator.bridge.register import Registers
from compensator.bridge.settings import Connection, certificate_of
from compensator.codes import BridgeTrouble, Remark
from compensator.errors import ConfigError
from compensator.input_file import KEY_BYTES, read_file
from compensator.receiver import Applied, AppliedAxes, AxesReceiver, Receiver
from compensator.receiver.client import monotonic_s

log = logging.getLogger("compensator")

#: A node and its type.
TypedNode = tuple[Any, ua.VariantType]
#: Values of `state_node`: the follower's states, and 4 if nothing may be written.
STATES = ("starting", "following", "holding", "fading", "trouble")
#: The counter of `heartbeat_node` fits into every integer of a PLC but a Byte, which has its own.
HEARTBEAT_MODULUS, BYTE_MODULUS = 2**15, 2**8
REALS = (ua.VariantType.Float, ua.VariantType.Double)
INTEGERS = (
    ua.VariantType.Byte,
    ua.VariantType.Int16,
    ua.VariantType.UInt16,
    ua.VariantType.Int32,
    ua.VariantType.UInt32,
    ua.VariantType.Int64,
    ua.VariantType.UInt64,
)


class PlcClient(ABC):
    """Keeps a connection to a PLC's server.

    Parameters
    ----------
    settings : Connection
        Server and intervals.
    receiver : Receiver or AxesReceiver
        Context manager entered by the caller; its `step_max_s` should be two cycles.
    report : callable
        Called with a line whenever state or reasons change.
    """

    #: What is written.
    register: Registers

    def __init__(
        self, settings: Connection, receiver: Receiver | AxesReceiver, report: Callable[[str], None] = log.info
    ) -> None:
        self._connection = settings
        self._modes = receiver.follower
        self._poll: Callable[[], Applied | AppliedAxes] = receiver.poll
        self._report = report
        self._reported = ""
        self._beat = 0
        self._nodes: dict[str, TypedNode] = {}
        self._served = False

    @abstractmethod
    async def _prepare(self, client: Client) -> None:
        """Find the nodes and check their types."""

    @abstractmethod
    async def _cycle(self) -> None:
        """Read, compare and write once."""

    @abstractmethod
    def _record_unknown(self) -> None:
        """Record for probes that it is not known what the PLC has."""

    async def run(self, stop: asyncio.Event) -> None:
        """Run until `stop` is set; the PLC then keeps its value.

        Raises
        ------
        ConfigError
            Where a node is of a type that cannot hold its value, at the first connection.
        """
        while not stop.is_set():
            try:
                async with await self._client() as client:
                    await self._serve(client, stop)
            except Exception as error:
                if isinstance(error, ConfigError) and not self._served:
                    raise
                figures = f"{self._connection.endpoint}: {type(error).__name__} {error}".rstrip(". ")
                self._record_unknown()  # or the record would be interpolated over what nobody has seen
                self.register.lost(Remark(BridgeTrouble.PLC_NOT_REACHED, f"{figures}.").marked)
            await self._wait_disconnected(stop)

    async def _client(self) -> Client:
        settings = self._connection
        client = Client(settings.endpoint, timeout=settings.timeout_s)
        if settings.user:
            client.set_user(settings.user)
            client.set_password(read_file(Path(settings.password_file), KEY_BYTES).decode("utf-8").strip())
        if settings.security_policy:
            # A server compares the application URI in the certificate with the one that the application sends.
            client.application_uri = _application_uri(Path(settings.certificate)) or client.application_uri
            await client.set_security(
                getattr(security_policies, f"SecurityPolicy{settings.security_policy}"),
                settings.certificate,
                settings.private_key,
                server_certificate=settings.server_certificate,
                mode=ua.MessageSecurityMode.SignAndEncrypt,
            )
        return client

    async def _serve(self, client: Client, stop: asyncio.Event) -> None:
        await self._prepare(client)
        self._served = True
        self.register.lost("")
        while not stop.is_set():
            await self._cycle()
            await _pause(stop, self._connection.cycle_s)

    def _hold_unless(self, free: bool) -> None:
        if free:
            self._modes.follow()
        else:
            self._modes.hold()

    def _next_beat(self) -> int:
        _, kind = self._nodes.get("heartbeat_node", (None, None))
        self._beat = (self._beat + 1) % (BYTE_MODULUS if kind is ua.VariantType.Byte else HEARTBEAT_MODULUS)
        return self._beat

    def _state(self, applied: Applied | AppliedAxes) -> int:
        return STATES.index("trouble" if self.register.trouble else applied.state)

    async def _wait_disconnected(self, stop: asyncio.Event) -> None:
        """Follow the published offset without the PLC, until the next attempt."""
        self._modes.hold()
        end_s = monotonic_s() + self._connection.retry_s
        while not stop.is_set() and monotonic_s() < end_s:
            self._report_change(self._poll())
            await _pause(stop, min(self._connection.cycle_s, self._connection.retry_s))

    def _report_change(self, applied: Applied | AppliedAxes) -> None:
        trouble = self.register.trouble
        line = f"trouble: {trouble}" if trouble else f"{applied.state}: {applied.steady_reasons}".rstrip(": ")
        if line != self._reported:
            self._reported = line
            self._report(line)


def _application_uri(path: Path) -> str:
    data = read_file(path, KEY_BYTES)
    try:
        names = certificate_of(data).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (ValueError, x509.ExtensionNotFound):
        return ""
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")


async def typed(client: Client, key: str, name: str, kinds: tuple[ua.VariantType, ...]) -> TypedNode:
    """Return a node of the server with its type.

    Raises
    ------
    ConfigError
        Where the type cannot hold the value.
    """
    node = client.get_node(name)
    kind = await node.read_data_type_as_variant_type()
    if kind not in kinds:
        expected = ", ".join(one.name for one in kinds)
        raise ConfigError(f"{key} = {name!r}: is a {kind.name}, expected one of {expected}")
    return node, kind


def real(value: object) -> float:
    """Return the number that a node holds.

    Raises
    ------
    asyncua.ua.UaError
        If it holds nothing, an array or a text: the PLC is not ready, or the node is not the one that was meant.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ua.UaError(f"a node that must hold a number holds a value of type {type(value).__name__}")
    return float(value)


def data_value(value: float, kind: ua.VariantType) -> ua.DataValue:
    """Return a value without time and status, which PLCs refuse."""
    return ua.DataValue(ua.Variant(value, kind))


async def _pause(stop: asyncio.Event, seconds: float) -> None:
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(stop.wait(), seconds)
