"""What to know before relying on what was found, in words: all of it together, and each effect."""

from __future__ import annotations

from collections.abc import Iterator

from compensator.arrays import rms_of
from compensator.codes import ModelWarning, Remark
from compensator.diagnose.choice.deployment import Deployment
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.search.background import room_for_channels
from compensator.model.effects.hypothesis import EQUAL, Context

#: An error is said to be worse from this many times another one on.
CLEARLY_WORSE = 1.05


def warnings_on(chosen: Deployment, *, deployed: bool) -> Iterator[Remark]:
    """Yield what to know before relying on the effects that were found.

    Parameters
    ----------
    chosen : Deployment
        Effects, with what is deployed and what speaks against it.
    deployed : bool
        Whether the extended model has any.
    """
    yield from _on_all(chosen, deployed=deployed)
    start_k = chosen.found.search.evidence.start_k
    for effect in chosen.effects:
        yield from _on_effect(effect, start_k)


def ceiling_in_part(context: Context) -> list[Remark]:
    """Return the remark that there are more channels than all together can be, where there are."""
    kept, count = room_for_channels(context), len(context.channels)
    if count <= kept:
        return []
    text = (
        f"Only {kept} of {count} channels that move are in the ceiling and the remainder, those that are most like "
        "what the model leaves; effects with a name were looked for in all."
    )
    return [Remark(ModelWarning.CEILING_IN_PART, text)]


def _on_all(chosen: Deployment, *, deployed: bool) -> Iterator[Remark]:
    """Yield what speaks against all that was found; of few values held-out blocks do not decide what is deployed."""
    rms_before, rms_after = rms_of(chosen.held_out.nothing), rms_of(chosen.held_out.whole)
    if chosen.worse_um is not None:
        text = (
            "In free run over the same data (zero of each run fitted) what would be deployed increases the error "
            f"({chosen.worse_um[1]:.2f} against {chosen.worse_um[0]:.2f} µm rms), so the model was left unchanged."
        )
        yield Remark(ModelWarning.WORSE_IN_FREE_RUN, text)
    elif chosen.too_short_h is not None:
        text = (
            f"What was found explains a record of {chosen.too_short_h:.1f} h only in part, and in so few hours noise "
            "and the model's own error look like an effect, so it was left unchanged."
        )
        yield Remark(ModelWarning.TOO_SHORT, text)
    # A source that no channel shows predicts nothing and is never deployed: what is, or could be, must.
    elif (deployed or any(effect.effect.observed for effect in chosen.effects)) and (
        rms_after > rms_before or (deployed and rms_after == rms_before)
    ):
        numbers = f"({rms_after:.2f} against {rms_before:.2f} µm rms)"
        if deployed or chosen.found.search.evidence.is_sparse:
            worse = "no better" if rms_after <= CLEARLY_WORSE * rms_before else "worse"
            text = f"What was found is clear in all data together, but predicts held-out blocks {worse} {numbers}."
            yield Remark(ModelWarning.NOT_CONFIRMED, text)
        else:
            text = f"The effects increase the error on held-out blocks {numbers}, so the model was left unchanged."
            yield Remark(ModelWarning.MADE_WORSE, text)


def _on_effect(effect: FoundEffect, start_k: float) -> Iterator[Remark]:
    """Yield what to know of an effect; `start_k` as in `Evidence`."""
    kind, named, loose = effect.place[0], effect.named, effect.hardly_determined
    if start_k and effect.term.effect.counts_from_rest and effect.place[1] == "DTF":
        text = (
            f"{kind}: the record begins with T_Q − AT at {start_k:.1f} K; the effect counts from its start, as if "
            "the machine were at rest there. On a run that begins cooler it is wrong."
        )
        if effect.term.hypothesis.rest == EQUAL:
            text = (
                f"{kind}: the record begins with T_Q − AT at {start_k:.1f} K; the effect counts from {EQUAL}, "
                "where the machine is taken to be at rest. The free runs here begin as warm as their data."
            )
        yield Remark(ModelWarning.WARM_START, text)
    if effect.reverses_path:
        text = f"{kind}: Y moves against the {effect.place[1]}, so the model was left unchanged."
        yield Remark(ModelWarning.PATH_REVERSED, text)
    if loose:
        # Two lags near each other share one response: what matters at rest is known.
        known = [name for name in named if name.startswith("gain_um_per_") and name not in loose]
        together = f"; their sum, {known[0]}, is determined" if known and len(loose) > 1 else ""
        text = f"{kind}: the standard error of {', '.join(loose)} is larger than the value{together}."
        yield Remark(ModelWarning.HARDLY_DETERMINED, text)
    if effect.rivals:
        names = ", ".join(rival.label for rival in effect.rivals)
        how = "as well, or nearly" if any(rival.log_evidence > 0.0 for rival in effect.rivals) else "nearly as well"
        yield Remark(ModelWarning.NEARLY_AS_GOOD, f"{kind}: {names} would explain it {how}.")
