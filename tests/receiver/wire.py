"""A router process and a scripted service on loopback."""

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

from tests.receiver.offsets import axis_offset, offset

PREFIX = "shop/vmc-07"


@contextmanager
def router(port: int) -> Iterator[subprocess.Popen[str]]:
    script = str(Path(__file__).with_name("router.py"))
    process = subprocess.Popen(
        [sys.executable, script, str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()


class ScriptedService:
    """Publishes what a test says, with token and answer, as a service does."""

    def __init__(self, port: int, prefix: str = PREFIX) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("listen/endpoints", "[]")
        config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/gossip/enabled", "false")
        retry = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
        config.insert_json5("connect/retry", json.dumps(retry))
        self.key = f"{prefix}/thermal/y/offset"
        self.latest: bytes | None = None
        self.session: Any = zenoh.open(config)
        self._publisher = self.session.declare_publisher(self.key)
        self._queryable = self.session.declare_queryable(self.key, self._answer)
        self.status: bytes | None = None
        self._status_key = f"{prefix}/thermal/status"
        self._statuses = self.session.declare_publisher(self._status_key)
        self._status_queryable = self.session.declare_queryable(self._status_key, self._answer_status)
        #: Payloads of the command `probe`.
        self.probes: list[dict[str, Any]] = []
        self.probe_answer: dict[str, Any] = {"ok": True, "text": "heard", "code": ""}
        self._commands = self.session.declare_queryable(f"{prefix}/thermal/command/probe/*", self._answer_probe)
        self._axes: dict[str, Any] = {}
        self._answered: list[Any] = []
        self._lengths: Any = None
        self._token = self.session.liveliness().declare_token(f"{prefix}/thermal/alive")

    def _answer(self, query: Any) -> None:
        with query:
            if self.latest is not None:
                query.reply(self.key, self.latest)

    def put(self, seq: int, y_um: float | None, *, heard: bool = True, **changes: Any) -> None:
        """Publish, as soon as somebody hears it: a subscription takes a moment to get here."""
        if heard:
            until(lambda: self._publisher.matching_status.matching, "a subscriber")
        self.latest = offset(seq, y_um, **{"time_utc_ns": time.time_ns(), **changes})
        self._publisher.put(self.latest)

    def put_axes(self, seq: int, *, heard: bool = True, without: str = "", **values: Any) -> None:
        """Publish a sample of several axes, each a value or the arguments of its message; `without` some of them."""
        time_utc_ns = time.time_ns()
        for axis in values:
            if axis not in self._axes:
                key = self.key.replace("/y/", f"/{axis}/")
                self._axes[axis] = [key, self.session.declare_publisher(key), b""]
                if axis != "y":
                    self._answered.append(self.session.declare_queryable(key, self._answers_of(axis)))
        for axis, value in values.items():
            changes = {"time_utc_ns": time_utc_ns, **(value if isinstance(value, dict) else {"value": value})}
            number = changes.pop("value", 0.0)
            payload = axis_offset(axis, seq, number, **{"axes": "".join(values), **changes})
            key, publisher, _ = self._axes[axis]
            if heard:
                until(lambda p=publisher: p.matching_status.matching, "a subscriber")
            if axis in without:
                continue
            self._axes[axis][2] = payload
            if axis == "y":
                self.latest = payload
            publisher.put(payload)

    def _answers_of(self, axis: str) -> Callable[[Any], None]:
        def answer(query: Any) -> None:
            key, _, payload = self._axes[axis]
            with query:
                if payload:
                    query.reply(key, payload)

        return answer

    def put_length(self, tool_length_mm: float | None, **changes: Any) -> None:
        """Publish the length of the tool."""
        key = self.key.replace("y/offset", "tool_length")
        if self._lengths is None:
            self._lengths = self.session.declare_publisher(key)
        until(lambda: self._lengths.matching_status.matching, "a subscriber")
        own = {"schema": 1, "machine": "vmc-07", "time_utc_ns": time.time_ns(), "valid_for_s": 600.0}
        self._lengths.put(json.dumps({**own, "tool_length_mm": tool_length_mm, **changes}))

    def _answer_status(self, query: Any) -> None:
        with query:
            if self.status is not None:
                query.reply(self._status_key, self.status)

    def _answer_probe(self, query: Any) -> None:
        with query:
            self.probes.append(json.loads(query.payload.to_bytes()))
            query.reply(query.key_expr, json.dumps(self.probe_answer))

    def put_status(self, *, heard: bool = True, **changes: Any) -> None:
        """Publish a status with these keys."""
        if heard:
            until(lambda: self._statuses.matching_status.matching, "a subscriber")
        own = {"schema": 1, "machine": "vmc-07", "seq": 1, "time_utc_ns": time.time_ns(), "state": "ok"}
        self.status = json.dumps(own | changes).encode()
        self._statuses.put(self.status)

    def close(self) -> None:
        own = [*self._answered, *(publisher for _, publisher, _ in self._axes.values())]
        for one in [*own, *([] if self._lengths is None else [self._lengths])]:
            one.undeclare()
        self._commands.undeclare()
        self._statuses.undeclare()
        self._status_queryable.undeclare()
        self._publisher.undeclare()
        self._queryable.undeclare()
        self._token.undeclare()
        self.session.close()

    def __enter__(self) -> ScriptedService:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def until(condition: Callable[[], object], what: str | Callable[[], str], timeout_s: float = 120.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"not within {timeout_s} s: {what if isinstance(what, str) else what()}"
        time.sleep(0.01)
