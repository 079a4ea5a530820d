"""What follows from the result of a diagnosis: the candidate, its effects, and how it differs from the present model.

A diagnosis starts from the calibrated model, never from an extension, so an effect that has ended is found as one that
has begun. The candidate is that model with the effects that can be deployed, or, where nothing is explained, that model
itself. In the place of a diagnosis it may be the present model without an effect.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from msgspec.structs import replace

from compensator.config import Config
from compensator.errors import CompensatorError, ModelError
from compensator.events import DiagnosisData
from compensator.model.effects import Effect
from compensator.model.effects.names import effect_names, known_by, name_of
from compensator.model.effects.regression import Regression
from compensator.model.model_file import parse_model
from compensator.model.model_writer import dump_model
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, model_of
from compensator.service.loop.state import is_fewer

#: Verdict of a diagnosis that ended without a result.
FAILED = "failed"
_EXPLAINING = ("explained", "partly_explained")


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """What a diagnosis gave.

    Parameters
    ----------
    verdict : str
        As in `diagnosis.json`, or `failed`.
    effects : tuple of str
        Kind and place of what can be deployed, such as `input:coolant_degc`.
    model : bytes or None
        File of the extended model; None if there is nothing to deploy.
    text : str
        One sentence for people.
    needs : str
        What a person has to do.
    y_moved_utc_ns : int
        When measured Y last moved by itself, ns since 1970 UTC; 0 if it has not.
    without : str
        The effect that the model, the present one otherwise, does not have; empty for what a diagnosis found.
    """

    verdict: str
    effects: tuple[str, ...]
    model: bytes | None
    text: str
    needs: str = ""
    y_moved_utc_ns: int = 0
    without: str = ""


def failed(why: str, *, without: str = "") -> Diagnosed:
    """Return a diagnosis that gave nothing, or that the model cannot be made without an effect."""
    what = f"the model without {without} cannot be made" if without else "the diagnosis failed"
    return Diagnosed(FAILED, (), None, f"{what}: {why}", why, without=without)


def without_effect(present: bytes, effect: str, *, calibrated: bytes) -> Diagnosed:
    """Return the present model without an effect, which may have ended, in the place of a diagnosis.

    Without its last named effect that is the calibrated model: a remainder was fitted beside what it named.

    Raises
    ------
    CompensatorError
        If the loop has not added this effect, or a file cannot be used.
    """
    model, base = parse_model(present, source="present model"), parse_model(calibrated, source="calibrated model")
    own = model.effects[len(base.effects) :]
    kept = tuple(one for one in own if name_of(one) != effect)
    if len(kept) == len(own):
        raise ModelError(f"present model: no effect {effect} beside those of the calibrated one")
    text = f"measured and predicted Y have diverged: the model without {effect}, which may have ended"
    if all(one.kind == Regression.kind for one in kept):
        return Diagnosed("", tuple(effect_names(base.effects)), calibrated, text, without=effect)
    less = dataclasses.replace(model, effects=(*base.effects, *kept))
    return Diagnosed("", tuple(effect_names(less.effects)), dump_model(less).encode(), text, without=effect)


@dataclass(frozen=True, slots=True)
class Weighed:
    """A diagnosis for the recording, and the candidate's model file; None if there is no candidate."""

    data: DiagnosisData
    candidate: bytes | None

    def lasting(self, seconds: float) -> Weighed:
        """Return it with the time that the diagnosis took."""
        return Weighed(replace(self.data, seconds=seconds), self.candidate)


def weigh(found: Diagnosed, config: Config, *, calibrated: bytes, present: ThermalModel) -> Weighed:
    """Return the candidate that follows from a diagnosis, checked, and its differences.

    Parameters
    ----------
    found : Diagnosed
        Result of the diagnosis of the calibrated model, or the present one without an effect.
    config : Config
        Settings of the service.
    calibrated : bytes
        Model file of the configuration, or the last that a person adopted.
    present : ThermalModel
        The present model.
    """
    base = model_of(config, calibrated, source="calibrated model")
    data = _candidate_of(found, calibrated, is_extended=present.sha256 != base.sha256)
    plain = without_candidate(found)
    if data is None:
        return Weighed(plain, None)
    try:
        model = _checked(config, data, base)
    except CompensatorError as error:
        return Weighed(replace(plain, refused=str(error)), None)
    same, change = difference(model, present)
    effects = effect_names(model.effects)
    if same and model.sha256 == base.sha256:
        change = 0.0
    weighed = replace(
        plain,
        effects=effects,
        candidate_sha256=model.sha256,
        candidate=model.name,
        fewer=_is_way_back(effects, effect_names(present.effects), found, config),
        present_sha256=present.sha256,
        same_effects=same,
        change_deviations=min(change, 1e9) if same else None,
        calibrated=model.sha256 == base.sha256,
        off_at_zero=off_at_zero(model, base),
    )
    return Weighed(weighed, data)


def off_at_zero(model: ThermalModel, base: ThermalModel) -> list[str] | None:
    """Return with which channels at 0 all that a model adds to another one is off at rest; None where it may not be."""
    known = [name_of(effect) for effect in known_by(base.effects)]
    added = [effect.off_at_zero for effect in known_by(model.effects) if name_of(effect) not in known]
    channels = [each for each in added if each is not None]
    if not added or len(channels) < len(added):
        return None
    return sorted({channel for each in channels for channel in each})


def _candidate_of(found: Diagnosed, calibrated: bytes, *, is_extended: bool) -> bytes | None:
    """Return the model file that follows from a diagnosis, which may be the calibrated one; None if none does."""
    if found.without or (found.verdict in _EXPLAINING and found.effects):
        return found.model
    return calibrated if is_extended and found.verdict != FAILED else None


def _is_way_back(effects: Sequence[str], present: Sequence[str], found: Diagnosed, config: Config) -> bool:
    """Return whether the service goes back to a model by itself, which the present one has all effects of and more.

    Where a person decides only if it is the present model otherwise: that one has been agreed to.
    """
    by_hand = config.loop is None or config.loop.policy == "propose"
    return is_fewer(effects, present) and bool(found.without or not by_hand)


def without_candidate(found: Diagnosed) -> DiagnosisData:
    """Return the data of a diagnosis from which no candidate follows."""
    return DiagnosisData(
        verdict=found.verdict,
        effects=list(found.effects),
        needs=found.needs,
        y_moved_utc_ns=found.y_moved_utc_ns,
        without=found.without,
    )


def difference(model: ThermalModel, other: ThermalModel) -> tuple[bool, float]:
    """Return whether two models have the same effects, and by how many standard deviations their parameters differ.

    In standard errors of the first model, which was found later: it was found on more of the effect, and says whether
    the parameters of the other one are still possible. Infinite where an effect has none and the parameters differ.
    """
    own, others = ({name_of(effect): effect for effect in known_by(one.effects)} for one in (model, other))
    if own.keys() != others.keys():
        return False, math.inf
    return True, max((_change(effect, others[name]) for name, effect in own.items()), default=0.0)


def _change(effect: Effect, other: Effect) -> float:
    """Return by how many standard deviations the parameter of an effect that differs most does."""
    rows = filter(None, effect.std_factor)  # those of effects that were there before are empty
    factors = [math.hypot(*column) for column in zip(*rows, strict=True)]
    if factors and len(factors) == len(effect.parameters) == len(other.parameters):
        # `std` names what stands in lists one by one.
        moved = [abs(a - b) for a, b in zip(effect.parameters, other.parameters, strict=True)]
        return max((by / std for by, std in zip(moved, factors, strict=True) if std > 0.0), default=0.0)
    tables, largest, compared = (effect.to_table(), other.to_table()), 0.0, False
    for name in effect.std:
        values = [_numbers(table.get(name)) for table in tables]
        errors = _numbers(effect.std[name])
        if not values[0] or len({len(each) for each in (*values, errors)}) > 1:
            continue
        for a, b, std in zip(*values, errors, strict=True):
            largest, compared = max(largest, abs(a - b) / std if std > 0.0 else 0.0), True
    if compared:
        return largest
    plain = [{key: value for key, value in table.items() if key not in ("std", "explanation")} for table in tables]
    return 0.0 if plain[0] == plain[1] else math.inf


def _numbers(value: Any) -> list[float]:
    """Return the numbers of a parameter: one, or those of a list or of lists."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return [float(value)]
    if isinstance(value, (Mapping, str)) or not isinstance(value, Iterable):
        return []
    return [number for item in value for number in _numbers(item)]


def _checked(config: Config, data: bytes, base: ThermalModel) -> ThermalModel:
    """Return a candidate that is the calibrated model with effects that can be deployed, and nothing else."""
    model = model_of(config, data, source="candidate")
    Compensation(config, model)  # refuses an effect of a channel that is not configured
    for effect in model.effects:
        if not effect.deployable:
            raise ModelError(f"candidate: {name_of(effect)} cannot be deployed")
    if _foundation(model, len(base.effects)) != _foundation(base, len(base.effects)):
        raise ModelError("candidate: its paths are not those of the calibrated model; a person has to calibrate it")
    return model


def _foundation(model: ThermalModel, effects: int) -> tuple[Any, ...]:
    """Return what a diagnosis leaves as it is: paths, estimator, validity, and the effects that were there before."""
    first = [effect.to_table() for effect in model.effects[:effects]]
    paths = (model.ttf, model.dtf, model.tdtf, model.alternatives)
    return (model.kind, model.period_s, model.inputs, *paths, model.estimator, model.validity, first)
