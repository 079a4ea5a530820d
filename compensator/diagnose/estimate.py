"""What every way to find missing effects gives to the diagnosis: effects, residuals, predictions of held-out blocks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar

from compensator.arrays import Vector
from compensator.codes import Remark
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Term
from compensator.diagnose.outcome import HELD_OUT, FoundEffect, described, rivals_of
from compensator.model.thermal_model import ThermalModel
from compensator.progress import ExecutorMap

#: What is predicted on every sample by the base alone and with the effects, µm.
Prediction = tuple[Vector, Vector]


class Estimate(ABC):
    """Effects that were found in all of the evidence, and how they are found without some of it.

    Attributes
    ----------
    effects : tuple of FoundEffect
        In the order in which they are reported, companions included.
    tried : tuple of (str, float)
        Explanations of the largest effect and the rms that each leaves, µm, best first.
    residual_before, residual_after : numpy.ndarray, shape (n,)
        Of the fit to everything, without and with the effects, µm.
    """

    #: How the errors before and after are measured.
    held_out: ClassVar[str] = HELD_OUT

    effects: tuple[FoundEffect, ...]
    tried: tuple[tuple[str, float], ...]
    residual_before: Vector
    residual_after: Vector

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence

    @abstractmethod
    def predictions(self, views: Sequence[Evidence], executor_map: ExecutorMap) -> Iterable[Prediction]:
        """Return what each part of the evidence predicts on every sample."""

    @abstractmethod
    def left(self, seen: Evidence, predicted: Vector) -> Sequence[Vector]:
        """Return the residual of a prediction on every sample, µm, for each choice of nuisances."""

    @abstractmethod
    def is_explained(self, before_um: float, after_um: float) -> bool:
        """Return whether what is left is noise, given the errors on held-out data."""

    @abstractmethod
    def extended(
        self, model: ThermalModel, deployed: Sequence[FoundEffect], after_um: float
    ) -> tuple[ThermalModel, tuple[Remark, ...]]:
        """Return the model with the effects that can be deployed, and what to know of it."""

    def found(
        self,
        term: Term,
        std: Mapping[str, float],
        signal: Vector,
        rms_um: tuple[float, float],
        others: Iterable[tuple[Term, float]],
        *,
        searched_um: float | None = None,
    ) -> FoundEffect:
        """Return an effect with its explanation and rivals.

        Parameters
        ----------
        term : Term
            What was found.
        std : mapping of str to float
            Standard errors.
        signal : numpy.ndarray, shape (n,)
            What it adds to y, µm.
        rms_um : (float, float)
            Residual without and with it, µm.
        others : iterable of (Term, float)
            Other explanations and the rms that each leaves, µm, best first.
        searched_um : float, optional
            What the search left, which rivals are compared with, where the deployed effect leaves more.
        """
        before, after = rms_um
        return FoundEffect(
            term=term,
            effect=described(term, std, signal[self.evidence.used]),
            rms_before_um=before,
            rms_after_um=after,
            signal=signal,
            rivals=rivals_of(term, others, after if searched_um is None else searched_um),
        )
