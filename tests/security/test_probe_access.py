"""A certificate that may probe, and nothing else."""

from __future__ import annotations

import json
from typing import Any

import pytest
import zenoh

from compensator.cli import main
from compensator.commands.probes import CommandSink
from compensator.probes.probe import NotSent, Probe, Reply
from compensator.probes.settings import Service
from compensator.service.probing.received import read_probe
from compensator.service.publisher import Sender
from tests.security.shop import BOTH, OFFSET, PREFIX, Plant, Shop, wait
from tests.security.test_access import COMMAND, tamper

PROBE = Probe(time_utc_ns=1, measured_um=3.2, offset_applied_um=-12.3, feature="sphere-1")
STEM = "probe-probe-07"


def sink(shop: Shop, prefix: str = PREFIX, stem: str = STEM) -> CommandSink:
    config = str(shop.client_file(stem))
    return CommandSink(Service(prefix=prefix, send_within_s=900.0, zenoh_config=config, timeout_s=3.0), "probes.toml")


def test_it_sends_probes_in_its_own_name(plant: Plant, shop: Shop) -> None:
    plant.forget()
    assert sink(shop).send(PROBE) == Reply(True, "heard")
    ((name, payload, sender),) = plant.commands
    assert (name, sender) == ("probe", Sender("probe-07", "certificate"))
    assert read_probe(payload).feature == "sphere-1"  # what the service makes of it
    assert json.loads(payload) == {
        "schema": 1,
        "time_utc_ns": 1,
        "axis": "y",
        "measured_um": 3.2,
        "offset_applied_um": -12.3,
        "feature": "sphere-1",
    }


def test_not_at_another_machine(plant: Plant, shop: Shop) -> None:
    with pytest.raises(NotSent, match="cannot be reached"):
        sink(shop, "shop/vmc-08").send(PROBE)
    assert plant.other_commands == []


def test_a_receivers_certificate_sends_none(plant: Plant, shop: Shop) -> None:
    plant.forget()
    with pytest.raises(NotSent, match="access list"):
        sink(shop, stem="receiver-cnc-07").send(PROBE)
    assert plant.commands == []


def answered(session: Any) -> bool:
    """Send a probe. What is sent over one link is handled in its order: all that came before has been handled."""
    answers = session.get(f"{COMMAND}/probe/probe-07", payload=b"{}", timeout=5.0)
    return any(answer.ok is not None and b"heard" in answer.ok.payload.to_bytes() for answer in answers)


def test_it_reads_nothing(plant: Plant, shop: Shop) -> None:
    plant.forget()
    seen: list[Any] = []
    keys = (OFFSET, *(f"{PREFIX}/thermal/{name}" for name in ("status", "command/probe", "command/probe/anna")))
    with zenoh.open(shop.config(STEM)) as session:
        session.declare_subscriber("**", seen.append)
        session.declare_subscriber(OFFSET, seen.append)
        session.liveliness().declare_subscriber("**", seen.append, history=True)
        for key in (*keys, f"{COMMAND}/probe/*", f"{COMMAND}/*/probe-07"):
            assert list(session.get(key, payload=b"{}", timeout=5.0)) == []
        assert list(session.liveliness().get("**", timeout=5.0)) == []
        marker = plant.publish()
        wait(lambda: any(payload == marker for *_, payload in plant.seen), "the genuine offset on the screen")
        assert answered(session)
    assert seen == [] and [name for name, *_ in plant.commands] == ["probe"]


def test_it_does_nothing_else(plant: Plant, shop: Shop, capsys: pytest.CaptureFixture[str]) -> None:
    plant.forget()
    with zenoh.open(shop.config(STEM)) as session:
        tokens = tamper(session, "probe-07")
        assert answered(session)
        marker = plant.publish()
        wait(lambda: any(payload == marker for *_, payload in plant.seen), "the genuine offset on the screen")
        assert plant.latest() == [marker] and plant.tokens() == BOTH
        del tokens
    assert plant.commands == [("probe", b"{}", Sender("probe-07", "certificate"))] and plant.other_commands == []
    assert {(key, kind) for key, kind, _ in plant.seen} == {(OFFSET, "PUT")}
    assert main(["hold", "--prefix", PREFIX, "--zenoh", str(shop.client_file(STEM)), "--timeout", "2"]) == 1
    assert "cannot be reached" in capsys.readouterr().err
