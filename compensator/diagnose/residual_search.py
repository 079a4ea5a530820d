"""Effects found by a search in the residual; the paths of the base model stay as they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import repeat

import numpy as np

from compensator.arrays import Vector
from compensator.codes import Remark
from compensator.diagnose.estimate import Estimate, Prediction
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import as_deployed, standard_errors
from compensator.diagnose.outcome import FoundEffect
from compensator.diagnose.search import Candidate, Search, Selection, without_lead_noise
from compensator.model.late_observer import late_variance_um2
from compensator.model.thermal_model import ThermalModel
from compensator.progress import ExecutorMap


class ResidualSearch(Estimate):
    """Effects that a search adds to the base model.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals.
    """

    def __init__(self, evidence: Evidence) -> None:
        super().__init__(evidence)
        self._selection = found = Search(evidence).run()
        self._deployed, responses = as_deployed(evidence, found.fit)
        self.effects = self._effects(found, responses)
        self.tried = self._ranked(found.rivals[0]) if found.rivals else ()
        self.residual_before, self.residual_after = found.before.residual, self._deployed.residual

    def predictions(self, views: Sequence[Evidence], executor_map: ExecutorMap) -> Iterable[Prediction]:
        """Repeat the search in each part of the evidence."""
        observed = [term.hypothesis.effect.observed for term in self._selection.fit.terms]
        if observed and not any(observed):
            # What an unobserved source does in a held-out block is not known.
            nothing = np.zeros(self.evidence.used.size)
            return repeat((nothing, nothing), len(views))
        return executor_map(partial(_predicted, unobserved=not all(observed)), views)

    def left(self, seen: Evidence, predicted: Vector) -> Sequence[Vector]:
        """Return the residual with only the zero of each run unknown, and with its initial state too."""
        return [seen.left(self.evidence.residual, predicted, at_rest=rest) for rest in (True, False)]

    def is_explained(self, before_um: float, after_um: float) -> bool:
        """Return whether the fit leaves noise; effects that do not hold on held-out data explain part at most."""
        fit = self._selection.fit
        holds = not fit.terms or after_um <= before_um
        return holds and self.evidence.noise.is_explained(without_lead_noise(self.evidence, fit))

    def extended(
        self, model: ThermalModel, deployed: Sequence[FoundEffect], after_um: float
    ) -> tuple[ThermalModel, tuple[Remark, ...]]:
        """Return the model with the effects, and with what it leaves where nothing was fitted as its own error.

        Without that error, a service would go on to publish that of the calibration, on a machine without the effect.
        What was found and cannot be deployed goes on acting.
        """
        kept_out = [e.signal[self.evidence.used] for e in self.effects if not e.deployable]
        left = max(after_um**2 - self.evidence.noise.noise_um**2, 0.0)
        left += float(np.var(np.sum(kept_out, axis=0))) if kept_out else 0.0
        extended = dataclasses.replace(
            model, effects=(*model.effects, *(found.effect for found in deployed)), sha256=""
        )
        # The engine states by itself what it cannot know of a late T_Q.
        left = max(left - (late_variance_um2(extended) - late_variance_um2(model)), 0.0)
        return dataclasses.replace(extended, y_std_um=max(model.y_std_um, float(np.sqrt(left)))), ()

    def _effects(self, selection: Selection, responses: Sequence[Vector]) -> tuple[FoundEffect, ...]:
        evidence, fit = self.evidence, self._deployed
        errors = standard_errors(evidence, selection.fit, selection.variance_inflation)
        after, searched = self._rms(fit.cost), self._rms(selection.fit.cost)
        effects = []
        for term, std, rivals, signal in zip(fit.terms, errors, selection.rivals, responses, strict=True):
            without = fit.residual + evidence.without_nuisances(np.where(evidence.used, signal, 0.0))
            others = ((c.term, self._rms(c.fit.cost)) for c in rivals)
            rms_um = self._rms(float(without @ without)), after
            effects.append(self.found(term, std, signal, rms_um, others, searched_um=searched))
        return tuple(sorted(effects, key=lambda e: -e.rms_before_um))

    def _ranked(self, candidates: Sequence[Candidate]) -> tuple[tuple[str, float], ...]:
        best: dict[str, float] = {}
        for candidate in candidates:
            label, rms = candidate.term.hypothesis.label, self._rms(candidate.fit.cost)
            best[label] = min(rms, best.get(label, np.inf))
        return tuple(sorted(best.items(), key=lambda item: item[1]))

    def _rms(self, cost: float) -> float:
        return float(np.sqrt(cost / self.evidence.count))


def _predicted(seen: Evidence, *, unobserved: bool) -> Prediction:
    """Search in a part of the evidence; return what is found there on every sample of all, µm."""
    _, responses = as_deployed(seen, Search(seen).run(unobserved=unobserved).fit)
    nothing = np.zeros(seen.used.size)
    return nothing, np.asarray(sum(responses, nothing))
