"""`compensator check`: validate a configuration without opening devices or connections."""

from __future__ import annotations

import argparse

from compensator.commands import Answer, log_warnings, warnings_as_json
from compensator.service.compensation import Compensation
from compensator.service.loading import load


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    setup = load(arguments.config)
    config, model = setup.config, setup.model
    checks = Compensation(config, model).describe_checks()
    warnings = setup.warnings()
    log_warnings(arguments.config, warnings)
    machine, devices = config.machine.name, setup.fleet.devices
    text = (
        f"{arguments.config}: valid. Machine {machine}, model {model.name} ({model.kind}), "
        f"{len(devices)} device(s), {len(config.channel)} channel(s). Nothing was opened.\n"
        f"plausibility: {checks}"
    )
    if config.probe is not None:
        probe = config.probe
        tolerance = f"{probe.tolerance_um:g} µm" if probe.tolerance_um is not None else "none"
        text += (
            f"\nprobes: on, one value ±{probe.std_um:g} µm, at most {probe.measured_max_um:g} µm, correction at most "
            f"{probe.largest_um:g} µm, tolerance {tolerance}"
        )
    result = {
        "ok": True,
        "machine": machine,
        "model": model.name,
        "model_sha256": model.sha256,
        "devices": list(devices),
        **warnings_as_json(warnings),
        "checks": checks,
    }
    return Answer(result, text)
