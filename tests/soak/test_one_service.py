"""One service for one machine; a router that goes and comes back; receivers that join late; floods of commands."""

from __future__ import annotations

import itertools
import json
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.ports import free_port
from tests.receiver.wire import router
from tests.soak.site import PATIENCE_S, Receiver, Site, check_received, end

PERIOD_S = 0.25


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def endpoint(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"


@pytest.fixture
def site(tmp_path: Path, endpoint: str) -> Iterator[Site]:
    with Site(tmp_path, connect=[endpoint], period_s=PERIOD_S) as site:
        yield site


def receiver(endpoint: str) -> Receiver:
    return Receiver("shop/vmc-07", mode="client", connect__endpoints=[endpoint], connect__timeout_ms=10_000)


def resident_mb(process: subprocess.Popen[str]) -> float:
    status = Path(f"/proc/{process.pid}/status").read_text()
    return next(int(line.split()[1]) / 1000 for line in status.splitlines() if line.startswith("VmRSS"))


def elsewhere(site: Site, name: str) -> Path:
    """The configuration of the same machine with recordings in another place, as on another computer."""
    path = site.folder / f"{name}.toml"
    path.write_text(site.text().replace('folder = "recordings"', f'folder = "{name}"'), encoding="utf-8")
    return path


def test_a_second_service_is_refused_and_the_first_goes_on(site: Site, port: int, endpoint: str) -> None:
    with router(port), receiver(endpoint) as control:
        with site.service() as first:
            control.more(2)
            for config, expected in (
                (site.config, "vmc-07.lock: locked by another service"),
                (elsewhere(site, "second"), "alive: another service is alive"),
            ):
                # A token that stands for this long is that of a living one, for whoever does not wait for a dead one's.
                second = site.start(config, stale_s=1.0)
                _, said = second.communicate(timeout=PATIENCE_S)
                assert second.returncode == 1
                assert expected in said and said.strip().count("\n") == 0, said
            control.more(2)
            assert first.poll() is None
            first.kill()
        # What a killed service leaves behind locks nobody out.
        with site.service():
            control.more(2)
        assert not list(site.folder.glob("second/*.mcap"))
        numbers = [message["seq"] for message in control.messages]
        assert numbers == sorted(set(numbers))
        check_received(control.offsets, PERIOD_S)


def test_of_two_that_start_at_the_same_moment_one_goes_on_at_most(site: Site, port: int, endpoint: str) -> None:
    with router(port), receiver(endpoint) as control:
        both = [site.start(elsewhere(site, name)) for name in ("here", "there")]
        try:
            ended = threading.Event()

            def watch(process: subprocess.Popen[str]) -> None:
                process.wait()
                ended.set()

            threads = [threading.Thread(target=watch, args=(process,)) for process in both]
            for thread in threads:
                thread.start()
            assert ended.wait(PATIENCE_S)
            codes = [process.poll() for process in both]
            assert 1 in codes
            if None in codes:
                control.more(3)
        finally:
            said = [end(process) for process in both]
            for thread in threads:
                thread.join()
        assert sum("this one ends" in text for text in said) == codes.count(1)
        numbers = [message["seq"] for message in control.messages]
        assert numbers == sorted(set(numbers))  # one voice only


def test_a_router_that_is_gone_for_long_and_comes_back(site: Site, port: int, endpoint: str) -> None:
    """As many samples as ten minutes have at one a minute, and more."""
    service = None
    try:
        with router(port), receiver(endpoint) as control:
            service = site.start()
            control.more(3)
            before_mb = resident_mb(service)
        gone_at = max(site.on_disk())
        until_recorded(site, gone_at + 15)
        back_at = max(site.on_disk())
        with router(port), receiver(endpoint) as again:
            again.more(3)
            first = again.messages[0]["seq"]
            assert first >= back_at  # nothing that was published meanwhile comes late
            numbers = [message["seq"] for message in again.messages]
            missing = site.missing()
            assert numbers == [seq for seq in range(first, numbers[-1] + 1) if seq not in missing]
            answers = again.ask("y/offset")
            assert len(answers) == 1 and answers[0]["seq"] >= numbers[-1]
            assert {answers[0]["state"]} <= {"ok", "degraded"}
            check_received([control.offsets[-1], *again.offsets], PERIOD_S)
        assert resident_mb(service) < before_mb + 15.0
        site.missing()  # none but those that it says itself
    finally:
        if service is not None:
            end(service)


def until_recorded(site: Site, seq: int) -> None:
    stop = time.monotonic() + PATIENCE_S
    while max(site.on_disk(), default=-1) < seq:
        assert time.monotonic() < stop, f"sample {seq} is not on disk"
        time.sleep(0.1)


def test_whoever_joins_late_is_served_at_once(site: Site, port: int, endpoint: str) -> None:
    with router(port), receiver(endpoint) as early, site.service():
        early.more(3)
        with receiver(endpoint) as late:
            latest = early.messages[-1]["seq"]
            answers = late.ask("y/offset")
            assert len(answers) == 1 and answers[0]["seq"] >= latest
            assert answers[0]["seq"] in site.on_disk()
            assert late.ask("status")[0]["seq"] >= latest


def test_a_flood_of_commands_holds_no_sample_up(tmp_path: Path, port: int, endpoint: str) -> None:
    count, period_s = 2000, 1.0  # on a busy computer a service without a flood may get no processor for 0.25 s
    with (
        Site(tmp_path, connect=[endpoint], period_s=period_s) as site,
        router(port),
        receiver(endpoint) as control,
        receiver(endpoint) as flooder,
        site.service() as service,
    ):
        control.more(3)
        before_mb, first = resident_mb(service), len(control.offsets)
        replies: list[bool] = []
        done = threading.Semaphore(0)

        def reply(answer: Any) -> None:
            replies.append(json.loads(answer.ok.payload.to_bytes())["ok"])
            done.release()

        for i in range(count):
            key = f"shop/vmc-07/thermal/command/{'resume' if i % 2 else 'hold'}"
            flooder.session.get(key, reply, payload=b"{}", timeout=PATIENCE_S)
            if i >= 200:  # so many are under way at once
                assert done.acquire(timeout=PATIENCE_S)
        for _ in range(200):
            assert done.acquire(timeout=PATIENCE_S)
        control.more(3)
        assert len(replies) == count and True in replies and False in replies  # the refused ones are told so
        assert resident_mb(service) < before_mb + 30.0
        numbers = [message["seq"] for message in control.messages]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        times = [message["time_utc_ns"] for message in control.messages[first:]]
        assert {b - a for a, b in itertools.pairwise(times)} == {round(period_s * 1e9)}
        service.terminate()
        assert service.wait(PATIENCE_S) == 0
    assert site.replay()["exit"] == 0
