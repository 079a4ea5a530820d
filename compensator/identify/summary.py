"""Figures, tables and text of an identification for terminal, notebook, page, JSON and model file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from compensator.display import Table, Words, warnings_of, with_std
from compensator.identify.calibration import Calibration
from compensator.identify.coefficients import Row
from compensator.identify.criticism import Criticism
from compensator.model.free_run import NOTHING, FreeRunErrors, in_words, table_of
from compensator.model.simulation import SCORE_HEAD

#: Name of the identified model among the errors in free run.
MODEL = "model"


def figures(calibration: Calibration, criticism: Criticism, free_run: Sequence[FreeRunErrors] = ()) -> dict[str, Any]:
    """Return all figures, warnings and remarks, as `--json` prints them."""
    model = calibration.model
    result: dict[str, Any] = {
        "kind": model.kind,
        "method": calibration.settings.method,
        "paths": {
            path.name: {
                "unit": path.unit,
                "gain": {"value": path.gain, "std": path.gain_std},
                "tau_min": [{"value": t, "std": s} for t, s in zip(path.taus_min, path.taus_std_min, strict=True)],
                "structure": str(fit.fit.structure) if fit.fit else "given",
            }
            for path, fit in zip(criticism.paths, calibration.paths, strict=True)
        },
        **errors_of(calibration, free_run),
        "noise": dict(calibration.noise),
        "warnings": [str(warning) for warning in criticism.warnings],
        "warning_codes": [warning.code for warning in criticism.warnings],
        "remarks": list(calibration.remarks),
    }
    temperature = calibration.temperature
    if temperature is not None:
        result["ttf"] = {
            "fit_pct": calibration.ttf_fit_pct,
            "held_out_rms_k": temperature.held_out_k,
            "inverse_noise_gain_w_per_k": temperature.noise_gain_w_per_k,
        }
    return result


def errors_of(calibration: Calibration, free_run: Sequence[FreeRunErrors] = ()) -> dict[str, Any]:
    """Return the errors: in free run as the service runs, and of each part of the data and the held-out folds.

    Those of parts and folds have the zero (and the fitted ones the initial state) from the data.
    """
    return {
        "free_run": [one.to_dict() for one in free_run],
        "parts": [
            {
                "name": part.name,
                "role": part.role,
                "samples": int(part.y_um.size),
                "fit_pct": part.model.fit_pct,
                "rms_um": part.model.rms_um,
                "peak_to_peak_um": part.model.peak_to_peak_um,
                "no_compensation_rms_um": part.nothing.rms_um,
                "persistence_rms_um": part.persistence.rms_um,
            }
            for part in calibration.parts
        ],
        "folds_rms_um": calibration.folds_rms_um,
    }


def verdict(errors: Mapping[str, Any]) -> str:
    """Return the error on data that were not used for the fit, in one sentence.

    Parameters
    ----------
    errors : mapping
        Result of :func:`errors_of`; a model file contains them in its provenance.
    """
    runs = {role: [one for one in errors.get("free_run", ()) if one["role"] == role] for role in ("held out", "fitted")}
    if runs["held out"]:
        count, worst = len(runs["held out"]), _worst(runs["held out"])
        several = f"; the worst of {count}" if count > 1 else ""
        return f"On data that were not used for the fit: {in_words(worst['scores'], MODEL)}{several}."
    if runs["fitted"]:
        return (
            f"On the fitted data: {in_words(_worst(runs['fitted'])['scores'], MODEL)}. On held-out blocks of time, "
            f"with zero and initial state fitted: {errors['folds_rms_um']:.2f} µm rms. There is no separate validation "
            "run; give one with --validate."
        )
    held_out = [part for part in errors["parts"] if part["role"] == "held out"]
    if held_out:  # a model file of version 0.1.0
        worst = max(held_out, key=lambda part: float(part["rms_um"]))
        return (
            f"On data that were not used for the fit: {worst['rms_um']:.2f} µm rms "
            f"({worst['no_compensation_rms_um']:.1f} without compensation), fit {worst['fit_pct']:.1f} %"
            + (f", worst of {len(held_out)}" if len(held_out) > 1 else "")
            + "."
        )
    return (
        f"On held-out blocks of time: {errors['folds_rms_um']:.2f} µm rms in free run "
        f"({errors['parts'][0]['no_compensation_rms_um']:.1f} without compensation). There is no separate "
        "validation run; give one with --validate."
    )


def _worst(runs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    return max(runs, key=lambda one: float(one["scores"][MODEL]["rms_um"]))


def share_left(errors: Mapping[str, Any]) -> float:
    """Return the ratio of the held-out error to that without compensation, the largest of all parts."""
    runs = [one["scores"] for one in errors.get("free_run", ()) if one["role"] == "held out"]
    if runs:
        return max(float(one[MODEL]["rms_um"] / one[NOTHING]["rms_um"]) for one in runs)
    held_out = [part for part in errors["parts"] if part["role"] == "held out"]
    if held_out:
        return max(float(part["rms_um"] / part["no_compensation_rms_um"]) for part in held_out)
    return float(errors["folds_rms_um"] / errors["parts"][0]["no_compensation_rms_um"])


class EstimatedParameter(NamedTuple):
    """A parameter: description, value with standard error (0: given), and unit."""

    label: str
    value: float
    std: float
    unit: str


def estimates(criticism: Criticism) -> dict[str, EstimatedParameter]:
    """Return gains at rest and time constants by name, such as `dtf_gain_um_per_w`, `dtf_tau_1_min`."""
    found = {}
    for path in criticism.paths:
        key, unit = path.name.lower(), path.unit.lower().replace("/", "_per_")
        shown = path.unit.replace("um", "µm")
        found[f"{key}_gain_{unit}"] = EstimatedParameter(f"{path.name}: gain at rest", path.gain, path.gain_std, shown)
        for i, (tau, std) in enumerate(zip(path.taus_min, path.taus_std_min, strict=True), start=1):
            found[f"{key}_tau_{i}_min"] = EstimatedParameter(f"{path.name}: time constant {i}", tau, std, "min")
    return found


def contents(
    calibration: Calibration,
    criticism: Criticism,
    comparison: Sequence[Row] = (),
    free_run: Sequence[FreeRunErrors] = (),
) -> Iterator[str | Table | Words]:
    """Yield the content for terminal and notebook: sentences, tables, warnings and remarks."""
    model = calibration.model
    what = (
        "TTF, DTF, TDTF: heat from the temperatures"
        if model.kind == "heat"
        else "direct: from T_Q − AT to the deformation, heat unknown"
    )
    yield f"model {model.name} ({what}; method {calibration.settings.method})"
    yield verdict(errors_of(calibration, free_run))
    yield parameter_table(calibration, criticism)
    if free_run:
        yield table_of(free_run)
    yield error_table(calibration)
    if comparison:
        yield comparison_table(comparison)
    yield from warnings_of(criticism.warnings)
    if calibration.remarks:
        yield Words(title="Remarks on the data", lines=calibration.remarks)


def parameter_table(calibration: Calibration, criticism: Criticism) -> Table:
    """Return gains and time constants with their standard errors and their names in Python."""
    rows = [[one.label, with_std(one.value, one.std), one.unit, name] for name, one in estimates(criticism).items()]
    for path in calibration.paths:
        rows.append([f"{path.name}: structure", str(path.fit.structure) if path.fit else "given", "", ""])
    if calibration.temperature is not None:
        watts = f"{calibration.temperature.noise_gain_w_per_k:.1f}"
        rows.append(["inverse TTF: noise in the heat per 1 K of temperature noise", watts, "W", ""])
        rows.append(["TTF: fit in free run with known heat", f"{calibration.ttf_fit_pct:.2f}", "%", ""])
    return Table(
        title="Gains and time constants",
        head=["parameter", "value ± standard error", "unit", "name"],
        rows=rows,
        note="The standard errors allow for the low-frequency power of a residual that is not white.",
    )


def error_table(calibration: Calibration) -> Table:
    """Return the errors of the fit: a row for each part of the data, one for the folds and one for the ARX fit."""
    arx_rms = f"{calibration.arx_rms_um:.2f}" if math.isfinite(calibration.arx_rms_um) else "unstable"
    rows = [
        [part.name, part.role, f"{part.hours:.1f}", *part.model.cells(), f"{part.nothing.rms_um:.2f}"]
        for part in calibration.parts
    ]
    rows.append(["blocks of the fit, cross-validated", "held out", "", f"{calibration.folds_rms_um:.2f}", "", "", ""])
    rows.append(["ARX of the same structure", "fitted", "", arx_rms, "", "", ""])
    return Table(
        title="Errors of the fit: zero from the data",
        head=["data", "part", "h", *SCORE_HEAD, "uncompensated µm"],
        rows=rows,
        note="Fitted runs: zero and initial state are fitted. Runs that were not fitted: the zero is the mean of their "
        "first hour. Fit: 100 · (1 − ‖y − ŷ‖ / ‖y − mean y‖).",
    )


def comparison_table(rows: Sequence[Row]) -> Table:
    """Return gains, time constants and coefficients, compared with those of a reference model."""
    return Table(
        title="Comparison with the reference model",
        head=["path and figure", "identified ± standard error", "reference", "difference / standard error"],
        rows=[
            [
                f"{row.path}: {row.figure}",
                with_std(row.found, row.std),
                f"{row.reference:.4g}",
                "–" if math.isnan(row.deviations) else f"{row.deviations:+.1f}",
            ]
            for row in rows
        ],
        note="Functions of s (1/min), highest denominator coefficient 1.",
    )
