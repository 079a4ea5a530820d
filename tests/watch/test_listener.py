"""The listener on a real router: hears everything, asks for the latest, and never sends anything else."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from compensator.clock import SystemClock
from compensator.config import Zenoh
from compensator.errors import ServiceError, UsageError
from compensator.service.publisher import COMMANDS, Publisher, Sender
from compensator.service.session import session_config
from compensator.watch.listener import Listener, of_endpoints, of_settings
from compensator.watch.shop import Shop
from tests.ports import free_port
from tests.watch.heard import event, offset, sample, status


@contextmanager
def router(port: int) -> Iterator[None]:
    with zenoh.open(session_config(Zenoh(prefix="router", mode="router", listen=[f"tcp/127.0.0.1:{port}"]))):
        yield


class Waiting:
    """A sink that tells when something has arrived."""

    def __init__(self) -> None:
        self.shop = Shop(SystemClock())
        self.keys: list[tuple[str, bool]] = []
        self._changed = threading.Condition()

    def receive(self, key: str, payload: bytes, *, asked: bool = False) -> None:
        with self._changed:
            self.shop.receive(key, payload, asked=asked)
            self.keys.append((key, asked))
            self._changed.notify_all()

    def set_alive(self, key: str, alive: bool) -> None:
        with self._changed:
            self.shop.set_alive(key, alive)
            self._changed.notify_all()

    def connection(self, connected: bool) -> None:
        with self._changed:
            self._changed.notify_all()

    def until(self, done: Callable[[], Any], again: Callable[[], None] | None = None) -> None:
        """Wait; a subscription takes a moment to reach a publisher, so what is sent meanwhile is sent again."""
        for _ in range(300):
            if again is not None:
                again()
            with self._changed:
                if self._changed.wait_for(done, timeout=0.2):
                    return
        raise AssertionError(f"waited for nothing; heard {self.states()}")

    def states(self) -> dict[str, tuple[str, bool | None]]:
        return {one["prefix"]: (one["shown"], one["alive"]) for one in self.shop.overview()}


@pytest.fixture
def services() -> Iterator[tuple[int, list[Publisher], list[str]]]:
    """Two services of a shop on a router; what they are told to do."""
    port, commands = free_port(), []

    def command(name: str, payload: bytes, sender: Sender) -> dict[str, Any]:
        commands.append(name)
        return {"ok": True, "text": ""}

    with router(port):
        publishers = [
            Publisher(Zenoh(prefix=f"shop/{name}", mode="peer", connect=[f"tcp/127.0.0.1:{port}"]), command)
            for name in ("vmc-07", "vmc-08")
        ]
        with publishers[0], publishers[1]:
            for publisher in publishers:
                name = publisher.key("status").split("/")[1]
                now_ns = SystemClock().utc_ns()
                publisher.publish("offset", offset(5, now_ns, machine=name))
                publisher.publish("status", status(5, now_ns, machine=name))
            # A service of another make that takes whatever reaches it for a command.
            settings = Zenoh(prefix="shop", mode="client", connect=[f"tcp/127.0.0.1:{port}"])
            with zenoh.open(session_config(settings)) as session:
                for name in COMMANDS:
                    for key in (f"shop/vmc-07/thermal/command/{name}", f"shop/vmc-07/thermal/command/{name}/*"):
                        session.declare_queryable(key, lambda query: commands.append(str(query.key_expr)))
                yield port, publishers, commands


def test_one_look_knows_every_machine_and_commands_none(services: tuple[int, list[Publisher], list[str]]) -> None:
    port, _, commands = services
    for prefix in ("shop", "", "shop/vmc-08"):
        waiting = Waiting()
        with Listener(of_endpoints(prefix, [f"tcp/127.0.0.1:{port}"]), waiting) as listener:
            listener.open()
            expected = {"shop/vmc-07": ("ok", True), "shop/vmc-08": ("ok", True)}
            if prefix == "shop/vmc-08":
                del expected["shop/vmc-07"]
            waiting.until(lambda: waiting.states() == expected, again=listener.query)  # noqa: B023
        assert all(asked for _, asked in waiting.keys)
    assert commands == []


def test_what_is_published_is_heard_and_an_end_is_told(services: tuple[int, list[Publisher], list[str]]) -> None:
    port, publishers, commands = services
    waiting = Waiting()
    with Listener(of_endpoints("shop", [f"tcp/127.0.0.1:{port}"]), waiting) as listener:
        listener.start()
        waiting.until(lambda: waiting.states() == dict.fromkeys(("shop/vmc-07", "shop/vmc-08"), ("ok", True)))
        numbers = itertools.count(6)

        def publish() -> None:
            number, now_ns = next(numbers), SystemClock().utc_ns()
            publishers[0].publish("offset", offset(number, now_ns))
            publishers[0].publish("sample", sample(number, now_ns))
            publishers[0].publish("event", event(number, now_ns))

        waiting.until(lambda: waiting.shop.one("shop/vmc-07")["events"], again=publish)  # type: ignore[index]
        machine = waiting.shop.one("shop/vmc-07")
        assert machine is not None and machine["seq"] >= 6 and machine["t_q_degc"] == 31.5
        publishers[1].close()
        waiting.until(lambda: waiting.states()["shop/vmc-08"] == ("ok", False))
    assert commands == []


def test_a_router_that_comes_late_or_comes_back_is_found() -> None:
    port = free_port()
    waiting, told = Waiting(), []

    def connection(connected: bool) -> None:
        told.append(connected)
        waiting.connection(connected)

    with Listener(of_endpoints("", [f"tcp/127.0.0.1:{port}"]), waiting, on_connection=connection) as listener:
        listener.start()
        with router(port):
            waiting.until(lambda: told[-1:] == [True])
        waiting.until(lambda: told[-1:] == [False])
        with router(port):
            waiting.until(lambda: told[-1:] == [True])
            settings = Zenoh(prefix="shop/vmc-07", mode="client", connect=[f"tcp/127.0.0.1:{port}"])
            with Publisher(settings, lambda name, payload, sender: {"ok": True}) as publisher:
                waiting.until(lambda: waiting.states().get("shop/vmc-07", ("", None))[1])
                numbers = itertools.count(5)

                def publish() -> None:
                    publisher.publish("offset", offset(next(numbers), SystemClock().utc_ns()))

                waiting.until(lambda: waiting.states()["shop/vmc-07"] == ("ok", True), again=publish)


def test_nobody_there_is_one_line() -> None:
    listener = Listener(of_endpoints("shop", [f"tcp/127.0.0.1:{free_port()}"]))
    with pytest.raises(ServiceError, match="no answer at tcp/127"):
        listener.open()
    with pytest.raises(UsageError, match="expected an endpoint such as"):
        of_endpoints("shop", ["127.0.0.1:7447"])


def test_a_service_is_reached_where_its_configuration_says() -> None:
    settings = Zenoh(prefix="a", listen=["tcp/0.0.0.0:7447", "tcp/127.0.0.1:0"], connect=["tcp/10.0.0.1:7447"])
    assert of_settings(settings).where == "tcp/10.0.0.1:7447, tcp/127.0.0.1:7447"


def test_the_machines_own_certificate_is_not_what_a_reader_uses() -> None:
    settings = Zenoh(prefix="a", connect=["tls/127.0.0.1:7447"], tls_ca="a", tls_certificate="b", tls_key="c")
    with pytest.raises(UsageError, match="--zenoh: missing"):
        of_settings(settings)
    with pytest.raises(UsageError, match="expected an endpoint"):
        of_settings(Zenoh(prefix="a"))
