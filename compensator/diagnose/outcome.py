"""What a diagnosis says: effects, rivals, errors before and after, the extended model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.joint import Part
from compensator.model.simulation import Scores
from compensator.model.thermal_model import EffectTable, ThermalModel
from compensator.reasons import Remark

Verdict = Literal["adequate", "explained", "partly_explained", "unexplained"]

#: Blocks that are held out in turn, and how that is told.
FOLDS = 3
HELD_OUT = (
    f"each of {FOLDS} blocks of time predicted after choosing and fitting on the others; zero and initial state from "
    "the others, too"
)
#: What is left counts as noise up to this many times its level.
NOISE_TIMES = 1.5
#: Another explanation is a rival while it leaves no more than this many times as much.
RIVAL_TIMES = 1.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """An effect that was found.

    Parameters
    ----------
    part : Part
        Hypothesis and values.
    std : dict of str to float
        Standard errors.
    explanation : str
        For an engineer.
    rms_before_um, rms_after_um : float
        Residual without it and with it, the others in place, µm.
    wave : numpy.ndarray, shape (n,)
        What it adds to y, µm, all runs one after another.
    rivals : tuple of Rival
        What explains it nearly as well.
    """

    part: Part
    std: dict[str, float]
    explanation: str
    rms_before_um: float
    rms_after_um: float
    wave: Vector
    rivals: tuple[Rival, ...]

    @property
    def deployable(self) -> bool:
        """Whether the service can run it."""
        return self.part.hypothesis.deployable


@dataclass(frozen=True, slots=True, kw_only=True)
class Rival:
    """Another explanation that is nearly as good."""

    part: Part
    rms_after_um: float
    how_to_tell_apart: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """What a model lacks.

    Parameters
    ----------
    verdict : Verdict
        In one word.
    effects : tuple of Effect
        In order of the error that they remove.
    before, after : Scores
        On data that took no part in choosing or fitting.
    held_out : str
        How that was measured.
    noise_floor_um : float
        What the sensors' noise alone makes, µm.
    model : ThermalModel
        The base model with every deployable effect.
    evidence : Evidence
        Residual and signals.
    residual_before, residual_after : numpy.ndarray, shape (n,)
        Of the fit to everything, nuisances taken out, µm; NaN where y is missing.
    held_out_before, held_out_after : numpy.ndarray, shape (n,)
        The same, each block by a search without it.
    tried : tuple of (str, float)
        Explanations of the largest effect and the rms that each leaves, µm, best first.
    warnings : tuple of Remark
        In words.
    """

    verdict: Verdict
    effects: tuple[Effect, ...]
    before: Scores
    after: Scores
    held_out: str
    noise_floor_um: float
    model: ThermalModel
    evidence: Evidence
    residual_before: Vector
    residual_after: Vector
    held_out_before: Vector
    held_out_after: Vector
    tried: tuple[tuple[str, float], ...]
    warnings: tuple[Remark, ...]


def rms_of(values: Vector) -> float:
    """Return the root mean square of what is there."""
    return float(np.sqrt(np.nanmean(values**2)))


def how_to_tell_apart(first: Part, second: Part) -> str:
    """Say which experiment would tell two explanations apart."""
    slow = max((v for p in (first, second) for n, v in p.named.items() if n.endswith("_min")), default=30.0)
    hours = max(1.0, 3.0 * slow / 60.0)

    def stimulus(part: Part) -> str:
        hypothesis = part.hypothesis
        if hypothesis.channel:
            return f"step {hypothesis.channel} with the heat steady"
        if hypothesis.path in ("DTF", "TTF"):
            return "step the heat with every other channel steady"
        if hypothesis.path == "TDTF":
            return "let the ambient change by some kelvin without heat"
        return "leave everything at rest"

    one, two = stimulus(first), stimulus(second)
    if one == two:
        return f"{one.capitalize()}, at two sizes and up and down, and watch Y for {hours:.0f} h."
    return f"{one.capitalize()}, then {two}; watch Y for {hours:.0f} h each: only one of the two moves it."


def warnings_of(effects: Sequence[Effect], before: Vector, after: Vector) -> tuple[Remark, ...]:
    """Say what to mind of the effects that were found."""
    words = []
    rms_before, rms_after = rms_of(before), rms_of(after)
    if effects and rms_after > rms_before:
        words.append(
            Remark(
                "made_worse",
                f"On held-out blocks the effects make it worse ({rms_after:.2f} against {rms_before:.2f} µm rms), so "
                "the model was left as it is.",
            )
        )
    for effect in effects:
        loose = [name for name, std in effect.std.items() if std > abs(effect.part.named[name]) > 0.0]
        if loose:
            said = f"{effect.part.hypothesis.kind}: {', '.join(loose)} is hardly determined."
            words.append(Remark("hardly_determined", said))
        if effect.rivals:
            names = ", ".join(" ".join(filter(None, rival.part.hypothesis.place)) for rival in effect.rivals)
            words.append(Remark("nearly_as_good", f"{effect.part.hypothesis.kind}: nearly as good would be {names}."))
    return tuple(words)


def table_of(effect: Effect) -> EffectTable:
    """Return an effect as the model file holds it."""
    part = effect.part
    table: dict[str, Any] = part.hypothesis.table(part.values, part.amplitudes)
    return EffectTable(kind=part.hypothesis.kind, table={**table, "std": effect.std, "explanation": effect.explanation})
