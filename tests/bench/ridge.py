"""A ridge regression over lags of every logged channel: what a good engineer would try first."""

import numpy as np

#: Time constants of the exponentially weighted means, min.
LAGS_MIN = (1.0, 5.0, 20.0, 60.0, 180.0, 600.0)
WEIGHTS = (1e-4, 1e-3, 1e-2, 1e-1)
FOLDS = 5


def lagged(u):
    """Return the exponentially weighted means of a signal, one column for each lag; one row is a minute."""
    found = []
    for tau in LAGS_MIN:
        out, p = np.zeros(u.size), np.exp(-1.0 / tau)
        for i in range(1, u.size):
            out[i] = p * out[i - 1] + (1.0 - p) * (u[i] - u[0])
        found.append(out)
    return np.stack(found, axis=1)


def complete(u):
    """Return a signal with what is missing interpolated."""
    known = np.isfinite(u)
    return np.interp(np.arange(u.size), np.flatnonzero(known), u[known])


def ridge(channels, y, used):
    """Predict Y by all channels, with an intercept.

    Parameters
    ----------
    channels : sequence of array, shape (n,)
        One row a minute.
    y : array, shape (n,)
        Measured Y, µm.
    used : array of bool, shape (n,)
        The minutes that it is fitted to; the weight is chosen on blocks of them.
    """
    used = used & np.isfinite(y)
    table = np.concatenate([lagged(complete(u)) for u in channels if np.isfinite(u).any()], axis=1)
    table = np.column_stack([table / (table[used].std(axis=0) + 1e-9), np.ones(y.size)])

    def fitted(mask, weight):
        x = table[mask]
        return np.linalg.solve(x.T @ x + weight * mask.sum() * np.eye(x.shape[1]), x.T @ y[mask])

    def left(weight):
        total = 0.0
        for block in np.array_split(np.flatnonzero(used), FOLDS):
            mask = used.copy()
            mask[block] = False
            total += float(np.sum((table[block] @ fitted(mask, weight) - y[block]) ** 2))
        return total

    return table @ fitted(used, min(WEIGHTS, key=left))
