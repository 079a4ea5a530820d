"""Whatever comes over a wire or as a command: a reading, a quality, an error or a refusal; and then it works again."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import random
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
import zenoh

from compensator.config import Zenoh
from compensator.messages import number
from compensator.service.compensation import Outcome
from compensator.service.publisher import COMMANDS, session_config
from drivers.errors import DriverError
from drivers.reading import Reading
from sim_hardware.wire import Rack
from sim_hardware.wire.faults import Layers
from sim_hardware.wire.outlet import Outlet
from tests.fuzz.mutation import PIECES, mutated
from tests.service.device_faults import make_world
from tests.service.simulated import Bench
from tests.service.wired import Receiver, WiredMachine, workshop

READS = 12
#: No read may take longer; twice the time limit is what drivers promise, the rest is for a busy machine.
DEADLINE_S = 20.0
LAYOUTS = ("apart", "dcon", "map")


class Mangled:
    """Every reply of every simulated device, changed at random, while it is on."""

    def __init__(self, seed: int) -> None:
        self.on = False
        self._random = random.Random(seed)

    def __call__(self, send: Any) -> Any:
        def mangled(outlet: Outlet, frame: bytes, layers: Layers) -> None:
            send(outlet, self.change(frame) if self.on else frame, layers)

        return mangled

    def change(self, frame: bytes) -> bytes:
        rng = self._random
        way = rng.randrange(6)
        if way == 0:
            return rng.randbytes(rng.randrange(1, 400))
        if way == 1:
            return frame * rng.randrange(2, 5)
        if way == 2:
            return rng.choice(PIECES)[:2000] + frame
        if way == 3:
            return frame[: rng.randrange(len(frame))] + rng.randbytes(3) + frame
        return mutated(rng.randrange(2**32), frame) or b"\x00"


@pytest.fixture
def mangled(monkeypatch: pytest.MonkeyPatch) -> Iterator[Mangled]:
    change = Mangled(11)
    monkeypatch.setattr(Outlet, "send", change(Outlet.send))
    yield change


@pytest.mark.parametrize("layout", LAYOUTS)
async def test_any_frame_gives_a_reading_or_an_error_and_the_device_comes_back(
    tmp_path: Path, mangled: Mangled, layout: str
) -> None:
    with Rack() as rack:
        machine = WiredMachine(rack, tmp_path, make_world(), layout=layout)

        async def read(name: str, reads: int) -> list[Any]:
            found: list[Any] = []
            for _ in range(reads):
                machine.capa.push(1)
                try:
                    async with asyncio.timeout(DEADLINE_S):
                        found.append(await machine.fleet.devices[name].read())
                except DriverError as error:
                    assert "\n" not in str(error) and error.code != "device_error"
                    found.append(error)
                    await asyncio.sleep(0.01)  # spaced out by the driver: else nothing is asked any more
            return found

        try:
            mangled.on = True
            found = [entry for name in machine.fleet.devices for entry in await read(name, READS)]
            readings = [r for entry in found if not isinstance(entry, DriverError) for r in entry.values()]
            assert all(isinstance(r, Reading) for r in readings)
            assert any(isinstance(entry, DriverError) for entry in found)
            mangled.on = False
            for name in machine.fleet.devices:
                async with asyncio.timeout(60.0):
                    while isinstance((await read(name, 1))[0], DriverError):
                        await asyncio.sleep(0.05)
        finally:
            await machine.fleet.close()


async def test_the_service_on_mangled_wires_never_fails_and_never_jumps(tmp_path: Path, mangled: Mangled) -> None:
    with workshop() as (rack, receiver):
        machine = WiredMachine(rack, tmp_path, make_world(), layout="dcon", receiver=receiver)

        def switch(outcome: Outcome) -> None:
            done = len(machine.outcomes)
            mangled.on = 40 <= done < 70
            if done >= 70:  # a device that did not answer in time is asked again seconds later, within the minute
                machine.waits_for = {"t_q_degc", "at_degc", "y_um"}

        machine.after = switch
        await machine.run(90)
    assert machine.events("error") == []
    offsets = [number(o.y_offset_um) for o in machine.offsets[20:]]
    assert all(abs(b - a) <= 8.0 + 1e-9 for a, b in itertools.pairwise(offsets))
    assert all(o.state in ("ok", "degraded") for o in machine.offsets[-3:]), machine.offsets[-50:]


def payloads(seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Commands of every name with what may come with them."""
    rng = random.Random(seed)
    good = (
        b"",
        b'{"mode": "rest"}',
        b'{"model": "[model]", "force": false}',
        b'{"sha256": "00ff", "force": true}',
        b'{"mode": {"mode": ["warm", 1e999, null]}}',
        b'{"model": 7, "sha256": [], "force": "yes"}',
    )
    for _ in range(count):
        data = rng.choice(good)
        yield rng.choice(COMMANDS), mutated(rng.randrange(2**32), data) if data and rng.random() < 0.8 else data


async def test_any_command_is_answered_in_words(bench: Bench) -> None:
    answers: list[Any] = []
    sent = payloads(3, 400)

    def send() -> None:
        for _ in range(20):
            command = next(sent, None)
            if command is not None:
                answers.append(bench.daemon.command(*command))
        bench.at_sample[len(bench.outcomes) + 1] = send

    bench.at_sample[1] = send
    await bench.run(30)
    for answer in answers:
        reply = answer.result(timeout=30.0) if isinstance(answer, Future) else answer
        assert isinstance(reply["ok"], bool) and reply["text"] and "\n" not in reply["text"], reply
        json.dumps(reply)
    assert len(answers) == 400 and {a["ok"] for a in answers if isinstance(a, dict)} == {True, False}
    events = [json.loads(data) for name, data in bench.published if name == "event"]
    assert not [e for e in events if e["kind"] == "error"]
    assert len(bench.outcomes) == 30


async def test_commands_over_zenoh_with_any_payload(tmp_path: Path) -> None:
    with Rack() as rack, Receiver() as receiver:
        machine = WiredMachine(rack, tmp_path, make_world(), receiver=receiver)
        replies: list[Any] = []

        def ask() -> None:
            settings = Zenoh(prefix="x", mode="client", connect=[receiver.endpoint])
            with zenoh.open(session_config(settings)) as session:
                for name, payload in payloads(7, 60):
                    key = f"shop/vmc-07/thermal/command/{name}"
                    for reply in session.get(key, payload=payload, timeout=30.0):
                        assert reply.ok is not None
                        replies.append(json.loads(reply.ok.payload.to_bytes()))

        asking: list[asyncio.Future[None]] = []
        stopped = asyncio.Event()

        async def watch() -> None:
            while not machine.outcomes:
                await asyncio.sleep(0.01)
            asking.append(asyncio.ensure_future(asyncio.to_thread(ask)))
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.wait(asking)
            machine.daemon.stop()
            stopped.set()

        watching = asyncio.create_task(watch())
        await machine.run(100_000)
        await watching
        await asking[0]
    assert len(replies) == 60 and all(isinstance(r["ok"], bool) and r["text"] for r in replies)
    assert machine.events("error") == []
