"""What all logged channels could explain, and the remainder, in words: from the content of `diagnosis.json`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compensator.display import Words

#: Named effects that explain less than this of what the channels explain fall short of it, %. It is what an engineer
#: would act on, and no bound of statistics.
SHORT_PCT = 80.0
#: Channels that remove less than this share of the mean square explain next to nothing.
_LITTLE = 0.1
#: Named effects leave less than the ceiling where they leave no more than this share of it.
_LESS = 0.9
#: A remainder that leaves more than this share of the error removes nothing that shows in two digits.
_MEASURABLE = 0.995
#: Channels of the remainder that are named.
_NAMED = 6


def named_rms(found: Mapping[str, Any]) -> float:
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


def ceiling(found: Mapping[str, Any]) -> Words:
    """Return what all channels could explain, and whether the named effects fall short of it."""
    return Words(title="Ceiling", lines=_lines(found))


def _lines(found: Mapping[str, Any]) -> list[str]:
    if (best := found.get("ceiling")) is None:
        return [
            "No linear combination of the logged channels has a smaller error on held-out data than the base model."
        ]
    lines = [
        f"With the best linear combination of all logged channels, the error on held-out data is "
        f"{best['rms_um']:.2f} µm rms, with the base model {found['before']['rms_um']:.2f}."
    ]
    if not (share := explained(found)):
        return [*lines, "The channels can explain almost nothing of the error."]
    lines.append(share)
    if found["effects"] and (named := named_rms(found)) < _LESS * best["rms_um"]:
        lines.append(
            f"Their error is smaller, {named:.2f} µm rms: not every effect is a linear combination of the channels."
        )
    if falls_short(found):
        rest = "no remainder was added"
        if beside := found.get("remainder"):
            lowers = _lowers(beside)
            rest = (
                "the remainder corrects some of the rest" if lowers else "the remainder does not lower the error there"
            )
        lines.append(
            "The channels show clearly more than the named effects explain, and " + rest + "."
            if found["effects"]
            else f"The channels show something that no named effect explains; {rest}."
        )
    return lines


def _lowers(rest: Mapping[str, Any]) -> bool:
    """Whether a remainder lowers the error on held-out data by what can be measured."""
    return bool(rest["rms_after_um"] < _MEASURABLE * rest["rms_before_um"])


def remainder(found: Mapping[str, Any]) -> list[Words]:
    """Return what the remainder is and does; empty where there is none."""
    if (rest := found.get("remainder")) is None:
        return []
    channels = rest["channels"]
    more = f" and {len(channels) - _NAMED} more" if len(channels) > _NAMED else ""
    deployed = "Deployed in the extended model." if rest["deployed"] else "Not deployed in the extended model."
    removes = [] if _lowers(rest) else ["It removes nothing that can be measured on held-out data."]
    lines = [
        f"A regularised linear response of {', '.join(channels[:_NAMED])}{more}: a correction that explains nothing.",
        f"Error on held-out data: {rest['rms_before_um']:.2f} µm rms without it, {rest['rms_after_um']:.2f} with it.",
        *removes,
        deployed,
    ]
    return [Words(title="Remainder", lines=lines)]
