"""`compensator bridge probes`: send what touch probes measure to the service, until SIGTERM or SIGINT."""

from __future__ import annotations

import argparse
import asyncio
import logging
from pathlib import Path

import msgspec
import zenoh

from compensator.codes import ProbeSourceRemark, Remark
from compensator.commands import Answer, log_warnings, warnings_as_json
from compensator.commands.stopping import on_stop
from compensator.config import Zenoh
from compensator.errors import ConfigError, ServiceError
from compensator.messages import SCHEMA, ProbeRequest
from compensator.probes.probe import NotSent, Probe, Reply
from compensator.probes.program import serve
from compensator.probes.settings import ProbeSettings, Service, load_probes
from compensator.service.command_client import operator_here, operator_of_file, send_probe

log = logging.getLogger("compensator")


class CommandSink:
    """Sends probes with the command `probe`.

    Parameters
    ----------
    service : Service
        Prefix, addresses or certificates.
    source : str
        File, for messages.

    Raises
    ------
    ConfigError
        If the Zenoh configuration cannot be used.
    """

    def __init__(self, service: Service, source: str) -> None:
        self._timeout_s = service.timeout_s
        table = {"prefix": service.prefix, "connect": list(service.connect)}
        try:
            self._zenoh = msgspec.convert(table, Zenoh)
            config = service.zenoh_config
            self._operator = operator_of_file(Path(config)) if config else operator_here(self._zenoh)
        except (msgspec.ValidationError, zenoh.ZError) as error:
            raise ConfigError(
                f"{source}: probes.prefix = {service.prefix!r}, connect = {list(service.connect)}: expected names "
                f"separated by / and addresses such as 'tcp/127.0.0.1:7447'"
            ) from error

    def send(self, probe: Probe) -> Reply:
        """Send a probe and wait for the answer.

        Raises
        ------
        NotSent
            If the service is not reached or does not answer.
        """
        request = ProbeRequest(
            schema=SCHEMA,
            time_utc_ns=probe.time_utc_ns,
            axis="y",
            measured_um=probe.measured_um,
            offset_applied_um=probe.offset_applied_um,
            std_um=probe.std_um,
            feature=probe.feature,
            tool=probe.tool,
            stopped_s=probe.stopped_s,
        )
        try:
            answer = send_probe(self._zenoh, request, timeout_s=self._timeout_s, operator=self._operator)
        except ServiceError as error:  # NotReached is one
            raise NotSent(str(error)) from error
        return Reply(bool(answer.get("ok")), str(answer.get("text", "")), str(answer.get("code") or ""))


def run(arguments: argparse.Namespace) -> Answer | None:
    """Run the command."""
    settings = load_probes(arguments.config)
    sink = CommandSink(settings.service, arguments.config)
    if arguments.check:
        return _checked(arguments.config, settings)
    asyncio.run(_serve(settings, sink))
    log.info("compensator bridge: stopped")
    return None


def _checked(config: str, settings: ProbeSettings) -> Answer:
    sources = [
        *(f"{one.path}/{one.pattern}, sign {one.sign:+d} ({one.sign_checked})" for one in settings.folders),
        *(f"{dprnt.name}, sign {dprnt.sign:+d} ({dprnt.sign_checked})" for dprnt in settings.dprnt),
        *(f"{file.file}, sign {file.sign:+d} ({file.sign_checked})" for file in settings.linuxcnc),
    ]
    warnings = _without_offset(settings)
    log_warnings(config, warnings)
    text = f"{config}: valid. To {settings.service.prefix} from {'; '.join(sources)}. Nothing was opened."
    result = {"ok": True, "prefix": settings.service.prefix, "sources": sources, **warnings_as_json(warnings)}
    return Answer(result, text)


def _without_offset(settings: ProbeSettings) -> list[Remark]:
    """Warn of sources whose probes may all be refused, because nothing shows the offset."""
    if settings.service.applied_file:
        return []
    sources = [
        *((f"{one.path}/{one.pattern}", "a line without offset_applied_um is refused") for one in settings.folders),
        *((one.name, "a line without OUM, OMM or OIN is refused") for one in settings.dprnt),
        *((one.file, "its lines have no offset, so every probe is refused") for one in settings.linuxcnc),
    ]
    return [
        Remark(ProbeSourceRemark.NO_OFFSET_SOURCE, f"{name}: no probes.applied_file: {why}.") for name, why in sources
    ]


async def _serve(settings: ProbeSettings, sink: CommandSink) -> None:
    stop = asyncio.Event()
    on_stop(stop.set)
    await serve(settings, sink, stop)
