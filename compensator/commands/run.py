"""`compensator run`: run the service in the foreground, started by a user or a service manager."""

from __future__ import annotations

import argparse
import asyncio
import faulthandler
import logging
import os
import sys
from collections.abc import Mapping
from typing import Any

import msgspec

from compensator.codes import State
from compensator.commands.stopping import on_stop
from compensator.errors import ServiceError
from compensator.events import EventKind
from compensator.messages import Event, Offset
from compensator.messages_axes import OFFSETS, SHOWN_UNITS, UNITS, AxisOffset, axis_of
from compensator.service import systemd
from compensator.service.composition import run_service
from compensator.service.daemon import Daemon
from compensator.service.loading import load
from compensator.service.systemd import ServiceManager

log = logging.getLogger("compensator")

_LEVELS = {State.OK: logging.INFO, State.STARTING: logging.INFO, State.FAULT: logging.ERROR}


class Reporter:
    """Reports the service's activity to the service manager (one line) and to the log (with fields).

    Parameters
    ----------
    manager : ServiceManager
        The service manager that started the service.
    """

    def __init__(self, manager: ServiceManager) -> None:
        self._manager = manager
        self._polled = False
        self._state: str = State.STARTING
        self._further: dict[str, AxisOffset] = {}

    def report_poll(self) -> None:
        """Report a complete poll; only this feeds the watchdog.

        A silent sensor, a slow disk, or an internal error with the offset held does not trigger the watchdog: the
        published offset shows it, and a restart would not help.
        """
        if not self._polled:
            self._polled = True
            self._manager.ready()
        self._manager.alive()

    def report_message(self, name: str, data: bytes) -> None:
        """Report a published message."""
        axis = axis_of(name)
        if name == "offset":
            self._manager.status(status(msgspec.json.decode(data, type=Offset), self._further))
        elif axis is not None:  # published before that of Y
            self._further[axis] = msgspec.json.decode(data, type=OFFSETS[axis])
        elif name == "event":
            self._log(msgspec.json.decode(data, type=Event))

    def _log(self, event: Event) -> None:
        fields: dict[str, Any] = {"MACHINE": event.machine, "SEQ": event.seq, "KIND": event.kind}
        if event.kind == EventKind.STATE:
            self._state = event.data["state"]
            fields["REASONS"] = " ".join(event.data["reasons"])
        fields["STATE"] = self._state
        text = event.text
        if "by" in event.data:
            fields["BY"] = event.data["by"]
            proof = event.data.get("by_proof")  # the loop needs none
            text += f" (by {event.data['by']}{f', proof: {proof}' if proof is not None else ''})"
        log.log(level(event), "%s: %s", event.kind, text, extra={"fields": fields})


def level(event: Event) -> int:
    """Return the logging level of an event.

    Parameters
    ----------
    event : Event
        What happened.
    """
    if event.kind == EventKind.STATE:
        return _LEVELS.get(event.data["state"], logging.WARNING)
    if event.kind == EventKind.ERROR:
        return logging.ERROR
    refused = event.data.get("ok") is False or event.data.get("taken") is False
    return logging.WARNING if refused else logging.INFO


def status(offset: Offset, further: Mapping[str, AxisOffset] | None = None) -> str:
    """Return state and offset in one line for `systemctl status`.

    Parameters
    ----------
    offset : Offset
        The published offset.
    further : mapping of str to AxisOffset, optional
        Those of further axes.
    """
    state = offset.state + (f" ({', '.join(offset.reasons)})" if offset.reasons else "")
    if offset.y_offset_um is None:
        return f"{state}: no offset yet; sample {offset.seq}"
    rate = offset.y_offset_rate_um_per_min
    growth = "" if rate is None else f", {rate:+.2f} µm/min"
    others = "".join(
        f", {axis.upper()} {one.y_offset_um:+.2f} {SHOWN_UNITS[UNITS[axis]]}"
        + (f" ({one.state})" if one.state != offset.state else "")
        for axis, one in (further or {}).items()
        if one.y_offset_um is not None
    )
    return f"{state}: Y offset {offset.y_offset_um:+.2f} µm{growth}{others}; sample {offset.seq}"


def run(arguments: argparse.Namespace) -> None:
    """Run the service of a configuration until SIGTERM or SIGINT.

    Raises
    ------
    CompensatorError
        If the configuration cannot be used, the service cannot start, or it ends with samples that are not on disk.
    """
    # The watchdog ends the service by SIGABRT; the log then shows the current line of each thread.
    faulthandler.enable()
    if systemd.is_connected(os.environ, sys.stderr.fileno()):
        logging.basicConfig(handlers=[systemd.JournalHandler()], format="%(message)s", force=True)
    with ServiceManager(os.environ) as manager:
        unfinished = asyncio.run(_serve(arguments.config, manager))
    if unfinished:
        raise ServiceError(f"stopped; the recording is not complete: {unfinished}")
    log.info("compensator: stopped, recording finished")


async def _serve(path: str, manager: ServiceManager) -> str:
    """Serve; return what of the recording is not on disk at the end."""
    reporter = Reporter(manager)
    manager.status("starting: reading the last recording")
    setup = load(path)

    def ready(daemon: Daemon) -> None:
        def stop() -> None:
            manager.stopping()
            daemon.stop()

        on_stop(stop)
        manager.watch(setup.config.sampling.poll_interval_s)
        manager.status("starting: waiting for the first poll")
        log.info("compensator: running")

    daemon = await run_service(setup, on_ready=ready, on_poll=reporter.report_poll, on_publish=reporter.report_message)
    return daemon.unfinished
