"""Figures and text of an identification, for terminal, JSON and model file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from compensator.identify.calibration import Calibration
from compensator.identify.criticism import Criticism


def figures(calibration: Calibration, criticism: Criticism) -> dict[str, Any]:
    """Return all figures, warnings and remarks.

    Parameters
    ----------
    calibration : Calibration
        Result of the identification.
    criticism : Criticism
        Responses, correlations and warnings.
    """
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


def verdict(calibration: Calibration) -> str:
    """Return one sentence: the error on data that took no part in the fit."""
    held_out = [part for part in calibration.parts if part.role == "held out"]
    if held_out:
        worst = max(held_out, key=lambda part: part.model.rms_um)
        return (
            f"On data that took no part in the fit: {worst.model.rms_um:.2f} µm rms "
            f"({worst.nothing.rms_um:.1f} without compensation), fit {worst.model.fit_pct:.1f} %"
            + (f", worst of {len(held_out)}" if len(held_out) > 1 else "")
            + "."
        )
    fitted = calibration.parts[0]
    return (
        f"On held-out blocks of time: {calibration.folds_rms_um:.2f} µm rms in free run "
        f"({fitted.nothing.rms_um:.1f} without compensation). No separate run validates it; give one with --validate."
    )


def text(calibration: Calibration, criticism: Criticism) -> str:
    """Return the summary for the terminal."""
    model = calibration.model
    what = (
        "TTF, DTF, TDTF: heat from the temperatures"
        if model.kind == "heat"
        else "direct: from T_Q − AT to the deformation, heat unknown"
    )
    lines = [f"model {model.name} ({what}; method {calibration.settings.method})", "", verdict(calibration), ""]
    for path, fit in zip(criticism.paths, calibration.paths, strict=True):
        unit = path.unit.replace("um", "µm")
        gain = with_std(path.gain, path.gain_std)
        taus = ", ".join(with_std(t, s) for t, s in zip(path.taus_min, path.taus_std_min, strict=True))
        structure = str(fit.fit.structure) if fit.fit else "given"
        lines.append(f"{path.name:<5} gain {gain} {unit}; time constants {taus} min; {structure}")
    if calibration.temperature is not None:
        lines.append(
            f"TTF   fit {calibration.ttf_fit_pct:.2f} %; its inverse is stable; 1 K of noise "
            f"becomes {calibration.temperature.noise_gain_w_per_k:.0f} W"
        )
    lines += ["", *_table(calibration)]
    warnings = [f"{warning} [{warning.code}]" for warning in criticism.warnings]
    for title, words in (("warnings", warnings), ("remarks", calibration.remarks)):
        if words:
            lines += ["", f"{title}:", *(f"- {word}" for word in words)]
    return "\n".join(lines)


def with_std(value: float, std: float) -> str:
    """Return a value with its standard error, to two digits of the error; without one, the value alone.

    Examples
    --------
    >>> with_std(1.0182, 0.0021), with_std(10.0, 0.0), with_std(169.0, 3e5)
    ('1.0182 ± 0.0021', '10', '169 (not determined)')
    >>> with_std(133.5, 26.1), with_std(1203.0, 1980.0), with_std(-2.147e-6, 1.6e-7)
    ('134 ± 26', '1200 ± 2000', '-2.15e-06 ± 0.16e-06')
    """
    if std == 0.0 or not math.isfinite(std):
        return f"{value:.4g}" + ("" if std == 0.0 else " (not determined)")
    if std > 10.0 * abs(value):
        return f"{value:.3g} (not determined)"
    decimals = 1 - int(f"{std:.1e}".partition("e")[2])
    power = int(f"{max(abs(value), std):.1e}".partition("e")[2])
    if -4 < power < 6:
        places = max(decimals, 0)
        return f"{round(value, decimals):.{places}f} ± {round(std, decimals):.{places}f}"
    places = max(decimals + power, 0)
    return f"{value / 10.0**power:.{places}f}e{power:+03d} ± {std / 10.0**power:.{places}f}e{power:+03d}"


def _table(calibration: Calibration) -> list[str]:
    rows = [["data", "part", "h", "fit %", "rms µm", "p-p µm", "no comp. µm", "persistence µm"]]
    rows += error_rows(calibration, folds="folds", arx="ARX, to compare")
    return aligned(rows, left=2)


def error_rows(calibration: Calibration, *, folds: str, arx: str) -> list[list[str]]:
    """Return the errors in free run, a row for each part of the data, one for the folds and one for the ARX fit.

    Parameters
    ----------
    calibration : Calibration
        Result of the identification.
    folds, arx : str
        Names of the last two rows.
    """
    period_h = calibration.model.period_s / 3600.0
    arx_rms = f"{calibration.arx_rms_um:.2f}" if math.isfinite(calibration.arx_rms_um) else "unstable"
    return [
        *(
            [
                part.name,
                part.role,
                f"{part.y_um.size * period_h:.1f}",
                f"{part.model.fit_pct:.2f}",
                f"{part.model.rms_um:.2f}",
                f"{part.model.peak_to_peak_um:.2f}",
                f"{part.nothing.rms_um:.2f}",
                f"{part.persistence.rms_um:.2f}",
            ]
            for part in calibration.parts
        ),
        [folds, "held out", "", "", f"{calibration.folds_rms_um:.2f}", "", "", ""],
        [arx, "fitted", "", "", arx_rms, "", "", ""],
    ]


def aligned(rows: Sequence[Sequence[str]], *, left: int) -> list[str]:
    """Return the lines of a table of text; the first columns are left-aligned.

    Examples
    --------
    >>> aligned([["data", "h"], ["a", "10"]], left=1)
    ['data   h', 'a     10']
    """
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(f"{c:{'<' if i < left else '>'}{widths[i]}}" for i, c in enumerate(row)) for row in rows]
