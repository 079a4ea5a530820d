r"""Heat conduction between lumped masses, stepped exactly.

.. math:: C \dot T = -K T + g T_{air} + q

with the capacities C (diagonal, J/K), the symmetric conductances K (W/K, links and films), the films g (W/K)
and further heat q (W). Since K is symmetric, :math:`C^{-1/2} K C^{-1/2} = V \Lambda V^T`, and a step of any
length with air and q held is exact and unconditionally stable.

Source: H. S. Carslaw, J. C. Jaeger, Conduction of Heat in Solids, 2nd ed., 1959 (the physics); the matrix
exponential of a symmetrisable system is textbook algebra.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_KEPT_STEPS = 256


class Network:
    """Collect masses and links, then :meth:`build` the equations.

    Examples
    --------
    >>> network = Network()
    >>> block = network.mass("block", 1000.0, air_w_per_k=2.0)
    >>> conduction = network.build()
    >>> phi, psi = conduction.step(500.0)
    >>> bool(abs(phi[block, block] - 2.718281828**-1) < 1e-9)
    True
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self._capacity: list[float] = []
        self._air: list[float] = []
        self._links: list[tuple[int, int, float]] = []

    def mass(self, name: str, capacity_j_per_k: float, air_w_per_k: float = 0.0) -> int:
        """Add a mass with its film to the air; return its index.

        Raises
        ------
        ValueError
            If the capacity is not positive or the film negative.
        """
        if not capacity_j_per_k > 0.0 or air_w_per_k < 0.0:
            raise ValueError(f"{name}: capacity {capacity_j_per_k} J/K, film {air_w_per_k} W/K")
        self.names.append(name)
        self._capacity.append(capacity_j_per_k)
        self._air.append(air_w_per_k)
        return len(self.names) - 1

    def link(self, a: int, b: int, w_per_k: float) -> None:
        """Add a conductance between two masses.

        Raises
        ------
        ValueError
            If the conductance is negative.
        """
        if w_per_k < 0.0:
            raise ValueError(f"{self.names[a]} to {self.names[b]}: {w_per_k} W/K")
        self._links.append((a, b, w_per_k))

    def build(self) -> Conduction:
        """Return the equations of all masses and links."""
        matrix = np.diag(np.array(self._air))
        for a, b, w_per_k in self._links:
            matrix[a, a] += w_per_k
            matrix[b, b] += w_per_k
            matrix[a, b] -= w_per_k
            matrix[b, a] -= w_per_k
        return Conduction(np.array(self._capacity), matrix, np.array(self._air))


class Conduction:
    """The equations of a network.

    Parameters
    ----------
    capacity_j_per_k : array, shape (n,)
        Heat capacities.
    conductance_w_per_k : array, shape (n, n)
        Symmetric; row sums are the films.
    air_w_per_k : array, shape (n,)
        Films to the air.
    """

    def __init__(self, capacity_j_per_k: Array, conductance_w_per_k: Array, air_w_per_k: Array) -> None:
        self.capacity_j_per_k = capacity_j_per_k
        self.conductance_w_per_k = conductance_w_per_k
        self.air_w_per_k = air_w_per_k
        root = np.sqrt(capacity_j_per_k)
        rates, vectors = np.linalg.eigh(conductance_w_per_k / np.outer(root, root))
        self.rates_per_s: Array = np.maximum(rates, 0.0)
        self._left = vectors / root[:, None]
        self._right = vectors * root[:, None]
        self._steps: dict[int, tuple[Array, Array]] = {}

    def step(self, dt_s: float) -> tuple[Array, Array]:
        """Return Φ and Ψ of :math:`T(t+dt) = Φ T(t) + Ψ (g T_{air} + q)`.

        The step length is rounded to whole microseconds; results for recent lengths are cached.
        """
        key = round(dt_s * 1e6)
        found = self._steps.get(key)
        if found is not None:
            return found
        decay = np.exp(-self.rates_per_s * dt_s)
        slow = self.rates_per_s * dt_s < 1e-12
        safe = np.where(slow, 1.0, self.rates_per_s)
        gain = np.where(slow, dt_s, -np.expm1(-safe * dt_s) / safe)
        phi = (self._left * decay) @ self._right.T
        psi = (self._left * gain) @ self._left.T
        if len(self._steps) >= _KEPT_STEPS:
            self._steps.clear()
        self._steps[key] = phi, psi
        return phi, psi

    def steady(self, heat_w: Array) -> Array:
        """Return the temperatures at which all flows balance, for heat (films included) of shape (n,)."""
        return np.asarray(np.linalg.solve(self.conductance_w_per_k, heat_w), dtype=np.float64)
