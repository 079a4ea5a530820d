"""A simulated machine for trials: a recorded day, then the real service in real time.

Devices with their protocols, the service on loopback and the recordings behave as on a real machine. Typed commands
inject sensor faults.
"""

from __future__ import annotations

import asyncio
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

from rich.console import Console
from rich.progress import Progress

from compensator.commands.stopping import on_stop
from compensator.demo.calibration import calibrate
from compensator.demo.clock import LateClock
from compensator.demo.loop import EFFECT_UM
from compensator.demo.machine import MACHINES, Hardware, configuration, hardware
from compensator.errors import UsageError
from compensator.service.composition import run_service
from compensator.service.loading import load
from compensator.service.presence import sole_user
from sim_hardware.physics import Duty, World, draw_effect, usual_sensors
from sim_hardware.wire import Faults

#: Sensors that can be broken, by their typed name: faults of the device, and input number.
Breakable = Mapping[str, tuple[Faults, int]]

MACHINE, PREFIX = "vmc-07", "shop/vmc-07"
#: Length of the duty cycle after the history, h; after that its last inputs remain.
AFTER_H = 7 * 24.0
#: Older messages of the simulated past are not published, s: to a receiver the service would appear to be silent.
PRESENT_S = 120.0
#: Plausibility checks, which detect the undeclared effect of this machine.
CHECKS = """
[plausibility]
t_q_below_at_after_min = 15.0
false_alarm_days = 30.0
sensor_must_fit = true
"""
#: A value that stands still is noticed after this time here, min; a real machine allows hours, as air may be still.
STUCK_AFTER_MIN = {"t_q": 15.0, "at": 15.0, "y": 3.0}
#: A value that stands still is counted from the first whole sample on, and a fault is published with the next sample.
_SEEN_MIN = 2.0
#: Longest line that is read as a typed command, characters, and the shortest time between two, s.
_LONGEST, _PAUSE_S = 200, 0.1
#: Faults of an input by typed command, and faults of a whole device by sensor.
INPUT_FAULTS = {"break": "open", "freeze": "frozen"}
UNPLUG = {"t_q": "silence", "at": "silence", "y": "disconnect"}


def run_live(out: Path, *, hours: float, seed: int, port: int, typed: IO[str] | None = None) -> Path:
    """Run a simulated machine and its service until SIGTERM or SIGINT.

    Parameters
    ----------
    out : pathlib.Path
        Folder of the demo. The files of this machine are in its folder `live`; the model is that of `conduction`, which
        is calibrated first if it does not exist.
    hours : float
        Length of the simulated past before real time starts, h.
    seed : int
        Seed of duty cycle, sensors and undeclared effect; the effect is that of the demo with the same seed.
    port : int
        TCP port of the service on loopback.
    typed : file, optional
        Source of the typed commands; stdin by default.

    Returns
    -------
    pathlib.Path
        The folder of the recordings.

    Raises
    ------
    UsageError
        If the length is negative.
    ServiceError
        If such a machine is already running, or the port is in use.
    """
    if hours < 0:
        raise UsageError(f"--hours {hours:g}: expected 0 or more")
    folder = out / "live"
    recordings = folder / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    with sole_user(recordings, MACHINE):
        _clear(recordings)
    if not (out / "conduction" / "calibration" / "model.toml").exists():
        sys.stderr.write("calibrating the machine first\n")
        calibrate(out / "conduction", machine="conduction", seed=seed)
    duty = Duty.working_day(seed + 3, hours=hours + AFTER_H)
    effect = draw_effect(seed, EFFECT_UM, hours or 24.0)
    world = World(MACHINES["conduction"](effects=[effect]), duty, usual_sensors(duty.extra_names), seed)
    with hardware(world) as devices:
        config = folder / "config.toml"
        model = "../conduction/calibration/model.toml"
        text = _noticing(configuration(MACHINE, devices.lines, port, model, prefix=PREFIX)) + CHECKS
        config.write_text(text, encoding="utf-8")
        asyncio.run(_serve(config, world, devices, hours, lambda: _explain(out, config, port), typed or sys.stdin))
    return recordings


def _noticing(text: str) -> str:
    """Return a configuration in which a frozen value is noticed while somebody watches."""
    for name, minutes in zip(("t_q_degc", "at_degc", "y_um"), STUCK_AFTER_MIN.values(), strict=True):
        before, channel, after = text.partition(f'[[channel]]\nname = "{name}"\n')
        text = before + channel + re.sub(r"stuck_after_min = [\d.]+", f"stuck_after_min = {minutes}", after, count=1)
    return text


def _clear(recordings: Path) -> None:
    """Remove the recordings of an earlier machine, which the service would continue."""
    for path in recordings.iterdir():
        if path.suffix != ".lock":
            shutil.rmtree(path) if path.is_dir() else path.unlink()


async def _serve(
    config: Path, world: World, devices: Hardware, hours: float, explain: Callable[[], None], typed: IO[str] | None
) -> None:
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as progress:
        bar = progress.add_task("simulated past", total=hours * 3600.0)

        async def advance(t_s: float) -> None:
            world.advance_to(t_s)
            devices.capa.push(1)
            progress.update(bar, completed=t_s)

        def on_time() -> None:
            progress.stop()
            explain()
            threading.Thread(target=_read_commands, args=(typed, devices.faults), daemon=True).start()

        clock = LateClock(hours * 3600.0, advance, on_time)
        await run_service(
            load(str(config)),
            clock=clock,
            on_ready=lambda daemon: on_stop(daemon.stop),
            publishes=lambda: clock.behind_s < PRESENT_S,
        )


def _explain(out: Path, config: Path, port: int) -> None:
    sys.stderr.write(f"""
{MACHINE} is running with a recorded history, and publishes an offset every minute. In another terminal:
  compensator watch --config {config}              with --page: a live page
  python deploy/examples/subscriber.py tcp/127.0.0.1:{port} {PREFIX}              one line per minute
  compensator hold --config {config}               and: resume, zero
The machine has an effect that its model lacks. To find it and extend the model:
  compensator diagnose {config.parent}/recordings/*.mcap --model {out}/conduction/calibration/model.toml --out diagnosis
  compensator adopt diagnosis/model.toml --config {config}              and back
Type here:  break t_q | at | y    wire broken            freeze …    value frozen
            unplug t_q | at | y   device disconnected    mend        repair all
Ctrl-C ends the demo.
""")
    sys.stderr.flush()


def _read_commands(typed: IO[str] | None, faults: Breakable) -> None:
    """Execute typed commands until the end of the input, which may be closed, endless, or no text."""
    while typed is not None:
        try:
            line = typed.readline(_LONGEST)
        except ValueError:
            line = "\0"
        if not line:
            return
        if "\0" in line or (len(line) == _LONGEST and not line.endswith("\n")):
            sys.stderr.write("The input is no text: typed commands are not read any more.\n")
            return
        sys.stderr.write(apply_fault(line, faults) + "\n")
        sys.stderr.flush()
        # Nobody types faster; what writes to the input without an end must not keep the machine from its samples.
        time.sleep(_PAUSE_S)


def apply_fault(line: str, breakable: Breakable) -> str:
    """Inject a sensor fault or repair all sensors by a typed command; return what was done.

    Parameters
    ----------
    line : str
        Command, such as `break t_q`.
    breakable : mapping of str to (Faults, int)
        The sensors, as in `Hardware`.
    """
    word, _, name = line.strip().partition(" ")
    if line.strip() == "mend":
        for faults, number in breakable.values():
            faults.clear()
            faults.clear(input=number)
        return "all sensors repaired"
    if name in breakable and (word in INPUT_FAULTS or word == "unplug"):
        faults, number = breakable[name]
        if word == "unplug":
            faults.set(UNPLUG[name])
        else:
            faults.set(INPUT_FAULTS[word], input=number)
        seen_min = _SEEN_MIN + (STUCK_AFTER_MIN[name] if word == "freeze" else 0.0)
        return f"{word} {name}: done; visible within {seen_min:g} minutes"
    words = ", ".join([*INPUT_FAULTS, "unplug"])
    return f"{line.strip()!r}: expected one of {words} with one of {', '.join(breakable)}; or mend"
