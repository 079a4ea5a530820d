"""Several axes on the real wire, their settings, and the length of the tool."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh

from compensator.receiver import (
    AppliedAxes,
    AxesReceiver,
    AxesSettings,
    ControlState,
    ReceiverError,
    Settings,
    load_any,
    load_settings,
)
from compensator.receiver.applied_record import applied_at
from compensator.receiver.tool_length import ToolLength
from tests.ports import free_port
from tests.receiver.offsets import slope
from tests.receiver.wire import ScriptedService, router, until

ROOT = Path(__file__).parents[2]
FILE = """
[receiver]
machine = "vmc-07"
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:7447"]
state_file = "state.json"
applied_file = "applied.txt"

[axis.y]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6000.0
slope_max_um_per_m = 50.0
position_min_mm = 0.0
position_max_mm = 500.0
position_speed_max_mm_per_s = 600.0

[axis.z]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6000.0
sign = -1

[axis.a]
offset_max_urad = 100.0

[tool]
length_min_mm = 20.0
length_max_mm = 400.0
length_from = "zenoh"
"""


def written(folder: Path, port: int = 7447, *, old: str = "", new: str = "") -> Path:
    assert old in FILE
    path = folder / "receiver.toml"
    path.write_text(FILE.replace(old, new, 1).replace("7447", str(port)), encoding="utf-8")
    return path


def loaded(path: Path) -> AxesSettings:
    settings, others = load_any(path)
    assert isinstance(settings, AxesSettings) and not others
    return settings


def codes(applied: AppliedAxes) -> set[str]:
    return {reason.code for reason in applied.reasons}


def test_through_a_router_together_or_not_at_all(tmp_path: Path) -> None:
    port = free_port()
    path = written(tmp_path, port)
    read = ControlState(positions_mm={"y": 200.0})
    with router(port), ScriptedService(port) as service:

        def at(receiver: AxesReceiver, y_um: float, z_um: float) -> None:
            def there() -> bool:
                axes = receiver.poll(read).axes
                return abs(axes["y"].offset_um - y_um) < 0.02 and abs(axes["z"].offset_um - z_um) < 0.02

            until(there, lambda: f"{y_um}, {z_um}: {receiver.poll(read).text}")

        def sends(seq: int, *, without: str = "", heard: bool = True, y: float = 1.0) -> None:
            values = {"x": 0.0, "y": {"value": y, **slope(10.0, 100.0)}, "z": 2.0, "a": 20.0}
            service.put_axes(seq, without=without, heard=heard, **values)

        sends(1, heard=False)
        with AxesReceiver(loaded(path)) as receiver:
            at(receiver, 2.0, -2.0)  # by the query: 1 µm and a tenth of a metre of slope
            until(lambda: codes(receiver.poll(read)) == {"no_tool_length", "further_axes"}, "what is said")
            service.put_length(250.0)
            at(receiver, 5.0, -2.0)  # and 20 µrad on 150 mm
            sends(2, without="z", y=30.0)
            until(lambda: "incomplete" in codes(receiver.poll(read)), "an axis is missing")
            assert receiver.poll(read).seq == 1
            at(receiver, 5.0, -2.0)
            sends(3, y=3.0)
            at(receiver, 7.0, -2.0)
            until(lambda: codes(receiver.poll(read)) == {"further_axes"}, "what is said")
            service.put_length(None)
            at(receiver, 4.0, -2.0)
            service.put_length("250")  # type: ignore[arg-type]
            until(lambda: "malformed" in codes(receiver.poll(read)), "no length")
            receiver.record({"y": 4.0, "z": -2.0})
        assert json.loads((tmp_path / "state.json").read_text()) == {"machine": "vmc-07", "last_sequence": 3}
        now_ns = time.time_ns()
        assert applied_at(tmp_path / "applied.txt", now_ns) == 4.0
        assert applied_at(tmp_path / "applied-z.txt", now_ns) == 2.0  # in the service's direction
        with AxesReceiver(loaded(path), applied_um={"y": 4.0, "z": -2.0}) as receiver:
            until(lambda: receiver.poll(read).seq == 3, "the newest sample is queried again after a restart")

            def is_noticed() -> bool:
                # Again and again: to the router the receiver before may still be the only subscriber.
                sends(3, y=40.0)
                return "replayed" in codes(receiver.poll(read))

            until(is_noticed, "a replay is noticed")
            at(receiver, 4.0, -2.0)
        command = [sys.executable, "-m", "compensator.receiver", "--config", str(path)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                # Starting, or the answer was there at once.
                assert process.stdout.readline().startswith("y +0.00, z +0.00 µm, ")
                assert any("following" in line for line in process.stdout)
            finally:
                process.terminate()


def test_a_stranger_that_answers_with_thousands_of_keys_holds_up_no_offset(tmp_path: Path) -> None:
    """Zenoh's thread waits for the buffer of an answer: whoever asks by a pattern lets a stranger fill it."""
    port = free_port()

    def flood(query: Any) -> None:
        with query:
            for i in range(3000):
                asked_for = str(query.key_expr)
                with suppress(zenoh.ZError):  # not what was asked for
                    query.reply(asked_for.replace("*", f"k{i}"), b"x" * 1000)

    with router(port):
        service, stranger = ScriptedService(port), ScriptedService(port, "shop/stranger")
        flooding = stranger.session.declare_queryable("shop/vmc-07/thermal/*/offset", flood)
        try:
            with AxesReceiver(loaded(written(tmp_path, port))) as receiver:
                until(lambda: receiver.poll() and receiver.connected, "a connection")
                for seq in (1, 2):
                    service.put_axes(seq, y=10.0 * seq, z=5.0, a=1.0)
                    until(lambda seq=seq: receiver.poll().seq == seq, f"sample {seq}")
        finally:
            flooding.undeclare()
            stranger.close()
            service.close()


@pytest.mark.parametrize("name", ["applied.txt", "applied-z.txt"])
def test_an_axis_that_is_recorded_hides_none_that_is_not(tmp_path: Path, name: str) -> None:
    receiver = AxesReceiver(loaded(written(tmp_path)))
    (tmp_path / name).mkdir()
    receiver.record({"y": 1.0, "z": 2.0})
    assert "applied_not_recorded" in codes(receiver.poll())
    (tmp_path / name).rmdir()
    receiver.record({"y": 2.0, "z": 3.0})
    assert "applied_not_recorded" not in codes(receiver.poll())


def test_a_length_that_waited_while_the_loop_stood_still_is_as_old_as_it_is(tmp_path: Path) -> None:
    port, now_s = free_port(), [1000.0]

    def after_a_pause(receiver: AxesReceiver) -> set[str]:
        now_s[0] += 7200.0
        return codes(receiver.poll())

    with router(port), ScriptedService(port) as service:
        service.put_axes(1, heard=False, y=1.0, z=2.0, a=20.0)
        with AxesReceiver(loaded(written(tmp_path, port)), clock=lambda: now_s[0]) as receiver:
            until(lambda: receiver.poll().seq == 1, "a sample")
            service.put_length(250.0, time_utc_ns=time.time_ns() - 6600 * 10**9)  # valid for 600 s
            heard: list[set[str]] = []

            def is_heard() -> bool:
                heard.append(after_a_pause(receiver))
                return "late" in heard[-1] or "no_tool_length" not in heard[-1]

            until(is_heard, "the length")
            assert {"late", "no_tool_length"} <= heard[-1]
            service.put_length(120.0, time_utc_ns=time.time_ns() - 100 * 10**9)
            until(lambda: "no_tool_length" not in after_a_pause(receiver), "the next one")
            now_s[0] += 400.0
            assert "no_tool_length" not in codes(receiver.poll())
            now_s[0] += 110.0
            assert "no_tool_length" in codes(receiver.poll())


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("[axis.z]", "[axis.w]", "axis.w: unknown axis"),
        ("offset_max_um = 100.0\n", "", "axis.y.offset_max_um: missing, expected a number"),
        ("sign = -1", "sign = 0", "axis.z.sign = 0: expected 1 or -1"),
        ("sign = -1", "signs = -1", "axis.z.signs: unknown key"),
        ("sign = -1", "sign = true", "axis.z.sign = True: expected a whole number"),
        ("offset_max_urad = 100.0", "offset_max_urad = nan", "axis.a.offset_max_urad = nan: expected a number"),
        ("offset_max_urad = 100.0", "offset_max_um = 1.0", "axis.a.offset_max_um: unknown key"),
        ("position_max_mm = 500.0\n", "", "axis.y.position_min_mm = 0, position_max_mm = 0: expected"),
        ("length_min_mm = 20.0", "length_min_mm = 500.0", "tool.length_min_mm = 500"),
        ('"zenoh"', '"plc"', "tool.length_from = 'plc'"),
        ("[tool]", "[tools]", "axis.a: an angle needs a table [tool]"),
        ("[axis.y]", "offset_max_um = 1.0\n[axis.y]", "receiver.offset_max_um: expected it in each table [axis.y]"),
        ("[axis.y]", "valid_max_s = -1\n[axis.y]", "receiver.valid_max_s = -1.0: expected a number above 0"),
    ],
)
def test_bad_settings_get_one_line(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = written(tmp_path, old=old, new=new)
    with pytest.raises(ReceiverError) as caught:
        load_any(path)
    text = str(caught.value)
    assert expected in text and str(path) in text and "\n" not in text and text.count(str(path)) == 1


def test_the_example_program_follows_a_service_with_the_shipped_settings(tmp_path: Path) -> None:
    port, path = free_port(), tmp_path / "receiver.toml"
    text = (ROOT / "deploy/receiver/receiver_axes.example.toml").read_text(encoding="utf-8")
    path.write_text(text.replace("7447", str(port)).replace("min = 10.0", "min = 6000.0"), encoding="utf-8")
    program = [sys.executable, str(ROOT / "deploy/receiver/follow_axes.py")]
    with router(port), ScriptedService(port) as service:
        y = {"value": -4.0, **slope(20.0, 300.0)}
        service.put_axes(1, heard=False, x=1.0, y=y, z=-7.0, a=30.0)
        with subprocess.Popen([*program, str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            try:
                # Nothing is read of a control: the tool is the reference, Y at the middle of its travel.
                line = next(line for line in process.stdout if "x +1.00, y -4.00, z -7.00 µm, following" in line)
                assert "[no_tool_length]" in line and "[no_position]" in line
            finally:
                process.send_signal(signal.SIGINT)
                process.stdout.read()
        assert process.returncode == 0
    for name, expected in (("none.toml", "none.toml"), ("receiver.example.toml", "of Y alone: follow.py")):
        done = subprocess.run(
            [*program, str(ROOT / "deploy/receiver" / name)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and expected in done.stderr


def test_a_program_of_one_axis_refuses_a_file_of_several(tmp_path: Path) -> None:
    with pytest.raises(ReceiverError, match=r"axis\.y: this program applies one axis"):
        load_settings(written(tmp_path))


def test_a_file_without_tables_of_axes_is_of_one(tmp_path: Path) -> None:
    for text, others in (("", {}), ('[axis]\nletter = "z"\n', {"axis": {"letter": "z"}})):
        path = tmp_path / "receiver.toml"
        limits = "offset_max_um = 1.0\noffset_rate_max_um_per_min = 1.0\n"
        path.write_text(FILE.partition("[axis.y]")[0] + limits + text)
        settings, left = load_any(path)
        assert isinstance(settings, Settings) and left == others


# ---------------------------------------------------------------------- the length of the tool


def length(mm: Any = 120.0, **changes: Any) -> bytes:
    own = {"schema": 1, "machine": "vmc-07", "time_utc_ns": 10_000_000_000, "valid_for_s": 60.0, "tool_length_mm": mm}
    return json.dumps({**own, **changes}).encode()


def test_a_length_is_used_while_it_is_valid() -> None:
    tool = ToolLength("vmc-07")
    assert tool.at(0.0) is None and tool.receive(5.0, length()) and tool.at(65.0) == 120.0 and tool.at(65.1) is None
    assert tool.receive(100.0, length(None)) and tool.at(100.0) is None
    assert not tool.receive(100.0, length(5.0), utc_ns=lambda: 11_000_000_000, asked=True)  # overtaken by a message
    tool = ToolLength("vmc-07")
    assert tool.receive(100.0, length(5.0), utc_ns=lambda: 40_000_000_000, asked=True)
    assert tool.at(130.0) == 5.0 and tool.at(131.0) is None  # an answer keeps its age


def test_an_older_length_replaces_none_that_is_valid() -> None:
    tool, clock = ToolLength("vmc-07"), lambda: 30_000_000_000
    assert tool.receive(0.0, length(80.0, time_utc_ns=30_000_000_000), utc_ns=clock)
    older = length(50.0, time_utc_ns=29_000_000_000)
    assert not tool.receive(1.0, older, utc_ns=clock) and tool.at(2.0) == 80.0
    assert [reason.code for reason in tool.reasons] == ["replayed"] and "1.0 s older" in tool.reasons[0].detail
    # The other clock was set back: what comes once the last one has expired is used.
    assert tool.receive(61.0, older, utc_ns=clock) and tool.at(62.0) == 50.0
    # Without a clock nothing says which of both times is wrong.
    assert tool.receive(70.0, length(80.0, time_utc_ns=10**18)) and tool.receive(71.0, length(60.0))


@pytest.mark.parametrize(
    ("payload", "code"),
    [
        (b"", "malformed"),
        (length("5"), "malformed"),
        (length(float("nan")), "malformed"),
        (length(1e6), "malformed"),
        (length().replace(b"120.0", b"9" * 400), "malformed"),
        (length(valid_for_s=0.0), "malformed"),
        (length(time_utc_ns=-1), "malformed"),
        (length(schema=2), "other_schema"),
        (length(machine="vmc-08"), "other_machine"),
        (length(machine=["\ud800"]), "other_machine"),
        (length(time_utc_ns=1), "late"),
        (length(time_utc_ns=10**18), "clock_disagrees"),
    ],
)
def test_what_is_no_length_is_dropped_with_a_reason_and_the_last_one_stays(payload: bytes, code: str) -> None:
    tool = ToolLength("vmc-07")
    assert tool.receive(0.0, length(80.0))
    assert not tool.receive(1.0, payload, utc_ns=lambda: 61_000_000_000 if code == "late" else 10_000_000_000)
    assert [reason.code for reason in tool.reasons] == [code] and tool.at(2.0) == 80.0
    assert tool.reasons[0].marked.isprintable()
    assert tool.receive(3.0, length()) and not tool.reasons
