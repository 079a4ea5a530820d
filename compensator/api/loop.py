"""A diagnosis in this process for the loop: from the service's outcomes to what can be deployed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from compensator.api.diagnosis import DiagnosisResult, diagnose
from compensator.arrays import Vector
from compensator.clock import NS
from compensator.codes import SampleQuality
from compensator.config import Config
from compensator.data.files import measured_probes
from compensator.diagnose.advice_words import advice_lines
from compensator.errors import CompensatorError
from compensator.messages import number
from compensator.model.model_file import parse_model
from compensator.model.model_writer import dump_model
from compensator.service.loop.run import Diagnosed
from compensator.service.outcome import Outcome

#: Verdict where a diagnosis could not be made.
NOT_MADE = "not_made"


def diagnosis_in_process(config: Config) -> Callable[[Sequence[Outcome], bytes], Diagnosed]:
    """Return a function that diagnoses outcomes in this process, as `LoopRun` calls it.

    Parameters
    ----------
    config : Config
        Settings of the machine: the standard deviation of its probes.
    """
    std_um = config.probe.std_um if config.probe is not None else None

    def of(outcomes: Sequence[Outcome], model: bytes) -> Diagnosed:
        return diagnosed(outcomes, model, y_std_um=std_um)

    return of


def diagnosed(outcomes: Sequence[Outcome], model: bytes, *, y_std_um: float | None = None) -> Diagnosed:
    """Diagnose outcomes as `compensator diagnose` does recordings.

    Parameters
    ----------
    outcomes : sequence of Outcome
        Samples in order; missing ones are gaps.
    model : bytes
        File of the base model.
    y_std_um : float, optional
        Standard deviation of a touch probe, µm; where no displacement sensor measured Y.

    Returns
    -------
    Diagnosed
        With the verdict `not_made` where there is too little data, or the data cannot be used.
    """
    try:
        columns, is_probed = table_of_outcomes(outcomes)
        base = parse_model(model, source="model of the loop")
        found = diagnose(base, columns, y_std_um=y_std_um if is_probed else None)
    except CompensatorError as error:
        return Diagnosed(verdict=NOT_MADE, effects=(), model=None, text=str(error), needs=str(error))
    return diagnosed_of(found)


def diagnosed_of(found: DiagnosisResult) -> Diagnosed:
    """Return what a loop uses of a diagnosis."""
    names = [_name(effect) for effect in found.effects if effect.deployable]
    remainder = found.diagnosis.remainder
    if remainder is not None and remainder.deployed:
        names.append(":".join(("regression", *remainder.channels)))
    others = [_name(effect) for effect in found.effects if not effect.deployable]
    text = f"{found.verdict.replace('_', ' ')}: {', '.join(names) or 'nothing that can be deployed'}"
    if others:
        text += f"; not for a model: {', '.join(others)}"
    return Diagnosed(
        verdict=found.verdict,
        effects=tuple(names),
        model=dump_model(found.model).encode() if names else None,
        text=f"{text}.",
        needs=_needs(found),
    )


def table_of_outcomes(outcomes: Sequence[Outcome]) -> tuple[dict[str, Any], bool]:
    """Return the samples as a table; whether Y is from touch probes, as where recordings are read.

    Raises
    ------
    CompensatorError
        If there are none.
    """
    names = sorted({name for outcome in outcomes for name in outcome.sample.channels})
    t_s: Vector = np.array([outcome.sample.time_utc_ns / NS for outcome in outcomes], dtype=np.float64)
    columns = {name: np.array([_value(outcome, name) for outcome in outcomes]) for name in names}
    probes, _ = measured_probes("probes", [[probe for outcome in outcomes for probe in outcome.probes]])
    is_probed = bool(probes) and bool(np.isnan(columns.get("y_um", np.array([math.nan]))).all())
    if is_probed:
        blank = np.full(len(probes), math.nan)
        columns = {name: np.concatenate([values, blank]) for name, values in columns.items() if name != "y_um"}
        shown = [number(probe.deformation_um) for probe in probes]
        columns["y_um"] = np.concatenate([np.full(t_s.size, math.nan), shown])
        t_s = np.concatenate([t_s, [probe.time_utc_ns / NS for probe in probes]])
    order = np.argsort(t_s, kind="stable")
    start_s = t_s[order[0]] if order.size else 0.0
    return {"t_s": t_s[order] - start_s, **{name: values[order] for name, values in columns.items()}}, is_probed


def _value(outcome: Outcome, name: str) -> float:
    channel = outcome.sample.channels.get(name)
    return number(channel.mean) if channel is not None and channel.quality == SampleQuality.GOOD else math.nan


def _name(effect: Any) -> str:
    return ":".join(filter(None, effect.place))


#: What a person has to do where the measurement of Y, and not the machine, has changed.
_OF_MEASUREMENT = {
    "drift": "check the mount of the displacement sensor or of the probed feature: it drifts",
    "step": "check the mount of the displacement sensor or of the probed feature: it has slipped",
    "periodic": "measured Y has a period that no channel shows: check its sensor, or log what cycles",
}


def _needs(found: DiagnosisResult) -> str:
    """Return what a person has to do, empty where nothing."""
    for effect in found.effects:
        if effect.kind in _OF_MEASUREMENT:
            return _OF_MEASUREMENT[effect.kind]
    lines = advice_lines(found.diagnosis.advice)
    return lines[-1] if lines and found.verdict in ("unexplained", "partly_explained") else ""
