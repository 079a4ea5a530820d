"""The page of a diagnosis: what the model lacks, what each effect removes, and what the channels could explain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.choice.outcome import Diagnosis
from compensator.diagnose.choice.verdict import is_contradicted
from compensator.diagnose.words.advice_words import advice_lines
from compensator.diagnose.words.ceiling_words import ceiling, falls_short
from compensator.diagnose.words.free_run_words import off_zero
from compensator.diagnose.words.remainder_words import remainder
from compensator.diagnose.words.standing import is_in_the_model
from compensator.diagnose.words.summary import (
    SHOWN,
    channels_to_configure,
    error_table,
    explanation,
    figures,
    headline,
    hiding_lines,
    name,
    parameter_table,
    rivals,
)
from compensator.model.effects.seen import unit_of_channel
from compensator.model.free_run import FreeRunErrors, table_of
from compensator.model.thermal_model import ThermalModel
from compensator.report.figure import Edges
from compensator.report.held_out import TimeAxis, waterfall
from compensator.report.page import (
    Block,
    Details,
    Figure,
    Page,
    Section,
    Table,
    Tone,
    Words,
    files_of,
    warnings_of,
)

#: Causes that are drawn below the first picture.
CAUSES = 3
#: Tone of each verdict.
TONES: dict[str, Tone] = {"adequate": "good", "explained": "good", "partly_explained": "warn", "unexplained": "warn"}


def tone_of(found: Mapping[str, Any]) -> Tone:
    """Return the tone of a diagnosis: that of its verdict.

    No good one where the named effects fall short, where a run that took no part says otherwise, where none of them can
    be deployed, or where an adequate model errs about the zero.

    Parameters
    ----------
    found : mapping
        Content of `diagnosis.json`.
    """
    tone = TONES[found["verdict"]]
    if is_contradicted(found) or off_zero(found):
        return "warn"
    holds = not found["effects"] or (is_in_the_model(found) and not falls_short(found))
    return tone if holds else "warn"


def page_of(
    diagnosis: Diagnosis,
    model: ThermalModel,
    remarks: Sequence[str],
    free_run: Sequence[FreeRunErrors] = (),
    *,
    since_utc_s: float | None = None,
    sources: Sequence[Mapping[str, Any]] = (),
) -> Page:
    """Make the page.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    model : ThermalModel
        The extended model as written, with its hash.
    remarks : sequence of str
        Remarks on the data.
    free_run : sequence of FreeRunErrors
        Errors of both models in free run as the service runs.
    since_utc_s : float, optional
        When the data begin, s since 1970 UTC.
    sources : sequence of mapping
        Name and hash of the data.
    """
    time = TimeAxis.of(diagnosis, since_utc_s)
    found = figures(diagnosis, free_run)
    blocks: list[Block] = [_picture(time, diagnosis)] if diagnosis.effects else []
    if len(diagnosis.effects) + (diagnosis.remainder is not None) != 1:
        blocks.append(waterfall(diagnosis))
    blocks += [table_of(free_run)] if free_run else []
    blocks += [_before_and_after(time, diagnosis), error_table(diagnosis), ceiling(found)]
    blocks += [_effect(time, diagnosis, effect) for effect in diagnosis.effects]
    blocks += remainder(found)
    blocks += channels_to_configure(diagnosis)
    if hidden := hiding_lines(found):
        blocks.append(Words(title="What could hide", lines=hidden))
    blocks += _advice(diagnosis)
    blocks += warnings_of(diagnosis.warnings)
    if diagnosis.tried:
        blocks.append(_ranking(diagnosis))
    blocks.append(_details(time, diagnosis, model, remarks, sources))
    title = f"Diagnosis: what {model.name} lacks"
    return Page(title=title, verdict=headline(found), blocks=blocks, tone=tone_of(found), data=files_of(sources))


def _picture(time: TimeAxis, diagnosis: Diagnosis) -> Figure:
    """Show the residual of the base model, the effects over it, and below it what the largest of them act by."""
    total = np.sum([effect.removed for effect in diagnosis.effects], axis=0)
    remainder, beside = diagnosis.remainder, diagnosis.paths_um + diagnosis.remainder_um
    deployed = remainder is not None and remainder.deployed
    stands = deployed and remainder is not None and remainder.instead
    causes = {cause[0]: cause for effect in diagnosis.effects for cause in _causes(diagnosis, effect)}
    below = _panels(time, list(causes.values())[:CAUSES], edges=time.unnamed_runs, height=1.7)
    one = len(diagnosis.effects) == 1
    words = name(diagnosis.effects[0]) if one else f"the {len(diagnosis.effects)} effects found"
    refitted = bool(diagnosis.paths_um.any())
    added = total + diagnosis.paths_um
    effects = "effect" if one else "all effects"
    if refitted:
        effects += ", with the paths refitted"
    inside = [effect.deployable for effect in diagnosis.effects]
    if not all(inside):
        effects += " (not in the extended model)" if not any(inside) else " (not all in the extended model)"
    lines = [
        time.line("residual of the base model", diagnosis.residual_after + total + beside, weight=0.9),
        time.line(effects, added, weight=2.2),
    ]
    if stands:
        lines.append(time.line("remainder, in place of the effects", added + diagnosis.remainder_um))
    elif deployed:
        lines.append(time.line("remainder (explains nothing)", diagnosis.remainder_um))
    return Figure(
        title=f"Measured − predicted by the base model, and {words}",
        x_label=time.label,
        y_label="Y, µm",
        lines=tuple(lines),
        edges=time.runs,
        below=below,
        note="Residual in the data that were searched, zero and initial state as fitted with everything found. What "
        "lies between it and the effects is what these do not explain."
        + (" Below: the inputs of the effects." if below else " No channel shows the cause.")
        + time.note,
    )


def _before_and_after(time: TimeAxis, diagnosis: Diagnosis) -> Figure:
    remainder, count = diagnosis.remainder, len(diagnosis.effects)
    parts = [name(diagnosis.effects[0]) if count == 1 else f"all {count} effects"] if count else []
    if remainder is not None:
        parts = ["the remainder, in place of the effects"] if remainder.instead else [*parts, "the remainder"]
    lines = [time.line("before" if parts else "base model", diagnosis.held_out_before)]
    if parts:
        with_it = "with what is not deployed" if diagnosis.refused else "after"
        lines.append(time.line(f"{with_it}: {' and '.join(parts)}", diagnosis.held_out_found))
    return Figure(
        title=f"Residual{' before and after the extension' if parts else ''} on held-out data",
        x_label=time.label,
        y_label="residual, µm",
        lines=tuple(lines),
        edges=time.edges,
        note="Measured − predicted: each block is predicted by a search that did not use it. A jump at a dashed edge "
        "comes from this change of search, not from the machine." + time.note,
    )


def _effect(time: TimeAxis, diagnosis: Diagnosis, effect: FoundEffect) -> Section:
    blocks: list[Block] = [explanation(effect)]
    if len(diagnosis.effects) > 1:
        # The only effect is in the first picture.
        blocks.append(_effect_figure(time, diagnosis, effect))
    blocks.append(parameter_table(effect, count=SHOWN))
    count = len(effect.named)
    if count > SHOWN:
        blocks.append(Details(title=f"All {count} parameters", blocks=[parameter_table(effect)]))
    if effect.rivals:
        blocks.append(rivals(effect))
    return Section(title=name(effect), blocks=blocks)


def _effect_figure(time: TimeAxis, diagnosis: Diagnosis, effect: FoundEffect) -> Figure:
    """Show the residual without the effect, the effect over it, and below it what it acts by."""
    causes = _causes(diagnosis, effect)
    below = _panels(time, causes, edges=time.unnamed, height=1.9)
    with_remainder = " The remainder is not removed from it." if diagnosis.remainder_um.any() else ""
    note = f"Residual in the data that were searched, without every other effect.{with_remainder}"
    return Figure(
        title=f"{name(effect)} in the residual",
        x_label=time.label,
        y_label="Y, µm",
        lines=(
            time.line(
                "residual without it", diagnosis.residual_after + diagnosis.remainder_um + effect.removed, weight=0.9
            ),
            time.line(
                "effect" if effect.deployable else "effect (not in the extended model)",
                effect.signal,
                weight=2.2,
            ),
        ),
        edges=time.edges,
        below=below,
        note=f"{note} {'' if causes else 'No channel shows its cause.'}{time.note}".strip(),
    )


def _panels(
    time: TimeAxis, causes: Sequence[tuple[str, str, Vector]], *, edges: tuple[Edges, ...], height: float
) -> tuple[Figure, ...]:
    """Return a panel below a picture for each cause (`_causes`)."""
    return tuple(
        Figure(
            title="",
            x_label=time.label,
            y_label=unit,
            lines=(time.line(label, values),),
            edges=edges,
            height=height,
        )
        for label, unit, values in causes
    )


def _causes(diagnosis: Diagnosis, effect: FoundEffect) -> list[tuple[str, str, Vector]]:
    """Return what an effect acts by, its unit and its course: its channels, or what drives its path."""
    records = diagnosis.evidence.signals
    if channels := effect.channels:
        columns = [np.concatenate([record.channels[name] for record in records]) for name in channels]
        return [(name, unit_of_channel(name), values) for name, values in zip(channels, columns, strict=True)]
    if (path := effect.path) is None:
        return []
    source = np.concatenate([record.source(path) for record in records])
    if path == "TDTF":
        return [("AT, change from the start", "K", source)]
    return [("heat, estimated", "W", source) if diagnosis.model.ttf else ("T_Q − AT", "K", source)]


def _advice(diagnosis: Diagnosis) -> list[Block]:
    """Return a section with the advice; none where there is nothing to do."""
    lines, advice = advice_lines(diagnosis.advice), diagnosis.advice
    if not lines or advice is None:
        return []
    blocks: list[Block] = [Words(title="Advice", lines=lines)]
    if advice.unexplained is not None and advice.nearest:
        rows = [[near.channel, f"{near.evidence:.1f}", f"{near.lag_min:+.0f}"] for near in advice.nearest]
        blocks.append(
            Table(
                head=["nearest channel", "adds to the log evidence", "best single lag, min"],
                rows=rows,
                note="Each channel alone, with lags in both directions. Negative: the channel follows the cause.",
            )
        )
    return [Section(title="What to measure and test next", blocks=blocks)]


def _ranking(diagnosis: Diagnosis) -> Details:
    chosen = diagnosis.effects[0].term.hypothesis.label
    rows = [[label, f"{rms:.2f}", "chosen" if label == chosen else ""] for label, rms in diagnosis.tried]
    return Details(
        title="Candidates for the largest effect, ranked",
        blocks=[Table(head=["candidate", "remaining µm rms", ""], rows=rows)],
    )


def _details(
    time: TimeAxis,
    diagnosis: Diagnosis,
    model: ThermalModel,
    remarks: Sequence[str],
    sources: Sequence[Mapping[str, Any]],
) -> Details:
    rows = [
        ["extended model, SHA-256", model.sha256],
        ["standard deviation that it states, µm", f"{model.y_std_um:.2f}"],
    ]
    rows += [[f"data: {one.get('file') or one['table']}", one["sha256"]] for one in sources]
    figure = Figure(
        title="Residual of the fit to all data",
        x_label=time.label,
        y_label="residual, µm",
        lines=(time.line("before", diagnosis.residual_before), time.line("after", diagnosis.residual_after)),
        edges=time.runs,
        height=2.6,
    )
    blocks: list[Block] = [figure, Table(head=["", ""], rows=rows)]
    if remarks:
        blocks.append(Words(title="Remarks on the data", lines=remarks))
    return Details(title="Residual of the fit, files", blocks=blocks)
