"""`tc.identify`: from measured runs to a thermal model with its errors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from compensator import __version__
from compensator.api.files import ModelLike, axes_as_in_file, models_of
from compensator.api.identification_result import IdentificationResult
from compensator.api.identified_axes import IdentifiedAxes
from compensator.axes import AxisWords, column_of
from compensator.blas import one_thread
from compensator.data.axes import AxisLike, axes_in, of_axis, words_of
from compensator.data.measurement import (
    PERIOD_S,
    DataLike,
    Measurement,
    check_each_once,
    check_validation,
    measurements,
    runs_in,
)
from compensator.data.screening import require_y_noise, screen_temperatures
from compensator.errors import UsageError
from compensator.identify.calibration import Calibration, calibrate, of_machine
from compensator.identify.coefficients import compare
from compensator.identify.criticism import criticise
from compensator.identify.pairs import Pair, pairs
from compensator.identify.settings import LONGEST_H, Method, Settings
from compensator.identify.shared_poles import calibrated_together
from compensator.identify.summary import MODEL, figures
from compensator.model.free_run import FreeRunErrors
from compensator.model.table import ONE_LINE, is_one_line, shown
from compensator.model.thermal_model import ThermalModel
from compensator.options import check_types
from compensator.progress import Progress, unreported

#: Figures that a model file keeps in its provenance.
_KEPT = ("method", "free_run", "parts", "warnings", "remarks", "ttf")
_DEFAULT = Settings()


@one_thread
def identify(
    data: DataLike,
    *,
    validate: DataLike = (),
    etve: DataLike = (),
    columns: Mapping[str, str] | None = None,
    axis: AxisLike = None,
    name: str = "model",
    kind: Literal["auto", "heat", "direct"] = "auto",
    method: Method = "IV",
    tdtf: Sequence[float] | None = None,
    etve_end_h: float = _DEFAULT.etve_end_h,
    ttf: Sequence[int] = _DEFAULT.ttf,
    order: Sequence[int] | None = None,
    drive: Literal["ttf", "known"] = "ttf",
    folds: int = _DEFAULT.folds,
    fit_until_h: float | None = None,
    y_std_um: float | None = None,
    reference: ModelLike | None = None,
    progress: Progress = unreported,
) -> IdentificationResult | IdentifiedAxes:
    """Identify a thermal model from measured runs.

    Several axes are identified together: the estimation of the heat is the machine's, and so are the time constants
    where the data do not contradict.

    Parameters
    ----------
    data : DataLike
        Runs to which the model is fitted.
    validate, etve : DataLike, optional
        Runs used only for validation; runs with the heat source off (methods II and III).
    columns : mapping of str to str, optional
        Column name for each role that has another name.
    axis : str or sequence of str, optional
        Axes, or single probes by the names of their columns without `_um`; by default all axes that the data have.
    name : str
        Name of the model.
    kind : {"auto", "heat", "direct"}
        `heat`: with a TTF; `direct`: from T_Q − AT to the deformation; `auto`: `heat` if `heat_w` is known.
    method : {"I", "II", "III", "IV"}
        TDTF given (I), fitted to a whole ETVE (II) or its end (III), or fitted together with the DTF (IV).
    tdtf : (float, float), optional
        Gain, µm/K, and time constant, min, of method I.
    etve_end_h : float
        Length of the end of the ETVE for method III, h.
    ttf : (int, int, int)
        nb, nf, nk of the TTF.
    order : (int, int, int), optional
        nf, nb of the DTF, nb of the TDTF; by default chosen on held-out blocks.
    drive : {"ttf", "known"}
        Heat for fitting the DTF: estimated from T_Q as in the service, or known.
    folds : int
        Number of held-out blocks.
    fit_until_h : float, optional
        Fit up to this hour; the rest is held out.
    y_std_um : float, optional
        Standard deviation of one measured Y, µm. Needed where Y was measured now and then, as by a touch probe;
        elsewhere neighbouring values show it.
    reference : model, optional
        Another model for a comparison of the coefficients.
    progress : callable
        Called with the steps done and their number.

    Returns
    -------
    IdentificationResult
        Model, parameters, standard errors, errors in free run. Of several axes: one for each, in an IdentifiedAxes.

    Raises
    ------
    CompensatorError
        If no model can be fitted to the data with these options.
    """
    check_types(name=name, folds=folds, fit_until_h=fit_until_h, etve_end_h=etve_end_h)
    settings = Settings(
        kind=kind,
        method=method,
        ttf=_orders("ttf", "(nb, nf, nk)", ttf),
        order=None if order is None else _orders("order", "(nf, nb of the DTF, nb of the TDTF)", order),
        drive=drive,
        given_tdtf=None if tdtf is None else _gain_and_time(tdtf),
        etve_end_h=float(etve_end_h),
        folds=folds,
    )
    if fit_until_h is not None and not 0.0 < fit_until_h <= LONGEST_H:
        raise UsageError(f"fit until {fit_until_h:g} h: expected more than 0, at most {LONGEST_H:g}")
    if not is_one_line(name):
        raise UsageError(f"name = {shown(name)}, expected {ONE_LINE}")
    # A wrong file is refused before the fit, which may take minutes.
    other = {} if reference is None else models_of(reference)
    sources = {
        role: measurements(given, name, columns, needed=role == "fit")
        for role, name, given in (("fit", "data", data), ("etve", "etve", etve), ("validation", "validate", validate))
    }
    for several in sources.values():
        check_each_once(several)
    check_validation([*sources["fit"], *sources["etve"]], sources["validation"])
    axes = axes_in(sources["fit"], axis)
    numbers = {"fit_until_h": fit_until_h, "y_std_um": y_std_um}
    provenance = partial(_provenance, sources, settings, columns or {}, numbers)
    calibrations: dict[str, Calibration] = {}
    words = {one: words_of(one, *sources.values(), models=[name]) for one in axes}
    # The axis that was measured most gives the heat.
    for i, one in enumerate(sorted(axes, key=lambda each: -_values(sources["fit"], each))):
        with words[one].errors():
            calibrations[one] = _calibrated(
                {role: of_axis(measured, one) for role, measured in sources.items()},
                settings,
                name=name,
                fit_until_h=fit_until_h,
                y_std_um=y_std_um,
                provenance=provenance,
                like=next(iter(calibrations.values()), None),
                progress=lambda done, of, i=i: progress(i * of + done, len(axes) * of),  # type: ignore[misc]
            )
    calibrations = of_machine({one: calibrations[one] for one in axes})
    alone = calibrations
    calibrations, shared = calibrated_together(alone, progress=progress)
    results = _results(calibrations, sources, words, fit_until_h, other)
    if len(results) == 1:
        return next(iter(results.values()))
    alone_um = {one: calibration.folds_rms_um for one, calibration in alone.items()}
    proposed = _pairs(sources["fit"], axes, shared)
    return IdentifiedAxes(results=results, shared=shared, alone_rms_um=alone_um, pairs=proposed)


def _values(measured: Sequence[Measurement], axis: str) -> int:
    """Return how many values of an axis were measured."""
    columns = (one.table.columns.get(column_of(axis)) for one in measured)
    return sum(int(np.isfinite(values).sum()) for values in columns if values is not None)


def _calibrated(
    sources: Mapping[str, Sequence[Measurement]],
    settings: Settings,
    *,
    name: str,
    fit_until_h: float | None,
    y_std_um: float | None,
    provenance: Callable[[], Mapping[str, Any]],
    like: Calibration | None,
    progress: Progress,
) -> Calibration:
    """Calibrate the model of an axis on its data."""
    remarks: list[str] = []
    runs = {}
    for role, measured in sources.items():
        runs[role], corrected = runs_in(measured, PERIOD_S, y_std_um=y_std_um)
        remarks += corrected
    require_y_noise(", ".join(dict.fromkeys(run.name for run in runs["etve"])), runs["etve"])
    for run in runs["validation"]:
        screen_temperatures(run.name, [run], quiet_air=True)
    return calibrate(
        runs["fit"],
        settings,
        period_s=PERIOD_S,
        name=name,
        etve=runs["etve"],
        validation=runs["validation"],
        fit_until_s=None if fit_until_h is None else fit_until_h * 3600.0,
        provenance=provenance(),
        remarks=remarks,
        like=like,
        progress=progress,
    )


def _results(
    calibrations: Mapping[str, Calibration],
    sources: Mapping[str, Sequence[Measurement]],
    words: Mapping[str, AxisWords],
    fit_until_h: float | None,
    other: Mapping[str, ThermalModel],
) -> dict[str, IdentificationResult]:
    """Return the result of each axis, with the models as one file has them."""
    views, free_runs, models = {}, {}, {}
    for axis, calibration in calibrations.items():
        with words[axis].errors():
            views[axis] = criticise(calibration)
            own = {role: of_axis(measured, axis) for role, measured in sources.items()}
            free_runs[axis] = _free_run(calibration.model, own, fit_until_h)
        found = words[axis](figures(calibration, views[axis], free_runs[axis]))
        provenance = dict(calibration.model.provenance) | {key: found[key] for key in _KEPT if key in found}
        models[axis] = dataclasses.replace(calibration.model, provenance=provenance)
    models = axes_as_in_file(models)
    return {
        axis: IdentificationResult(
            model=models[axis],
            calibration=calibration,
            criticism=views[axis],
            comparison=tuple(compare(models[axis], other[axis])) if axis in other else (),
            free_run=free_runs[axis],
            in_frame=any(measured.in_frame for measured in sources["fit"]),
            words=words[axis],
        )
        for axis, calibration in calibrations.items()
    }


def _pairs(measured: Sequence[Measurement], axes: Sequence[str], shared: Sequence[Sequence[str]]) -> tuple[Pair, ...]:
    """Return the probes that are probably pairs."""
    records = [record for one in measured for record in one.at_period(PERIOD_S).records]
    names = [axis for axis in axes if all(column_of(axis) in record.columns for record in records)]
    values = {axis: [record.columns[column_of(axis)] for record in records] for axis in names}
    return tuple(pairs(values, PERIOD_S, shared))


def _free_run(
    model: ThermalModel, sources: Mapping[str, Sequence[Measurement]], fit_until_h: float | None
) -> tuple[FreeRunErrors, ...]:
    """Return the errors in free run on each of the data that has measured Y, fitted ones first."""
    until_h = math.inf if fit_until_h is None else fit_until_h
    found = [FreeRunErrors.of({MODEL: model}, [one], "fitted", until_h=until_h) for one in sources["fit"]]
    found += [FreeRunErrors.of({MODEL: model}, [one], "held out", from_h=until_h) for one in sources["fit"]]
    found += [FreeRunErrors.of({MODEL: model}, [one], "held out") for one in sources["validation"]]
    return tuple(one for one in found if one.samples)


def _orders(name: str, meaning: str, values: Sequence[int]) -> tuple[int, int, int]:
    try:
        first, second, third = (int(value) for value in values if not isinstance(value, str))
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name} {values!r}, expected three integers: {meaning}") from error
    return first, second, third


def _gain_and_time(tdtf: Sequence[float]) -> tuple[float, float]:
    try:
        gain, tau_min = (float(value) for value in tdtf)
    except (TypeError, ValueError) as error:
        raise UsageError(f"tdtf {tdtf!r}, expected two numbers: gain in µm/K and time constant in min") from error
    return gain, tau_min


def _provenance(
    sources: Mapping[str, Sequence[Measurement]],
    settings: Settings,
    columns: Mapping[str, str],
    numbers: Mapping[str, float | None],
) -> dict[str, Any]:
    """Return the provenance of a model: every source with its hash, and the options."""
    asked = {name: value for name, value in dataclasses.asdict(settings).items() if value is not None}
    asked |= {name: float(value) for name, value in numbers.items() if value is not None}
    every = [(role, measured) for role, group in sources.items() for measured in group]
    roles = [*columns.items(), *(pair for _, measured in every for pair in measured.roles.items())]
    asked["columns"] = [f"{role}={name}" for role, name in dict.fromkeys(roles)]
    data = [{"role": role} | origin.provenance() for role, measured in every for origin in measured.origins]
    return {"source": f"compensator {__version__} identify", "data": data, "asked": asked}
