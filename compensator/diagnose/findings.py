"""What is found in some evidence: named effects as the engine runs them, and a remainder of all channels."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.background import Background, Regressed
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Term, as_deployed, late_term
from compensator.diagnose.likelihood import Likelihood
from compensator.diagnose.search import MARGIN, Search, Selection
from compensator.model.effects.blocks import Lag
from compensator.model.effects.regression import AMBIENT, DRIVE, Regression
from compensator.model.thermal_model import Path, ThermalModel
from compensator.model.transfer_function import SampledTransferFunction

#: The remainder is worth deploying where it adds this much to the logarithm of the evidence, and this share of noise
#: and own error.
WORTH, LEAST = 2.0 * MARGIN, 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Effects and remainder.

    Parameters
    ----------
    search : Search
        The search, with its data.
    selection : Selection
        What it found.
    terms : tuple of Term
        Effects as the engine runs them.
    responses : tuple of numpy.ndarray, shape (n,)
        What each adds to y on every sample, µm.
    remainder : Regressed or None
        What the channels explain beyond them, where that is worth deploying.
    ceiling : numpy.ndarray, shape (n,)
        What all channels together would explain without any named effect, µm.
    paths : numpy.ndarray, shape (n,)
        What the base's paths alone would explain, where nothing was known of them; 0 elsewhere, µm.
    own_paths : numpy.ndarray, shape (n,)
        What they explain together with effects and remainder; 0 where the base's paths are kept, µm.
    """

    search: Search
    selection: Selection
    terms: tuple[Term, ...]
    responses: tuple[Vector, ...]
    remainder: Regressed | None
    ceiling: Vector
    paths: Vector
    own_paths: Vector

    @property
    def named(self) -> Vector:
        """What the named effects add, µm; with the paths, where nothing was known of them."""
        return np.asarray(sum(self.responses, self.own_paths))

    @property
    def whole(self) -> Vector:
        """What effects and remainder add, µm."""
        return self.named if self.remainder is None else self.named + self.remainder.added - self.own_paths

    @property
    def rest_um(self) -> float:
        """Standard deviation of what they leave to an unknown slow cause and to the form of the effects, µm."""
        rest = self.selection.fit.rest
        if self.remainder is not None:
            return self.remainder.rest.slow_um
        return float(np.hypot(rest.slow_um, rest.own_um))


def findings_of(evidence: Evidence, *, unobserved: bool = True) -> Findings:
    """Search in some evidence.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals; nothing but the samples used takes part.
    unobserved : bool
        Whether an unobserved source is looked for.
    """
    search = Search(evidence)
    selection = search.run(unobserved=unobserved)
    fit, points = selection.fit, search.points
    terms, responses = as_deployed(fit)
    background = Background(evidence)
    nothing = np.zeros(points.used.size)
    ceiling = background.fitted(points, nothing, selection.before.rest)
    remainder: Regressed | None = None
    paths = own_paths = np.zeros(evidence.used.size)
    if late_term(fit) is None:
        found = background.fitted(points, fit.added, fit.rest)
        without = Likelihood(points, fit.rest)
        target = without.projected((points.residual - fit.added)[:, None])[:, 0]
        known = without.log_prior - 0.5 * (float(target @ target) + without.log_det)
        size = float(np.std(found.added[evidence.used]))
        least = LEAST * np.hypot(evidence.noise.noise_um, evidence.noise.own_error_um)
        if evidence.free_paths or (found.log_evidence > known + WORTH and size > least):
            remainder = found
    if evidence.free_paths and remainder is not None:
        own_paths = background.response_of_base(remainder.effect)
        paths = Background(evidence, channels=False).fitted(points, nothing, selection.before.rest).added
    return Findings(
        search=search,
        selection=selection,
        terms=terms,
        responses=tuple(responses),
        remainder=remainder,
        ceiling=ceiling.added,
        paths=paths,
        own_paths=own_paths,
    )


def with_paths(model: ThermalModel, found: Regression) -> tuple[ThermalModel, Regression | None]:
    """Return a model whose own paths are those of a regression, and what is left of the regression."""
    drive = found.channels.index(DRIVE[model.kind])
    dtf = Path(sampled=_function(found, drive, model.period_s), unit=model.dtf.unit)
    tdtf, gone = model.tdtf, {drive}
    if tdtf is not None and AMBIENT in found.channels:
        ambient = found.channels.index(AMBIENT)
        tdtf = Path(sampled=_function(found, ambient, model.period_s), unit=tdtf.unit)
        gone.add(ambient)
    kept = [i for i in range(len(found.channels)) if i not in gone]
    changed = dataclasses.replace(model, dtf=dtf, tdtf=tdtf, alternatives={}, sha256="")
    if not kept:
        return changed, None
    lags = len(found.taus_min)
    rest = dataclasses.replace(
        found,
        channels=tuple(found.channels[i] for i in kept),
        exponents=tuple(found.exponents[i] for i in kept),
        gains=tuple(found.gains[i] for i in kept),
        std_factor=tuple(tuple(v for i in kept for v in row[i * lags : (i + 1) * lags]) for row in found.std_factor),
    )
    return changed, rest


def _function(found: Regression, channel: int, period_s: float) -> SampledTransferFunction:
    """Return a channel's filter bank as one transfer function."""
    lagged = [tau for tau in found.taus_min if tau > 0.0]
    poles = np.array([Lag(tau, period_s / 60.0).pole for tau in lagged])
    denominator = np.poly(poles)
    numerator = np.zeros(poles.size + 1)
    rest = iter(range(poles.size))
    for tau, gain in zip(found.taus_min, found.gains[channel], strict=True):
        if tau == 0.0:
            numerator += gain * denominator
        else:
            i = next(rest)
            numerator += gain * (1.0 - poles[i]) / 2.0 * np.convolve([1.0, 1.0], np.poly(np.delete(poles, i)))
    return SampledTransferFunction(
        b=tuple(numerator.tolist()), a=tuple(np.asarray(denominator).tolist()), period_s=period_s
    )
