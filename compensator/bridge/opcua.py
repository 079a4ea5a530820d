"""Writes the offset to a PLC's data block over OPC UA: the asyncua client around `Register` and `Receiver`."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from asyncua import Client, ua
from asyncua.crypto import security_policies
from cryptography import x509

from compensator.bridge.register import Register
from compensator.bridge.settings import OpcUa
from compensator.codes import BridgeTrouble, Remark
from compensator.errors import ConfigError
from compensator.input_file import KEY_BYTES, read_file
from compensator.receiver import Applied, Receiver
from compensator.receiver.subscriber import monotonic_s

log = logging.getLogger("compensator")

#: Values of `state_node`: the follower's states, and 4 if nothing may be written.
STATES = ("starting", "following", "holding", "fading", "trouble")
#: The counter of `heartbeat_node` fits into every integer of a PLC.
HEARTBEAT_MODULUS = 2**15
_REALS = (ua.VariantType.Float, ua.VariantType.Double)
_INTEGERS = (
    ua.VariantType.Byte,
    ua.VariantType.Int16,
    ua.VariantType.UInt16,
    ua.VariantType.Int32,
    ua.VariantType.UInt32,
    ua.VariantType.Int64,
    ua.VariantType.UInt64,
)
#: Raised if a connection is lost, refused or does not answer.
_GONE = (OSError, ua.UaError, asyncio.TimeoutError, ConnectionError)


class Bridge:
    """Writes the offset to a PLC.

    Parameters
    ----------
    settings : OpcUa
        Server, node, unit and sign.
    receiver : Receiver
        Context manager entered by the caller; its `step_max_s` should be two cycles.
    report : callable, optional
        Called with a line whenever state or reasons change; the log by default.
    """

    def __init__(self, settings: OpcUa, receiver: Receiver, report: Callable[[str], None] = log.info) -> None:
        self._settings = settings
        self._receiver = receiver
        self._report = report
        self._reported = ""
        self._beat = 0
        self.register = Register(
            receiver.follower,
            sign=settings.sign,
            unit_um=settings.unit_um,
            tolerance_um=settings.readback_tolerance_um,
            resume_after_s=settings.resume_after_s,
        )

    async def run(self, stop: asyncio.Event) -> None:
        """Run until `stop` is set; the PLC then keeps its value.

        Raises
        ------
        ConfigError
            Where a node is of a type that cannot hold its value.
        """
        while not stop.is_set():
            try:
                async with await self._client() as client:
                    await self._serve(client, stop)
            except _GONE as error:
                figures = f"{self._settings.endpoint}: {type(error).__name__} {error}".rstrip(". ")
                self.register.lost(Remark(BridgeTrouble.PLC_NOT_REACHED, f"{figures}.").marked)
            await self._wait_disconnected(stop)

    async def _client(self) -> Client:
        settings = self._settings
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
        nodes = await self._nodes(client)
        self.register.lost("")
        while not stop.is_set():
            await self._cycle(nodes)
            await _pause(stop, self._settings.cycle_s)

    async def _nodes(self, client: Client) -> dict[str, tuple[Any, ua.VariantType]]:
        nodes = {}
        wanted = {
            "offset_node": _REALS,
            "heartbeat_node": _INTEGERS,
            "state_node": _INTEGERS,
            "enable_node": (ua.VariantType.Boolean,),
            "probe_wanted_node": (ua.VariantType.Boolean,),
        }
        for key, kinds in wanted.items():
            name = getattr(self._settings, key)
            if not name:
                continue
            node = client.get_node(name)
            kind = await node.read_data_type_as_variant_type()
            if kind not in kinds:
                expected = ", ".join(one.name for one in kinds)
                raise ConfigError(f"opcua.{key} = {name!r}: is a {kind.name}, expected one of {expected}")
            nodes[key] = (node, kind)
        self.register.single = nodes["offset_node"][1] is ua.VariantType.Float
        return nodes

    async def _cycle(self, nodes: dict[str, tuple[Any, ua.VariantType]]) -> None:
        node, kind = nodes["offset_node"]
        found = float(await node.read_value())
        self._receiver.record(found * self._settings.sign * self._settings.unit_um)
        may_move = self.register.check(monotonic_s(), found)
        enabled = "enable_node" not in nodes or bool(await nodes["enable_node"][0].read_value())
        if may_move and enabled:
            self._receiver.follower.follow()
        else:
            self._receiver.follower.hold()
        applied = self._receiver.poll()
        if may_move:
            value = self.register.value(applied.offset_um)
            if value is not None:
                await _write(node, value, kind)
                self.register.wrote(value)
        self._beat = (self._beat + 1) % HEARTBEAT_MODULUS
        state = STATES.index("trouble" if self.register.trouble else applied.state)
        wanted = self._receiver.probe_wanted
        shown = {"state_node": state, "heartbeat_node": self._beat}
        shown["probe_wanted_node"] = wanted is not None and wanted.wanted
        for key, number in shown.items():
            if key in nodes:
                await _write(nodes[key][0], number, nodes[key][1])
        self._report_change(applied)

    async def _wait_disconnected(self, stop: asyncio.Event) -> None:
        """Follow the published offset without the PLC, until the next attempt."""
        self._receiver.follower.hold()
        end_s = monotonic_s() + self._settings.retry_s
        while not stop.is_set() and monotonic_s() < end_s:
            self._report_change(self._receiver.poll())
            await _pause(stop, min(self._settings.cycle_s, self._settings.retry_s))

    def _report_change(self, applied: Applied) -> None:
        trouble = self.register.trouble
        line = f"trouble: {trouble}" if trouble else f"{applied.state}: {applied.steady_reasons}".rstrip(": ")
        if line != self._reported:
            self._reported = line
            self._report(line)


def _application_uri(path: Path) -> str:
    data = read_file(path, KEY_BYTES)
    try:
        read = x509.load_pem_x509_certificate if data.startswith(b"-----") else x509.load_der_x509_certificate
        names = read(data).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (ValueError, x509.ExtensionNotFound):
        return ""
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")


async def _write(node: Any, value: float, kind: ua.VariantType) -> None:
    # Without time and status, which PLCs refuse.
    await node.write_value(ua.DataValue(ua.Variant(value, kind)))


async def _pause(stop: asyncio.Event, seconds: float) -> None:
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(stop.wait(), seconds)
