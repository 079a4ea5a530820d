"""Effects of a base model that is far off: its paths are refitted together with the channels that it lacks.

The error before is that of the paths alone, also refitted without the held-out block: the first model may have seen it
in its calibration.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence

from compensator.arrays import Vector
from compensator.codes import ModelWarning, Remark
from compensator.diagnose.estimate import Estimate, Prediction
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Term, response
from compensator.diagnose.outcome import HELD_OUT, FoundEffect
from compensator.diagnose.refit import refit
from compensator.model.thermal_model import Path, ThermalModel
from compensator.progress import ExecutorMap

#: A base whose own calibration left more than this share of the deformation's spread lacks something.
FAR_OFF = 0.1


def is_far_off(model: ThermalModel, evidence: Evidence) -> bool:
    """Return whether the calibration itself says that the model misses much of the deformation."""
    return model.held_out_rms_um is not None and model.held_out_rms_um > FAR_OFF * evidence.spread_um


class BaseRefit(Estimate):
    """Channels that are fitted together with the paths of the base model.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals.
    """

    held_out = f"{HELD_OUT}; before: the paths of the first model alone, also refitted to the others"

    def __init__(self, evidence: Evidence) -> None:
        super().__init__(evidence)
        self._whole = whole = refit(evidence)
        self.effects = tuple(
            self.found(term, std, response(evidence, term), (whole.rms_um[i], whole.rms_um[i + 1]), self._others(i))
            for i, (term, std) in enumerate(zip(whole.terms, whole.std, strict=True))
        )
        self.tried = tuple((c.hypothesis.label, c.rms_um) for c in whole.rivals[0][:12]) if whole.rivals else ()
        self.residual_before = evidence.deformation_um - whole.by_paths
        self.residual_after = evidence.deformation_um - (whole.predicted if self.effects else whole.by_paths)

    def predictions(self, views: Sequence[Evidence], executor_map: ExecutorMap) -> Iterable[Prediction]:
        """Repeat the fit in each part of the evidence."""
        for by_paths, predicted in executor_map(_predicted, views):
            yield by_paths, predicted if self.effects else by_paths

    def left(self, seen: Evidence, predicted: Vector) -> Sequence[Vector]:
        """Return the residual; the prediction includes the zero of each run."""
        return [self.evidence.deformation_um - predicted]

    def is_explained(self, before_um: float, after_um: float) -> bool:
        """Return whether channels were found that leave noise on held-out data."""
        return bool(self.effects) and self.evidence.noise.is_explained_held_out(after_um)

    def extended(
        self, model: ThermalModel, deployed: Sequence[FoundEffect], after_um: float
    ) -> tuple[ThermalModel, tuple[Remark, ...]]:
        """Return the model with refitted paths and the channels, and a warning that the paths are others."""
        dtf, tdtf = Path(sampled=self._whole.dtf, unit=model.dtf.unit), model.tdtf
        paths = [("DTF", model.dtf, dtf)]
        if model.tdtf and self._whole.tdtf:
            tdtf = Path(sampled=self._whole.tdtf, unit=model.tdtf.unit)
            paths.append(("TDTF", model.tdtf, tdtf))
        gains = ", ".join(
            f"{name} from {old.sampled.dc_gain:.3g} to {new.sampled.dc_gain:.3g} {old.unit.replace('um', 'µm')}"
            for name, old, new in paths
        )
        text = (
            "The first model was calibrated while this acted and misses much of its own data, so its paths were "
            f"refitted together with it; gains changed: {gains}."
        )
        error = self._whole.rms_um[-1]
        extended = dataclasses.replace(
            model,
            dtf=dtf,
            tdtf=tdtf,
            effects=(*model.effects, *(found.effect for found in deployed)),
            y_std_um=error,
            alternatives={},
            held_out_rms_um=error,
            sha256="",
        )
        return extended, (Remark(ModelWarning.FITTED_ANEW, text),)

    def _others(self, index: int) -> Iterator[tuple[Term, float]]:
        """Yield the other channels in the place of one, with its gains: how fast they act is not compared."""
        gains = self._whole.terms[index].amplitudes
        for other in self._whole.rivals[index]:
            yield Term(hypothesis=other.hypothesis, values=(), amplitudes=gains), other.rms_um


def _predicted(seen: Evidence) -> Prediction:
    """Refit to a part of the evidence; return what paths alone and paths with channels predict on every sample, µm."""
    fitted = refit(seen)
    return fitted.by_paths, fitted.predicted
