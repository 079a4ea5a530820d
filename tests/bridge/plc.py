"""A PLC's OPC UA server on loopback, with everything that was ever in its data block."""

from __future__ import annotations

import logging
from typing import Any

from asyncua import Server, ua

logging.getLogger("asyncua").setLevel(logging.CRITICAL)


class Plc:
    def __init__(
        self,
        port: int,
        value: float = 0.0,
        kind: ua.VariantType = ua.VariantType.Float,
        heartbeat: ua.VariantType = ua.VariantType.Int16,
    ) -> None:
        self.port, self.start, self.kind, self.heartbeat_kind = port, value, kind, heartbeat
        self.endpoint = f"opc.tcp://127.0.0.1:{port}/"
        self.values: list[float] = []
        self.server: Any = None

    async def __aenter__(self) -> Plc:
        self.server = Server()
        await self.server.init()
        self.server.set_endpoint(self.endpoint)
        self.server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        space = await self.server.register_namespace("plc")
        assert space == 2
        block = await self.server.nodes.objects.add_object(ua.NodeId("/Plc/DB100", space), "DB100")

        async def add(name: str, value: Any, kind: ua.VariantType) -> Any:
            node = await block.add_variable(ua.NodeId(name, space), name.partition(":")[0], value, varianttype=kind)
            await node.set_writable()
            return node

        self.offset = await add("/Plc/DB100.DBD0:REAL", self.start, self.kind)
        self.heartbeat = await add("/Plc/DB100.DBW4", 0, self.heartbeat_kind)
        self.state = await add("/Plc/DB100.DBW6", 0, ua.VariantType.UInt16)
        self.enable = await add("/Plc/DB100.DBX8.0", True, ua.VariantType.Boolean)
        self.probe_wanted = await add("/Plc/DB100.DBX8.1", False, ua.VariantType.Boolean)
        # What a PLC of several axes has besides.
        self.z = await add("/Plc/DB100.DBD12:REAL", self.start, self.kind)
        self.slope = await add("/Plc/DB100.DBD16:LREAL", 0.0, ua.VariantType.Double)
        self.tool_mm = await add("/Plc/DB100.DBD24:REAL", 0.0, ua.VariantType.Float)
        self.cutting = await add("/Plc/DB100.DBX8.2", True, ua.VariantType.Boolean)
        await self.server.start()
        subscription = await self.server.create_subscription(10, self)
        await subscription.subscribe_data_change(self.offset, queuesize=1000)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.server.stop()

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        self.values.append(value)

    async def um(self) -> float:
        return float(await self.offset.read_value()) * 1000.0

    async def put(self, um: float) -> None:
        await self.offset.write_value(ua.Variant(um / 1000.0, self.kind))
