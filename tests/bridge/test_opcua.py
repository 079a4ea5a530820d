"""The bridge against a PLC's OPC UA server on loopback: values, checks, losses, and what it refuses to start with."""

from __future__ import annotations

import asyncio
import itertools
import json
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from compensator.bridge.axes_settings import load_any_bridge
from compensator.bridge.opcua import Bridge
from compensator.bridge.plc_client import real
from compensator.bridge.settings import OpcUa
from compensator.cli import main
from compensator.errors import ConfigError
from compensator.receiver import Receiver, Settings
from compensator.receiver.applied_record import applied_at
from tests.bridge.plc import Plc
from tests.ports import free_port
from tests.receiver.wire import ScriptedService, router

CYCLE_S, RATE_UM_PER_S = 0.05, 100.0
#: Largest step of the value: what the rate allows in two cycles.
STEP_UM = 2 * CYCLE_S * RATE_UM_PER_S + 0.01
FILE = """
[receiver]
machine = "vmc-07"
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:{zenoh}"]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6000.0
applied_file = "applied.txt"

[opcua]
endpoint = "{endpoint}"
offset_node = "ns=2;s=/Plc/DB100.DBD0:REAL"
unit = "mm"
sign = -1
sign_checked = "2026-03-02, dial gauge, J. Novak"
cycle_s = 0.05
resume_after_s = 1.0
retry_s = 0.2
timeout_s = 5.0
heartbeat_node = "ns=2;s=/Plc/DB100.DBW4"
state_node = "ns=2;s=/Plc/DB100.DBW6"
enable_node = "ns=2;s=/Plc/DB100.DBX8.0"
probe_wanted_node = "ns=2;s=/Plc/DB100.DBX8.1"
"""


def written(folder: Path, endpoint: str = "opc.tcp://127.0.0.1:4840", zenoh: int = 7447, **changes: str) -> Path:
    text = FILE.format(endpoint=endpoint, zenoh=zenoh)
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "bridge.toml"
    path.write_text(text, encoding="utf-8")
    return path


async def until(
    condition: Callable[[], Awaitable[Any]], what: str | Callable[[], str], timeout_s: float = 120.0
) -> None:
    end = time.monotonic() + timeout_s
    while not await condition():
        assert time.monotonic() < end, f"not within {timeout_s} s: {what() if callable(what) else what}"
        await asyncio.sleep(0.02)


class Clock:
    """The clock of a bridge, which a test may stop: a busy computer may take longer than a time that must not pass."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._stopped_s: float | None = None
        patch.setattr("compensator.bridge.opcua.monotonic_s", self)

    def __call__(self) -> float:
        return time.monotonic() if self._stopped_s is None else self._stopped_s

    @contextmanager
    def stopped(self) -> Iterator[None]:
        self._stopped_s = time.monotonic()
        yield
        self._stopped_s = None


def refused(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one line with which a bridge refuses its settings."""
    assert main(["bridge", "opcua", "--config", str(path)]) == 2
    error = capsys.readouterr().err
    assert str(path) in error and error.count("\n") == 1
    return error


def loaded(path: Path) -> tuple[Settings, OpcUa]:
    receiver, opcua = load_any_bridge(path)
    assert isinstance(receiver, Settings) and isinstance(opcua, OpcUa)
    return receiver, opcua


@asynccontextmanager
async def bridging(path: Path, said: list[str]) -> AsyncIterator[Bridge]:
    settings, opcua = loaded(path)
    stop = asyncio.Event()
    with Receiver(settings, step_max_s=2.0 * opcua.cycle_s) as receiver:
        bridge = Bridge(opcua, receiver, said.append)
        task = asyncio.create_task(bridge.run(stop))
        try:
            yield bridge
        finally:
            stop.set()
            await task


def check(values: list[float]) -> None:
    steps = [abs(b - a) * 1000.0 for a, b in itertools.pairwise(values)]
    assert len(values) > 1 and max(steps) <= STEP_UM, max(steps)


async def test_from_the_offset_to_the_data_block_and_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    zenoh, plc, said = free_port(), Plc(free_port(), value=0.002), []  # type: tuple[int, Plc, list[str]]
    path = written(tmp_path, plc.endpoint, zenoh)

    async def at(um: float) -> bool:
        return abs(await plc.um() - um) < 0.05

    with router(zenoh), ScriptedService(zenoh) as service:
        async with bridging(path, said) as bridge:
            await until(lambda: asyncio.sleep(0, any("trouble" in line for line in said)), "no PLC yet")
            async with plc:
                await until(lambda: asyncio.sleep(0, bridge._beat > 3), "connected")
                assert await at(2.0)  # what it held stands until there is an offset
                service.put(1, -12.0)
                await until(lambda: at(12.0), "minus the offset, in mm")
                assert await plc.probe_wanted.read_value() is False
                service.put_status(probe_wanted=True)
                await until(lambda: _is(plc.probe_wanted, True), "a probe is wanted")
                # For probes: what the PLC holds, with the sign of the offset.
                await until(lambda: asyncio.sleep(0, _applied_um(tmp_path) == -12.0), "the record")
                check(plc.values)
                await until(lambda: asyncio.sleep(0, said[-1] == "following"), "following is said")
                assert await plc.state.read_value() == 1
                beat = await plc.heartbeat.read_value()
                await until(lambda: _changed(plc, beat), "the heartbeat")
                await plc.enable.write_value(False)  # the PLC's own interlock
                await until(lambda: _is(plc.state, 2), "it holds")
                service.put(2, -20.0)
                assert await at(12.0)
                await plc.enable.write_value(True)
                await until(lambda: at(20.0), "it goes on")
                await until(lambda: asyncio.sleep(0, said[-1] == "following"), "all is written")
                # Somebody else writes: it stands, says so, and goes on from there once that stands.
                with clock.stopped():
                    await plc.put(-30.0)
                    await until(lambda: asyncio.sleep(0, "[plc_written_over]" in said[-1]), "the difference is said")
                    assert await at(-30.0) and await plc.state.read_value() == 4
                    count = len(plc.values)
                await until(lambda: at(20.0), "it goes on")
                check(plc.values[count - 1 :])
                # A write that is refused moves nothing and is tried again.
                await plc.offset.set_writable(False)
                service.put(3, -25.0)
                await until(lambda: asyncio.sleep(0, "NotWritable" in said[-1] or "Denied" in said[-1]), "refused")
                assert await at(20.0)
                await plc.offset.set_writable(True)
                await until(lambda: at(25.0), "it goes on")
                await until(lambda: asyncio.sleep(0, said[-1] == "following"), "all is written")
                # What the PLC holds is no offset: nothing is written over it.
                await plc.put(5_000.0)
                await until(lambda: asyncio.sleep(0, "plc_beyond_limit" in said[-1]), "it is said")
                assert await at(5_000.0)
                await plc.put(0.0)
                count = len(plc.values)
                await until(lambda: at(25.0), "it goes on")
                check(plc.values[count:])
            await until(lambda: asyncio.sleep(0, said[-1].startswith("trouble: opc.tcp")), "the server is gone")
            assert (tmp_path / "applied.txt").read_text().endswith(" -\n")  # what it has now is not known
            service.put(4, -10.0)
            again = Plc(plc.port, value=0.04)
            async with again:  # restarted, holding something else
                await until(lambda: _near(again, 10.0), "it goes on from what the PLC holds")
                assert again.values[0] == pytest.approx(0.04)
                check(again.values)
                service.put(5, None, state="fault")
                await until(lambda: _is(again.state, 2), "it holds")
                await until(lambda: asyncio.sleep(0, "no reliable offset" in said[-1]), "it is said")
                assert await _near(again, 10.0)
                integer = {"/Plc/DB100.DBD0:REAL": "/Plc/DB100.DBW6"}
                settings, opcua = loaded(written(tmp_path, plc.endpoint, zenoh, **integer))
                with (
                    Receiver(settings) as receiver,
                    pytest.raises(ConfigError, match="a UInt16, expected one of Float"),
                ):
                    await Bridge(opcua, receiver, said.append).run(asyncio.Event())


@pytest.mark.parametrize(("kind", "last"), [("Byte", 255), ("Int16", 32767), ("UInt16", 32767)])
async def test_the_heartbeat_begins_again_before_its_node_is_full(tmp_path: Path, kind: str, last: int) -> None:
    said: list[str] = []
    async with (
        Plc(free_port(), heartbeat=ua.VariantType[kind]) as plc,
        bridging(written(tmp_path, plc.endpoint, free_port()), said) as bridge,
    ):
        bridge._beat = last - 2

        async def is_over() -> bool:
            return await plc.heartbeat.read_value() in range(1, 100) or any("trouble" in line for line in said)

        await until(is_over, "the end of the count")
        assert not any("trouble" in line for line in said), said


def _applied_um(folder: Path) -> float | None:
    return applied_at(folder / "applied.txt", time.time_ns())


async def _changed(plc: Plc, beat: int) -> bool:
    return bool(await plc.heartbeat.read_value() != beat)


async def _is(node: Any, value: int) -> bool:
    return bool(await node.read_value() == value)


async def _near(plc: Plc, um: float) -> bool:
    return abs(await plc.um() - um) < 0.05


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("sign = -1\n", "", "opcua.sign: missing; determine the sign on this machine with a dial gauge"),
        ("sign = -1\n", "sign = 0\n", "opcua.sign = 0: expected 1 or -1"),
        ("sign = -1\n", "sign = -1.0\n", "opcua.sign = -1.0: expected a whole number"),
        ('sign_checked = "2026-03-02, dial gauge, J. Novak"\n', "", "opcua.sign_checked: missing"),
        ('"2026-03-02, dial gauge, J. Novak"', '" "', "opcua.sign_checked = ' ': expected who"),
        ('unit = "mm"', 'unit = "inch"', "opcua.unit = 'inch': expected one of mm, um"),
        ('unit = "mm"', "", "opcua.unit: missing"),
        ("cycle_s", "cycles_s", "opcua.cycles_s: unknown key"),
        ("cycle_s = 0.05", "cycle_s = 0.0", "opcua.cycle_s = 0.0: expected 0.05 to 10"),
        ('"opc.tcp:', '"http:', "expected opc.tcp://HOST:PORT"),
        ('"opc.tcp://', '"opc.tcp://[::1', "expected opc.tcp://HOST:PORT"),
        ('"opc.tcp://', '"opc.tcp://:x', "expected opc.tcp://HOST:PORT"),
        ("retry_s", 'user = "x"\nretry_s', "user and password_file together"),
        ("retry_s", 'security_policy = "None"\nretry_s', "opcua.security_policy = 'None': expected one of"),
        ("retry_s", 'certificate = "c.der"\nretry_s', "private_key and server_certificate together"),
        ("retry_s", 'user = "x"\npassword_file = "p"\nretry_s', "opcua.password_file = 'p': no such file"),
        ("[opcua]", "[opc-ua]", "opcua: missing"),
        ("[opcua]", "[other]\nx = 1\n[opcua]", "other: unknown table"),
        ("offset_max_um", "offset_maximum_um", "receiver.offset_maximum_um: unknown key"),
    ],
)
def test_it_does_not_start_like_this(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, expected: str
) -> None:
    assert expected in refused(written(tmp_path, **{old: new}), capsys)


def self_signed() -> tuple[bytes, bytes]:
    """Return a private key and its certificate, PEM."""
    key = rsa.generate_private_key(65537, 2048)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "bridge")])
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(1).not_valid_before(datetime(2026, 1, 1)).not_valid_after(datetime(2046, 1, 1))
    pem = serialization.Encoding.PEM
    private = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return private, builder.sign(key, hashes.SHA256()).public_bytes(pem)


@pytest.mark.parametrize("key", ["certificate", "private_key", "server_certificate", "password_file"])
def test_a_file_that_cannot_be_read_is_refused_before_the_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    (tmp_path / "junk").write_bytes(b"\xff\xfe no certificate, no key, no text")
    right = {"certificate": "c.pem", "private_key": "k.pem", "server_certificate": "c.pem"}
    for name, data in zip(("k.pem", "c.pem"), self_signed(), strict=True):
        (tmp_path / name).write_bytes(data)
    files = {"password_file": "junk"} if key == "password_file" else right | {key: "junk"}
    more = "".join(f'{name} = "{file}"\n' for name, file in files.items())
    more += 'user = "x"\n' if key == "password_file" else 'security_policy = "Basic256Sha256"\n'
    assert f"opcua.{key} = 'junk': " in refused(written(tmp_path, retry_s=f"{more}retry_s"), capsys)


async def test_no_answer_of_a_server_ends_the_bridge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What asyncua raises on an answer that it cannot read may be anything; also while it connects."""
    left: list[Exception] = [AssertionError(), struct.error("unpack"), IndexError("x"), TypeError("y")]
    connect = Client.connect

    async def breaks(client: Client) -> None:
        if left:
            raise left.pop()
        await connect(client)

    monkeypatch.setattr(Client, "connect", breaks)
    async with (
        Plc(free_port(), 0.0) as plc,
        bridging(written(tmp_path, plc.endpoint, free_port()), []) as bridge,
    ):

        async def is_ready() -> bool:
            return not left and not bridge.register.trouble

        await until(is_ready, lambda: bridge.register.trouble)


def test_check_opens_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bridge", "opcua", "--config", str(written(tmp_path)), "--check", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sign"] == -1


def test_the_trial_without_a_plc_can_be_loaded() -> None:
    settings, opcua = loaded(Path(__file__).parents[2] / "deploy/opcua/trial.toml")
    assert (settings.prefix, opcua.offset_node, opcua.unit) == ("shop/vmc-07", "ns=2;i=2", "um")


@pytest.mark.parametrize("value", [None, [1.0], "1.0", True, object()])
def test_a_node_that_holds_no_number_is_trouble_and_no_end(value: object) -> None:
    """The bridge takes it for a PLC that is not ready, says so in one line, and tries again."""
    with pytest.raises(ua.UaError, match="must hold a number"):
        real(value)


async def test_a_plc_that_is_not_ready_is_asked_again(tmp_path: Path) -> None:
    said: list[str] = []
    async with Plc(free_port(), 0.0) as plc:
        await plc.offset.write_value(ua.DataValue(ua.Variant([1.0, 2.0], ua.VariantType.Float)))
        async with bridging(written(tmp_path, plc.endpoint, free_port()), said) as bridge:

            async def in_trouble() -> bool:
                return "must hold a number" in bridge.register.trouble

            await until(in_trouble, "the array is not noticed")
            await plc.put(0.0)

            async def is_ready() -> bool:
                return not bridge.register.trouble

            await until(is_ready, lambda: bridge.register.trouble)
    assert any("must hold a number" in line for line in said)
