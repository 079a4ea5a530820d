"""How large an effect is, and whether it can be told apart from what else is logged: by linear regression over lags."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sim_hardware.drawn_machines.duty import Duty, lag
from sim_hardware.drawn_machines.plant import Response, minutes

Array = NDArray[np.float64]

LAGS_MIN = (3.0, 12.0, 45.0, 180.0, 600.0)


def bank(signal: Array) -> Array:
    """Return a signal of one value a minute, and its lags, shape (n, 6)."""
    return np.column_stack((signal, *(lag(signal, tau, 1.0) for tau in LAGS_MIN)))


def left_um(part_um: Array, columns: Array) -> float:
    """Return the standard deviation of what columns cannot imitate of a part, a constant included."""
    design = np.column_stack((columns, np.ones(part_um.size)))
    design = design / np.maximum(np.linalg.norm(design, axis=0), 1e-12)
    weights = np.linalg.lstsq(design, part_um, rcond=1e-9)[0]
    return float(np.std(part_um - design @ weights))


def imitated_um(error_um: Array, healthy: Response, channels: Mapping[str, Array], duty: Duty) -> float:
    """Return what the best imitation of an effect's error leaves, µm standard deviation.

    Imitations: each other channel through lags; a ramp; heat and air together through lags, as if the model were wrong.
    """
    n = error_um.size
    rivals = [bank(minutes(values)[-n:]) for values in channels.values()]
    rivals.append(np.arange(n, dtype=np.float64)[:, None])
    rivals.append(np.column_stack((bank(healthy.heat_w), bank(healthy.at_degc))))
    return min(left_um(error_um, columns) for columns in rivals)


def error_um(healthy: Response, response: Response) -> Array:
    """Return the error that an effect makes in a prediction from T_Q and AT, µm, shape (n,).

    Y is regressed on lags of T_Q − AT and of AT where the effect is absent; the same weights are then given T_Q as the
    effect alters it. So heat that T_Q shows is no error, and a T_Q that is late or loose is one although Y is right.
    """
    air = bank(healthy.at_degc)
    difference, altered = (bank(r.t_q_degc - r.at_degc) for r in (healthy, response))
    design = np.column_stack((difference, air, np.ones(air.shape[0])))
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
    # Bounded weights: a direct part of noise-free signals would otherwise take any size.
    bounded = np.vstack((design / scale, 1e-4 * np.eye(scale.size)))
    weights = np.linalg.lstsq(bounded, np.concatenate((healthy.y_um, np.zeros(scale.size))), rcond=None)[0] / scale
    return np.asarray(response.y_um - healthy.y_um - (altered - difference) @ weights[: difference.shape[1]])
