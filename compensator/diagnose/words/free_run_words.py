"""The errors of the base and the extended model in free run, in words: from the content of `diagnosis.json`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compensator.diagnose.choice.verdict import BASE, EXTENDED, HELD_OUT, SEARCHED
from compensator.model.free_run import in_words

#: An adequate model that errs about the zero by more than this many times what it leaves where zero and initial state
#: are fitted is right about changes only.
_OFF_ZERO = 3.0


def off_zero(found: Mapping[str, Any]) -> str:
    """Return that an adequate model errs about the zero of its data, and why that may be; empty where it does not.

    Examples
    --------
    >>> scores = {"base model": {"rms_um": 10.5, "rms_about_mean_um": 1.3}}
    >>> run = {"name": "run.csv", "role": "searched", "scores": scores}
    >>> off_zero({"verdict": "adequate", "before": {"rms_um": 1.2}, "free_run": [run]})[:40]
    'About the zero it errs by 10.5 µm rms: t'
    """
    searched = [one["scores"][BASE]["rms_um"] for one in found.get("free_run", []) if one["role"] == SEARCHED]
    far_um = max(searched, default=0.0)
    if found["verdict"] != "adequate" or far_um <= _OFF_ZERO * found["before"]["rms_um"]:
        return ""
    return (
        f"About the zero it errs by {far_um:.1f} µm rms: the machine was not at rest there, or the displacement sensor "
        "moved in the first hours. Set the zero at rest, and look at the sensor's mount."
    )


def free_run_sentence(found: Mapping[str, Any]) -> str:
    """Return the errors in free run in a sentence: on held-out data where there are some; empty for an old file.

    Parameters
    ----------
    found : mapping
        Content of `diagnosis.json`.

    Examples
    --------
    >>> own = {"rms_um": 6.3, "rms_about_mean_um": 6.2}
    >>> scores = {"base model": own, "no compensation": {"rms_um": 41.3, "rms_about_mean_um": 20.0}}
    >>> free_run_sentence({"free_run": [{"name": "run.csv", "role": "searched", "scores": scores}]})
    'Base model in free run 6.30 µm rms about the zero, 6.20 about the mean (without compensation 41.3 and 20.0).'
    """
    runs = found.get("free_run", [])
    if not runs:
        return ""
    held_out = [one for one in runs if one["role"] == HELD_OUT]
    worst = max(held_out or runs, key=lambda one: float(one["scores"].get(EXTENDED, one["scores"][BASE])["rms_um"]))
    scores = worst["scores"]
    words = f"{BASE} {in_words(scores, BASE)}"
    if EXTENDED in scores:
        own = scores[EXTENDED]
        # The zero of the data is older than an effect that began within them, so it says nothing of that one's level.
        key = "rms_about_mean_um" if found.get("since_h") and worst["role"] == SEARCHED else "rms_um"
        worse = ", so it is worse there" if own[key] > scores[BASE][key] else ""
        words += f"; {EXTENDED} {own['rms_um']:.2f} and {own['rms_about_mean_um']:.2f}{worse}"
    several = f" (the worst of {len(held_out)})" if len(held_out) > 1 else ""
    where = f"On {worst['name']}{several}, which took no part in the search: " if held_out else ""
    text = f"{where}{words}."
    return f"{text[0].upper()}{text[1:]}"
