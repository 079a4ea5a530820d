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
    """A command.

    Parameters
    ----------
    name, text, example : str
        What stands in the help.
    describe : callable
        Adds its arguments to a parser.
    run : str
        Module and function that do it, loaded when it is called; the function takes the arguments and returns an
        `Answer`, or None where there is nothing to print.
    """

    name: str
    text: str
    example: str
    describe: Callable[[argparse.ArgumentParser], None]
    run: str


COMMANDS = (
    Command(
        "demo",
        "the whole loop on simulated hardware",
        "demo --out demo-out",
        arguments.demo,
        "compensator.demo.command:run",
    ),
    Command("run", "the service", "run --config machine.toml", arguments.of_service, "compensator.commands.run:run"),
    Command(
        "check",
        "validate a configuration; opens nothing",
        "check --config machine.toml",
        arguments.of_service,
        "compensator.commands.check:run",
    ),
    Command(
        "probe",
        "one reading of every device",
        "probe --config machine.toml",
        arguments.of_service,
        "compensator.commands.probe:run",
    ),
    Command(
        "simulate",
        "run a model over measured data",
        "simulate run.csv --model quill --out predicted.csv",
        arguments.simulate,
        "compensator.commands.simulate:run",
    ),
    Command(
        "identify",
        "a model from measured runs",
        "identify run.csv --validate other.csv --out model.toml",
        arguments.identify,
        "compensator.commands.identify:run",
    ),
    Command(
        "diagnose",
        "what a model lacks, from measured data",
        "diagnose day.mcap --model model.toml --out diagnosis",
        arguments.diagnose,
        "compensator.commands.diagnose:run",
    ),
    Command(
        "replay",
        "audit recordings: nothing changed, all comes out again",
        "replay recordings/*.mcap",
        arguments.replay,
        "compensator.commands.replay:run",
    ),
    Command(
        "report",
        "a page for people: of recordings, or of a folder with results",
        "report recordings/",
        arguments.report,
        "compensator.commands.report:run",
    ),
    Command(
        "adopt",
        "the running service takes a model over without a jump",
        "adopt diagnosis/model.toml --config machine.toml",
        arguments.adopt,
        "compensator.commands.adopt:adopt",
    ),
    Command(
        "back",
        "the service returns to the model before",
        "back --config machine.toml",
        arguments.back,
        "compensator.commands.adopt:back",
    ),
    Command(
        "zero",
        "the service takes the machine's state for zero",
        "zero --config machine.toml",
        arguments.zero,
        "compensator.commands.order:zero",
    ),
    Command(
        "hold",
        "the service freezes the offset",
        "hold --config machine.toml",
        arguments.order,
        "compensator.commands.order:hold",
    ),
    Command(
        "resume",
        "the service goes on after hold",
        "resume --prefix shop/vmc-07 --zenoh operator.json5",
        arguments.order,
        "compensator.commands.order:resume",
    ),
    Command(
        "router",
        "a Zenoh router, where no zenohd is installed",
        "router --config router.json5",
        arguments.router,
        "compensator.commands.router:run",
    ),
    Command(
        "watch",
        "live view of one machine or many",
        "watch --connect tcp/127.0.0.1:7447 --prefix shop",
        arguments.watch,
        "compensator.commands.watch:run",
    ),
    Command(
        "export",
        "recordings as a table",
        "export day.mcap --out day.csv",
        arguments.export,
        "compensator.commands.export:run",
    ),
    Command(
        "bridge",
        "the offset to a control that speaks OPC UA",
        "bridge opcua --config bridge.toml",
        arguments.bridge,
        "compensator.commands.bridge:run",
    ),
    Command(
        "explain",
        "a state, reason or warning in words",
        "explain degraded",
        arguments.explain,
        "compensator.commands.explain:run",
    ),
)


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
    """Return what does a command."""
    module, _, function = command.run.partition(":")
    loaded: Callable[[argparse.Namespace], Answer | None] = getattr(importlib.import_module(module), function)
    return loaded


def _in_words(error: Exception) -> str:
    """Say what went wrong in one line: "FILE: No such file or directory", not "[Errno 2] …"."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename2 or error.filename}: {error.strerror or error}"
    return str(error)


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong, as everything else does, and where the rest stands."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; `{self.prog} --help` has all options\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="compensator",
        description="Thermal error compensation for machine tools.",
        epilog="example: compensator demo --out demo-out",
    )
    parser.add_argument("--version", action="version", version=__version__)
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        one = subparsers.add_parser(
            command.name, help=command.text, description=command.text, epilog=f"example: compensator {command.example}"
        )
        one.set_defaults(command=command)
        one.add_argument("--debug", action="store_true", help="show where an error comes from")
        one.add_argument("--json", action="store_true", help="print the result as JSON")
        command.describe(one)
    return parser
