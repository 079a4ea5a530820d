"""All commands, grouped by user, with the place of each."""

from __future__ import annotations

import argparse
from typing import NamedTuple

from compensator.commands import arguments


class Command(NamedTuple):
    """A command; the function of the same name in `commands.arguments` adds its arguments.

    Parameters
    ----------
    name, text, example : str
        Its name, one line for the help, and an example.
    place : str
        Module and function that run it, as `MODULE:FUNCTION`; by default `run` in the module of the same name in
        `commands`. The module is imported when the command is called; the function takes the arguments and returns an
        `Answer`, or None if there is nothing to print.
    """

    name: str
    text: str
    example: str
    place: str = ""

    def describe(self, parser: argparse.ArgumentParser) -> None:
        """Add its arguments to a parser."""
        getattr(arguments, self.name)(parser)


#: The commands, grouped by user.
USERS = {
    "evaluation": (
        Command("demo", "run the whole loop on simulated hardware", "demo --out demo-out", "demo.command:run"),
    ),
    "calibration engineer": (
        Command("identify", "fit a model to measured runs", "identify run.csv --validate other.csv --out model.toml"),
        Command("simulate", "run a model over measured data", "simulate run.csv --model quill --out predicted.csv"),
        Command(
            "compare",
            "compare models on the same measured data",
            "compare run.csv --model model.toml --model diagnosis/model.toml --page comparison.html",
        ),
        Command(
            "diagnose",
            "find what a model lacks, from measured data",
            "diagnose day.mcap --model model.toml --out diagnosis",
        ),
        Command(
            "adopt",
            "switch the running service to another model without a jump",
            "adopt diagnosis/model.toml --config machine.toml",
            "commands.adopt:adopt",
        ),
        Command("back", "return to the previous model", "back --config machine.toml", "commands.adopt:back"),
        Command(
            "dismiss",
            "refuse the model that the service proposes",
            "dismiss --config machine.toml",
            "commands.adopt:dismiss",
        ),
        Command(
            "loop",
            "run diagnosis, comparison and adoption over a shop's recordings",
            "loop recordings/vmc-07 recordings/vmc-08 --page shop.html",
        ),
    ),
    "operator": (
        Command("watch", "show one machine or many, live", "watch --connect tcp/127.0.0.1:7447 --prefix shop"),
        Command("explain", "explain a state, reason or warning", "explain degraded"),
        Command("zero", "set the machine's present state as zero", "zero --config machine.toml", "commands.order:zero"),
        Command("hold", "freeze the offset", "hold --config machine.toml", "commands.order:hold"),
        Command(
            "resume",
            "let the offset follow the model again after hold",
            "resume --prefix shop/vmc-07 --zenoh operator.json5",
            "commands.order:resume",
        ),
        Command("report", "make a page from recordings or a folder of results", "report recordings/"),
    ),
    "CNC integrator": (
        Command(
            "bridge",
            "send the offset to a control over OPC UA, or probes to the service",
            "bridge opcua --config bridge.toml",
        ),
        Command("router", "run a Zenoh router where no zenohd is installed", "router --config router.json5"),
    ),
    "auditor": (
        Command(
            "replay",
            "audit recordings: detect changes, reproduce every sample",
            "replay recordings/*.mcap",
        ),
        Command("export", "export recordings as a table", "export day.mcap --out day.csv"),
    ),
    "commissioning": (
        Command("check", "validate a configuration without opening devices", "check --config machine.toml"),
        Command("probe", "read every device once", "probe --config machine.toml"),
        Command("run", "run the service", "run --config machine.toml"),
        Command("completion", "print a completion script for a shell", "completion bash"),
    ),
}
COMMANDS = tuple(command for commands in USERS.values() for command in commands)
