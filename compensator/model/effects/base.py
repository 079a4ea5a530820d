"""What every effect shares: the signals it may use, its streaming step, its registration.

An effect adds to the predicted deformation. It sees the signals of the base model at the same sample and
keeps a state of its own. A wrong gain of the DTF adds `g · y_dtf`, a late path adds `y(t − d) − y(t)`, an
unused channel adds its own transfer function of that channel: every kind of the contract's table can be
written as an addition, because the base is linear in its drive.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from compensator.errors import ModelError


@dataclass(slots=True)
class Signals:
    """Signals of one sample that an effect may use.

    Parameters
    ----------
    drive : float
        Estimated heat, W (T_Q − AT, K, in a direct model).
    difference_k : float
        T_Q − AT as a change from the reference, K.
    ambient_k : float
        AT as a change from the reference, K.
    y_dtf_um, y_tdtf_um : float
        Share of each path, µm.
    channels : dict of str to float
        Auxiliary channels, in their own units; the last good value where one is missing.
    """

    drive: float = 0.0
    difference_k: float = 0.0
    ambient_k: float = 0.0
    y_dtf_um: float = 0.0
    y_tdtf_um: float = 0.0
    channels: dict[str, float] = field(default_factory=dict)


class Effect(Protocol):
    """One effect that runs in the engine."""

    @property
    def kind(self) -> str:
        """Kind, as in the model file."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Auxiliary channels that it needs."""

    def step(self, signals: Signals) -> float:
        """Advance by one sample and return the addition to y, µm."""

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""


class EffectKind(Protocol):
    """How a kind of effect is made from its table in the model file."""

    def from_table(self, table: Mapping[str, Any], period_s: float) -> Effect:
        """Make the effect; raise `ModelError` naming key and value where the table is wrong."""


_KINDS: dict[str, EffectKind] = {}
_loaded = False


def register(kind: str) -> Callable[[EffectKind], EffectKind]:
    """Register a kind of effect under its name in the model file."""

    def add(maker: EffectKind) -> EffectKind:
        if kind in _KINDS:
            raise ModelError(f"effect kind {kind!r} is registered twice")
        _KINDS[kind] = maker
        return maker

    return add


def kinds() -> Mapping[str, EffectKind]:
    """Return every kind, importing the package's modules on the first call."""
    global _loaded  # noqa: PLW0603  the imports below register themselves once
    if not _loaded:
        package = importlib.import_module("compensator.model.effects")
        for module in pkgutil.iter_modules(package.__path__):
            importlib.import_module(f"{package.__name__}.{module.name}")
        _loaded = True
    return _KINDS
