"""The whole loop on simulated hardware: a machine's day through real protocols, the service, disk and Zenoh.

The simulated machine, its sensors and its devices come from `sim_hardware` and share nothing with the
service. Time is handed in, so that the day takes seconds.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import json
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import zenoh
from rich.console import Console
from rich.progress import Progress

from compensator.clock import NS, VirtualClock
from compensator.commands import Answer
from compensator.commands.diagnose import diagnose_files
from compensator.commands.identify import Request, identify
from compensator.config import Zenoh, load_config
from compensator.errors import ServiceError
from compensator.identify.settings import Settings
from compensator.messages import Offset, number
from compensator.report.demonstration import MachineDay, page_of, verdict
from compensator.report.formats import checked, write
from compensator.service.asking import ask
from compensator.service.compensation import Outcome
from compensator.service.composition import run_service
from compensator.service.model_store import sha256_of
from compensator.service.session import session_config
from compensator.simulation import Scores, scores
from sim_hardware.physics import Duty, PublishedQuill, QuillMachine, World, draw_effect, usual_sensors
from sim_hardware.physics.effects.base import Effect
from sim_hardware.wire import (
    CapaNcdt,
    DconLine,
    IcpDas,
    ModbusRtuLine,
    ModbusTcpServer,
    Rack,
    Register,
    RegisterMap,
)

Vector = npt.NDArray[np.float64]

#: 2026-01-05 06:00 UTC, a Monday's early shift.
START_NS = 1_767_592_800 * NS
POLL_INTERVAL_S = 10.0
PROBE_RANGE_UM = 500.0

PERIOD_S = 60.0
CALIBRATION_H = 36.0
CALIBRATION_SEED = 1000
#: About how much the undeclared effect moves Y, µm standard deviation.
EFFECT_UM = 5.0
#: When the second day's service is asked to adopt the extended model, and what a poll then waits for it, s.
ADOPT_AFTER_S, ADOPT_PATIENCE_S = 3600.0, 0.02
#: Readings in a minute of the calibration's logger.
READINGS = 60
#: Full deflection of the paper's calibration, K and µm.
PAPER_K, PAPER_UM = 22.6, 116.0

MACHINES = {"conduction": QuillMachine, "published": PublishedQuill}


@dataclass(frozen=True, slots=True, kw_only=True)
class Day:
    """What came of one simulated run.

    Parameters
    ----------
    outcomes : list of Outcome
        One for each sample.
    received : list of Offset
        What a separate Zenoh subscriber got.
    truth : dict of str to numpy.ndarray
        The simulated machine's own history.
    seconds : float
        How long it took, s.
    adopted_at : int
        Sample from which the offset is wholly that of the adopted model; 0 where none was to be adopted.
    """

    outcomes: list[Outcome]
    received: list[Offset]
    truth: Mapping[str, Vector]
    seconds: float
    adopted_at: int = 0


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command `demo`."""
    also = checked(arguments.page, option="--page") if arguments.page else None
    return Answer(*run_demo(arguments.out, hours=arguments.hours, seed=arguments.seed, also=also))


def run_demo(out: Path, *, hours: float, seed: int, also: Path | None = None) -> tuple[dict[str, Any], str]:
    """Run the demo and write its results.

    Parameters
    ----------
    out : pathlib.Path
        Folder; a configuration, recordings and `report.html` of each machine come there.
    hours : float
        Length of the simulated run, h.
    seed : int
        Seed of the simulated day.
    also : pathlib.Path, optional
        Another file that the page goes into, such as a PDF.

    Returns
    -------
    (dict, str)
        Figures, and the table as text.
    """
    days = []
    for name in MACHINES:
        calibrate(out / name, machine=name, seed=seed)
        day = run_day(out / name, machine=name, hours=hours, seed=seed, model="calibration/model.toml")
        days.append(_shown(name, day))
    results = {day.name: day.figures for day in days}
    page = out / "report.html"
    table = _table(results)
    loop, second_day = close_the_loop(out / "conduction", hours=hours, seed=seed)
    made = page_of(days, table, loop, second_day, paper_case(out / "paper", seed=seed))
    for path in (page, *([also] if also is not None else [])):
        write(path, made)
    text = "\n".join(
        "  ".join(f"{cell:>{width}}" for cell, width in zip(row, _widths(table), strict=True)) for row in table
    )
    rms = loop["second_day_rms_um"]
    said = (
        f"The loop, on the conduction machine with an effect drawn by the seed ({loop['drawn']}): found "
        f"{', '.join(loop['found']) or 'nothing'} in the first day's recordings.\n"
        f"Second day, rms: {rms['without']:.2f} µm without compensation, {rms['first']:.2f} with the first model, "
        f"{rms['extended']:.2f} with the extended one."
    )
    result = {"machines": results, "loop": loop, "report": str(page)}
    return result, f"{text}\n\n{verdict(days)}\n{said}\npage: {page}"


# ---------------------------------------------------------------------------- calibration


def calibrate(folder: Path, *, machine: str, seed: int) -> None:
    """Run a simulated machine for a day and a half with a wattmeter at its heat source, and make its model of that.

    Parameters
    ----------
    folder : pathlib.Path
        Where `calibration.csv`, `model.toml` and the page go.
    machine : str
        `conduction` or `published`.
    seed : int
        Seed of the demo; the calibration has a duty of its own.
    """
    folder.mkdir(parents=True, exist_ok=True)
    duty = Duty.working_day(CALIBRATION_SEED + seed, hours=CALIBRATION_H)
    sensors = usual_sensors(duty.extra_names, heat_known=True)
    table = folder / "calibration" / "run.csv"
    write_table(table, World(MACHINES[machine](), duty, sensors, CALIBRATION_SEED + seed).record(PERIOD_S))
    request = Request(data=[table], out=table.parent / "model.toml", name=f"sim-{machine}", settings=Settings())
    identify(request)


def paper_case(folder: Path, *, seed: int) -> dict[str, Any]:
    """Make the paper's own calibration of its published equations, and put what comes out beside what is printed.

    90 W for six of twelve hours; 95 % of the readings within 1 % of the full deflection, as the paper states its
    measuring error.

    Parameters
    ----------
    folder : pathlib.Path
        Where the run, the model and the page go.
    seed : int
        Seed of the noise.

    Returns
    -------
    dict
        The result of `identify`, with the comparison.
    """
    duty = Duty.paper_calibration(seed)
    per_reading = np.sqrt(READINGS) * 0.01 / 1.96
    sensors = usual_sensors(
        temperature_noise_k=PAPER_K / np.sqrt(2.0) * per_reading, y_noise_um=PAPER_UM * per_reading, heat_known=True
    )
    table = folder / "run.csv"
    write_table(table, World(PublishedQuill(), duty, sensors, seed).record(PERIOD_S))
    settings = Settings(order=(3, 3, 2), drive="known")
    return identify(
        Request(data=[table], out=folder / "model.toml", name="paper", settings=settings, reference="quill")
    ).result


# ---------------------------------------------------------------------------- the loop


def close_the_loop(
    folder: Path, *, hours: float, seed: int
) -> tuple[dict[str, Any], dict[str, tuple[Vector, Vector]]]:  # fmt: skip
    """Let an effect act that the calibration never saw, find it in the service's own recordings, and run with it.

    The effect is drawn by the seed and sealed: nothing here knows what it is until the table is written.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the conduction machine, with its calibration.
    hours : float
        Length of each of the two days, h.
    seed : int
        Seed of the effect and of the duties.

    Returns
    -------
    (dict, dict)
        What was drawn, what was found, and the error on the second day; that error over time, h and µm.
    """
    effect = draw_effect(seed, EFFECT_UM, hours)
    first = "../calibration/model.toml"
    before = folder / "with-effect"
    run_day(before, machine="conduction", hours=hours, seed=seed + 1, model=first, effects=[effect])
    recordings = sorted((before / "recordings").glob("*.mcap"))
    found = diagnose_files(recordings, folder / "calibration" / "model.toml", folder / "diagnosis").result
    # An adequate model is left as it was: there is nothing to take over.
    adopt = (
        folder / "diagnosis" / "model.toml"
        if found["model_sha256"] != sha256_of((folder / "calibration" / "model.toml").read_bytes())
        else None
    )
    days = {
        name: run_day(folder / f"second-day-{name}", machine="conduction", hours=hours, seed=seed + 2, model=first,
                      effects=[effect], adopt=model)
        for name, model in (("first", None), ("extended", adopt))
    }  # fmt: skip
    adopted_h = days["extended"].adopted_at * PERIOD_S / 3600.0
    errors, curves = {}, {}
    for name, day in days.items():
        values = _errors(day)
        curves[name] = (values["t_h"], values["followed"])
        judged = values["t_h"] >= adopted_h + values["t_h"][0]
        errors[name], errors["without"] = values["followed"][judged], values["without"][judged]
    drawn = effect.reveal().describe()
    return {
        "drawn": " ".join(str(drawn[key]) for key in ("kind", "path", "channel") if drawn.get(key)),
        "found": [" ".join(filter(None, (e["kind"], e["path"], e["channel"]))) for e in found["effects"]],
        "verdict": found["verdict"], "report": found["report"],
        "explanation": [e["explanation"] for e in found["effects"]],
        "held_out_rms_um": {"before": found["before"]["rms_um"], "after": found["after"]["rms_um"]},
        "adopted_after_h": adopted_h,
        "second_day_rms_um": {name: float(np.std(values)) for name, values in errors.items()},
    }, curves  # fmt: skip


def write_table(path: Path, columns: Mapping[str, Vector]) -> None:
    """Write a recording as CSV; a missing value is an empty cell."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        rows = zip(*columns.values(), strict=True)
        writer.writerows(["" if np.isnan(v) else repr(round(float(v), 6)) for v in row] for row in rows)


# ---------------------------------------------------------------------------- one simulated day


def run_day(
    folder: Path, *, machine: str, hours: float, seed: int, model: str = "quill", effects: Sequence[Effect] = (),
    adopt: Path | None = None,
) -> Day:  # fmt: skip
    """Run one simulated machine through its devices, the service, disk and Zenoh.

    Parameters
    ----------
    folder : pathlib.Path
        Where the configuration and the recordings go.
    machine : str
        `conduction` or `published`.
    hours : float
        Length, h.
    seed : int
        Seed of duty and sensors.
    model : str
        Name of a model, or path of its file from the folder.
    effects : sequence of Effect
        What acts in the machine that its calibration never saw.
    adopt : pathlib.Path, optional
        A model that the running service is asked to take over after `ADOPT_AFTER_S`.

    Raises
    ------
    ServiceError
        If the service did not take it over before the end.
    """
    duty = Duty.working_day(seed, hours=hours + 0.1)
    world = World(MACHINES[machine](effects=effects), duty, usual_sensors(duty.extra_names), seed)
    folder.mkdir(parents=True, exist_ok=True)
    # A day of its own, not the continuation of the one that an earlier demo left here.
    shutil.rmtree(folder / "recordings", ignore_errors=True)
    began = time.perf_counter()
    with hardware(world) as (lines, capa):
        port = _free_port()
        config = folder / "config.toml"
        config.write_text(configuration(f"sim-{machine}", lines, port, model), encoding="utf-8")

        asked: list[asyncio.Future[dict[str, Any] | None]] = []

        async def advance(t_s: float) -> None:
            world.advance_to(t_s)
            capa.push(1)
            if adopt is not None and t_s >= ADOPT_AFTER_S:
                if not asked:
                    asked.append(asyncio.ensure_future(asyncio.to_thread(_ask_to_adopt, config, adopt)))
                if not asked[0].done():
                    # Simulated time waits a little for what takes its own time.
                    await asyncio.sleep(ADOPT_PATIENCE_S)

        outcomes: list[Outcome] = []
        received: list[Offset] = []
        clock = VirtualClock(START_NS, advance)
        samples = round(hours * 60)
        with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as progress:
            bar = progress.add_task(f"simulated machine {machine}", total=samples)

            def took(outcome: Outcome) -> None:
                outcomes.append(outcome)
                progress.advance(bar)

            asyncio.run(_serve(config, clock, samples, took, received, port))
    return Day(
        outcomes=outcomes, received=received, truth=world.history(), seconds=time.perf_counter() - began,
        adopted_at=_adopted_at(outcomes) if adopt is not None else 0,
    )  # fmt: skip


def _ask_to_adopt(config: Path, model: Path) -> dict[str, Any] | None:
    """Ask the running service as `compensator adopt` does."""
    wanted = json.dumps({"model": model.read_text(encoding="utf-8")}).encode()
    return ask(load_config(config).config.zenoh, "adopt", wanted, timeout_s=60.0)


def _adopted_at(outcomes: Sequence[Outcome]) -> int:
    first = outcomes[0].offset.model_sha256
    for i, outcome in enumerate(outcomes):
        if outcome.offset.model_sha256 != first and "model_changed" not in outcome.offset.reasons:
            return i
    raise ServiceError("the service did not take the model over before the simulated day ended")


async def _serve(
    config: Path,
    clock: VirtualClock,
    samples: int,
    took: Callable[[Outcome], None],
    received: list[Offset],
    port: int,
) -> None:
    """Run the service with a subscriber in a Zenoh session of its own."""
    subscriber: Any = None
    ready = asyncio.Event()

    async def listen() -> None:
        nonlocal subscriber
        await ready.wait()
        settings = Zenoh(prefix="shop/sim", mode="client", connect=[f"tcp/127.0.0.1:{port}"])
        subscriber = await asyncio.to_thread(zenoh.open, session_config(settings))
        subscriber.declare_subscriber(
            "shop/sim/thermal/y/offset",
            lambda s: received.append(msgspec.json.decode(s.payload.to_bytes(), type=Offset)),
        )

    task = asyncio.create_task(listen())
    try:
        await run_service(
            str(config),
            clock=clock,
            samples=samples,
            on_ready=lambda _: ready.set(),
            on_sample=took,
        )
        await task
    finally:
        if subscriber is not None:
            await asyncio.to_thread(subscriber.close)


@contextmanager
def hardware(world: World) -> Iterator[tuple[dict[str, Any], CapaNcdt]]:
    """Put the simulated machine's sensors on simulated devices, one for each protocol.

    Yields
    ------
    (dict, CapaNcdt)
        Addresses of the lines by protocol, and the displacement controller, whose stream the clock drives.
    """
    source = world.source
    with Rack() as rack:
        rtu = rack.add(ModbusRtuLine({1: IcpDas("m-7018r", couples="K", sources={0: source("t_q_degc")})}))
        tcp = rack.add(ModbusTcpServer({1: IcpDas("et-7018z", couples="T", sources={0: source("at_degc")})}))
        plc = rack.add(ModbusTcpServer({1: RegisterMap({
            0: Register(source=source("spindle_rpm")),
            1: Register(source=source("coolant_degc"), per_unit=100.0),
        })}))  # fmt: skip
        dcon = rack.add(DconLine({2: IcpDas("m-7018r", couples="K", sources={0: source("base_degc")})}))
        capa = rack.add(CapaNcdt({1: lambda: PROBE_RANGE_UM / 2 + source("y_um")()}, PROBE_RANGE_UM))
        yield {
            "rtu": rtu.port, "tcp": tcp.port, "plc": plc.port, "dcon": dcon.port,
            "data": capa.data_port, "command": capa.command_port,
        }, capa  # fmt: skip


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def configuration(machine: str, lines: Mapping[str, Any], zenoh_port: int, model: str = "quill") -> str:
    """Write the configuration of the simulated machine, as an engineer would write it."""
    return f"""# Configuration of a simulated machine.
[machine]
name = "{machine}"

[model]
file = "{model}"

[sampling]
poll_interval_s = {POLL_INTERVAL_S}

[limits]
offset_max_um = 200.0
offset_rate_max_um_per_min = 8.0
[limits.validity]
t_q_degc = [10.0, 60.0]
at_degc = [12.0, 32.0]

[loss]
predict_for_min = 30.0

[zero]
rest_rate_um_per_min = 0.2

[guards]
t_q_below_at_max_k = 2.0

[zenoh]
prefix = "shop/sim"
mode = "peer"
listen = ["tcp/127.0.0.1:{zenoh_port}"]

[recording]
folder = "recordings"

[[line]]
name = "rs485"
protocol = "modbus-rtu"
port = "{lines["rtu"]}"
[[line]]
name = "cabinet"
protocol = "modbus-tcp"
host = "127.0.0.1"
tcp_port = {lines["tcp"]}
[[line]]
name = "plc"
protocol = "modbus-tcp"
host = "127.0.0.1"
tcp_port = {lines["plc"]}
[[line]]
name = "base-line"
protocol = "dcon"
port = "{lines["dcon"]}"
[[line]]
name = "probe-line"
protocol = "capancdt"
host = "127.0.0.1"
data_port = {lines["data"]}
command_port = {lines["command"]}

[[device]]
name = "spindle-couples"
line = "rs485"
model = "icpdas-m7018r"
address = 1
format = "hex"
inputs = [{{ input = 0, couple = "K" }}]
[[device]]
name = "cabinet-couples"
line = "cabinet"
model = "icpdas-et7018z"
address = 1
format = "hex"
inputs = [{{ input = 0, couple = "T" }}]
[[device]]
name = "control"
line = "plc"
model = "modbus-map"
address = 1
inputs = [
  {{ input = 0, unit = "rpm", function = 4, address = 0, type = "int16" }},
  {{ input = 1, unit = "degc", function = 4, address = 1, type = "int16", scale = 0.01 }},
]
[[device]]
name = "base-couples"
line = "base-line"
model = "dcon"
address = 2
inputs = [{{ input = 0, couple = "K" }}]
[[device]]
name = "probe"
line = "probe-line"
model = "capancdt-6200"
inputs = [{{ input = 0 }}]

[[channel]]
name = "t_q_degc"
device = "spindle-couples"
input = 0
range = [0.0, 80.0]
rate_max_per_min = 5.0
stuck_after_min = 120.0
[[channel]]
name = "at_degc"
device = "cabinet-couples"
input = 0
range = [5.0, 45.0]
rate_max_per_min = 2.0
stuck_after_min = 240.0
[[channel]]
name = "y_um"
device = "probe"
input = 0
range = [10.0, 490.0]
rate_max_per_min = 30.0
stuck_after_min = 60.0
[[channel]]
name = "base_degc"
device = "base-couples"
input = 0
[[channel]]
name = "spindle_rpm"
device = "control"
input = 0
[[channel]]
name = "coolant_degc"
device = "control"
input = 1
"""


# ---------------------------------------------------------------------------- figures


def _errors(day: Day) -> dict[str, Vector]:
    """Return true deformation and what is left of it with the offset held and with its rate followed, µm."""
    t = day.truth["t_s"]
    y = day.truth["y_um"]
    offsets = [(o.offset.time_utc_ns - START_NS) / NS for o in day.outcomes]
    start = int(np.searchsorted(t, offsets[0]))
    t, y = t[start:], y[start:] - y[start]
    index = np.clip(np.searchsorted(offsets, t, side="right") - 1, 0, None)
    value = np.array([number(o.offset.y_offset_um) for o in day.outcomes])[index]
    rate = np.array([number(o.offset.y_offset_rate_um_per_min) for o in day.outcomes])[index]
    return {
        "t_h": t / 3600.0, "without": y, "held": y + value,
        "followed": y + value + rate * (t - np.array(offsets)[index]) / 60.0,
    }  # fmt: skip


def _figures(day: Day) -> dict[str, Any]:
    errors = _errors(day)
    estimate = [outcome.estimate for outcome in day.outcomes]
    fit = scores(np.array([number(e.y_um) for e in estimate]), np.array([number(e.y_pred_um) for e in estimate]))
    still = errors["followed"]
    part: dict[str, Any] = {
        name: {
            "rms_um": float(np.sqrt(np.mean(errors[name] ** 2))),
            "peak_to_peak_um": float(np.ptp(errors[name])),
        }
        for name in ("without", "held", "followed")
    }
    part |= {
        "samples": len(day.outcomes), "received": len(day.received), "seconds": round(day.seconds, 1),
        "fit_pct": fit.fit_pct, "removed_pct": 100.0 * (1.0 - float(np.std(still)) / float(np.std(errors["without"]))),
        "states": {s: sum(o.offset.state == s for o in day.outcomes) for s in {o.offset.state for o in day.outcomes}},
    }  # fmt: skip
    return part


def _table(results: Mapping[str, Any]) -> list[list[str]]:
    rows = [["simulated machine", "", "rms µm", "peak-to-peak µm", "fit %", "samples", "seconds"]]
    for machine, figures in results.items():
        for key, words in (
            ("without", "no compensation"),
            ("held", "offset held 60 s"),
            ("followed", "rate followed"),
        ):
            first = key == "without"
            rows.append([
                machine if first else "", words, f"{figures[key]['rms_um']:.2f}",
                f"{figures[key]['peak_to_peak_um']:.2f}", f"{figures['fit_pct']:.1f}" if key == "followed" else "",
                str(figures["samples"]) if first else "", f"{figures['seconds']:.1f}" if first else "",
            ])  # fmt: skip
    return rows


def _widths(table: list[list[str]]) -> list[int]:
    return [max(len(row[i]) for row in table) for i in range(len(table[0]))]


def _shown(name: str, day: Day) -> MachineDay:
    """Return what the page shows of a day."""
    hours = [(o.estimate.time_utc_ns - START_NS) / NS / 3600 for o in day.outcomes]
    heat = [number(o.estimate.heat_w) for o in day.outcomes]
    return MachineDay(
        name=name, figures=_figures(day), errors=_errors(day),
        heat=(day.truth["t_s"] / 3600.0, day.truth["heat_w"], np.array(hours), np.array(heat)),
    )  # fmt: skip


__all__ = ["Day", "Scores", "configuration", "hardware", "run", "run_day", "run_demo"]
