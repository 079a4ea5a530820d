"""Effects that a base model lacks: one file for each kind.

A kind registers itself with `register`; every module of this package is imported when the kinds are first
asked for, so a new kind is a new file and nothing else.
"""

from __future__ import annotations

from compensator.model.effects.base import Effect, EffectKind, Signals, kinds, register

__all__ = ["Effect", "EffectKind", "Signals", "kinds", "register"]
