"""The sized quill: dimensions, masses, films and lever arms of :class:`QuillMachine`.

The dimensions of the machine in the experiment were not published. These values are plausible for a hollow steel
quill of that size in a cast headstock on a column, and were sized by ``sizing.py`` so that the responses
approximate the functions published by M. Mareš and P. Bárta.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class QuillDesign:
    """Dimensions and properties; the name of every field contains its unit."""

    # The quill: a hollow steel body along Y, cut into nodes from its rear (0) to its nose (1).
    quill_nodes: int = 18
    quill_length_m: float = 1.85
    quill_section_m2: float = 0.00259
    quill_perimeter_m: float = 0.473
    steel_w_per_mk: float = 46.0
    steel_j_per_m3k: float = 3.67e6
    expansion_per_k: float = 11.7e-6
    growth_factor: float = 1.0

    # The heater plate on it, and the thermocouple T_Q next to the plate.
    plate_centre: float = 0.443
    plate_length_m: float = 0.255
    plate_j_per_k: float = 415.0
    plate_contact_w_per_k: float = 20.9
    plate_area_m2: float = 0.0124
    sensor_place: float = 0.417
    sensor_j_per_k: float = 2.62
    sensor_contact_w_per_k: float = 0.12
    sensor_area_m2: float = 1.0e-4

    # The nose with the front bearing.
    nose_j_per_k: float = 737.0
    nose_area_m2: float = 0.115
    nose_link_w_per_k: float = 0.614
    nose_length_m: float = 0.319

    # The headstock around the quill's rear, its coolant jacket, the column's front and rear wall, the base.
    guided_share: float = 0.45
    guide_w_per_mk: float = 6.95
    housing_j_per_k: float = 63900.0
    housing_area_m2: float = 0.175
    housing_lever_m: float = -0.693
    jacket_j_per_k: float = 3e3
    jacket_link_w_per_k: float = 40.0
    housing_column_w_per_k: float = 3.71
    front_j_per_k: float = 91500.0
    front_area_m2: float = 0.671
    front_lever_m: float = -1.56
    walls_w_per_k: float = 1.07
    rear_j_per_k: float = 137000.0
    rear_area_m2: float = 0.93
    rear_lever_m: float = 0.971
    column_base_w_per_k: float = 0.556
    base_j_per_k: float = 400e3
    base_area_m2: float = 1.5

    # A further mass on the housing, absent from the calibration; 0 J/K: none.
    second_j_per_k: float = 0.0
    second_link_w_per_k: float = 0.0
    second_lever_m: float = 0.0

    # The air: always moving a little; faces of this height; the thermocouple AT in it.
    forced_w_per_m2k: float = 5.0
    face_height_m: float = 0.3
    emissivity: float = 0.8
    at_lag_s: float = 45.0
