"""The live page: for whoever sits at this computer, and for nobody else."""

from __future__ import annotations

import http.client
import json
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.clock import NS
from compensator.codes import WORDS
from compensator.commands.watch import _token
from compensator.errors import ServiceError, UsageError
from compensator.messages import Offset
from compensator.watch import server as server_module
from compensator.watch.clients import CONNECTIONS
from compensator.watch.history import MachineHistory
from compensator.watch.server import PageServer
from compensator.watch.shop import Shop
from tests.report import chromium
from tests.watch.heard import START_NS, Clock, estimate, event, offset, sample, status
from tests.watch.slow import drip

STATUS = {"connected": True, "where": "tcp/127.0.0.1:7447", "prefix": "shop", "ignored": 0}
EVIL = '<img src=x onerror="document.title=1">'


def filled() -> Shop:
    clock = Clock()
    shop = Shop(clock)
    for i in range(180):
        for name in ("vmc-07", "vmc-08"):
            t, key = START_NS + i * 60 * NS, f"shop/{name}/thermal/"
            state = {"state": "degraded", "reasons": ["t_q_missing"]} if 60 < i < 90 else {}
            shop.receive(key + "y/offset", offset(i, t, machine=name, y_offset_um=-i / 3.0, **state))
            shop.receive(
                key + "sample",
                sample(i, t, t_q=None if state else 20.0 + i / 20.0, quality="open_circuit" if state else "good"),
            )
            shop.receive(key + "estimate", estimate(i, t, residual_um=0.1))
            shop.receive(key + "status", status(i, t, devices={"couples": EVIL}))
        clock.advance(60)
    shop.receive("shop/vmc-07/thermal/event", event(3, text=EVIL, ok=False))
    return shop


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    with PageServer(filled(), lambda: STATUS, 0) as served:
        yield served


def ask(server: PageServer, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    port = int(server.address.rsplit(":", 1)[1].strip("/"))
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read()
    connection.close()
    return found


def test_the_page_loads_nothing_from_anywhere(server: PageServer) -> None:
    code, headers, body = ask(server, "/")
    text = body.decode()
    assert code == 200 and headers["Content-Type"].startswith("text/html")
    assert not re.search(r"""(src|href)=["'](?!#|data:,)""", text) and "@import" not in text and "url(" not in text
    assert set(re.findall(r"https?://[^\s\"'`]+", text)) <= {"http://www.w3.org/2000/svg"}
    assert "{{" not in text
    assert all(f'id="word={code}"' in text for code in (*WORDS, "silent"))
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy and "frame-ancestors 'none'" in policy


def test_what_is_known_comes_as_json(server: PageServer) -> None:
    shop = json.loads(ask(server, "/shop.json")[2])
    assert shop["headline"] == "2 machines: 2 ok" and [one["prefix"] for one in shop["machines"]] == [
        "shop/vmc-07",
        "shop/vmc-08",
    ]
    one = json.loads(ask(server, "/machine.json?prefix=shop%2Fvmc-07")[2])
    assert one["machine"]["machine"] == "vmc-07" and one["effects"] == ["gain DTF"]
    history: dict[str, list[Any]] = one["history"]
    assert len(history["t_s"]) == 180 and history["t_q_degc"][70] is None and history["reasons"][70] == "t_q_missing"
    since = json.loads(ask(server, f"/machine.json?prefix=shop%2Fvmc-07&since_s={history['t_s'][-3]}")[2])
    assert since["history"]["t_s"] == history["t_s"][-3:]


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "127.0.0.1", "", "127.0.0.1:1", "127.0.0.1.evil.example"]
)
def test_a_name_that_is_not_its_own_is_refused(server: PageServer, host: str) -> None:
    for path in ("/", "/shop.json"):
        code, _, body = ask(server, path, Host=host)
        assert code == 421 and b"vmc" not in body


def test_bound_to_another_address_it_answers_below_its_token_only(tmp_path: Path) -> None:
    token = "Zm9vYmFyYmF6cXV4MDEyMw"
    with PageServer(filled(), lambda: STATUS, 0, host="127.0.0.2", token=token) as served:
        port = int(served.address.split(":")[2].split("/")[0])
        assert served.address == f"http://127.0.0.2:{port}/{token}/"

        def code_of(path: str, method: str = "GET") -> int:
            connection = http.client.HTTPConnection("127.0.0.2", port, timeout=30)
            connection.request(method, path)
            answer = connection.getresponse()
            body = answer.read()
            assert answer.status == 200 or b"vmc" not in body
            connection.close()
            return answer.status

        for path in ("", "shop.json", "machine.json?prefix=shop%2Fvmc-07"):
            assert code_of(f"/{token}/{path}") == 200
            for wrong in ("", f"{token[:-1]}/", f"{token}x/", "%5A/"):
                assert code_of(f"/{wrong}{path}") == 404, wrong
        # Typed without the last slash it leads to the page, and to nowhere else.
        connection = http.client.HTTPConnection("127.0.0.2", port, timeout=30)
        connection.request("GET", f"/{token}")
        answer = connection.getresponse()
        assert (answer.status, answer.headers["Location"]) == (308, f"/{token}/")
        connection.close()
        assert code_of(f"/{token}x") == 404
        assert code_of(f"/{token}/shop.json", "POST") == 405
        text, console = drawn(f"{served.address}#m=shop%2Fvmc-07", tmp_path, 390)
        assert console == "" and "✓ May cut</b>" in text


@pytest.mark.parametrize("token", ["", "short", "with space in it 1234", "../../etc/passwd-x"])
def test_another_address_without_a_good_token_is_refused(token: str) -> None:
    with pytest.raises(UsageError, match="token: expected 16 to 128"):
        PageServer(Shop(Clock()), lambda: STATUS, 0, host="127.0.0.2", token=token)


def test_a_token_is_made_once_and_kept_for_its_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "token"
    made = _token(path)
    assert _token(path) == made and path.stat().st_mode & 0o077 == 0
    assert _token(None) != _token(None)


@pytest.mark.parametrize(
    ("text", "mode", "words"),
    [
        ("", 0o600, "token: empty, expected 16 to 128"),
        ("short\n", 0o600, "token: 5 characters, expected 16 to 128"),
        ("Zm9vYmFyYmF6cXV4MDEyMw\n", 0o644, "token: mode 0644, expected 0600"),
    ],
)
def test_a_token_file_that_protects_nothing_is_refused(tmp_path: Path, text: str, mode: int, words: str) -> None:
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(UsageError, match=words):
        _token(path)


@pytest.mark.parametrize("host", ["192.0.2.7", "10.0.0.1:8710", "no such name"])
def test_an_address_that_is_not_of_this_computer_says_what_is_expected(host: str) -> None:
    with pytest.raises(ServiceError, match=f"--bind {host} --port 0: .* expected --bind with an address of this comp"):
        PageServer(Shop(Clock()), lambda: STATUS, 0, host=host, token="Zm9vYmFyYmF6cXV4MDEyMw").__enter__()


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"])
def test_nothing_but_looking_is_answered(server: PageServer, method: str) -> None:
    assert ask(server, "/shop.json", method)[0] == 405


def test_what_is_not_there_is_not_there(server: PageServer) -> None:
    for path in (
        "/machine.json",
        "/machine.json?prefix=shop/none",
        "/machine.json?prefix=shop%2Fvmc-07&since_s=x",
        "/machine.json?prefix=shop%2Fvmc-07&since_s=" + "9" * 400,
        "/machine.json?prefix=shop%2Fvmc-07&since_s=%C2%B2",
        "/../../etc/passwd",
        "/live.js",
    ):
        assert ask(server, path)[0] == 404, path
    assert ask(server, "/", "HEAD")[2] == b""


def test_a_port_that_is_taken_is_one_line(server: PageServer) -> None:
    port = int(server.address.rsplit(":", 1)[1].strip("/"))
    with pytest.raises(ServiceError, match=f"--port {port}: "):
        PageServer(Shop(Clock()), lambda: STATUS, port).__enter__()


def drawn(
    address: str, folder: Path, width: int, zone: str = "UTC", scheme: int = 1, budget_ms: int = 4000
) -> tuple[str, str]:
    """Return the page in a window of some width, and what its console said."""
    options = f"--window-size={width},900", f"--blink-settings=preferredColorScheme={scheme}"
    return chromium.drawn(address, folder, *options, budget_ms=budget_ms, zone=zone)


def test_a_browser_draws_one_machine_and_takes_nothing_for_code(server: PageServer, tmp_path: Path) -> None:
    text, console = drawn(f"{server.address}#m=shop%2Fvmc-07", tmp_path, 1400)
    assert console == ""
    assert text.count("<figure>") == 4 and "✓ May cut</b>" in text and "ok: offset −59.67 µm" in text
    # T_Q is missing for half an hour: its curve has two parts, the offset's has one.
    curves = re.findall(r'<path d="([^"]*)" class="curve c0">', text)
    parts = [curve.count("M") for curve in curves if curve != "M0 6H32"]
    assert parts == [1, 1, 1, 2]
    assert "&lt;img src=x" in text and "<img" not in text
    assert "gain DTF" in text and "spindle" not in text
    assert re.search(r"<td>⚠ degraded</td><td>\d+ min</td><td>t_q_missing</td>", text)


def test_a_page_goes_on_after_the_clock_of_the_watch_was_set_back(tmp_path: Path) -> None:
    clock = Clock()
    shop = Shop(clock)
    key = "shop/vmc-07/thermal/y/offset"
    shop.receive(key, offset(5, y_offset_um=-11.11))
    asked: list[int] = []

    def status() -> dict[str, Any]:
        asked.append(clock.now_ns)
        if len(asked) == 3:  # the page has drawn its points
            clock.now_ns -= 7200 * NS
            shop.receive(key, offset(6, clock.now_ns, y_offset_um=-22.22))
        return STATUS

    with PageServer(shop, status, 0) as served:
        text, console = drawn(f"{served.address}#m=shop%2Fvmc-07", tmp_path, 400, budget_ms=12_000)
    assert console == "" and len(asked) > 6
    assert re.search(r'<table id="points".*<td>−22.22</td>', text, re.DOTALL) and "<td>−11.11</td>" not in text


@pytest.mark.parametrize("past_minute_s", [0.0, 0.005, 30.0, 59.9])
def test_a_page_that_stays_open_keeps_every_point(past_minute_s: float) -> None:
    """The page's own code joins what `MachineHistory` answers to it, some times in each minute."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    history, answers, since_s, minutes = MachineHistory(), [], 0.0, 40
    for i in range(minutes):
        at_ns = START_NS + round((i * 60 + past_minute_s) * NS)
        history.add(msgspec.json.decode(offset(i, at_ns), type=Offset), at_ns)
        for later_s in (0.5, 20.0, 40.0):
            now_s = at_ns / NS + later_s
            found = history.columns(round(since_s * NS))
            answers.append([found, now_s])
            since_s = min(found["t_s"][-1], now_s) - 300.0
    page = (Path(server_module.__file__).parent / "live.js").read_text(encoding="utf-8")
    own = [
        re.search(pattern, page, re.DOTALL | re.MULTILINE)
        for pattern in (r"^const POLL_MS.*?;$", r"^function joined.*?^}")
    ]
    code = "\n".join(part[0] for part in own if part is not None) + (
        "\nconst answers = JSON.parse(require('fs').readFileSync(0, 'utf-8'));"
        "\nconsole.log(JSON.stringify(answers.reduce((past, one) => joined(past, ...one), null).y_offset_um.length));"
    )
    done = subprocess.run([node, "-e", code], input=json.dumps(answers), capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == minutes


@pytest.mark.parametrize("part", ["word=%zz", "m=%zz"])
def test_an_address_with_a_stray_percent_sign_is_drawn(server: PageServer, tmp_path: Path, part: str) -> None:
    text, console = drawn(f"{server.address}#{part}", tmp_path, 400)
    said = "2 machines: 2 ok" if part.startswith("word") else "No messages from %zz."
    assert console == "" and said in text


def test_a_browser_draws_the_shop(server: PageServer, tmp_path: Path) -> None:
    text, console = drawn(server.address, tmp_path, 400)
    assert console == "" and "2 machines: 2 ok" in text and text.count('data-prefix="shop/vmc-0') == 2


def test_the_shop_says_what_to_do_and_times_are_of_the_viewers_zone(tmp_path: Path) -> None:
    shop = filled()
    key, t = "shop/vmc-07/thermal/y/offset", START_NS + 180 * 60 * NS  # 08:59 UTC
    shop.receive(key, offset(180, t, state="hold", reasons=["operator_hold"]))
    with PageServer(shop, lambda: STATUS, 0) as served:
        text, console = drawn(served.address, tmp_path, 400)
        assert console == ""
        assert "<li><b>✗ shop/vmc-07 hold: Do not cut to size. </b>An operator has frozen the offset. Send" in text
        text, console = drawn(f"{served.address}#m=shop%2Fvmc-07", tmp_path, 1400, zone="Asia/Tokyo")
    assert console == ""
    assert "Asia/Tokyo, UTC+09:00" in text and text.count("time of day, UTC+09:00") == 4
    assert re.search(r"<th scope=\"row\">(\d\d-\d\d )?18:00</th><td>✗ hold</td>", text)


def test_a_channel_that_is_not_well_stands_above_the_numbers(tmp_path: Path) -> None:
    shop = filled()
    t = START_NS + 180 * 60 * NS
    shop.receive("shop/vmc-07/thermal/sample", sample(180, t, t_q=None, quality="open_circuit"))
    with PageServer(shop, lambda: STATUS, 0) as served:
        text, console = drawn(f"{served.address}#m=shop%2Fvmc-07", tmp_path, 400)
    assert console == ""
    said = (
        't_q_degc: <a href="#word=open_circuit">open_circuit</a>: The thermocouple or its wiring is broken. <b>Action'
    )
    assert said in text and text.index(said) < text.index('<dl id="now"')


def test_slow_clients_hold_a_place_for_the_time_of_one_request(
    server: PageServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who sends byte after byte is dropped, and more than are answered at once are turned away; then all is well."""
    assert server._server is not None
    monkeypatch.setattr(server._server.RequestHandlerClass, "timeout", 0.5)
    address = server._server.server_address[:2]
    with ExitStack() as stack:
        slow = [stack.enter_context(socket.create_connection(address)) for _ in range(CONNECTIONS)]
        with socket.create_connection(address) as one_more:
            one_more.settimeout(30)
            with suppress(ConnectionError):
                assert one_more.recv(1) == b"", "turned away"
        drip(slow[0], 0.5)
        for one in slow[1:]:
            one.settimeout(30)
            assert one.recv(1) == b""
    assert ask(server, "/shop.json")[0] == 200


def test_a_browser_that_closes_early_leaves_no_traceback(server: PageServer, capfd: pytest.CaptureFixture[str]) -> None:
    assert server._server is not None
    for error, printed in ((BrokenPipeError(), False), (ConnectionResetError(), False), (ValueError("a defect"), True)):
        try:
            raise error
        except (OSError, ValueError):
            server._server.handle_error(None, ("127.0.0.1", 1))
        assert ("Traceback" in capfd.readouterr().err) == printed
