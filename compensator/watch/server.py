"""Server of the live page: one HTML file and JSON, on loopback only.

Only users of this computer can read it. Requests with another host name (DNS rebinding) are refused, nothing can be
changed, and the page loads nothing from other servers.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import threading
from collections.abc import Callable
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

from compensator import __version__
from compensator.clock import NS
from compensator.codes import WORDS
from compensator.errors import ServiceError
from compensator.watch.history import state_intervals
from compensator.watch.shop import Shop, headline

#: The only address to which the server is bound.
HOST = "127.0.0.1"
#: A time in a request, s since 1970: no more digits than any has.
_SECONDS = re.compile(r"[0-9]{1,12}(\.[0-9]{0,9})?", re.ASCII)
#: Largest number of intervals in one state on the page.
INTERVALS = 30
#: Values of a machine that the table of a shop does not need.
_DETAILS = ("channels", "devices", "events", "shares")


class PageServer:
    """A server of the live page. Use it as a context manager.

    Parameters
    ----------
    shop : Shop
        The machines.
    status : callable
        Returns the status of the watch: `connected`, `where`, `prefix`, `ignored`.
    port : int
        0 selects a free port.
    """

    def __init__(self, shop: Shop, status: Callable[[], dict[str, Any]], port: int) -> None:
        self._shop, self._status, self._port = shop, status, port
        self._server: ThreadingHTTPServer | None = None
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self._server.server_port if self._server else self._port}/"

    def __enter__(self) -> PageServer:
        try:
            self._server = _Server((HOST, self._port), _Handler)
        except (OSError, OverflowError) as error:
            raise ServiceError(f"--port {self._port}: {error}; 0 selects a free port") from error
        self._server.answer = self._answer
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="live page")
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()
        self._server = self._thread = None

    def _answer(self, path: str, query: dict[str, list[str]]) -> tuple[str, bytes] | None:
        """Return content type and body of a path; None if it does not exist."""
        if path == "/":
            return "text/html; charset=utf-8", page()[0]
        if path == "/shop.json":
            machines = self._shop.overview()
            short = [{name: value for name, value in one.items() if name not in _DETAILS} for one in machines]
            return _json({"status": self._status(), "headline": headline(machines), "machines": short})
        if path == "/machine.json":
            prefix, since = query.get("prefix", [""])[0], query.get("since_s", ["0"])[0]
            machine = self._shop.one(prefix)
            if machine is None or not _SECONDS.fullmatch(since):
                return None
            history = self._shop.history(prefix, int(float(since)) * NS)
            found = {"now_s": self._shop.now_ns() / NS, "status": self._status(), "machine": machine}
            intervals = state_intervals(self._shop.history(prefix), machine["valid_for_s"])[:INTERVALS]
            found["intervals"] = [interval._asdict() for interval in intervals]
            return _json(found | {"history": history, "effects": self._shop.effects(prefix)})
        return None


def _json(found: Any) -> tuple[str, bytes]:
    return "application/json", json.dumps(found, ensure_ascii=False, allow_nan=False).encode()


@cache
def page() -> tuple[bytes, str]:
    """Return the page and its content security policy, which permits its style and script by their hashes."""

    def part(room: str, name: str) -> str:
        return resources.files(room).joinpath(name).read_text(encoding="utf-8")

    style = part("compensator.report", "style.css") + part("compensator.watch", "live.css")
    script = part("compensator.watch", "live.js")
    words = "".join(
        f'<dt id="word={code}"><code>{code}</code></dt>'
        f"<dd>{html.escape(meaning)} <b>Action:</b> {html.escape(action)}</dd>"
        for code, (meaning, action) in WORDS.items()
    )
    text = part("compensator.watch", "live.html")
    for name, filled in (("style", style), ("words", words), ("version", __version__), ("script", script)):
        text = text.replace(f"{{{{{name}}}}}", filled)
    hashes = [base64.b64encode(hashlib.sha256(part.encode()).digest()).decode() for part in (style, script)]
    policy = (
        f"default-src 'none'; style-src 'sha256-{hashes[0]}'; script-src 'sha256-{hashes[1]}'; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return text.encode(), policy


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    # Otherwise another program could use the same port.
    allow_reuse_port = False
    answer: Callable[[str, dict[str, list[str]]], tuple[str, bytes] | None]


class _Handler(BaseHTTPRequestHandler):
    """A request; only GET and HEAD with the address's host name are answered."""

    server: _Server
    server_version, sys_version = "compensator", ""
    #: Timeout of a silent client, s.
    timeout = 10.0

    def do_GET(self) -> None:
        """Answer a request."""
        if not self._has_own_host():
            # 421: the host name in the request is not that of this server.
            return self._send(HTTPStatus.MISDIRECTED_REQUEST, "text/plain", b"expected this page by its own address\n")
        parts = urlsplit(self.path)
        found = self.server.answer(parts.path, parse_qs(parts.query))
        if found is None:
            return self._send(HTTPStatus.NOT_FOUND, "text/plain", b"not found\n")
        return self._send(HTTPStatus.OK, *found)

    do_HEAD = do_GET  # noqa: N815

    def __getattr__(self, name: str) -> Any:
        """Refuse every other method."""
        if name.startswith("do_"):
            return lambda: self._send(HTTPStatus.METHOD_NOT_ALLOWED, "text/plain", b"expected GET\n")
        raise AttributeError(name)

    def _has_own_host(self) -> bool:
        port = self.server.server_port
        return self.headers.get("Host", "") in (f"{HOST}:{port}", f"localhost:{port}")

    def _send(self, code: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(code)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(body))),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", page()[1]),
            ("X-Content-Type-Options", "nosniff"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
        ):
            self.send_header(name, value)
        if code == HTTPStatus.METHOD_NOT_ALLOWED:
            self.send_header("Allow", "GET, HEAD")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Log nothing: an open page sends a request every two seconds."""
