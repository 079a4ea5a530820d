"""How good a model is, by one definition for every command and page: its free run over measured data.

The model runs from the first sample, at rest; measured Y counts from its first value, as in the service. A zero that is
off by a constant is part of the rms about the zero, and not of that about the mean.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from compensator.arrays import Mask, Vector
from compensator.data.record import SampledData, require
from compensator.display import Table
from compensator.model.simulation import FREE_RUN_HEAD, Scores, require_channels, scores, simulate
from compensator.model.thermal_model import ThermalModel

#: References with which every model is compared.
NOTHING, PERSISTENCE = "no compensation", "persistence"
TITLE = "Error in free run, µm: rms about the zero and about the mean, mean absolute, peak to peak"
NOTE = (
    "Free run: from the first sample, at rest; measured Y counts from its first value, as in the service. About the "
    "mean: without the residual's mean. Persistence: the last Y measured before the samples is held."
)
#: Added where most of an error about the zero is one constant: it is this many times the error about the mean, and this
#: share of the deformation's spread.
CONSTANT = (
    "Where the error about the zero is much larger than about the mean, most of it is one constant: the data begin on "
    "a machine that is not at rest, or their first Y is wrong. Judge the model by data that begin at rest, or by the "
    "error about the mean."
)
CONSTANT_TIMES, CONSTANT_SHARE = 2.0, 0.05


class Measured(Protocol):
    """Measured data, as `data.measurement` reads them."""

    @property
    def name(self) -> str:
        """Name in messages."""

    @property
    def label(self) -> str:
        """Name of the runs."""

    @property
    def hours(self) -> float:
        """Time from the first row to the last, h."""

    def at_period(self, period_s: float) -> SampledData:
        """Return the records at a sample period, s."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeRuns:
    """Free runs of models over the same samples; files follow each other.

    Parameters
    ----------
    t_h : numpy.ndarray, shape (n,)
        Time, h.
    y_um : numpy.ndarray, shape (n,)
        Measured deformation from its first value, µm; NaN outside the samples.
    residuals : dict of str to numpy.ndarray, shape (n,)
        Measured − predicted of each model, of no compensation and of persistence, µm; NaN outside the samples.
    """

    t_h: Vector
    y_um: Vector
    residuals: dict[str, Vector]

    @property
    def scores(self) -> dict[str, Scores]:
        """Errors by the names of `residuals`."""
        return {name: scores(self.y_um, self.y_um - values) for name, values in self.residuals.items()}

    @property
    def samples(self) -> int:
        """Number of samples."""
        return int(np.sum(np.isfinite(self.y_um)))


def free_runs(
    models: Mapping[str, ThermalModel],
    data: Sequence[Measured],
    *,
    from_h: float = 0.0,
    until_h: float = np.inf,
    from_rest: bool = False,
) -> FreeRuns:
    """Run models over data and compare them on the samples that all of them predict.

    Parameters
    ----------
    models : mapping of str to ThermalModel
        Models of one sample period by name.
    data : sequence of Measured
        With T_Q, AT and Y.
    from_h, until_h : float
        Hours of each of the data between which samples are compared; the models run from its start.
    from_rest : bool
        How each run begins, as `simulate` has it.

    Raises
    ------
    DataError
        If a column is missing.
    """
    period_s = next(iter(models.values())).period_s
    models = {name: _without_deviations(model) for name, model in models.items()}
    times: list[Vector] = []
    parts: dict[str, list[Vector]] = {name: [] for name in ("y", *models, NOTHING, PERSISTENCE)}
    begin_h = 0.0
    for one in data:
        for record in one.at_period(period_s).records:
            require(one.name, record, ("t_q_degc", "at_degc", "y_um"))
            for model in models.values():
                require_channels(model, record, one.name)
            runs = {
                name: simulate(model, record, source=one.name, from_rest=from_rest) for name, model in models.items()
            }
            residuals = {name: run["residual_um"] for name, run in runs.items()}
            y = next(iter(runs.values()))["y_um"]
            known = np.all([np.isfinite(values) for values in (y, *residuals.values())], axis=0)
            scored = known & (record.t_s >= from_h * 3600.0) & (record.t_s < until_h * 3600.0)
            residuals |= {NOTHING: y, PERSISTENCE: y - _last_before(y, known, scored)}
            for name, values in {"y": y, **residuals}.items():
                parts[name].append(np.where(scored, values, np.nan))
            times.append(record.t_s / 3600.0 + begin_h)
        begin_h += one.hours
    joined = {name: np.concatenate(values) for name, values in parts.items()}
    y = joined.pop("y")
    return FreeRuns(t_h=np.concatenate(times), y_um=y, residuals=joined)


def _without_deviations(model: ThermalModel) -> ThermalModel:
    """Return a model that predicts the same and states nothing of its effects' errors, which takes most of the time."""
    effects = tuple(dataclasses.replace(effect, std_factor=()) for effect in model.effects)
    return dataclasses.replace(model, effects=effects)


def _last_before(y: Vector, known: Mask, scored: Mask) -> float:
    """Return the last value measured before the scored samples; the first of all if there is none."""
    before = y[known & (np.arange(y.size) < (int(np.argmax(scored)) if scored.any() else y.size))]
    first = y[known][:1]
    return float(before[-1] if before.size else first[0] if first.size else np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeRunErrors:
    """Errors of models in free run on some data.

    Parameters
    ----------
    name : str
        Name of the data.
    role : str
        `fitted`, `held out`, or what else the data were to the models.
    samples : int
        Number of samples.
    scores : dict of str to Scores
        Of each model by name, of no compensation and of persistence.
    """

    name: str
    role: str
    samples: int
    scores: dict[str, Scores]

    @classmethod
    def of(
        cls,
        models: Mapping[str, ThermalModel],
        data: Sequence[Measured],
        role: str,
        *,
        from_h: float = 0.0,
        until_h: float = np.inf,
        from_rest: bool = False,
    ) -> FreeRunErrors:
        """Return the errors on data; see `free_runs`."""
        runs = free_runs(models, data, from_h=from_h, until_h=until_h, from_rest=from_rest)
        labels = ", ".join(dict.fromkeys(one.label for one in data))
        if from_h:
            labels += f" from {from_h:g} h on"
        if until_h < np.inf:
            labels += f" until {until_h:g} h"
        return cls(name=labels, role=role, samples=runs.samples, scores=runs.scores)

    def to_dict(self) -> dict[str, Any]:
        """Return all figures."""
        found = {name: dataclasses.asdict(row) for name, row in self.scores.items()}
        return {"name": self.name, "role": self.role, "samples": self.samples, "scores": found}


def table_of(rows: Sequence[FreeRunErrors]) -> Table:
    """Return the errors as a table, the same on every page and in every command."""
    return table_of_scores([one.scores for one in rows], [f"{one.name} ({one.role})" for one in rows])


def table_of_scores(scores: Sequence[Mapping[str, Scores]], names: Sequence[str] = ("",)) -> Table:
    """Return the errors of models on one or several data as a table.

    Parameters
    ----------
    scores : sequence of mapping of str to Scores
        For each of the data, errors by the name of the model.
    names : sequence of str
        Of the data; a single one is not shown.
    """
    lines: list[list[str]] = []
    for name, by_model in zip(names, scores, strict=True):
        if len(scores) > 1:
            lines.append([name, *[""] * len(FREE_RUN_HEAD)])
        lines += [[model, *row.free_run_cells()] for model, row in by_model.items()]
    note = f"{NOTE} {CONSTANT}" if any(map(_is_constant, scores)) else NOTE
    return Table(title=TITLE, head=["", *FREE_RUN_HEAD], rows=lines, note=note)


def _is_constant(scores: Mapping[str, Scores]) -> bool:
    """Whether most of the error of a model is one constant that matters beside the deformation."""
    least_um = CONSTANT_SHARE * scores[NOTHING].rms_about_mean_um
    models = [row for name, row in scores.items() if name not in (NOTHING, PERSISTENCE)]
    return any(row.rms_um > max(CONSTANT_TIMES * row.rms_about_mean_um, least_um) for row in models)


def in_words(scores: Mapping[str, Any], model: str) -> str:
    """Return the error of a model in free run, in the words of every command and page.

    Parameters
    ----------
    scores : mapping of str to mapping
        As in `FreeRunErrors.to_dict`.
    model : str
        Name of the model in it.

    Examples
    --------
    >>> own = {"rms_um": 23.04, "rms_about_mean_um": 7.26}
    >>> in_words({"quill": own, "no compensation": {"rms_um": 41.3, "rms_about_mean_um": 20.0}}, "quill")
    'in free run 23.04 µm rms about the zero, 7.26 about the mean (without compensation 41.3 and 20.0)'
    """
    own, nothing = scores[model], scores[NOTHING]
    return (
        f"in free run {own['rms_um']:.2f} µm rms about the zero, {own['rms_about_mean_um']:.2f} about the mean "
        f"(without compensation {nothing['rms_um']:.1f} and {nothing['rms_about_mean_um']:.1f})"
    )
