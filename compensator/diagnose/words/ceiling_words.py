"""What all logged channels could explain, in words: from the content of `diagnosis.json`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compensator.diagnose.advice.ceiling import Ceiling
from compensator.diagnose.words.remainder_words import lowers
from compensator.diagnose.words.standing import held_by_the_base
from compensator.display import Words


def named_rms(found: Mapping[str, Any]) -> float:
    """Return the error on held-out data with the named effects alone, µm rms."""
    return float((found.get("remainder") or {}).get("rms_before_um", found_rms(found)))


def found_rms(found: Mapping[str, Any]) -> float:
    """Return the error on held-out data with everything that was found, deployed or not, µm rms."""
    return float(found.get("refused", found["after"])["rms_um"])


def _ceiling_in(found: Mapping[str, Any]) -> Ceiling | None:
    best = found.get("ceiling")
    return Ceiling(rms_um=best["rms_um"], explained_pct=best["explained_pct"]) if best else None


def explained(found: Mapping[str, Any]) -> str:
    """Return how much of what the channels can explain the named effects do, in a sentence.

    Empty where the channels explain next to nothing.

    Examples
    --------
    >>> found = {"effects": [{}], "before": {"rms_um": 4.0}, "ceiling": {"rms_um": 1.0, "explained_pct": 83.0}}
    >>> explained(found)
    'The named effects explain 83 % of what the channels can explain.'
    """
    best = _ceiling_in(found)
    if best is None or not best.shows_something(found["before"]["rms_um"]):
        return ""
    share = best.explained_pct
    if not found["effects"]:
        return "No named effect explains what the channels can explain."
    if share < 0.5 and held_by_the_base(found):
        return "The named effects explain it only together with the base model's own error."
    how_much = "all" if share > 99.5 else "nothing" if share < 0.5 else f"{share:.0f} %"
    return f"The named effects explain {how_much} of what the channels can explain."


def falls_short(found: Mapping[str, Any]) -> bool:
    """Whether the named effects explain clearly less than the channels can."""
    best = _ceiling_in(found)
    return best is not None and best.is_missed(found["before"]["rms_um"])


def ceiling(found: Mapping[str, Any]) -> Words:
    """Return what all channels could explain, and whether the named effects fall short of it."""
    return Words(title="Ceiling", lines=_lines(found))


def _lines(found: Mapping[str, Any]) -> list[str]:
    if (best := found.get("ceiling")) is None:
        return [
            "No linear combination of the logged channels has a smaller error on held-out data than the base model."
        ]
    lines = [_of_all(found, best)]
    if not (share := explained(found)):
        return [*lines, "The channels can explain almost nothing of the error."]
    lines.append(share)
    if falls_short(found):
        outcome = "no remainder was added"
        beside = found.get("remainder")
        if beside and not beside["deployed"]:
            outcome = "nothing is deployed"
        elif beside:
            does = "corrects some of the rest" if lowers(beside) else "does not lower the error there"
            outcome = f"the remainder {does}"
        lines.append(
            "The channels show clearly more than the named effects explain, and " + outcome + "."
            if found["effects"]
            else f"The channels show something that no named effect explains; {outcome}."
        )
    return lines


def _of_all(found: Mapping[str, Any], best: Mapping[str, Any]) -> str:
    """Return the smallest error on held-out data, what has it, and what the channels leave in a linear combination."""
    linear, base = best["rms_um"], found["before"]["rms_um"]
    least = best.get("least_rms_um") or linear
    if linear <= least:
        return (
            f"With the best linear combination of all logged channels, the error on held-out data is "
            f"{linear:.2f} µm rms, with the base model {base:.2f}."
        )
    by = "the named effects" if named_rms(found) <= found_rms(found) else "the remainder"
    return (
        f"The smallest error on held-out data of all that was tried is {least:.2f} µm rms, with {by}. The "
        f"best linear combination of all logged channels, without names, leaves {linear:.2f}, the base model "
        f"{base:.2f}."
    )
