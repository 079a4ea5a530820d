"""`compensator check`: validates a configuration and opens nothing."""

from __future__ import annotations

import argparse
import logging

from compensator.commands import Answer
from compensator.service.compensation import Compensation
from compensator.service.loading import load

log = logging.getLogger("compensator")


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    CompensatorError
        Naming what is wrong with the configuration.
    """
    setup = load(arguments.config)
    config, model = setup.config, setup.model
    checks = Compensation(config, model).plausibility.describe()
    warnings = setup.warnings()
    for warning in warnings:
        log.warning("%s: warning: %s", arguments.config, warning.marked)
    machine, devices = config.machine.name, setup.fleet.devices
    text = (
        f"{arguments.config}: good. Machine {machine}, model {model.name} ({model.kind}), "
        f"{len(devices)} device(s), {len(config.channel)} channel(s). Nothing was opened.\n"
        f"plausibility: {checks}"
    )
    result = {
        "ok": True,
        "machine": machine,
        "model": model.name,
        "model_sha256": model.sha256,
        "devices": list(devices),
        "warnings": list(warnings),
        "warning_codes": [warning.code for warning in warnings],
        "checks": checks,
    }
    return Answer(result, text)
