"""Sending: in order, once, retried with the same time, given up when too old."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from compensator.probes.probe import Probe, Reply
from compensator.probes.sender import WAITING, Outcome, ProbeQueue
from tests.probes.helpers import Sink, until

S = 1_000_000_000


class Bench:
    def __init__(self) -> None:
        self.sink = Sink()
        self.now_s = 1000
        self.reports: list[str] = []
        self.outcomes: list[tuple[int, Outcome]] = []
        self.sender = ProbeQueue(
            self.sink, send_within_s=60.0, retry_s=0.01, report=self.reports.append, utc_ns=lambda: self.now_s * S
        )

    def submit(self, at_s: int) -> None:
        probe = Probe(time_utc_ns=at_s * S, measured_um=1.0, offset_applied_um=0.0, feature="1")
        self.sender.submit(probe, "source", lambda outcome: self.outcomes.append((at_s, outcome)))

    @property
    def sent_s(self) -> list[int]:
        return [probe.time_utc_ns // S for probe in self.sink.probes]


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    bench = Bench()
    async with running(bench):
        yield bench


@asynccontextmanager
async def running(bench: Bench) -> AsyncIterator[None]:
    stop = asyncio.Event()
    task = asyncio.create_task(bench.sender.run(stop))
    yield
    stop.set()
    await asyncio.wait_for(task, 10.0)


async def test_in_order_with_the_answers(bench: Bench) -> None:
    for at_s in (1000, 999, 999):
        bench.submit(at_s)
    await until(lambda: len(bench.outcomes) == 3, "all")
    assert bench.outcomes == [(1000, "sent"), (999, "sent"), (999, "refused")]
    assert "[duplicate]" in bench.reports[2] and bench.sent_s == [1000, 999]


@pytest.mark.parametrize("code", ["probe_future", "probe_too_many"])
async def test_a_reply_writes_no_line_of_its_own(bench: Bench, monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    reply = Reply(False, "no\n\x1b[2Jsource: sent: +1.00 µm", code)
    monkeypatch.setattr(bench.sink, "send", lambda _: reply)
    bench.submit(1000)
    await until(lambda: bench.reports, "a report")
    assert bench.reports[0].isprintable() and r"no\n\x1b[2Jsource" in bench.reports[0] and "µm" in bench.reports[0]


async def test_what_could_not_be_sent_is_sent_later_as_it_was(bench: Bench) -> None:
    bench.sink.reachable = False
    bench.submit(1000)
    await until(lambda: bench.sink.attempts > 3, "attempts")
    bench.submit(1001)
    assert not bench.outcomes and len(bench.reports) == 1  # reported once
    bench.now_s = 1030
    bench.sink.reachable = True
    await until(lambda: len(bench.outcomes) == 2, "both")
    assert bench.sent_s == [1000, 1001]


async def test_what_has_become_too_old_is_given_up(bench: Bench) -> None:
    bench.sink.reachable = False
    bench.submit(1000)
    await until(lambda: bench.sink.attempts > 1, "an attempt")
    bench.submit(1050)
    bench.now_s = 1061
    await until(lambda: bench.outcomes, "given up")
    bench.sink.reachable = True
    await until(lambda: len(bench.outcomes) == 2, "the other")
    assert bench.outcomes == [(1000, "given up"), (1050, "sent")] and bench.sent_s == [1050]
    assert any("[probe_not_sent]" in report for report in bench.reports)


async def test_the_end_reports_what_waits_and_calls_it_nothing() -> None:
    bench = Bench()
    bench.sink.reachable = False
    async with running(bench):
        bench.submit(1000)
        await until(lambda: bench.sink.attempts, "an attempt")
    assert not bench.outcomes and "not sent before the end" in bench.reports[-1]


def test_a_flood_pushes_the_oldest_out() -> None:
    bench = Bench()
    for at_s in range(WAITING + 3):
        bench.submit(at_s)
    assert bench.outcomes == [(0, "given up"), (1, "given up"), (2, "given up")]


async def test_what_the_service_has_no_room_for_is_sent_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    send, full = bench.sink.send, [3]

    def crowded(probe: Probe) -> Reply:
        full[0] -= 1
        return (
            Reply(False, "probe: 20 wait for the next sample already", "probe_too_many")
            if full[0] >= 0
            else send(probe)
        )

    monkeypatch.setattr(bench.sink, "send", crowded)
    bench.submit(1000)
    bench.submit(1001)
    await until(lambda: len(bench.outcomes) == 2, "both")
    assert bench.outcomes == [(1000, "sent"), (1001, "sent")]
    assert sum("probe_too_many" in report for report in bench.reports) == 1


def test_half_of_the_places_is_for_sources_that_cannot_wait() -> None:
    bench = Bench()
    while bench.sender.has_room():
        bench.submit(1000)
    for at_s in range(WAITING // 2):
        bench.submit(at_s)
    assert not bench.outcomes
