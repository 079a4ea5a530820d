"""Heat from surfaces to the air: forced and natural convection together, and radiation.

Sources: natural convection at upright faces in air, h = 1.42 (ΔT/L)^(1/4) W/m²K (W. H. McAdams, Heat
Transmission, 3rd ed., 1954); mixed convection h³ = h_forced³ + h_natural³ (S. W. Churchill, AIChE Journal 23,
1977); radiation to surroundings at air temperature, ε σ (T_s⁴ − T_a⁴).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEFAN_BOLTZMANN_W_PER_M2K4 = 5.670374e-8
KELVIN = 273.15


class Film:
    """Surfaces in moving air.

    Parameters
    ----------
    area_m2 : array, shape (n,)
        Surfaces, m².
    forced_w_per_m2k : float
        Coefficient due to the permanent air movement in a shop, W/m²K.
    height_m : float
        Height of the faces, m.
    emissivity : float
        Emissivity of painted or oily steel, 1.
    reference_degc : float
        Temperature of the linearisation, °C.
    """

    def __init__(
        self,
        area_m2: Array,
        forced_w_per_m2k: float,
        height_m: float,
        emissivity: float,
        reference_degc: float,
    ) -> None:
        self.area_m2 = area_m2
        self._forced = forced_w_per_m2k
        self._natural3 = (1.42 / height_m**0.25) ** 3
        self._radiant = emissivity * STEFAN_BOLTZMANN_W_PER_M2K4
        # The linear part is the film without any difference of temperature; the remainder is then small.
        linear = forced_w_per_m2k + 4.0 * self._radiant * (reference_degc + KELVIN) ** 3
        self.linear_w_per_k: Array = linear * area_m2
        self._linear = linear

    def coefficient(self, surface_degc: Array, air_degc: float, forced_factor: float = 1.0) -> Array:
        """Return the coefficient of each surface, W/m²K; `forced_factor` is that of a fan."""
        surface_k = surface_degc + KELVIN
        air_k = air_degc + KELVIN
        natural3 = self._natural3 * np.abs(surface_degc - air_degc) ** 0.75
        mixed = np.cbrt((self._forced * forced_factor) ** 3 + natural3)
        radiation = self._radiant * (surface_k * surface_k + air_k * air_k) * (surface_k + air_k)
        return np.asarray(mixed + radiation, dtype=np.float64)

    def excess_w(self, surface_degc: Array, air_degc: float, forced_factor: float = 1.0) -> Array:
        """Return the heat into each mass beyond the linear part, W."""
        extra = self.coefficient(surface_degc, air_degc, forced_factor) - self._linear
        return np.asarray(extra * self.area_m2 * (air_degc - surface_degc), dtype=np.float64)
