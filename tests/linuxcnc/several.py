"""X, Y and Z at the control: a tool change, a table that moves, and a sample that is not whole."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tests.linuxcnc.control import SHIPPED, Control, changed, linuxcnc
from tests.receiver.offsets import slope
from tests.receiver.wire import ScriptedService, router, until
from tests.soak.axes_site import FREE, GAUGE_MM, PERIOD_S, RATES, Axes, AxesSite, levers
from tests.soak.site import end

SAMPLER = """
loadrt sampler depth=8192 cfg=ffffff
addf sampler.0 servo-thread
net x-position => sampler.0.pin.0
net y-position => sampler.0.pin.1
net z-position => sampler.0.pin.2
net x-program axis.x.pos-cmd => sampler.0.pin.3
net y-program axis.y.pos-cmd => sampler.0.pin.4
net z-program axis.z.pos-cmd => sampler.0.pin.5
"""
PORT = 7447
AXES = ("x", "y", "z")
#: A joint may be this far from where it should be, µm.
NEAR_UM = 0.1
#: While the table moves, the offset is one of a place where it was in this time, servo periods of 1 ms; the component
#: is no real-time program, and waits for its turn on a busy computer.
LAG = 1500
#: A component whose offset stands for longer than this while the table moves has not had its turn, servo periods. What
#: it lacks then it catches up slowly: the permitted rate is little more than the slope asks for.
TURN = 200
#: Longest step of an offset in a servo period, µm.
STEP_UM = 0.2
#: 60 µm/m over Y, 20 µrad for a tool of 100 mm; the tool in T1 has 150 mm.
SLOPE, ANGLE, REFERENCE_MM, TOOL_MM = 60.0, 20.0, 100.0, 150.0
TABLE = f"T1 P1 Z{TOOL_MM}\n"
#: In the coordinates of the tool, which is longer than the travel of Z.
PROGRAM = "G21 G90 G17 G64\nG1 X10 Y8 Z-155 F3000\nG4 P0.3\nG1 X0 Y50 Z-150\nG4 P0.3\nM2\n"


class Joints(NamedTuple):
    """One servo period, µm: joints and program of X, Y and Z."""

    motor_um: tuple[float, ...]
    program_um: tuple[float, ...]

    @classmethod
    def read(cls, words: list[str]) -> Joints:
        um = [1000.0 * float(word) for word in words]
        return cls(tuple(um[:3]), tuple(um[3:]))


def settings() -> str:
    """The shipped settings, ten µm a second instead of eight a minute; Y two, less than the slope asks for."""
    text = (SHIPPED / "thermal_axes.toml").read_text(encoding="utf-8")
    text = changed(
        text,
        {"rate_max_um_per_min = 8.0": "rate_max_um_per_min = 600.0", "slew_um_per_s = 10.0": "slew_um_per_s = 20.0"},
    )
    of_y = "[axis.y]\noffset_max_um = 100.0\noffset_rate_max_um_per_min = "
    return changed(text, {f"{of_y}600.0": f"{of_y}120.0"})


def smooth(periods: Sequence[Joints]) -> None:
    """No offset jumps: each joint is program and offset, two periods later."""
    assert len(periods) > 20
    offsets = [[d.motor_um[i] - b.program_um[i] for i in range(3)] for b, d in zip(periods, periods[2:], strict=False)]
    steps = [max(abs(b - a) for a, b in zip(*pair, strict=True)) for pair in itertools.pairwise(offsets)]
    worst = max(range(len(steps)), key=steps.__getitem__)
    assert steps[worst] <= STEP_UM, (steps[worst], periods[max(worst - 3, 0) : worst + 7])


def waited(offset_um: Sequence[float]) -> list[int]:
    """For how many servo periods until each one the component has waited for its turn."""
    found, stands = [0], 0
    for before, now in itertools.pairwise(offset_um):
        stands = stands + 1 if abs(now - before) < 1e-6 else 0
        found.append(found[-1] + (TURN if stands == TURN else stands > TURN))
    return found


class Bench:
    """A control with three axes, and the service that says what the test says, if that is not the real one."""

    def __init__(self, control: Control, service: ScriptedService | None = None) -> None:
        self.control, self.service = control, service
        self.seq = 0

    def put(self, x: float, y: float, z: float, *, without: str = "") -> None:
        assert self.service is not None
        self.seq += 1
        angle: dict[str, Any] = {"value": ANGLE, "reference_mm": REFERENCE_MM}
        self.service.put_axes(self.seq, without=without, x=x, y={"value": y, **slope(SLOPE)}, z=z, a=angle)

    def pin(self, name: str) -> Any:
        return self.control.get(f"thermal-offset.{name}")

    def offsets_um(self) -> dict[str, float]:
        """What each joint is away from what is programmed."""
        motors = [self.control.um(f"joint.{i}.motor-pos-cmd") for i in range(3)]
        programs = [self.control.um(f"axis.{axis}.pos-cmd") for axis in AXES]
        return {axis: motors[i] - programs[i] for i, axis in enumerate(AXES)}

    def arrive(self, **offsets_um: float) -> None:
        """Each joint is at what is programmed and its offset."""
        self.follow(lambda: offsets_um)

    def follow(self, wanted_um: Callable[[], Mapping[str, float]]) -> None:
        """Each joint is at what is programmed and what is wanted then."""

        def off_um() -> dict[str, float]:
            found = self.offsets_um()
            return {axis: found[axis] - um for axis, um in wanted_um().items()}

        until(
            lambda: self.pin("arrived") and all(abs(um) < NEAR_UM for um in off_um().values()),
            lambda: f"off by {off_um()}, Y goes to {self.pin('y.offset-um')}",
        )


@contextmanager
def machine(folder: Path) -> Iterator[tuple[Control, Path]]:
    """A control with three axes and a tool table."""
    folder.mkdir(mode=0o777, exist_ok=True)
    (folder / "tool.tbl").write_text(TABLE, encoding="utf-8")
    ini = {
        "HALFILE = thermal.hal": "HALFILE = thermal_axes.hal\nHALFILE = sampler.hal",
        "EMCIO = io\n": "EMCIO = io\nTOOL_TABLE = tool.tbl\n",
        "[AXIS_X]\n": "[AXIS_X]\nOFFSET_AV_RATIO = 0.01\n",
        "[AXIS_Z]\n": "[AXIS_Z]\nOFFSET_AV_RATIO = 0.01\n",
    }
    with linuxcnc(folder, settings(), sampler=SAMPLER, read=Joints.read, **ini) as started:
        yield started


def axes(folder: Path) -> None:
    """From the samples to three joints."""
    with router(PORT), ScriptedService(PORT) as service, machine(folder) as (control, log):
        bench = Bench(control, service)
        with control.watched() as periods:
            _start(bench)
            _tool(bench)
        smooth(periods)
        _table(bench)
        _not_whole(bench, log)
        _program(bench)
        text = log.read_text(errors="replace")
        assert "thermal-offset: following" in text and "Traceback" not in text, text
        assert not [line for line in control.do("failures") if "joint" in line.lower()]


def _start(bench: Bench) -> None:
    """Published in emergency stop; there once the machine can move. No tool is measured: that of the reference."""
    bench.put(3.0, 4.0, -5.0)
    until(lambda: abs(bench.pin("z.offset-um") + 5.0) < 0.01, "the component has it")
    bench.control.do("states", "ESTOP_RESET")
    bench.control.do("states", "ON")
    bench.control.do("home")
    bench.control.do("teleop")
    bench.arrive(x=3.0, y=4.0, z=-5.0)


def _tool(bench: Bench) -> None:
    """With the tool's length the angle comes to Y, and goes with it."""
    longer_um = ANGLE * (TOOL_MM - REFERENCE_MM) / 1000.0
    bench.control.do("mdi", "T1 M6 G43")
    bench.arrive(x=3.0, y=4.0 + longer_um, z=-5.0)
    bench.control.do("mdi", "G49")
    bench.arrive(x=3.0, y=4.0, z=-5.0)
    bench.control.do("mdi", "G43")
    bench.arrive(x=3.0, y=4.0 + longer_um, z=-5.0)


def _table(bench: Bench) -> None:
    """The offset of Y follows its position while it moves, and the others stay."""
    for y_mm in (90.0, -30.0, 50.0):
        with bench.control.watched() as periods:
            bench.control.do("mdi", f"G1 F1800 Y{y_mm:g}")
            bench.arrive(x=3.0, y=5.0 + SLOPE * y_mm / 1000.0, z=-5.0)
        offsets = [
            [motor - program for motor, program in zip(later.motor_um, period.program_um, strict=True)]
            for period, later in zip(periods, periods[2:], strict=False)
        ]
        late = waited([y_um for _, y_um, _ in offsets])
        for at in range(LAG, len(offsets)):
            x_um, y_um, z_um = offsets[at]
            since = max(at - LAG - late[at], 0)
            places_mm = [period.program_um[1] / 1000.0 for period in periods[since : at + 1]]
            least, most = (5.0 + SLOPE * place / 1000.0 for place in (min(places_mm), max(places_mm)))
            assert least - NEAR_UM < y_um < most + NEAR_UM, (at, y_um, least, most)
            assert abs(x_um - 3.0) < NEAR_UM and abs(z_um + 5.0) < NEAR_UM
        smooth(periods)


def _not_whole(bench: Bench, log: Path) -> None:
    """A sample without Z moves neither X nor Y."""
    with bench.control.watched() as periods:
        bench.put(9.0, 9.0, 9.0, without="z")
        until(lambda: "[incomplete]" in log.read_text(errors="replace"), "it is said")
        bench.arrive(x=3.0, y=8.0, z=-5.0)
        bench.put(-2.0, 1.0, 2.0)
        bench.arrive(x=-2.0, y=5.0, z=2.0)
    smooth(periods)


def _program(bench: Bench) -> None:
    """A sample arrives while a program moves all three."""
    part = bench.control.folder / "part.ngc"
    part.write_text(PROGRAM, encoding="utf-8")
    with bench.control.watched() as periods:
        bench.control.do("start", str(part))
        bench.put(1.0, -1.0, 4.0)
        until(lambda: not bench.control.do("running"), "the program's end")
        bench.arrive(x=1.0, y=3.0, z=4.0)
    smooth(periods)


# ---------------------------------------------------------------------- the service itself


def service_axes(folder: Path) -> None:
    """The real service of five outputs moves three joints, with a tool change, a moved table and a kill."""
    endpoint = f"tcp/127.0.0.1:{PORT}"
    with (
        router(PORT),
        Axes("shop/vmc-07", mode="client", connect__endpoints=[endpoint], connect__timeout_ms=10_000) as heard,
        AxesSite(folder.parent, dict.fromkeys(RATES, FREE), connect=[endpoint], period_s=PERIOD_S) as site,
        machine(folder) as (control, log),
    ):
        bench = Bench(control)

        def follow(y_mm: float, tool_mm: float) -> None:
            def wanted() -> dict[str, float]:
                seq = heard.newest()
                return heard.wanted_um(seq, levers(y_mm, tool_mm), time.monotonic() - heard.came_s[seq])

            bench.follow(wanted)

        process = site.start()
        try:
            until(lambda: abs(heard.whole.get(heard.newest(), {}).get("z_offset_um") or 0.0) > 1.0, "an offset")
            control.do("states", "ESTOP_RESET")
            control.do("states", "ON")
            control.do("home")
            control.do("teleop")
            control.do("mdi", "G0 X0 Y0 Z0")
            with control.watched() as periods:
                follow(0.0, GAUGE_MM)
                control.do("mdi", "T1 M6 G43")
                follow(0.0, TOOL_MM)
                control.do("mdi", "G0 Y90")
                follow(90.0, TOOL_MM)
                end(process)  # kill −9
                until(lambda: not bench.pin("alive") and bench.pin("state") == 2, "it holds")
                held = stands(bench)
                time.sleep(1.0)
                assert bench.offsets_um() == held
                process = site.start()
                until(lambda: bench.pin("alive") and bench.pin("fresh"), "it goes on")
                follow(90.0, TOOL_MM)
            smooth(periods)
        finally:
            end(process)
        text = log.read_text(errors="replace")
        assert "thermal-offset: following" in text and "Traceback" not in text, text
        assert not [line for line in control.do("failures") if "joint" in line.lower()]


def stands(bench: Bench) -> dict[str, float]:
    """Wait until the axes stand; a last change may still be on its way to the control."""
    seen = [bench.offsets_um()]

    def still() -> bool:
        time.sleep(0.2)
        seen.append(bench.offsets_um())
        return seen[-1] == seen[-2]

    until(still, "the axes stand")
    return seen[-1]
