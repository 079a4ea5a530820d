"""Linear maps of a bank's states where its reference changes: at a zero, and when another model takes over."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compensator.arrays import Matrix
from compensator.model.correction.kalman_bank import SIZE, KalmanBank


def map_to_zero(before: KalmanBank, fresh: KalmanBank, contributions_um: Sequence[float], *, active: bool) -> None:
    """Give a fresh bank the gains and walks of one before a zero, so that the correction is 0 now.

    Parameters
    ----------
    before, fresh : KalmanBank
        The bank before the zero, and one of the same model without values.
    contributions_um : sequence of float, length k
        Shares of the paths and effects at the zero, as they are counted after it, µm.
    active : bool
        Whether a value has corrected anything: else there is nothing that the gains have added.
    """
    n = 1 + len(contributions_um)
    gains = slice(1, n)
    fresh.x[:, gains], fresh.P[:, gains, gains] = before.x[:, gains], before.P[:, gains, gains]
    if active:
        fresh.x, fresh.P = _mapped(_less(contributions_um, n), fresh.x, fresh.P)
    fresh.weights = before.weights_of_walks()
    fresh.mean_weights = list(fresh.weights)


def moved_zero(bank: KalmanBank, by_um: Sequence[float]) -> KalmanBank:
    """Return a bank, changed, whose shares at the zero are larger by so much, µm, and its correction there the same."""
    bank.x, bank.P = _mapped(_less(by_um, bank.x.shape[1]), bank.x, bank.P)
    return bank


def map_to_model(
    before: KalmanBank,
    fresh: KalmanBank,
    contributions_um: Sequence[float],
    new_contributions_um: Sequence[float],
    change_um: float,
) -> None:
    """Give a fresh bank of another model the correction as it is now, and the zeros and walks.

    Parameters
    ----------
    before, fresh : KalmanBank
        The bank of the old model, and one of the new model without values.
    contributions_um, new_contributions_um : sequence of float
        Shares of the paths and effects now: of the old model, of the new one, µm.
    change_um : float
        Deformation now of the new model's free run, less that of the old one, µm.
    """
    old, new = 1 + len(contributions_um), 1 + len(new_contributions_um)
    zeros = before.x.shape[1] - old
    # The old model's states, reduced to the correction as it is now and the zeros.
    reduced = np.zeros((1 + zeros, old + zeros))
    reduced[0, :old] = [1.0, *contributions_um]
    reduced[np.arange(1, 1 + zeros), np.arange(old, old + zeros)] = 1.0
    x, p = _mapped(reduced, before.x, before.P)
    # The new offset is that correction, less the change of the free run, less what the new gains add now.
    for _ in range(zeros):
        fresh.add_zero()
    kept = [0, *range(new, new + zeros)]
    fresh.x[:, kept] = x
    fresh.x[:, 0] -= change_um
    fresh.P[np.ix_(range(SIZE), kept, kept)] = p
    fresh.x, fresh.P = _mapped(_less(new_contributions_um, new + zeros), fresh.x, fresh.P)
    fresh.weights, fresh.mean_weights = list(before.weights), list(before.mean_weights)


def _less(contributions_um: Sequence[float], n: int) -> Matrix:
    """Return the map of `n` states that takes from the offset what the gains add now."""
    found = np.eye(n)
    found[0, 1 : 1 + len(contributions_um)] = [-share for share in contributions_um]
    return found


def _mapped(matrix: Matrix, x: Matrix, p: Matrix) -> tuple[Matrix, Matrix]:
    """Return T x and T P T' for each filter, summed in a fixed order."""

    def times(right: Matrix) -> Matrix:
        total = np.zeros((right.shape[0], matrix.shape[0], *right.shape[2:]))
        for j in range(matrix.shape[1]):
            total = total + np.multiply.outer(matrix[:, j], right[:, j]).swapaxes(0, 1)
        return total

    return times(x), times(times(p).transpose(0, 2, 1))
