"""What the service's process has open, read from the kernel: nothing but what is configured."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.ports import free_port
from tests.security.test_check import written

LISTENING = "0A"


def sockets(pid: int) -> set[tuple[str, str, str]]:
    """Protocol, local address and state of each IP socket that a process has open."""
    own = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = str(link.readlink())
        except OSError:  # closed meanwhile
            continue
        if target.startswith("socket:["):
            own.add(target[8:-1])
    found = set()
    for protocol in ("tcp", "tcp6", "udp", "udp6"):
        table = Path(f"/proc/net/{protocol}")
        for line in table.read_text().splitlines()[1:] if table.exists() else []:
            fields = line.split()
            if fields[9] in own:
                found.add((protocol, fields[1], fields[3]))
    return found


def doors(pid: int) -> set[tuple[str, str]]:
    """Where somebody could reach the process: TCP that listens, and any UDP."""
    return {(p, address) for p, address, state in sockets(pid) if p.startswith("udp") or state == LISTENING}


@contextmanager
def running(config: Path) -> Iterator[int]:
    process = subprocess.Popen(
        [sys.executable, "-m", "compensator", "run", "--config", str(config)], stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        assert any("compensator: running" in line for line in process.stderr)
        yield process.pid
        process.terminate()
        process.stderr.read()
        assert process.wait(timeout=30) == 0
    finally:
        process.kill()
        process.wait()
        assert process.stderr is not None
        process.stderr.close()


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs Linux's /proc")
def test_the_service_opens_no_door_that_is_not_configured(tmp_path: Path) -> None:
    port = free_port()
    zenoh = f'listen = ["tcp/127.0.0.1:{port}"]\nconnect = ["tcp/127.0.0.1:{free_port()}"]\n'
    with running(written(tmp_path, zenoh)) as pid:
        assert doors(pid) == {("tcp", f"0100007F:{port:04X}")}
