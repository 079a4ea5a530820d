"""The commands as their users call them."""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from compensator.cli import _parser, load, main
from compensator.commands.adopt import _hash_of
from compensator.commands.catalog import COMMANDS
from compensator.config import Zenoh
from compensator.data.table import roles_of
from compensator.demo.day import START_NS, run_day
from compensator.demo.machine import configuration, hardware
from compensator.errors import UsageError
from compensator.model.model_file import load_model
from compensator.recording.reading import read_messages, recordings
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.ports import free_port


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a simulated run of two hours through every protocol."""
    folder = tmp_path_factory.mktemp("day")
    result = run_day(folder, machine="published", hours=2.0, seed=3)
    assert len(result.outcomes) == 120
    # The subscriber joins while the run is under way; from then on it misses nothing and gets what was decided.
    sent = {outcome.offset.seq: outcome.offset for outcome in result.outcomes}
    numbers = [offset.seq for offset in result.received]
    assert numbers and numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert all(sent[offset.seq] == offset for offset in result.received if offset.state == "ok")
    return folder


def recording(day: Path) -> Path:
    return recordings(day / "recordings", "sim-published")[0]


def table(path: Path) -> dict[str, list[str]]:
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


def write_run(path: Path, n: int = 300, **extra: list[str]) -> None:
    model = load_model("quill")
    heat = np.where(np.arange(n) >= 30, 90.0, 0.0)
    assert model.ttf is not None
    t_q = 20.0 + model.ttf.sampled.response(heat)
    y = model.dtf.sampled.response(heat)
    with path.open("w", encoding="utf-8") as file:
        file.write("t_s,t_q_degc,at_degc,y_um\n")
        for i in range(n):
            file.write(f"{60 * i},{float(t_q[i])!r},20.0,{float(y[i])!r}\n")


def test_every_value_of_the_run_was_good(day: Path, tmp_path: Path) -> None:
    out = tmp_path / "day.csv"
    assert main(["export", str(recording(day)), "--out", str(out)]) == 0
    columns = table(out)
    assert len(columns["t_s"]) == 120
    for name in ("t_q_degc", "at_degc", "y_um", "base_degc", "spindle_rpm", "coolant_degc"):
        assert set(columns[f"{name}_quality"]) == {"good"}, name
    assert columns["t_s"][:3] == ["0.0", "60.0", "120.0"]
    assert set(columns["state"]) <= {"ok", "degraded"}


def test_simulating_a_recording_gives_what_the_service_estimated(day: Path, tmp_path: Path) -> None:
    exported, simulated = tmp_path / "e.csv", tmp_path / "s.csv"
    main(["export", str(recording(day)), "--out", str(exported)])
    assert main(["simulate", str(recording(day)), "--model", "quill", "--out", str(simulated)]) == 0
    live = np.array([float(v) for v in table(exported)["y_pred_um"]])
    again = np.array([float(v) for v in table(simulated)["y_pred_um"]])
    assert np.max(np.abs(live - again)) < 1e-8


def test_check_and_run_on_hardware_with_sigterm(tmp_path: Path) -> None:
    """The service as a process of its own, in real time, ended by SIGTERM with a finished recording."""
    duty = Duty.working_day(1, hours=1)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    with hardware(world) as (lines, _capa, _):
        port = free_port()
        config = tmp_path / "machine.toml"
        fast = load_fast_model(tmp_path)
        text = configuration("vmc-07", lines, port).replace('file = "quill"', f'file = "{fast.name}"')
        config.write_text(text.replace("poll_interval_s = 10.0", "poll_interval_s = 0.25"), encoding="utf-8")
        assert main(["check", "--config", str(config)]) == 0
        process = subprocess.Popen(
            [sys.executable, "-m", "compensator", "run", "--config", str(config)],
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stderr is not None
            for line in process.stderr:
                if "running" in line:
                    break
            folder = tmp_path / "recordings"
            offsets = receive(port, 3)
            assert [o["machine"] for o in offsets] == ["vmc-07"] * 3
            assert offsets[1]["seq"] == offsets[0]["seq"] + 1
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=20) == 0
            process.stderr.close()
        finally:
            process.kill()
            process.wait()
    path = recordings(folder, "vmc-07")[0]
    assert path.read_bytes().endswith(b"\x89MCAP0\r\n")
    logged = [json.loads(r.data) for r in read_messages(path, ("offset",))]
    assert offsets[0] in logged


def load_fast_model(folder: Path) -> Path:
    """The published model with a sample of one second, for tests in real time."""
    text = (Path(__file__).parents[2] / "compensator/model/quill.toml").read_text(encoding="utf-8")
    path = folder / "fast.toml"
    path.write_text(text.replace("sample_period_s = 60.0", "sample_period_s = 1.0"), encoding="utf-8")
    return path


def receive(port: int, count: int) -> list[dict[str, object]]:
    """Receive offsets as a program apart from the project would: plain zenoh, plain JSON."""
    code = f"""
import json, sys, zenoh
c = zenoh.Config()
c.insert_json5("mode", '"client"')
c.insert_json5("connect/endpoints", '["tcp/127.0.0.1:{port}"]')
c.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(c) as s:
    sub = s.declare_subscriber("shop/sim/thermal/y/offset")
    for _ in range({count}):
        print(json.dumps(json.loads(sub.recv().payload.to_bytes())))
    answers = [json.loads(r.ok.payload.to_bytes()) for r in s.get("shop/sim/thermal/y/offset")]
    assert len(answers) == 1 and answers[0]["schema"] == 1, answers
    zero = [json.loads(r.ok.payload.to_bytes()) for r in s.get("shop/sim/thermal/command/zero", payload=b"")]
    assert zero[0]["ok"], zero
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=40, env=dict(os.environ)
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_probe_reads_every_device_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    duty = Duty.working_day(1, hours=1)
    world = World(PublishedQuill(), duty, None, 1)
    world.advance_to(60.0)
    with hardware(world) as (lines, _capa, _):
        # A controller in push mode streams only when the simulated time moves: the probe's first frame.
        config = tmp_path / "machine.toml"
        config.write_text(configuration("vmc-07", lines, 7447), encoding="utf-8")
        code = main(["probe", "--config", str(config), "--json"])
    rows = {row["channel"]: row for row in json.loads(capsys.readouterr().out)["channels"]}
    assert rows["t_q_degc"]["value"] == pytest.approx(world.truth("t_q_degc"), abs=0.05)
    assert rows["at_degc"]["value"] == pytest.approx(world.truth("at_degc"), abs=0.05)
    assert rows["y_um"]["value"] is None and rows["y_um"]["quality"] == "device_timeout"
    assert code == 1


def test_probe_names_a_missing_port_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = {"rtu": "/dev/absent", "tcp": 1, "plc": 2, "dcon": "/dev/absent-too", "data": 3, "command": 4}
    config = tmp_path / "machine.toml"
    config.write_text(configuration("vmc-07", lines, 7447), encoding="utf-8")
    assert main(["probe", "--config", str(config)]) == 1
    out = capsys.readouterr().out
    assert out.count("/dev/absent:") == 1
    rpm, coolant = out.splitlines()[-2:]
    assert "cannot open 127.0.0.1:2" in rpm and "cannot open" not in coolant and "device_disconnected" in coolant


def test_simulate_scores_the_published_model_on_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(tmp_path / "run.csv")
    assert (
        main(
            [
                "simulate",
                str(tmp_path / "run.csv"),
                "--model",
                "quill",
                "--out",
                str(tmp_path / "o.csv"),
                "--json",
            ]
        )
        == 0
    )
    result = json.loads(capsys.readouterr().out)
    assert result["fit_pct"] > 95.0
    columns = table(tmp_path / "o.csv")
    assert {"t_s", "heat_w", "y_pred_um", "residual_um"} <= set(columns)
    assert float(columns["heat_w"][250]) == pytest.approx(90.0, abs=0.5)


def test_simulate_takes_several_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables, outs = [tmp_path / "one.csv", tmp_path / "two.csv"], []
    for path in tables:
        write_run(path)
    for i, given in enumerate(([tables[0]], tables)):
        outs.append(tmp_path / f"out-{i}.csv")
        assert main(["simulate", *map(str, given), "--model", "quill", "--out", str(outs[i])]) == 0
    one, both = (out.read_text().splitlines() for out in outs)
    assert both == one + one[1:]  # each run begins at rest
    assert main(["simulate", *map(str, tables), "--model", "quill", "--out", str(tables[1])]) == 2


def test_simulate_takes_roles_and_reports_gaps_and_disorder(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "run.csv")
    lines = (tmp_path / "run.csv").read_text().splitlines()
    lines[0] = "t_s,spindle,room,y_um"
    lines[50], lines[51] = lines[51], lines[50]
    del lines[100:110]
    (tmp_path / "rough.csv").write_text("\n".join(lines))
    command = [
        "simulate",
        str(tmp_path / "rough.csv"),
        "--model",
        "quill",
        "--out",
        str(tmp_path / "o.csv"),
        "--json",
        "--column",
        "t_q_degc=spindle",
        "--column",
        "at_degc=room",
    ]
    assert main(command) == 0
    captured = capsys.readouterr()
    assert "out of order" in captured.err and "gap of 10 sample(s) from t_s = 5940; bridged" in captured.err
    assert json.loads(captured.out)["samples"] == 300


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("t_s,t_q_degc,at_degc\n0,20,20\n60,warm,20\n", "row 3: t_q_degc = 'warm', expected a number"),
        ("t_s,t_q_degc\n0,20\n60,20\n", "no column at_degc"),
        ("a,b\n1,2\n", "no column t_s or time_utc"),
        ("t_s,t_q_degc,at_degc\n0,20,20\n60,20\n", "row 3: 2 cells, expected 3"),
        ("", "expected a header and data"),
        ("t_s,t_q_degc,at_degc\n0,inf,20\n", "t_q_degc = inf, expected a finite number"),
        ("t_s,t_q_degc,at_degc\n0,,20\n60,20,\n", "no row has both"),
    ],
)
def test_bad_tables_get_one_line_and_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, expected: str
) -> None:
    (tmp_path / "bad.csv").write_text(text)
    assert main(["simulate", str(tmp_path / "bad.csv"), "--model", "quill", "--out", str(tmp_path / "o.csv")]) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1 and "Traceback" not in error


PROBE_TABLE = "[probe]\nstd_um = 1.0\nmeasured_max_um = 60.0\nlargest_um = 40.0\n"
REST_TABLE = '[plausibility.rest]\nchannel = "NAME"\nat_most = 100.0\nafter_min = 60.0\nt_q_at_max_k = 0.5\n'
LISTEN = 'listen = ["tcp/127.0.0.1:7447"]'
BAD_CONFIGS = [
    (
        "offset_max_um = 200.0",
        "offset_maximum_um = 200.0",
        "limits.offset_maximum_um: no such key, expected one of: offset_max_um, ",
    ),
    ("offset_max_um = 200.0\n", "", "limits.offset_max_um: missing"),
    ("[machine]", "[machin]", "machin: no such key, expected one of: machine, "),
    ('name = "t_q_degc"', 'nam = "t_q_degc"', "channel[0].nam: no such key, expected one of: name, device"),
    ("predict_for_min = 30.0", "predict_for_min = -1.0", "loss.predict_for_min = -1.0"),
    ('device = "probe"', 'device = "prob"', "device 'prob' is not configured"),
    ('name = "y_um"\ndevice = "probe"', 'name = "y_um"\ndevice = "control"', "expected um"),
    ("poll_interval_s = 10.0", "poll_interval_s = 7.0", "expected the model's 60 s divided by an integer"),
    ('model = "icpdas-m7018r"', 'model = "icpdas-m7018x"', "icpdas-m7018r"),
    ('file = "quill"', 'file = "absent.toml"', "expected a model file"),
    ("range = [0.0, 80.0]", "range = [80.0, 0.0]", "expected the lower bound first"),
    ("rate_max_per_min = 30.0\n", "", "rate_max_per_min is missing"),
    ("[machine]", "[probe]\nstd_um = 1.0\n[machine]", "probe.measured_max_um: missing"),
    ("[machine]", PROBE_TABLE.replace("1.0", "0.0") + "[machine]", "probe.std_um = 0.0"),
    ("[machine]", PROBE_TABLE.replace("40.0", "400.0") + "[machine]", "probe.largest_um = 400, expected at most"),
    ("[machine]", PROBE_TABLE + "oldest_min = 1000.0\n[machine]", "probe.oldest_min = 1000.0"),
    (
        "[machine]",
        '[loop]\npolicy = "always"\n[machine]',
        "loop.policy = 'always': expected one of: off, propose, adopt",
    ),
    ('mode = "peer"', 'mode = "pear"', "zenoh.mode = 'pear': expected one of: peer, client, router"),
    ('mode = "peer"', "mode = 3", "zenoh.mode = 3: expected one of: peer, client, router"),
    ("[machine]", '[loop]\npolicy = "adopt"\nat_utc = "25:00"\n[machine]', "loop.at_utc = '25:00'"),
    ("[machine]", "[loop]\nshadow_h = 1.0\n[machine]", "loop.shadow_h = 1.0"),
    ('name = "coolant_degc"', 'name = "y_pred_um"', "channel 'y_pred_um': `export` writes another column of this name"),
    ('name = "coolant_degc"', 'name = "time_utc"', "channel 'time_utc': `export` writes another column of this name"),
    ('name = "coolant_degc"', 'name = "t_q_degc_quality"', "channel 't_q_degc_quality': `export` writes another"),
    (
        'device = "cabinet-thermocouples"\ninput = 0',
        'device = "spindle-thermocouples"\ninput = 0',
        "channel 'at_degc': input 0 of device 'spindle-thermocouples' is that of channel 't_q_degc', expected one",
    ),
    ('device = "control"\ninput = 1', 'device = "control"\ninput = 0', "'control' is that of channel 'spindle_rpm'"),
    ('unit = "rpm"', 'unit = "v"', "channel 'spindle_rpm': its input gives v, expected rpm"),
    ('1, unit = "degc"', '1, unit = "degf"', "channel 'coolant_degc': its input gives degf, expected degc"),
    ('name = "base_degc"', 'name = "z_um"', "channel 'z_um': its input gives degc, expected um"),
    (LISTEN, LISTEN.replace(":7447", ""), "zenoh.listen[0] = 'tcp/127.0.0.1': expected such as tcp/127.0.0.1:7447 or"),
    (LISTEN, LISTEN.replace("tcp/", ""), "zenoh.listen[0] = '127.0.0.1:7447': expected such as"),
    (LISTEN, LISTEN.replace("7447", "99999"), "with a port up to 65535"),
    (LISTEN, LISTEN.replace("listen", "connect").replace("7447", "65536"), "zenoh.connect[0] = 'tcp/127.0.0.1:65536'"),
    (LISTEN, LISTEN.replace("tcp", "tpc"), "zenoh.listen[0] = 'tpc/127.0.0.1:7447': expected such as"),
    (LISTEN, LISTEN.replace("7447", "7447#"), "zenoh.listen[0] = 'tcp/127.0.0.1:7447#': expected such as"),
    ('name = "vmc-07"', 'name = "vmc-07\\n"', "machine.name = 'vmc-07\\n': has a control character"),
    ('name = "y_um"', 'name = "y_um\\n"', "].name = 'y_um\\n': has a control character"),
    ('device = "probe"', 'device = "probe\\n"', "].device = 'probe\\n': has a control character"),
    ('prefix = "shop/sim"', 'prefix = "shop/sim\\n"', "zenoh.prefix = 'shop/sim\\n': has a control character"),
    (
        'folder = "recordings"',
        'folder = "recordings\\n"',
        "recording.folder = 'recordings\\n': has a control character",
    ),
    *(
        ("[machine]", REST_TABLE.replace("NAME", name) + "[machine]", f"plausibility.rest.channel = {name!r}: {words}")
        for name, words in (("y_um", "which says"), ("at_degc", "which says"), ("spindle", "no such channel"))
    ),
    ("[machine]", PROBE_TABLE + "often = true\n[machine]", "probe.often: no such key, expected one of: std_um"),
]


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/router.shop:0",
        "udp/[::]:65535",
        "tcp/::1:7447",
        "ws/localhost:07447",
        "tcp/10.0.0.1:7447?rel=1#iface=eth0",
        "quic/a:1",
        "unixsock-stream//run/z z",
        "unixsock-stream/run/z",
    ],
)
def test_endpoints_that_zenoh_takes_are_taken(endpoint: str) -> None:
    """Opened with eclipse-zenoh 1.10.2, but for the certificates that QUIC needs and hosts that are not there."""
    assert msgspec.convert({"prefix": "p", "listen": [endpoint]}, Zenoh).listen == [endpoint]


@pytest.mark.parametrize(("old", "new", "expected"), BAD_CONFIGS)
def test_bad_configurations_get_one_line_and_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, expected: str
) -> None:
    lines = {
        "rtu": "/dev/ttyS90",
        "dcon": "/dev/ttyS91",
        "tcp": 1502,
        "plc": 1503,
        "data": 10001,
        "command": 10023,
    }
    text = configuration("vmc-07", lines, 7447)
    assert old in text
    (tmp_path / "bad.toml").write_text(text.replace(old, new, 1))
    assert main(["check", "--config", str(tmp_path / "bad.toml")]) == 2
    error = capsys.readouterr().err
    assert expected in error and "bad.toml" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("old", "new"), [('"spindle_rpm"', '"pump_on"'), ('unit = "rpm"', 'unit = "hz"'), ('"base_degc"', '"bed"')]
)
def test_a_channel_whose_name_or_input_states_no_known_unit_is_taken(tmp_path: Path, old: str, new: str) -> None:
    lines = {"rtu": "/dev/ttyS90", "dcon": "/dev/ttyS91", "tcp": 1502, "plc": 1503, "data": 10001, "command": 10023}
    text = configuration("vmc-07", lines, 7447)
    assert old in text
    (tmp_path / "m.toml").write_text(text.replace(old, new, 1))
    assert main(["check", "--config", str(tmp_path / "m.toml")]) == 0


def test_two_devices_on_one_address_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = {
        "rtu": "/dev/ttyS90",
        "dcon": "/dev/ttyS91",
        "tcp": 1502,
        "plc": 1503,
        "data": 10001,
        "command": 10023,
    }
    second = '[[device]]\nname = "twin"'
    second += '\nline = "rs485"\nmodel = "icpdas-m7018r"\naddress = 1\ninputs = [{ input = 1, couple = "K" }]\n'
    (tmp_path / "bad.toml").write_text(configuration("vmc-07", lines, 7447) + second)
    assert main(["check", "--config", str(tmp_path / "bad.toml")]) == 2
    error = capsys.readouterr().err
    assert "twin" in error and "spindle-thermocouples" in error and error.count("\n") == 1


def test_model_with_an_unstable_inverse_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (Path(__file__).parents[2] / "compensator/model/quill.toml").read_text(encoding="utf-8")
    (tmp_path / "m.toml").write_text(text.replace("[0.0002567, 0.01629, 0.008079]", "[-0.0002567, 0.01629, 0.008079]"))
    write_run(tmp_path / "run.csv")
    assert (
        main(
            [
                "simulate",
                str(tmp_path / "run.csv"),
                "--model",
                str(tmp_path / "m.toml"),
                "--out",
                str(tmp_path / "o"),
            ]
        )
        == 2
    )
    assert "inverse unstable" in capsys.readouterr().err


def test_every_command_has_help_with_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("demo", "run", "check", "probe", "simulate", "export", "explain"):
        with pytest.raises(SystemExit) as ended:
            main([command, "--help"])
        assert ended.value.code == 0
        assert f"example: compensator {command}" in capsys.readouterr().out


def test_only_adopt_says_that_it_refuses_a_worse_model(capsys: pytest.CaptureFixture[str]) -> None:
    """`back` is never refused for its figures."""
    for command, says in (("adopt", True), ("back", False)):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        text = " ".join(capsys.readouterr().out.split())
        assert ("clearly worse" in text) == says and "do not determine" in text


def test_explain_knows_every_state_and_refuses_others(capsys: pytest.CaptureFixture[str]) -> None:
    for code in ("starting", "ok", "degraded", "hold", "fault", "outside_validity:t_q_degc", "outlier", "HOLD"):
        assert main(["explain", code]) == 0
    assert main(["explain", "nonsense"]) == 2
    capsys.readouterr()
    assert main(["explain", "operator_holt"]) == 2
    error = capsys.readouterr().err
    assert "did you mean operator_hold?" in error and len(error) < 200
    assert main(["explain", "--json"]) == 0
    assert {"hold", "open_listen", "silent", "catching_up"} <= set(json.loads(capsys.readouterr().out))


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["nonsense"],
        ["zero", "--mode", "bogus"],
        ["check"],
        ["report"],
        ["hold", "--timeout", "soon"],
        ["hold", "--timeout", "nan"],
        ["adopt", "quill", "--config", "machine.toml", "--timeout", "1e30"],
        ["dismiss", "--config", "machine.toml", "--timeout=-1"],
        ["watch", "--conect"],
    ],
)
def test_wrong_usage_is_one_line_that_leads_to_the_help(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    error = capsys.readouterr().err
    assert ended.value.code == 2 and error.startswith("compensator") and "--help`" in error and error.count("\n") == 1
    assert START_NS % 60_000_000_000 == 0


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["completion"], "required: shell (one of bash, zsh, fish);"),
        (["completion", "bsh"], "did you mean bash"),
        (["bridge"], "required: protocol (one of opcua, probes), --config;"),
        (["explain", "--cod"], "unrecognized arguments: --cod"),
        (["hold", "--config", "a.toml", "--con=b.toml"], "argument --config: given twice, expected once;"),
        (
            ["simulate", "a.csv", "--out", "b", "--model", "quill", "--y-std", "1", "--y-std", "1"],
            "--y-std: given twice",
        ),
        (
            ["identify", "a.csv", "--out", "b", "--order", "1", "1", "1", "--order", "1", "1", "1"],
            "--order: given twice",
        ),
        (["replay", ""], "argument FILE.mcap: '': expected a name;"),
        (["simulate", "a.csv", "--out", "", "--model", "quill"], "argument --out: '': expected a name;"),
        (["check", "--config="], "argument --config: '': expected a name;"),
        (["adopt", "--config", "a.toml", "--candidate", ""], "argument --candidate: '': expected the first 6 or more"),
        (["dismiss", "", "--config", "a.toml"], "argument HASH: '': expected the first 6 or more"),
    ],
)
def test_wrong_usage_names_what_can_be_chosen(
    words: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(words)
    assert expected in capsys.readouterr().err


def test_what_may_be_repeated_may_and_a_second_command_begins_anew() -> None:
    words = ["compare", "a.csv", "--model", "quill", "--model", "b.toml", "--column", "t_s=t", "--column", "y_um=y"]
    for _ in range(2):
        given = _parser().parse_args(words)
        assert given.model == ["quill", "b.toml"] and given.column == ["t_s=t", "y_um=y"]
    parser = _parser()
    for name in ("a.toml", "b.toml"):
        assert parser.parse_args(["check", "--config", name]).config == name
    for words, hash_ in ((["adopt", "--candidate"], ""), (["dismiss"], ""), (["dismiss", "055e0d2a"], "055e0d2a")):
        assert _hash_of(parser.parse_args([*words, "--config", "a.toml"])) == hash_
    with pytest.raises(UsageError, match="--column t_s=u: t_s is t already"):
        roles_of(["t_s=t", "t_s=u"])


def test_every_command_is_there_and_its_example_parses(capsys: pytest.CaptureFixture[str]) -> None:
    for command in COMMANDS:
        assert callable(load(command))
        with pytest.raises(SystemExit) as ended:
            main([command.name, "--help"])
        assert ended.value.code == 0
        assert f"example: compensator {command.example}" in " ".join(capsys.readouterr().out.split())
        parser = argparse.ArgumentParser()
        command.describe(parser)
        parser.parse_args(command.example.split()[1:])


def test_asking_for_help_loads_no_numbers() -> None:
    code = "import sys\nfrom compensator.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "sys.exit(any(name in sys.modules for name in ('numpy', 'scipy', 'zenoh', 'matplotlib')))"
    assert subprocess.run([sys.executable, "-c", code], check=False, stdout=subprocess.DEVNULL).returncode == 0
