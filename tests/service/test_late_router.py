"""A machine's PC is up before the shop's router: the service works, and is heard as soon as the router is there."""

from __future__ import annotations

import json
import logging
import threading

import pytest
import zenoh

from compensator.config import Zenoh
from compensator.service import presence
from compensator.service import publisher as publisher_module
from compensator.service.publisher import Publisher
from compensator.service.session import session_config
from tests.ports import free_port
from tests.receiver.wire import router

LONG_S = 60.0


def test_a_client_waits_for_its_router_in_the_background(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(publisher_module, "RETRY_S", 0.05)
    port = free_port()
    settings = Zenoh(prefix="shop/vmc-07", mode="client", connect=[f"tcp/127.0.0.1:{port}"])
    with caplog.at_level(logging.WARNING), Publisher(settings, lambda *_: {"ok": True, "text": "held"}) as service:
        service.publish("offset", b'{"seq": 1}')
        with router(port), zenoh.open(session_config(settings)) as session:
            heard = threading.Event()
            seen: list[int] = []

            def hear(sample: zenoh.Sample) -> None:
                seen.append(json.loads(sample.payload.to_bytes())["seq"])
                heard.set()

            subscriber = session.declare_subscriber("shop/vmc-07/thermal/y/offset", hear)
            for seq in range(2, 3000):
                service.publish("offset", json.dumps({"seq": seq}).encode())
                if heard.wait(0.05):
                    break
            assert seen and seen[0] > 1  # what was published before anybody could hear it does not come out as new
            (latest,) = [
                json.loads(r.ok.payload.to_bytes()) for r in session.get("shop/vmc-07/thermal/y/offset") if r.ok
            ]
            assert latest["seq"] >= seen[0]
            answers = [r.ok for r in session.get("shop/vmc-07/thermal/command/hold", timeout=LONG_S)]
            assert len(answers) == 1
            assert list(session.liveliness().get("shop/vmc-07/thermal/alive", timeout=LONG_S))
            subscriber.undeclare()
    told = [record for record in caplog.records if "Unable to connect" in record.getMessage()]
    assert len(told) == 1  # once, not once a try
    assert "zenoh-router" not in [thread.name for thread in threading.enumerate()]


def test_the_service_ends_at_once_while_it_waits() -> None:
    settings = Zenoh(prefix="shop/vmc-07", mode="client", connect=[f"tcp/127.0.0.1:{free_port()}"])
    with Publisher(settings, lambda *_: {}) as service:
        service.publish("offset", b"{}")
    service.close()


def test_a_client_that_leaves_is_no_lost_link(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    settings = Zenoh(prefix="shop/vmc-07", mode="peer", listen=[f"tcp/127.0.0.1:{port}"])
    client = Zenoh(prefix="shop/vmc-07", mode="client", connect=[f"tcp/127.0.0.1:{port}"])
    with caplog.at_level(logging.INFO), Publisher(settings, lambda *_: {}):
        with zenoh.open(session_config(client)) as session:
            number = str(session.zid())
        for _ in range(600):
            if f"client {number} is disconnected" in caplog.text:
                break
            threading.Event().wait(0.05)
    assert f"client {number} is disconnected" in caplog.text and "retrying" not in caplog.text


def test_a_router_that_is_asked_by_a_whole_shop_at_once_is_asked_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    real, refused = zenoh.open, []

    def opened(config: zenoh.Config) -> zenoh.Session:
        if not refused:
            refused.append(config)
            raise zenoh.ZError("the router lets too many in")
        return real(config)

    monkeypatch.setattr(presence.zenoh, "open", opened)
    monkeypatch.setattr(presence, "REACHED_S", LONG_S / 20)
    port = free_port()
    settings = Zenoh(prefix="shop/vmc-07", mode="peer", connect=[f"tcp/127.0.0.1:{port}"])
    with router(port), caplog.at_level(logging.WARNING), presence.sole_publisher(settings):
        assert refused
    assert "others_unknown" not in caplog.text
