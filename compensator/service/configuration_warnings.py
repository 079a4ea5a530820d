"""What a configuration may hold and better does not; `check` says it, `run` goes on."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from compensator.certificates import check_files, remarks
from compensator.config import LoadedConfig, Zenoh
from compensator.errors import ConfigError
from compensator.reasons import Remark
from compensator.service.session import tls_files

#: Numbers that go by the order in which adapters are plugged in or found.
_NUMBERED = re.compile(r"/dev/tty(USB|ACM)\d+")
_BY_ID = Path("/dev/serial/by-id")


def precautions(loaded: LoadedConfig, now: datetime.datetime | None = None) -> list[Remark]:
    """Return warnings, each in one line.

    Parameters
    ----------
    loaded : LoadedConfig
        The configuration.
    now : datetime.datetime, optional
        Time to judge certificates at, UTC; now where none is given.

    Raises
    ------
    ConfigError
        If the certificate cannot be used now: the router will refuse the service.
    """
    config = loaded.config
    found = [text for line in config.line if (text := _numbered(line)) is not None]
    found += _open_doors(config.zenoh)
    files = tls_files(config.zenoh)
    if files is not None:
        now = now or datetime.datetime.now(datetime.UTC)
        certificate = check_files(str(loaded.path), files)
        wrong = certificate.wrong_at(now) if certificate is not None else None
        if wrong is not None:
            raise ConfigError(f"{loaded.path}: zenoh.tls_certificate = {str(files.certificate)!r}: {wrong}")
        found += remarks(certificate, now)
    return found


def _numbered(line: Mapping[str, Any]) -> Remark | None:
    """Say that a serial port has no name of its own."""
    port = str(line.get("port", ""))
    if not _NUMBERED.fullmatch(port):
        return None
    lasting = [link for link in sorted(_BY_ID.glob("*")) if link.resolve() == Path(port).resolve()]
    stays = f" The name of it that stays is {lasting[0]}." if lasting else ""
    figures = f"Line {line.get('name')!r}: port {port} goes by the order of plugging in, and may be another adapter's "
    return Remark("numbered_port", f"{figures}after a restart.{stays}")


def _open_doors(zenoh: Zenoh) -> list[Remark]:
    """Say where somebody on the network may speak for the machine or its operator."""
    found = []
    outside = [endpoint for endpoint in zenoh.listen if not zenoh.is_loopback(endpoint)]
    if outside:
        found.append(
            Remark(
                "open_listen",
                f"zenoh.listen {', '.join(outside)}: whoever reaches it can publish "
                f"offsets and send commands in any name.",
            )
        )
    outside = [endpoint for endpoint in zenoh.connect if not zenoh.is_loopback(endpoint)]
    if outside and not zenoh.secured():
        found.append(
            Remark(
                "unsecured_connect", f"zenoh.connect {', '.join(outside)}: neither encrypted nor proven who is there."
            )
        )
    if zenoh.unproven_commands and not zenoh.on_loopback():
        figures = "zenoh.unproven_commands: commands are taken of which nobody proves who sent them."
        found.append(Remark("unproven_commands", figures))
    return found
