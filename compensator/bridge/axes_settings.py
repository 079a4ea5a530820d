"""Settings of the OPC UA bridge of several axes: `[opcua]` with a table `[opcua.axis.x]` for each axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compensator.bridge.register import AxisPlace
from compensator.bridge.settings import (
    SIGN_BY,
    Connection,
    OpcUa,
    check_connection,
    check_value,
    opcua_from,
    opcua_table,
    with_files,
)
from compensator.errors import ConfigError
from compensator.receiver import AxesSettings, AxisLimits, ReceiverError, Settings, load_any
from compensator.receiver.settings import read_table, require_sign


@dataclass(frozen=True, slots=True, kw_only=True)
class Plc(Connection):
    """`[opcua]` of several axes.

    Parameters
    ----------
    tool_length_node : str
        Optional: a REAL or LREAL with the length of the tool, mm, for angles.
    cutting_node : str
        Optional: a BOOL of the PLC, true while the tool may cut.
    """

    tool_length_node: str = ""
    cutting_node: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlcAxis:
    """`[opcua.axis.x]`.

    Parameters
    ----------
    offset_node : str
        A REAL or LREAL for the offset.
    sign, sign_checked
        As in `[opcua]` of one axis.
    slope_node : str
        Optional: a REAL or LREAL for the slope, where the control adds slope times distance: in mm for each mm where
        `unit` is mm, else in µm/m.
    reference_mm : float
        Position from which the control counts that distance.
    """

    offset_node: str
    sign: int
    sign_checked: str
    slope_node: str = ""
    reference_mm: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OpcUaAxes:
    """The bridge of several axes.

    Parameters
    ----------
    plc : Plc
        Server, intervals and nodes for all axes.
    axes : mapping of str to PlcAxis
        Nodes of each axis.
    limits : mapping of str to AxisLimits
        `[axis.x]` of each.
    """

    plc: Plc
    axes: Mapping[str, PlcAxis]
    limits: Mapping[str, AxisLimits]

    def places(self) -> dict[str, AxisPlace]:
        """Return where each axis is in the PLC."""
        unit_um = self.plc.unit_um
        return {
            axis: AxisPlace(
                sign=one.sign,
                per_um=1.0 / unit_um,
                # 1 µm/m is 1e-6 mm for each mm.
                per_slope=(1e-6 if self.plc.unit == "mm" else 1.0) if one.slope_node else 0.0,
                reference_mm=one.reference_mm,
                tolerance_um=self.plc.readback_tolerance_um,
                travel_mm=self.limits[axis].position_max_mm - self.limits[axis].position_min_mm,
            )
            for axis, one in self.axes.items()
        }


def load_any_bridge(path: str | Path) -> tuple[Settings, OpcUa] | tuple[AxesSettings, OpcUaAxes]:
    """Read and check a bridge's file, of one axis or of several; nothing is opened.

    Raises
    ------
    ConfigError
        One line that names file, key, value and what was expected.
    """
    try:
        receiver, tables = load_any(path)
        if isinstance(receiver, Settings):
            return receiver, opcua_from(tables, str(path))
        opcua = _load(receiver, tables, str(path))
    except ReceiverError as error:
        raise ConfigError(str(error)) from error
    return receiver, opcua


def _load(receiver: AxesSettings, tables: dict[str, Any], path: str) -> OpcUaAxes:
    table = opcua_table(tables, path, "receiver, axis, tool, opcua")
    named = table.get("axis")
    named = named if isinstance(named, dict) else {}
    for axis in {**receiver.linear, **named}:
        if axis not in receiver.linear or not isinstance(named.get(axis), dict):
            raise ReceiverError(
                f"{path}: opcua.axis.{axis}: expected a table for each of: {', '.join(receiver.linear)}"
            )
    plc = read_table(Plc, {key: value for key, value in table.items() if key != "axis"}, source=path, name="opcua")
    check_connection(plc, path)
    axes = {axis: _axis(axis, limits, named[axis], path) for axis, limits in receiver.linear.items()}
    if plc.tool_length_node and (receiver.tool is None or receiver.tool.length_from != "control"):
        raise ReceiverError(f"{path}: opcua.tool_length_node: expected tool.length_from = 'control'")
    return OpcUaAxes(plc=with_files(plc, path), axes=axes, limits=receiver.linear)


def _axis(axis: str, limits: AxisLimits, table: dict[str, Any], path: str) -> PlcAxis:
    where = f"{path}: opcua.axis.{axis}"
    require_sign(table, where, how=SIGN_BY)
    one = read_table(PlcAxis, table, source=path, name=f"opcua.axis.{axis}")
    check_value(one, where)
    if limits.sign != 1:
        raise ReceiverError(f"{path}: axis.{axis}.sign = {limits.sign}: expected the sign in opcua.axis.{axis} alone")
    if bool(one.slope_node) != limits.has_slope:
        raise ReceiverError(f"{where}.slope_node and axis.{axis}.slope_max_um_per_m: expected both or none")
    if limits.has_slope and not limits.position_min_mm <= one.reference_mm <= limits.position_max_mm:
        raise ReceiverError(f"{where}.reference_mm = {one.reference_mm:g}: expected a position within the travel")
    return one
