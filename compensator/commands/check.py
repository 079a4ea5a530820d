"""`compensator check`: validates a configuration and opens nothing."""

from __future__ import annotations

import argparse
import logging

from compensator.commands import Answer
from compensator.service.compensation import Compensation
from compensator.service.composition import load
from compensator.service.configuration_warnings import precautions

log = logging.getLogger("compensator")


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    CompensatorError
        Naming what is wrong with the configuration.
    """
    loaded, model, _, fleet = load(arguments.config)
    checks = Compensation(loaded.config, model).plausibility.describe()
    warnings = precautions(loaded)
    for warning in warnings:
        log.warning("%s: warning: %s", arguments.config, warning.marked)
    machine = loaded.config.machine.name
    text = (
        f"{arguments.config}: good. Machine {machine}, model {model.name} ({model.kind}), "
        f"{len(fleet.devices)} device(s), {len(loaded.config.channel)} channel(s). Nothing was opened.\n"
        f"plausibility: {checks}"
    )
    result = {
        "ok": True,
        "machine": machine,
        "model": model.name,
        "model_sha256": model.sha256,
        "devices": list(fleet.devices),
        "warnings": list(warnings),
        "warning_codes": [warning.code for warning in warnings],
        "checks": checks,
    }
    return Answer(result, text)
