"""What another model would have done: the recorded samples through the service's compensation with that model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from compensator.audit.findings import utc
from compensator.clock import NS
from compensator.codes import AuditRemark, Remark
from compensator.errors import DataError, ServiceError
from compensator.events import EventKind
from compensator.messages import EstimateMessage, Offset, number
from compensator.model.thermal_model import ThermalModel
from compensator.recording.container import Container, Contents
from compensator.recording.reading import in_order
from compensator.report.history import Spread
from compensator.service.compensation import Compensation, Outcome
from compensator.service.replay import FreeRun, RecordedStep, setup_of, steps_in
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
class Comparison:
    """The recorded model compared with another one.

    Parameters
    ----------
    recorded, other : str
        Names of the models.
    residual_before, residual_after : Spread
        Measured − predicted deformation.
    left_before, left_after : Spread
        Remaining error: measured deformation + offset.
    offsets : Spread
        The other offset − the recorded one.
    samples : int
        Number of samples.
    remarks : list of Remark
        Remarks on the validity of the figures.
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
        """Return the result for `--json`."""
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

    def rows(self) -> dict[str, Spread]:
        """Return the figures with their names, in the order in which they are shown."""
        return {
            f"residual, {self.recorded} (recorded)": self.residual_before,
            f"residual, {self.other}": self.residual_after,
            f"remaining error, {self.recorded} (recorded)": self.left_before,
            f"remaining error, {self.other}": self.left_after,
            f"offset of {self.other} − recorded offset": self.offsets,
        }

    def text(self) -> str:
        """Return a table for people."""
        rows = self.rows()
        width = max(map(len, rows))
        lines = [
            f"{self.samples} samples; y_um was measured in {self.residual_before.samples} of them",
            f"{'':<{width}} {'rms µm':>9} {'peak µm':>9} {'samples':>9}  worst at",
        ]
        for name, spread in rows.items():
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

    Raises
    ------
    DataError
        If a file is not a recording, the files belong to several machines, or the model needs a missing channel.
    """
    ordered = in_order(paths)
    total = sum(path.stat().st_size for path in ordered)
    run = _Run(model, row, point)
    done = 0
    for path in ordered:
        with Container(path) as container:
            for count, step in enumerate(steps_in(container)):
                run.add(step, container.contents)
                if progress is not None and count % 1000 == 0:
                    progress(done + container.position, total)
        done += path.stat().st_size
    return run.result(ordered)


class _Run:
    def __init__(
        self, model: ThermalModel, row: Callable[[Iterable[Any]], Any] | None, point: Callable[..., None] | None
    ) -> None:
        self._model, self._row, self._point = model, row, point
        self._free: FreeRun | None = None
        #: Configuration and model of the present file, and names of the recorded models.
        self._config = self._recorded = b""
        self._names: dict[str, None] = {}
        self._result = Comparison("", model.name, Spread(), Spread(), Spread(), Spread(), Spread(), 0, [])

    def add(self, step: RecordedStep, contents: Contents) -> None:
        """Run one group."""
        estimate, offset = step.estimate, step.offset
        if self._free is None and (step.sample is None or estimate is None):
            return
        result = self._ready(step, contents, estimate).run(step)
        if isinstance(result, Outcome) and estimate is not None and offset is not None:
            self._compare(estimate, offset, result)

    def _ready(self, step: RecordedStep, contents: Contents, estimate: EstimateMessage | None) -> FreeRun:
        """Return the run with the other model and the configuration of the file."""
        parts = [contents.attachments.get(name) for name in ("config.toml", "model.toml")]
        data, model = (part.data if part else b"" for part in parts)
        if self._free is not None and (data, model) == (self._config, self._recorded):
            return self._free
        config, recorded = setup_of(contents, step.file)
        self._names[recorded.name], self._recorded = None, model
        if self._free is not None and data == self._config:
            return self._free
        try:
            # The other model is compared on Y, also on a machine of several axes.
            self._free = FreeRun(Compensation(msgspec.structs.replace(config, axis=None), self._model))
        except ServiceError as error:
            raise DataError(f"{error} in the recording") from error
        self._config = data
        if estimate is not None:
            self._begin(self._free.compensation, step, estimate)
        return self._free

    def _begin(self, compensation: Compensation, step: RecordedStep, estimate: EstimateMessage) -> None:
        """Start with the recorded zero if the first sample does not set one."""
        zero = any(event.kind == EventKind.ZERO for event in step.events)
        if estimate.t_q_ref_degc is None or estimate.at_ref_degc is None or zero:
            return
        y_ref_um = math.nan if estimate.y_base_um != 0.0 else number(estimate.y_ref_um)
        compensation.begin(replace(Zero.of_estimate(estimate), y_ref_um=y_ref_um, y_base_um=0.0))
        figures = (
            f"{step.file}: starts while the machine is running, and the other model has no state except the zero; "
            f"its first {3 * compensation.slowest_min / 60.0:.0f} h are uncertain."
        )
        self._result.remarks.append(Remark(AuditRemark.BEGINS_RUNNING, figures))

    def _compare(self, estimate: EstimateMessage, offset: Offset, outcome: Outcome) -> None:
        result, sample = self._result, outcome.sample
        at_s = sample.time_utc_ns / NS
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
            self._point(sample.time_utc_ns, y, recorded, other_y, other)
        if self._row is not None:
            values = (y, recorded, before, other_y, other, after)
            cells = ["" if math.isnan(value) else repr(value) for value in values]
            self._row([utc(sample.time_utc_ns), sample.seq, *cells, outcome.offset.state])

    def result(self, paths: Sequence[Path]) -> Comparison:
        """Return the figures; raise an error that names the files if there are none."""
        if not self._result.samples:
            names = ", ".join(path.name for path in paths[:3])
            raise DataError(f"{names}: no samples, expected recordings of a machine's service")
        self._result.recorded = ", ".join(self._names)
        return self._result


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
