"""Signals of the base model that effects may use: of one sample, and over a whole record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic

import numpy as np

from compensator.arrays import Vector
from compensator.model.effects.blocks import S


@dataclass(frozen=True, slots=True, kw_only=True)
class Signals(Generic[S]):
    """Signals of one sample.

    Parameters
    ----------
    drive : float
        Estimated heat, W (T_Q − AT, K, in a direct model).
    ambient_k : float
        AT as a change from the reference, K.
    y_dtf_um, y_tdtf_um : float
        Share of each path, µm.
    channels : mapping of str to float
        Auxiliary channels, in their own units; the last good value where one is missing.
    """

    drive: S
    ambient_k: S
    y_dtf_um: S
    y_tdtf_um: S
    channels: Mapping[str, S] = field(default_factory=dict)

    def share(self, path: str) -> S:
        """Return the share of a path in y, µm (`all`: of both); the TTF's is the DTF's, which it drives."""
        if path == "all":
            return self.y_dtf_um + self.y_tdtf_um
        return self.y_tdtf_um if path == "TDTF" else self.y_dtf_um

    def source(self, path: str) -> S:
        """Return what drives a path: heat, W (or T_Q − AT, K), or the change of the ambient, K."""
        return self.ambient_k if path == "TDTF" else self.drive


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordSignals(Signals[Vector]):
    """Signals over a whole record: each an array, shape (n,), channels with gaps bridged.

    Parameters
    ----------
    period_min : float
        Sample period, min.
    share_of_ambient : numpy.ndarray, shape (n,)
        What the DTF would make of the ambient's change if T_Q alone showed it, µm.
    number : int
        Which of several records this is.
    begins_min : float
        When it begins after the start of the first, min.
    """

    period_min: float
    share_of_ambient: Vector = field(default_factory=lambda: np.zeros(1))
    number: int = 0
    begins_min: float = 0.0

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.drive.size)

    @property
    def minutes(self) -> Vector:
        """Time from the start of the record, shape (n,), min."""
        return np.asarray(np.arange(self.size) * self.period_min)

    @property
    def time_min(self) -> Vector:
        """Time from the start of the first record, shape (n,), min."""
        return self.begins_min + self.minutes
