"""The page of a calibration, for the engineer who approves it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.display import with_std
from compensator.identify.calibration import Calibration, Part, joined
from compensator.identify.choice import TriedStructure
from compensator.identify.coefficients import Row as Comparison
from compensator.identify.criticism import LAGS, Criticism, PathView, ResidualView
from compensator.identify.summary import (
    comparison_table,
    error_table,
    errors_of,
    parameter_table,
    share_left,
    verdict,
)
from compensator.model.free_run import FreeRunErrors, table_of
from compensator.model.thermal_model import ThermalModel
from compensator.report.page import (
    Bar,
    Block,
    Details,
    Figure,
    Line,
    Marks,
    Page,
    Row,
    Section,
    Span,
    Stems,
    Table,
    Tone,
    Words,
    files_of,
    warnings_of,
)


def page_of(
    calibration: Calibration,
    criticism: Criticism,
    model: ThermalModel,
    comparison: Sequence[Comparison] = (),
    free_run: Sequence[FreeRunErrors] = (),
) -> Page:
    """Make the page.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    criticism : Criticism
        Its diagnostics.
    model : ThermalModel
        The model as written, with its hash.
    comparison : sequence of Comparison
        Coefficients compared with those of another model.
    free_run : sequence of FreeRunErrors
        Errors in free run as the service runs.
    """
    errors = errors_of(calibration, free_run)
    blocks: list[Block] = [_prediction(calibration)]
    blocks += [table_of(free_run)] if free_run else []
    blocks.append(error_table(calibration))
    blocks += warnings_of(criticism.warnings)
    if comparison:
        blocks.append(comparison_table(comparison))
    blocks += [parameter_table(calibration, criticism), _coefficients(calibration)]
    blocks += [_path_section(view) for view in criticism.paths]
    blocks.append(Section(title="Residual analysis", blocks=[_correlations(view) for view in criticism.residuals]))
    blocks.append(_choice(calibration))
    blocks.append(_provenance(calibration, model))
    return Page(
        title=f"Calibration: {model.name}",
        verdict=verdict(errors),
        blocks=blocks,
        tone=tone_of(errors),
        data=files_of(model.provenance.get("data", [])),
    )


def tone_of(errors: Mapping[str, Any]) -> Tone:
    """Return the tone of a calibration by its errors on held-out data; see `summary.errors_of`."""
    share = share_left(errors)
    return "bad" if share >= 1.0 else "good" if share < 0.1 else "warn"


def _joined(parts: Sequence[Part]) -> tuple[Vector, Vector, Vector, tuple[Span, ...]]:
    """Return the parts on one time axis, and a span for each held-out part, the first of them named."""
    t, y, predicted, held_out = joined(parts)
    spans = (Span("" if i else "held out", first, last) for i, (first, last) in enumerate(held_out))
    return t, y, predicted, tuple(spans)


def _prediction(calibration: Calibration) -> Figure:
    """Show measured and predicted deformation; below it, on the same axis, the residual and what the model ran from."""
    t, y, predicted, spans = _joined(calibration.parts)
    unnamed = tuple(Span("", span.first, span.last) for span in spans)

    def panel(y_label: str, *lines: Line) -> Figure:
        return Figure(title="", x_label="time, h", y_label=y_label, lines=lines, spans=unnamed, height=2.0)

    temperatures = [
        Line(name, t, values)
        for name, key in (("T_Q", "t_q_degc"), ("AT", "at_degc"))
        if np.isfinite(values := _input(calibration.parts, key)).any()
    ]
    heat = _input(calibration.parts, "heat_w")
    below = [panel("residual, µm", Line("measured − predicted", t, y - predicted))]
    below += [panel("temperature, °C", *temperatures)] if temperatures else []
    below += [panel("heat, W", Line("heat, known", t, heat))] if np.isfinite(heat).any() else []
    return Figure(
        title="Measured and predicted deformation, free run from T_Q and AT",
        x_label="time, h",
        y_label="Y, µm",
        lines=(Line("measured", t, y), Line("predicted", t, predicted)),
        spans=spans,
        below=tuple(below),
        note=f"Measured Y is not fed back.{_averaged(calibration)}"
        + (" Shaded: held out from fitting and selection." if spans else ""),
    )


def _averaged(calibration: Calibration) -> str:
    """Return a sentence where the data have more than one row for each sample."""
    period_s = calibration.model.period_s
    rows_s = sorted({run.row_s for run in calibration.runs if run.row_s < period_s})
    if not rows_s:
        return f" Samples of {period_s:g} s."
    return f" Rows every {' or '.join(f'{row_s:g}' for row_s in rows_s)} s are averaged to samples of {period_s:g} s."


def _input(parts: Sequence[Part], key: str) -> Vector:
    """Return an input of all parts on the time axis of `joined`; NaN where it is unknown."""
    values: list[Vector] = []
    for i, part in enumerate(parts):
        if i and part.name != parts[i - 1].name:
            values.append(np.array([np.nan]))
        values.append(part.inputs.get(key, np.full(part.t_s.size, np.nan)))
    return np.concatenate(values)


def _coefficients(calibration: Calibration) -> Details:
    rows = []
    for path in calibration.paths:
        values = [*path.function.b, *path.function.a[1:]]
        stds = np.zeros(len(values))
        if path.fit is not None:
            stds = np.sqrt(np.diag(path.fit.coefficient_covariance(path.column)))
        names = [f"b{i}" for i in range(len(path.function.b))] + [f"a{i}" for i in range(1, len(path.function.a))]
        rows += [
            [f"{path.name}: {name}", with_std(value, std)]
            for name, value, std in zip(names, values, stds.tolist(), strict=True)
        ]
    return Details(title="Coefficients of 1/z", blocks=[Table(head=["coefficient", "value"], rows=rows)])


def _path_section(view: PathView) -> Block:
    unit = view.unit.replace("um", "µm")
    hours = view.t_min / 60.0

    def plot(name: str, x_label: str, y_label: str, *lines: Line, **options: Any) -> Figure:
        title = f"{view.name}: {name}"
        return Figure(title=title, x_label=x_label, y_label=y_label, lines=lines, height=3.2, **options)

    band = (view.step - 2 * view.step_std, view.step + 2 * view.step_std)
    step = Line("step, ± 2 standard errors", hours, view.step, band=band)
    settles = f"Settles at {with_std(view.gain, view.gain_std)} {unit} (dashed)."
    zeros = [Marks("zeros", view.zeros.real, view.zeros.imag, marker="o")] if view.zeros.size else []
    poles = (Marks("poles", view.poles.real, view.poles.imag), *zeros)
    impulse = Line("impulse", hours, view.impulse)
    magnitude = Line("magnitude", view.frequency_per_h, view.magnitude)
    phase = Line("phase", view.frequency_per_h, view.phase_deg)
    shown = (
        plot("step response", "time, h", unit, step, limits=(view.gain,), note=settles),
        _time_constants(view),
    )
    folded = (
        plot("poles and zeros, z plane", "real part", "imaginary part", unit_circle=True, marks=poles),
        plot("impulse response", "time, h", f"{unit} per sample", impulse),
        plot("magnitude", "frequency, 1/h", unit, magnitude, x_log=True, y_log=True),
        plot("phase", "frequency, 1/h", "degrees", phase, x_log=True),
    )
    details = Details(
        title=f"{view.name}: poles and zeros, impulse response, Bode diagram", blocks=[Row(figures=folded)]
    )
    return Section(title=view.name, blocks=[Row(figures=shown), details])


def _minutes(tau_min: float, std_min: float) -> str:
    value, space, rest = with_std(tau_min, std_min).partition(" (")
    return f"{value} min{space}{rest}"


def _time_constants(view: PathView) -> Figure:
    """Show the time constants as bars: on a z plane slow poles are dots on top of each other at 1."""
    bars = tuple(
        Bar(f"time constant {i}", _minutes(tau, std), 0.0, tau, 1, joined=False)
        for i, (tau, std) in enumerate(zip(view.taus_min, view.taus_std_min, strict=True), start=1)
        if math.isfinite(tau) and tau > 0.0
    )
    return Figure(
        title=f"{view.name}: time constants",
        x_label="time constant, min",
        y_label="mode",
        bars=bars,
        height=1.1 + 0.5 * max(len(bars), 1),
        note="With standard errors." if bars else "No real time constant.",
    )


def _correlations(view: ResidualView) -> Block:
    def plot(name: str, stems: Stems, limit: float, note: str = "") -> Figure:
        title, limits = f"{view.name}: {name}", (-limit, limit)
        axes: dict[str, Any] = {"x_label": f"lag, {view.lag_unit}", "y_label": "correlation", "height": 3.0}
        return Figure(title=title, stems=(stems,), limits=limits, note=note, **axes)

    lags = np.arange(1, view.autocorrelation.size + 1, dtype=np.float64)
    both = np.arange(-LAGS, LAGS + 1, dtype=np.float64)
    note = f"Dashed: 99 % limits of white noise. Whiteness test: p {_probability(view.white_chance)}."
    own = plot("autocorrelation of the residual", Stems("residual", lags, view.autocorrelation), view.limit, note)
    cross = (
        plot(f"correlation of the residual with {name}", Stems(name, both, values), limit)
        for name, (values, limit) in view.cross.items()
    )
    return Row(figures=(own, *cross))


def _probability(p: float) -> str:
    return f"= {p:.2g}" if p >= 0.001 else "< 0.001"


def _choice(calibration: Calibration) -> Block:
    by_blocks = "Chosen: the simplest structure whose held-out error is within one standard error of the best."
    by_information = (
        "Chosen: the structure with the best information criterion (Akaike's, for few values), as blocks with few "
        "values differ by chance."
    )
    sparse = any(run.has_sparse_y for run in calibration.runs)

    def table(title: str, candidates: Sequence[TriedStructure]) -> Table:
        return Table(
            title=title,
            head=["structure", "held-out rms, µm", "worst block, µm", ""],
            rows=[
                [
                    c.label,
                    f"{c.rms:.3f}",
                    f"{max(c.fold_rms):.3f}",
                    "chosen" if c.chosen else "" if c.supported else "not supported by the data",
                ]
                for c in candidates
            ],
            note=by_information if sparse else by_blocks,
        )

    blocks = [
        table("DTF and TDTF" if calibration.settings.method == "IV" else "DTF", calibration.deformation.candidates)
    ]
    if calibration.deformation.etve_candidates:
        blocks.append(table("TDTF, on the ETVE", calibration.deformation.etve_candidates))
    return Details(title="Order selection", blocks=blocks)


def _provenance(calibration: Calibration, model: ThermalModel) -> Block:
    asked = model.provenance.get("asked", {})
    rows = [
        ["model", model.name],
        ["kind", model.kind],
        ["method", calibration.settings.method],
        ["SHA-256 of the model file", model.sha256],
    ]
    for entry in model.provenance.get("data", []):
        rows.append([f"{entry['role']}: {entry.get('file') or entry['table']}", entry["sha256"]])
    if asked.get("columns"):
        rows.append(["columns by role", ", ".join(asked["columns"])])
    rows.append(["sample period, s", f"{model.period_s:g}"])
    for name, (low, high) in model.validity.items():
        rows.append([f"valid for {name}", f"{low:g} to {high:g}"])
    for name, value in calibration.noise.items():
        rows.append([f"noise of a sample, {name}", f"{value:.3g}"])
    for i, segment in enumerate(calibration.deformation.segments):
        rows.append([f"{calibration.runs[i].name} starts", "at rest" if segment.rest else "from a fitted state"])
    blocks: list[Block] = [Table(head=["", ""], rows=rows)]
    if calibration.remarks:
        blocks.append(Words(title="Remarks on the data", lines=calibration.remarks))
    return Details(title="Data, validity, provenance", blocks=blocks)
