"""The columns of a free run as a DataFrame; imported only if the data are a DataFrame."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, ClassVar

import pandas

from compensator.api.simulation_result import SimulatedAxes, SimulationResult
from compensator.codes import Remark
from compensator.data.frames import time_index
from compensator.model.simulation import Scores


class FramePlot(pandas.plotting.PlotAccessor):  # type: ignore[misc]
    """Plots of a SimulationFrame: `plot()` is that of its result; arguments and methods are those of pandas."""

    def __init__(self, frame: SimulationFrame) -> None:
        super().__init__(frame)
        self._result = frame.result

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Plot measured and predicted deformation and the residual or, with arguments, what pandas would."""
        return super().__call__(*arguments, **options) if arguments or options else self._result.plot()


class SimulationFrame(pandas.DataFrame):  # type: ignore[misc]
    """A DataFrame of the columns, indexed by time if the data were; slices of it are plain DataFrames.

    Parameters
    ----------
    result : SimulationResult or SimulatedAxes
        The same columns as arrays, of several axes also by axis; its `to_dict()` returns the figures, that of the
        DataFrame the columns.
    """

    _metadata: ClassVar[list[str]] = ["result"]
    result: SimulationResult | SimulatedAxes

    @classmethod
    def of(cls, result: SimulationResult | SimulatedAxes, start_utc_s: float | None, *, local: bool) -> SimulationFrame:
        """Make a DataFrame of a result; `start_utc_s`: the time of `t_s` = 0, s since 1970 (`local`: no zone)."""
        frame = cls(result.table, index=time_index(result["t_s"], start_utc_s, local=local))
        frame.result = result
        return frame

    @property
    def _constructor(self) -> Any:
        return pandas.DataFrame

    @property
    def plot(self) -> FramePlot:
        """`plot()` plots measured and predicted deformation and the residual; else as in pandas."""
        return FramePlot(self)

    @property
    def scores(self) -> Scores | dict[str, Scores | None] | None:
        """Fit, rms and peak to peak of the residual, if Y was measured; of several axes by axis."""
        return self.result.scores

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """Remarks on the data, and on doubtful predictions."""
        return self.result.remarks

    def summary(self) -> str:
        """Return what `compensator simulate` prints."""
        return self.result.summary()

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the columns as CSV, as `compensator simulate` does."""
        return self.result.save(path)
