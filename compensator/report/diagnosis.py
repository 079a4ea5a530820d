"""The page of a diagnosis: what the model lacks, and the error before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.outcome import Diagnosis, FoundEffect
from compensator.diagnose.summary import (
    SHOWN,
    error_table,
    explanation,
    figures,
    name,
    parameter_table,
    rivals,
    verdict,
)
from compensator.model.thermal_model import ThermalModel
from compensator.report.advice import advice_blocks
from compensator.report.page import (
    Block,
    Details,
    Figure,
    Line,
    Page,
    Section,
    Table,
    Tone,
    Words,
    warnings_of,
)

#: Tone of each verdict.
TONES: dict[str, Tone] = {"adequate": "good", "explained": "good", "partly_explained": "warn", "unexplained": "warn"}


def page_of(diagnosis: Diagnosis, model: ThermalModel, remarks: Sequence[str]) -> Page:
    """Make the page.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    model : ThermalModel
        The extended model as written, with its hash.
    remarks : sequence of str
        Remarks on the data.
    """
    t = _hours(diagnosis)
    blocks: list[Block] = [_before_and_after(t, diagnosis), error_table(diagnosis)]
    blocks += [_effect(t, effect) for effect in diagnosis.effects]
    blocks += advice_blocks(diagnosis)
    blocks += warnings_of(diagnosis.warnings)
    if diagnosis.tried:
        blocks.append(_ranking(diagnosis))
    blocks.append(_details(t, diagnosis, model, remarks))
    title = f"Diagnosis: what {model.name} lacks"
    return Page(title=title, verdict=verdict(figures(diagnosis)), blocks=blocks, tone=TONES[diagnosis.verdict])


def _hours(diagnosis: Diagnosis) -> Vector:
    """Return a time axis in hours, the runs one after another."""
    period_h = diagnosis.model.period_s / 3600.0
    return np.asarray(np.arange(diagnosis.residual_before.size) * period_h)


def _before_and_after(t: Vector, diagnosis: Diagnosis) -> Figure:
    count = len(diagnosis.effects)
    found = name(diagnosis.effects[0]) if count == 1 else f"all {count} effects" if count else "nothing to add"
    return Figure(
        title="Residual before and after the extension",
        x_label="time, h",
        y_label="residual, µm",
        lines=(
            Line("before", t, diagnosis.held_out_before),
            Line(f"after: {found}", t, diagnosis.held_out_after),
        ),
        note="Measured − predicted on held-out data: each block was left out of the search that predicts it.",
    )


def _effect(t: Vector, effect: FoundEffect) -> Section:
    blocks: list[Block] = [
        explanation(effect),
        Figure(
            title=f"Contribution: {name(effect)}",
            x_label="time, h",
            y_label="Y, µm",
            lines=(Line("effect", t, effect.signal),),
            height=2.6,
        ),
        parameter_table(effect, count=SHOWN),
    ]
    count = len(effect.named)
    if count > SHOWN:
        blocks.append(Details(title=f"All {count} parameters", blocks=[parameter_table(effect)]))
    if effect.rivals:
        blocks.append(rivals(effect))
    return Section(title=name(effect), blocks=blocks)


def _ranking(diagnosis: Diagnosis) -> Details:
    chosen = diagnosis.effects[0]
    rows = [[name(chosen), f"{chosen.rms_after_um:.2f}", "chosen"]]
    rows += [[label, f"{rms:.2f}", ""] for label, rms in diagnosis.tried]
    return Details(
        title="Candidates for the largest effect, ranked",
        blocks=[Table(head=["candidate", "remaining µm rms", ""], rows=rows)],
    )


def _details(t: Vector, diagnosis: Diagnosis, model: ThermalModel, remarks: Sequence[str]) -> Details:
    rows = [["extended model, SHA-256", model.sha256]]
    rows += [
        [f"data: {d.get('file') or d['table']}", d["sha256"]]
        for d in model.provenance.get("diagnosis", {}).get("data", [])
    ]
    figure = Figure(
        title="Residual of the fit to all data",
        x_label="time, h",
        y_label="residual, µm",
        lines=(Line("before", t, diagnosis.residual_before), Line("after", t, diagnosis.residual_after)),
        height=2.6,
    )
    blocks: list[Block] = [figure, Table(head=["", ""], rows=rows)]
    if remarks:
        blocks.append(Words(title="Remarks on the data", lines=remarks))
    return Details(title="Residual of the fit, files", blocks=blocks)
