"""The command line: `compensator COMMAND …`.

Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 failed, 2 wrong usage, configuration or
data, 3 an audit found a difference.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import io
import json
import logging
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from compensator import __version__
from compensator.blas import one_thread_from_start
from compensator.commands import Answer
from compensator.commands.catalog import COMMANDS, USERS, Command
from compensator.commands.outputs import check_outputs, takes_stdout
from compensator.commands.stopping import stoppable, was_interrupted
from compensator.commands.wrapping import styled, wrapped
from compensator.errors import CompensatorError, in_words, one_line
from drivers.errors import DriverError

log = logging.getLogger("compensator")

#: Longest line of an error, characters; several files are named in one of them at times.
LONGEST_LINE = 4000


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; by default those of `sys.argv`.
    """
    _have_streams()
    try:
        stoppable()
    except KeyboardInterrupt:  # it waited
        return 130
    one_thread_from_start()
    given, unknown = _parser().parse_known_args(argv)
    if unknown:
        # argparse itself would name the help of the whole program.
        given.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    logging.basicConfig(stream=sys.stderr, format="%(message)s", force=True)
    log.setLevel(logging.INFO)  # what libraries tell is of no use to an operator, what they warn of is
    try:
        check_outputs(given)
        is_taken = takes_stdout(given)
        answer = load(given.command)(given)
    except (CompensatorError, DriverError, OSError) as error:
        if given.debug:
            raise
        log.error("compensator: %s", shortened(one_line(in_words(error))))
        result = getattr(error, "result", None)
        code = getattr(error, "exit_code", 1)
        return _printed(json.dumps(result), code) if given.json and result is not None else code
    except KeyboardInterrupt:
        return 130
    except ImportError:  # so a compiled module answers to an interrupt
        if was_interrupted():
            return 130
        raise
    if was_interrupted():
        return 130
    if answer is None:
        return 0
    text = json.dumps(answer.result) if given.json else answer.text
    if is_taken:
        log.info("%s", text)
        return answer.code
    return _printed(text, answer.code, for_people=not given.json)


def _have_streams() -> None:
    """Open the standard streams that are closed, and let the others write every character.

    Else a file that is opened, such as a recording, would get the number of one, and what a library writes to it.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115  it stays open
        elif isinstance(stream, io.TextIOWrapper) and mode == "w":
            stream.reconfigure(errors="backslashreplace")


def _printed(text: str, code: int, *, for_people: bool = False) -> int:
    """Print a result and return the exit code; that of a failure instead of 0 if it could not be written."""
    try:
        if for_people and sys.stdout.isatty():
            _show(wrapped(text, shutil.get_terminal_size().columns))
        else:
            sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
    except OSError as error:
        log.error("compensator: standard output: %s", error.strerror or error)
        # What it holds is written again when Python ends.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        return code or 1
    return code


def _show(text: str) -> None:
    """Print a result on a terminal."""
    from rich.console import Console

    Console(file=sys.stdout).print(styled(text), soft_wrap=True)


def load(command: Command) -> Callable[[argparse.Namespace], Answer | None]:
    """Import a command's module and return the function that runs it."""
    module, _, function = (command.place or f"commands.{command.name}:run").partition(":")
    loaded: Callable[[argparse.Namespace], Answer | None]
    loaded = getattr(importlib.import_module(f"compensator.{module}"), function)
    return loaded


def shortened(line: str) -> str:
    """Return a line without the middle of what is longer than any error needs, such as a file's key that it cites."""
    return line if len(line) <= LONGEST_LINE else f"{line[: LONGEST_LINE // 2]} … {line[-LONGEST_LINE // 2 :]}"


def _did_you_mean(word: str, names: Sequence[str]) -> str:
    """Return a question for the names that are like a word; empty if there are none."""
    near = difflib.get_close_matches(word.partition("=")[0].lower(), names, n=2)
    return f"; did you mean {' or '.join(near)}?" if near else ""


class _Once(argparse._StoreAction):
    """Stores the value of an option, which may be given once: of two machines' files one would silently be left out."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Store it."""
        if option_string is not None and self.dest in parser.given:
            parser.error(f"argument {'/'.join(self.option_strings)}: given twice, expected once")
        parser.given.add(self.dest)
        super().__call__(parser, namespace, values, option_string)


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports wrong usage in one line, like every other error."""

    _words: Sequence[str] = ()

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.register("action", None, _Once)
        #: Options that were given so far.
        self.given: set[str] = set()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Keep the words, so that an error can name an option that was mistyped."""
        self._words = sys.argv[1:] if args is None else args
        self.given.clear()
        return super().parse_known_args(args, namespace)

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print help or version; argparse itself would end with 0 where they could not be written."""
        if file is not sys.stdout:
            super()._print_message(message, file)
        elif code := _printed(message.removesuffix("\n"), 0):
            self.exit(code)

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        wrong = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        if wrong is not None and (near := _did_you_mean(wrong[1], re.findall(r"[^', ]+", wrong[2]))):
            message = f"{message[: wrong.start()]}{wrong[1]!r} is unknown{near}"
        missing = re.search(r"arguments are required: (.*)", message)
        for action in self._actions if missing else ():
            if action.choices is not None and action.dest in message.replace(",", "").split():
                message = message.replace(action.dest, f"{action.dest} (one of {', '.join(map(str, action.choices))})")
        options = [name for action in self._actions for name in action.option_strings]
        for word in self._words:
            name = word.partition("=")[0]
            if name.startswith("--") and not any(option.startswith(name) for option in options):
                message += _did_you_mean(name, options)
        self.exit(2, f"{self.prog}: {message}; `{self.prog} --help` lists all options\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="compensator",
        usage="compensator [-h] [--version] COMMAND ...",
        description=f"quill-compensator: thermal error compensation for machine tools.\n\n{_overview()}",
        epilog="`compensator COMMAND --help` shows options and an example.\nexample: compensator demo --out demo-out",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=__version__)
    # The overview lists the commands: argparse cannot group them.
    subparsers = parser.add_subparsers(prog="compensator", required=True, metavar="COMMAND", help=argparse.SUPPRESS)
    for command in COMMANDS:
        one = subparsers.add_parser(
            command.name, description=command.text, epilog=f"example: compensator {command.example}"
        )
        one.set_defaults(command=command, parser=one)
        one.add_argument("--debug", action="store_true", help="show where an error comes from")
        one.add_argument("--json", action="store_true", help="print the result as JSON")
        command.describe(one)
    return parser


def _overview() -> str:
    """Return the commands grouped by user, one line each where the terminal is wide enough."""
    wide = shutil.get_terminal_size().columns

    def line(command: Command) -> str:
        return textwrap.fill(f"  {command.name:<10} {command.text}", wide, subsequent_indent=" " * 13)

    groups = (f"{user}:\n" + "\n".join(map(line, commands)) for user, commands in USERS.items())
    return "\n\n".join(groups)
