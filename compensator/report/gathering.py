"""Reads recordings of a machine in one pass: what they tell, and no more of it than a page can show."""

from __future__ import annotations

import heapq
import math
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from compensator.errors import DataError
from compensator.messages import number
from compensator.recording.container import PAYLOAD, Container, Contents, Damaged, Torn
from compensator.recording.reading import in_order
from compensator.report.envelope import Envelope, Stretches
from compensator.report.history import EPISODES, EVENTS, NO_RECORDING, Episode, File, History, Missed, Period

_NS = 1e-9
_DAY_S = 86400.0
#: Values of a curve that are brought to it together.
_TOGETHER = 5000
#: A distance of more periods between two samples is time without a recording.
_GAP = 1.5
_UNREADABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


class _Channel(msgspec.Struct):
    mean: float | None
    quality: str
    errors: dict[str, int] = {}


class _Sample(msgspec.Struct):
    seq: int
    time_utc_ns: int
    period_s: float
    channels: dict[str, _Channel]


class _Estimate(msgspec.Struct):
    seq: int
    time_utc_ns: int
    heat_w: float | None
    y_dtf_um: float | None
    y_tdtf_um: float | None
    y_effects_um: list[float]
    y_base_um: float
    y_pred_um: float | None
    y_um: float | None
    residual_um: float | None


class _Offset(msgspec.Struct):
    seq: int
    time_utc_ns: int
    y_offset_um: float | None
    y_offset_std_um: float | None
    state: str
    reasons: list[str]
    model_sha256: str


class _Event(msgspec.Struct):
    time_utc_ns: int
    kind: str
    text: str


_DECODERS: dict[str, msgspec.json.Decoder[Any]] = {
    name: msgspec.json.Decoder(kind)
    for name, kind in (("sample", _Sample), ("estimate", _Estimate), ("offset", _Offset), ("event", _Event))
}


def read_history(paths: Sequence[Path], *, progress: Callable[[int, int], None] | None = None) -> History:
    """Read recordings of one machine.

    Parameters
    ----------
    paths : sequence of pathlib.Path
        In any order.
    progress : callable, optional
        Called with the number of bytes read, and of all.

    Raises
    ------
    DataError
        If one of them is no recording, there are no samples, or they are of several machines.
    """
    ordered = in_order(paths)
    whole = sum(path.stat().st_size for path in ordered)
    reader, done = _Reader(), 0
    for path in ordered:
        with Container(path) as container:
            for i in reader.file(path.name, container):
                if progress is not None and i % 1000 == 0:
                    progress(done + container.position, whole)
        done += path.stat().st_size
    return reader.result()


class _Reader:
    """Takes messages in, one after the other."""

    def __init__(self) -> None:
        self.history = History()
        self._take: dict[str, Callable[[Any], None]] = {
            "sample": self._sample,
            "estimate": self._estimate,
            "offset": self._offset,
            "event": self._event,
        }
        self._buffers: dict[str, tuple[list[float], list[float]]] = {}
        self._period_s = 60.0
        #: End of the last offset's sample; number of the last estimate, and what it measured.
        self._last_s = math.nan
        self._measured = (-1, math.nan)
        self._episode: Episode | None = None
        self._numbers = count()
        self._effects: list[str] = []
        self._model = ""
        self._days: dict[int, Period] = {}

    def file(self, name: str, container: Container) -> Iterator[int]:
        """Take a file in, message by message."""
        file = File(name)
        self.history.files.append(file)
        topics: dict[int, str] = {}
        try:
            for i, (channel, sequence, _, body) in enumerate(container.messages()):
                topic = topics.get(channel)
                if topic is None:
                    topic = topics[channel] = container.contents.channels[channel].topic.lstrip("/")
                    self._opening(container.contents)
                decoder = _DECODERS.get(topic)
                if decoder is not None:
                    try:
                        message = decoder.decode(body[PAYLOAD:])
                    except _UNREADABLE as error:
                        raise DataError(f"{name}: /{topic} record {sequence}: {error}") from error
                    if topic == "sample":
                        file.add(message.time_utc_ns * _NS)
                    self._take[topic](message)
                yield i
            file.end = "finished" if container.contents.ended else "no end"
        except Torn:
            file.end = "no end"
        except Damaged as damage:
            file.end = f"damaged from byte {damage.offset} on"

    def result(self) -> History:
        """Return what was gathered."""
        for name in self._buffers:
            self._flush(name)
        self._close()
        history = self.history
        if not history.whole.samples or not history.states:
            names = ", ".join(file.name for file in history.files[:3])
            raise DataError(f"{names}: no samples in it, expected recordings of a machine's service")
        history.episodes.sort(key=lambda episode: episode.number)
        return history

    # ------------------------------------------------------------------ messages

    def _opening(self, contents: Contents) -> None:
        """Learn the machine's name, and those of the model and its effects."""
        self.history.machine = contents.metadata.get("run", {}).get("machine", "") or self.history.machine
        part = contents.attachments.get("model.toml")
        try:
            table = tomllib.loads(part.data.decode()) if part else {}
        except (tomllib.TOMLDecodeError, UnicodeDecodeError):
            table = {}
        self._model = str(table.get("name", ""))
        self._effects = [
            " ".join(str(effect[key]) for key in ("kind", "path", "channel") if effect.get(key))
            for effect in table.get("effect", [])
        ]

    def _sample(self, sample: _Sample) -> None:
        t = sample.time_utc_ns * _NS
        self._period_s = sample.period_s
        self.history.whole.samples += 1
        self._day(t).samples += 1
        for name, channel in sample.channels.items():
            good = channel.quality == "good"
            self._put(f"channel {name}", t, number(channel.mean) if good else math.nan)
            missed = self.history.channels.get(name)
            if missed is None:
                missed = self.history.channels[name] = Missed()
            missed.samples += 1
            if not good:
                missed.missing += 1
                missed.qualities[channel.quality] += 1
            if channel.errors:
                missed.errors.update(channel.errors)

    def _estimate(self, estimate: _Estimate) -> None:
        t = estimate.time_utc_ns * _NS
        shares = {"DTF": number(estimate.y_dtf_um), "TDTF": number(estimate.y_tdtf_um)}
        for i, value in enumerate(estimate.y_effects_um):
            shares[self._effects[i] if i < len(self._effects) else f"effect {i + 1}"] = value
        if estimate.y_base_um or "share zero on a warm machine" in self._buffers:
            shares["zero on a warm machine"] = -estimate.y_base_um
        for name, value in shares.items():
            self._put(f"share {name}", t, value)
        y, residual = number(estimate.y_um), number(estimate.residual_um)
        for name, value in (
            ("heat", number(estimate.heat_w)),
            ("predicted", number(estimate.y_pred_um)),
            ("measured", y),
            ("residual", residual),
        ):
            self._put(name, t, value)
        for period in (self.history.whole, self._day(t)):
            period.residual.add(residual, t)
            period.measured.add(y, t)
        self._measured = (estimate.seq, y)

    def _offset(self, offset: _Offset) -> None:
        t, history = offset.time_utc_ns * _NS, self.history
        y_offset, std = number(offset.y_offset_um), number(offset.y_offset_std_um)
        y = self._measured[1] if self._measured[0] == offset.seq else math.nan
        self._put("offset", t, y_offset)
        self._put("left", t, y + y_offset)
        if offset.model_sha256 not in history.models:
            history.models[offset.model_sha256] = (self._model, t)
        first = t - self._period_s
        if abs(first - self._last_s) <= (_GAP - 1.0) * self._period_s:
            first = self._last_s
        elif first > self._last_s:
            self._stood("", (), self._last_s, first)
        self._stood(offset.state, tuple(offset.reasons), first, t)
        self._last_s = t
        for period in (history.whole, self._day(t)):
            period.seconds[offset.state] += t - first
            period.offset.add(y_offset, t)
            period.left.add(y + y_offset, t)
            period.std.add(std, t)

    def _event(self, event: _Event) -> None:
        self.history.events_count += 1
        self.history.events = [*self.history.events[1 - EVENTS :], (event.time_utc_ns * _NS, event.kind, event.text)]

    # ------------------------------------------------------------------ gathering

    def _stood(self, state: str, reasons: tuple[str, ...], first: float, last: float) -> None:
        """Take in that a state stood, or that nothing was recorded."""
        history = self.history
        if not state:
            history.whole.seconds[NO_RECORDING] += last - first
            self._day(first).seconds[NO_RECORDING] += last - first
        history.states.setdefault(state or NO_RECORDING, Stretches()).add(first, last)
        for reason in reasons:
            history.reasons.setdefault(reason, Stretches()).add(first, last)
            history.reason_seconds[reason] += last - first
        episode = self._episode
        if episode is not None and (episode.state, episode.reasons) == (state, reasons):
            self._episode = replace(episode, seconds=last - episode.first_s, last_s=last)
            return
        self._close()
        if state != "ok":
            self._episode = Episode(last - first, next(self._numbers), first, last, state, reasons)

    def _close(self) -> None:
        """Keep the episode that is over, where it is one of the longest."""
        if self._episode is None:
            return
        self.history.episodes_count += 1
        heapq.heappush(self.history.episodes, self._episode)
        if len(self.history.episodes) > EPISODES:
            heapq.heappop(self.history.episodes)
        self._episode = None

    def _put(self, name: str, t: float, value: float) -> None:
        buffer = self._buffers.get(name)
        if buffer is None:
            buffer = self._buffers[name] = ([], [])
        times, values = buffer
        times.append(t)
        values.append(value)
        if len(times) >= _TOGETHER:
            self._flush(name)

    def _flush(self, name: str) -> None:
        times, values = self._buffers[name]
        curve = self.history.curves.setdefault(name, Envelope(period_s=self._period_s))
        curve.add(np.array(times), np.array(values, dtype=np.float64))
        times.clear()
        values.clear()

    def _day(self, t: float) -> Period:
        # The sample that ends at midnight is the last of the day before.
        number_of_day = int((t - 1e-3) // _DAY_S)
        day = self._days.get(number_of_day)
        if day is None:
            date = datetime.fromtimestamp(number_of_day * _DAY_S, UTC).date().isoformat()
            day = self._days[number_of_day] = self.history.days.setdefault(date, Period())
        return day
