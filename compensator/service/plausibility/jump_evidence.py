"""Evidence for and against a channel that has jumped: measured Y, probes and what the model thinks likely."""

from __future__ import annotations

import math

from compensator.service.plausibility.grown_y import GrownY
from compensator.service.plausibility.jump_engines import JumpEngines
from compensator.service.plausibility.jump_state import JumpState

#: Log likelihood ratio, and least number of samples, for the model to agree with a channel.
_AGREES, _AGREES_SAMPLES = 12.0, 10
#: What agrees then, with its verb.
MODEL_AGREES = "the model agrees"
#: Log likelihood ratio at which a jump within the permitted rate is refuted.
_REFUTED = 12.0
#: Consecutive samples for which Y must speak for a channel.
_Y_SAMPLES = 10
#: The same by the change since the zero alone. An engine that is wrong agrees with it on its way, but not for so long.
_Y_ZERO_SAMPLES = 45
#: Samples with Y that count as one: its errors last. At most so much speaks for either engine.
_Y_CORRELATED, _MOST_BY_Y = 60.0, 30.0
#: Log likelihood ratio by which one value of Y outweighs what the temperatures say.
_OUTWEIGHS = 4.0
#: So many of them are taken back by one that does not agree: some values are outside of what is expected by chance.
_Y_MISFIT = 3
#: Probes that must speak for a channel: one may have met a chip.
_PROBES = 2
#: So soon after a jump both engines agree, and a probe that fits says nothing.
_APART_SAMPLES = 10


def weigh_y(state: JumpState, engines: JumpEngines, grown: GrownY) -> None:
    """Count the samples for which measured Y has spoken for one engine.

    Parameters
    ----------
    state : JumpState
        State of the watch, which keeps the counts.
    engines : JumpEngines
        The two engines.
    grown : GrownY
        Deformation by measured Y.
    """
    if not grown.level_std_um > 0.0:
        return
    if not math.isnan(grown.by_level):
        speaks = engines.speaks(grown.by_level, grown.level_std_um)
        favours = engines.favours(grown.by_level, grown.level_std_um)
        _add(state, favours / _Y_CORRELATED)
        if favours > _OUTWEIGHS:
            # A heat that is switched is unexpected for both, and less so for the one that knows less of it.
            state.ratio = max(state.ratio, 0.0)
        state.y_for = state.y_for + 1 if speaks > 0 else 0
        state.y_against = state.y_against + 1 if speaks < 0 else 0
    if not math.isnan(grown.by_zero):
        speaks, fits = (ask(grown.by_zero, grown.zero_std_um) for ask in (engines.speaks, engines.fits_y))
        state.y_zero_for = state.y_zero_for + 1 if speaks > 0 else 0
        state.y_fits = max(state.y_fits + (1 if fits and not state.y_against else -_Y_MISFIT), 0)


def weigh_probe(state: JumpState, engines: JumpEngines, grown_um: float, std_um: float) -> None:
    """Count a probe if it speaks for one engine: deformation since the zero and standard deviation, µm."""
    if not (state.is_suspect or state.is_unconfirmed) or math.isnan(grown_um):
        return
    speaks = engines.speaks(grown_um, std_um)
    if state.is_unconfirmed:
        # One probe alone decides nothing: it may have met a chip.
        _add(state, min(engines.favours(grown_um, std_um), _AGREES / _PROBES))
    state.probes_for += speaks > 0
    state.probes_against += speaks < 0
    if state.age >= _APART_SAMPLES:
        state.probes_fit = state.probes_fit + 1 if engines.fits_y(grown_um, std_um) else 0


def _add(state: JumpState, favours: float) -> None:
    """Add what speaks for the believing engine, or against it: then it must speak for it for longer."""
    state.y_ratio = max(min(state.y_ratio + favours, _MOST_BY_Y), -_MOST_BY_Y)


def confirmed_by(state: JumpState) -> str:
    """Return what agrees with the believing engine, with its verb; empty if nothing decides."""
    by_y = state.y_ratio >= _AGREES
    if state.y_for >= _Y_SAMPLES or state.y_zero_for >= _Y_ZERO_SAMPLES or (by_y and not state.probes_fit):
        return "measured Y agrees"
    if state.probes_for >= _PROBES or by_y:
        return "probes agree"
    if state.ratio >= _AGREES and state.samples >= _AGREES_SAMPLES:
        return MODEL_AGREES
    return ""


def is_good_enough(state: JumpState) -> bool:
    """Return whether measured Y, or probes, have agreed with the believing engine for long, perhaps with both."""
    return state.y_fits >= _Y_ZERO_SAMPLES or state.probes_fit >= _PROBES


def is_contradicted(state: JumpState) -> bool:
    """Return whether measured Y or probes speak for the shifted engine."""
    return state.y_against >= _Y_SAMPLES or state.probes_against >= _PROBES


def is_unlikely(state: JumpState) -> bool:
    """Return whether the shifted engine has expected the channels far better."""
    return state.ratio <= -_REFUTED
