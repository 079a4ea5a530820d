"""Server of the live page: one HTML file and JSON, on loopback, or on purpose on the shop's network.

On loopback only users of this computer can read it, and requests with another host name (DNS rebinding) are refused.
Bound to another address the page is below a token: whoever does not have the whole address gets nothing. Nothing can
be changed through it, and the page loads nothing from other servers.
"""

from __future__ import annotations

import base64
import errno
import hashlib
import hmac
import html
import io
import json
import re
import socket
import sys
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
from compensator.codes import SUFFIX_WORDS, WORDS
from compensator.errors import ServiceError, UsageError
from compensator.watch.clients import CONNECTIONS, REQUEST_S, Within
from compensator.watch.history import state_intervals
from compensator.watch.shop import Shop, headline

#: The address to which the server is bound without a token.
HOST = "127.0.0.1"
#: Shortest token: as many characters of a URL-safe alphabet cannot be guessed.
TOKEN = re.compile(r"[A-Za-z0-9_-]{16,128}", re.ASCII)
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
    host : str
        Address of this computer to which it is bound.
    token : str
        First part of every path; empty on loopback only.

    Raises
    ------
    UsageError
        If another address than loopback has no token, or the token can be guessed.
    """

    def __init__(
        self, shop: Shop, status: Callable[[], dict[str, Any]], port: int, *, host: str = HOST, token: str = ""
    ) -> None:
        if (host != HOST or token) and not TOKEN.fullmatch(token):
            raise UsageError("token: expected 16 to 128 letters, digits, - or _")
        self._shop, self._status, self._port, self._host, self._token = shop, status, port, host, token
        self._server: ThreadingHTTPServer | None = None
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Address of the page."""
        # Nobody can open the address of every network; the name of this computer may do.
        name = socket.gethostname() if self._host in ("0.0.0.0", "::") else self._host
        host = f"[{name}]" if ":" in name else name
        return f"http://{host}:{self._server.server_port if self._server else self._port}/" + (
            f"{self._token}/" if self._token else ""
        )

    def __enter__(self) -> PageServer:
        try:
            server = _Server6 if ":" in self._host else _Server
            self._server = server((self._host, self._port), _Handler)
        except (OSError, OverflowError) as error:
            where = f"--port {self._port}" if self._host == HOST else f"--bind {self._host} --port {self._port}"
            raise ServiceError(f"{where}: {error}; {_to_do(error)}") from error
        self._server.answer, self._server.token = self._answer, self._token
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


def _to_do(error: Exception) -> str:
    """Return what to do about a server that could not be bound."""
    if isinstance(error, socket.gaierror) or getattr(error, "errno", None) == errno.EADDRNOTAVAIL:
        return "expected --bind with an address of this computer, such as 192.168.0.10, or 0.0.0.0 for all of them"
    if getattr(error, "errno", None) == errno.EACCES:
        return "ports below 1024 are for the system; 0 selects a free one"
    return "0 selects a free port"


def _json(found: Any) -> tuple[str, bytes]:
    return "application/json", json.dumps(found, ensure_ascii=False, allow_nan=False).encode()


def _prose(text: str) -> str:
    """Return a text as HTML; a command between backticks is code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))


@cache
def page() -> tuple[bytes, str]:
    """Return the page and its content security policy, which permits its style and script by their hashes."""

    def part(room: str, name: str) -> str:
        return resources.files(room).joinpath(name).read_text(encoding="utf-8")

    style = part("compensator.report", "style.css") + part("compensator.watch", "live.css")
    script = part("compensator.watch", "live_plots.js") + part("compensator.watch", "live.js")
    words = "".join(
        f'<dt id="word={code}"><code>{code}</code></dt><dd>{_prose(meaning)} <b>Action:</b> {_prose(action)}</dd>'
        for code, (meaning, action) in {**WORDS, **SUFFIX_WORDS}.items()
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
    token: str = ""

    def __init__(self, *args: Any) -> None:
        self._free = threading.BoundedSemaphore(CONNECTIONS)
        super().__init__(*args)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own, unless too many are being answered."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and make room for another one."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing about a browser that was closed before it had its answer."""
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Server6(_Server):
    address_family = socket.AF_INET6


class _Handler(BaseHTTPRequestHandler):
    """A request; only GET and HEAD with the address's host name are answered."""

    server: _Server
    server_version, sys_version = "compensator", ""
    timeout = REQUEST_S

    def setup(self) -> None:
        """Read the request within its time."""
        super().setup()
        self.rfile = io.BufferedReader(Within(self.connection, self.timeout))

    def do_GET(self) -> None:
        """Answer a request."""
        if not self._has_own_host():
            # 421: the host name in the request is not that of this server.
            return self._send(HTTPStatus.MISDIRECTED_REQUEST, "text/plain", b"expected this page by its own address\n")
        try:
            parts = urlsplit(self.path)
        except ValueError:
            return self._send(HTTPStatus.BAD_REQUEST, "text/plain", b"expected a path\n")
        if self._is_token(parts.path.removeprefix("/")):
            # Without the last slash the page's own requests would miss the token.
            return self._send(HTTPStatus.PERMANENT_REDIRECT, "text/plain", b"", Location=f"/{self.server.token}/")
        path = self._below_token(parts.path)
        found = self.server.answer(path, parse_qs(parts.query)) if path is not None else None
        if found is None:
            return self._send(HTTPStatus.NOT_FOUND, "text/plain", b"not found\n")
        return self._send(HTTPStatus.OK, *found)

    do_HEAD = do_GET  # noqa: N815

    def __getattr__(self, name: str) -> Any:
        """Refuse every other method."""
        if name.startswith("do_"):
            return lambda: self._send(HTTPStatus.METHOD_NOT_ALLOWED, "text/plain", b"expected GET\n")
        raise AttributeError(name)

    def _below_token(self, path: str) -> str | None:
        """Return the path without its token; None if it has not the right one."""
        if not self.server.token:
            return path
        _, given, rest = [*path.split("/", 2), "", ""][:3]
        return f"/{rest}" if self._is_token(given) and path.count("/") > 1 else None

    def _is_token(self, given: str) -> bool:
        return bool(self.server.token) and hmac.compare_digest(
            given.encode("utf-8", "replace"), self.server.token.encode()
        )

    def _has_own_host(self) -> bool:
        if self.server.token:
            # The token protects as well as the name: a foreign page does not know it.
            return True
        port = self.server.server_port
        return self.headers.get("Host", "") in (f"{HOST}:{port}", f"localhost:{port}")

    def _send(self, code: HTTPStatus, kind: str, body: bytes, **headers: str) -> None:
        self.send_response(code)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(body))),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", page()[1]),
            ("X-Content-Type-Options", "nosniff"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
            *headers.items(),
        ):
            self.send_header(name, value)
        if code == HTTPStatus.METHOD_NOT_ALLOWED:
            self.send_header("Allow", "GET, HEAD")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Log nothing: an open page sends a request every two seconds."""
