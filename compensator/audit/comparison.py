"""What another model would have done on history: the recorded samples through the service with that model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from compensator.audit.findings import utc
from compensator.audit.recomputation import act, model_of, raw_of
from compensator.audit.recording_audit import recorded_groups
from compensator.audit.verification import Record
from compensator.clock import NS
from compensator.config import Config
from compensator.errors import DataError, ServiceError
from compensator.messages import Event, Sample, number
from compensator.model.thermal_model import ThermalModel
from compensator.reasons import Remark
from compensator.recording.container import PAYLOAD, Container
from compensator.report.history import Spread
from compensator.service.compensation import Compensation, Outcome

#: Columns of the table of both offsets.
COLUMNS = (
    "time_utc",
    "seq",
    "y_um",
    "y_offset_um",
    "residual_um",
    "other_y_um",
    "other_y_offset_um",
    "other_residual_um",
    "other_state",
)


class _Estimate(msgspec.Struct):
    """What is needed of a recorded estimate."""

    t_q_ref_degc: float | None
    at_ref_degc: float | None
    y_ref_um: float | None
    y_base_um: float
    y_um: float | None
    residual_um: float | None


class _Offset(msgspec.Struct):
    """What is needed of a recorded offset."""

    y_offset_um: float | None


_SAMPLE, _EVENT = msgspec.json.Decoder(Sample), msgspec.json.Decoder(Event)
_ESTIMATE, _OFFSET = msgspec.json.Decoder(_Estimate), msgspec.json.Decoder(_Offset)


@dataclass(slots=True)
class Comparison:
    """The recorded model beside another one.

    Parameters
    ----------
    recorded, other : str
        Names of the models.
    residual_before, residual_after : Spread
        Measured − predicted deformation.
    left_before, left_after : Spread
        What is left of the measured deformation with the offset.
    offsets : Spread
        The other offset − the recorded one.
    samples : int
        Number of samples.
    remarks : list of Remark
        What the figures depend on.
    """

    recorded: str
    other: str
    residual_before: Spread
    residual_after: Spread
    left_before: Spread
    left_after: Spread
    offsets: Spread
    samples: int
    remarks: list[Remark]

    def as_json(self) -> dict[str, Any]:
        """Return it as it stands in the result of `--json`."""
        return {
            "recorded_model": self.recorded,
            "other_model": self.other,
            "samples": self.samples,
            "residual_um": {"before": _spread_json(self.residual_before), "after": _spread_json(self.residual_after)},
            "left_um": {"before": _spread_json(self.left_before), "after": _spread_json(self.left_after)},
            "offset_difference_um": _spread_json(self.offsets),
            "remarks": list(self.remarks),
            "remark_codes": [remark.code for remark in self.remarks],
        }

    def text(self) -> str:
        """Return a table for people."""
        rows = [
            (f"residual, {self.recorded} (recorded)", self.residual_before),
            (f"residual, {self.other}", self.residual_after),
            (f"left with the offset, {self.recorded} (recorded)", self.left_before),
            (f"left with the offset, {self.other}", self.left_after),
            (f"offset of {self.other} − recorded offset", self.offsets),
        ]
        width = max(len(name) for name, _ in rows)
        lines = [
            f"{self.samples} samples; y_um was measured in {self.residual_before.samples} of them",
            f"{'':<{width}} {'rms µm':>9} {'peak µm':>9} {'samples':>9}  worst at",
        ]
        for name, spread in rows:
            figures = f"{spread.rms:9.3f} {abs(spread.peak):9.3f}" if spread.samples else f"{'–':>9} {'–':>9}"
            worst = worst_utc(spread) if spread.samples else "–"
            lines.append(f"{name:<{width}} {figures} {spread.samples:9d}  {worst}")
        return "\n".join([*lines, *(f"remark: {remark.marked}" for remark in self.remarks)])


def compare(
    paths: Sequence[Path],
    model: ThermalModel,
    *,
    progress: Callable[[int, int], None] | None = None,
    row: Callable[[Iterable[Any]], Any] | None = None,
    point: Callable[..., None] | None = None,
) -> Comparison:
    """Run another model over recordings, in the order in which they were begun.

    Parameters
    ----------
    paths : sequence of pathlib.Path
        Recordings of one machine.
    model : ThermalModel
        The other model.
    progress : callable, optional
        Called with the number of bytes worked off, and of all.
    row : callable, optional
        Takes the rows of the table of both offsets, see `COLUMNS`.
    point : callable, optional
        Takes time (ns), and measured deformation and offset with the recorded and with the other model, µm.

    Raises
    ------
    DataError
        If one of them is no recording, they belong to several machines, or the model needs a channel that is not there.
    """
    ordered = _in_order(paths)
    whole = sum(path.stat().st_size for path in ordered)
    run = _Run(model, row, point)
    done = 0
    for path in ordered:
        with Container(path) as container:
            for count, records in enumerate(recorded_groups(container)):
                run.group(records, container, path.name)
                if progress is not None and count % 1000 == 0:
                    progress(done + container.position, whole)
        done += path.stat().st_size
    return run.result(ordered)


def _in_order(paths: Sequence[Path]) -> list[Path]:
    began: dict[Path, str] = {}
    machines = set()
    for path in dict.fromkeys(paths):
        with Container(path) as container:
            for _ in recorded_groups(container):
                break
            run = container.contents.metadata.get("run", {})
        machines.add(run.get("machine", ""))
        began[path] = run.get("file", path.name).removesuffix(".mcap")
    if len(machines) > 1:
        raise DataError(f"recordings of {', '.join(sorted(machines))}; expected those of one machine")
    return sorted(began, key=began.__getitem__)


class _Run:
    def __init__(
        self, model: ThermalModel, row: Callable[[Iterable[Any]], Any] | None, point: Callable[..., None] | None
    ) -> None:
        self._model, self._row, self._point = model, row, point
        self._compensation: Compensation | None = None
        self._config = self._recorded = b""
        self._last_ns = 0
        self._names: dict[str, None] = {}
        self._result = Comparison("", model.name, Spread(), Spread(), Spread(), Spread(), Spread(), 0, [])

    def group(self, records: list[Record], container: Container, file: str) -> None:
        """Take one group in."""
        bodies = {record.topic: record.body[PAYLOAD:] for record in records if record.topic != "event"}
        try:
            events = [_EVENT.decode(record.body[PAYLOAD:]) for record in records if record.topic == "event"]
            if "sample" not in bodies or "estimate" not in bodies or "offset" not in bodies:
                return
            sample = _SAMPLE.decode(bodies["sample"])
            estimate, offset = _ESTIMATE.decode(bodies["estimate"]), _OFFSET.decode(bodies["offset"])
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise DataError(f"{file}: record {records[0].sequence}: {error}") from error
        compensation = self._ready(container, file, events, estimate)
        if self._last_ns:
            # What nobody recorded counts as missing, as it does in the service.
            compensation.pause(round((sample.time_utc_ns - self._last_ns) / (sample.period_s * 1e9)) - 1)
        self._last_ns = sample.time_utc_ns
        for event in events:
            if event.seq == sample.seq:
                act(compensation, event)
        try:
            outcome = compensation.process(raw_of(sample))
        except (KeyError, AttributeError, TypeError) as error:
            raise DataError(f"{file}: /sample {sample.seq}: {error}; expected the configured channels") from error
        self._add(sample, estimate, offset, outcome)

    def _ready(self, container: Container, file: str, events: list[Event], estimate: _Estimate) -> Compensation:
        """Return the compensation with the other model and the configuration of the file."""
        parts = [container.contents.attachments.get(name) for name in ("config.toml", "model.toml")]
        data, model = (part.data if part else b"" for part in parts)
        if self._compensation is not None and (data, model) == (self._config, self._recorded):
            return self._compensation
        config, recorded = model_of(container.contents, file)
        self._names[recorded.name], self._recorded = None, model
        if self._compensation is not None and data == self._config:
            return self._compensation
        compensation = self._made(config)
        zero = any(event.kind == "zero" for event in events)
        if estimate.t_q_ref_degc is not None and estimate.at_ref_degc is not None and not zero:
            warm = estimate.y_base_um != 0.0
            compensation.begin(
                t_q_ref_degc=estimate.t_q_ref_degc,
                at_ref_degc=estimate.at_ref_degc,
                y_ref_um=math.nan if warm else number(estimate.y_ref_um),
                y_base_um=0.0,
            )
            figures = (
                f"{file}: begins on a running machine, of which the other model knows no more than the zero; "
                f"its first {3 * compensation.slowest_min / 60.0:.0f} h are uncertain."
            )
            self._result.remarks.append(Remark("begins_running", figures))
        self._compensation, self._config, self._last_ns = compensation, data, 0
        return compensation

    def _made(self, config: Config) -> Compensation:
        try:
            return Compensation(config, self._model)
        except ServiceError as error:
            raise DataError(f"{error} in the recording") from error

    def _add(self, sample: Sample, estimate: _Estimate, offset: _Offset, outcome: Outcome) -> None:
        result, time_ns = self._result, sample.time_utc_ns
        at_s = time_ns / NS
        y, other_y = number(estimate.y_um), number(outcome.estimate.y_um)
        before, after = number(estimate.residual_um), number(outcome.estimate.residual_um)
        recorded, other = number(offset.y_offset_um), number(outcome.offset.y_offset_um)
        result.samples += 1
        if not math.isnan(before) and not math.isnan(after):
            result.residual_before.add(before, at_s)
            result.residual_after.add(after, at_s)
        if not math.isnan(y + recorded) and not math.isnan(other_y + other):
            result.left_before.add(y + recorded, at_s)
            result.left_after.add(other_y + other, at_s)
        result.offsets.add(other - recorded, at_s)
        if self._point is not None:
            self._point(time_ns, y, recorded, other_y, other)
        if self._row is not None:
            values = (y, recorded, before, other_y, other, after)
            cells = ["" if math.isnan(value) else repr(value) for value in values]
            self._row([utc(time_ns), sample.seq, *cells, outcome.offset.state])

    def result(self, paths: Sequence[Path]) -> Comparison:
        """Return the figures; the files are named where there are none."""
        if not self._result.samples:
            names = ", ".join(path.name for path in paths[:3])
            raise DataError(f"{names}: no samples in it, expected recordings of a machine's service")
        self._result.recorded = ", ".join(self._names)
        return self._result


def worst_utc(spread: Spread) -> str:
    """Return when the largest amount of something was, as ISO 8601."""
    return utc(round(spread.at_s * NS))


def _spread_json(spread: Spread) -> dict[str, Any]:
    there = spread.samples > 0
    return {
        "samples": spread.samples,
        "rms_um": spread.rms if there else None,
        "peak_um": abs(spread.peak) if there else None,
        "worst_time_utc": worst_utc(spread) if there else None,
    }
