"""A diagnosis as figures, tables and text for `diagnosis.json`, terminal, notebook and page."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from compensator.arrays import rms_of
from compensator.channel_lines import channel_lines, unusable_names
from compensator.codes import ModelWarning, Remark
from compensator.diagnose.advice.ceiling import Ceiling
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.choice.outcome import Diagnosis, Remainder
from compensator.diagnose.choice.verdict import verdict_of
from compensator.diagnose.fitting.fit import Term
from compensator.diagnose.search.detection_limit import DetectionLimits
from compensator.diagnose.words.advice_words import advice_lines, advice_table
from compensator.diagnose.words.ceiling_words import ceiling, explained, falls_short, found_rms, named_rms
from compensator.diagnose.words.free_run_words import free_run_sentence, off_zero
from compensator.diagnose.words.remainder_words import lowers, remainder
from compensator.diagnose.words.standing import words as of_the_effects
from compensator.display import Listing, Table, Words, warnings_of, with_std
from compensator.model.free_run import FreeRunErrors, table_of
from compensator.model.simulation import SCORE_HEAD, Scores

_VERDICTS = {
    "adequate": (
        "The model is adequate: with its zero and initial state fitted, the residual is within the noise and the "
        "model's own error."
    ),
    "explained": (
        "The missing effects were found; the rest of the residual is within the noise and the model's own error."
    ),
    "partly_explained": "Some of the missing effects were found; part of the residual remains unexplained.",
    "unexplained": "The model lacks an effect that no channel shows.",
}
#: The same of Y that was measured now and then.
_ADEQUATE_VALUES = "The model is adequate as far as so few values can show: the residual is within their noise."
#: The verdict if few values leave nothing but noise and could not have shown what matters.
_CANNOT_SHOW = (
    "The residual is within the noise, but these values are too few or too noisy to show whether the model is adequate."
)
#: The verdict if few values leave nothing but noise and an effect would explain some of it.
_UNDECIDED = "The residual is within the noise, yet {names} may act: these values cannot decide this."
#: What could hide in few values.
_HIDDEN = {
    "gain": "an error of the {path}'s gain",
    "drift": "a drift",
    "step": "a step",
    "unobserved": "a source that no channel shows",
}
#: The verdict if a path would have to be reversed.
_REVERSED = "Measured Y moves against the model: a wrong sign, or a model of another machine. Nothing is deployed."
#: The verdict if the effects found increase the error on held-out data.
_DOES_NOT_HOLD = (
    "The model lacks an effect; the best explanation found increases the error on held-out data, so the model was "
    "left unchanged."
)
#: The verdict if what would be deployed increases the error of its own data in free run.
_NOT_IN_FREE_RUN = (
    "The model lacks an effect; the best explanation found increases the error in free run over the same data, so the "
    "model was left unchanged."
)
#: The verdict if the record is too short for what was found.
_SHORT = (
    "The model lacks an effect; what was found explains the record only in part, and the record is too short to extend "
    "the model by it: it was left unchanged."
)
#: The verdict if the effects found do not predict held-out values, which decide nothing where they are few.
_NOT_FORETOLD = "The model lacks an effect; the best explanation found does not predict held-out values."
#: The verdict if nothing was named and the channels show some of what acts.
_WITHOUT_A_NAME = "The model lacks an effect that has no name here; the logged channels show some of it."
#: The verdict if nothing was named, and a correction of the base's own paths explains much.
_OWN_PATHS = (
    "The paths of the model do not fit these data, and no named effect explains it: calibrate the machine anew. Until "
    "then the remainder corrects the paths."
)
#: The verdict if the base leaves noise where it is fitted to, and clearly more on held-out data.
_FORETELLS_LESS = (
    "Something acts, or the record began warm: with its zero and initial state fitted, the model leaves noise, but it "
    "does not foretell the rest of the record. Record longer, or begin at rest."
)
#: The verdict if the effects found explain clearly less than the channels can, whatever a remainder corrects.
_FALLS_SHORT = "Some of the missing effects were found; the channels show more than these explain."

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
    "lpm": "(l/min)",
    "pct": "%",
    "bar": "bar",
}

#: Keys of an effect in `diagnosis.json`, after its place.
_FIGURES = ("parameters", "deployable", "left_in", "explanation", "rms_before_um", "rms_after_um")


def figures(diagnosis: Diagnosis, free_run: Sequence[FreeRunErrors] = ()) -> dict[str, Any]:
    """Return the content of `diagnosis.json`."""
    runs = [one.to_dict() for one in free_run]
    return {
        "verdict": verdict_of(diagnosis.verdict, runs, diagnosis.noise_floor_um),
        "effects": [
            {
                **_place(effect.term),
                **{key: effect[key] for key in _FIGURES},
                "determined": effect.is_determined,
            }
            for effect in diagnosis.effects
        ],
        "rivals": [
            {
                **_place(rival.term),
                "rms_after_um": rival.rms_after_um,
                "rms_chosen_um": rival.rms_chosen_um,
                "log_evidence": rival.log_evidence,
                "how_to_tell_apart": rival.how_to_tell_apart,
            }
            for effect in diagnosis.effects
            for rival in effect.rivals
        ],
        "before": _scores(diagnosis.before),
        "after": _scores(diagnosis.after),
        **({"refused": {"why": refused.why, **_scores(diagnosis.found)}} if (refused := diagnosis.refused) else {}),
        "held_out": diagnosis.held_out,
        "noise_floor_um": diagnosis.noise_floor_um,
        "fit": {
            "before_um": rms_of(diagnosis.residual_before),
            "named_um": diagnosis.named_rms_um,
            "after_um": rms_of(diagnosis.residual_after),
        },
        "remainder": _table(diagnosis.remainder),
        "ceiling": _table(diagnosis.ceiling),
        "advice": advice_table(diagnosis.advice),
        "warnings": list(map(str, diagnosis.warnings)),
        "warning_codes": [warning.code for warning in diagnosis.warnings],
        **_could_hide(diagnosis.could_hide),
        **({"since_h": diagnosis.since_h} if diagnosis.since_h else {}),
        "free_run": runs,
    }


def _could_hide(found: DetectionLimits | None) -> dict[str, Any]:
    """Return how much could hide under its key; nothing where Y was measured all the time."""
    if found is None:
        return {}
    needed = found.values_needed if found.is_too_much else 0
    table = {
        "values": found.values,
        "every_min": found.every_min,
        "matters_um": found.matters_um,
        "too_much": found.is_too_much,
        "undecided": list(found.undecided),
        "values_needed": max(needed, found.values),
        "what": [{"kind": one.kind, "path": one.path or None, "size_um": one.size_um} for one in found.what],
    }
    return {"could_hide": table}


def _table(found: Remainder | Ceiling | None) -> dict[str, Any] | None:
    if found is None:
        return None
    table = dataclasses.asdict(found)
    return {key: list(value) if isinstance(value, tuple) else value for key, value in table.items()}


def _place(term: Term) -> dict[str, Any]:
    kind, path, channel = term.hypothesis.place
    return {"kind": kind, "path": path or None, "channel": channel or None, "form": term.hypothesis.form}


def _scores(scores: Scores) -> dict[str, float | None]:
    values = {"rms_um": scores.rms_um, "peak_to_peak_um": scores.peak_to_peak_um, "fit_pct": scores.fit_pct}
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def headline(found: Mapping[str, Any]) -> str:
    """Return what a page begins with: the verdict and the error in free run; where that is not known, on held-out data.

    Parameters
    ----------
    found : mapping
        Result of :func:`figures`, or content of `diagnosis.json`.
    """
    share = f" {explained(found)}" if found["effects"] and falls_short(found) else ""
    error = free_run_sentence(found)
    if not found["effects"]:
        return f"{_residual(found)} {error}".strip()
    if not error:
        it = "it" if len(found["effects"]) == 1 else "them"
        error = (
            f"Error on held-out data: {found['before']['rms_um']:.2f} µm rms without {it}, {named_rms(found):.2f} with "
            f"{it}{_with_remainder(found)}."
        )
    return f"{_names(found['effects'])}{_since(found)}. {_words(found)} {error}{share}"


def verdict(found: Mapping[str, Any]) -> str:
    """Return a diagnosis in a few sentences: what the headline has, with noise, ceiling and errors in free run.

    Parameters
    ----------
    found : mapping
        Result of :func:`figures`, or content of `diagnosis.json`.
    """
    share = "".join(f" {sentence}" for sentence in (explained(found), free_run_sentence(found)) if sentence)
    if not found["effects"]:
        return _residual(found) + share
    named = f"{_names(found['effects'])}{_since(found)}"
    does = "would be" if "refused" in found else "is"
    return (
        f"{_words(found)} {named}. On held-out data, with a fitted zero, the residual was "
        f"{found['before']['rms_um']:.2f} µm rms without and {does} {named_rms(found):.2f} µm rms with them"
        f"{_with_remainder(found)} (sensor noise {found['noise_floor_um']:.2f}).{share}"
    )


def _since(found: Mapping[str, Any]) -> str:
    """Return since when the effects act, where they began within the data."""
    return f", began within the data: searched from {found['since_h']:.1f} h on" if found.get("since_h") else ""


def _residual(found: Mapping[str, Any]) -> str:
    """Return the verdict where no effect was found, with the residual."""
    hidden = "".join(f" {line}" for line in hiding_lines(found)[:1])
    about_zero = f" {said}" if (said := off_zero(found)) else ""
    return (
        f"{_words(found)}{about_zero} Residual {found['before']['rms_um']:.2f} µm rms{_with_remainder(found)}, sensor "
        f"noise {found['noise_floor_um']:.2f}.{hidden}"
    )


def _with_remainder(found: Mapping[str, Any]) -> str:
    return f", {found_rms(found):.2f} with the remainder" if found.get("remainder") else ""


def _words(found: Mapping[str, Any]) -> str:
    """Return the verdict without figures."""
    words = _VERDICTS[found["verdict"]]
    if found["verdict"] == "adequate" and "could_hide" in found:
        words = _ADEQUATE_VALUES
    elif _cannot_show(found):
        names = found["could_hide"]["undecided"]
        words = _UNDECIDED.format(names=" or ".join(names)) if names else _CANNOT_SHOW
    if ModelWarning.PATH_REVERSED in found["warning_codes"]:
        words = _REVERSED
    elif ModelWarning.WORSE_IN_FREE_RUN in found["warning_codes"]:
        words = _NOT_IN_FREE_RUN
    elif ModelWarning.TOO_SHORT in found["warning_codes"]:
        words = _SHORT
    elif ModelWarning.MADE_WORSE in found["warning_codes"]:
        words = _DOES_NOT_HOLD
    elif ModelWarning.NOT_CONFIRMED in found["warning_codes"] and "could_hide" in found:
        words = _NOT_FORETOLD
    elif said := of_the_effects(found):
        words = said
    elif found["verdict"] in ("explained", "partly_explained") and falls_short(found):
        words = _FALLS_SHORT
    elif _foretells_less(found):
        words = _FORETELLS_LESS
    elif _without_a_name(found):
        added = found.get("remainder") or {}
        words = _OWN_PATHS if added.get("belongs") and lowers(added) else _WITHOUT_A_NAME
    return words


def _without_a_name(found: Mapping[str, Any]) -> bool:
    """Whether something acts that the channels show and that has no name."""
    shown = bool(found.get("remainder")) or falls_short(found)
    return found["verdict"] == "unexplained" and not found["effects"] and shown and not _cannot_show(found)


def _foretells_less(found: Mapping[str, Any]) -> bool:
    """Whether nothing is left to look for in the fit, and the base is not adequate all the same."""
    nothing = found["verdict"] == "unexplained" and not found["effects"] and not found.get("remainder")
    advice = found.get("advice")
    return nothing and "could_hide" not in found and advice is not None and advice["unexplained"] is None


def _cannot_show(found: Mapping[str, Any]) -> bool:
    """Whether few values leave nothing but noise, and something that matters could hide in it."""
    hides = found.get("could_hide")
    left = found["advice"]["unexplained"] if found.get("advice") else None
    return hides is not None and found["verdict"] == "unexplained" and not found["effects"] and left is None


def hiding_lines(found: Mapping[str, Any]) -> list[str]:
    """Return how much could hide in few values, in sentences.

    Empty where Y was measured all the time, and where the values show that something acts without a name.
    """
    hides = found.get("could_hide")
    if not hides or (found["verdict"] == "unexplained" and not _cannot_show(found)):
        return []
    first, *others = [
        f"{_HIDDEN[one['kind']].format(**one)} of {one['size_um']:.1f} µm peak to peak" for one in hides["what"]
    ]
    beside = " beside the effects found" if found["effects"] else ""
    limit = f"{hides['matters_um']:.1f} µm, a tenth of Y's movement"
    lines = [
        f"With {hides['values']} values, one every {hides['every_min']:g} min, {first} could act{beside} without being "
        f"seen (limit for an adequate model: {limit})."
    ]
    if others:
        lines.append(f"So could {', '.join(others)}. What begins and ends between two values cannot be seen at all.")
    if hides["too_much"]:
        lines.append(
            f"That is more than the limit: about {hides['values_needed']} values like these are needed, or as many "
            "with less noise."
        )
    return lines


def _names(effects: Sequence[Mapping[str, Any]]) -> str:
    """Return kinds and places of all effects, grouped by kind."""
    places: dict[str, list[str]] = {}
    for effect in effects:
        place = " ".join(filter(None, (effect["path"], effect["channel"])))
        places.setdefault(effect["kind"].capitalize(), []).append(place)
    return "; ".join(": ".join(filter(None, (kind, ", ".join(filter(None, where))))) for kind, where in places.items())


def name(effect: FoundEffect) -> str:
    """Return an effect's kind and place."""
    return _names([_place(effect.term)])


def contents(
    diagnosis: Diagnosis, remarks: Sequence[Remark], free_run: Sequence[FreeRunErrors] = ()
) -> Iterator[str | Table | Words | Listing]:
    """Yield the content for terminal and notebook: verdict, tables, explanations, warnings and remarks."""
    found = figures(diagnosis, free_run)
    yield verdict(found)
    if free_run:
        yield table_of(free_run)
    yield error_table(diagnosis)
    yield ceiling(found)
    for i, effect in enumerate(diagnosis.effects, start=1):
        yield explanation(effect, title=f"{i}. {name(effect).replace(': ', ' ')}")
        yield parameter_table(effect, count=SHOWN)
        if effect.rivals:
            yield rivals(effect)
    yield from remainder(found)
    yield from channels_to_configure(diagnosis)
    if hidden := hiding_lines(found):
        yield Words(title="What could hide", lines=hidden)
    if advice := advice_lines(diagnosis.advice):
        yield Words(title="What to measure and test next", lines=advice)
    yield from warnings_of(diagnosis.warnings)
    yield from warnings_of(remarks, "Remarks on the data")


def channels_to_configure(diagnosis: Diagnosis) -> list[Listing | Words]:
    """Return the lines of the configuration for the channels that the extended model needs; empty without any."""
    new = [name for name in diagnosis.model.channels if name not in diagnosis.evidence.model.channels]
    if not new:
        return []
    ranges = {}
    for name in new:
        values = np.concatenate([run.channels[name] for run in diagnosis.evidence.runs if name in run.channels])
        ranges[name] = (float(np.nanmin(values)), float(np.nanmax(values)))
    title = (
        "The extended model needs these channels. Paste those that are missing into the service's configuration, with "
        "device and input of the sensor"
    )
    found: list[Listing | Words] = [Listing(title=title, lines=channel_lines(new, ranges))]
    if bad := unusable_names(new):
        words = f"{', '.join(bad)}: no name for a channel (small letters, digits, _). Rename the column and repeat."
        found.append(Words(title="Names", lines=[words], kind="warning"))
    return found


def error_table(diagnosis: Diagnosis) -> Table:
    """Return the errors on held-out data before and after, and what they are compared with."""
    rows = [["base model", *diagnosis.before.cells()]]
    if len(diagnosis.effects) > 1:
        rows += [[f"+ {name(effect)}", f"{step.rms_um:.2f}", "", ""] for effect, step in diagnosis.stepped]
    refused = " (not deployed)" if diagnosis.refused else ""
    if diagnosis.effects:
        named = diagnosis.named if diagnosis.remainder else diagnosis.found
        rows.append([f"with the effects{refused}", *named.cells()])
    if diagnosis.remainder:
        rows.append([f"with the remainder{refused}", *diagnosis.found.cells()])
    if diagnosis.ceiling:
        rows.append(["best linear use of all channels", f"{diagnosis.ceiling.rms_um:.2f}", "", ""])
    return Table(
        title="Errors on held-out data, zero fitted",
        head=["", *SCORE_HEAD],
        rows=[*rows, ["sensor noise alone", f"{diagnosis.noise_floor_um:.2f}", "", ""]],
        note=f"Held-out data: {diagnosis.held_out}.",
    )


def parameter_table(effect: FoundEffect, *, count: int | None = None) -> Table:
    """Return the parameters of an effect, or the first of them, with their standard errors."""
    rows = [[in_words(key), with_std(value, effect.std[key])] for key, value in effect.named.items()]
    if count is not None:
        rows = rows[:count]
        rows.append(["residual of the fit without the effect, µm rms", f"{effect.rms_before_um:.2f}"])
        rows.append(["residual of the fit with the effect, µm rms", f"{effect.rms_after_um:.2f}"])
    return Table(head=["parameter", "value ± standard error"], rows=rows)


def explanation(effect: FoundEffect, *, title: str = "Explanation") -> Words:
    """Return the explanation of an effect, and whether the extended model has it."""
    if effect.deployable:
        deploy = "Deployed in the extended model."
    elif effect.replaced or effect.left_in:
        deploy = "Not in the extended model."
    elif effect.is_refused:
        deploy = "The model was left unchanged."
    else:
        deploy = "Not deployable, so not in the extended model."
    return Words(title=title, lines=[effect.explanation, deploy])


def rivals(effect: FoundEffect) -> Words:
    """Return the rival explanations of an effect, and how to distinguish them."""
    lines = [
        f"{r.label}: {r.rms_after_um:.2f} µm rms remain, {r.rms_chosen_um:.2f} with the effect above (log evidence "
        f"{r.log_evidence:+.3g} for the rival). {r.how_to_tell_apart}"
        for r in effect.rivals
    ]
    return Words(title="Rival explanations", lines=lines)


def in_words(key: str) -> str:
    """Return the name of a parameter with its unit in the usual notation.

    Examples
    --------
    >>> in_words("half_width_um"), in_words("gain_um_per_rpm2"), in_words("um_per_h"), in_words("change_per_100")
    ('half width, µm', 'gain, µm/(1/min)²', 'rate, µm/h', 'change per 100')
    >>> in_words("gain_1_um_per_unit"), in_words("gain_um_per_rpm_5_3")
    ('gain 1, µm per unit', 'gain, µm/(1/min)^(5/3)')
    """
    name, um, channel = key.partition("_um_per_")
    if um:
        base, five_thirds, _ = channel.partition("_5_3")
        power = "^(5/3)" if five_thirds else "²" if base.endswith("2") else ""
        unit = base.removesuffix("2")
        per = f"/{_UNITS[unit]}" if unit in _UNITS else f" per {unit}"
        return f"{name.replace('_', ' ')}, µm{per}{power}"
    words = key.split("_")
    at = len(words)
    while at and (words[at - 1].rstrip("2") in _UNITS or words[at - 1] == "per"):
        at -= 1
    unit = "".join("/" if word == "per" else _UNITS[word.rstrip("2")] + "²" * word.endswith("2") for word in words[at:])
    if len(words) == at + 1:  # a unit by itself is no divisor
        unit = unit.strip("()")
    return f"{' '.join(words[:at]) or 'rate'}{', ' if unit else ''}{unit}"
