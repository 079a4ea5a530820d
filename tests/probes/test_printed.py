"""Which lines of a control become probes: sign, offset, time; over bytes, and over real TCP and a pseudo-terminal."""

from __future__ import annotations

import asyncio
import datetime
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.probes.printed import PrintedProbes
from compensator.probes.probe import Probe
from compensator.probes.settings import Dprnt
from compensator.probes.stream import Freshness, Stream
from sim_hardware.wire import PrintingControl, Rack
from sim_hardware.wire.printing import Maker
from tests.probes.helpers import touch_um, until

NOW = datetime.datetime(2026, 3, 2, 10, 0, 0, tzinfo=datetime.UTC)
NOW_NS = int(NOW.timestamp()) * 1_000_000_000
SETTINGS = Dprnt(
    sign=-1,
    sign_checked="2026-03-02, two offsets, J. Novak",
    address="127.0.0.1:1",
    delay_s=0.5,
    settle_s=0.05,
    retry_s=0.05,
)
LINE = b"TPROBE YUM   3.200 CUM-  3.200 OUM- 12.300 F  1. T 99 END\r\n"


class Bench:
    def __init__(self, settings: Dprnt = SETTINGS, applied_um: float | None = None) -> None:
        self.probes: list[Probe] = []
        self.reports: list[str] = []
        self.asked: list[int] = []
        self.applied_um = applied_um
        self.printed = PrintedProbes(settings, self.probes.append, self._applied, self.reports.append)

    def _applied(self, time_utc_ns: int) -> float | None:
        self.asked.append(time_utc_ns)
        return self.applied_um

    def receive(self, data: bytes, *, late: bool = False, now_ns: int = NOW_NS) -> None:
        self.printed.receive(data, 0.0, now_ns, late=late)


@pytest.mark.parametrize("includes_offset", [False, True])
@pytest.mark.parametrize("y_um", [15.0, -4.0])
def test_the_deformation_comes_out_by_geometry(y_um: float, includes_offset: bool) -> None:
    """The deformation is `measured_um` − `offset_applied_um`, whatever the control displays."""
    for offset_um in (0.0, -12.3, 20.0):
        reading = touch_um(y_um=y_um, offset_um=offset_um, includes_offset=includes_offset)
        bench = Bench(replace(SETTINGS, includes_offset=includes_offset))
        bench.receive(f"TPROBE YUM{reading:.3f} CUM{-reading:.3f} OUM{offset_um:.3f} F1 END\n".encode())
        (probe,) = bench.probes
        assert probe.measured_um - probe.offset_applied_um == pytest.approx(y_um)
        assert probe.offset_applied_um == offset_um


def test_a_line_without_a_time_is_timed_by_its_arrival() -> None:
    bench = Bench()
    bench.receive(LINE.replace(b"END", b"A 30 S 20. END"))
    assert bench.probes == [
        Probe(
            time_utc_ns=NOW_NS - 30_500_000_000,
            measured_um=-3.2,
            offset_applied_um=-12.3,
            feature="1",
            tool="99",
            stopped_s=20.0,
        )
    ]
    assert not bench.reports and not bench.asked


def test_a_time_in_the_line_is_kept_and_checked() -> None:
    local = replace(SETTINGS, zone="Europe/Prague")
    for seconds, sent in ((0, True), (9, True), (12, False), (-12, False), (3600, False), (86400, False)):
        for settings_, shift_h in ((SETTINGS, 0), (local, 1)):
            bench = Bench(settings_)
            at = NOW - datetime.timedelta(seconds=seconds) + datetime.timedelta(hours=shift_h)
            bench.receive(LINE.replace(b"END", f"D{at:%Y%m%d} H{int(f'{at:%H%M%S}'):6d} A 2 END".encode()))
            assert len(bench.probes) == sent, (seconds, bench.reports)
            if sent:
                assert bench.probes[0].time_utc_ns == NOW_NS - (seconds + 2) * 1_000_000_000
            else:
                assert "[line_clock_disagrees]" in bench.reports[0]


@pytest.mark.parametrize("utc_h", [0, 1])
def test_the_hour_that_comes_twice_is_the_one_that_is_now(utc_h: int) -> None:
    now = datetime.datetime(2026, 10, 25, utc_h, 30, 0, tzinfo=datetime.UTC)  # both are 02:30 in Prague
    bench = Bench(replace(SETTINGS, zone="Europe/Prague"))
    now_ns = int(now.timestamp()) * 1_000_000_000
    bench.receive(LINE.replace(b"END", b"D20261025 H 23000 END"), now_ns=now_ns)
    assert [probe.time_utc_ns for probe in bench.probes] == [now_ns] and not bench.reports


def test_what_waited_somewhere_is_refused() -> None:
    bench = Bench()
    bench.receive(LINE, late=True)
    bench.receive(LINE[:10], late=True)
    bench.receive(LINE[10:])
    assert not bench.probes and ["[line_age_unknown]" in report for report in bench.reports] == [True, True]
    bench.receive(LINE)
    assert len(bench.probes) == 1


def test_the_offset_comes_from_the_receivers_record_at_the_time_of_the_touch() -> None:
    line = LINE.replace(b"OUM- 12.300 ", b"").replace(b"END", b"A10 END")
    bench = Bench(applied_um=7.5)
    bench.receive(line)
    assert bench.probes[0].offset_applied_um == 7.5 and bench.asked == [NOW_NS - 10_500_000_000]
    bench = Bench(applied_um=None)
    bench.receive(line)
    (report,) = bench.reports
    assert not bench.probes and "[line_offset_unknown]" in report and "no record of the offset at this time" in report


def test_a_feature_is_needed() -> None:
    line = LINE.replace(b"F  1. ", b"")
    bench = Bench()
    bench.receive(line)
    assert not bench.probes and "no F" in bench.reports[0]
    bench = Bench(replace(SETTINGS, feature="sphere-1"))
    bench.receive(line)
    assert bench.probes[0].feature == "sphere-1"


def test_other_lines_are_reported_a_few_times() -> None:
    bench = Bench()
    bench.receive(b"PART 17 OK\n" * 100 + LINE)
    assert len(bench.probes) == 1 and len(bench.reports) == 5


def test_a_wrong_baud_rate_does_not_fill_the_log() -> None:
    bench = Bench()
    bench.receive(b"\xff\r" * 5000)
    assert len(bench.reports) == 25 and "(5000 in a row)" in bench.reports[-1]
    bench.receive(LINE + b"\xff\r")
    assert len(bench.probes) == 1 and len(bench.reports) == 26


@settings(max_examples=150, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=300), st.just(LINE), st.sampled_from([LINE[:30], LINE[30:]]))), st.data())
def test_no_bytes_end_the_reading(pieces: list[bytes], data: st.DataObject) -> None:
    """Whatever arrives, in whatever pieces: each whole line after a line end is read."""
    bench = Bench(replace(SETTINGS, bits=data.draw(st.sampled_from(["8N", "8N"]))))
    for piece in pieces:
        bench.receive(piece, late=data.draw(st.booleans()))
    assert all(probe.measured_um == -3.2 for probe in bench.probes)
    before = len(bench.probes)
    bench.receive(b"\r" + LINE + LINE)
    assert len(bench.probes) == before + 2


# ---------------------------------------------------------------------- when bytes are fresh


def test_freshness() -> None:
    fresh = Freshness(settle_s=2.0, pause_s=2.0)
    fresh.connected(100.0)
    assert fresh.is_late(100.5) and fresh.is_late(102.0) and fresh.is_late(103.5)  # never quiet for 2 s
    for beat in range(4):
        fresh.beat(104.0 + beat)
    assert not fresh.is_late(107.5)
    assert not fresh.is_late(109.0)
    assert fresh.is_late(112.0) and fresh.is_late(112.1)  # 3 s without a beat: stopped, or the computer slept
    for beat in range(3):
        fresh.beat(113.0 + beat)
    assert not fresh.is_late(115.5)


# ---------------------------------------------------------------------- real connections

MACRO = "POPEN\nDPRNT[TPROBE*YUM#101[53]*CUM#102[53]*OUM#103[53]*F#9[30]*T#20[30]*END]\nPCLOS\n"
VARIABLES = {101: 3.2, 102: -3.2, 103: -12.3, 9: 1.0, 20: 99.0}


@asynccontextmanager
async def reading(control: PrintingControl, serial: bool, settings_: Dprnt = SETTINGS) -> AsyncIterator[Bench]:
    where = {"port": control.address, "address": ""} if serial else {"address": control.address}
    settings_ = replace(settings_, **where)  # type: ignore[arg-type]
    bench, stop = Bench(settings_), asyncio.Event()
    stream = Stream(settings_, bench.printed, bench.reports.append)
    task = asyncio.create_task(stream.run(stop))
    try:
        await until(lambda: any("connected" in report for report in bench.reports), "connected")
        if not serial:
            await until(lambda: control.clients == 1, "accepted")
        yield bench
    finally:
        stop.set()
        await asyncio.wait_for(task, 10.0)


async def settled() -> None:
    """Let the line be quiet for `settle_s`."""
    await asyncio.sleep(3 * SETTINGS.settle_s)


@pytest.mark.parametrize("maker", ["fanuc", "fanuc-no-blanks", "haas", "mitsubishi"])
@pytest.mark.parametrize(("serial", "parity"), [(False, False), (False, True), (True, False), (True, True)])
async def test_every_control_over_every_line(maker: Maker, serial: bool, parity: bool) -> None:
    bits = {"bits": "7E" if parity else "8N"}
    with Rack() as rack:
        control = rack.add(PrintingControl(maker, serial=serial, parity=parity))
        async with reading(control, serial, replace(SETTINGS, **bits)) as bench:  # type: ignore[arg-type]
            await settled()
            control.run_macro(MACRO, VARIABLES)
            await until(lambda: bench.probes, lambda: str(bench.reports))
            control.run_macro(MACRO + MACRO, VARIABLES | {101: -4.0, 102: 4.0})  # two at once
            await until(lambda: len(bench.probes) == 3, lambda: str(bench.reports))
    assert [probe.measured_um for probe in bench.probes] == [-3.2, 4.0, 4.0]
    assert {(p.feature, p.tool, p.offset_applied_um) for p in bench.probes} == {("1", "99", -12.3)}


@pytest.mark.parametrize("serial", [False, True])
async def test_noise_half_lines_and_a_lost_connection(serial: bool) -> None:
    with Rack() as rack:
        control = rack.add(PrintingControl("haas", serial=serial))
        async with reading(control, serial) as bench:
            await settled()
            for length in (1, 40, 3000):
                control.send(control.noise(length) + b"\r")
            control.send(LINE[:25])
            control.send(LINE[25:])
            await until(lambda: len(bench.probes) == 1, lambda: str(bench.reports))
            assert any("[line_broken]" in report for report in bench.reports)
            control.send(LINE[:25])
            control.unplug()
            await until(lambda: any("[source_lost]" in report for report in bench.reports), "lost")
            control.plug()
            await until(lambda: sum("connected" in r for r in bench.reports) >= 2, lambda: str(bench.reports))
            await settled()
            control.send(LINE[25:])  # the rest of a line of the connection before
            control.send(LINE)
            await until(lambda: len(bench.probes) == 2, lambda: str(bench.reports))
        assert len(bench.probes) == 2


async def test_lines_that_a_converter_kept_are_refused() -> None:
    with Rack() as rack:
        control = rack.add(PrintingControl("fanuc", keeps=True))
        control.run_macro(MACRO * 3, VARIABLES)  # while nobody reads
        async with reading(control, False) as bench:
            await until(lambda: sum("[line_age_unknown]" in r for r in bench.reports) == 3, lambda: str(bench.reports))
            await settled()
            control.run_macro(MACRO, VARIABLES)
            await until(lambda: len(bench.probes) == 1, lambda: str(bench.reports))
        assert len(bench.probes) == 1


async def test_a_program_that_stood_still_does_not_trust_what_it_then_reads() -> None:
    now = {"s": 0.0}
    with Rack() as rack:
        control = rack.add(PrintingControl("fanuc"))
        where = replace(SETTINGS, address=control.address)
        bench, stop = Bench(where), asyncio.Event()
        stream = Stream(where, bench.printed, bench.reports.append, clock=lambda: now["s"])
        task = asyncio.create_task(stream.run(stop))
        await until(lambda: control.clients == 1 and bench.reports, "connected")
        now["s"] += 1.0
        control.run_macro(MACRO, VARIABLES)
        await until(lambda: bench.probes, lambda: str(bench.reports))
        now["s"] += 60.0  # the computer slept
        control.run_macro(MACRO, VARIABLES)
        await until(lambda: any("[line_age_unknown]" in r for r in bench.reports), lambda: str(bench.reports))
        now["s"] += 1.0
        control.run_macro(MACRO, VARIABLES)
        await until(lambda: len(bench.probes) == 2, lambda: str(bench.reports))
        stop.set()
        await asyncio.wait_for(task, 10.0)
