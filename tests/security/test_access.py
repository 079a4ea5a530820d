"""Who may do what over TLS, asserted by what a genuine receiver sees and does not see."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import pytest
import zenoh

from compensator.cli import main
from compensator.service.publisher import Sender
from tests.security.shop import ALIVE, BOTH, EVIL, OFFSET, PREFIX, Plant, Shop, wait

COMMAND = f"{PREFIX}/thermal/command"


def tamper(session: Any, operator: str) -> list[Any]:
    """Everything somebody could try who has a link: publish, delete, answer, be alive, command in another's name.

    Returns the tokens: one that nobody holds is taken back.
    """
    for key in (OFFSET, f"{PREFIX}/**", "shop/*/thermal/y/offset", f"{PREFIX}/thermal/status"):
        session.put(key, EVIL)
        session.delete(key)

    def lie(query: Any) -> None:
        with query, contextlib.suppress(zenoh.ZError):  # a reply on a key that was not asked for
            query.reply(OFFSET, EVIL)

    for key, complete in ((OFFSET, False), (f"{PREFIX}/thermal/**", True), ("**", True)):
        session.declare_queryable(key, lie, complete=complete)
    alive = (ALIVE, f"{PREFIX}/thermal/alive/2", "shop/vmc-09/thermal/alive")
    tokens = [session.liveliness().declare_token(key) for key in alive]
    for name in ("hold", "zero"):
        for end in ("", "/anna", "/*", "/**", "/nobody"):
            list(session.get(f"{COMMAND}/{name}{end}", payload=b"{}", timeout=5.0))
    for key in (f"{COMMAND}/*/{operator}", f"shop/*/thermal/command/hold/{operator}", f"{COMMAND}/**"):
        list(session.get(key, payload=b"{}", timeout=5.0))
    return tokens


@pytest.mark.parametrize(
    ("stem", "mode"),
    [
        ("receiver-cnc-07", "client"),
        ("receiver-cnc-07", "router"),
        ("machine-vmc-08", "client"),
        ("machine-vmc-08", "peer"),
        ("operator-bert", "client"),
    ],
)
def test_what_others_try_reaches_nobody(plant: Plant, shop: Shop, stem: str, mode: str) -> None:
    plant.forget()
    with zenoh.open(shop.config(stem, mode)) as session:
        wait(lambda: session.info.transports(), "the link")
        tokens = tamper(session, stem.partition("-")[2])
        # What is sent over one link is handled in its order: where this is answered, all of the above has been.
        own = "shop/vmc-08/thermal/status" if "08" in stem or "bert" in stem else f"{PREFIX}/thermal/status"
        list(session.get(own, timeout=5.0))
        if stem == "machine-vmc-08":
            session.put("shop/vmc-08/thermal/event", b"mine")
            wait(lambda: any(key == "shop/vmc-08/thermal/event" for key, *_ in plant.seen), "its own machine's event")
        marker = plant.publish()
        wait(lambda: plant.receiver.poll().seq == json.loads(marker)["seq"], "the genuine offset at the control")
        wait(lambda: any(payload == marker for *_, payload in plant.seen), "the genuine offset on the screen")
        assert plant.latest() == [marker]
        assert plant.tokens() == BOTH
        del tokens
    assert {(key, kind) for key, kind, _ in plant.seen} - {("shop/vmc-08/thermal/event", "PUT")} == {(OFFSET, "PUT")}
    assert all(payload == marker for key, _, payload in plant.seen if key == OFFSET)
    assert plant.commands == []
    # Zenoh says a token again now and then while another client leaves; nobody else's, and never that one is gone.
    assert set(plant.alive) <= {(key, "PUT") for key in BOTH}
    assert plant.tokens() == BOTH  # its end takes nobody's token away either
    assert plant.receiver.poll().offset_um == pytest.approx(5.0, abs=0.5)


def test_the_same_succeeds_where_there_is_no_access_list(tmp_path: Path, keys: Path) -> None:
    """The trial above is worth something: without the list all of it gets through."""
    shop = Shop(tmp_path, keys)
    with shop.router(access_list=False), Plant(shop) as plant:
        plant.forget()
        with zenoh.open(shop.config("receiver-cnc-07")) as session:
            tokens = tamper(session, "cnc-07")
            wait(lambda: (OFFSET, "PUT", EVIL) in plant.seen, "the false offset")
            wait(lambda: any(kind == "DELETE" for _, kind, _ in plant.seen), "the delete")
            wait(lambda: "shop/vmc-09/thermal/alive" in plant.tokens(), "the false token")
            wait(lambda: EVIL in plant.latest(), "the false answer")
            wait(lambda: plant.commands, "the command")
            del tokens


@pytest.mark.parametrize("case", ["none", "plain", "other authority", "both of another authority", "expired"])
def test_who_cannot_prove_who_he_is_gets_no_link(plant: Plant, shop: Shop, case: str) -> None:
    config = shop.config("operator-old" if case == "expired" else "operator-anna")
    other = shop.keys.parent / "other"
    if case == "none":
        config.insert_json5("transport/link/tls/enable_mtls", "false")
    if case == "plain":
        config.insert_json5("transport/link/protocols", '["tcp"]')
        config.insert_json5("connect/endpoints", json.dumps([shop.endpoint.replace("tls/", "tcp/")]))
        # The router's end of TLS does not answer what it cannot read: the client waits for it.
        config.insert_json5("transport/unicast/open_timeout", "500")
    if "other" in case:
        config.insert_json5("transport/link/tls/connect_certificate", json.dumps(str(other / "operator-anna.pem")))
        config.insert_json5("transport/link/tls/connect_private_key", json.dumps(str(other / "operator-anna.key")))
    if case.startswith("both"):
        config.insert_json5("transport/link/tls/root_ca_certificate", json.dumps(str(other / "ca.pem")))
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        zenoh.open(config)


def test_a_receivers_certificate_cannot_pose_as_the_router(shop: Shop, tmp_path: Path) -> None:
    false = Shop(tmp_path, shop.keys)
    config = zenoh.Config.from_file(str(false.router_file))
    config.insert_json5("access_control", '{"enabled": false}')
    for key, name in (("certificate", "receiver-cnc-07.pem"), ("private_key", "receiver-cnc-07.key")):
        config.insert_json5(f"transport/link/tls/listen_{key}", json.dumps(str(shop.keys / name)))
    with zenoh.open(config), pytest.raises(zenoh.ZError, match="Unable to connect"):
        zenoh.open(false.config("receiver-cnc-07"))


def test_an_operator_commands_in_the_own_name_only(
    plant: Plant, shop: Shop, capsys: pytest.CaptureFixture[str]
) -> None:
    plant.forget()
    anna, bert = (str(shop.client_file(f"operator-{name}")) for name in ("anna", "bert"))
    assert main(["hold", "--prefix", PREFIX, "--zenoh", anna]) == 0
    assert main(["zero", "--prefix", PREFIX, "--zenoh", anna, "--mode", "warm", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"ok": True, "text": "heard"}
    by = Sender("anna", "certificate")
    assert plant.commands == [("hold", b"{}", by), ("zero", b'{"mode": "warm"}', by)]
    plant.forget()
    assert main(["hold", "--prefix", PREFIX, "--zenoh", bert, "--timeout", "2"]) == 1  # his is the other machine
    assert "cannot be reached" in capsys.readouterr().err  # it is not even told to be there
    receiver = str(shop.client_file("receiver-cnc-07"))
    assert main(["hold", "--prefix", PREFIX, "--zenoh", receiver, "--timeout", "2"]) == 1
    error = capsys.readouterr().err
    assert "is alive but has not answered within 2 s" in error and "access list permits cnc-07" in error
    assert main(["hold", "--prefix", PREFIX, "--zenoh", str(shop.client_file("operator-old"))]) == 2
    error = capsys.readouterr().err
    assert "certificate of 'old' has expired on" in error and error.count("\n") == 1
    assert plant.commands == []


def test_an_operator_cannot_use_anothers_name(plant: Plant, shop: Shop) -> None:
    hold = "shop/vmc-08/thermal/command/hold"
    with zenoh.open(shop.config("operator-bert")) as session:
        assert [list(session.get(f"{hold}/{name}", timeout=5.0)) for name in ("anna", "bert.x", "*")] == [[], [], []]
        assert len(list(session.get(f"{hold}/bert", timeout=5.0))) == 1
    assert plant.other_commands == [("hold", Sender("bert", "certificate"))]


def test_a_question_to_many_keys_is_no_command(plant: Plant, shop: Shop) -> None:
    """Whoever looks around must not zero, hold and resume: the list lets an operator ask this, the service does not."""
    plant.forget()
    with zenoh.open(shop.config("operator-anna")) as session:
        for key in (f"{COMMAND}/*/anna", "shop/*/thermal/command/hold/anna", f"{COMMAND}/*"):
            assert list(session.get(key, payload=b"{}", timeout=5.0)) == []
        assert plant.commands == []
        list(session.get(f"{COMMAND}/hold", payload=b"{}", timeout=5.0))
    assert plant.commands == [("hold", b"{}", Sender())]  # no name, no proof: the daemon refuses it in words


def test_the_adopt_command_without_an_operators_certificate_says_so(
    shop: Shop, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from tests.security.test_check import secured

    config = secured(tmp_path, shop.keys)
    assert main(["back", "--config", str(config)]) == 2
    error = capsys.readouterr().err
    assert "--zenoh" in error and error.count("\n") == 1
