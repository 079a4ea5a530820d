"""Advice as sentences for terminal, notebook and page, and as a table for `diagnosis.json`."""

from __future__ import annotations

from typing import Any

from compensator.diagnose.advice.advice import Advice, SeenOnce, Unexplained, resembling
from compensator.diagnose.advice.deciding import SHOWN, PlannedTest
from compensator.diagnose.advice.switched import DAY
from compensator.model.effects.seen import roughly

#: Tests in sentences; all are in `diagnosis.json`.
SAID = 2
_WHAT = {
    "unobserved": "A source that no channel shows moves Y",
    "remainder": "A cause that the channels show but no named effect explains moves Y",
    "residual": "A cause that nothing explains moves Y",
}


def advice_lines(advice: Advice | None) -> list[str]:
    """Return the advice as sentences; empty where there is nothing to do."""
    if advice is None:
        return []
    lines = []
    if advice.unexplained is not None:
        lines.append(_left(advice.unexplained))
        if alike := resembling(advice.nearest):
            named = ", ".join(f"{near.channel} (log evidence +{roughly(near.evidence)})" for near in alike[:3])
            lines.append(f"Logged channels that resemble it most: {named}.")
        lines.append(advice.sensor or "No sensor is advised for that: it is less than the noise of Y.")
    lines += [f"Next test, {_purpose(test)}: {test.sentence}" for test in advice.tests[:SAID]]
    lines += [_repeat(seen) for seen in advice.seen_once[:SAID]]
    return lines


def _left(unexplained: Unexplained) -> str:
    event, times = unexplained.goes_with, unexplained.times
    goes = "It coincides with nothing that was logged."
    if event is not None and event.event == DAY:
        goes = "It follows the time of day."
    elif event is not None:
        goes = f"It coincides with the switching of {event.event} in {event.times} of {event.of} times."
    when = f", first at {times[0][1]:.1f} h" if unexplained.kind == "unobserved" and times else ""
    return (
        f"{_WHAT[unexplained.kind]} by {roughly(unexplained.rms_um)} µm rms with a time constant of "
        f"{roughly(unexplained.tau_min)} min{when}. {goes}"
    )


def _purpose(test: PlannedTest) -> str:
    if test.between == SHOWN:
        return "with the new sensor"
    return f"to tell {test.between[0]} from {test.between[1]}"


def _repeat(seen: SeenOnce) -> str:
    return (
        f"Seen once: {seen.label} rests on one rise and fall of {seen.driver} at most. Repeat it: {seen.test.sentence}"
    )


def advice_table(advice: Advice | None) -> dict[str, Any] | None:
    """Return the advice as `diagnosis.json` has it."""
    if advice is None:
        return None
    return {
        "unexplained": _unexplained(advice.unexplained),
        "nearest": [
            {"channel": near.channel, "evidence": near.evidence, "lag_min": near.lag_min} for near in advice.nearest
        ],
        "sensor": advice.sensor,
        "tests": [_test(test) for test in advice.tests],
        "seen_once": [
            {"effect": seen.label, "driver": seen.driver, "test": _test(seen.test)} for seen in advice.seen_once
        ],
    }


def _unexplained(found: Unexplained | None) -> dict[str, Any] | None:
    if found is None:
        return None
    event = found.goes_with
    return {
        "kind": found.kind,
        "rms_um": found.rms_um,
        "peak_to_peak_um": found.peak_to_peak_um,
        "tau_min": found.tau_min,
        "when": [{"run": run + 1, "hour": hour} for run, hour in found.times],
        "goes_with": None if event is None else {"event": event.event, "times": event.times, "of": event.of},
        "sensor_evidence": found.sensor_evidence,
    }


def _test(test: PlannedTest) -> dict[str, Any]:
    return {
        "what": test.words,
        "hours": test.hours,
        "expected_evidence": test.expected_evidence,
        "decides": test.decides,
        "between": list(test.between),
    } | ({"probes": test.probes} if test.probes else {})
