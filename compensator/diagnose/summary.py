"""A diagnosis in figures and in words: `diagnosis.json` and the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from compensator.codes import ModelWarning
from compensator.diagnose.fit import Term
from compensator.diagnose.outcome import Diagnosis, FoundEffect
from compensator.identify.summary import with_std
from compensator.model.simulation import Scores

_VERDICTS = {
    "adequate": "The model is adequate: the residual is noise.",
    "explained": "What the model lacks is found; the residual with it is noise.",
    "partly_explained": "Part of what the model lacks is found; something is left.",
    "unexplained": "Something acts that the model lacks and that no channel shows.",
}
#: The same where what was found makes held-out data worse.
_DOES_NOT_HOLD = (
    "Something acts that the model lacks; what fits it best here does not hold on held-out data, so the model was left "
    "as it was."
)

#: What `diagnosis.json` says of an effect, after its place.
_FIGURES = ("parameters", "deployable", "explanation", "rms_before_um", "rms_after_um")


def figures(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the diagnosis as `diagnosis.json` holds it."""
    return {
        "verdict": diagnosis.verdict,
        "effects": [
            {
                **_place(effect.term),
                **{key: effect[key] for key in _FIGURES},
            }
            for effect in diagnosis.effects
        ],
        "rivals": [
            {**_place(rival.term), "rms_after_um": rival.rms_after_um, "how_to_tell_apart": rival.how_to_tell_apart}
            for effect in diagnosis.effects
            for rival in effect.rivals
        ],
        "before": _scores(diagnosis.before),
        "after": _scores(diagnosis.after),
        "held_out": diagnosis.held_out,
        "noise_floor_um": diagnosis.noise_floor_um,
        "warnings": list(map(str, diagnosis.warnings)),
        "warning_codes": [warning.code for warning in diagnosis.warnings],
    }


def _place(term: Term) -> dict[str, Any]:
    kind, path, channel = term.hypothesis.place
    return {"kind": kind, "path": path or None, "channel": channel or None, "form": term.hypothesis.form}


def _scores(scores: Scores) -> dict[str, float | None]:
    values = {"rms_um": scores.rms_um, "peak_to_peak_um": scores.peak_to_peak_um, "fit_pct": scores.fit_pct}
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def verdict(diagnosis: Diagnosis) -> str:
    """Return the diagnosis in one or two sentences."""
    words = _VERDICTS[diagnosis.verdict]
    if any(warning.code == ModelWarning.MADE_WORSE for warning in diagnosis.warnings):
        words = _DOES_NOT_HOLD
    before, after, noise = diagnosis.before.rms_um, diagnosis.after.rms_um, diagnosis.noise_floor_um
    if not diagnosis.effects:
        return f"{words} Residual {before:.2f} µm rms, sensor noise {noise:.2f}."
    return (
        f"{words} {_names(diagnosis.effects)}. On held-out data the residual goes from {before:.2f} to {after:.2f} µm "
        f"rms (sensor noise {noise:.2f})."
    )


def _names(effects: Sequence[FoundEffect]) -> str:
    """Return kinds and places of all effects, those of one kind together."""
    places: dict[str, list[str]] = {}
    for effect in effects:
        kind, _, place = name(effect).partition(": ")
        places.setdefault(kind, []).append(place)
    return "; ".join(": ".join(filter(None, (kind, ", ".join(filter(None, where))))) for kind, where in places.items())


def name(effect: FoundEffect) -> str:
    """Return an effect's kind and place."""
    kind, *where = effect.place
    return ": ".join(part for part in (kind.capitalize(), " ".join(word for word in where if word)) if part)


def text(diagnosis: Diagnosis) -> str:
    """Return the summary for the terminal."""
    lines = [verdict(diagnosis)]
    for i, effect in enumerate(diagnosis.effects, start=1):
        values = ", ".join(f"{n} {with_std(v, effect.std[n])}" for n, v in list(effect.named.items())[:6])
        lines += ["", f"{i}. {name(effect)}: {values}", f"   {effect.explanation}"]
        if not effect.deployable:
            lines.append("   It cannot be compensated by the model; model.toml leaves it out.")
        lines += [
            f"   nearly as good: {rival.label} ({rival.rms_after_um:.2f} µm rms). {rival.how_to_tell_apart}"
            for rival in effect.rivals
        ]
    if diagnosis.warnings:
        lines += ["", "warnings:", *(f"- {word} [{word.code}]" for word in diagnosis.warnings)]
    return "\n".join(lines)
