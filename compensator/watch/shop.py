"""All machines whose messages were received; written by other threads, read by views."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from typing import Any

from compensator.clock import NS, Clock
from compensator.watch.machine import KINDS, WatchedMachine
from compensator.watch.words import CONFIG, TONES

#: Largest number of machines, also for Foxglove and for the losses of a recording; messages of further machines are
#: only counted here.
MACHINES = 1000
_ORDER = {"bad": 0, "warn": 1, "good": 2}


class Shop:
    """Machines by prefix.

    Parameters
    ----------
    clock : Clock
        Clock for ages.

    Examples
    --------
    >>> from compensator.clock import SystemClock
    >>> shop = Shop(SystemClock())
    >>> shop.receive("shop/vmc-07/thermal/y/offset", b"nonsense")
    >>> shop.overview()[0]["malformed"], str(shop.overview()[0]["shown"])
    (1, 'unknown')
    """

    def __init__(self, clock: Clock, config_of: Mapping[str, str] | None = None) -> None:
        self._clock, self._config_of = clock, config_of or {}
        self._lock = threading.Lock()
        self._machines: dict[str, WatchedMachine] = {}
        #: Number of messages with unknown keys, or of machines beyond `MACHINES`.
        self.ignored = 0

    def receive(self, key: str, payload: bytes, *, asked: bool = False) -> None:
        """Receive a message, from any thread.

        Parameters
        ----------
        key, payload : str, bytes
            Its key and content; the content may be anything.
        asked : bool
            Whether it is the answer to a query.
        """
        prefix, _, rest = key.rpartition("/thermal/")
        kind = KINDS.get(rest)
        with self._lock:
            machine = self._machine(prefix) if kind is not None else None
            if machine is None or kind is None:
                self.ignored += 1
            else:
                machine.update(kind, payload, self._clock.utc_ns(), self._clock.monotonic_ns() / NS, asked=asked)

    def set_alive(self, key: str, alive: bool) -> None:
        """Receive a change of a liveliness token, from any thread."""
        prefix, _, rest = key.rpartition("/thermal/")
        with self._lock:
            machine = self._machine(prefix) if rest == "alive" else None
            if machine is not None:
                machine.alive = alive

    def forget_alive(self) -> None:
        """Mark the liveliness of all machines as unknown: the connection is gone."""
        with self._lock:
            for machine in self._machines.values():
                machine.alive = None

    def add_recorded(self, prefix: str, messages: Iterable[Any]) -> None:
        """Add messages from a recording to a machine's history."""
        with self._lock:
            machine = self._machine(prefix)
            if machine is not None:
                for message in messages:
                    machine.add_recorded(message, self._clock.utc_ns(), self._clock.monotonic_ns() / NS)

    def _machine(self, prefix: str) -> WatchedMachine | None:
        machine = self._machines.get(prefix)
        if machine is None and prefix and len(self._machines) < MACHINES:
            machine = self._machines[prefix] = WatchedMachine(prefix, self._config_of.get(prefix, CONFIG))
        return machine

    # ------------------------------------------------------------------ views

    def now_ns(self) -> int:
        """Return the wall clock of all ages, ns since 1970 UTC."""
        return self._clock.utc_ns()

    def overview(self) -> list[dict[str, Any]]:
        """Return the snapshots of all machines, the most severe first."""
        now_ns, monotonic_s = self._clock.utc_ns(), self._clock.monotonic_ns() / NS
        with self._lock:
            found = [machine.snapshot(now_ns, monotonic_s) for machine in self._machines.values()]
        return sorted(found, key=lambda one: (_ORDER[one["tone"]], one["prefix"]))

    def one(self, prefix: str) -> dict[str, Any] | None:
        """Return the snapshot of one machine; None if it is unknown."""
        now_ns, monotonic_s = self._clock.utc_ns(), self._clock.monotonic_ns() / NS
        with self._lock:
            machine = self._machines.get(prefix)
            return machine.snapshot(now_ns, monotonic_s) if machine is not None else None

    def history(self, prefix: str, since_ns: int = 0) -> dict[str, list[Any]]:
        """Return the last day of a machine; see `MachineHistory.columns`."""
        with self._lock:
            machine = self._machines.get(prefix)
            return machine.history.columns(since_ns) if machine is not None else {}

    def effects(self, prefix: str) -> list[str]:
        """Return the names of the effects in a machine's history."""
        with self._lock:
            machine = self._machines.get(prefix)
            return machine.effects() if machine is not None else []


def headline(machines: list[dict[str, Any]]) -> str:
    """Return a summary of the states of a shop.

    Examples
    --------
    >>> headline([{"shown": "ok"}, {"shown": "silent"}, {"shown": "ok"}])
    '3 machines: 1 silent, 2 ok'
    """
    if not machines:
        return "No machine is heard."
    counts: dict[str, int] = {}
    for name in TONES:
        count = sum(machine["shown"] == name for machine in machines)
        counts |= {name: count} if count else {}
    words = ", ".join(f"{count} {name}" for name, count in counts.items())
    return f"{len(machines)} machine{'s' if len(machines) > 1 else ''}: {words}"
