"""The masses of the machine, their contacts, and their levers on the tool centre point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_hardware.physics.design import QuillDesign
from sim_hardware.physics.network import Conduction, Network

Array = NDArray[np.float64]


class Layout:
    """Nodes of a design, by name and by position.

    Parameters
    ----------
    design : QuillDesign
        Dimensions.
    """

    def __init__(self, design: QuillDesign) -> None:
        d = design
        self._design = d
        self._dx_m = d.quill_length_m / d.quill_nodes
        # Capacity, surface and lever of each mass; the links follow when the equations are built.
        self._masses: list[tuple[str, float, float, float]] = []
        quill = d.quill_section_m2 * self._dx_m * d.steel_j_per_m3k
        self.quill = [
            self._add(f"quill {i}", quill, d.quill_perimeter_m * self._dx_m, self._dx_m) for i in range(d.quill_nodes)
        ]
        self.nose = self._add("nose", d.nose_j_per_k, d.nose_area_m2, d.nose_length_m)
        self.plate = self._add("plate", d.plate_j_per_k, d.plate_area_m2, 0.0)
        self.sensor = self._add("sensor", d.sensor_j_per_k, d.sensor_area_m2, 0.0)
        self.housing = self._add("housing", d.housing_j_per_k, d.housing_area_m2, d.housing_lever_m)
        self.jacket = self._add("jacket", d.jacket_j_per_k, 0.0, 0.0)
        self.front = self._add("column front", d.front_j_per_k, d.front_area_m2, d.front_lever_m)
        self.rear = self._add("column rear", d.rear_j_per_k, d.rear_area_m2, d.rear_lever_m)
        self.base = self._add("base", d.base_j_per_k, d.base_area_m2, 0.0)
        self.second = self._add("second mass", d.second_j_per_k, 0.0, d.second_lever_m) if d.second_j_per_k else None
        self.names = [name for name, *_ in self._masses]
        self.area_m2: Array = np.array([area for _, _, area, _ in self._masses])
        lever = 1e6 * d.expansion_per_k * np.array([lever for *_, lever in self._masses])
        grows = np.arange(len(lever)) <= self.nose
        self.growth_um_per_k: Array = np.where(grows, lever * d.growth_factor, 0.0)
        self.frame_um_per_k: Array = np.where(grows, 0.0, lever)
        self.guided = self.quill[: max(1, round(d.guided_share * d.quill_nodes))]
        self.places: dict[str, list[int]] = {
            "quill": self.quill,
            "guided": self.guided,
            "nose": [self.nose],
            "jacket": [self.jacket],
            "housing": [self.housing],
            "front": [self.front],
            "rear": [self.rear],
            "base": [self.base],
        }

    def conduction(self, air_w_per_k: Array) -> Conduction:
        """Return the equations, given the linear films in W/K."""
        d = self._design
        network = Network()
        for (name, capacity, _, _), film in zip(self._masses, air_w_per_k, strict=True):
            network.mass(name, capacity, float(film))
        axial = d.steel_w_per_mk * d.quill_section_m2 / self._dx_m
        for a, b in zip(self.quill, self.quill[1:], strict=False):
            network.link(a, b, axial)
        network.link(self.quill[-1], self.nose, d.nose_link_w_per_k)
        for node, share in self._under_plate():
            network.link(self.plate, node, d.plate_contact_w_per_k * share)
        for node, share in self._around_sensor():
            network.link(self.sensor, node, d.sensor_contact_w_per_k * share)
        for node in self.guided:
            network.link(node, self.housing, d.guide_w_per_mk * self._dx_m)
        network.link(self.housing, self.jacket, d.jacket_link_w_per_k)
        network.link(self.housing, self.front, d.housing_column_w_per_k)
        network.link(self.front, self.rear, d.walls_w_per_k)
        network.link(self.front, self.base, d.column_base_w_per_k)
        network.link(self.rear, self.base, d.column_base_w_per_k)
        if self.second is not None:
            network.link(self.housing, self.second, d.second_link_w_per_k)
        return network.build()

    def _add(self, name: str, capacity_j_per_k: float, area_m2: float, lever_m: float) -> int:
        self._masses.append((name, capacity_j_per_k, area_m2, lever_m))
        return len(self._masses) - 1

    def _under_plate(self) -> list[tuple[int, float]]:
        """Return the nodes below the plate and their shares of its length."""
        d = self._design
        left = d.plate_centre * d.quill_length_m - d.plate_length_m / 2
        right = left + d.plate_length_m
        covered = [(i, min(right, (i + 1) * self._dx_m) - max(left, i * self._dx_m)) for i in range(d.quill_nodes)]
        total = sum(length for _, length in covered if length > 0.0)
        return [(self.quill[i], length / total) for i, length in covered if length > 0.0]

    def _around_sensor(self) -> list[tuple[int, float]]:
        """Return the two nodes between whose centres the thermocouple sits."""
        d = self._design
        position = min(max(d.sensor_place * d.quill_nodes - 0.5, 0.0), d.quill_nodes - 1.001)
        first = int(position)
        return [(self.quill[first], 1.0 - (position - first)), (self.quill[first + 1], position - first)]
