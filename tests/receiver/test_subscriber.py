"""The receiver on the real wire: through a router, over its loss and restarts of either side."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from compensator.demo import live
from compensator.receiver import Receiver, ReceiverError, Settings, load_settings
from tests.ports import free_port
from tests.receiver.offsets import MACHINE
from tests.receiver.wire import PREFIX, ScriptedService, router, until

ROOT = Path(__file__).parents[2]


def settings(port: int, **changes: Any) -> Settings:
    usual: dict[str, Any] = {
        "machine": MACHINE,
        "prefix": PREFIX,
        "connect": (f"tcp/127.0.0.1:{port}",),
        "offset_max_um": 100.0,
        "offset_rate_max_um_per_min": 6_000.0,
    }
    return Settings(**{**usual, **changes})


def at(receiver: Receiver, y_um: float) -> None:
    until(lambda: abs(receiver.poll().offset_um - y_um) < 0.02, f"{y_um} µm, is {receiver.poll()}")


def code_of(receiver: Receiver) -> set[str]:
    return {reason.code for reason in receiver.poll().reasons}


def test_through_a_router_that_goes_and_comes_back(tmp_path: Path) -> None:
    port = free_port()
    state = tmp_path / "state.json"
    with Receiver(settings(port, state_file=str(state)), applied_um=5.0) as receiver:
        first = receiver.poll()  # nobody is there yet, and nothing is waited for
        assert first.offset_um == 5.0 and first.state == "starting" and "not_connected" in code_of(receiver)
        with router(port), ScriptedService(port) as service:
            service.put(10, -3.0, heard=False)
            at(receiver, -3.0)  # the put may have come too early; the query does not
            until(lambda: receiver.poll() and receiver.follower.alive, "the token")
            service.put(11, -4.0)
            at(receiver, -4.0)
            assert receiver.poll().state == "following"
            service.put(10, 50.0)
            until(lambda: "replayed" in code_of(receiver), "the replay is noticed")
            service.put(12, float("nan"))
            until(lambda: "malformed" in code_of(receiver), "what is malformed is noticed")
            assert abs(receiver.poll().offset_um + 4.0) < 0.02 and receiver.follower.dropped["replayed"] == 1
            service.session.delete(service.key)
            until(lambda: receiver.poll() and receiver.follower.dropped["malformed"] == 2, "a delete is no offset")
        until(lambda: receiver.poll() and receiver.follower.alive is False, "the router's loss")
        assert "service_gone" in code_of(receiver) and receiver.poll().state == "following"
        with router(port), ScriptedService(port) as service:
            # Published while nobody could hear it: it comes by the query that the token brings about.
            service.put(20, -6.0, heard=False)
            at(receiver, -6.0)
    assert json.loads(state.read_text()) == {"machine": MACHINE, "last_sequence": 20}
    with router(port), ScriptedService(port) as service:
        with Receiver(settings(port, state_file=str(state)), applied_um=-6.0) as receiver:
            until(lambda: receiver.poll() and receiver.follower.alive, "the token")
            service.put(19, 70.0)
            until(lambda: "replayed" in code_of(receiver), "a replay from before the restart is noticed")
            assert receiver.poll().offset_um == -6.0 and receiver.poll().state == "starting"
            service.put(21, -7.0)
            at(receiver, -7.0)
        # A service whose loop hangs still answers queries. Its old answer is not fresh because it was just given.
        service.put(22, 1.0, heard=False, time_utc_ns=time.time_ns() - 3_600_000_000_000)
        with Receiver(settings(port)) as receiver:
            until(lambda: "late" in code_of(receiver), "the answer's age")
            assert receiver.poll().state == "starting"
            service.put(23, 2.0, time_utc_ns=1)  # live: counts as measured now, unless the clock is to be checked
            at(receiver, 2.0)
        with Receiver(settings(port, check_clock=True)) as receiver:
            until(lambda: receiver.poll() and receiver.follower.dropped.get("late"), "the answer's age")
            service.put(24, 3.0, time_utc_ns=time.time_ns() + 3_600_000_000_000)
            until(lambda: "clock_disagrees" in code_of(receiver), "a message from the future")
            service.put(25, 3.0)
            at(receiver, 3.0)


def test_what_waited_while_the_program_stood_still_is_judged_by_the_wall_clock() -> None:
    port = free_port()
    now = [1000.0]
    with router(port), ScriptedService(port) as service, Receiver(settings(port), clock=lambda: now[0]) as receiver:

        def step(condition: Any, what: str) -> None:
            def stepped() -> bool:
                now[0] += 0.5
                return bool(condition(receiver.poll()))

            until(stepped, what)

        step(lambda a: receiver.follower.alive, "the token")
        service.put(1, 5.0)
        step(lambda a: abs(a.offset_um - 5.0) < 0.02, "the offset")
        service.put(2, 90.0, time_utc_ns=time.time_ns() - 400_000_000_000)

        def stood() -> bool:
            now[0] += 400.0
            receiver.poll()
            return bool(receiver.follower.dropped)

        until(stood, "the old offset is noticed")
        last = receiver.poll()
        # Once as a message, and perhaps as the answer to a query that was under way.
        assert set(receiver.follower.dropped) == {"late"} and last.state == "holding"
        assert last.offset_um == pytest.approx(5.0, abs=0.02)


def test_the_file_of_another_machine_a_damaged_one_and_one_that_cannot_be_written(tmp_path: Path) -> None:
    port, state = free_port(), tmp_path / "state.json"
    state.write_text('{"machine": "vmc-08", "last_sequence": 3}')
    with pytest.raises(ReceiverError, match="vmc-08"):
        Receiver(settings(port, state_file=str(state)))
    for damaged in ("", "{", "[1]", '{"machine": "vmc-07"}', '{"machine": "vmc-07", "last_sequence": true}'):
        state.write_text(damaged)
        assert "state_damaged" in code_of(Receiver(settings(port, state_file=str(state))))
    with (
        router(port),
        ScriptedService(port) as service,
        Receiver(settings(port, state_file=str(tmp_path / "no/state.json"))) as receiver,
    ):
        until(lambda: receiver.poll() and receiver.follower.alive, "the token")
        service.put(1, 5.0)
        at(receiver, 5.0)
        assert "state_not_saved" in code_of(receiver)


def test_a_zenoh_configuration_of_ones_own(tmp_path: Path) -> None:
    port, path = free_port(), tmp_path / "client.json5"
    path.write_text(f"{{mode: 'client', connect: {{endpoints: ['tcp/127.0.0.1:{port}']}}}}")
    with (
        router(port),
        ScriptedService(port) as service,
        Receiver(settings(port, connect=(), zenoh_config=str(path))) as receiver,
    ):
        until(lambda: receiver.poll() and receiver.follower.alive, "the token")
        service.put(1, 5.0)
        at(receiver, 5.0)
    for text, expected in (
        ("{mode: 'peer'}", "expected 'client'"),
        ("{mod: 1}", "expected a Zenoh configuration"),
        ("{a:" * 100_000, "more than 15000 brackets"),  # Zenoh's parser would end the process
        ("{a:" * 15_000, "expected a Zenoh configuration"),
    ):
        path.write_text(text)
        with pytest.raises(ReceiverError, match=expected):
            Receiver(settings(port, connect=(), zenoh_config=str(path)))


def test_as_a_program_and_the_example(tmp_path: Path) -> None:
    port, path = free_port(), tmp_path / "receiver.toml"
    path.write_text(f"""[receiver]
machine = "{MACHINE}"
prefix = "{PREFIX}"
connect = ["tcp/127.0.0.1:{port}"]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6000.0
""")
    programs = (
        ["-m", "compensator.receiver", "--config", str(path)],
        [str(ROOT / "deploy/receiver/follow.py"), str(path)],
    )
    with router(port), ScriptedService(port) as service:
        for seq, program in enumerate(programs, 1):
            service.put(seq, -4.0, heard=False)
            with subprocess.Popen([sys.executable, *program], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                try:
                    assert any("-4.00" in line for line in process.stdout)
                finally:
                    process.send_signal(signal.SIGINT)
                    process.stdout.read()
    done = subprocess.run(
        [sys.executable, "-m", "compensator.receiver", "--config", str(tmp_path / "none.toml")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "none.toml" in done.stderr
    done = subprocess.run(
        [sys.executable, str(ROOT / "deploy/receiver/follow.py"), str(tmp_path / "none.toml")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "none.toml" in done.stderr


@pytest.mark.parametrize(
    ("program", "settings_of"),
    [
        (["-m", "compensator.receiver", "--config"], "receiver"),
        ([str(ROOT / "deploy/receiver/follow.py")], "receiver"),
        ([str(ROOT / "deploy/receiver/follow_axes.py")], "receiver_axes"),
    ],
)
def test_a_program_that_nobody_reads_ends_in_one_line(program: list[str], settings_of: str) -> None:
    read, write = os.pipe()
    os.close(read)
    path = ROOT / f"deploy/receiver/{settings_of}.example.toml"
    try:
        done = subprocess.run(
            [sys.executable, *program, str(path)], cwd=ROOT, stdout=write, stderr=subprocess.PIPE, text=True, timeout=60
        )
    finally:
        os.close(write)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "Broken pipe" in done.stderr


def test_the_shipped_settings_follow_the_machine_to_try_things_on() -> None:
    settings, _ = load_settings(ROOT / "deploy/receiver/receiver.example.toml")
    assert (settings.machine, settings.prefix) == (live.MACHINE, live.PREFIX)
