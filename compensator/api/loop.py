"""A diagnosis in this process for the loop: from the service's outcomes to what can be deployed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from compensator.api.diagnosis import DiagnosisResult, diagnose
from compensator.config import Config
from compensator.diagnose.advice_words import advice_lines
from compensator.errors import CompensatorError
from compensator.model.model_file import parse_model
from compensator.model.model_writer import dump_model
from compensator.service.loop.record import usable_table
from compensator.service.loop.weighing import FAILED, Diagnosed
from compensator.service.outcome import Outcome


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
        Samples in order; what must not be used is left out (`usable_table`).
    model : bytes
        File of the base model.
    y_std_um : float, optional
        Standard deviation of a touch probe, µm; where no displacement sensor measured Y.

    Returns
    -------
    Diagnosed
        With the verdict `failed` where there is too little data, or the data cannot be used.
    """
    try:
        table = usable_table(outcomes)
        columns = {"t_s": table.t_s - (table.t_s[0] if table.t_s.size else 0.0), **table.columns}
        is_probed = not any("y_um" in outcome.sample.channels for outcome in outcomes)
        base = parse_model(model, source="model of the loop")
        found = diagnose(base, columns, y_std_um=y_std_um if is_probed else None)
    except CompensatorError as error:
        return Diagnosed(verdict=FAILED, effects=(), model=None, text=str(error), needs=str(error))
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
