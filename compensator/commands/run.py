"""`compensator run`: the service, until SIGTERM or SIGINT."""

from __future__ import annotations

import argparse
import asyncio
import logging
import signal

from compensator.service.composition import run_service
from compensator.service.daemon import Daemon

log = logging.getLogger("compensator")


def run(arguments: argparse.Namespace) -> None:
    """Run the command; it ends with a finished recording.

    Raises
    ------
    CompensatorError
        If the configuration cannot be used.
    """
    asyncio.run(_serve(arguments.config))
    log.info("compensator: stopped, recording finished")


async def _serve(config: str) -> None:
    loop = asyncio.get_running_loop()

    def ready(daemon: Daemon) -> None:
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, daemon.stop)
        log.info("compensator: running")

    await run_service(config, on_ready=ready)
