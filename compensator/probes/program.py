"""All sources of a file, together with the sender."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from compensator.probes.folder import WatchedFolder
from compensator.probes.handled import Handled
from compensator.probes.linuxcnc import ProbeFile
from compensator.probes.printed import PrintedProbes
from compensator.probes.probe import Probe, ProbeSink
from compensator.probes.sender import ProbeQueue
from compensator.probes.settings import ProbeSettings
from compensator.probes.stream import Stream
from compensator.receiver.applied_record import applied_at

log = logging.getLogger("compensator")
#: How long a handled line is remembered beyond the time in which lines are sent, s: clocks may be set.
_MARGIN_S = 86400.0


async def serve(settings: ProbeSettings, sink: ProbeSink, stop: asyncio.Event) -> None:
    """Read all sources and send what they yield, until `stop` is set.

    Parameters
    ----------
    settings : ProbeSettings
        Sources and service.
    sink : ProbeSink
        Where probes go.
    stop : asyncio.Event
        Ends it.

    Raises
    ------
    ConfigError
        If the state file cannot be read.
    """
    service = settings.service
    sender = ProbeQueue(sink, send_within_s=service.send_within_s, retry_s=service.retry_s, report=log.info)

    def applied(time_utc_ns: int) -> float | None:
        return applied_at(Path(service.applied_file), time_utc_ns) if service.applied_file else None

    def submitting(source: str) -> Callable[[Probe], None]:
        return lambda probe: sender.submit(probe, source)

    runs: list[Coroutine[Any, Any, None]] = []
    watching: list[WatchedFolder] = []
    if settings.folders:
        handled = Handled(Path(service.state_file), service.send_within_s + _MARGIN_S)
        within_s = service.send_within_s
        for folder in settings.folders:
            watched = WatchedFolder(
                folder,
                handled,
                sender.submit,
                applied,
                log.info,
                send_within_s=within_s,
                has_room=sender.has_room,
            )
            watching.append(watched)
            runs.append(watched.run(stop))
    runs.append(sender.run(stop))
    for dprnt in settings.dprnt:
        printed = PrintedProbes(dprnt, submitting(dprnt.name), applied, log.info)
        runs.append(Stream(dprnt, printed, log.info).run(stop))
    for linuxcnc in settings.linuxcnc:
        file = ProbeFile(linuxcnc, submitting(Path(linuxcnc.file).name), applied, log.info)
        runs.append(file.run(stop))
    async with asyncio.TaskGroup() as group:
        for run in runs:
            group.create_task(run)
    for watched in watching:  # What the sender sent last.
        watched.keep()
