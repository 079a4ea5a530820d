"""What the remainder is and does, in words: from the content of `diagnosis.json`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compensator.diagnose.words.standing import is_hidden
from compensator.display import Words

#: A remainder that leaves more than this share of the error removes nothing that shows in two digits.
_MEASURABLE = 0.995
#: Channels of the remainder that are named.
_NAMED = 6


def lowers(remainder: Mapping[str, Any]) -> bool:
    """Whether a remainder lowers the error on held-out data by what can be measured."""
    return bool(remainder["rms_after_um"] < _MEASURABLE * remainder["rms_before_um"])


def remainder(found: Mapping[str, Any]) -> list[Words]:
    """Return what the remainder is and does; empty where there is none."""
    if (remainder := found.get("remainder")) is None:
        return []
    channels = remainder["channels"]
    more = f" and {len(channels) - _NAMED} more" if len(channels) > _NAMED else ""
    before, after, instead = remainder["rms_before_um"], remainder["rms_after_um"], remainder.get("instead", False)
    place = "without it"
    if found["effects"]:
        place = "with the named effects" if instead else "with the named effects alone"
    it = "with it in their place" if found["effects"] and instead else "with it"
    figures = f"Error on held-out data: {before:.2f} µm rms {place}, {after:.2f} {it}."
    if after * _MEASURABLE > before:
        figures += " It increases the error there."
    elif not lowers(remainder):
        figures += " It removes nothing there that can be measured."
    if fit := found.get("fit"):
        named = fit["named_um"] if found["effects"] else fit["before_um"]
        figures += f" In the fit to all data: {named:.2f} and {fit['after_um']:.2f}."
    deployed = _why_deployed(found)
    lines = [
        f"A regularised linear response of {', '.join(channels[:_NAMED])}{more}: a correction that explains nothing.",
        figures,
        deployed if remainder["deployed"] else "Not deployed in the extended model.",
    ]
    return [Words(title="Remainder", lines=lines)]


def _part(remainder: Mapping[str, Any]) -> str:
    """Return how much of an own error is deployed, in words; empty of all of it, and in a file that does not say."""
    share = float(remainder.get("confirmed", 1.0))
    return "" if share > 0.99 else f"{100.0 * share:.0f} % of "


def _why_deployed(found: Mapping[str, Any]) -> str:
    """Return that a remainder is deployed, and why, where held-out data alone would not say so."""
    remainder, deployed = found["remainder"], "Deployed in the extended model"
    if remainder.get("belongs"):
        place, beside = "", ""
        if remainder.get("instead"):
            place = " in place of the named effects"
        elif found["effects"]:
            place, beside = " with the named effects", " that they were fitted beside"
        return (
            f"{deployed}{place}: it is {_part(remainder)}the base model's own error{beside}, as much of it as predicts "
            "held-out data best."
        )
    if remainder.get("instead") and is_hidden(found):
        why = "because it leaves far less of these data in free run"
        return f"{deployed} in place of the source, which nothing foretells, {why}."
    if remainder.get("instead"):
        why = "which leave more on held-out data" if lowers(remainder) else "because all data are more probable with it"
        return f"{deployed} in place of the named effects, {why}."
    if not lowers(remainder):
        return f"{deployed}, because all data are more probable with it."
    return f"{deployed}."
