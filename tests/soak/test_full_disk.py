"""A disk that takes nothing, as the file system itself says it: the receiver is told, and nothing is missing after."""

from __future__ import annotations

import itertools
import os
import resource
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.ports import free_port
from tests.soak.site import Receiver, Site, check_received, is_early

PERIOD_S = 0.25


@pytest.fixture
def place(tmp_path: Path) -> Iterator[tuple[Site, Receiver]]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        Receiver("shop/vmc-07", mode="router", listen__endpoints=[endpoint]) as control,
        Site(tmp_path, connect=[endpoint], period_s=PERIOD_S) as site,
    ):
        yield site, control


def refused(control: Receiver, count: int) -> None:
    """Wait for so many offsets that say that the disk does not take them."""

    def enough() -> bool:
        return sum("recording_failed" in message["reasons"] for message in control.messages) >= count

    control.wait(enough, "recording_failed")


def ends_well(site: Site, control: Receiver, service: subprocess.Popen[str]) -> None:
    control.wait(lambda: any("accepts the recording again" in e["text"] for e in control.events), "the disk is back")
    known = len(control.offsets)
    control.wait(lambda: any(m["state"] == "ok" for m in control.messages[known:]), "ok again")
    service.terminate()
    assert service.wait(60) == 0
    said = [message for message in control.messages if "recording_failed" in message["reasons"]]
    # Where the computer is busy, the devices have not answered yet, and there is no value to be refused.
    said = list(itertools.dropwhile(lambda message: message["y_offset_um"] is None, said))
    assert said and all(m["state"] == "degraded" and m["y_offset_um"] is not None for m in said)
    assert any(e["text"].startswith("the disk does not accept the recording") for e in control.events)
    check_received(control.offsets, PERIOD_S)
    # Every sample is there, those that waited too, exactly as they were published (but for one that was being written).
    on_disk = site.on_disk()
    for message, data in zip(control.messages, control.offsets, strict=True):
        assert message["seq"] in on_disk
        assert on_disk[message["seq"]] == data or is_early(data)
    audit = site.replay()
    assert audit["exit"] == 0 and sum(file["skipped_samples"] for file in audit["files"]) == 0, audit


def test_a_process_that_may_not_write_any_more(place: tuple[Site, Receiver]) -> None:
    """A limit on the size of files acts as a full disk does, and needs no rights."""
    site, control = place
    with site.service() as service:
        control.more(3)
        _, hard = resource.prlimit(service.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(service.pid, resource.RLIMIT_FSIZE, (10, hard))
        refused(control, 4)
        resource.prlimit(service.pid, resource.RLIMIT_FSIZE, (hard, hard))
        ends_well(site, control, service)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "recordings"
    folder.mkdir()
    if os.geteuid() != 0 or run("mount", "-t", "tmpfs", "-o", "size=20m", "none", folder):
        pytest.skip("a file system can be mounted by root only, and not in every container")
    yield folder
    run("umount", "-l", folder)


def run(*command: Any) -> int:
    return subprocess.run([str(part) for part in command], capture_output=True, check=False, timeout=30).returncode


def test_a_full_disk(small_disk: Path, place: tuple[Site, Receiver]) -> None:
    site, control = place
    with site.service() as service:
        control.more(3)
        with (small_disk / "other").open("wb", buffering=0) as other:
            try:
                while True:
                    other.write(bytes(4096))
            except OSError:
                pass
            refused(control, 4)
        (small_disk / "other").unlink()
        ends_well(site, control, service)


def test_a_disk_that_is_read_only(small_disk: Path, place: tuple[Site, Receiver]) -> None:
    site, control = place
    assert run("mount", "-o", "remount,ro", small_disk) == 0
    with site.service() as service:
        refused(control, 4)
        assert run("mount", "-o", "remount,rw", small_disk) == 0
        ends_well(site, control, service)
