"""What all logged channels could explain; this and the remainder in words, from the content of `diagnosis.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from compensator.diagnose.standing import held_by_the_base, is_hidden
from compensator.display import Words

#: Named effects that explain less than this of what the channels explain fall short of it, %. It is what an engineer
#: would act on, and no bound of statistics.
SHORT_PCT = 80.0
#: Channels that remove less than this share of the mean square explain next to nothing.
LITTLE = 0.1
#: A remainder that leaves more than this share of the error removes nothing that shows in two digits.
_MEASURABLE = 0.995
#: Channels of the remainder that are named.
_NAMED = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Ceiling:
    """What the best linear use of all logged channels leaves on data that took no part.

    Parameters
    ----------
    rms_um : float
        Its residual, µm.
    explained_pct : float
        How much of what it removes the named effects remove, %.
    least_rms_um : float, optional
        The smallest residual of this, the named effects, and these with the remainder, µm; None: it is `rms_um`.
    """

    rms_um: float
    explained_pct: float
    least_rms_um: float | None = None

    def shows_something(self, before_um: float) -> bool:
        """Return whether the channels remove more than next to nothing of a residual, µm rms."""
        return bool(before_um > 0.0 and 1.0 - (self.rms_um / before_um) ** 2 >= LITTLE)

    def is_missed(self, before_um: float) -> bool:
        """Return whether the named effects explain clearly less of a residual than the channels can."""
        return self.shows_something(before_um) and self.explained_pct < SHORT_PCT

    @property
    def least_um(self) -> float:
        """The smallest residual of all that was tried, µm."""
        return self.rms_um if self.least_rms_um is None else self.least_rms_um


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
        rest = "no remainder was added"
        beside = found.get("remainder")
        if beside and not beside["deployed"]:
            rest = "nothing is deployed"
        elif beside:
            does = "corrects some of the rest" if lowers(beside) else "does not lower the error there"
            rest = f"the remainder {does}"
        lines.append(
            "The channels show clearly more than the named effects explain, and " + rest + "."
            if found["effects"]
            else f"The channels show something that no named effect explains; {rest}."
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


def lowers(rest: Mapping[str, Any]) -> bool:
    """Whether a remainder lowers the error on held-out data by what can be measured."""
    return bool(rest["rms_after_um"] < _MEASURABLE * rest["rms_before_um"])


def remainder(found: Mapping[str, Any]) -> list[Words]:
    """Return what the remainder is and does; empty where there is none."""
    if (rest := found.get("remainder")) is None:
        return []
    channels = rest["channels"]
    more = f" and {len(channels) - _NAMED} more" if len(channels) > _NAMED else ""
    before, after, instead = rest["rms_before_um"], rest["rms_after_um"], rest.get("instead", False)
    place = "without it"
    if found["effects"]:
        place = "with the named effects" if instead else "with the named effects alone"
    it = "with it in their place" if found["effects"] and instead else "with it"
    figures = f"Error on held-out data: {before:.2f} µm rms {place}, {after:.2f} {it}."
    if after * _MEASURABLE > before:
        figures += " It increases the error there."
    elif not lowers(rest):
        figures += " It removes nothing there that can be measured."
    if fit := found.get("fit"):
        named = fit["named_um"] if found["effects"] else fit["before_um"]
        figures += f" In the fit to all data: {named:.2f} and {fit['after_um']:.2f}."
    deployed = _why_deployed(found)
    lines = [
        f"A regularised linear response of {', '.join(channels[:_NAMED])}{more}: a correction that explains nothing.",
        figures,
        deployed if rest["deployed"] else "Not deployed in the extended model.",
    ]
    return [Words(title="Remainder", lines=lines)]


def _part(rest: Mapping[str, Any]) -> str:
    """Return how much of an own error is deployed, in words; empty of all of it, and in a file that does not say."""
    share = float(rest.get("confirmed", 1.0))
    return "" if share > 0.99 else f"{100.0 * share:.0f} % of "


def _why_deployed(found: Mapping[str, Any]) -> str:
    """Return that a remainder is deployed, and why, where held-out data alone would not say so."""
    rest, deployed = found["remainder"], "Deployed in the extended model"
    if rest.get("belongs"):
        place, beside = "", ""
        if rest.get("instead"):
            place = " in place of the named effects"
        elif found["effects"]:
            place, beside = " with the named effects", " that they were fitted beside"
        return (
            f"{deployed}{place}: it is {_part(rest)}the base model's own error{beside}, as much of it as predicts "
            "held-out data best."
        )
    if rest.get("instead") and is_hidden(found):
        why = "because it leaves far less of these data in free run"
        return f"{deployed} in place of the source, which nothing foretells, {why}."
    if rest.get("instead"):
        why = "which leave more on held-out data" if lowers(rest) else "because all data are more probable with it"
        return f"{deployed} in place of the named effects, {why}."
    if not lowers(rest):
        return f"{deployed}, because all data are more probable with it."
    return f"{deployed}."
