"""Writes the offset to a PLC's data block over OPC UA, and those of several axes together."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from asyncua import Client, ua

from compensator.bridge.axes_settings import OpcUaAxes
from compensator.bridge.plc_client import INTEGERS, REALS, PlcClient, TypedNode, data_value, log, real, typed
from compensator.bridge.register import AxesRegisters, Register
from compensator.bridge.settings import OpcUa
from compensator.receiver import AxesReceiver, ControlState, Receiver
from compensator.receiver.client import monotonic_s

_BOOLS = (ua.VariantType.Boolean,)
#: Nodes that show how the bridge is, and what a PLC says to it.
_SHOWN = {"heartbeat_node": INTEGERS, "state_node": INTEGERS, "probe_wanted_node": _BOOLS}


class Bridge(PlcClient):
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

    register: Register

    def __init__(self, settings: OpcUa, receiver: Receiver, report: Callable[[str], None] = log.info) -> None:
        super().__init__(settings, receiver, report)
        self._settings = settings
        self._receiver = receiver
        self.register = Register(
            receiver.follower,
            sign=settings.sign,
            unit_um=settings.unit_um,
            tolerance_um=settings.readback_tolerance_um,
            resume_after_s=settings.resume_after_s,
        )

    async def _prepare(self, client: Client) -> None:
        wanted = {"offset_node": REALS, "enable_node": _BOOLS, **_SHOWN}
        names = {key: getattr(self._settings, key) for key in wanted}
        self._nodes = {
            key: await typed(client, f"opcua.{key}", name, wanted[key]) for key, name in names.items() if name
        }
        self.register.single = self._nodes["offset_node"][1] is ua.VariantType.Float

    async def _cycle(self) -> None:
        nodes = self._nodes
        node, kind = nodes["offset_node"]
        found = real(await node.read_value())
        self._receiver.record(found * self._settings.sign * self._settings.unit_um)
        may_move = self.register.check(monotonic_s(), found)
        enabled = "enable_node" not in nodes or await nodes["enable_node"][0].read_value() is True
        self._hold_unless(may_move and enabled)
        applied = self._receiver.poll()
        if may_move:
            value = self.register.value(applied.offset_um)
            if value is not None:
                await node.write_value(data_value(value, kind))
                self.register.wrote(value)
        wanted = self._receiver.probe_wanted
        shown = {"state_node": self._state(applied), "heartbeat_node": self._next_beat()}
        shown["probe_wanted_node"] = wanted is not None and wanted.wanted
        for key, number in shown.items():
            if key in nodes:
                await nodes[key][0].write_value(data_value(number, nodes[key][1]))
        self._report_change(applied)

    def _record_unknown(self) -> None:
        self._receiver.record(None)


class AxesBridge(PlcClient):
    """Writes the offsets and slopes of several axes to a PLC: all in one call, then state and heartbeat.

    Parameters
    ----------
    settings : OpcUaAxes
        Server, and nodes, signs and units of each axis.
    receiver : AxesReceiver
        Context manager entered by the caller; its `step_max_s` should be two cycles.
    report : callable, optional
        Called with a line whenever state or reasons change; the log by default.
    """

    register: AxesRegisters

    def __init__(self, settings: OpcUaAxes, receiver: AxesReceiver, report: Callable[[str], None] = log.info) -> None:
        super().__init__(settings.plc, receiver, report)
        self._settings = settings
        self._receiver = receiver
        places = settings.places()
        self.register = AxesRegisters(receiver.follower, places, settings.plc.resume_after_s)
        receiver.follower.signs |= {axis: place.sign for axis, place in places.items()}
        # For the control, which adds slope times distance from there.
        self._at_mm = {axis: place.reference_mm for axis, place in places.items()}
        self._server: Any = None
        self._values: list[TypedNode] = []

    async def _prepare(self, client: Client) -> None:
        self._server = client
        self._values = []
        for axis, one in self._settings.axes.items():
            for key in ("offset_node", "slope_node"):
                if name := getattr(one, key):
                    self._values.append(await typed(client, f"opcua.axis.{axis}.{key}", name, REALS))
        plc = self._settings.plc
        wanted = {"enable_node": _BOOLS, "cutting_node": _BOOLS, "tool_length_node": REALS, **_SHOWN}
        names = {key: getattr(plc, key) for key in wanted}
        self._nodes = {
            key: await typed(client, f"opcua.{key}", name, wanted[key]) for key, name in names.items() if name
        }
        self.register.single = [kind is ua.VariantType.Float for _, kind in self._values]

    async def _cycle(self) -> None:
        found, read = await self._read()
        self._receiver.record(self.register.offsets_um(found))
        may_move = self.register.check_all(monotonic_s(), found)
        self._hold_unless(may_move and read.get("enable_node", True) is True)
        length = read.get("tool_length_node")
        control = ControlState(
            tool_length_mm=None if length is None else real(length),
            positions_mm=self._at_mm,
            cutting=read.get("cutting_node", True) is not False,
        )
        applied = self._receiver.poll(control)
        if may_move:
            values = self.register.values(applied)
            if values is not None:
                await self._write(list(zip(self._values, values, strict=True)))
                self.register.wrote(values)
        wanted = self._receiver.probe_wanted
        shown = {"state_node": self._state(applied), "probe_wanted_node": wanted is not None and wanted.wanted}
        shown["heartbeat_node"] = self._next_beat()
        await self._write([(self._nodes[key], value) for key, value in shown.items() if key in self._nodes])
        self._report_change(applied)

    def _record_unknown(self) -> None:
        self._receiver.record({})

    async def _read(self) -> tuple[tuple[float, ...], dict[str, Any]]:
        """Read all in one call; a length or a signal that the server marks as bad is not there."""
        keys = [key for key in ("enable_node", "cutting_node", "tool_length_node") if key in self._nodes]
        nodes = [node for node, _ in self._values] + [self._nodes[key][0] for key in keys]
        results = await self._server.read_attributes(nodes, attr=ua.AttributeIds.Value)
        for result in results[: len(self._values)]:
            result.StatusCode.check()
        values = [None if one.StatusCode.is_bad() or one.Value is None else one.Value.Value for one in results]
        count = len(self._values)
        found = tuple(math.nan if value is None else real(value) for value in values[:count])
        return found, dict(zip(keys, values[count:], strict=True))

    async def _write(self, values: list[tuple[TypedNode, float]]) -> None:
        """Write in one call; an error of any value is raised, and all are then read again."""
        if values:
            nodes = [node for (node, _), _ in values]
            await self._server.write_values(nodes, [data_value(value, kind) for (_, kind), value in values])
