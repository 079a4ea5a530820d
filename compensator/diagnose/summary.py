"""A diagnosis in figures and in words: `diagnosis.json` and the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from compensator.diagnose.joint import Part
from compensator.diagnose.outcome import Diagnosis, Effect
from compensator.identify.summary import with_std
from compensator.model.simulation import Scores

_VERDICTS = {
    "adequate": "The model is adequate: what is left is noise.",
    "explained": "What the model lacks is found; what is left with it is noise.",
    "partly_explained": "Part of what the model lacks is found; something is left.",
    "unexplained": "Something acts that the model lacks and that no channel shows.",
}


#: The words where what was found makes held-out data worse.
_DOES_NOT_HOLD = (
    "Something acts that the model lacks; what fits it best here does not hold on data that was not seen, so the model "
    "was left as it was."
)


def figures(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the diagnosis as `diagnosis.json` holds it."""
    return {
        "verdict": diagnosis.verdict,
        "effects": [
            {
                **_place(effect.part),
                "parameters": {
                    name: {"value": value, "std": effect.std[name]} for name, value in effect.part.named.items()
                },
                "deployable": effect.deployable,
                "explanation": effect.explanation,
                "rms_before_um": effect.rms_before_um,
                "rms_after_um": effect.rms_after_um,
            }
            for effect in diagnosis.effects
        ],
        "rivals": [
            {**_place(rival.part), "rms_after_um": rival.rms_after_um, "how_to_tell_apart": rival.how_to_tell_apart}
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


def _place(part: Part) -> dict[str, Any]:
    hypothesis = part.hypothesis
    return {
        "kind": hypothesis.kind,
        "path": hypothesis.path or None,
        "channel": hypothesis.channel or None,
        "form": hypothesis.form,
    }


def _scores(scores: Scores) -> dict[str, float | None]:
    values = {"rms_um": scores.rms_um, "peak_to_peak_um": scores.peak_to_peak_um, "fit_pct": scores.fit_pct}
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def verdict(diagnosis: Diagnosis) -> str:
    """Return the sentence to take away."""
    words = _VERDICTS[diagnosis.verdict]
    if any(warning.code == "made_worse" for warning in diagnosis.warnings):
        words = _DOES_NOT_HOLD
    if not diagnosis.effects:
        return f"{words} Residual {diagnosis.before.rms_um:.2f} µm rms, sensor noise {diagnosis.noise_floor_um:.2f}."
    return (
        f"{words} {_names(diagnosis.effects)}. On held-out data {diagnosis.before.rms_um:.2f} µm rms become "
        f"{diagnosis.after.rms_um:.2f} (sensor noise {diagnosis.noise_floor_um:.2f})."
    )


def _names(effects: Sequence[Effect]) -> str:
    """Return all effects in a few words, those of one kind together."""
    places: dict[str, list[str]] = {}
    for effect in effects:
        kind, _, place = name(effect).partition(": ")
        places.setdefault(kind, []).append(place)
    return "; ".join(": ".join(filter(None, (kind, ", ".join(filter(None, where))))) for kind, where in places.items())


def name(effect: Effect) -> str:
    """Return an effect's kind and place."""
    hypothesis = effect.part.hypothesis
    kind, *where = hypothesis.place
    return ": ".join(part for part in (kind.capitalize(), " ".join(word for word in where if word)) if part)


def text(diagnosis: Diagnosis) -> str:
    """Return the summary for the terminal."""
    lines = [verdict(diagnosis)]
    for i, effect in enumerate(diagnosis.effects, start=1):
        values = ", ".join(f"{n} {with_std(v, effect.std[n])}" for n, v in list(effect.part.named.items())[:6])
        lines += ["", f"{i}. {name(effect)}: {values}", f"   {effect.explanation}"]
        if not effect.deployable:
            lines.append("   It cannot be compensated by the model; model.toml leaves it out.")
        lines += [
            f"   nearly as good: {' '.join(w for w in r.part.hypothesis.place if w)} ({r.rms_after_um:.2f} µm rms). "
            f"{r.how_to_tell_apart}"
            for r in effect.rivals
        ]
    if diagnosis.warnings:
        lines += ["", "warnings:", *(f"- {word} [{word.code}]" for word in diagnosis.warnings)]
    return "\n".join(lines)
