"""`compensator bridge`: write the offset to a control over OPC UA, or send probes, until SIGTERM or SIGINT."""

from __future__ import annotations

import argparse
import asyncio
import logging

from compensator.bridge.settings import OpcUa, load_bridge
from compensator.commands import Answer
from compensator.commands.stopping import on_stop
from compensator.errors import ConfigError, UsageError
from compensator.receiver import Receiver, ReceiverError, Settings

log = logging.getLogger("compensator")


def run(arguments: argparse.Namespace) -> Answer | None:
    """Run the command."""
    if arguments.protocol == "probes":
        from compensator.commands import probes

        return probes.run(arguments)
    settings, opcua = load_bridge(arguments.config)
    if arguments.check:
        text = (
            f"{arguments.config}: valid. {settings.machine} to {opcua.endpoint}, {opcua.offset_node} in {opcua.unit}, "
            f"sign {opcua.sign:+d} ({opcua.sign_checked}). Nothing was opened."
        )
        return Answer({"ok": True, "machine": settings.machine, "endpoint": opcua.endpoint, "sign": opcua.sign}, text)
    try:
        asyncio.run(_serve(settings, opcua))
    except ReceiverError as error:
        raise ConfigError(f"{arguments.config}: {error}") from error
    log.info("compensator bridge: stopped; the PLC keeps its value")
    return None


async def _serve(settings: Settings, opcua: OpcUa) -> None:
    try:
        from compensator.bridge.opcua import Bridge
    except ModuleNotFoundError as error:
        raise UsageError(f"OPC UA needs {error.name}: pip install quill-compensator[opcua]") from error
    stop = asyncio.Event()
    on_stop(stop.set)
    # asyncua logs a traceback for every lost connection; the bridge logs one line.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    with Receiver(settings, step_max_s=2.0 * opcua.cycle_s) as receiver:
        await Bridge(opcua, receiver).run(stop)
