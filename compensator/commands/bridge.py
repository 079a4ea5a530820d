"""`compensator bridge`: write the offset to a control over OPC UA, or send probes, until SIGTERM or SIGINT."""

from __future__ import annotations

import argparse
import asyncio
import logging

from compensator.bridge.axes_settings import OpcUaAxes, load_any_bridge
from compensator.bridge.settings import OpcUa
from compensator.commands import Answer
from compensator.commands.stopping import on_stop
from compensator.errors import ConfigError, UsageError
from compensator.receiver import AxesReceiver, AxesSettings, Receiver, ReceiverError, Settings

log = logging.getLogger("compensator")


def run(arguments: argparse.Namespace) -> Answer | None:
    """Run the command."""
    if arguments.protocol == "probes":
        from compensator.commands import probes

        return probes.run(arguments)
    loaded = load_any_bridge(arguments.config)
    if arguments.check:
        return _checked(arguments.config, *loaded)
    try:
        asyncio.run(_serve(*loaded))
    except ReceiverError as error:
        raise ConfigError(f"{arguments.config}: {error}") from error
    log.info("compensator bridge: stopped; the PLC keeps its value")
    return None


def _checked(path: str, settings: Settings | AxesSettings, opcua: OpcUa | OpcUaAxes) -> Answer:
    if isinstance(settings, AxesSettings) or isinstance(opcua, OpcUaAxes):
        return _checked_axes(path, settings, opcua)
    text = (
        f"{path}: valid. {settings.machine} to {opcua.endpoint}, {opcua.offset_node} in {opcua.unit}, "
        f"sign {opcua.sign:+d} ({opcua.sign_checked}). Nothing was opened."
    )
    return Answer({"ok": True, "machine": settings.machine, "endpoint": opcua.endpoint, "sign": opcua.sign}, text)


def _checked_axes(path: str, settings: Settings | AxesSettings, opcua: OpcUa | OpcUaAxes) -> Answer:
    assert isinstance(settings, AxesSettings) and isinstance(opcua, OpcUaAxes)
    machine, endpoint = settings.source.machine, opcua.plc.endpoint
    lines = [f"{path}: valid. {machine} to {endpoint}, in {opcua.plc.unit}:"]
    for axis, one in opcua.axes.items():
        slope = f", slope {one.slope_node} from {one.reference_mm:g} mm" if one.slope_node else ""
        lines.append(f"  {axis}: {one.offset_node}{slope}, sign {one.sign:+d} ({one.sign_checked})")
    signs = {axis: one.sign for axis, one in opcua.axes.items()}
    text = "\n".join([*lines, "Nothing was opened."])
    return Answer({"ok": True, "machine": machine, "endpoint": endpoint, "signs": signs}, text)


async def _serve(settings: Settings | AxesSettings, opcua: OpcUa | OpcUaAxes) -> None:
    try:
        from compensator.bridge.opcua import AxesBridge, Bridge
    except ModuleNotFoundError as error:
        raise UsageError(f"OPC UA needs {error.name}: pip install quill-compensator[opcua]") from error
    stop = asyncio.Event()
    on_stop(stop.set)
    # asyncua logs a traceback for every lost connection; the bridge logs one line.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    if isinstance(settings, AxesSettings) and isinstance(opcua, OpcUaAxes):
        with AxesReceiver(settings, step_max_s=2.0 * opcua.plc.cycle_s) as axes:
            await AxesBridge(opcua, axes).run(stop)
    elif isinstance(settings, Settings) and isinstance(opcua, OpcUa):
        with Receiver(settings, step_max_s=2.0 * opcua.cycle_s) as receiver:
            await Bridge(opcua, receiver).run(stop)
