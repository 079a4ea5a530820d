"""A diagnosis as figures, tables and text for `diagnosis.json`, terminal, notebook and page."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from compensator.codes import ModelWarning, Remark
from compensator.diagnose.fit import Term
from compensator.diagnose.outcome import Ceiling, Diagnosis, FoundEffect, Remainder
from compensator.display import Table, Words, warnings_of, with_std
from compensator.model.simulation import SCORE_HEAD, Scores

_VERDICTS = {
    "adequate": "The model is adequate: the residual is within the noise and the model's own error.",
    "explained": "The missing effects were found; what remains is within the noise and the model's own error.",
    "partly_explained": "Some of the missing effects were found; part of the residual remains unexplained.",
    "unexplained": "The model lacks an effect that no channel shows.",
}
#: The verdict if the effects found increase the error on held-out data.
_DOES_NOT_HOLD = (
    "The model lacks an effect; the best explanation found increases the error on held-out data, so the model was "
    "left unchanged."
)

#: Named effects that explain less than this of what the channels explain fall short of it, %. It is what an engineer
#: would act on, and no bound of statistics.
SHORT_PCT = 80.0
#: Channels that remove less than this share of the mean square explain next to nothing.
_LITTLE = 0.1
#: Channels of the remainder that are named.
_NAMED = 6
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

#: Keys of an effect in `diagnosis.json`, after its place.
_FIGURES = ("parameters", "deployable", "explanation", "rms_before_um", "rms_after_um")


def figures(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the content of `diagnosis.json`."""
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
        "remainder": _table(diagnosis.remainder),
        "ceiling": _table(diagnosis.ceiling),
        "warnings": list(map(str, diagnosis.warnings)),
        "warning_codes": [warning.code for warning in diagnosis.warnings],
    }


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


def verdict(found: Mapping[str, Any]) -> str:
    """Return a diagnosis in one or two sentences.

    Parameters
    ----------
    found : mapping
        Result of :func:`figures`, or content of `diagnosis.json`.
    """
    words = _VERDICTS[found["verdict"]]
    if ModelWarning.MADE_WORSE in found["warning_codes"]:
        words = _DOES_NOT_HOLD
    before, after, noise = found["before"]["rms_um"], found["after"]["rms_um"], found["noise_floor_um"]
    remainder, share = found.get("remainder"), explained(found)
    share = f" {share}" if share else ""
    with_remainder = f", {after:.2f} with the remainder" if remainder else ""
    if not found["effects"]:
        return f"{words} Residual {before:.2f} µm rms{with_remainder}, sensor noise {noise:.2f}.{share}"
    return (
        f"{words} {_names(found['effects'])}. On held-out data the residual was {before:.2f} µm rms without and is "
        f"{_named_rms(found):.2f} µm rms with them{with_remainder} (sensor noise {noise:.2f}).{share}"
    )


def _named_rms(found: Mapping[str, Any]) -> float:
    """Return the error on held-out data with the named effects alone, µm rms."""
    return float((found.get("remainder") or {}).get("rms_before_um", found["after"]["rms_um"]))


def _can_explain(found: Mapping[str, Any]) -> float:
    """Return what share of the mean square on held-out data the channels remove."""
    ceiling, before = found.get("ceiling"), found["before"]["rms_um"]
    return 1.0 - (ceiling["rms_um"] / before) ** 2 if ceiling and before else 0.0


def explained(found: Mapping[str, Any]) -> str:
    """Return how much of what the channels can explain the named effects do, in a sentence.

    Empty where the channels explain next to nothing.

    Examples
    --------
    >>> found = {"effects": [{}], "before": {"rms_um": 4.0}, "ceiling": {"rms_um": 1.0, "explained_pct": 83.0}}
    >>> explained(found)
    'The named effects explain 83 % of what the channels can explain.'
    """
    if _can_explain(found) < _LITTLE:
        return ""
    share = found["ceiling"]["explained_pct"]
    if not found["effects"]:
        return "No named effect explains what the channels can explain."
    how_much = "all" if share > 99.5 else "nothing" if share < 0.5 else f"{share:.0f} %"
    return f"The named effects explain {how_much} of what the channels can explain."


def falls_short(found: Mapping[str, Any]) -> bool:
    """Whether the named effects explain clearly less than the channels can."""
    return _can_explain(found) >= _LITTLE and bool(found["ceiling"]["explained_pct"] < SHORT_PCT)


def ceiling_words(found: Mapping[str, Any]) -> list[str]:
    """Return what all channels could explain, and whether the named effects fall short of it, as sentences."""
    if (ceiling := found.get("ceiling")) is None:
        return ["No linear use of the logged channels leaves less on held-out data than the base model does."]
    lines = [
        f"The best linear use of all logged channels leaves {ceiling['rms_um']:.2f} µm rms on held-out data, the base "
        f"model {found['before']['rms_um']:.2f}."
    ]
    if not (share := explained(found)):
        return [*lines, "The channels can explain next to nothing."]
    lines.append(share)
    if falls_short(found):
        rest = "the remainder corrects some of the rest" if found.get("remainder") else "no remainder was added"
        lines.append(
            "They fall clearly short: the channels show more than the effects that have a name, and " + rest + "."
            if found["effects"]
            else f"The channels show something that has no name here; {rest}."
        )
    return lines


def remainder_words(found: Mapping[str, Any]) -> list[str]:
    """Return what the remainder is and does, as sentences; empty where there is none."""
    if (remainder := found.get("remainder")) is None:
        return []
    channels = remainder["channels"]
    more = f" and {len(channels) - _NAMED} more" if len(channels) > _NAMED else ""
    deployed = "Deployed in the extended model." if remainder["deployed"] else "Not deployed in the extended model."
    return [
        f"A regularised linear response of {', '.join(channels[:_NAMED])}{more}: a correction that explains nothing.",
        f"It takes the error on held-out data from {remainder['rms_before_um']:.2f} to {remainder['rms_after_um']:.2f} "
        "µm rms.",
        deployed,
    ]


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


def contents(diagnosis: Diagnosis, remarks: Sequence[Remark]) -> Iterator[str | Table | Words]:
    """Yield the content for terminal and notebook: verdict, tables, explanations, warnings and remarks."""
    yield verdict(figures(diagnosis))
    yield error_table(diagnosis)
    for i, effect in enumerate(diagnosis.effects, start=1):
        yield parameter_table(effect, title=f"{i}. {name(effect)}", count=SHOWN)
        yield explanation(effect)
        if effect.rivals:
            yield rivals(effect)
    yield from beyond_effects(diagnosis)
    yield from warnings_of(diagnosis.warnings)
    yield from warnings_of(remarks, "Remarks on the data")


def error_table(diagnosis: Diagnosis) -> Table:
    """Return the errors on held-out data before and after, and what they are compared with."""
    rows = [["base model", *diagnosis.before.cells()]]
    if diagnosis.effects:
        rows.append(["with the named effects", *(diagnosis.named if diagnosis.remainder else diagnosis.after).cells()])
    if diagnosis.remainder:
        rows.append(["with the remainder", *diagnosis.after.cells()])
    if diagnosis.ceiling:
        rows.append(["best linear use of all channels", f"{diagnosis.ceiling.rms_um:.2f}", "", ""])
    return Table(
        title="Errors on held-out data",
        head=["", *SCORE_HEAD],
        rows=[*rows, ["sensor noise alone", f"{diagnosis.noise_floor_um:.2f}", "", ""]],
        note=f"Held-out data: {diagnosis.held_out}.",
    )


def parameter_table(effect: FoundEffect, *, title: str = "", count: int | None = None) -> Table:
    """Return the parameters of an effect, or the first of them, with their standard errors."""
    rows = [[in_words(key), with_std(value, effect.std[key])] for key, value in effect.named.items()]
    if count is not None:
        rows = rows[:count]
        rows.append(["residual of the fit without the effect, µm rms", f"{effect.rms_before_um:.2f}"])
        rows.append(["residual of the fit with the effect, µm rms", f"{effect.rms_after_um:.2f}"])
    return Table(title=title, head=["parameter", "value ± standard error"], rows=rows)


def explanation(effect: FoundEffect) -> Words:
    """Return the explanation of an effect, and whether the model compensates it."""
    deploy = "Deployed in the extended model." if effect.deployable else "Not deployable, so not in the extended model."
    return Words(title="Explanation", lines=[effect.explanation, deploy])


def rivals(effect: FoundEffect) -> Words:
    """Return the rival explanations of an effect, and how to distinguish them."""
    lines = [f"{r.label}: {r.rms_after_um:.2f} µm rms remain. {r.how_to_tell_apart}" for r in effect.rivals]
    return Words(title="Rival explanations", lines=lines)


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


def beyond_effects(diagnosis: Diagnosis) -> list[Words]:
    """Return ceiling and remainder: what the channels explain beyond the named effects."""
    found = figures(diagnosis)
    lists = [("Ceiling", ceiling_words(found)), ("Remainder", remainder_words(found))]
    return [Words(title=title, lines=lines) for title, lines in lists if lines]
