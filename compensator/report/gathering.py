"""Reads recordings of a machine in one pass into a history of bounded size."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UnsetType

from compensator.axes import FIRST
from compensator.codes import RecordingEnd, State
from compensator.errors import DataError
from compensator.input_file import parse_toml
from compensator.messages import EstimateMessage, Event, Offset, Probe, Sample, number
from compensator.messages_axes import UNITS, AxesEstimate, AxisOffset, RecordedOffsets
from compensator.model.effects.base import label_of
from compensator.recording.container import Container, Contents, Damaged, Torn
from compensator.recording.reading import decode, in_order, records_of
from compensator.report.envelope import Envelope, Stretches
from compensator.report.history import (
    EPISODES,
    EVENTS,
    NO_RECORDING,
    PROBES,
    Episode,
    File,
    History,
    Missed,
    Period,
    ProbeShown,
)

_NS = 1e-9
_DAY_S = 86400.0
#: Number of values that are added to a curve in one call.
_TOGETHER = 5000
#: Samples farther apart than this number of periods are separated by time without a recording.
_GAP = 1.5


def read_history(paths: Sequence[Path], *, progress: Callable[[int, int], None] | None = None) -> History:
    """Read recordings of one machine.

    Parameters
    ----------
    paths : sequence of pathlib.Path
        In any order.
    progress : callable, optional
        Called with the number of bytes read and their total.

    Raises
    ------
    DataError
        If a file is not a recording, there are no samples, or the files belong to several machines.
    """
    ordered = in_order(paths)
    total = sum(path.stat().st_size for path in ordered)
    reader, done = _Reader(), 0
    for path in ordered:
        with Container(path) as container:
            for i in reader.file(path.name, container):
                if progress is not None and i % 1000 == 0:
                    progress(done + container.position, total)
        done += path.stat().st_size
    return reader.result()


class _Reader:
    """Builds a history from messages in order."""

    def __init__(self) -> None:
        self.history = History()
        self._add: dict[str, Callable[[Any], None]] = {
            "sample": self._sample,
            "estimate": self._estimate,
            "offsets": self._axes,
            "offset": self._offset,
            "event": self._event,
            "probe": self._probe,
        }
        self._buffers: dict[str, tuple[list[float], list[float]]] = {}
        self._period_s = 60.0
        #: End of the last offset's sample; number and measured Y of the last estimate.
        self._last_s = math.nan
        self._measured = (-1, math.nan)
        #: Values of further axes in the last estimate of a machine of several.
        self._of_axes: tuple[int, dict[str, Any]] = (-1, {})
        #: Offsets of further axes that come before that of Y with the same number.
        self._further: list[AxisOffset] = []
        self._episode: Episode | None = None
        self._numbers = count()
        self._effects: list[str] = []
        self._model = ""
        self._days: dict[int, Period] = {}

    def file(self, name: str, container: Container) -> Iterator[int]:
        """Add a file, message by message."""
        file = File(name)
        self.history.files.append(file)
        try:
            for i, record in enumerate(records_of(container)):
                if i == 0:
                    self._opening(container.contents)
                add = self._add.get(record.topic)
                if add is not None:
                    message = decode(record, name)
                    if record.topic == "sample":
                        file.add(message.time_utc_ns * _NS)
                    add(message)
                yield i
            file.end = RecordingEnd.FINISHED if container.contents.ended else RecordingEnd.OPEN
        except Torn:
            file.end = RecordingEnd.OPEN
        except Damaged as damage:
            file.end = f"damaged from byte {damage.offset} on"

    def result(self) -> History:
        """Return the history."""
        for name in self._buffers:
            self._flush(name)
        self._close()
        history = self.history
        if not history.whole.samples or not history.states:
            names = ", ".join(file.name for file in history.files[:3])
            raise DataError(f"{names}: no samples; expected recordings of a machine's service")
        history.episodes.sort(key=lambda episode: episode.number)
        return history

    # ------------------------------------------------------------------ messages

    def _opening(self, contents: Contents) -> None:
        """Read the names of the machine, the model and its effects."""
        self.history.machine = contents.metadata.get("run", {}).get("machine", "") or self.history.machine
        part = contents.attachments.get("model.toml")
        self._model, self._effects = "", []
        # It may have been made by anybody.
        with suppress(ValueError, AttributeError, TypeError, KeyError):
            table = parse_toml(part.data) if part else {}
            self._model = str(table.get("name", ""))
            own = table.get("axis", {}).get(FIRST, table)  # of several axes: those of Y
            self._effects = _numbered([label_of(effect) for effect in own.get("effect", [])])

    def _sample(self, sample: Sample) -> None:
        t = sample.time_utc_ns * _NS
        self._period_s = sample.period_s
        self.history.whole.samples += 1
        self._day(t).samples += 1
        for name, channel in sample.channels.items():
            good = channel.is_good
            self._append(f"channel {name}", t, number(channel.mean) if good else math.nan)
            missed = self.history.channels.get(name)
            if missed is None:
                missed = self.history.channels[name] = Missed()
            missed.samples += 1
            if not good:
                missed.missing += 1
                missed.qualities[channel.quality] += 1
            if channel.errors:
                missed.errors.update(channel.errors)

    def _estimate(self, estimate: EstimateMessage) -> None:
        t = estimate.time_utc_ns * _NS
        shares = {"DTF": number(estimate.y_dtf_um), "TDTF": number(estimate.y_tdtf_um)}
        for i, value in enumerate(estimate.y_effects_um):
            shares[self._effects[i] if i < len(self._effects) else f"effect {i + 1}"] = value
        level_um = estimate.level_um or 0.0
        at_zero_um = estimate.y_base_um + level_um
        if at_zero_um or "share at the zero" in self._buffers:
            shares["at the zero"] = -at_zero_um
        if level_um or "share level" in self._buffers:
            shares["level"] = level_um
        if self.history.probes_count:
            # Zero before the first probe taken; the prediction is the sum of all shares.
            modelled = (number(estimate.y_dtf_um), number(estimate.y_tdtf_um), *estimate.y_effects_um)
            shares["probes"] = number(estimate.y_pred_um) - math.fsum((*modelled, -estimate.y_base_um))
        for name, value in shares.items():
            self._append(f"share {name}", t, value)
        y, residual = number(estimate.y_um), number(estimate.residual_um)
        for name, value in (
            ("heat", number(estimate.heat_w)),
            ("predicted", number(estimate.y_pred_um)),
            ("measured", y),
            ("residual", residual),
        ):
            self._append(name, t, value)
        for period in (self.history.whole, self._day(t)):
            period.residual.add(residual, t)
            period.measured.add(y, t)
        self._measured = (estimate.seq, y)
        if isinstance(estimate, AxesEstimate):
            self._of_axes = (estimate.seq, estimate.axes)

    def _offset(self, offset: Offset) -> None:
        t, history = offset.time_utc_ns * _NS, self.history
        y_offset, std = number(offset.y_offset_um), number(offset.y_offset_std_um)
        y = self._measured[1] if self._measured[0] == offset.seq else math.nan
        self._append("offset", t, y_offset)
        self._append("left", t, y + y_offset)
        if offset.model_sha256 not in history.models:
            history.models[offset.model_sha256] = (self._model, t)
        first = t - self._period_s
        if abs(first - self._last_s) <= (_GAP - 1.0) * self._period_s:
            first = self._last_s
        elif first > self._last_s:
            self._extend("", (), self._last_s, first)
        history.in_force.setdefault(offset.model_sha256, Stretches()).add(first, t)
        self._extend(offset.state, tuple(offset.reasons), first, t)
        for one in self._further:
            if one.seq == offset.seq and one.state != offset.state:
                history.apart.setdefault((one.axis, one.state), Stretches()).add(first, t)
                history.apart_seconds[one.axis, one.state] += t - first
        self._further = []
        self._last_s = t
        for period in (history.whole, self._day(t)):
            period.seconds[offset.state] += t - first
            period.offset.add(y_offset, t)
            period.left.add(y + y_offset, t)
            period.std.add(std, t)
        self._slope(offset)

    def _axes(self, offsets: RecordedOffsets) -> None:
        """Add the offsets of further axes."""
        self._further = offsets.messages()
        for offset in self._further:
            self._axis(offset)

    def _axis(self, offset: AxisOffset) -> None:
        values = self._of_axes[1] if self._of_axes[0] == offset.seq else {}
        name = f"{offset.axis}_{UNITS[offset.axis]}"
        measured, residual = (number(values.get(key)) for key in (name, f"{offset.axis}_residual_um"))
        self._add_output(offset.axis, offset, number(offset.y_offset_um), measured, residual)
        self._slope(offset)

    def _slope(self, offset: Offset) -> None:
        if isinstance(offset, AxisOffset) and not isinstance(offset.y_slope_um_per_m, UnsetType):
            self._add_output(f"{offset.axis}_slope", offset, number(offset.y_slope_um_per_m), math.nan, math.nan)

    def _add_output(self, name: str, offset: Offset, value: float, measured: float, residual: float) -> None:
        t = offset.time_utc_ns * _NS
        figures = self.history.axes.setdefault(name, Period())
        figures.samples += 1
        figures.seconds[offset.state] += 1
        self.history.axis_reasons[name].update(offset.reasons)
        for spread, one in (("offset", value), ("measured", measured), ("residual", residual)):
            getattr(figures, spread).add(one, t)
        figures.left.add(measured + value, t)
        for curve, one in (("offset", value), ("measured", measured), ("left", measured + value)):
            self._append(f"axis {name} {curve}", t, one)

    def _probe(self, probe: Probe) -> None:
        history, deformation_um = self.history, number(probe.deformation_um)
        shown = ProbeShown(
            at_s=probe.time_utc_ns * _NS,
            feature=probe.feature,
            deformation_um=deformation_um,
            left_um=number(probe.measured_um),
            predicted_um=deformation_um - number(probe.innovation_um),
            taken=probe.taken,
            code=probe.code,
        )
        history.probes = [*history.probes[1 - PROBES :], shown]
        history.probes_count += 1
        if probe.taken:
            history.probes_taken += 1
            history.probes_left.add(shown.left_um, shown.at_s)
            self._day(shown.at_s).probed.add(shown.left_um, shown.at_s)

    def _event(self, event: Event) -> None:
        self.history.story.add(event)
        self.history.events_count += 1
        self.history.events = [*self.history.events[1 - EVENTS :], (event.time_utc_ns * _NS, event.kind, event.text)]

    # ------------------------------------------------------------------ gathering

    def _extend(self, state: str, reasons: tuple[str, ...], first: float, last: float) -> None:
        """Add an interval in a state, or without a recording."""
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
            self._episode = replace(episode, seconds=episode.seconds + last - first, last_s=last)
            return
        self._close()
        if state != State.OK:
            self._episode = Episode(last - first, next(self._numbers), first, last, state, reasons)

    def _close(self) -> None:
        """End the current episode and keep it if it is one of the longest."""
        if self._episode is None:
            return
        self.history.episodes_count += 1
        heapq.heappush(self.history.episodes, self._episode)
        if len(self.history.episodes) > EPISODES:
            heapq.heappop(self.history.episodes)
        self._episode = None

    def _append(self, name: str, t: float, value: float) -> None:
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
        # The sample that ends at midnight belongs to the day before.
        number_of_day = int((t - 1e-3) // _DAY_S)
        day = self._days.get(number_of_day)
        if day is None:
            date = datetime.fromtimestamp(number_of_day * _DAY_S, UTC).date().isoformat()
            day = self._days[number_of_day] = self.history.days.setdefault(date, Period())
        return day


def _numbered(labels: Sequence[str]) -> list[str]:
    """Return labels with a number behind each that is there already: a model may have two effects of one kind."""
    numbers = [labels[: i + 1].count(label) for i, label in enumerate(labels)]
    return [label if number == 1 else f"{label} {number}" for label, number in zip(labels, numbers, strict=True)]
