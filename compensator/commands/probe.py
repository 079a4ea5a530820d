"""`compensator probe`: read every device once."""

from __future__ import annotations

import argparse
import asyncio
from typing import Any

from compensator.codes import Remark, ServiceWarning
from compensator.commands import Answer, log_warnings, warnings_as_json
from compensator.service.composition import read_once
from compensator.service.loading import load
from compensator.service.presence import is_used
from drivers.errors import DriverError
from drivers.reading import Quality


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command; the exit code is 1 if a channel gave no good reading."""
    setup = load(arguments.config)
    config, fleet = setup.config, setup.fleet
    warnings = []
    if is_used(setup.recordings, config.machine.name):
        figures = f"The service of {config.machine.name} is running and uses the devices."
        warnings.append(Remark(ServiceWarning.SERVICE_RUNS, figures))
    log_warnings(arguments.config, warnings)
    units = {name: dict(device.units) for name, device in fleet.devices.items()}
    answers = asyncio.run(read_once(fleet))
    rows: list[dict[str, Any]] = []
    for channel in config.channel:
        answer, unit = answers[channel.device], units[channel.device][channel.input]
        row = {"channel": channel.name, "device": channel.device, "input": channel.input, "value": None, "unit": unit}
        if isinstance(answer, DriverError):
            row |= {"quality": answer.code, "detail": str(answer)}
        else:
            reading = answer[channel.input]
            row |= {"quality": str(reading.quality), "detail": reading.detail}
            if reading.quality is Quality.GOOD:
                row["value"] = reading.value
        rows.append(row)
    good = all(row["quality"] == Quality.GOOD for row in rows)
    result = {"channels": rows, **warnings_as_json(warnings)}
    return Answer(result, "\n".join(_lines(rows)), 0 if good else 1)


def _lines(rows: list[dict[str, Any]]) -> list[str]:
    """Return a line for each channel; the error of a device stands in the line of its first channel only."""
    lines, devices = [], set()
    for row in rows:
        failed = row["quality"].startswith("device_")
        lines.append(_line(row | {"detail": "(as above)"} if failed and row["device"] in devices else row))
        devices.add(row["device"])
    return lines


def _line(row: dict[str, Any]) -> str:
    value = f"{row['value']:12.4f} {row['unit']:<5}" if row["value"] is not None else " " * 18
    return f"{row['channel']:<20} {row['device']:<16} {row['input']:>3}  {value} {row['quality']} {row['detail']}"
