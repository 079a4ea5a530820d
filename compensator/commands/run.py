"""`compensator run`: the service in the foreground, as a person or a service manager starts it."""

from __future__ import annotations

import argparse
import asyncio
import faulthandler
import logging
import os
import signal
import sys
from typing import Any

import msgspec

from compensator.config import load_config
from compensator.messages import Event, Offset
from compensator.service import journald
from compensator.service.composition import run_service
from compensator.service.daemon import Daemon
from compensator.service.notify import ServiceManager

log = logging.getLogger("compensator")

_LEVELS = {"ok": logging.INFO, "starting": logging.INFO, "fault": logging.ERROR}


class Voice:
    """Says what the service does: to its manager in one line, to the log with fields.

    Parameters
    ----------
    manager : ServiceManager
        Who started the service.
    """

    def __init__(self, manager: ServiceManager) -> None:
        self._manager = manager
        self._polled = False
        self._state = "starting"

    def polled(self) -> None:
        """Take a poll that is wholly done: the only thing that counts as a sign of life.

        A sensor that does not answer, a disk that is late, or a sample that ended in an internal error and was held is
        no standstill: the offset says so, and another start would not say more.
        """
        if not self._polled:
            self._polled = True
            self._manager.ready()
        self._manager.alive()

    def published(self, name: str, data: bytes) -> None:
        """Take a message that was published."""
        if name == "offset":
            self._manager.status(status(msgspec.json.decode(data, type=Offset)))
        elif name == "event":
            self._log(msgspec.json.decode(data, type=Event))

    def _log(self, event: Event) -> None:
        fields: dict[str, Any] = {"MACHINE": event.machine, "SEQ": event.seq, "KIND": event.kind}
        if event.kind == "state":
            self._state = event.data["state"]
            fields["REASONS"] = " ".join(event.data["reasons"])
        fields["STATE"] = self._state
        text = event.text
        if "by" in event.data:
            fields["BY"] = event.data["by"]
            text += f" (by {event.data['by']}, proof: {event.data['by_proof']})"
        log.log(level(event), "%s: %s", event.kind, text, extra={"fields": fields})


def level(event: Event) -> int:
    """Return how urgent an event is: a number of `logging`.

    Parameters
    ----------
    event : Event
        What happened.
    """
    if event.kind == "state":
        return _LEVELS.get(event.data["state"], logging.WARNING)
    if event.kind == "error":
        return logging.ERROR
    return logging.WARNING if event.data.get("ok") is False else logging.INFO


def status(offset: Offset) -> str:
    """Put state and offset into one line for `systemctl status`.

    Parameters
    ----------
    offset : Offset
        What was published.
    """
    state = offset.state + (f" ({', '.join(offset.reasons)})" if offset.reasons else "")
    if offset.y_offset_um is None:
        return f"{state}: no offset yet; sample {offset.seq}"
    rate = offset.y_offset_rate_um_per_min
    growth = "" if rate is None else f", {rate:+.2f} µm/min"
    return f"{state}: Y offset {offset.y_offset_um:+.2f} µm{growth}; sample {offset.seq}"


def run(arguments: argparse.Namespace) -> None:
    """Run the service of a configuration until SIGTERM or SIGINT.

    Raises
    ------
    CompensatorError
        If the configuration cannot be used, or the service cannot begin.
    """
    # A watchdog ends the service by SIGABRT: then the log says in which line each thread stood.
    faulthandler.enable()
    if journald.is_connected(os.environ, sys.stderr.fileno()):
        logging.basicConfig(handlers=[journald.JournalHandler()], level=logging.INFO, format="%(message)s", force=True)
    with ServiceManager(os.environ) as manager:
        asyncio.run(_serve(arguments.config, manager))
    log.info("compensator: stopped, recording finished")


async def _serve(path: str, manager: ServiceManager) -> None:
    loop = asyncio.get_running_loop()
    voice = Voice(manager)
    manager.status("starting: reads the last recording")

    def ready(daemon: Daemon) -> None:
        def stop() -> None:
            manager.stopping()
            daemon.stop()

        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, stop)
        manager.watch(load_config(path).config.sampling.poll_interval_s)
        manager.status("starting: waits for the first poll")
        log.info("compensator: running")

    await run_service(path, on_ready=ready, on_poll=voice.polled, on_publish=voice.published)
