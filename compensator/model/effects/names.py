"""Names by which the effects of a model are known: each by its kind and place."""

from __future__ import annotations

from collections.abc import Sequence

from compensator.model.effects.base import Effect
from compensator.model.effects.regression import Regression


def effect_names(effects: Sequence[Effect]) -> list[str]:
    """Return the names of the effects that a model is known by."""
    return [name_of(effect) for effect in known_by(effects)]


def known_by(effects: Sequence[Effect]) -> Sequence[Effect]:
    """Return the effects with a name; without any, the remainder.

    A remainder beside them is the base's own error: its channels differ from one diagnosis to the next, and what is
    explained stays the same.
    """
    return [effect for effect in effects if effect.kind != Regression.kind] or effects


def name_of(effect: Effect) -> str:
    """Return kind and place of an effect.

    Examples
    --------
    >>> from compensator.model.effects import effect_from
    >>> name_of(effect_from("gain", {"path": "DTF", "change": 0.1}))
    'gain:DTF'
    """
    channels = dict.fromkeys(effect.channels)
    return ":".join(filter(None, (effect.kind, effect.path, "+".join(channels))))
