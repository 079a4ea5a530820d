"""Records everything that a shop publishes to MCAP: every message as received, with its key and time of arrival.

This is a copy for viewing and for comparing machines. The evidence is each service's own recording, which contains the
sample before its offset was published, and a hash chain. Here a message is on disk within `SYNC_S` of its arrival, a
kill loses at most this time, and lost messages are counted by their sequence numbers.
"""

from __future__ import annotations

import json
import logging
import threading
from collections import deque
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple

from compensator import __version__
from compensator.clock import Clock
from compensator.events import EventKind, pause_of
from compensator.messages import shipped_schema
from compensator.messages_axes import ALL_MESSAGES, axis_of
from compensator.recording.compaction import rewrite
from compensator.recording.finishing import Finisher, Retention
from compensator.recording.live_file import LiveFile
from compensator.recording.naming import day_of, names
from compensator.recording.reading import recordings
from compensator.watch.machine import KINDS, Malformed, decoded
from compensator.watch.sequence import Sequence
from compensator.watch.shop import MACHINES

log = logging.getLogger("compensator")

#: Longest time from the arrival of a message until it is on disk, s.
SYNC_S = 2.0
#: Largest number of queued messages, and of their bytes; beyond that the oldest are dropped and counted.
WAITING, WAITING_BYTES = 200_000, 500_000_000
#: Most messages that are written at once, so that a file is not much longer than full.
PART = 10_000
#: Largest number of channels in one file, so that arbitrary keys cannot fill the memory.
CHANNELS = 20_000
#: Prefix of the file names of a shop's recordings.
NAME = "shop"
#: Topic prefix of messages that follow no schema.
OTHER = "other/"


class _Arrival(NamedTuple):
    """A message with its key and time of arrival."""

    time_ns: int
    key: str
    payload: bytes


class ShopRecorder:
    """Recorder of a shop. Use it as a context manager; at its exit everything is on disk and compacted.

    Parameters
    ----------
    folder : pathlib.Path
        Created if it does not exist.
    prefix : str
        Prefix of the keys, for the metadata.
    clock : Clock
        Time of arrival.
    """

    def __init__(self, folder: Path, prefix: str, clock: Clock) -> None:
        self._folder, self._prefix, self._clock = folder, prefix, clock
        self._lock = threading.Lock()
        self._waiting: deque[_Arrival] = deque()
        self._waiting_bytes = 0
        self._wake, self._ended = threading.Event(), False
        self._thread: threading.Thread | None = None
        self._finisher = Finisher(folder, NAME, Retention(), None, compacted=_compacted)
        self._file: _File | None = None
        self._day, self._failed = "", False
        #: Numbers by prefix and the rest of the key, of at most `MACHINES` machines.
        self._numbers: dict[str, dict[str, Sequence]] = {}
        self._not_counted = 0
        self.files: list[Path] = []
        self.messages = 0
        #: Number of messages that arrived but are in no file, because the disk failed for too long.
        self.not_recorded = 0

    def receive(self, key: str, payload: bytes, *, asked: bool = False) -> None:
        """Receive a message, from any thread; answers to queries repeat messages and are ignored."""
        if asked:
            return
        with self._lock:
            self._waiting.append(_Arrival(self._clock.utc_ns(), key, payload))
            self._waiting_bytes += len(payload)
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        """Drop what exceeds the memory for waiting messages, under the lock."""
        while len(self._waiting) > WAITING or self._waiting_bytes > WAITING_BYTES:
            self._waiting_bytes -= len(self._waiting.popleft().payload)
            self.not_recorded += 1

    def set_alive(self, key: str, alive: bool) -> None:
        """Record a change of a liveliness token, as JSON under its key."""
        self.receive(key, b'{"alive": true}' if alive else b'{"alive": false}')

    def __enter__(self) -> ShopRecorder:
        self._folder.mkdir(parents=True, exist_ok=True)
        for path in recordings(self._folder, NAME):
            self._finisher.enqueue(path, self._clock.utc_ns())
        self._thread = threading.Thread(target=self._work, name="shop recorder")
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
        self._finisher.wait()

    def answer(self) -> tuple[dict[str, Any], str]:
        """Return what was recorded and lost, as JSON and as text."""
        missed = self.missed()
        result = {
            "files": [str(path) for path in self.files],
            "messages": self.messages,
            "not_recorded": self.not_recorded,
            "missed": missed,
        }
        lost = ", ".join(f"{count} of {key}" for key, count in missed.items()) or "none"
        text = f"{self.messages} messages in {len(self.files)} file(s) in {self._folder}; lost in transit: {lost}"
        if self.not_recorded:
            text += f"; not recorded, because the disk failed: {self.not_recorded}"
        if self._not_counted:
            text += f"; losses not counted beyond {MACHINES} machines: {self._not_counted} messages"
        return result, text

    def missed(self) -> dict[str, int]:
        """Return the number of lost messages of each key, by gaps in the sequence numbers."""
        found = {
            f"{prefix}/thermal/{rest}": one.missed
            for prefix, numbers in self._numbers.items()
            for rest, one in numbers.items()
        }
        return {key: count for key, count in sorted(found.items()) if count}

    # ------------------------------------------------------------------ on a separate thread

    def _work(self) -> None:
        while not self._ended:
            self._wake.wait(SYNC_S / 2.0)
            self._write_waiting()
        # The last messages, and those that could not be written before.
        if not self._write_waiting():
            with self._lock:
                self.not_recorded += len(self._waiting)
        try:
            self._finish()
        except OSError as error:
            log.error("compensator: the shop's recording could not be finished: %s", error)

    def _write_waiting(self) -> bool:
        """Write the waiting messages; return whether the disk accepted them."""
        with self._lock:
            batch = list(self._waiting)
            self._waiting.clear()
            self._waiting_bytes = 0
        try:
            self._write(batch)
        except OSError as error:
            self._give_up(batch, error)
            return False
        return True

    def _write(self, batch: list[_Arrival]) -> None:
        """Write a batch, each day to files of its own; remove written messages from the batch."""
        while batch:
            day, same = next(groupby(batch, lambda arrival: day_of(arrival.time_ns)))
            part = list(islice(same, PART))
            if self._file is None or day != self._day or self._file.is_full:
                self._finish()
                self._file, self._day = _File(self._folder, part[0].time_ns, self._prefix), day
            written = sum([self._file.add(arrival, self._numbered(arrival)) for arrival in part])
            self._file.sync()
            if self.files[-1:] != [self._file.path]:  # one that is given up before that is removed
                self.files.append(self._file.path)
            self.messages += written
            self.not_recorded += len(part) - written
            del batch[: len(part)]
            if self._failed:
                self._failed = False
                log.info("compensator: the shop's recording is being written again")

    def _numbered(self, arrival: _Arrival) -> tuple[str, int, int]:
        """Return kind, number and time of a message, and count it; `other` if it follows no schema."""
        prefix, _, rest = arrival.key.rpartition("/thermal/")
        kind = KINDS.get(rest, "")
        if rest == "alive":
            return "alive", 0, arrival.time_ns
        try:
            message = decoded(kind, arrival.payload) if kind else None
        except Malformed:
            message = None
        if message is None:
            return "other", 0, arrival.time_ns
        self._count(prefix, rest, kind, message)
        return kind, message.seq & 0xFFFFFFFF, message.time_utc_ns

    def _count(self, prefix: str, rest: str, kind: str, message: Any) -> None:
        """Count a message by its number; those of machines beyond `MACHINES` are recorded, but not counted."""
        if prefix not in self._numbers and len(self._numbers) >= MACHINES:
            self._not_counted += 1
            return
        numbers = self._numbers.setdefault(prefix, {})
        if kind in ("sample", "estimate") or axis_of(kind) is not None:
            numbers.setdefault(rest, Sequence()).update(message.seq, message.time_utc_ns)
        pause = pause_of(message) if kind == "event" else None
        if pause is not None and pause.missing is not None:
            for sequence in numbers.values():
                sequence.stood_still(pause.missing)
        started_ns = message.started_utc_ns if kind == "status" else 0
        if kind == "event" and message.kind == EventKind.START:
            started_ns = message.time_utc_ns
        for sequence in numbers.values() if started_ns else ():
            sequence.started(started_ns)

    def _give_up(self, batch: list[_Arrival], error: OSError) -> None:
        """Truncate the file to its last sync and queue the batch for another file."""
        file, self._file = self._file, None
        if file is not None:
            file.give_up()
        if not self._failed:
            self._failed = True
            log.error("compensator: the shop's recording cannot be written: %s", error)
        with self._lock:
            self._waiting.extendleft(reversed(batch))
            self._waiting_bytes += sum(len(arrival.payload) for arrival in batch)
            self._drop_oldest()

    def _finish(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        file.end(self.messages, self.not_recorded, self.missed(), self._clock.utc_ns())
        self._finisher.enqueue(file.path, self._clock.utc_ns())


def _compacted(path: Path) -> str:
    """Compact a shop's recording and describe the copy; empty if it was already compact."""
    copy = rewrite(path)
    if copy is None:
        return ""
    end = "" if copy.contents.ended else "; it had no end, every complete message was kept"
    return f"{copy.messages} messages, compact{end}"


class _File(LiveFile):
    """The file that is being written; channels are registered with their first message."""

    def __init__(self, folder: Path, time_ns: int, prefix: str) -> None:
        super().__init__(names(folder, NAME, time_ns))
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.writer.start(profile="", library=f"compensator {__version__}")
        metadata = {
            "prefix": prefix,
            "file": self.path.name,
            "compensator": __version__,
            "started_utc_ns": str(time_ns),
        }
        self.writer.add_metadata("shop", metadata)

    def add(self, arrival: _Arrival, numbered: tuple[str, int, int]) -> bool:
        """Write a message (log time: arrival; publish time: its own); return whether it has a channel."""
        kind, number, time_ns = numbered
        topic = f"/{OTHER if kind == 'other' else ''}{arrival.key}"
        channel = self._channels.get(topic)
        if channel is None:
            if len(self._channels) >= CHANNELS:
                return False
            channel = self._channels[topic] = self._register(topic, kind, arrival.key)
        self.writer.add_message(channel, arrival.time_ns, arrival.payload, time_ns, sequence=number)
        return True

    def _register(self, topic: str, kind: str, key: str) -> int:
        schema = 0
        if kind in ALL_MESSAGES or kind == "alive":
            if kind not in self._schemas:
                data = shipped_schema(kind) if kind in ALL_MESSAGES else ALIVE
                name = ALL_MESSAGES[kind].__name__ if kind in ALL_MESSAGES else "Alive"
                self._schemas[kind] = self.writer.register_schema(name, "jsonschema", data)
            schema = self._schemas[kind]
        encoding = "octet-stream" if kind == "other" else "json"
        about = {"key": key, "machine": key.rpartition("/thermal/")[0]}
        return self.writer.register_channel(topic, encoding, schema, about)

    def end(self, messages: int, not_recorded: int, missed: dict[str, int], time_ns: int) -> None:
        """Write the summary of lost messages and the end of the file, and close it."""
        summary = {"messages": messages, "not_recorded": not_recorded, "missed": missed}
        try:
            schema = self.writer.register_schema("ShopSummary", "jsonschema", SUMMARY)
            channel = self.writer.register_channel("/summary", "json", schema)
            self.writer.add_message(channel, time_ns, json.dumps(summary).encode(), time_ns)
            self.finish()
        except OSError:
            self.give_up()
            raise


#: Schema of the last message of a file.
SUMMARY = (
    b'{"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "thermal.shop_summary", "type": "object", '
    b'"properties": {"messages": {"type": "integer"}, "not_recorded": {"type": "integer"}, "missed": '
    b'{"type": "object", "additionalProperties": {"type": "integer"}}}, '
    b'"required": ["messages", "not_recorded", "missed"]}'
)
#: Schema of liveliness changes.
ALIVE = (
    b'{"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "thermal.alive", "type": "object", '
    b'"properties": {"alive": {"type": "boolean"}}, "required": ["alive"]}'
)
