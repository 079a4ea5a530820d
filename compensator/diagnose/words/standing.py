"""What may be said of the named effects: found, found in part, or undecided. One definition for text, page and JSON.

"Found" is said of the named effects alone, against the noise of the data; a remainder that corrects what they leave
explains nothing. A run that took no part has the last word.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compensator.diagnose.choice.verdict import is_confirmed
from compensator.display import listed
from compensator.model.effects.hypothesis import DEGC
from compensator.model.effects.input import Input
from compensator.model.effects.unobserved import Unobserved


def undecided(found: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the effects that are smaller than their own standard error."""
    return [effect for effect in found["effects"] if not effect.get("determined", True)]


def is_in_the_model(found: Mapping[str, Any]) -> bool:
    """Whether any of the effects can be deployed."""
    return any(effect.get("deployable", True) for effect in found["effects"])


def is_hidden(found: Mapping[str, Any]) -> bool:
    """Whether all that is named is a source that no channel shows."""
    return bool(found["effects"]) and all(effect["kind"] == Unobserved.kind for effect in found["effects"])


def held_by_the_base(found: Mapping[str, Any]) -> list[str]:
    """Return the temperatures that act beside the base's own error: it has what heat and ambient do by them already."""
    remainder = found.get("remainder") or {}
    if not remainder.get("belongs") or remainder.get("instead"):
        return []
    channels = [effect.get("channel") or "" for effect in found["effects"] if effect["kind"] == Input.kind]
    return [channel for channel in channels if channel.endswith(DEGC)]


def words(found: Mapping[str, Any]) -> str:
    """Return what is said of the named effects beyond the verdict in one word; empty where that says all.

    Parameters
    ----------
    found : mapping
        Content of `diagnosis.json`.
    """
    if not found["effects"]:
        return ""
    if not is_confirmed(found.get("free_run", []), found["noise_floor_um"]):
        return (
            "The effects explain the data that were searched, but little or nothing of a run that took no part: what "
            "the model lacks was not found."
        )
    if len(undecided(found)) == len(found["effects"]):
        return _undecided(found)
    if said := _by_the_remainder(found):
        return said
    if found["verdict"] == "explained" and not is_in_the_model(found):
        return "The missing effects were found, but none of them can be deployed: the model's error stays as it is."
    return ""


def _undecided(found: Mapping[str, Any]) -> str:
    size = "its" if len(found["effects"]) == 1 else "their"
    test = " The test that decides is among what to measure next." if _has_test(found) else ""
    return (
        f"The model lacks an effect. What is named may act, but is smaller than {size} own standard error: these data "
        f"do not decide.{test}"
    )


def _has_test(found: Mapping[str, Any]) -> bool:
    return bool(found.get("rivals")) and any("expected change" in one["how_to_tell_apart"] for one in found["rivals"])


def _by_the_remainder(found: Mapping[str, Any]) -> str:
    """Return what the named effects explain and what the remainder corrects; empty where it has no part in it."""
    remainder, fit = found.get("remainder"), found.get("fit")
    if not remainder or not remainder["deployed"] or not fit or found["verdict"] == "explained":
        return ""
    left = f"of {fit['before_um']:.2f} µm rms in the fit, {fit['named_um']:.2f} is left by it"
    if remainder.get("instead") and is_hidden(found):
        return (
            f"Something acts that no channel shows by itself. All channels together make up for it: the remainder, "
            f"which explains nothing, leaves {fit['after_um']:.2f} of {fit['before_um']:.2f} µm rms in the fit."
        )
    if remainder.get("instead"):
        return (
            f"What is named resembles the cause most: {left}. A regularised response does better: the remainder, which "
            f"explains nothing, is deployed in its place and leaves {fit['after_um']:.2f}."
        )
    if channels := held_by_the_base(found):
        in_part = f"What was found explains the error in part: {left}."
        if fit["named_um"] >= fit["before_um"]:
            in_part = f"What was found explains the error of {fit['before_um']:.2f} µm rms in the fit not by itself."
        return (
            f"{in_part} What heat and ambient do by {listed(channels)} the base model has already: with its own error "
            f"corrected, {fit['after_um']:.2f} is left."
        )
    return (
        f"What was found explains the error in part: {left}. The remainder, which explains nothing, corrects that to "
        f"{fit['after_um']:.2f}."
    )
