"""SIGINT and SIGTERM end every program that runs on, also where whoever started it ignored and blocked both."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from compensator.cli import main as cli_main
from compensator.commands import Answer
from tests.ports import free_port
from tests.receiver.wire import router, until

ROOT = Path(__file__).parents[2]
#: Starts a program as a script's background does, and worse.
IGNORING = """
import os, signal, sys
both = (signal.SIGINT, signal.SIGTERM)
for number in both:
    signal.signal(number, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_BLOCK, both)
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""
RECEIVER = """[receiver]
machine = "vmc-07"
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:{port}"]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6.0
"""
OPCUA = """
[opcua]
endpoint = "opc.tcp://127.0.0.1:1"
offset_node = "ns=2;i=2"
unit = "um"
sign = 1
sign_checked = "simulated"
"""
PROBES = """[probes]
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:{port}"]
send_within_s = 900.0
state_file = "state.json"
[[dprnt]]
address = "127.0.0.1:1"
sign = -1
sign_checked = "simulated"
retry_s = 0.1
"""
ROUTER = '{mode: "router", listen: {endpoints: ["tcp/127.0.0.1:{port}"]}, scouting: {multicast: {enabled: false}}}'
EXAMPLE = (ROOT / "deploy/machine.example.toml").read_text(encoding="utf-8")
MACHINE = (
    EXAMPLE.replace(":7447", ":{port}")
    .replace("/var/lib/compensator/vmc-07/", "")
    .replace("192.168.10.22", "127.0.0.1")
)
AXES = (ROOT / "deploy/receiver/receiver_axes.example.toml").read_text(encoding="utf-8").replace(":7447", ":{port}")
COMMAND = ["-m", "compensator"]
PROGRAMS = {
    "receiver": (["-m", "compensator.receiver", "--config", "file.json5"], RECEIVER),
    "follow.py": ([str(ROOT / "deploy/receiver/follow.py"), "file.json5"], RECEIVER),
    "follow_axes.py": ([str(ROOT / "deploy/receiver/follow_axes.py"), "file.json5"], AXES),
    "run": ([*COMMAND, "run", "--config", "file.json5"], MACHINE),
    "bridge opcua": ([*COMMAND, "bridge", "opcua", "--config", "file.json5"], RECEIVER + OPCUA),
    "bridge probes": ([*COMMAND, "bridge", "probes", "--config", "file.json5"], PROBES),
    "router": ([*COMMAND, "router", "--config", "file.json5"], ROUTER),
    "watch": ([*COMMAND, "watch", "--connect", "tcp/127.0.0.1:{port}"], ""),
}

#: What a program has written when it is at work; otherwise its first line.
READY = {"run": "running", "router": "listens"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", PROGRAMS)
def test_ends_when_started_with_the_signals_ignored_and_blocked(
    tmp_path: Path, name: str, number: signal.Signals
) -> None:
    words, text = PROGRAMS[name]
    port = free_port()
    (tmp_path / "file.json5").write_text(text.replace("{port}", str(port)))
    command = [sys.executable, "-c", IGNORING, *(word.replace("{port}", str(port)) for word in words)]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        shown = ""
        while READY.get(name, "\n") not in shown:
            line = process.stdout.readline()
            assert line, shown
            shown += line
        process.send_signal(number)
        shown += process.communicate(timeout=50)[0]
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 0 and "Traceback" not in shown, shown


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", PROGRAMS)
def test_a_signal_that_waited_for_the_program_to_start_ends_it(
    tmp_path: Path, name: str, number: signal.Signals
) -> None:
    """Sent while both are ignored and blocked, it is kept; unblocked while still ignored it would be lost."""
    words, text = PROGRAMS[name]
    port = free_port()
    (tmp_path / "file.json5").write_text(text.replace("{port}", str(port)))
    script = IGNORING.replace("os.execv", f"os.kill(os.getpid(), {number.value})\nos.execv")
    command = [sys.executable, "-c", script, *(word.replace("{port}", str(port)) for word in words)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=50, check=False)
    assert done.returncode in (0, 130, -signal.SIGTERM) and "Traceback" not in done.stderr, done.stderr


def test_a_recording_that_is_not_complete_is_no_success(tmp_path: Path) -> None:
    port = free_port()
    text = MACHINE.replace("{port}", str(port)).replace("poll_interval_s = 1.0", "poll_interval_s = 0.1")
    (tmp_path / "machine.toml").write_text(text)
    full = "import os, resource as of, sys\nof.setrlimit(of.RLIMIT_FSIZE, (0, 0))\nos.execv(sys.argv[1], sys.argv[1:])"
    command = [sys.executable, "-c", full, sys.executable, *COMMAND, "run", "--config", "machine.toml"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            while "running" not in process.stderr.readline():
                assert process.poll() is None
            process.terminate()
            *_, last = process.communicate(timeout=50)[1].splitlines()
        finally:
            process.kill()
    assert process.returncode == 1
    assert last.startswith("compensator: stopped; the recording is not complete: the recording could not be finished: ")


def test_sigterm_ends_the_example_that_was_started_with_it_ignored() -> None:
    port = free_port()
    ignored = IGNORING.replace("signal.pthread_sigmask", "# signal.pthread_sigmask")
    words = [str(ROOT / "deploy/examples/subscriber.py"), f"tcp/127.0.0.1:{port}"]
    with router(port), subprocess.Popen([sys.executable, "-c", ignored, *words]) as process:
        try:
            status = Path(f"/proc/{process.pid}/status")
            until(lambda: is_kept(status, signal.SIGTERM), "SIGTERM is no longer ignored")
            process.terminate()
            assert process.wait(timeout=20) == -signal.SIGTERM
        finally:
            process.kill()


def is_kept(status: Path, number: int) -> bool:
    """Whether a process does not ignore a signal."""
    (ignored,) = (line.split()[1] for line in status.read_text().splitlines() if line.startswith("SigIgn"))
    return not int(ignored, 16) >> (number - 1) & 1 and "python" in status.read_text()


#: Waits while another process sends signals one after another: a handler that needs a lock meets itself.
STORMED = """
import os, subprocess, sys
from compensator.commands.stopping import until_stopped
storm = "import os, sys\\nwhile True: os.kill(int(sys.argv[1]), 15)"
with until_stopped() as stop:
    sender = subprocess.Popen([sys.executable, "-c", storm, str(os.getpid())])
    try:
        for _ in range(1000):
            assert stop.wait(10.0)
    finally:
        sender.kill()
        sender.wait()
"""


def test_a_signal_that_comes_while_a_program_waits_for_it_does_not_lock_it_up() -> None:
    subprocess.run([sys.executable, "-c", STORMED], timeout=60, check=True)


def test_an_interrupt_that_python_drops_is_not_taken_for_success(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An exception of a signal's handler that meets the callback of a weak reference is printed and lost."""

    class Dropped:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    def command(_: object) -> Answer:
        held = Dropped()
        del held
        return Answer({}, "done")

    monkeypatch.setattr("compensator.cli.load", lambda name: command)
    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)
    assert cli_main(["check", "--config", "machine.toml"]) == 130
    assert "done" not in capsys.readouterr().out


def test_an_interrupt_that_an_import_answers_to_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiled module that is interrupted while it is made says that its initialization failed."""

    def command(_: object) -> Answer:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None
        return Answer({}, "done")

    monkeypatch.setattr("compensator.cli.load", lambda name: command)
    assert cli_main(["check", "--config", "machine.toml"]) == 130
