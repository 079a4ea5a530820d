"""From a model and measured runs to a verdict, the effects that the model lacks, and the model with them.

The error before and after is measured on blocks of time that took no part: for each block the whole search is done
again without it, and what that finds is applied to the block.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from compensator.diagnose.evidence import Evidence, evidence_of
from compensator.diagnose.joint import Part, response, standard_errors, summed
from compensator.diagnose.search import Found, Search, Tried
from compensator.identify.runs import Run
from compensator.model.effects.unobserved import Unobserved
from compensator.model.thermal_model import EffectTable, ThermalModel
from compensator.simulation import Scores, scores

Vector = npt.NDArray[np.float64]
Verdict = Literal["adequate", "explained", "partly_explained", "unexplained"]
Told = Callable[[int, int], None]

#: Blocks that are held out in turn.
FOLDS = 3
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
    warnings : tuple of str
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
    warnings: tuple[str, ...]


def _silent(done: int, total: int) -> None:
    """Tell nobody."""


def diagnose(model: ThermalModel, runs: Sequence[Run], *, told: Told = _silent) -> Diagnosis:
    """Find what a model lacks.

    Parameters
    ----------
    model : ThermalModel
        The base model.
    runs : sequence of Run
        Measured data with y and every channel that was logged.
    told : callable
        Is told how many searches of how many are done.

    Raises
    ------
    DataError
        If there is too little data.
    """
    evidence = evidence_of(model, runs)
    told(0, FOLDS + 1)
    found, before, after = _searched(evidence, told)
    helps = _rms(after) <= _rms(before)
    floor = evidence.noise_um
    effects = _effects(evidence, found)
    extended = dataclasses.replace(
        model, effects=(*model.effects, *(_table(e) for e in effects if e.deployable and helps)), sha256=""
    )
    y = np.concatenate([run.y_um for run in runs])
    return Diagnosis(
        verdict=_verdict(evidence, found), effects=effects,
        before=scores(y, y - before), after=scores(y, y - after),
        held_out=f"each of {FOLDS} blocks of time predicted after choosing and fitting on the others; zero and initial "
        "state from the others, too",
        noise_floor_um=floor, model=extended, evidence=evidence,
        residual_before=np.where(evidence.used, found.before.residual, np.nan),
        residual_after=np.where(evidence.used, found.joint.residual, np.nan), held_out_before=before,
        held_out_after=after, tried=_tried(found, evidence), warnings=_warnings(effects, before, after),
    )  # fmt: skip


# ---------------------------------------------------------------------------- held out


def _searched(evidence: Evidence, told: Told) -> tuple[Found, Vector, Vector]:
    """Search, and again more carefully where what was found does not hold on blocks that were held out."""
    found = Search(evidence).run()
    before, after = _held_out(evidence, found, told, Search.run)
    if _rms(after) <= _rms(before):
        return found, before, after
    general = Search(evidence).run_by_folds()
    by_folds = _held_out(evidence, general, told, lambda search, **_: search.run_by_folds())
    if general.joint.parts and _rms(by_folds[1]) < _rms(by_folds[0]):
        return general, *by_folds
    return found, before, after


def _rms(values: Vector) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _held_out(evidence: Evidence, found: Found, told: Told, run: Callable[..., Found]) -> tuple[Vector, Vector]:
    """Return the residual before and after on every block, each by a search that did not see it.

    Whether a run's initial state is taken as unknown or as rest is what serves the first model better.
    """
    raw, nothing = evidence.residual, np.zeros(evidence.used.size)
    hidden = [isinstance(part.hypothesis, Unobserved) for part in found.joint.parts]
    before = {rest: np.full(raw.size, np.nan) for rest in (True, False)}
    after = {rest: np.full(raw.size, np.nan) for rest in (True, False)}
    for done, block in enumerate(evidence.blocks(FOLDS), start=1):
        told(done, FOLDS + 1)
        seen = evidence.hidden(block)
        # Nobody knows what a hidden source does in a block that was not seen.
        effects = nothing if hidden and all(hidden) else summed(seen, run(Search(seen), hidden=any(hidden)).joint)
        for rest in (True, False):
            before[rest][block] = seen.left(raw, nothing, at_rest=rest)[block]
            after[rest][block] = seen.left(raw, effects, at_rest=rest)[block]
    best = min((True, False), key=lambda rest: _rms(before[rest]))
    return before[best], after[best]


# ---------------------------------------------------------------------------- what was found


def _effects(evidence: Evidence, found: Found) -> tuple[Effect, ...]:
    joint = found.joint
    errors = standard_errors(evidence, joint, found.colour)
    count = evidence.count
    after = float(np.sqrt(joint.cost / count))
    effects = []
    for i, (part, std) in enumerate(zip(joint.parts, errors, strict=True)):
        wave = response(evidence, part)
        masked = np.where(evidence.used, wave, 0.0)
        without = joint.residual + evidence.without_nuisances(masked)
        rms = float(np.std(wave[evidence.used]))
        effects.append(
            Effect(
                part=part, std=std, explanation=part.hypothesis.explain(part.named, rms),
                rms_before_um=float(np.sqrt(without @ without / count)), rms_after_um=after, wave=wave,
                rivals=_rivals(found.rivals[i], part, after, count),
            )
        )  # fmt: skip
    return tuple(sorted(effects, key=lambda e: -e.rms_before_um))


def _rivals(others: Sequence[Tried], part: Part, after: float, count: int) -> tuple[Rival, ...]:
    rivals: list[Rival] = []
    seen = {part.hypothesis.place}
    for other in others:
        rms = float(np.sqrt(other.joint.cost / count))
        place = other.part.hypothesis.place
        if place in seen or rms > RIVAL_TIMES * after:
            continue
        seen.add(place)
        rivals.append(Rival(part=other.part, rms_after_um=rms, how_to_tell_apart=_apart(part, other.part)))
    return tuple(rivals[:3])


def _apart(first: Part, second: Part) -> str:
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


def _tried(found: Found, evidence: Evidence) -> tuple[tuple[str, float], ...]:
    if not found.rivals:
        return ()
    best: dict[str, float] = {}
    for tried in found.rivals[0]:
        hypothesis = tried.part.hypothesis
        name = " ".join(word for word in (*hypothesis.place, f"({hypothesis.form})" if hypothesis.form else "") if word)
        rms = float(np.sqrt(tried.joint.cost / evidence.count))
        best[name] = min(rms, best.get(name, np.inf))
    return tuple(sorted(best.items(), key=lambda item: item[1]))


def _verdict(evidence: Evidence, found: Found) -> Verdict:
    parts = found.joint.parts
    clean = found.joint.cost < NOISE_TIMES**2 * (evidence.count * evidence.noise_um**2 + evidence.allowance)
    if not parts:
        return "adequate" if clean else "unexplained"
    hidden = [isinstance(part.hypothesis, Unobserved) for part in parts]
    if all(hidden):
        return "unexplained"
    return "explained" if clean and not any(hidden) else "partly_explained"


def _warnings(effects: Sequence[Effect], before: Vector, after: Vector) -> tuple[str, ...]:
    words = []
    rms_before, rms_after = _rms(before), _rms(after)
    if effects and rms_after > rms_before:
        words.append(
            f"On held-out blocks the effects make it worse ({rms_after:.2f} against {rms_before:.2f} µm rms), so the "
            "model was left as it is: record longer, with more change in the inputs."
        )
    for effect in effects:
        loose = [name for name, std in effect.std.items() if std > abs(effect.part.named[name]) > 0.0]
        if loose:
            words.append(f"{effect.part.hypothesis.kind}: {', '.join(loose)} is hardly determined.")
        if effect.rivals:
            names = ", ".join(" ".join(filter(None, rival.part.hypothesis.place)) for rival in effect.rivals)
            words.append(f"{effect.part.hypothesis.kind}: nearly as good would be {names}.")
    return tuple(words)


def _table(effect: Effect) -> EffectTable:
    part = effect.part
    table: dict[str, Any] = part.hypothesis.table(part.values, part.amplitudes)
    return EffectTable(
        kind=part.hypothesis.kind, table={**table, "std": effect.std, "explanation": effect.explanation}
    )  # fmt: skip
