"""The command line: `compensator COMMAND …`.

Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 failed, 2 wrong usage, configuration or
data, 3 an audit found a difference.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import json
import logging
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from compensator import __version__
from compensator.commands.arguments import adopt as add_adopt
from compensator.commands.arguments import back as add_back
from compensator.commands.arguments import diagnose as add_diagnose
from compensator.commands.arguments import identify as add_identify
from compensator.commands.arguments import replay as add_replay
from compensator.errors import CompensatorError, UsageError
from drivers.errors import DriverError

log = logging.getLogger("compensator")

_SIMULATE_COLUMNS = ("t_s", "heat_w", "y_pred_um", "residual_um", "y_um", "y_dtf_um", "y_tdtf_um", "y_std_um")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; `sys.argv` where none are given.
    """
    arguments = _parser().parse_args(argv)
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s", force=True)
    command: Callable[[argparse.Namespace], int] = arguments.command
    try:
        return command(arguments)
    except (CompensatorError, DriverError, OSError) as error:
        if arguments.debug:
            raise
        log.error("compensator: %s", error)
        return getattr(error, "exit_code", 1)
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="compensator", description="Thermal error compensation for machine tools.",
        epilog="example: compensator demo --out demo-out",
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=__version__)
    parser.set_defaults(debug=False)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    demo = _command(commands, "demo", _demo, "the whole loop on simulated hardware", "compensator demo --out demo-out")
    demo.add_argument("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="folder for the results")
    demo.add_argument("--hours", type=float, default=24.0, help="length of the simulated run, h (default 24)")
    demo.add_argument("--seed", type=int, default=1, help="seed of the simulated day (default 1)")
    run = _command(commands, "run", _run, "the service", "compensator run --config machine.toml")
    run.add_argument("--config", required=True, metavar="FILE")
    check = _command(
        commands,
        "check",
        _check,
        "validate a configuration; opens nothing",
        "compensator check --config machine.toml",
    )
    check.add_argument("--config", required=True, metavar="FILE")
    probe = _command(
        commands, "probe", _probe, "one reading of every device", "compensator probe --config machine.toml"
    )
    probe.add_argument("--config", required=True, metavar="FILE")
    simulate = _command(commands, "simulate", _simulate, "run a model over measured data",
                        "compensator simulate run.csv --model quill --out predicted.csv")  # fmt: skip
    simulate.add_argument("data", type=Path, metavar="DATA", help="CSV, or a recording")
    simulate.add_argument("--model", required=True, help="a model file, or quill")
    simulate.add_argument("--out", type=Path, required=True, metavar="CSV")
    simulate.add_argument(
        "--column", action="append", default=[], metavar="ROLE=NAME", help="role of a column of another name"
    )
    example = "compensator identify run.csv --validate other.csv --out model.toml"
    add_identify(_command(commands, "identify", _identify, "a model from measured runs", example))
    example = "compensator diagnose day.mcap --model model.toml --out diagnosis"
    add_diagnose(_command(commands, "diagnose", _diagnose, "what a model lacks, from measured data", example))
    example = "compensator replay recordings/*.mcap"
    add_replay(_command(commands, "replay", _replay, "audit recordings: nothing changed, all comes out again", example))
    example = "compensator adopt diagnosis/model.toml --config machine.toml"
    add_adopt(_command(commands, "adopt", _adopt, "the running service takes a model over without a jump", example))
    example = "compensator back --config machine.toml"
    add_back(_command(commands, "back", _back, "the service returns to the model before", example))
    export = _command(
        commands, "export", _export, "a recording as a table", "compensator export day.mcap --out day.csv"
    )
    export.add_argument("recording", type=Path, metavar="FILE.mcap")
    export.add_argument("--out", type=Path, required=True, metavar="CSV")
    explain = _command(commands, "explain", _explain, "a state or reason in words", "compensator explain degraded")
    explain.add_argument("code")
    return parser


def _command(
    commands: Any, name: str, function: Callable[[argparse.Namespace], int], text: str, example: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=text, description=text, epilog=f"example: {example}"
    )
    parser.set_defaults(command=function)
    parser.add_argument("--debug", action="store_true", help="show where an error comes from")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    return parser


def _print(arguments: argparse.Namespace, result: dict[str, Any], text: str) -> None:
    sys.stdout.write((json.dumps(result) if arguments.json else text) + "\n")


def _demo(arguments: argparse.Namespace) -> int:
    from compensator.demo import run_demo

    result, text = run_demo(arguments.out, hours=arguments.hours, seed=arguments.seed)
    _print(arguments, result, text)
    return 0


def _run(arguments: argparse.Namespace) -> int:
    from compensator.service.composition import run_service
    from compensator.service.daemon import Daemon

    async def serve() -> None:
        loop = asyncio.get_running_loop()

        def ready(daemon: Daemon) -> None:
            for number in (signal.SIGTERM, signal.SIGINT):
                loop.add_signal_handler(number, daemon.stop)
            log.info("compensator: running")

        await run_service(arguments.config, on_ready=ready)

    asyncio.run(serve())
    log.info("compensator: stopped, recording finished")
    return 0


def _check(arguments: argparse.Namespace) -> int:
    from compensator.service.compensation import Compensation
    from compensator.service.composition import load

    loaded, model, _, fleet = load(arguments.config)
    Compensation(loaded.config, model)
    machine = loaded.config.machine.name
    text = (
        f"{arguments.config}: good. Machine {machine}, model {model.name} ({model.kind}), "
        f"{len(fleet.devices)} device(s), {len(loaded.config.channel)} channel(s). Nothing was opened."
    )
    _print(arguments, {"ok": True, "machine": machine, "model": model.name, "model_sha256": model.sha256,
                       "devices": list(fleet.devices)}, text)  # fmt: skip
    return 0


def _probe(arguments: argparse.Namespace) -> int:
    from compensator.service.composition import load, read_once

    loaded, _, _, fleet = load(arguments.config)
    units = {name: dict(device.units) for name, device in fleet.devices.items()}
    answers = asyncio.run(read_once(fleet))
    rows: list[dict[str, Any]] = []
    for channel in loaded.config.channel:
        answer = answers[channel.device]
        row: dict[str, Any] = {"channel": channel.name, "device": channel.device, "input": channel.input}
        if isinstance(answer, DriverError):
            row |= {
                "value": None,
                "unit": units[channel.device][channel.input],
                "quality": answer.code,
                "detail": str(answer),
            }
        else:
            reading = answer[channel.input]
            good = reading.quality == "good"
            row |= {"value": reading.value if good else None, "unit": units[channel.device][channel.input],
                    "quality": str(reading.quality), "detail": reading.detail}  # fmt: skip
        rows.append(row)
    lines = [
        f"{r['channel']:<20} {r['device']:<16} {r['input']:>3}  "
        + (f"{r['value']:12.4f} {r['unit']:<5}" if r["value"] is not None else " " * 18)
        + f" {r['quality']} {r['detail']}"
        for r in rows
    ]
    _print(arguments, {"channels": rows}, "\n".join(lines))
    return 0 if all(row["quality"] == "good" for row in rows) else 1


def _simulate(arguments: argparse.Namespace) -> int:
    from compensator.model.model_file import load_model
    from compensator.simulation import csv_rows, scores, simulate
    from compensator.tables import load_data, require, roles_of

    model = load_model(arguments.model)
    data = load_data(arguments.data, model.period_s, roles_of(arguments.column))
    for remark in data.remarks:
        log.warning("%s", remark)
    for record in data.records:
        require(arguments.data, record, ("t_q_degc", "at_degc"))
    parts = [simulate(model, record) for record in data.records]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    with arguments.out.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(csv_rows(columns, _SIMULATE_COLUMNS))
    result: dict[str, Any] = {
        "samples": int(columns["t_s"].size),
        "records": len(parts),
        "out": str(arguments.out),
    }
    text = f"{result['samples']} samples in {len(parts)} record(s) → {arguments.out}"
    if "y_um" in columns:
        score = scores(columns["y_um"], columns["y_pred_um"])
        result |= {"fit_pct": score.fit_pct, "rms_um": score.rms_um, "peak_to_peak_um": score.peak_to_peak_um}
        text += f"\nfit {score.fit_pct:.2f} %, residual {score.rms_um:.3f} µm rms"
        text += f", {score.peak_to_peak_um:.2f} µm peak to peak"
    _print(arguments, result, text)
    return 0


def _identify(arguments: argparse.Namespace) -> int:
    from compensator.commands.identify import run

    result, text = run(arguments)
    _print(arguments, result, text)
    return 0


def _diagnose(arguments: argparse.Namespace) -> int:
    from compensator.commands.diagnose import run

    result, text = run(arguments)
    _print(arguments, result, text)
    return 0


def _replay(arguments: argparse.Namespace) -> int:
    from compensator.commands.replay import run

    result, text, code = run(arguments)
    _print(arguments, result, text)
    return code


def _adopt(arguments: argparse.Namespace) -> int:
    from compensator.commands.adopt import adopt

    result, text = adopt(arguments)
    _print(arguments, result, text)
    return 0


def _back(arguments: argparse.Namespace) -> int:
    from compensator.commands.adopt import back

    result, text = back(arguments)
    _print(arguments, result, text)
    return 0


def _export(arguments: argparse.Namespace) -> int:
    from compensator.export import export

    samples = export(arguments.recording, arguments.out)
    _print(arguments, {"samples": samples, "out": str(arguments.out)}, f"{samples} samples → {arguments.out}")
    return 0


def _explain(arguments: argparse.Namespace) -> int:
    from compensator.reasons import WORDS, explain

    words = explain(arguments.code)
    if words is None:
        raise UsageError(f"{arguments.code}: unknown, expected one of: {', '.join(WORDS)}")
    _print(arguments, {"code": arguments.code, "means": words[0], "do": words[1]}, f"{words[0]}\n{words[1]}")
    return 0
