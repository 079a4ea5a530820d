"""Settings of a receiver of several axes: `[receiver]`, a table `[axis.x]` for each axis, and `[tool]`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from .axes_follower import check_axes
from .axis_message import LINEAR, TILTS
from .errors import ReceiverError
from .limits import AxisLimits, TiltLimits, ToolLimits
from .settings import Settings, Source, read_table, receiver_tables, settings_from, source_from

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class AxesSettings:
    """Settings of several axes.

    Parameters
    ----------
    source : Source
        `[receiver]`, without limits.
    axes : mapping of str to (AxisLimits or TiltLimits)
        `[axis.x]` … and `[axis.a]` …
    tool : ToolLimits or None
        `[tool]`.
    """

    source: Source
    axes: Mapping[str, AxisLimits | TiltLimits]
    tool: ToolLimits | None

    @property
    def linear(self) -> dict[str, AxisLimits]:
        """Return the axes that have an offset."""
        return {axis: limits for axis, limits in self.axes.items() if isinstance(limits, AxisLimits)}

    @property
    def has_tilt(self) -> bool:
        """Return whether an angle is applied, for which the length of the tool is needed."""
        return any(isinstance(limits, TiltLimits) for limits in self.axes.values())


def load_any(path: str | Path) -> tuple[Settings | AxesSettings, dict[str, Any]]:
    """Read a TOML file: of several axes if it has a table such as `[axis.z]`, else of one.

    Returns
    -------
    (Settings or AxesSettings, dict)
        The settings with paths made absolute, and the file's other tables. Keys of `[axis]` itself stay in these.

    Raises
    ------
    ReceiverError
        One line that names file, key, value and what was expected.
    """
    path = Path(path)
    table, named, others = receiver_tables(path)
    if not named:
        return settings_from(table, source=str(path), folder=path.parent), others
    for key in ("offset_max_um", "offset_rate_max_um_per_min"):
        if key in table:
            raise ReceiverError(f"{path}: receiver.{key}: expected it in each table [axis.{next(iter(named))}] instead")
    source = source_from(Source, table, source=str(path), folder=path.parent)
    try:
        source.acceptance()
    except ReceiverError as error:
        raise ReceiverError(f"{path}: receiver.{error}") from error
    axes = {name: _axis(name, one, str(path)) for name, one in named.items()}
    tool = _tool(others, str(path))
    try:
        check_axes(axes, tool)
    except ReceiverError as error:
        raise ReceiverError(f"{path}: {error}") from error
    return AxesSettings(source=source, axes=axes, tool=tool), others


def _axis(name: str, table: Mapping[str, Any], source: str) -> AxisLimits | TiltLimits:
    if name not in LINEAR + TILTS:
        raise ReceiverError(f"{source}: axis.{name}: unknown axis, expected one of: {', '.join(LINEAR + TILTS)}")
    kind: type[AxisLimits | TiltLimits] = AxisLimits if name in LINEAR else TiltLimits
    return _named(kind, table, source, f"axis.{name}")


def _tool(tables: dict[str, Any], source: str) -> ToolLimits | None:
    table = tables.pop("tool", None)
    if table is None:
        return None
    if not isinstance(table, dict):
        raise ReceiverError(f"{source}: tool = {table!r:.60}: expected a table [tool]")
    return _named(ToolLimits, table, source, "tool")


def _named(kind: type[T], table: Mapping[str, Any], source: str, name: str) -> T:
    """Read a table whose limits check themselves, and know neither file nor table."""
    try:
        return read_table(kind, table, source=source, name=name)
    except ReceiverError as error:
        text = str(error)
        raise error if text.startswith(source) else ReceiverError(f"{source}: {name}.{text}") from error
