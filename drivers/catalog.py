"""Builds the devices of a configuration: the catalogue of all models, `build`, and `Fleet`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from drivers.errors import DriverConfigError
from drivers.families import adam, capancdt, dcon, icpdas, modbus_map, moxa
from drivers.families.base import DeviceSettings, Family, Line
from drivers.lines.capancdt_link import CapancdtLink
from drivers.lines.dcon_line import DconLine
from drivers.lines.modbus_line import ModbusLine
from drivers.lines.settings import CapancdtLine, LineSettings, SerialLine, line_settings
from drivers.reading import Device
from drivers.settings import Where, one_of, settings

MODELS: Mapping[str, Family] = {
    **icpdas.MODELS,
    **adam.MODELS,
    **moxa.MODELS,
    **modbus_map.MODELS,
    **dcon.MODELS,
    **capancdt.MODELS,
}


class Fleet:
    """All devices of a configuration.

    Parameters
    ----------
    devices : Mapping
        Devices by name, in the order of the configuration.
    """

    def __init__(self, devices: Mapping[str, Device]) -> None:
        self.devices: dict[str, Device] = dict(devices)

    async def close(self) -> None:
        """Close every device and with it every line. May be called twice."""
        for device in self.devices.values():
            await device.close()


def build(lines: Sequence[Mapping[str, object]], devices: Sequence[Mapping[str, object]], *, source: str) -> Fleet:
    """Make the devices of a configuration without opening them.

    Parameters
    ----------
    lines : sequence of Mapping
        The `[[line]]` tables.
    devices : sequence of Mapping
        The `[[device]]` tables.
    source : str
        Name of the file, at the start of each message.

    Raises
    ------
    DriverConfigError
        If a table is wrong; the message names table, key, value and what was expected.
    """
    known = _lines(lines, source)
    made: dict[str, Line] = {}
    fleet: dict[str, Device] = {}
    taken: dict[tuple[str, object], str] = {}
    for index, table in enumerate(devices):
        where = _where(table, index, "devices", source)
        family = _family(table, where)
        config = settings(table, family.kind, where)
        if config.name in fleet:
            raise where.wrong("name", config.name, "a name that no other device has")
        line_config = _line_of(config, family, known, where)
        # A controller with its own line has no address: a second one on that line collides, too.
        address = getattr(config, "address", None)
        other = taken.setdefault((config.line, address), config.name)
        if other != config.name:
            spot = f"line {config.line!r}" if address is None else f"address {address} on line {config.line!r}"
            raise where.error(f"{spot} is used by {other!r} and by {config.name!r}")
        if config.line not in made:
            made[config.line] = _new_line(line_config)
        fleet[config.name] = family.make(config, made[config.line], where)
    return Fleet(fleet)


def _lines(tables: Sequence[Mapping[str, object]], source: str) -> dict[str, LineSettings]:
    """Convert the lines; each has its own name and its own port."""
    lines: dict[str, LineSettings] = {}
    taken: dict[str, str] = {}
    for index, table in enumerate(tables):
        where = _where(table, index, "lines", source)
        config = line_settings(_table(table, where), where)
        if config.name in lines:
            raise where.wrong("name", config.name, "a name that no other line has")
        for end in config.endpoints():
            if end in taken:
                raise where.error(f"{end} is on line {taken[end]!r} and on line {config.name!r}, expected one line")
            taken[end] = config.name
        lines[config.name] = config
    return lines


def _where(table: object, index: int, tables: str, source: str) -> Where:
    """Identify a table by its position and its name, if it has one."""
    name = table.get("name") if isinstance(table, Mapping) else None
    return Where(
        source=source, table=f"{tables}[{index}]" + (f' "{_in_one_line(name)}"' if isinstance(name, str) else "")
    )


def _in_one_line(text: str) -> str:
    """Escape line breaks, which TOML allows in a name."""
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


def _table(table: object, where: Where) -> Mapping[str, object]:
    """Return a table; raise an error if it is not one."""
    if not isinstance(table, Mapping):
        raise where.error(f"is {table!r}, expected a table")
    return table


def _family(given: object, where: Where) -> Family:
    """Find the family of a device table."""
    table = _table(given, where)
    if "model" not in table:
        raise where.error(f"key 'model' is missing, expected {one_of(tuple(MODELS))}")
    model = table["model"]
    if not isinstance(model, str) or model not in MODELS:
        raise where.wrong("model", model, one_of(tuple(MODELS)))
    return MODELS[model]


def _line_of(config: DeviceSettings, family: Family, known: Mapping[str, LineSettings], where: Where) -> LineSettings:
    """Find the line of a device, and check that its model supports the protocol."""
    if config.line not in known:
        names = _in_one_line(", ".join(known)) or "none configured"
        raise where.wrong("line", config.line, f"the name of a line ({names})")
    line = known[config.line]
    if line.protocol not in family.protocols:
        expected = f"a line with protocol {' or '.join(family.protocols)} for {config.model}"
        raise where.error(f"key 'line' is {config.line!r} with protocol {line.protocol!r}, expected {expected}")
    return line


def _new_line(config: LineSettings) -> Line:
    """Make a line; it opens with its first request."""
    if isinstance(config, CapancdtLine):
        return CapancdtLink(config)
    if isinstance(config, SerialLine) and config.protocol == "dcon":
        return DconLine(config)
    return ModbusLine(config)


__all__ = ["MODELS", "DriverConfigError", "Fleet", "build"]
