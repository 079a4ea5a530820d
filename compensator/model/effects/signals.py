"""Signals of the base model that effects may use: of one sample, and over a whole record."""

from __future__ import annotations

import dataclasses
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
    t_q_degc, at_degc : float
        T_Q and AT as they are, °C, for what exchanges heat with something whose temperature is measured, too. Where
        the model corrects a dead time of T_Q, what its sensor is going to show after it.
    y_dtf_um, y_tdtf_um : float
        Share of each path, µm.
    channels : mapping of str to float
        Auxiliary channels, in their own units; the last good value where one is missing.
    """

    drive: S
    ambient_k: S
    t_q_degc: S
    at_degc: S
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

    def share_from_rest(self, path: str) -> S:
        """Return the share of a path counted from where the machine is at rest: where the service has its zero."""
        return self.share(path)

    def source_from_rest(self, path: str) -> S:
        """Return what drives a path, counted from where the machine is at rest."""
        return self.source(path)


@dataclass(frozen=True, slots=True, kw_only=True)
class Warmth:
    """What a machine that is not at rest has at the start of a record.

    Parameters
    ----------
    drive : float
        Heat that would hold its T_Q − AT, W (T_Q − AT itself, K, in a direct model).
    y_dtf_um : float
        Share of the DTF that this heat has in the end, µm.
    """

    drive: float = 0.0
    y_dtf_um: float = 0.0


COLD = Warmth()


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
    warmth : Warmth
        What the machine has at its start.
    warmths : mapping of str to Warmth
        The same by where the machine may be at rest, see `Hypothesis.rest`.
    initial_um : numpy.ndarray, optional, shape (n,)
        What the initial state of the paths adds to that, µm, where it is known.
    """

    period_min: float
    share_of_ambient: Vector = field(default_factory=lambda: np.zeros(1))
    number: int = 0
    begins_min: float = 0.0
    warmth: Warmth = COLD
    warmths: Mapping[str, Warmth] = field(default_factory=dict)
    initial_um: Vector | None = None

    @property
    def begins_at_rest(self) -> bool:
        """Whether nothing is known to be left from before the record."""
        return self.warmth == COLD and self.initial_um is None

    def begun(self, rest: str) -> RecordSignals:
        """Return the record as it begins if the machine is at rest there."""
        warmth = self.warmths.get(rest, COLD)
        return self if warmth == self.warmth else dataclasses.replace(self, warmth=warmth)

    def share_from_rest(self, path: str) -> Vector:
        """Return the share of a path with what it had at the start.

        Once the initial state has died away this is exact, because the paths are linear.
        """
        if path == "TDTF":
            return self.share(path)
        found = self.share(path) + self.warmth.y_dtf_um
        return found if self.initial_um is None else found + self.initial_um

    def source_from_rest(self, path: str) -> Vector:
        """Return what drives a path with what it had at the start."""
        return self.source(path) if path == "TDTF" else self.source(path) + self.warmth.drive

    def held(self) -> RecordSignals:
        """Return the record of a machine that stays as it was at the start."""
        still = np.zeros(self.size)
        channels = {name: np.full(self.size, values[0]) for name, values in self.channels.items()}
        return dataclasses.replace(
            self,
            drive=still,
            ambient_k=still,
            t_q_degc=np.full(self.size, self.t_q_degc[0]),
            at_degc=np.full(self.size, self.at_degc[0]),
            y_dtf_um=still,
            y_tdtf_um=still,
            channels=channels,
            initial_um=None,
        )

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
