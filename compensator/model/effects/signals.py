"""Signals of the base model that effects may use: of one sample, and over a whole record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from compensator.arrays import Vector
from compensator.model.effects.blocks import Signal
from compensator.model.transfer_function import SampledTransferFunction


class _ByPath:
    """Access to signals by the name of a path."""

    __slots__ = ()
    drive: Signal
    ambient_k: Signal
    y_dtf_um: Signal
    y_tdtf_um: Signal

    def share(self, path: str) -> Signal:
        """Return the share of a path in y, µm (`all`: of both); the TTF's is the DTF's, which it drives."""
        if path == "all":
            return self.y_dtf_um + self.y_tdtf_um
        return self.y_tdtf_um if path == "TDTF" else self.y_dtf_um

    def source(self, path: str) -> Signal:
        """Return what drives a path: heat, W (or T_Q − AT, K), or the change of the ambient, K."""
        return self.ambient_k if path == "TDTF" else self.drive


@dataclass(slots=True)
class Signals(_ByPath):
    """Signals of one sample.

    Parameters
    ----------
    drive : float
        Estimated heat, W (T_Q − AT, K, in a direct model).
    ambient_k : float
        AT as a change from the reference, K.
    y_dtf_um, y_tdtf_um : float
        Share of each path, µm.
    channels : dict of str to float
        Auxiliary channels, in their own units; the last good value where one is missing.
    """

    drive: float = 0.0
    ambient_k: float = 0.0
    y_dtf_um: float = 0.0
    y_tdtf_um: float = 0.0
    channels: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordSignals(_ByPath):
    """Signals over a whole record.

    Parameters
    ----------
    period_min : float
        Sample period, min.
    drive, ambient_k, y_dtf_um, y_tdtf_um : numpy.ndarray, shape (n,)
        As in `Signals`.
    channels : mapping of str to numpy.ndarray, shape (n,)
        Auxiliary channels, gaps bridged.
    dtf, tdtf : SampledTransferFunction
        Paths of the base model.
    number : int
        Which of several records this is.
    """

    period_min: float
    drive: Vector
    ambient_k: Vector
    y_dtf_um: Vector
    y_tdtf_um: Vector
    channels: Mapping[str, Vector]
    dtf: SampledTransferFunction
    tdtf: SampledTransferFunction
    number: int = 0

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.drive.size)

    @property
    def minutes(self) -> Vector:
        """Time from the start of the record, shape (n,), min."""
        return np.asarray(np.arange(self.size) * self.period_min)

    def function(self, path: str) -> SampledTransferFunction:
        """Return the transfer function of a path."""
        return self.tdtf if path == "TDTF" else self.dtf
