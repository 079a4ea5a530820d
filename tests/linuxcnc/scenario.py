"""What happens at a control, from the operator's panel to the joint; in namespaces of its own.

The first error ends it with a traceback; the test around it shows that.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import zenoh

from compensator.demo.machine import configuration, hardware
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.linuxcnc.control import SHIPPED, Control, Period, changed, linuxcnc
from tests.linuxcnc.several import axes, service_axes
from tests.receiver.wire import ScriptedService, router, until

PORT = 7447
#: The joint may be this far from where it should be, and move this much in a servo period, µm.
NEAR_UM, STEP_UM = 0.1, 0.2
#: What LinuxCNC itself may do in a period when it takes an offset away: OFFSET_AV_RATIO of 100 mm/s.
OWN_STEP_UM = 1.0
PROGRAM = "G21 G90 G17 G64\nG0 X0 Y0\nG1 X10 Y8 F900\nG4 P0.3\nG1 X0 Y2\nG4 P0.3\nG0 Y1\nM2\n"


def settings(prefix: str = "shop/vmc-07") -> str:
    """The shipped settings, ten µm a second instead of eight a minute."""
    text = (SHIPPED / "thermal.toml").read_text(encoding="utf-8")
    return changed(
        text,
        {
            "max_um_per_min = 8.0 ": "max_um_per_min = 600.0 ",
            "slew_um_per_s = 10.0": "slew_um_per_s = 20.0",
            "fade_um_per_min = 20.0": "fade_um_per_min = 300.0",
            '"shop/vmc-07"': f'"{prefix}"',
        },
    )


def still(periods: list[Period], most_um: float = STEP_UM) -> None:
    """Nothing jumps while no program moves the axis."""
    assert len(periods) > 20
    steps = [abs(b.motor_um - a.motor_um) for a, b in itertools.pairwise(periods)]
    worst = max(range(len(steps)), key=steps.__getitem__)
    assert steps[worst] <= most_um, (steps[worst], periods[max(worst - 3, 0) : worst + 4])


def in_motion(periods: list[Period]) -> None:
    """Nothing jumps while a program moves the axis: the joint is program and offset, two periods later."""
    steps = [
        abs((d.motor_um - b.program_um) - (c.motor_um - a.program_um))
        for a, b, c, d in zip(periods, periods[1:], periods[2:], periods[3:], strict=False)
    ]
    worst = max(range(len(steps)), key=steps.__getitem__)
    assert steps[worst] <= 2 * STEP_UM, (steps[worst], periods[max(worst - 3, 0) : worst + 7])


class Bench:
    """A control with what it reads of its own."""

    def __init__(self, control: Control) -> None:
        self.control = control

    def on(self) -> None:
        self.control.do("states", "ESTOP_RESET")
        self.control.do("states", "ON")

    def arrive(self, offset_um: float, nominal_um: float = 0.0) -> None:
        """The joint is at nominal and offset."""
        until(
            lambda: abs(self.control.um() - nominal_um - offset_um) < NEAR_UM and self.pin("arrived"),
            lambda: f"{nominal_um} + {offset_um} µm: joint at {self.control.um()}, {self.pin('offset-um')} asked for",
        )

    def pin(self, name: str) -> Any:
        return self.control.get(f"thermal-offset.{name}")

    def program(self, while_running: Callable[[], None]) -> list[Period]:
        path = self.control.folder / "part.ngc"
        path.write_text(PROGRAM, encoding="utf-8")
        with self.control.watched() as periods:
            self.control.do("start", str(path))
            while_running()
            until(lambda: not self.control.do("running"), "the program's end")
        return periods


# ---------------------------------------------------------------------- a service that says what the test says


def scripted(folder: Path) -> None:
    with router(PORT), ScriptedService(PORT) as service, linuxcnc(folder, settings()) as (control, log):
        bench = Bench(control)
        _start(bench, service)
        _part(bench, service)
        _stops(bench, service)
        _told(bench, service)
        _reloaded(bench, service)
        text = log.read_text(errors="replace")
        assert "thermal-offset: following" in text and "Traceback" not in text, text
        assert not [line for line in control.do("failures") if "joint" in line.lower()]


def _start(bench: Bench, service: ScriptedService) -> None:
    """Published while the machine is in emergency stop; it is there once the machine is on, homed and can move."""
    control = bench.control
    with control.watched() as periods:
        service.put(1, 5.0)
        until(lambda: abs(bench.pin("offset-um") - 5.0) < 0.01, "the component has it")
        assert not bench.pin("ready") and not bench.pin("arrived") and control.um() == 0.0
        bench.on()
        assert control.um() == 0.0
        control.do("home")
        bench.arrive(5.0)
        control.do("joints")  # a change would be taken here, and leap out when the mode is left
        service.put(2, -2.0)
        until(lambda: abs(bench.pin("offset-um") + 2.0) < 0.01, "the component has it")
        assert abs(control.um("axis.y.eoffset-request") - 5.0) < 0.01 and not bench.pin("ready")
        assert abs(bench.pin("applied-um") - 5.0) < 0.01
        control.do("teleop")
        bench.arrive(-2.0)
    still(periods)


def _part(bench: Bench, service: ScriptedService) -> None:
    control = bench.control
    control.do("mdi", "G0 X0 Y0")
    periods = bench.program(lambda: service.put(3, -4.0))
    in_motion(periods)
    bench.arrive(-4.0, 1000.0)  # the program ends at Y1
    dwelt = [p for a, p in itertools.pairwise(periods) if a.program_um == p.program_um == 2000.0]
    assert dwelt and abs(dwelt[-1].motor_um - 2000.0 - dwelt[-1].eoffset_um) < NEAR_UM
    control.do("mdi", "G0 X0 Y0")
    bench.arrive(-4.0)


def _stops(bench: Bench, service: ScriptedService) -> None:
    """Emergency stop and off, with the offset at rest and on its way."""
    control = bench.control
    for seq, (stop, back) in enumerate((("ESTOP", -6.0), ("OFF", -5.0)), 4):
        with control.watched() as periods:
            at_um = control.um()
            control.do("states", stop)
            service.put(seq, back)
            until(lambda back=back: abs(bench.pin("offset-um") - back) < 0.01, "the component has it")
            assert abs(control.um() - at_um) < 0.001
            bench.on()
            control.do("teleop")
            # LinuxCNC has taken the offset into the position, so the joint goes on from there …
            bench.arrive(back, at_um)
        still(periods)
        control.do("mdi", "G0 Y0")  # … until the next absolute move puts the position right.
        bench.arrive(back)
    with control.watched() as periods:
        service.put(6, -15.0)
        until(lambda: control.um("axis.y.eoffset") < -7.0, "it is on its way")
        control.do("states", "ESTOP")
        bench.on()
        control.do("teleop")
        until(lambda: bench.pin("arrived"), "it goes on")
    still(periods)
    control.do("mdi", "G0 Y0")
    bench.arrive(-15.0)


def _told(bench: Bench, service: ScriptedService) -> None:
    control = bench.control
    with control.watched() as periods:  # the operator clears the external offsets
        assert control.do("halcmd", "sets", "y-clear", "1") == [0, ""]
        until(
            lambda: abs(control.um("axis.y.eoffset")) < 0.001 and abs(control.um()) < NEAR_UM,
            lambda: f"cleared: {control.um('axis.y.eoffset')}, joint at {control.um()}",
        )
        service.put(7, -12.0)
        control.do("halcmd", "sets", "y-clear", "0")
        bench.arrive(-12.0)
    still(periods, OWN_STEP_UM)
    with control.watched() as periods:
        service.put(8, -2.0)
        until(lambda: control.um("axis.y.eoffset") > -11.0, "it is on its way")
        control.do("halcmd", "setp", "thermal-offset.enable", "0")
        until(lambda: bench.pin("state") == 2 and not bench.pin("fresh"), "it holds")
        control.do("halcmd", "setp", "thermal-offset.fade", "1")
        until(lambda: bench.pin("state") == 3 and abs(control.um()) < NEAR_UM, "it has faded")
        control.do("halcmd", "setp", "thermal-offset.enable", "1")
        control.do("halcmd", "setp", "thermal-offset.fade", "0")
        bench.arrive(-2.0)
        for bad in (float("nan"), 500.0):
            service.put(9, bad)
        service.put(8, 50.0)
        service.put(9, -3.0, state="hold")
        until(lambda: bench.pin("state") == 2, "it holds")
        assert abs(control.um() + 2.0) < NEAR_UM
        service.put(10, -3.0)
        bench.arrive(-3.0)
    still(periods)
    # In coordinated mode LinuxCNC forgets the rest of a move that was interrupted.
    control.do("mdi", "G0 Y0")
    with control.watched() as periods:
        service.put(11, -9.0)
        until(lambda: control.um("axis.y.eoffset") < -5.0, "it is on its way")
        control.do("halcmd", "setp", "axis.y.eoffset-enable", "0")
        until(lambda: not bench.pin("ready"), "it is noticed")
        control.do("halcmd", "setp", "axis.y.eoffset-enable", "1")
        bench.arrive(-9.0)
    still(periods)


def _reloaded(bench: Bench, service: ScriptedService) -> None:
    control = bench.control
    load = ("loadusr", "-Wn", "{}", "./python", "./thermal_offset.py", "--config", "thermal.toml", "--name", "{}")
    counts = control.get("axis.y.eoffset-counts")
    with control.watched() as periods:
        assert control.do("halcmd", "unload", "thermal-offset")[0] == 0
        until(lambda: "thermal-offset" not in control.do("halcmd", "show", "comp")[1], "the component is gone")
        service.put(12, -8.0, heard=False)
        assert control.get("axis.y.eoffset-counts") == counts
        code, text = control.do("halcmd", *(word.format("thermal-offset") for word in load))
        assert code == 0, text
        assert control.do("halcmd", "net", "thermal-counts", "thermal-offset.counts")[0] == 0
        assert control.get("axis.y.eoffset-counts") == counts and not bench.pin("fresh")
        control.do("halcmd", "setp", "thermal-offset.enable", "1")
        service.put(13, -8.0)
        bench.arrive(-8.0)
    still(periods)
    with control.watched() as periods:  # kill -9: HAL keeps a dead component and its pin; another one takes over
        line = next(line for line in control.do("halcmd", "show", "comp")[1].splitlines() if "thermal-offset" in line)
        os.kill(int(line.split()[3]), signal.SIGKILL)
        code, text = control.do("halcmd", *(word.format("thermal-again") for word in load))
        assert code == 0, text
        assert control.do("halcmd", "unlinkp", "thermal-offset.counts")[0] == 0
        assert control.do("halcmd", "net", "thermal-counts", "thermal-again.counts")[0] == 0
        control.do("halcmd", "setp", "thermal-again.enable", "1")
        service.put(14, -7.0)
        until(lambda: control.get("thermal-again.arrived") and abs(control.um() + 7.0) < NEAR_UM, "it goes on")
    still(periods)


# ---------------------------------------------------------------------- the service itself


class Witness:
    """Reads what is published, apart from everything, and says what the joint should have."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.messages: list[tuple[float, dict[str, Any]]] = []

    @contextmanager
    def listening(self) -> Iterator[None]:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{PORT}"]')
        with zenoh.open(config) as session:
            session.declare_subscriber(f"{self.prefix}/thermal/y/offset", self._take)
            yield

    def _take(self, sample: Any) -> None:
        self.messages.append((time.monotonic(), json.loads(sample.payload.to_bytes())))

    def heard(self) -> int:
        return len(self.messages)

    def wanted_um(self) -> float:
        at_s, message = self.messages[-1]
        return float(message["y_offset_um"] + message["y_offset_rate_um_per_min"] * (time.monotonic() - at_s) / 60.0)


@contextmanager
def machine(folder: Path) -> Iterator[Path]:
    """A machine that warms up in real time, and its configuration with a sample a second."""
    duty = Duty.working_day(1, hours=2)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    world.advance_to(1850.0)
    ended = threading.Event()

    def warm() -> None:
        at_s = 1850.0
        while not ended.wait(0.1):
            at_s += 1.0
            world.advance_to(at_s)

    with hardware(world) as (lines, _, _):
        quill = (Path(__file__).parents[2] / "compensator/model/quill.toml").read_text(encoding="utf-8")
        # A day in minutes: what warms up that fast takes more heat than the machine has.
        fast = changed(quill, {"sample_period_s = 60.0": "sample_period_s = 1.0", "[-20.0, 120.0]": "[-9e3, 9e3]"})
        (folder / "fast.toml").write_text(fast, encoding="utf-8")
        text = configuration("vmc-07", lines, PORT, model="fast.toml")
        text = changed(
            text,
            {
                "poll_interval_s = 10.0": "poll_interval_s = 0.25",
                "max_um_per_min = 8.0": "max_um_per_min = 300.0",
                f'listen = ["tcp/127.0.0.1:{PORT}"]': f'connect = ["tcp/127.0.0.1:{PORT}"]',
            },
        )
        text = re.sub(r"(?m)^rate_max_per_min = .*$", "rate_max_per_min = 10000.0", text)
        path = folder / "machine.toml"
        path.write_text(text, encoding="utf-8")
        thread = threading.Thread(target=warm)
        thread.start()
        try:
            yield path
        finally:
            ended.set()
            thread.join()


@contextmanager
def running(config: Path) -> Iterator[subprocess.Popen[bytes]]:
    with (config.parent / "service.log").open("ab") as log:
        process = subprocess.Popen([sys.executable, "-m", "compensator", "run", "--config", str(config)], stderr=log)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def service(folder: Path) -> None:
    witness = Witness("shop/sim")
    with ExitStack() as stack:
        config = stack.enter_context(machine(folder.parent))
        shop = stack.enter_context(ExitStack())
        shop.enter_context(router(PORT))
        stack.enter_context(witness.listening())
        daemon = stack.enter_context(ExitStack())
        process = daemon.enter_context(running(config))
        control, _ = stack.enter_context(linuxcnc(folder, settings("shop/sim")))
        bench = Bench(control)
        bench.on()
        control.do("home")
        control.do("teleop")

        def follows(nominal_um: float = 0.0) -> None:
            until(
                lambda: bench.pin("arrived") and abs(control.um() - nominal_um - witness.wanted_um()) < NEAR_UM,
                lambda: f"{nominal_um} + {witness.wanted_um()} µm: joint at {control.um()}",
            )

        def holds() -> float:
            """Wait until it holds and the axis stands: a last change may still be on its way to the control."""
            until(lambda: not bench.pin("alive") and bench.pin("state") == 2, "it holds")
            seen = [math.nan]

            def stands() -> bool:
                seen.append(control.um())
                time.sleep(0.2)
                return seen[-1] == seen[-2]

            until(stands, "the axis stands")
            return seen[-1]

        until(lambda: witness.messages and abs(witness.messages[-1][1]["y_offset_um"] or 0.0) > 0.3, "an offset")
        control.do("mdi", "G0 Y0")
        follows()
        in_motion(bench.program(lambda: None))
        follows(1000.0)
        control.do("mdi", "G0 Y0")
        with control.watched() as periods:  # the router goes
            shop.close()
            at_um = holds()
            heard = witness.heard()
            time.sleep(1.0)
            assert control.um() == at_um and witness.heard() == heard
            shop.enter_context(router(PORT))
            until(lambda: witness.heard() > heard and bench.pin("fresh"), "it goes on")
            follows()
            process.kill()  # the service is killed
            process.wait()
            at_um, seq = holds(), witness.messages[-1][1]["seq"]
            time.sleep(1.0)
            assert control.um() == at_um
            daemon.enter_context(running(config))
            until(lambda: bench.pin("alive") and bench.pin("fresh"), "it goes on")
            follows()
            assert witness.messages[-1][1]["seq"] > seq
        still(periods)
        seqs = [message["seq"] for _, message in witness.messages]
        assert all(b > a for a, b in itertools.pairwise(seqs))


# ---------------------------------------------------------------------- a touch probe

#: Where the feature is, mm, and a switch that closes where the tip (the slide and the deformation) touches it.
FEATURE_MM = 50.0
TOUCH = """
source thermal_probe.hal
loadrt sum2
addf sum2.0 servo-thread
loadrt comp
addf comp.0 servo-thread
net y-position => sum2.0.in0
net deformation sum2.0.in1
net tip sum2.0.out => comp.0.in1
setp comp.0.in0 50.0
net touch comp.0.out => motion.probe-input
"""
PROBES = """
[probes]
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:7447"]
send_within_s = 900.0
applied_file = "applied.txt"

[[linuxcnc]]
file = "thermal-probe.txt"
feature = "bore"
nominal = 50.0
unit = "mm"
sign = -1
includes_offset = true
sign_checked = "the simulated machine, two offsets"
"""


def probing_settings() -> str:
    return changed(settings(), {"# applied_file": "applied_file"})


def probing(folder: Path) -> None:
    """The cycle probes where it is wanted; the value shows the deformation, whatever the offset."""
    with (
        router(PORT),
        ScriptedService(PORT) as service,
        linuxcnc(folder, probing_settings(), hal=TOUCH) as (control, _),
    ):
        bench = Bench(control)
        bench.on()
        control.do("home")
        config = folder / "probes.toml"
        config.write_text(PROBES, encoding="utf-8")
        command = [sys.executable, "-m", "compensator", "bridge", "probes", "--config", str(config)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            try:
                _probed(bench, service, process)
            finally:
                process.terminate()


def _probed(bench: Bench, service: ScriptedService, process: subprocess.Popen[str]) -> None:
    control, probes = bench.control, service.probes
    part = control.folder / "probe.ngc"
    cycle = (control.folder / "thermal_probe.ngc").read_text(encoding="utf-8").rpartition("M2")[0]
    part.write_text(cycle + "G20 G91 G55\no<thermal_probe> call\nG4 P0.5\nM2\n", encoding="utf-8")

    def run() -> None:
        control.do("start", str(part))
        until(lambda: not control.do("running"), "the program's end")

    for seq, (deformation_um, offset_um) in enumerate(((12.0, -8.0), (12.0, 0.0), (-5.0, 3.0)), 1):
        service.put(seq, offset_um)
        service.put_status(probe_wanted=False)
        bench.arrive(offset_um, control.um("axis.y.pos-cmd"))
        control.do("halcmd", "sets", "deformation", str(deformation_um / 1000.0))
        until(lambda: not bench.pin("probe-wanted"), "no probe is wanted")
        run()
        assert len(probes) == seq - 1 and abs(control.um("axis.y.pos-cmd") - 47_000.0 * (seq > 1)) < 1.0
        service.put_status(probe_wanted=True, wanted_by_ns=time.time_ns(), wanted_std_um=2.5)
        until(lambda: bench.pin("probe-wanted") and bench.pin("probe-by-s") == 0.0, "a probe is wanted")
        begin_ns = time.time_ns()
        run()
        until(lambda seq=seq: len(probes) == seq, "the probe at the service")
        probe = probes[-1]
        assert probe["feature"] == "bore" and begin_ns < probe["time_utc_ns"] < time.time_ns()
        # The touch is found in a servo period; at 60 mm/min that is 1 µm, and the probe is read two periods later.
        assert abs(probe["offset_applied_um"] - offset_um) < 0.05
        assert abs(probe["measured_um"] - probe["offset_applied_um"] - deformation_um) < 3.0, probe


# ---------------------------------------------------------------------- what must not start


def refused(folder: Path) -> None:
    """An axis that would never move, and settings that cannot be right, stop LinuxCNC's start with one line."""
    for number, (ini, toml, expected) in enumerate(
        (
            ({"OFFSET_AV_RATIO = 0.01": ""}, ("", ""), "OFFSET_AV_RATIO = 0: expected above 0"),
            ({}, ("unit_um = 1000.0 ", "unit_um = 25400.0 "), "is another unit"),
        )
    ):
        one = folder.parent / f"refused-{number}"
        try:
            with linuxcnc(one, settings().replace(*toml), **ini):
                raise RuntimeError("it started")
        except AssertionError:
            text = (one / "linuxcnc.log").read_text(errors="replace")
        lines = [line for line in text.splitlines() if line.startswith("thermal-offset:")]
        assert len(lines) == 1 and expected in lines[0], text


if __name__ == "__main__":  # NAME FOLDER
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    place = Path(sys.argv[2])
    scenarios = (scripted, service, probing, refused, axes, service_axes)
    {one.__name__: one for one in scenarios}[sys.argv[1]](place / "control")
    print("done", flush=True)
