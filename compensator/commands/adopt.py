"""`compensator adopt` and `back`: another model for the service, running or not."""

from __future__ import annotations

import argparse
import json
from typing import Any

from compensator.clock import SystemClock
from compensator.commands import Answer
from compensator.config import LoadedConfig
from compensator.errors import ServiceError
from compensator.model.model_file import read_model_bytes
from compensator.service.adoption import check_model
from compensator.service.command_client import NotReached, Operator, ask, operator_of_file
from compensator.service.composition import load
from compensator.service.model_store import ModelStore

NOT_REACHED = "The service was not reached; it uses the model from its next start on."


def adopt(arguments: argparse.Namespace) -> Answer:
    """Check a model, have the running service take it over, or keep it for the next start.

    Raises
    ------
    CompensatorError
        If the configuration or the model cannot be used, or the service refuses.
    """
    loaded, running, _, _ = load(arguments.config)
    data = read_model_bytes(arguments.model)
    model = check_model(loaded.config, data, source=arguments.model)
    wanted = {"sha256": model.sha256, "model": data.decode(), "force": arguments.force}
    reply = _asked("adopt", wanted, loaded, arguments)
    if reply is None:
        if model.sha256 == running.sha256:
            raise ServiceError(f"model {model.name} ({model.sha256[:12]}) is the service's model already")
        _store(loaded).adopt(data, name=model.name, time_utc_ns=SystemClock().utc_ns())
    return _answered(reply, f"model {model.name} ({model.sha256[:12]}) is kept in {loaded.store()}.", model.sha256)


def back(arguments: argparse.Namespace) -> Answer:
    """Have the running service go back to the model before, or keep that for the next start.

    Raises
    ------
    CompensatorError
        If the configured model is in use, or the service refuses.
    """
    loaded, _, _, _ = load(arguments.config)
    reply = _asked("back", {"force": arguments.force}, loaded, arguments)
    if reply is not None:
        return _answered(reply, "", "")
    store = _store(loaded)
    before = store.before()
    if before is None:
        raise ServiceError("back: the configured model is in use, there is none before it")
    model = check_model(loaded.config, before, source="model before")
    store.back(name=model.name, time_utc_ns=SystemClock().utc_ns())
    return _answered(None, f"back to model {model.name} ({model.sha256[:12]}).", model.sha256)


def operator_of(arguments: argparse.Namespace) -> Operator | None:
    """Return who sends a command, None where nothing is said of it."""
    return operator_of_file(arguments.zenoh) if arguments.zenoh is not None else None


def _asked(
    name: str, wanted: dict[str, Any], loaded: LoadedConfig, arguments: argparse.Namespace
) -> dict[str, Any] | None:
    """Ask the running service; None where there is none."""
    payload, operator = json.dumps(wanted).encode(), operator_of(arguments)
    try:
        return ask(loaded.config.zenoh, name, payload, timeout_s=arguments.timeout, operator=operator)
    except NotReached:
        return None


def _store(loaded: LoadedConfig) -> ModelStore:
    return ModelStore(loaded.store(), read_model_bytes(loaded.model_name()))


def _answered(reply: dict[str, Any] | None, kept: str, sha256: str) -> Answer:
    if reply is None:
        text = f"{kept} {NOT_REACHED}"
        return Answer({"ok": True, "service_reached": False, "model_sha256": sha256, "text": text}, text)
    if not reply.get("ok"):
        raise ServiceError(f"the service refuses: {reply.get('text', 'no reason given')}")
    return Answer({**reply, "service_reached": True}, str(reply.get("text", "")))
