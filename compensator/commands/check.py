"""`compensator check`: validate a configuration without opening devices or connections."""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

from compensator.axes import FIRST
from compensator.channel_lines import channel_lines
from compensator.commands import Answer, log, log_warnings, warnings_as_json
from compensator.model.model_file import parse_axes, read_model_bytes
from compensator.service.compensation import Compensation, model_of
from compensator.service.loading import Setup, load
from compensator.service.transfer.model_store import check_model


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    setup = load(arguments.config)
    if arguments.model is not None:
        data = read_model_bytes(arguments.model)
        model = model_of(setup.config, data, source=arguments.model)
        setup = dataclasses.replace(setup, model=model, model_bytes=data)
    config, model = setup.config, setup.model
    configured = {channel.name for channel in config.channel}
    if missing := [name for name in model.channels if name not in configured]:
        return _without_channels(arguments.config, model.name, missing)
    checks = Compensation(config, model).describe_checks()
    if arguments.model is not None:
        check_model(config, setup.model_bytes, source=arguments.model)
    warnings = setup.warnings()
    log_warnings(arguments.config, warnings)
    machine, devices = config.machine.name, setup.fleet.devices
    text = (
        f"{arguments.config}: valid. Machine {machine}, model {model.name} ({model.kind}), "
        f"{len(devices)} device(s), {len(config.channel)} channel(s). Nothing was opened.\n"
        f"plausibility: {checks}"
    )
    axes = _axes(setup)
    text += _axes_text(axes)
    if config.probe is not None:
        probe = config.probe
        tolerance = f"{probe.tolerance_um:g} µm" if probe.tolerance_um is not None else "none"
        text += (
            f"\nprobes: on, one value ±{probe.std_um:g} µm, at most {probe.measured_max_um:g} µm, correction at most "
            f"{probe.largest_um:g} µm, tolerance {tolerance}"
        )
    if config.loop is not None:
        loop = config.loop
        when = f", a diagnosis at {loop.at_utc} UTC and every {loop.every_h} h" if loop.is_on else " (loop.policy)"
        text += f"\nloop: {loop.policy}{when}"
    result = {
        "ok": True,
        "machine": machine,
        "model": model.name,
        "model_sha256": model.sha256,
        "devices": list(devices),
        **warnings_as_json(warnings),
        "checks": checks,
        **axes,
    }
    return Answer(result, text)


def _axes(setup: Setup) -> dict[str, Any]:
    """Return the axes of a machine and the parts of the model that none of them uses; nothing where all is Y alone."""
    used = {setup.model.axis, *(part.axis for part in setup.model.parts)}
    unused = [name for name in parse_axes(setup.model_bytes, source="model") if name not in used]
    if setup.config.axis is None:
        return {"axes": [FIRST], "unused_parts": unused} if unused else {}
    turned = [name for name, axis in setup.config.axis.linear().items() if axis.sign != 1]
    found = {"axes": list(setup.config.axis.names()), "unused_parts": unused}
    return {**found, "turned": turned} if turned else found


def _axes_text(axes: dict[str, Any]) -> str:
    if not axes:
        return ""
    text = f"\naxes: {', '.join(axes['axes'])}"
    if turned := axes.get("turned"):
        text += f"; sign = -1 of {', '.join(turned)}: the published offset is turned, so no receiver turns it again"
    if axes["unused_parts"]:
        text += f"; the model also has {', '.join(axes['unused_parts'])}, for which there is no table [axis.*]"
    if len(axes["axes"]) > 1:
        text += "\nof Y alone: probes, and the checks of measured against predicted deformation"
    return text


def _without_channels(path: str, model: str, missing: list[str]) -> Answer:
    """Return the lines to paste for the channels that a model needs and the configuration lacks."""
    words = f"{path}: model {model} needs channel {' and '.join(missing)}, which is not configured"
    log.error("compensator: %s", words)
    lines = channel_lines(missing)
    result = {"ok": False, "model": model, "missing_channels": missing, "lines": lines}
    return Answer(result, f"# Paste into {path}; name device and input of the sensor.\n{lines}", 2)
