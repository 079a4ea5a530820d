"""Effects that a base model lacks: one file for each kind.

A form registers itself with `register`; every module of this package is imported when the kinds are first asked for,
so a new kind is a new file and nothing else.
"""

from __future__ import annotations

from compensator.model.effects.base import Effect, effect_from, kinds, register
from compensator.model.effects.signals import Signals
from compensator.model.effects.stream import EffectStream

__all__ = ["Effect", "EffectStream", "Signals", "effect_from", "kinds", "register"]
