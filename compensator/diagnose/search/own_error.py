"""What the data say of the base's own error, beside named effects or alone: the part of the likelihood without a name.

The likelihood grants the base's paths an error of their own, and every effect one of its form. How large these were is
known once the data are seen. Effects that were fitted beside them are right only together with them: what both explain
is shared between them, and an effect alone would lack its share.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.linalg import block_diag

from compensator.diagnose.fitting.fit import Fit, fit_terms, settled
from compensator.diagnose.fitting.likelihood import Likelihood
from compensator.diagnose.fitting.points import lags_of_paths
from compensator.diagnose.search.background import Regressed, strongest
from compensator.model.effects.regression import AMBIENT, DRIVE, Regression


def foretelling(fit: Fit) -> Fit:
    """Return effects fitted anew, to foretell other days together with the own error.

    Parameters
    ----------
    fit : Fit
        Effects whose forms are approximate.
    """
    points = fit.likelihood.points
    return settled(fit_terms(Likelihood(points.of(points.evidence, foretells=True), fit.rest), fit.starts()))


def own_error_alone(nothing: Fit) -> Regressed:
    """Return the own error of the paths where no effect is deployed.

    Parameters
    ----------
    nothing : Fit
        The fit of nothing.
    """
    return own_error(foretelling(nothing))


def own_error(fit: Fit) -> Regressed:
    """Return the most probable own error of the paths and error of form of effects, beside these.

    Parameters
    ----------
    fit : Fit
        Effects as they are deployed, of points that foretell.
    """
    likelihood, rest = fit.likelihood, fit.rest
    points = likelihood.points
    context, records = points.evidence.context, points.evidence.signals
    names = {"DTF": DRIVE["heat" if context.has_ttf else "direct"], "TDTF": AMBIENT}
    parts = [(names.get(name, name), gains) for name, gains in points.made_of(rest)]
    channels, taus = tuple(dict.fromkeys(name for name, _ in parts)), lags_of_paths(context)
    # Gains of all channels, lag by lag, of each unknown weight.
    gains = block_diag(*(each for _, each in parts)).reshape(len(parts), len(taus), -1)
    made_of = np.concatenate([sum(gains[i] for i, (name, _) in enumerate(parts) if name == own) for own in channels])
    first = points.zeros.shape[1] + points.starts_of_modes.shape[1]
    shape = Regression(
        channels=channels,
        exponents=(1.0,) * len(channels),
        taus_min=taus,
        gains=((0.0,) * len(taus),) * len(channels),
        std_factor=(),
    )
    blocks = shape.blocks(context.period_min)
    columns = np.concatenate([shape.columns(record, blocks) for record in records])
    found = made_of @ likelihood.weights(fit.added)[first:]
    rows = strongest(made_of @ likelihood.weights_root()[first:], points.averaged(columns))
    effect = dataclasses.replace(
        shape, gains=tuple(map(tuple, found.reshape(len(channels), -1).tolist())), std_factor=rows
    )
    return Regressed(effect=effect, added=columns @ found, log_evidence=fit.log_evidence_as_it_is, rest=rest)
