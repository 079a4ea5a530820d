"""What follows from the result of a diagnosis: whether it has found the same effects again, and how far they differ."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from compensator.model.effects import effect_from
from compensator.model.effects.names import effect_names
from compensator.model.model_file import load_model
from compensator.model.thermal_model import ThermalModel
from compensator.service.loop.weighing import difference, off_at_zero


def coolant(gain: float) -> tuple[str, dict[str, Any]]:
    table = {"channel": "coolant_degc", "curve": "linear", "tau_min": [30.0], "gain": [gain], "delay_min": 0.0}
    return "input", {**table, "std": {"gain": [0.1]}}


def remainder(*channels: str) -> tuple[str, dict[str, Any]]:
    gains = [[0.1 * number, 0.2] for number, _ in enumerate(channels, start=1)]
    table = {"channels": list(channels), "exponents": [1.0] * len(channels), "taus_min": [0.0, 30.0], "gains": gains}
    return "regression", table


def extended(*effects: tuple[str, dict[str, Any]]) -> ThermalModel:
    found = tuple(effect_from(kind, table) for kind, table in effects)
    return dataclasses.replace(load_model("quill"), effects=found)


def test_the_own_error_beside_a_named_effect_makes_no_other_explanation_of_it() -> None:
    first = extended(coolant(2.0), remainder("heat_w", "floor_degc"))
    again = extended(coolant(2.3), remainder("heat_w", "coolant_degc", "at_degc"))
    assert effect_names(first.effects) == effect_names(again.effects) == ["input:coolant_degc"]
    same, deviations = difference(again, first)
    assert same and math.isclose(deviations, 3.0)
    assert difference(extended(coolant(2.0)), first) == (True, 0.0)


def test_what_is_off_at_rest_is_known_by_all_that_is_added() -> None:
    gain, ambient = (("gain", {"path": path, "change": 0.2}) for path in ("DTF", "TDTF"))
    joint = "hysteresis", {"path": "DTF", "form": "play", "half_width_um": 2.0}
    base = extended()
    assert off_at_zero(extended(gain, remainder("heat_w")), base) == []
    assert off_at_zero(extended(gain, coolant(2.0)), base) == ["coolant_degc"]
    assert off_at_zero(extended(coolant(2.0)), extended(coolant(1.0))) is None  # nothing is added
    for other in (ambient, joint):
        assert off_at_zero(extended(gain, other), base) is None
    assert off_at_zero(extended(remainder("heat_w")), base) is None


def test_parameters_of_two_time_constants_are_compared_one_by_one() -> None:
    """`std` names them for people (`gain_1_um_per_k`), and the table has lists."""
    table = {"channel": "coolant_degc", "curve": "linear", "tau_min": [3.0, 40.0], "delay_min": 0.0}
    factor = [
        [1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 12.0, 0.0, 0.0, 0.0],
        [0.0, 5.0, 0.3, 0.0, 0.0],
        [0.0, 0.0, 0.4, 0.1, 0.0],
    ]
    found = {"std": {"gain_1_um_per_k": 0.5, "delay_min": 1.0}, "std_factor": factor}
    first, again = (extended(("input", {**table, "gain": [gain, 0.3], **found})) for gain in (0.5, 1.5))
    same, deviations = difference(again, first)
    assert same and math.isclose(deviations, 2.0)


def test_a_remainder_of_other_gains_is_another_model() -> None:
    """Its gains are rows, and its factor has a column for each."""
    kind, table = remainder("heat_w", "floor_degc")
    factor = {"std_factor": [[0.1] * 4, [0.2] * 4]}
    first, again = (extended((kind, {**table, "gains": [[gain, 0.2], [0.1, 0.2]], **factor})) for gain in (0.1, 0.5))
    assert difference(again, first) == (True, math.inf)
    assert difference(first, first) == (True, 0.0)


def test_a_remainder_alone_is_told_by_its_channels() -> None:
    first, again = extended(remainder("heat_w", "floor_degc")), extended(remainder("heat_w", "coolant_degc"))
    assert effect_names(first.effects) == ["regression:heat_w+floor_degc"]
    assert difference(again, first) == (False, math.inf)
    assert not difference(extended(coolant(2.0)), first)[0]


def test_effects_that_a_diagnosis_has_added_to_those_of_the_calibrated_model_are_compared() -> None:
    """Their factors begin with an empty row for each effect that was there before."""
    first, again = (
        extended(coolant(2.0), ("gain", {"path": "DTF", "change": change, "std_factor": [[], [0.05]]}))
        for change in (0.2, 0.3)
    )
    same, deviations = difference(again, first)
    assert same and math.isclose(deviations, 2.0)
