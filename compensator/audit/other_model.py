"""What another model would have done: the recorded samples through the service's compensation with that model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from compensator.audit.findings import utc
from compensator.audit.recording_audit import not_left_by_a_kill
from compensator.axes import column_of, label_of
from compensator.clock import NS
from compensator.codes import AuditRemark, Remark
from compensator.config import Config
from compensator.errors import DataError, ModelError, ServiceError
from compensator.events import EventKind
from compensator.messages import EstimateMessage, Offset, number
from compensator.messages_axes import AxesEstimate, further_values
from compensator.model.thermal_model import ThermalModel
from compensator.recording.container import Container, Contents, Damaged
from compensator.recording.reading import in_order
from compensator.report.history import Spread
from compensator.service.compensation import Compensation, Outcome, model_of
from compensator.service.replay import ForeignRun, RecordedStep, setup_of, steps_until_damage
from compensator.service.status import Zero

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


@dataclass(slots=True)
class AxisComparison:
    """Figures of a further axis that was measured, as those of Y in `OtherModel`."""

    residual_before: Spread = field(default_factory=Spread)
    residual_after: Spread = field(default_factory=Spread)
    left_before: Spread = field(default_factory=Spread)
    left_after: Spread = field(default_factory=Spread)
    offsets: Spread = field(default_factory=Spread)

    def add(self, at_s: float, recorded: Sequence[float], other: Sequence[float]) -> None:
        """Add a sample: measured deformation, offset and residual with each model, µm."""
        (y, offset, before), (other_y, other_offset, after) = recorded, other
        if not math.isnan(before) and not math.isnan(after):
            self.residual_before.add(before, at_s)
            self.residual_after.add(after, at_s)
        if not math.isnan(y + offset) and not math.isnan(other_y + other_offset):
            self.left_before.add(y + offset, at_s)
            self.left_after.add(other_y + other_offset, at_s)
        self.offsets.add(other_offset - offset, at_s)

    def as_json(self) -> dict[str, Any]:
        """Return the figures for `--json`."""
        return {
            "residual_um": {"before": _spread_json(self.residual_before), "after": _spread_json(self.residual_after)},
            "left_um": {"before": _spread_json(self.left_before), "after": _spread_json(self.left_after)},
            "offset_difference_um": _spread_json(self.offsets),
        }

    def rows(self, recorded: str, other: str) -> dict[str, Spread]:
        """Return the figures with their names, in the order in which they are shown."""
        return {
            f"residual, {recorded} (recorded)": self.residual_before,
            f"residual, {other}": self.residual_after,
            f"remaining error, {recorded} (recorded)": self.left_before,
            f"remaining error, {other}": self.left_after,
            f"offset of {other} − recorded offset": self.offsets,
        }


@dataclass(slots=True)
class OtherModel:
    """The recorded model compared with another one.

    Parameters
    ----------
    recorded, other : str
        Names of the models.
    own : AxisComparison
        Figures of Y: residual (measured − predicted), remaining error (measured + offset), the other offset − the
        recorded one.
    samples : int
        Number of samples.
    remarks : list of Remark
        Remarks on the validity of the figures.
    axes : dict of str to AxisComparison
        Further axes that were measured.
    only_y : str
        Why a machine of several axes was compared on Y alone; empty otherwise.
    """

    recorded: str
    other: str
    own: AxisComparison = field(default_factory=AxisComparison)
    samples: int = 0
    remarks: list[Remark] = field(default_factory=list)
    axes: dict[str, AxisComparison] = field(default_factory=dict)
    only_y: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the result for `--json`."""
        return {
            "recorded_model": self.recorded,
            "other_model": self.other,
            "samples": self.samples,
            **self.own.as_json(),
            "remarks": list(self.remarks),
            "remark_codes": [remark.code for remark in self.remarks],
            **({"axes": {axis: one.as_json() for axis, one in self.axes.items()}} if self.axes else {}),
            **({"only_y": self.only_y} if self.only_y else {}),
        }

    def rows(self) -> dict[str, Spread]:
        """Return the figures with their names, in the order in which they are shown."""
        rows = self.own.rows(self.recorded, self.other)
        for axis, one in self.axes.items():
            rows |= {
                f"{label_of(axis)}: {name}": spread for name, spread in one.rows(self.recorded, self.other).items()
            }
        return rows

    def text(self) -> str:
        """Return a table for people."""
        rows = self.rows()
        width = max(map(len, rows))
        lines = [
            f"{self.samples} samples; {self.own.residual_before.samples} of them have a residual with both models",
            f"{'':<{width}} {'rms µm':>9} {'peak µm':>9} {'samples':>9}  worst at",
        ]
        for name, spread in rows.items():
            figures = f"{spread.rms:9.3f} {abs(spread.peak):9.3f}" if spread.samples else f"{'–':>9} {'–':>9}"
            worst = worst_utc(spread) if spread.samples else "–"
            lines.append(f"{name:<{width}} {figures} {spread.samples:9d}  {worst}")
        if self.only_y:
            lines.append(f"compared on Y alone: {self.only_y}")
        return "\n".join([*lines, *(f"remark: {remark.marked}" for remark in self.remarks)])


def compare(
    paths: Sequence[Path],
    model: ThermalModel,
    *,
    progress: Callable[[int, int], None] | None = None,
    row: Callable[[Iterable[Any]], Any] | None = None,
    point: Callable[..., None] | None = None,
    data: bytes = b"",
) -> OtherModel:
    """Run another model over recordings, in the order of their start.

    Parameters
    ----------
    paths : sequence of pathlib.Path
        Recordings of one machine.
    model : ThermalModel
        The other model.
    progress : callable, optional
        Called with the number of bytes processed and their total.
    row : callable, optional
        Called with the rows of the table of both offsets, see `COLUMNS`.
    point : callable, optional
        Called with time (ns), and measured deformation and offset with the recorded and with the other model, µm.
    data : bytes
        The file of the other model, with its parts for further axes; without it a machine of several axes is compared
        on Y alone.

    Raises
    ------
    DataError
        If a file is not a recording or a copy of another one, the files belong to several machines, or the model needs
        a missing channel.
    """
    ordered = in_order(paths)
    total = sum(path.stat().st_size for path in ordered)
    run = _Run(model, row, point, data)
    done = 0
    for path in ordered:
        before = run.samples
        with Container(path) as container:
            try:
                for count, step in enumerate(steps_until_damage(container)):
                    run.add(step, container.contents)
                    if progress is not None and count % 1000 == 0:
                        progress(done + container.position, total)
            except Damaged as damage:
                if not_left_by_a_kill(damage, container.contents) is not None:
                    run.remark(
                        AuditRemark.NOT_READ, f"{path.name}: only a part could be read, {run.samples - before} samples."
                    )
        done += path.stat().st_size
    return run.result(ordered)


class _Run:
    def __init__(
        self,
        model: ThermalModel,
        row: Callable[[Iterable[Any]], Any] | None,
        point: Callable[..., None] | None,
        data: bytes,
    ) -> None:
        self._model, self._row, self._point, self._data = model, row, point, data
        self._foreign: ForeignRun | None = None
        #: Configuration and model of the present file, and names of the recorded models.
        self._config = self._recorded = b""
        self._names: dict[str, None] = {}
        self._result = OtherModel("", model.name)

    def add(self, step: RecordedStep, contents: Contents) -> None:
        """Run one group."""
        estimate, offset = step.estimate, step.offset
        if self._foreign is None and (step.sample is None or estimate is None):
            return
        result = self._ready(step, contents, estimate).run(step)
        if isinstance(result, Outcome) and estimate is not None and offset is not None:
            self._compare(estimate, offset, result)
            if result.further and isinstance(estimate, AxesEstimate):
                self._compare_axes(estimate, step.further, result)

    @property
    def samples(self) -> int:
        """Number of samples that were compared."""
        return self._result.samples

    def remark(self, code: AuditRemark, figures: str) -> None:
        """Add a remark on the validity of the figures."""
        self._result.remarks.append(Remark(code, figures))

    def _ready(self, step: RecordedStep, contents: Contents, estimate: EstimateMessage | None) -> ForeignRun:
        """Return the run with the other model and the configuration of the file."""
        parts = [contents.attachments.get(name) for name in ("config.toml", "model.toml")]
        data, model = (part.data if part else b"" for part in parts)
        if self._foreign is not None and (data, model) == (self._config, self._recorded):
            return self._foreign
        config, recorded = setup_of(contents, step.file)
        self._names[recorded.name], self._recorded = None, model
        if self._foreign is not None and data == self._config:
            return self._foreign
        try:
            self._foreign = ForeignRun(self._other(config))
        except ServiceError as error:
            raise DataError(f"{error} in the recording") from error
        self._config = data
        if estimate is not None:
            self._begin(self._foreign.compensation, step, estimate)
        return self._foreign

    def _other(self, config: Config) -> Compensation:
        """Return a compensation with the other model: of all axes, if it has their parts, else of Y alone."""
        if config.axis is not None and self._data:
            plain = msgspec.structs.replace(config.model, alternative=None)
            try:
                config = msgspec.structs.replace(config, model=plain)
                found = Compensation(config, model_of(config, self._data, source=self._model.name))
            except ModelError as error:
                self._result.only_y = str(error)
            else:
                self._result.only_y = ""
                return found
        return Compensation(msgspec.structs.replace(config, axis=None), self._model)

    def _begin(self, compensation: Compensation, step: RecordedStep, estimate: EstimateMessage) -> None:
        """Start with the recorded zero if the first sample does not set one."""
        zero = any(event.kind == EventKind.ZERO for event in step.events)
        if estimate.t_q_ref_degc is None or estimate.at_ref_degc is None or zero:
            return
        recorded = Zero.of_estimate(estimate)
        y_ref_um = math.nan if recorded.y_base_um != 0.0 else recorded.y_ref_um
        compensation.begin(msgspec.structs.replace(recorded, y_ref_um=y_ref_um, y_base_um=0.0, further={}))
        figures = (
            f"{step.file}: starts while the machine is running, and the other model has no state except the zero; "
            f"its first {3 * compensation.slowest_min / 60.0:.0f} h are uncertain."
        )
        self.remark(AuditRemark.BEGINS_RUNNING, figures)

    def _compare(self, estimate: EstimateMessage, offset: Offset, outcome: Outcome) -> None:
        result, sample = self._result, outcome.sample
        at_s = sample.time_utc_ns / NS
        y, other_y = number(estimate.y_um), number(outcome.estimate.y_um)
        before, after = number(estimate.residual_um), number(outcome.estimate.residual_um)
        recorded, other = number(offset.y_offset_um), number(outcome.offset.y_offset_um)
        result.samples += 1
        result.own.add(at_s, (y, recorded, before), (other_y, other, after))
        if self._point is not None:
            self._point(sample.time_utc_ns, y, recorded, other_y, other)
        if self._row is not None:
            values = (y, recorded, before, other_y, other, after)
            cells = ["" if math.isnan(value) else repr(value) for value in values]
            self._row([utc(sample.time_utc_ns), sample.seq, *cells, outcome.offset.state])

    def _compare_axes(self, estimate: AxesEstimate, recorded: Mapping[str, float], outcome: Outcome) -> None:
        """Add the further axes that are measured; `recorded` are their offsets."""
        assert isinstance(outcome.estimate, AxesEstimate)
        other = further_values(outcome.further)
        for axis, um in recorded.items():
            if axis in other and column_of(axis) in estimate.axes:
                one = self._result.axes.setdefault(axis, AxisComparison())
                measured = (_measured(found.axes, axis) for found in (estimate, outcome.estimate))
                (y, before), (other_y, after) = measured
                one.add(outcome.sample.time_utc_ns / NS, (y, um, before), (other_y, other[axis], after))

    def result(self, paths: Sequence[Path]) -> OtherModel:
        """Return the figures; raise an error that names the files if there are none."""
        if not self._result.samples:
            names = ", ".join(path.name for path in paths[:3])
            raise DataError(f"{names}: no samples, expected recordings of a machine's service")
        self._result.recorded = ", ".join(self._names)
        return self._result


def _measured(values: Mapping[str, Any], axis: str) -> tuple[float, float]:
    """Return the measured deformation of an axis since its zero, and its residual, µm."""
    return number(values.get(column_of(axis))), number(values.get(f"{axis}_residual_um"))


def worst_utc(spread: Spread) -> str:
    """Return the time of the largest magnitude, as ISO 8601."""
    return utc(round(spread.at_s * NS))


def _spread_json(spread: Spread) -> dict[str, Any]:
    there = spread.samples > 0
    return {
        "samples": spread.samples,
        "rms_um": spread.rms if there else None,
        "peak_um": abs(spread.peak) if there else None,
        "worst_time_utc": worst_utc(spread) if there else None,
    }
