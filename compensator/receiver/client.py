"""The Zenoh client around a follower, of one axis or of several.

`poll` empties Zenoh's buffers on the caller's thread: there are no callbacks, a slow caller blocks nothing, and no
thread delays the program's exit. Only the first connection is made by a separate thread, because an address that does
not answer would block the caller's loop.
"""

from __future__ import annotations

import errno
import json
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh

from .applied_record import AppliedRecord
from .errors import ReceiverError
from .message import PAYLOAD_MAX_BYTES, SEQ_MAX, ProbeWanted, Rejected, parse_status
from .modes import Modes
from .reasons import Reason
from .settings import STATE_MAX_BYTES, ZENOH_BRACKETS, ZENOH_MAX_BYTES, Source, read_file, write_file

#: One attempt to reach the router, ms, and the pause before the next, s.
CONNECT_TIMEOUT_MS = 1000
CONNECT_PAUSE_S = 0.5
#: How long to wait for the answer to the query of the latest offset, s.
ANSWER_TIMEOUT_S = 5.0
#: Longest text of an error of Zenoh, characters.
LONGEST_ERROR = 400
_BUFFER = 32
_CONNECTING = Reason("not_connected")


def monotonic_s() -> float:
    """Return a clock that cannot be set and that runs while the computer sleeps, s."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def client_config(source: Source) -> Any:
    """Make the Zenoh configuration: a client without listening endpoints and scouting.

    Raises
    ------
    ReceiverError
        Where the file cannot be used.
    """
    if source.zenoh_config:
        try:
            data = read_file(Path(source.zenoh_config), ZENOH_MAX_BYTES)  # of a device Zenoh would never come back
        except OSError as error:
            raise ReceiverError(f"{source.zenoh_config}: {error.strerror}; expected a Zenoh configuration") from error
        if data.count(b"[") + data.count(b"{") > ZENOH_BRACKETS:
            raise ReceiverError(
                f"{source.zenoh_config}: more than {ZENOH_BRACKETS} brackets; expected a Zenoh configuration"
            )
        try:
            config = zenoh.Config.from_file(source.zenoh_config)
        except zenoh.ZError as error:
            text = " ".join(str(error).split())  # it may cite a whole line of the file
            text = (
                text if len(text) <= LONGEST_ERROR else f"{text[: LONGEST_ERROR // 2]} … {text[-LONGEST_ERROR // 2 :]}"
            )
            raise ReceiverError(f"{source.zenoh_config}: {text}; expected a Zenoh configuration") from error
        # A router forwards nothing between two peers, and reports no error.
        if json.loads(config.get_json("mode") or "null") != "client":
            raise ReceiverError(f"{source.zenoh_config}: mode = {config.get_json('mode')}: expected 'client'")
    else:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps(list(source.connect)))
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/gossip/enabled", "false")
        config.insert_json5("transport/shared_memory/enabled", "false")  # it leaves files behind
        retry = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
        config.insert_json5("connect/retry", json.dumps(retry))
    config.insert_json5("connect/timeout_ms", str(CONNECT_TIMEOUT_MS))
    return config


class Client(ABC):
    """Connects, receives offsets, liveliness and status, and keeps the last number.

    Parameters
    ----------
    source : Source
        Machine and addresses.
    offset_key : str
        What is subscribed to, below the prefix and `thermal/`.
    latest_keys : tuple of str
        What the latest offset is asked for by: no patterns, because a stranger may answer one with thousands of keys,
        and Zenoh's thread waits for what an answer's buffer does not hold.
    clock, utc_ns : callable
        Monotonic clock, s, and wall clock, ns.

    Raises
    ------
    ReceiverError
        Where the settings, the Zenoh configuration or the state file cannot be used.
    """

    def __init__(
        self,
        source: Source,
        offset_key: str,
        latest_keys: tuple[str, ...],
        *,
        clock: Callable[[], float],
        utc_ns: Callable[[], int],
    ) -> None:
        self._source = source
        self._config = client_config(source)
        self._clock, self._utc_ns = clock, utc_ns
        self._offset_key, self._latest_keys = offset_key, latest_keys
        self._state_file = Path(source.state_file) if source.state_file else None
        self._remark: Reason | None = None
        self._not_recorded: dict[AppliedRecord, Reason] = {}
        self._wanted: tuple[ProbeWanted | None, int, float] | None = None
        self._polled_s: float | None = None
        self._paused = False
        self._session: Any = None
        self._opened: list[Any] = []
        self._ended = threading.Event()
        self._opener = threading.Thread(target=self._open, name="thermal-receiver-connect", daemon=True)
        self._accepted = False
        self._offsets: Any = None
        self._tokens: Any = None
        self._statuses: Any = None
        self._answers: list[Any] = []
        self._status_answers: list[Any] = []

    @property
    @abstractmethod
    def _modes(self) -> Modes[Any]:
        """Return the follower."""

    @abstractmethod
    def _accept(self, now_s: float, sample: Any, utc_ns: Callable[[], int] | None, *, asked: bool) -> bool:
        """Hand a sample of Zenoh to the follower; return whether it is used now."""

    def __enter__(self) -> Self:
        self._opener.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the Zenoh session; may be called twice. The offset at the control is not changed."""
        self._ended.set()
        if self._opener.is_alive():
            self._opener.join(CONNECT_TIMEOUT_MS / 1000.0 + 2.0)
        session, self._session = self._session, None
        if session is None and self._opened:
            session = self._opened.pop()
        if session is not None:
            with suppress(zenoh.ZError):  # one that is held up does not close in time; it ends with the process
                session.close()

    @property
    def connected(self) -> bool:
        """Whether the first connection was made."""
        return self._session is not None

    # ------------------------------------------------------------------ the loop

    def _receive_all(self) -> float:
        """Process new messages, without waiting; return the time, s."""
        now_s = self._clock()
        # If this program was blocked, a message may have been waiting for an unknown time.
        self._paused = self._polled_s is not None and now_s - self._polled_s > self._modes.step_max_s
        self._polled_s = now_s
        if self._session is None and self._opened:
            self._declare(self._opened.pop())
        if self._session is not None:
            self._receive_tokens()
            self._receive_answers(now_s)
            self._receive_statuses(now_s)
            for sample in waiting(self._offsets):
                self._receive(now_s, sample, check_age=self._paused or self._source.check_clock, asked=False)
            self._save()
        return now_s

    @property
    def _remarks(self) -> tuple[Reason, ...]:
        """Return what does not concern the offset."""
        own = (self._remark, *dict.fromkeys(self._not_recorded.values()), None if self.connected else _CONNECTING)
        return tuple(reason for reason in own if reason is not None)

    def _receive(self, now_s: float, sample: Any, *, check_age: bool, asked: bool) -> None:
        self._accepted |= self._accept(now_s, sample, self._utc_ns if check_age else None, asked=asked)

    def _receive_answers(self, now_s: float) -> None:
        for sample in answered(self._answers):
            self._receive(now_s, sample, check_age=True, asked=True)

    def _receive_tokens(self) -> None:
        for token in waiting(self._tokens):
            self._modes.alive = token.kind == zenoh.SampleKind.PUT
            if self._modes.alive:  # a new service, or a new route to it: it may have published meanwhile
                self._query_latest()

    # ------------------------------------------------------------------ probes

    def _append(self, record: AppliedRecord, applied_um: float | None) -> None:
        try:
            record.append(self._utc_ns(), applied_um)
        except OSError as error:
            self._not_recorded[record] = Reason("applied_not_recorded", f"{error.strerror or error}")
        else:
            self._not_recorded.pop(record, None)

    @property
    def probe_wanted(self) -> ProbeWanted | None:
        """What the service says about the next probe; None without probes, or where its status is not recent."""
        if self._wanted is None or self._modes.alive is False:
            return None
        wanted, _, received_s = self._wanted
        return wanted if self._clock() - received_s <= self._source.valid_max_s else None

    def _receive_statuses(self, now_s: float) -> None:
        for sample in answered(self._status_answers):
            self._receive_status(now_s, sample, check_age=True, asked=True)
        for sample in waiting(self._statuses):
            self._receive_status(now_s, sample, check_age=self._paused, asked=False)

    def _receive_status(self, now_s: float, sample: Any, *, check_age: bool, asked: bool) -> None:
        try:
            status = parse_status(bytes_of(sample), self._source.machine)
        except Rejected:  # the messages of the offset show what is wrong
            return
        time_utc_ns, measured_s = status.time_utc_ns, now_s
        if asked and self._wanted is not None and time_utc_ns < self._wanted[1]:
            return  # overtaken by a message
        if check_age:  # a service whose sampling hangs still answers
            measured_s -= max((self._utc_ns() - time_utc_ns) / 1e9, 0.0)
        self._wanted = (status.wanted, time_utc_ns, measured_s)

    # ------------------------------------------------------------------ connecting

    def _key(self, name: str) -> str:
        return f"{self._source.prefix}/thermal/{name}"

    def _open(self) -> None:
        while not self._ended.is_set():
            try:
                session = zenoh.open(self._config)
            except zenoh.ZError:
                self._ended.wait(CONNECT_PAUSE_S)
                continue
            self._opened.append(session)
            return

    def _declare(self, session: Any) -> None:
        ring = zenoh.handlers.RingChannel
        self._session = session
        self._offsets = session.declare_subscriber(self._key(self._offset_key), ring(_BUFFER))
        self._statuses = session.declare_subscriber(self._key("status"), ring(_BUFFER))
        self._tokens = session.liveliness().declare_subscriber(self._key("alive"), ring(_BUFFER), history=True)
        self._query_latest()

    def _query_latest(self) -> None:
        keys = [(self._latest_keys, self._answers), (("status",), self._status_answers)]
        for names, answers in keys:
            # All axes are asked for, or none.
            for key in names if len(answers) < _BUFFER * len(names) else ():
                # A ring channel would lose the answers when the query ends.
                handler: Any = zenoh.handlers.FifoChannel(_BUFFER)
                answers.append(self._session.get(self._key(key), handler, timeout=ANSWER_TIMEOUT_S))

    # ------------------------------------------------------------------ over a restart

    def _last_sequence(self) -> int:
        if self._state_file is None:
            return -1
        try:
            kept = json.loads(read_file(self._state_file, STATE_MAX_BYTES))
            machine, last = kept["machine"], kept["last_sequence"]
        except FileNotFoundError:
            return -1
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            machine, last = None, None
        if not isinstance(last, int) or isinstance(last, bool) or not -1 <= last <= SEQ_MAX:
            self._remark = Reason("state_damaged", str(self._state_file))
            return -1
        if machine != self._source.machine:
            raise ReceiverError(
                f"{self._state_file}: machine = {str(machine)[:64]!r}: expected {self._source.machine!r}; "
                f"each receiver needs its own state file"
            )
        return last

    def _save(self) -> None:
        """Save the last number if messages were accepted; once for all, because each time waits for the disk."""
        accepted, self._accepted = self._accepted, False
        if self._state_file is None or not accepted:
            return
        try:
            if self._state_file.exists() and not self._state_file.is_file():
                raise OSError(errno.EINVAL, "not a regular file")  # a device would be gone
            part = self._state_file.with_name(self._state_file.name + ".part")
            write_file(part, json.dumps(self._modes.snapshot()))
            part.replace(self._state_file)
        except (OSError, ValueError) as error:  # ValueError: "/" has no name
            self._remark = Reason("state_not_saved", f"{self._state_file}: {getattr(error, 'strerror', None) or error}")
        else:
            self._remark = None


def waiting(channel: Any) -> Iterator[Any]:
    """Yield what has arrived, at most a buffer full: a flood must not keep the caller's loop."""
    for _ in range(_BUFFER):
        if (item := channel.try_recv()) is None:
            return
        yield item


def answered(queries: list[Any]) -> Iterator[Any]:
    """Yield what has arrived in answer to queries, and remove those that have all their answers."""
    for answers in list(queries):
        try:
            for reply in waiting(answers):
                if reply.ok is not None:
                    yield reply.ok
        except zenoh.ZError:
            queries.remove(answers)


def bytes_of(sample: Any) -> bytes:
    """Return the payload; the part of a payload that is too long suffices to drop it."""
    payload = sample.payload
    return payload.to_bytes() if len(payload) <= PAYLOAD_MAX_BYTES else bytes(PAYLOAD_MAX_BYTES + 1)
