"""What a viewer gets over Foxglove's protocol."""

from __future__ import annotations

import json
import re
import socket
import struct
from pathlib import Path
from typing import Any

import pytest

from compensator.errors import ServiceError
from compensator.watch import foxglove, origin_gate
from compensator.watch.foxglove import FoxgloveServer, topic_of
from tests.watch.heard import START_NS, estimate, event, offset, sample
from tests.watch.slow import drip

pytest.importorskip("foxglove")
connect = pytest.importorskip("websockets.sync.client").connect
Refused = pytest.importorskip("websockets.exceptions").InvalidStatus


class Viewer:
    """A client of the protocol as a program apart from the project would write it."""

    def __init__(self, port: int) -> None:
        self._connect = connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], proxy=None)
        self.channels: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> Viewer:
        self._socket = self._connect.__enter__()
        return self

    def __exit__(self, *told: Any) -> None:
        self._connect.__exit__(*told)

    def until_advertised(self, *topics: str) -> None:
        while not set(topics) <= set(self.channels):
            told = self._socket.recv(timeout=30)
            if isinstance(told, str) and json.loads(told)["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in json.loads(told)["channels"]}

    def subscribe(self, topic: str) -> None:
        subscription = {"id": 1, "channelId": self.channels[topic]["id"]}
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))

    def message(self) -> tuple[int, bytes]:
        while True:
            told = self._socket.recv(timeout=30)
            if isinstance(told, bytes) and told[0] == 1:
                _, _, time_ns = struct.unpack_from("<BIQ", told)
                return time_ns, told[13:]


def test_a_viewer_gets_the_latest_at_once_and_then_all_that_follows() -> None:
    key = "shop/vmc-07/thermal/y/offset"
    with FoxgloveServer("shop/vmc-07", 0) as server:
        server.receive(key, offset(5))
        server.receive("shop/vmc-07/thermal/estimate", estimate(5))
        with Viewer(server.port) as viewer:
            viewer.until_advertised("/offset", "/estimate")
            channel = viewer.channels["/offset"]
            assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
            assert json.loads(channel["schema"])["properties"]["y_offset_um"]
            viewer.subscribe("/offset")
            assert viewer.message() == (START_NS, offset(5))
            server.receive(key, b"nonsense")
            server.receive(key, offset(5), asked=True)
            server.receive("shop/vmc-07/thermal/y/other", b"{}")
            server.receive(key, offset(6, START_NS + 1))
            assert viewer.message() == (START_NS + 1, offset(6, START_NS + 1))


def test_a_viewer_that_joins_gets_the_last_events() -> None:
    with FoxgloveServer("shop", 0) as server:
        for i in range(30):
            server.receive("shop/vmc-07/thermal/event", event(i, START_NS + i))
        with Viewer(server.port) as viewer:
            viewer.until_advertised("/vmc-07/event")
            viewer.subscribe("/vmc-07/event")
            assert [viewer.message()[0] for _ in range(20)] == [START_NS + i for i in range(10, 30)]


def test_machines_beyond_the_bound_have_no_channels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foxglove, "MACHINES", 2)
    with FoxgloveServer("shop", 0) as server:
        for kind, payload in (("y/offset", offset(5)), ("event", event(5))):
            for i in range(4):
                server.receive(f"shop/n{i}/thermal/{kind}", payload)
        assert set(server._channels) == set(server._latest) == {"/n0/offset", "/n1/offset", "/n0/event", "/n1/event"}


def test_topics() -> None:
    assert topic_of("shop/vmc-07/thermal/status", "") == ("/shop/vmc-07/status", "status")
    assert topic_of("shop/vmc-07/thermal/alive", "shop") is None


def test_a_port_that_is_taken_is_said_in_one_line() -> None:
    with FoxgloveServer("shop", 0) as server, pytest.raises(ServiceError, match=f"--foxglove-port {server.port}"):
        FoxgloveServer("shop", server.port).__enter__()


def test_every_path_of_the_layout_is_a_field_of_a_message() -> None:
    layout = json.loads((Path(__file__).parents[2] / "deploy/foxglove/machine.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    paths += [panel["topicPath"] for panel in panels.values() if "topicPath" in panel]
    assert len(paths) >= 10
    messages = {
        "offset": offset(1),
        "sample": sample(1),
        "estimate": estimate(1, effects=(1.0, 2.0)),
        "event": event(1),
    }
    for path in paths:
        topic, *fields = re.findall(r"[a-z_]+|\[\d+\]", path)
        value = json.loads(messages[topic])
        for field in fields:
            value = value[int(field[1:-1])] if field.startswith("[") else value[field]
        assert value is not None, path

    def named(part: Any) -> set[str]:
        return {part} if isinstance(part, str) else named(part["first"]) | named(part["second"])

    assert named(layout["layout"]) == set(panels)


@pytest.mark.parametrize(
    "origin", ["https://elsewhere.example", "null", "http://127.0.0.1:8765", "https://app.foxglove.dev.evil.example"]
)
def test_a_page_of_another_site_cannot_connect(origin: str) -> None:
    with FoxgloveServer("shop", 0) as server, pytest.raises(Refused, match="403"):
        connect(f"ws://127.0.0.1:{server.port}", subprotocols=["foxglove.sdk.v1"], proxy=None, origin=origin)


def test_the_viewer_and_a_viewer_of_ones_own_can() -> None:
    own = "https://viewer.factory.example"
    with FoxgloveServer("shop", 0, [own]) as server:
        for origin in (None, "https://app.foxglove.dev", "file://", own):
            address = f"ws://127.0.0.1:{server.port}"
            with connect(address, subprotocols=["foxglove.sdk.v1"], proxy=None, origin=origin) as viewer:
                assert json.loads(viewer.recv(timeout=30))["op"] == "serverInfo"


def test_who_sends_byte_after_byte_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(origin_gate, "REQUEST_S", 0.3)
    with FoxgloveServer("shop", 0) as server, socket.create_connection(("127.0.0.1", server.port)) as slow:
        drip(slow, 0.3)


def test_what_is_no_request_does_not_keep_others_out() -> None:
    with FoxgloveServer("shop", 0) as server:
        address = ("127.0.0.1", server.port)
        with socket.create_connection(address) as silent, socket.create_connection(address) as endless:
            silent.sendall(b"GET")
            endless.sendall(b"x" * 40_000)
            with Viewer(server.port) as viewer:
                server.receive("shop/vmc-07/thermal/y/offset", offset(5))
                viewer.until_advertised("/vmc-07/offset")
