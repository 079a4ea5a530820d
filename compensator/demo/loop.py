"""The closed loop: an effect absent from the calibration is found in the recordings, and the service adopts it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.commands.diagnose import diagnose_files
from compensator.demo.calibration import PERIOD_S
from compensator.demo.day import Day, run_day
from compensator.demo.figures import errors_of
from compensator.model.effects.hypothesis import place_in_words
from compensator.model.model_file import load_model
from compensator.model.model_writer import dump_model
from sim_hardware.physics import draw_effect
from sim_hardware.physics.effects.base import UndeclaredEffect

#: Approximate standard deviation of the undeclared effect in Y, µm.
EFFECT_UM = 5.0
#: The model of the calibration, from the folder of a day.
FIRST_MODEL = "../calibration/model.toml"
#: Added to the demo's seed for the duty and the sensors of the second day.
SECOND_DAY = 2


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TwoDays:
    """What was found on the first day, and the second day with it.

    Parameters
    ----------
    found : dict
        The diagnosis of the first day.
    model : pathlib.Path, optional
        The extended model; None where nothing was added to the first one.
    offset_changes : bool
        Whether it predicts otherwise than the first one.
    second_day : Day
        A day on which the running service adopts it.
    """

    found: dict[str, Any]
    model: Path | None
    offset_changes: bool
    second_day: Day


def effect_of(seed: int, hours: float) -> UndeclaredEffect:
    """Return the effect that the seed of the demo draws."""
    return draw_effect(seed, EFFECT_UM, hours)


def close_the_loop(folder: Path, *, hours: float, seed: int) -> TwoDays:
    """Run a day with an undeclared effect, diagnose its recordings, and run a second day with the extended model.

    The effect is drawn by the seed and not disclosed before the results are written.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the conduction machine, with its calibration.
    hours : float
        Length of each of the two days, h.
    seed : int
        Seed of the effect and of the duties.
    """
    before, effect = folder / "with-effect", effect_of(seed, hours)
    run_day(before, machine="conduction", hours=hours, seed=seed + 1, model=FIRST_MODEL, effects=[effect])
    recordings = sorted((before / "recordings").glob("*.mcap"))
    first_model, extended = folder / "calibration" / "model.toml", folder / "diagnosis" / "model.toml"
    found = diagnose_files(recordings, first_model, extended.parent).result
    # An unchanged model is not adopted.
    model = extended if _content(extended) != _content(first_model) else None
    return TwoDays(
        found=found,
        model=model,
        offset_changes=_content(extended, y_std_um=1.0) != _content(first_model, y_std_um=1.0),
        second_day=second_day(folder, "extended", hours=hours, seed=seed, adopt=model),
    )


def second_day(folder: Path, name: str, *, hours: float, seed: int, adopt: Path | None = None) -> Day:
    """Run the second day with the first model, which the service may be told to replace after an hour."""
    return run_day(
        folder / f"second-day-{name}",
        machine="conduction",
        hours=hours,
        seed=seed + SECOND_DAY,
        model=FIRST_MODEL,
        effects=[effect_of(seed, hours)],
        adopt=adopt,
    )


def figures_of_loop(
    adopted: TwoDays, first: Day, effect: UndeclaredEffect
) -> tuple[dict[str, Any], dict[str, tuple[Vector, Vector]]]:
    """Return the figures of the loop, and the error on the second day over time by model, h and µm.

    Parameters
    ----------
    adopted : TwoDays
        What was found and adopted.
    first : Day
        The second day with the first model.
    effect : UndeclaredEffect
        The effect.
    """
    adopted_h = adopted.second_day.adopted_at * PERIOD_S / 3600.0
    errors, curves = {}, {}
    for name, day in (("first", first), ("extended", adopted.second_day)):
        values = errors_of(day)
        curves[name] = (values["t_h"], values["followed"])
        counted = values["t_h"] >= adopted_h + values["t_h"][0]
        errors[name], errors["without"] = values["followed"][counted], values["without"][counted]
    drawn, found = effect.reveal().describe(), adopted.found
    figures = {
        "drawn": " ".join(str(drawn[key]) for key in ("kind", "path", "channel") if drawn.get(key)),
        "found": [place_in_words((e["kind"], e["path"], e["channel"])) for e in found["effects"]],
        "verdict": found["verdict"],
        "report": found["report"],
        "explanation": [e["explanation"] for e in found["effects"]],
        "held_out_rms_um": {"before": found["before"]["rms_um"], "after": found["after"]["rms_um"]},
        "adopted": adopted.model is not None,
        "offset_changes": adopted.offset_changes,
        "adopted_after_h": adopted_h,
        "second_day_rms_um": {name: float(np.std(values)) for name, values in errors.items()},
    }
    return figures, curves


def _content(model: Path, **same: Any) -> str:
    """Return the content of a model file without its provenance, with some fields replaced."""
    return dump_model(dataclasses.replace(load_model(model), provenance={}, **same))
