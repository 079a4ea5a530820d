"""The thread in which all simulated devices of a test run."""

from __future__ import annotations

import asyncio
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, TypeVar

from sim_hardware.wire.faults import Faults

PATIENCE_S = 60.0

_Result = TypeVar("_Result")


class Server(ABC):
    """Serve simulated devices on one port; started by `Rack.add`.

    Attributes
    ----------
    faults : Faults
        Faults of the whole line. They have precedence over those of the devices on it.
    """

    def __init__(self) -> None:
        self.faults = Faults()
        self._rack: Rack | None = None

    @property
    def rack(self) -> Rack:
        """The rack that runs the server.

        Raises
        ------
        RuntimeError
            If it has not been added to one.
        """
        if self._rack is None:
            raise RuntimeError(f"{type(self).__name__} has not been added to a rack")
        return self._rack

    def watch(self, *faults: Faults, supported: frozenset[str]) -> None:
        """Apply `disconnect` when one of these sets of faults changes; refuse faults that this carrier cannot have."""
        for each in faults:
            each.restrict(supported)
            each.listen(self._faults_changed)

    @abstractmethod
    async def start(self) -> None:
        """Open the ports, in the rack's loop."""

    @abstractmethod
    async def stop(self) -> None:
        """Close everything that `start` opened, in the rack's loop."""

    @abstractmethod
    async def apply_faults(self) -> None:
        """Set the ports to the state required by the faults."""

    def _faults_changed(self) -> None:
        if self._rack is not None:
            self._rack.run(self.apply_faults())


_Server = TypeVar("_Server", bound=Server)


class Rack:
    """Run servers in one background thread, and stop them all on leaving.

    Sources are called in that thread. Errors in it (such as an exception in a source) are stored and raised on
    exit.

    Parameters
    ----------
    new_loop : callable
        Makes the thread's event loop: one with a clock of its own, for example.

    Examples
    --------
    >>> from sim_hardware.wire import Adam, ModbusTcpServer
    >>> with Rack() as rack:
    ...     tcp = rack.add(ModbusTcpServer({1: Adam("adam-6018", ranges="K", sources={0: lambda: 21.5})}))
    ...     tcp.module(1).faults.set("open", input=0)
    ...     tcp.host
    '127.0.0.1'
    """

    def __init__(self, new_loop: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop) -> None:
        self._new_loop = new_loop
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._servers: list[Server] = []
        self.errors: list[BaseException] = []

    def __enter__(self) -> Rack:
        self._loop = self._new_loop()
        self._loop.set_exception_handler(self._failed)
        self._thread = threading.Thread(target=self._run, name="sim-hardware", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if self.errors and error is None:
            raise RuntimeError("a simulated device failed") from self.errors[0]

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The background thread's event loop.

        Raises
        ------
        RuntimeError
            If the rack is not running.
        """
        if self._loop is None:
            raise RuntimeError("the rack is not running: use it as a context manager")
        return self._loop

    def add(self, server: _Server) -> _Server:
        """Start a server and return it, its ports open."""
        server._rack = self
        self._servers.append(server)
        self.run(server.start())
        return server

    def run(self, coroutine: Coroutine[Any, Any, _Result]) -> _Result | None:
        """Run a coroutine in the background thread and return its result.

        From that thread itself (a source that sets a fault) it is only scheduled.

        Raises
        ------
        TimeoutError
            If it takes longer than `PATIENCE_S`.
        """
        if self._loop is None or self._thread is None:
            coroutine.close()
            return None
        if threading.current_thread() is self._thread:
            task = self._loop.create_task(coroutine)
            task.add_done_callback(lambda done: done.exception())
            return None
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(PATIENCE_S)

    def close(self) -> None:
        """Stop all servers and the thread. May be called twice."""
        if self._loop is None or self._thread is None:
            return
        try:
            for server in reversed(self._servers):
                self.run(server.stop())
                server._rack = None
        finally:
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(PATIENCE_S)
            self._servers.clear()
            self._loop = self._thread = None

    def _run(self) -> None:
        assert self._loop is not None
        loop = self._loop
        asyncio.set_event_loop(loop)
        try:
            loop.run_forever()
        finally:
            pending = asyncio.all_tasks(loop)
            for task in pending:
                task.cancel()
            loop.run_until_complete(asyncio.gather(*pending, return_exceptions=True))
            loop.close()

    def _failed(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        self.errors.append(context.get("exception") or RuntimeError(str(context.get("message"))))
