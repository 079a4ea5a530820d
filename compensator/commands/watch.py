"""`compensator watch`: show machines live in the terminal, on a page or in Foxglove; record a shop."""

from __future__ import annotations

import argparse
import itertools
import logging
import secrets
import stat
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.live import Live

from compensator.atomic_write import replace_file
from compensator.clock import SystemClock
from compensator.commands import Answer
from compensator.commands.stopping import Stop, until_stopped
from compensator.config import LoadedConfig, load_config, zenoh_below
from compensator.errors import ServiceError, UsageError
from compensator.input_file import KEY_BYTES, read_file
from compensator.service.session import services_text
from compensator.watch.listener import Listener, Sink, Source, of_endpoints, of_file, of_settings
from compensator.watch.past import last_day
from compensator.watch.shop import Shop, headline
from compensator.watch.terminal import line, view

log = logging.getLogger("compensator")

#: Time between two updates of the view, s; ages increase even without messages.
REFRESH_S = 1.0
#: Time after which a watch without a terminal reports that nothing has been received, s; longer than a query takes.
QUIET_S = 5.0


def run(arguments: argparse.Namespace) -> Answer | None:
    """Run the command until Ctrl-C or SIGTERM, or once.

    Raises
    ------
    UsageError
        If the endpoint is missing or wrong.
    ServiceError
        If run once and no service answers.
    """
    loaded = load_config(arguments.config) if arguments.config else None
    source = _source(arguments, loaded)
    config_of = {loaded.config.zenoh.prefix: str(arguments.config)} if loaded is not None else {}
    shop = Shop(SystemClock(), config_of)
    if loaded is not None:
        folder = loaded.resolve(loaded.config.recording.folder)
        shop.add_recorded(
            loaded.config.zenoh.prefix, last_day(folder, loaded.config.machine.name, SystemClock().utc_ns())
        )
    if arguments.bind is not None and not arguments.page:
        raise UsageError("--bind: is for --page, which is not given")
    if arguments.token is not None and arguments.bind is None:
        raise UsageError("--token: is for --bind, which is not given")
    other = arguments.page or arguments.record or arguments.foxglove
    if arguments.once or (arguments.json and not other):
        return _once(arguments, source, shop)
    with until_stopped() as stopped, ExitStack() as stack:
        sinks: list[Sink] = [shop]
        recorder = None
        watch = _Watch(shop, source, stopped)
        if arguments.record:
            from compensator.watch.shop_recorder import ShopRecorder

            recorder = ShopRecorder(arguments.record, source.prefix, SystemClock())
            sinks.append(recorder)
            stack.enter_context(recorder)
        if arguments.foxglove:
            from compensator.watch.foxglove import FoxgloveServer

            sinks.append(
                stack.enter_context(FoxgloveServer(source.prefix, arguments.foxglove_port, arguments.foxglove_origin))
            )
        if arguments.page:
            from compensator.watch.server import PageServer

            options = {"host": arguments.bind, "token": _token(arguments.token)} if arguments.bind else {}
            server = stack.enter_context(PageServer(shop, watch.status, arguments.port, **options))
            log.info("compensator: live page at %s (Ctrl-C ends it)", server.address)
        listener = stack.enter_context(Listener(source, *sinks, on_connection=watch.connection))
        listener.start()
        watch.show(terminal=sys.stdout.isatty() and not other, lines=not other)
    return Answer(*recorder.answer()) if recorder is not None else None


def _token(path: Path | None) -> str:
    """Return the token of the page: of its file, which is made if it does not exist, or a new one."""
    from compensator.watch.server import TOKEN

    if path is None:
        return secrets.token_urlsafe(16)
    try:
        token = read_file(path, KEY_BYTES).decode("ascii", "replace").strip()
    except FileNotFoundError:
        token = secrets.token_urlsafe(16)
        replace_file(path, f"{token}\n".encode(), mode=0o600)
        return token
    except OSError as error:
        raise UsageError(f"--token {path}: {error.strerror}, expected a file for the token of the page") from error
    if not TOKEN.fullmatch(token):
        shown = f"{len(token)} characters" if token else "empty"
        words = "expected 16 to 128 letters, digits, - or _; remove the file and it is made"
        raise UsageError(f"--token {path}: {shown}, {words}")
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o037:
        raise UsageError(f"--token {path}: mode {mode:04o}, expected 0600; otherwise other users could open the page")
    return token


def _source(arguments: argparse.Namespace, loaded: LoadedConfig | None) -> Source:
    """Return the endpoints and the prefix."""
    prefix = arguments.prefix
    if prefix is not None:
        zenoh_below(prefix)
    if arguments.connect and arguments.zenoh:
        raise UsageError("--connect: cannot be combined with --zenoh, whose file contains the endpoints")
    if prefix is None:
        prefix = loaded.config.zenoh.prefix if loaded is not None else ""
    if arguments.zenoh:
        return of_file(arguments.zenoh, prefix)
    if arguments.connect:
        return of_endpoints(prefix, arguments.connect)
    if loaded is None:
        words = "watch: expected --config FILE, --zenoh FILE or --connect ENDPOINT, such as tcp/127.0.0.1:7447"
        raise UsageError(words)
    return of_settings(msgspec.structs.replace(loaded.config.zenoh, prefix=prefix))


def _once(arguments: argparse.Namespace, source: Source, shop: Shop) -> Answer:
    """Query the latest messages once, and listen for the duration of --wait."""
    with Listener(source, shop) as listener:
        listener.open()
        listener.query()
        if arguments.wait:
            with until_stopped() as stopped:
                stopped.wait(arguments.wait)
        if not shop.overview() and not arguments.json:
            there = services_text(listener.elsewhere())
            raise ServiceError(f"no messages below {source.prefix or 'any prefix'} at {source.where}; {there}")
        console = Console(file=sys.stdout)
        with console.capture() as captured:
            console.print(
                view(shop, prefix=source.prefix, where=source.where, connected=True, console=console, stays=False)
            )
    machines = shop.overview()
    result = {"machines": machines, "headline": headline(machines), "ignored": shop.ignored}
    return Answer(result, captured.get().rstrip("\n"), 0 if machines else 1)


class _Watch:
    """Shows the shop until it is stopped."""

    def __init__(self, shop: Shop, source: Source, stopped: Stop) -> None:
        self._shop, self._source, self._stopped = shop, source, stopped
        self._connected = False

    def connection(self, connected: bool) -> None:
        """Update the state of the connection."""
        if connected != self._connected:
            log.info("compensator: %s %s", "connected to" if connected else "no connection to", self._source.where)
        self._connected = connected
        if not connected:
            self._shop.forget_alive()

    def status(self) -> dict[str, Any]:
        """Return the status of the watch itself."""
        return {
            "connected": self._connected,
            "where": self._source.where,
            "prefix": self._source.prefix,
            "ignored": self._shop.ignored,
        }

    def show(self, *, terminal: bool, lines: bool) -> None:
        """Draw on the terminal, or write a line per change, until stopped."""
        if terminal:
            self._draw()
            return
        written: dict[str, tuple[Any, ...]] = {}
        for turn in itertools.count():
            if lines:
                self._write_changes(written)
            if turn * REFRESH_S / 2.0 == QUIET_S:
                self._report_absence()
            if self._stopped.wait(REFRESH_S / 2.0):
                return

    def _write_changes(self, written: dict[str, tuple[Any, ...]]) -> None:
        """Write a line for each machine that has changed since it was written."""
        for machine in self._shop.overview():
            now = (machine["shown"], machine["seq"], machine["alive"], machine["malformed"])
            if written.get(machine["prefix"]) != now and (machine["seq"] is not None or machine["malformed"]):
                written[machine["prefix"]] = now
                sys.stdout.write(line(machine) + "\n")
                sys.stdout.flush()

    def _report_absence(self) -> None:
        """Log why nothing has been received, if so."""
        machines = self._shop.overview()
        if any(machine["seq"] is not None or machine["malformed"] for machine in machines):
            return
        where = self._source.where
        absent = f"no connection to {where} yet"
        if self._connected:
            alive = any(machine["alive"] for machine in machines)
            absent = "the service has published nothing yet" if alive else "no service is heard"
            absent += f" below {self._source.prefix or 'any prefix'} at {where}"
        log.info("compensator: %s; waiting", absent)

    def _draw(self) -> None:
        console = Console()
        # Log lines would disturb the screen; the view shows the state of the connection.
        log.setLevel(logging.WARNING)
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                live.update(
                    view(
                        self._shop,
                        prefix=self._source.prefix,
                        where=self._source.where,
                        connected=self._connected,
                        console=console,
                    ),
                    refresh=True,
                )
                if self._stopped.wait(REFRESH_S):
                    return
