"""`compensator zero`, `hold` and `resume`: an operator's commands to the running service."""

from __future__ import annotations

import argparse
import json
from typing import Any

from compensator.commands import Answer
from compensator.config import load_config, zenoh_below
from compensator.errors import ServiceError, UsageError
from compensator.events import CommandName
from compensator.service.command_client import Operator, ask, operator_of_file


def zero(arguments: argparse.Namespace) -> Answer:
    """Set the machine's present state as zero."""
    return _order(CommandName.ZERO, {"mode": arguments.mode}, arguments)


def hold(arguments: argparse.Namespace) -> Answer:
    """Freeze the offset."""
    return _order(CommandName.HOLD, {}, arguments)


def resume(arguments: argparse.Namespace) -> Answer:
    """Let the offset follow the model again."""
    return _order(CommandName.RESUME, {}, arguments)


def _order(name: str, payload: dict[str, Any], arguments: argparse.Namespace) -> Answer:
    """Send a command.

    Raises
    ------
    CompensatorError
        If the service is not reached, does not answer or refuses.
    """
    operator = operator_of(arguments)
    if (arguments.config is None) == (arguments.prefix is None):
        raise UsageError("expected either --config FILE, or --prefix PREFIX with --zenoh FILE")
    if arguments.config is not None:
        settings = load_config(arguments.config).config.zenoh
    elif operator is None:
        raise UsageError("--zenoh: required with --prefix, expected a Zenoh configuration such as operator.json5")
    else:
        settings = zenoh_below(arguments.prefix)
    return answered(ask(settings, name, json.dumps(payload).encode(), timeout_s=arguments.timeout, operator=operator))


def operator_of(arguments: argparse.Namespace) -> Operator | None:
    """Return the operator of `--zenoh`; None without it."""
    return operator_of_file(arguments.zenoh) if arguments.zenoh is not None else None


def answered(reply: dict[str, Any], **more: Any) -> Answer:
    """Return the service's reply, with more for `--json`; raise an error if it refused."""
    if not reply.get("ok"):
        raise ServiceError(f"the service refused: {reply.get('text', 'no reason given')}", {**reply, **more})
    return Answer({**reply, **more}, str(reply.get("text", "")))
