"""`compensator router` as its users call it, and the shipped files."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tomllib
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from compensator.certificates import check_files
from compensator.cli import main
from compensator.commands.router import _LinkLog, checked
from compensator.config import Zenoh
from compensator.service.command_client import operator_of_file
from compensator.service.publisher import Publisher
from compensator.service.session import alive_services, client_config, get, read_config_file, tls_files
from tests.ports import free_port
from tests.security.shop import DEPLOY, Shop, script


def test_the_router_serves_says_who_comes_and_ends_on_sigterm(shop: Shop, tmp_path: Path) -> None:
    own = Shop(tmp_path, shop.keys)
    process = subprocess.Popen(
        [sys.executable, "-m", "compensator", "router", "--config", str(own.router_file)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stderr is not None and process.stdout is not None
        assert own.endpoint in process.stderr.readline()
        with zenoh.open(own.config("receiver-cnc-07")):
            line = process.stderr.readline()
            assert "cnc-07" in line and line.endswith(" connected\n")
        assert process.stderr.readline().endswith(" disconnected\n")
        refused = own.config("operator-old")
        with pytest.raises(zenoh.ZError):
            zenoh.open(refused)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=30) == 0
        # Whoever is refused leaves nothing behind in the log.
        assert process.stderr.read() == "compensator: router stopped\n" and process.stdout.read() == ""
    finally:
        process.kill()
        process.wait()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def test_a_link_that_is_told_twice_is_one_line(caplog: pytest.LogCaptureFixture) -> None:
    """Zenoh tells of a link as an event and as history, if it comes while the router begins to listen to events."""
    caplog.set_level("INFO", logger="compensator")
    tell = _LinkLog()
    for kind in (zenoh.SampleKind.PUT, zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE, zenoh.SampleKind.DELETE):
        tell(SimpleNamespace(kind=kind, link=SimpleNamespace(auth_identifier="cnc-07", dst="tls/a:1", zid="ee")))
    assert [message.split()[-1] for message in caplog.messages] == ["connected", "disconnected"]


def changed(shop: Shop, tmp_path: Path, change: Any) -> Path:
    text = "".join(line for line in shop.router_file.read_text().splitlines(True) if not line.startswith("//"))
    table = json.loads(text)
    change(table)
    path = tmp_path / "router.json5"
    path.write_text(json.dumps(table), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t: t.update(lissten={}), "lissten"),
        (lambda t: t["access_control"].update(enabled=False), "access_control/enabled"),
        (lambda t: t["access_control"].pop("enabled"), "access_control/enabled"),
        (lambda t: t["access_control"].update(default_permission="allow"), "default_permission"),
        (lambda t: t["transport"]["link"]["tls"].update(enable_mtls=False), "enable_mtls"),
        (lambda t: t["listen"]["endpoints"].append("tcp/0.0.0.0:7447"), "tcp/0.0.0.0:7447"),
        (lambda t: t["listen"].update(endpoints=[]), "listen/endpoints"),
        (lambda t: t.update(plugins={"rest": {"http_port": 8000}}), "plugins"),
        (lambda t: t.update(mode="client"), "expected router"),
        (lambda t: t["transport"]["link"]["tls"].update(listen_private_key="nowhere.key"), "nowhere.key"),
    ],
)
def test_what_would_not_do_what_it_looks_like_is_refused(
    shop: Shop, tmp_path: Path, change: Any, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = changed(shop, tmp_path, change)
    assert main(["router", "--config", str(path), "--check"]) == 2
    error = capsys.readouterr().err
    assert expected in error and "router.json5" in error and error.count("\n") == 1 and ".rs:" not in error


def test_a_rule_that_names_nothing_ends_the_router_in_one_line(
    shop: Shop, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(table: dict[str, Any]) -> None:
        table["access_control"]["policies"][0]["rules"] = ["nonsense"]

    assert main(["router", "--config", str(changed(shop, tmp_path, change))]) == 1
    error = capsys.readouterr().err
    assert "nonsense" in error and error.count("\n") == 1


def test_a_good_file_is_said_to_be_good(shop: Shop, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["router", "--config", str(shop.router_file), "--check", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["access_control"] is True
    config = checked(shop.router_file, read_config_file(shop.router_file))
    for name in ("multicast", "gossip"):
        assert json.loads(config.get_json(f"scouting/{name}/enabled")) is False


def test_the_shipped_router_is_made_of_the_shipped_list() -> None:
    shipped = (DEPLOY / "router.json5").read_text(encoding="utf-8")
    assert shipped == script("access_list.py", str(DEPLOY / "shop.toml"))


def test_the_shipped_list_shows_every_role(tmp_path: Path) -> None:
    """One that no machine needs from the start is commented out."""
    text = (DEPLOY / "shop.toml").read_text(encoding="utf-8")
    text = re.sub(r"^# (?=\[\[|\w+ = )", "", text, flags=re.MULTILINE)
    (tmp_path / "shop.toml").write_text(text, encoding="utf-8")
    made = script("access_list.py", str(tmp_path / "shop.toml"))
    for name in ("vmc-07 publishes", "cnc-07 reads", "anna commands", "probe-07 probes", "tool-07 publishes"):
        assert f'"{name}"' in made


def test_a_list_may_begin_with_the_mark_of_an_editor(tmp_path: Path) -> None:
    (tmp_path / "shop.toml").write_bytes(b"\xef\xbb\xbf" + (DEPLOY / "shop.toml").read_bytes())
    assert script("access_list.py", str(tmp_path / "shop.toml")) == script("access_list.py", str(DEPLOY / "shop.toml"))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('name = "cnc-07"', 'name = "anna"', "each name once"),
        ('prefix = "shop/vmc-07"', 'prefix = "shop/**"', "prefix"),
        ('name = "anna"', 'name = "*"', "name '*'"),
        ('machines = ["vmc-07"]', 'machines = ["vmc-70"]', "vmc-70"),
        ('listen = ["tls/', 'listen = ["tcp/', "tls/HOST:PORT"),
        ("[[operator]]", "[[operater]]", "operater"),
        ('name = "anna"', "name = 5", "name = 5, expected a text"),
        ('machines = ["vmc-07"]', "machines = [7]", "expected texts"),
        ('machines = ["vmc-07"]', "machines = []", "expected at least one"),
        ('listen = ["tls/0.0.0.0:7447"]', "listen = []", "router: listen = [], expected at least one"),
        *(
            (
                "[[operator]]",
                f'[[machine]]\nname = "b"\nprefix = "shop/vmc-07{below}"\n[[operator]]',
                "another is below it",
            )
            for below in ("/thermal", "/thermal/b", "")
        ),
        ("[[operator]]", "[operator]", "expected tables [[operator]]"),
        ("[[operator]]", ".".join("a" * 400) + " = 1\n[[operator]]", "more than 300 points"),
    ],
)
def test_a_list_that_gives_other_rights_than_meant_is_refused(
    tmp_path: Path, old: str, new: str, expected: str
) -> None:
    text = (DEPLOY / "shop.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "shop.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    assert expected in script("access_list.py", str(path), code=1)


def test_machines_may_be_below_one_another_where_their_messages_are_apart(tmp_path: Path) -> None:
    more = '[[machine]]\nname = "b"\nprefix = "shop/vmc-07/thermal-b"\n[[machine]]\nname = "c"\nprefix = "shop"\n'
    path = tmp_path / "shop.toml"
    path.write_text((DEPLOY / "shop.toml").read_text(encoding="utf-8") + more, encoding="utf-8")
    assert "shop/vmc-07/thermal-b/thermal/**" in script("access_list.py", str(path))


def test_what_has_no_end_is_neither_a_list_nor_a_certificate(tmp_path: Path, shop: Shop) -> None:
    assert script("access_list.py", "/dev/zero", code=1) == "/dev/zero: not a regular file\n"
    own = Shop(tmp_path, shop.keys)
    keys = shutil.copytree(own.keys, tmp_path / "copied")
    certificate = keys / "machine-vmc-07.pem"
    for make, expected in (
        (lambda: os.mkfifo(certificate), "not a regular file"),
        (lambda: certificate.write_bytes(bytes(200_000)), "larger than 100000 bytes"),
        (lambda: certificate.write_text("no certificate"), "expected a certificate in PEM"),
    ):
        certificate.unlink()
        make()
        assert expected in script("certificates.py", str(keys), "--machine", "vmc-07", code=1)


def test_the_trial_on_one_computer_works_as_written(tmp_path: Path) -> None:
    text = (DEPLOY / "README.md").read_text(encoding="utf-8").partition("<!-- trial -->")[2].split("```")[1]
    assert text.count("\ncompensator ") == 1
    shell = text.replace("/path/to/deploy/zenoh", str(DEPLOY)).replace("python ", f"{sys.executable} ")
    shell = shell.replace("\ncompensator ", f"\n{sys.executable} -m compensator ")
    done = subprocess.run(
        ["sh", "-euc", shell],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
        env={**os.environ, "PYTHONPATH": str(DEPLOY.parents[1])},
    )
    assert done.returncode == 0, done.stderr
    assert "Listens on tls/127.0.0.1:7448, access list on." in done.stdout
    for name in ("receiver", "operator", "probe"):
        operator_of_file(tmp_path / f"{name}.json5")  # files are where the configuration says
    files = tls_files(Zenoh(**_zenoh(tmp_path / "service.toml")))
    assert files is not None and check_files("service.toml", files) is not None


def _zenoh(path: Path) -> dict[str, Any]:
    table = tomllib.loads(path.read_text(encoding="utf-8"))["zenoh"]
    return {key: str(path.parent / value) if key.startswith("tls_") else value for key, value in table.items()}


def test_a_receiver_reaches_a_service_beside_silent_connections() -> None:
    port = free_port()
    settings = Zenoh(prefix="shop/vmc-07", mode="peer", listen=[f"tcp/127.0.0.1:{port}"])
    with Publisher(settings, lambda *_: {"ok": True, "text": ""}), ExitStack() as silent:
        for _ in range(200):
            silent.enter_context(socket.create_connection(("127.0.0.1", port)))
        with zenoh.open(client_config(settings, settings.listen)) as session:
            assert alive_services(session, 2.0) == ["shop/vmc-07"]


def test_a_router_bears_silent_connections_also_with_a_file_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "router.json5"
    for unicast, pending, timeout_ms in (
        ("{}", 4000, 3000),
        ("{accept_pending: 100, accept_timeout: 10000}", 4000, 3000),
        ("{accept_pending: 6000, accept_timeout: 1000}", 6000, 1000),
    ):
        path.write_text(
            f"{{mode: 'router', listen: {{endpoints: ['tcp/127.0.0.1:1']}}, transport: {{unicast: {unicast}}}}}"
        )
        config = checked(path, read_config_file(path))
        assert get(config, "transport/unicast/accept_pending") == pending
        assert get(config, "transport/unicast/accept_timeout") == timeout_ms
