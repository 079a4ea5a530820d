"""`[axis.*]` of the configuration: axes, tilts and slopes of a machine that has more than Y.

A file without these tables is of a machine with Y alone, whose limits are in `[limits]`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from compensator.axes import AXES, FIRST, NAME
from compensator.config_types import Micrometres, MicrometresPerMin, Table
from compensator.errors import ConfigError

#: Axes that tilt, about X and about Y, and where their deformation at the tool acts.
TILTS: Mapping[str, str] = {"a": "y", "b": "x"}

#: From the smallest to the largest that a machine can have.
Microradians = Annotated[float, Meta(ge=0.001, le=5000)]
MicroradiansPerMin = Annotated[float, Meta(ge=0.001, le=1000)]
MicrometresPerM = Annotated[float, Meta(ge=0.001, le=5000)]
MicrometresPerMPerMin = Annotated[float, Meta(ge=0.001, le=1000)]
Distance = Annotated[float, Meta(ge=1, le=20_000)]
#: Of an axis' position, or of a tool.
Position = Annotated[float, Meta(ge=-50_000, le=50_000)]
Part = Annotated[str, Meta(pattern=rf"^{NAME.pattern}\Z")]


class Slope(Table, frozen=True, kw_only=True):
    """`[axis.y.slope]`: the offset changes with the position of the axis, by a further part of the model in µm/m.

    `part`: its name in the model file, by default that of the axis with `_slope`. `reference_mm`: the position at which
    the offset of the axis holds.
    """

    slope_max_um_per_m: MicrometresPerM
    slope_rate_max_um_per_m_per_min: MicrometresPerMPerMin
    reference_mm: Position
    part: Part | None = None

    def part_of(self, axis: str) -> str:
        """Return the name of its part in the model, from that of its axis' part."""
        return self.part or f"{axis}_slope"


class Axis(Table, frozen=True, kw_only=True):
    """`[axis.z]`: limits of an axis' offset.

    `sign`: −1 where the deformation was calibrated against the sense of the control's axis. `part`: name of its part in
    the model file, by default its own.
    """

    offset_max_um: Micrometres
    offset_rate_max_um_per_min: MicrometresPerMin
    sign: Literal[-1, 1] = 1
    part: Part | None = None
    slope: Slope | None = None

    def part_of(self, name: str) -> str:
        """Return the name of its part in the model, from that of the axis."""
        return self.part or name


class Tilt(Table, frozen=True, kw_only=True):
    """`[axis.a]`: an angle, from two parts of the model at two heights.

    a = (upper − lower) / distance. `probes`: names of the two parts, the lower one first. `acts_on`: the axis whose
    offset changes with the length of the tool, by default Y for `a` and X for `b`. `reference_mm`: length of the tool
    for which the offset of that axis holds. `sign`: as of an axis.
    """

    probes: tuple[Part, Part]
    distance_mm: Distance
    reference_mm: Position
    offset_max_urad: Microradians
    offset_rate_max_urad_per_min: MicroradiansPerMin
    acts_on: Literal["x", "y", "z"] | None = None
    sign: Literal[-1, 1] = 1


class Axes(Table, frozen=True, kw_only=True):
    """`[axis.*]`: the axes of a machine; Y is one of them."""

    y: Axis
    x: Axis | None = None
    z: Axis | None = None
    a: Tilt | None = None
    b: Tilt | None = None

    def linear(self) -> dict[str, Axis]:
        """Return the axes X, Y and Z that there are, by name."""
        found = {name: getattr(self, name) for name in AXES}
        return {name: axis for name, axis in found.items() if axis is not None}

    def tilts(self) -> dict[str, Tilt]:
        """Return the tilts that there are, by name."""
        found = {name: getattr(self, name) for name in TILTS}
        return {name: tilt for name, tilt in found.items() if tilt is not None}

    def names(self) -> tuple[str, ...]:
        """Return the names of all axes, each of which has a message with every sample."""
        return (*self.linear(), *self.tilts())


class _AxisTables(msgspec.Struct, frozen=True, kw_only=True):
    """What of a file is checked before the limits of Y are taken from it."""

    axis: Axes


_LIMITS = ("offset_max_um", "offset_rate_max_um_per_min")


def with_limits_of_y(table: dict[str, Any]) -> dict[str, Any]:
    """Return the tables of a file with the limits of Y in `limits`, where all that knows Y alone finds them.

    Raises
    ------
    ConfigError
        If the limits are given twice, or Y is missing.
    msgspec.ValidationError
        If the tables of the axes are wrong.
    """
    limits = table.get("limits")
    if "axis" not in table or not isinstance(limits, dict):
        return table
    if isinstance(table["axis"], dict) and FIRST not in table["axis"]:
        raise ConfigError(
            f"axis.{FIRST}: missing; zero, checks and probes of the machine are those of Y, so several axes have it "
            "among them: add [axis.y]. Where a single axis is corrected there is no [axis.*]: that axis is called Y "
            "(y_um, [limits]), and the receiver's program applies the offset to it"
        )
    axes = msgspec.convert({"axis": table["axis"]}, _AxisTables).axis
    for key in _LIMITS:
        if key in limits:
            raise ConfigError(f"limits.{key} = {limits[key]!r}: expected in axis.{FIRST}, for the file has [axis.*]")
    return {**table, "limits": {**limits, **{key: getattr(axes.y, key) for key in _LIMITS}}}


def check_axes(axes: Axes, *, loop: bool) -> None:
    """Check what several tables say together.

    Parameters
    ----------
    axes : Axes
        The tables.
    loop : bool
        Whether the service looks for better models.

    Raises
    ------
    ConfigError
        Naming table, key, value and what was expected.
    """
    if axes.y.sign != 1:
        raise ConfigError("axis.y.sign = -1: expected 1, for y_um is a displacement in +Y")
    taken: dict[str, str] = {}
    for name, axis in axes.linear().items():
        parts = {f"axis.{name}": axis.part_of(name)}
        if axis.slope is not None:
            parts[f"axis.{name}.slope"] = axis.slope.part_of(axis.part_of(name))
        for key, part in parts.items():
            if part in taken:
                raise ConfigError(f"{key}.part = {part!r}: expected a part of its own, {taken[part]} has this one")
            taken[part] = key
    for name, tilt in axes.tilts().items():
        acts_on = tilt.acts_on or TILTS[name]
        if acts_on not in axes.linear():
            raise ConfigError(f"axis.{name}: acts on {acts_on!r}, expected one of: {', '.join(axes.linear())}")
        if tilt.probes[0] == tilt.probes[1]:
            raise ConfigError(f"axis.{name}.probes = {list(tilt.probes)}: expected two parts of the model")
    acting = [tilt.acts_on or TILTS[name] for name, tilt in axes.tilts().items()]
    if len(set(acting)) != len(acting):
        raise ConfigError(f"axis.a, axis.b: both act on {acting[0]!r}, expected one axis each")
    if loop:
        raise ConfigError("loop.policy: expected 'off' with [axis.*]: candidates are compared on Y alone")
