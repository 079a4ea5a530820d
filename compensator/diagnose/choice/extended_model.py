"""The extended model: the base with what is deployed, and the deviation that it states."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from compensator.arrays import rms_of
from compensator.codes import ModelWarning, Remark
from compensator.diagnose.choice.deployment import Deployment
from compensator.diagnose.choice.found_effect import FoundEffect, no_further_than_seen, seen_of
from compensator.diagnose.choice.held_out import HeldOut
from compensator.diagnose.fitting.standard_errors import std_factors
from compensator.diagnose.residual.noise import VERDICT_TIMES
from compensator.diagnose.search.findings import Findings, in_free_run
from compensator.diagnose.search.refitted_paths import with_paths
from compensator.model.effects import Effect
from compensator.model.late_observer import late_variance_um2
from compensator.model.thermal_model import LEAST_OWN_ERROR, ThermalModel


def extended_model(model: ThermalModel, chosen: Deployment) -> tuple[ThermalModel, tuple[Remark, ...]]:
    """Return a model with what is deployed and the deviation that the data show; itself where nothing is added.

    Parameters
    ----------
    model : ThermalModel
        The base model.
    chosen : Deployment
        What is deployed.

    Returns
    -------
    ThermalModel
        The extended model, or the base.
    tuple of Remark
        That paths were fitted anew, or that the base states a smaller deviation than the data show.
    """
    found, effects = chosen.found, chosen.effects
    extended, remarks = (model, ()) if chosen.is_refused else with_effects(model, found, effects)
    deviation_um = _deviation_um(extended, model, found, effects, chosen.held_out)
    if extended is model:
        return model, tuple(_deviation_contradicted(model.y_std_um, deviation_um))
    return dataclasses.replace(extended, y_std_um=deviation_um, sha256=""), remarks


def with_effects(
    model: ThermalModel, found: Findings, effects: Sequence[FoundEffect]
) -> tuple[ThermalModel, tuple[Remark, ...]]:
    """Return the model with every effect that can be deployed and the remainder; the model itself without any."""
    evidence = found.search.evidence
    deployed = _with_factors(model, found, [effect for effect in effects if effect.deployable])
    remarks: tuple[Remark, ...] = ()
    base, remainder = model, found.remainder.effect if found.remainder else None
    if found.refitted:
        base, remainder = with_paths(model, remainder or found.refitted.effect)
        base = dataclasses.replace(base, held_out_rms_um=None)
        remarks = (Remark(ModelWarning.FITTED_ANEW, _refitted(model, base)),)
    if remainder is not None:
        seen = seen_of(remainder, found.whole - found.named, evidence)
        if not found.refitted:
            # Paths that were fitted anew together with it may go further, too, and the two share what both explain.
            remainder = no_further_than_seen(remainder, evidence)
        deployed.append(dataclasses.replace(remainder, explanation=remainder.explain(seen)))
    if not deployed and base is model:
        return model, ()
    return dataclasses.replace(base, effects=(*model.effects, *deployed), sha256=""), remarks


def _with_factors(model: ThermalModel, found: Findings, effects: Sequence[FoundEffect]) -> list[Effect]:
    """Return effects with what the data leave open of all their parameters together.

    Where the base's paths were fitted anew with them, none is stated: what the paths make up for is not known apart.
    """
    if found.refitted or not effects:
        return [effect.effect for effect in effects]
    terms = [term for term in found.terms if term is not found.left_in]
    factors = std_factors(found.fit, terms, beside_own_error=found.is_own_error)
    rows = dict(zip(map(id, terms), factors, strict=True))
    # Rows belong together by their place: those of effects that the model has already come first.
    before = max((len(one.std_factor) for one in model.effects if not one.has_variance), default=0)
    return [
        effect.effect
        if effect.effect.lateness
        else dataclasses.replace(effect.effect, std_factor=((),) * before + rows[id(effect.term)])
        for effect in effects
    ]


def _deviation_contradicted(stated_um: float, shown_um: float) -> Iterator[Remark]:
    """Yield a remark where a model to which nothing is added states a smaller deviation than the data show."""
    if shown_um > VERDICT_TIMES * stated_um:
        text = (
            f"The model states {stated_um:.2f} µm as the standard deviation of its own error; these data show "
            f"{shown_um:.2f} µm. It was left as it is."
        )
        yield Remark(ModelWarning.DEVIATION_CONTRADICTED, text)


def _deviation_um(
    extended: ThermalModel, model: ThermalModel, found: Findings, effects: Sequence[FoundEffect], held_out: HeldOut
) -> float:
    """Return the standard deviation of a model's own error that the data show, µm."""
    evidence, deploys = found.search.evidence, extended is not model
    # What depends on time alone is an error of the measurement: it is not in the machine that the model runs on.
    of_machine = [effect for effect in effects if effect.effect.deployable or not effect.effect.observed]
    kept_out = [
        effect.signal[evidence.used]
        for effect in of_machine
        if effect.left_in or not (deploys and (effect.effect.deployable or effect.replaced))
    ]
    left = found.rest_um**2 + (rms_of(np.sum(kept_out, axis=0)) ** 2 if kept_out else 0.0)
    is_approximate = found.refitted is not None or not found.search.points.is_exact
    if deploys and is_approximate and not kept_out and len(of_machine) == len(effects) and not evidence.is_sparse:
        # No effect has exactly this form: half what the fit expects, half what held-out blocks show. The one is too
        # small, the other has few blocks. What is open of the parameters the effects state by themselves.
        shown = max(rms_of(held_out.whole) ** 2 - evidence.noise.noise_um**2, 0.0)
        left = 0.5 * (left + shown)
    if not deploys and evidence.is_far_off:
        # What is learned beside paths, or an own error, that are not deployed says nothing of what the base leaves.
        left = max(left, in_free_run(found)[0] ** 2 - evidence.noise.noise_um**2)
    # The engine states by itself what it cannot know of a late T_Q.
    late = late_variance_um2(extended) - late_variance_um2(model)
    return float(np.sqrt(max(left - late, (LEAST_OWN_ERROR * evidence.noise.noise_um) ** 2)))


def _refitted(old: ThermalModel, new: ThermalModel) -> str:
    paths = [("DTF", old.dtf, new.dtf), *([("TDTF", old.tdtf, new.tdtf)] if old.tdtf and new.tdtf else [])]
    gains = ", ".join(
        f"{name} from {a.sampled.dc_gain:.3g} to {b.sampled.dc_gain:.3g} {a.unit.replace('um', 'µm')}"
        for name, a, b in paths
    )
    return (
        "The first model was calibrated while this acted and misses much of its own data, so its paths were refitted "
        f"together with it; gains changed: {gains}."
    )
