"""A shop over real TLS on loopback: keys and access list by the shipped scripts, the router by the product's check."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh

from compensator.commands.router import checked
from compensator.config import Zenoh
from compensator.receiver import Receiver
from compensator.receiver.settings import Settings
from compensator.service.publisher import Publisher, Sender
from compensator.service.session import read_config_file
from tests.ports import free_port
from tests.receiver.offsets import offset

DEPLOY = Path(__file__).parents[2] / "deploy" / "zenoh"
PREFIX = "shop/vmc-07"
OFFSET = f"{PREFIX}/thermal/y/offset"
ALIVE = f"{PREFIX}/thermal/alive"
BOTH = {ALIVE, "shop/vmc-08/thermal/alive"}
#: A receiver that believed this would scrap the part.
EVIL = offset(900_000, 150.0)
SHOP = """
[router]
listen = ["tls/127.0.0.1:{port}"]
ca = "{keys}/ca.pem"
certificate = "{keys}/router.pem"
key = "{keys}/router.key"
[[machine]]
name = "vmc-07"
prefix = "shop/vmc-07"
[[machine]]
name = "vmc-08"
prefix = "shop/vmc-08"
[[receiver]]
name = "cnc-07"
machines = ["vmc-07"]
[[receiver]]
name = "watch"
[[operator]]
name = "anna"
[[operator]]
name = "bert"
machines = ["vmc-08"]
[[operator]]
name = "old"
[[probe]]
name = "probe-07"
machines = ["vmc-07"]
[[tool]]
name = "tool-07"
machines = ["vmc-07"]
"""


def wait(done: Callable[[], Any], what: str, timeout_s: float = 30.0) -> Any:
    """Wait for an event; generous, because nothing is measured here."""
    end = time.monotonic() + timeout_s
    while not (found := done()):
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.005)
    return found


def script(name: str, *arguments: str, code: int = 0) -> str:
    """Call a shipped script as an engineer would; return what it says."""
    command = [sys.executable, str(DEPLOY / name), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


def make_keys(folder: Path) -> Path:
    keys = folder / "keys"
    script(
        "certificates.py",
        str(keys),
        "--router",
        "127.0.0.1",
        "--machine",
        "vmc-07",
        "--machine",
        "vmc-08",
        "--receiver",
        "cnc-07",
        "--receiver",
        "watch",
        "--operator",
        "anna",
        "--operator",
        "bert",
        "--probe",
        "probe-07",
        "--tool",
        "tool-07",
    )
    script("certificates.py", str(keys), "--operator", "old", "--days", "-2")
    script("certificates.py", str(folder / "other"), "--operator", "anna", "--receiver", "cnc-07")
    return keys


class Shop:
    """Keys and files of a shop.

    Parameters
    ----------
    folder : Path
        Where keys lie and files are written.
    """

    def __init__(self, folder: Path, keys: Path) -> None:
        self.keys = keys
        self.folder = folder
        self.port = free_port()
        self.endpoint = f"tls/127.0.0.1:{self.port}"
        shop = folder / "shop.toml"
        shop.write_text(SHOP.format(port=self.port, keys=keys), encoding="utf-8")
        self.router_file = folder / "router.json5"
        self.router_file.write_text(script("access_list.py", str(shop)), encoding="utf-8")

    @contextmanager
    def router(self, *, access_list: bool = True) -> Iterator[None]:
        config = checked(self.router_file, read_config_file(self.router_file))
        if not access_list:
            config.insert_json5("access_control", '{"enabled": false}')
        with zenoh.open(config):
            yield

    def client_file(self, stem: str) -> Path:
        """The shipped client configuration, with this shop's addresses and keys in the place of the example's."""
        role, *_ = stem.partition("-")
        shipped = f"{role}.json5" if role in ("receiver", "probe") else "operator.json5"
        text = (DEPLOY / shipped).read_text(encoding="utf-8")
        for old, new in (
            ("router.shop:7447", f"127.0.0.1:{self.port}"),
            ("/etc/compensator/zenoh", str(self.keys)),
            ("receiver-cnc-07", stem),
            ("operator-anna", stem),
            ("probe-probe-07", stem),
        ):
            assert old in text or old in ("receiver-cnc-07", "operator-anna", "probe-probe-07")
            text = text.replace(old, new)
        path = self.folder / f"{stem}.json5"
        path.write_text(text, encoding="utf-8")
        return path

    def config(self, stem: str, mode: str = "client") -> Any:
        config = zenoh.Config.from_file(str(self.client_file(stem)))
        config.insert_json5("mode", json.dumps(mode))
        config.insert_json5("listen/endpoints", "[]")
        config.insert_json5("connect/timeout_ms", "0" if mode == "client" else "20000")
        config.insert_json5("connect/exit_on_failure", "true")
        return config

    def settings(self, machine: str = "vmc-07") -> Zenoh:
        stem = self.keys / f"machine-{machine}"
        return Zenoh(
            prefix=f"shop/{machine}",
            connect=[self.endpoint],
            tls_ca=str(self.keys / "ca.pem"),
            tls_certificate=f"{stem}.pem",
            tls_key=f"{stem}.key",
        )


class Plant:
    """The service of `vmc-07`, its control, and a screen that sees and notes everything there is to see."""

    def __init__(self, shop: Shop) -> None:
        self.commands: list[tuple[str, bytes, Sender]] = []
        self.seen: list[tuple[str, str, bytes]] = []
        self.alive: list[tuple[str, str]] = []
        self.shop = shop
        self._seq = 0
        self.service = Publisher(shop.settings(), self._command)
        self.other_commands: list[tuple[str, Sender]] = []
        self.other = Publisher(shop.settings("vmc-08"), self._other_command)
        self.receiver = Receiver(
            Settings(
                machine="vmc-07",
                prefix=PREFIX,
                offset_max_um=200.0,
                offset_rate_max_um_per_min=6000.0,
                valid_max_s=600.0,
                zenoh_config=str(shop.client_file("receiver-cnc-07")),
            ),
            step_max_s=60.0,
        )

    def _command(self, name: str, payload: bytes, sender: Sender) -> dict[str, Any]:
        self.commands.append((name, payload, sender))
        return {"ok": True, "text": "heard"}

    def _other_command(self, name: str, _: bytes, sender: Sender) -> dict[str, Any]:
        self.other_commands.append((name, sender))
        return {"ok": True, "text": "heard"}

    def __enter__(self) -> Plant:
        self.screen = zenoh.open(self.shop.config("receiver-watch"))
        self.screen.declare_subscriber(
            "**",
            lambda s: self.seen.append(
                (
                    str(s.key_expr),
                    s.kind.name if hasattr(s.kind, "name") else str(s.kind).rpartition(".")[2],
                    s.payload.to_bytes(),
                )
            ),
        )
        self.screen.liveliness().declare_subscriber(
            "**", lambda s: self.alive.append((str(s.key_expr), str(s.kind).rpartition(".")[2])), history=True
        )
        self.service.open()
        self.other.open()
        self.receiver.__enter__()
        wait(lambda: self.receiver.poll() and self.receiver.connected, "the receiver's connection")
        # A subscription takes a moment through the router: what is sent before is nobody's loss here.
        wait(lambda: self.publish() and self.seen, "the first offset on the screen")
        wait(lambda: self.publish() and self.receiver.poll().seq is not None, "the first offset at the control")
        wait(lambda: {key for key, _ in self.alive} >= BOTH, "both tokens")
        return self

    def __exit__(self, *_: object) -> None:
        self.receiver.close()
        self.other.close()
        self.service.close()
        self.screen.close()

    def publish(self) -> bytes:
        """Let the genuine service publish its next offset."""
        self._seq += 1
        time.sleep(0.02)
        data = offset(self._seq, 5.0, time_utc_ns=time.time_ns())
        self.service.publish("offset", data)
        return data

    def forget(self) -> None:
        """Begin a new observation, with what is under way out of it."""
        last = self.publish()
        wait(lambda: any(payload == last for _, _, payload in self.seen), "the last genuine offset")
        self.seen.clear()
        self.alive.clear()
        self.commands.clear()

    def latest(self) -> list[bytes]:
        """What a control is answered that asks for the latest."""
        replies = self.screen.get(OFFSET, timeout=10.0)
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

    def tokens(self) -> set[str]:
        """Who is alive; asked until both machines are there, because the answer may miss some while a client leaves."""

        def asked() -> set[str] | None:
            replies = self.screen.liveliness().get("**", timeout=10.0)
            found = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
            return found if found >= BOTH else None

        found: set[str] = wait(asked, "both machines' tokens")
        return found
