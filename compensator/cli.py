"""The command line: `compensator COMMAND …`.

Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 failed, 2 wrong usage, configuration or
data, 3 an audit found a difference.
"""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple, NoReturn

from compensator import __version__
from compensator.blas import one_thread_from_start
from compensator.commands import Answer, arguments
from compensator.errors import CompensatorError
from drivers.errors import DriverError

log = logging.getLogger("compensator")


class Command(NamedTuple):
    """A command; its arguments are described by the function of its name in `commands.arguments`.

    Parameters
    ----------
    name, text, example : str
        Its name, one line for the help, and an example.
    place : str
        Module of the package, and function, that run it; by default `run` in the module of its name in `commands`.
        The module is loaded when the command is called; the function takes the arguments and returns an `Answer`, or
        None where there is nothing to print.
    """

    name: str
    text: str
    example: str
    place: str = ""

    def describe(self, parser: argparse.ArgumentParser) -> None:
        """Add its arguments to a parser."""
        getattr(arguments, self.name)(parser)


#: The commands by the user who needs them.
USERS = {
    "to try it": (Command("demo", "the whole loop on simulated hardware", "demo --out demo-out", "demo.command:run"),),
    "calibration engineer": (
        Command("identify", "a model from measured runs", "identify run.csv --validate other.csv --out model.toml"),
        Command("simulate", "run a model over measured data", "simulate run.csv --model quill --out predicted.csv"),
        Command(
            "diagnose",
            "what a model lacks, from measured data",
            "diagnose day.mcap --model model.toml --out diagnosis",
        ),
        Command(
            "adopt",
            "bring another model into the running service, without a jump",
            "adopt diagnosis/model.toml --config machine.toml",
            "commands.adopt:adopt",
        ),
        Command("back", "return to the model before", "back --config machine.toml", "commands.adopt:back"),
    ),
    "operator": (
        Command("watch", "live view of one machine or many", "watch --connect tcp/127.0.0.1:7447 --prefix shop"),
        Command("explain", "a state, reason or warning in words", "explain degraded"),
        Command("zero", "set the machine's present state as zero", "zero --config machine.toml", "commands.order:zero"),
        Command("hold", "freeze the offset", "hold --config machine.toml", "commands.order:hold"),
        Command(
            "resume",
            "let the offset follow again after hold",
            "resume --prefix shop/vmc-07 --zenoh operator.json5",
            "commands.order:resume",
        ),
        Command("report", "a page of recordings, or of a folder with results", "report recordings/"),
    ),
    "CNC integrator": (
        Command("bridge", "write the offset to a control that speaks OPC UA", "bridge opcua --config bridge.toml"),
        Command("router", "a Zenoh router, where no zenohd is installed", "router --config router.json5"),
    ),
    "auditor": (
        Command(
            "replay",
            "audit recordings: nothing was changed, every sample is reproduced",
            "replay recordings/*.mcap",
        ),
        Command("export", "recordings as a table", "export day.mcap --out day.csv"),
    ),
    "at the machine": (
        Command("check", "validate a configuration; opens nothing", "check --config machine.toml"),
        Command("probe", "one reading of every device", "probe --config machine.toml"),
        Command("run", "the service", "run --config machine.toml"),
    ),
}
COMMANDS = tuple(command for commands in USERS.values() for command in commands)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; `sys.argv` where none are given.
    """
    one_thread_from_start()
    given = _parser().parse_args(argv)
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s", force=True)
    try:
        answer = load(given.command)(given)
    except (CompensatorError, DriverError, OSError) as error:
        if given.debug:
            raise
        log.error("compensator: %s", _in_words(error))
        return getattr(error, "exit_code", 1)
    except KeyboardInterrupt:
        return 130
    if answer is None:
        return 0
    sys.stdout.write((json.dumps(answer.result) if given.json else answer.text) + "\n")
    return answer.code


def load(command: Command) -> Callable[[argparse.Namespace], Answer | None]:
    """Import a command's module and return the function that runs it."""
    module, _, function = (command.place or f"commands.{command.name}:run").partition(":")
    loaded: Callable[[argparse.Namespace], Answer | None]
    loaded = getattr(importlib.import_module(f"compensator.{module}"), function)
    return loaded


def _in_words(error: Exception) -> str:
    """Return an error as one line: "FILE: No such file or directory", not "[Errno 2] …"."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename2 or error.filename}: {error.strerror or error}"
    return str(error)


class _Parser(argparse.ArgumentParser):
    """Reports wrong usage in one line, like every other error, and where the options are listed."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; `{self.prog} --help` has all options\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="compensator",
        usage="compensator [-h] [--version] COMMAND ...",
        description=f"Thermal error compensation for machine tools.\n\n{_overview()}",
        epilog="`compensator COMMAND --help` has its options and an example.\nexample: compensator demo --out demo-out",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=__version__)
    # The overview lists the commands: argparse cannot group them.
    subparsers = parser.add_subparsers(prog="compensator", required=True, metavar="COMMAND", help=argparse.SUPPRESS)
    for command in COMMANDS:
        one = subparsers.add_parser(
            command.name, description=command.text, epilog=f"example: compensator {command.example}"
        )
        one.set_defaults(command=command)
        one.add_argument("--debug", action="store_true", help="show where an error comes from")
        one.add_argument("--json", action="store_true", help="print the result as JSON")
        command.describe(one)
    return parser


def _overview() -> str:
    """Return the commands by user, one line each."""
    groups = (
        f"{user}:\n" + "\n".join(f"  {command.name:<10} {command.text}" for command in commands)
        for user, commands in USERS.items()
    )
    return "\n\n".join(groups)
