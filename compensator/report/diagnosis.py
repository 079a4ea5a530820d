"""The page of a diagnosis: what the model lacks, and the error before and after."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.outcome import Diagnosis, FoundEffect
from compensator.diagnose.summary import name, verdict
from compensator.identify.summary import with_std
from compensator.model.thermal_model import ThermalModel
from compensator.report.formats import write
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
    write_page,
)

#: Parameters of an effect that are shown unfolded.
SHOWN = 6

#: Units in the names of parameters, and on the page.
_UNITS = {
    "um": "µm",
    "k": "K",
    "w": "W",
    "min": "min",
    "h": "h",
    "s": "s",
    "degc": "°C",
    "rpm": "(1/min)",
    "pct": "%",
    "bar": "bar",
}

_TONES: dict[str, Tone] = {"adequate": "good", "explained": "good", "partly_explained": "warn", "unexplained": "warn"}


def write_report(
    path: Path, diagnosis: Diagnosis, model: ThermalModel, remarks: Sequence[str], *, also: Path | None = None
) -> Path:
    """Write the page.

    Parameters
    ----------
    path, also : pathlib.Path
        The HTML file, and another file for the same page, with any suffix of `formats.SUFFIXES`.
    diagnosis : Diagnosis
        The diagnosis.
    model : ThermalModel
        As written, with its hash.
    remarks : sequence of str
        Corrections made while reading the data.
    """
    t = _hours(diagnosis)
    blocks: list[Block] = [_before_and_after(t, diagnosis), _errors(diagnosis)]
    blocks += [_effect(t, effect) for effect in diagnosis.effects]
    if diagnosis.warnings:
        blocks.append(warnings_of(diagnosis.warnings))
    if diagnosis.tried:
        blocks.append(_ranking(diagnosis))
    blocks.append(_details(t, diagnosis, model, remarks))
    title = f"Diagnosis: what {model.name} lacks"
    page = Page(title=title, verdict=verdict(diagnosis), blocks=blocks, tone=_TONES[diagnosis.verdict])
    if also is not None:
        write(also, page)
    return write_page(path, page)


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


def _errors(diagnosis: Diagnosis) -> Table:
    rows = [
        [label, f"{s.rms_um:.2f}", f"{s.peak_to_peak_um:.1f}", f"{s.fit_pct:.2f}"]
        for label, s in (("base model", diagnosis.before), ("extended model", diagnosis.after))
    ]
    rows.append(["sensor noise alone", f"{diagnosis.noise_floor_um:.2f}", "", ""])
    return Table(
        title="Errors on held-out data",
        head=["", "rms µm", "peak to peak µm", "fit %"],
        rows=rows,
        note=f"Held-out data: {diagnosis.held_out}.",
    )


def _effect(t: Vector, effect: FoundEffect) -> Section:
    parameters = [[in_words(key), with_std(value, effect.std[key])] for key, value in effect.named.items()]
    rows = parameters[:SHOWN]
    rows.append(["residual of the fit without the effect, µm rms", f"{effect.rms_before_um:.2f}"])
    rows.append(["residual of the fit with the effect, µm rms", f"{effect.rms_after_um:.2f}"])
    deploy = "Deployed in the extended model." if effect.deployable else "Not deployable: not in the extended model."
    blocks: list[Block] = [
        Words(title="Explanation", lines=[effect.explanation, deploy]),
        Figure(
            title=f"Contribution: {name(effect)}",
            x_label="time, h",
            y_label="Y, µm",
            lines=(Line("effect", t, effect.signal),),
            height=2.6,
        ),
        Table(head=["parameter", "value ± standard error"], rows=rows),
    ]
    if len(parameters) > SHOWN:
        head = ["parameter", "value ± standard error"]
        blocks.append(Details(title=f"All {len(parameters)} parameters", blocks=[Table(head=head, rows=parameters)]))
    if effect.rivals:
        blocks.append(
            Words(
                title="Rival explanations",
                lines=[f"{r.label}: {r.rms_after_um:.2f} µm rms remain. {r.how_to_tell_apart}" for r in effect.rivals],
            )
        )
    return Section(title=name(effect), blocks=blocks)


def in_words(key: str) -> str:
    """Return the name of a parameter with its unit in the usual notation.

    Examples
    --------
    >>> in_words("half_width_um"), in_words("gain_um_per_rpm2"), in_words("um_per_h"), in_words("change_per_100")
    ('half width, µm', 'gain, µm/(1/min)²', 'rate, µm/h', 'change per 100')
    """
    words = key.split("_")
    at = len(words)
    while at and (words[at - 1].rstrip("2") in _UNITS or words[at - 1] == "per"):
        at -= 1
    unit = "".join("/" if word == "per" else _UNITS[word.rstrip("2")] + "²" * word.endswith("2") for word in words[at:])
    return f"{' '.join(words[:at]) or 'rate'}{', ' if unit else ''}{unit}"


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
