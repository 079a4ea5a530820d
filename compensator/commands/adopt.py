"""`compensator adopt` and `back`: change the model of the service, whether it is running or not; `dismiss`."""

from __future__ import annotations

import argparse
import json
from typing import Any

from compensator.clock import SystemClock
from compensator.commands import Answer
from compensator.commands.order import answered, operator_of
from compensator.errors import ServiceError, UsageError
from compensator.events import CommandName, ComparisonData
from compensator.model.model_file import read_model_bytes
from compensator.service.command_client import NotReached, ask
from compensator.service.loading import Setup, load
from compensator.service.presence import is_used
from compensator.service.transfer.model_store import check_model
from compensator.service.transfer.second_opinion import described, refuse_if_worse, second_opinion

NOT_REACHED = "The service could not be reached; it will use the model from its next start."


def adopt(arguments: argparse.Namespace) -> Answer:
    """Check a model; the running service adopts it, or it is stored for the next start.

    Raises
    ------
    CompensatorError
        If the configuration or the model cannot be used, or the service refuses.
    """
    if (arguments.model is None) == (arguments.candidate is None):
        raise UsageError("expected either MODEL, or --candidate for the model that the service proposes")
    setup = load(arguments.config)
    if arguments.candidate is not None:
        wanted = {"candidate": True, "force": arguments.force, "sha256": _hash_of(arguments)}
        return _decide(CommandName.ADOPT, wanted, setup, arguments)
    data = read_model_bytes(arguments.model)
    model = check_model(setup.config, data, source=arguments.model)
    wanted = {"sha256": model.sha256, "model": data.decode(), "force": arguments.force}
    reply = _ask(CommandName.ADOPT, wanted, setup, arguments)
    if reply is not None:
        return answered(reply, service_reached=True)
    if model.sha256 == setup.model.sha256:
        raise ServiceError(f"model {model.name} ({model.sha256[:12]}) is already the service's model")
    found = second_opinion(setup.recordings, setup.config, setup.model, model)
    try:
        refuse_if_worse(found, model, force=arguments.force)
    except ServiceError as error:
        refused = {"ok": False, "service_reached": False, "model_sha256": model.sha256, "text": str(error)}
        raise ServiceError(str(error), refused | {"comparison": found.table()}) from error
    setup.store.adopt(data, name=model.name, time_utc_ns=SystemClock().utc_ns())
    return _stored(f"model {model.name} ({model.sha256[:12]}) is stored in {setup.store.folder}", model.sha256, found)


def back(arguments: argparse.Namespace) -> Answer:
    """Return to the previous model, now if the service is running, otherwise at its next start.

    Raises
    ------
    CompensatorError
        If the configured model is in use, or the service refuses.
    """
    setup = load(arguments.config)
    reply = _ask(CommandName.BACK, {"force": arguments.force}, setup, arguments)
    if reply is not None:
        return answered(reply, service_reached=True)
    model = check_model(setup.config, setup.store.before(), source="previous model")
    found = second_opinion(setup.recordings, setup.config, setup.model, model)
    setup.store.back(name=model.name, time_utc_ns=SystemClock().utc_ns())
    return _stored(f"back to model {model.name} ({model.sha256[:12]})", model.sha256, found)


def dismiss(arguments: argparse.Namespace) -> Answer:
    """Refuse the candidate of the running service.

    Raises
    ------
    CompensatorError
        If the configuration cannot be used, or the service is not reached or refuses.
    """
    return _decide(CommandName.DISMISS, {"sha256": _hash_of(arguments)}, load(arguments.config), arguments)


def _hash_of(arguments: argparse.Namespace) -> str:
    """Return the beginning of the candidate's hash; empty: whichever is proposed."""
    return "" if arguments.candidate is True else str(arguments.candidate)


def _decide(name: str, wanted: dict[str, Any], setup: Setup, arguments: argparse.Namespace) -> Answer:
    """Decide about the candidate of the running service: only that has one."""
    operator = operator_of(arguments)
    zenoh = setup.config.zenoh
    return answered(ask(zenoh, name, json.dumps(wanted).encode(), timeout_s=arguments.timeout, operator=operator))


def _ask(name: str, wanted: dict[str, Any], setup: Setup, arguments: argparse.Namespace) -> dict[str, Any] | None:
    """Send a command to the running service; return None if there is none, or its next start is meant by force."""
    payload, operator = json.dumps(wanted).encode(), operator_of(arguments)
    try:
        return ask(setup.config.zenoh, name, payload, timeout_s=arguments.timeout, operator=operator)
    except NotReached:
        _refuse_beside_a_service(setup, force=arguments.force)
        return None


def _refuse_beside_a_service(setup: Setup, *, force: bool) -> None:
    """Refuse to change the model of the next start under a service that runs: its loop may change it, too."""
    machine = setup.config.machine.name
    if is_used(setup.recordings, machine) and not force:
        raise ServiceError(
            f"a service of {machine} runs here and could not be reached: correct the connection (its router, the table "
            "[zenoh], --zenoh), or stop it; --force stores the model for its next start all the same",
            {"ok": False, "service_reached": False},
        )


def _stored(kept: str, sha256: str, found: ComparisonData) -> Answer:
    """Return the answer without a service: the comparison was made here."""
    text = f"{kept}; {described(found)}. {NOT_REACHED}"
    record = {"ok": True, "service_reached": False, "model_sha256": sha256, "text": text}
    return Answer(record | {"comparison": found.table()}, text)
