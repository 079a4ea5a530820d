"""`compensator check`: validates a configuration and opens nothing."""

from __future__ import annotations

import argparse

from compensator.commands import Answer
from compensator.service.compensation import Compensation
from compensator.service.composition import load


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    CompensatorError
        Naming what is wrong with the configuration.
    """
    loaded, model, _, fleet = load(arguments.config)
    Compensation(loaded.config, model)
    machine = loaded.config.machine.name
    text = (
        f"{arguments.config}: good. Machine {machine}, model {model.name} ({model.kind}), "
        f"{len(fleet.devices)} device(s), {len(loaded.config.channel)} channel(s). Nothing was opened."
    )
    result = {"ok": True, "machine": machine, "model": model.name, "model_sha256": model.sha256,
              "devices": list(fleet.devices)}  # fmt: skip
    return Answer(result, text)
