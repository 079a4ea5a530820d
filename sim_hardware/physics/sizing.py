"""Size the quill: fit the dimensions of :class:`QuillDesign` to the published responses.

Run ``python -m sim_hardware.physics.sizing`` to show the fit of the stored dimensions, with ``--fit`` to
search again (some minutes) and print the new ones, rounded. Least squares over three responses: displacement
and T_Q − AT after 90 W from rest, and the displacement after the air has become 1 K warmer; dimensions are
searched in their logarithms (masses, films and contacts are positive) within plausible
bounds.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sim_hardware.physics.conduction import QuillMachine
from sim_hardware.physics.design import QuillDesign
from sim_hardware.physics.plant import REST_DEGC, Inputs
from sim_hardware.physics.published import step_responses

Array = NDArray[np.float64]

STEP_W = 90.0
HORIZON_MIN = 1440
STEADY_Y_UM, STEADY_T_K = 91.7, 22.6

# Lower and upper bound of every dimension that is searched; the sign is the stored value's.
BOUNDS: dict[str, tuple[float, float]] = {
    "quill_length_m": (0.7, 2.2),
    "quill_section_m2": (1e-3, 2e-2),
    "quill_perimeter_m": (0.2, 1.8),
    "plate_centre": (0.3, 0.8),
    "plate_length_m": (0.08, 0.6),
    "plate_j_per_k": (150.0, 2500.0),
    "plate_contact_w_per_k": (2.0, 60.0),
    "plate_area_m2": (0.003, 0.08),
    "sensor_place": (0.3, 0.95),
    "sensor_j_per_k": (2.0, 20.0),
    "nose_j_per_k": (300.0, 12e3),
    "nose_area_m2": (0.01, 0.2),
    "nose_link_w_per_k": (0.3, 10.0),
    "nose_length_m": (0.03, 0.4),
    "guide_w_per_mk": (0.3, 60.0),
    "housing_j_per_k": (8e3, 300e3),
    "housing_area_m2": (0.05, 2.0),
    "housing_lever_m": (0.05, 5.0),
    "housing_column_w_per_k": (1.0, 200.0),
    "front_j_per_k": (20e3, 900e3),
    "front_area_m2": (0.1, 4.0),
    "front_lever_m": (0.05, 10.0),
    "walls_w_per_k": (1.0, 100.0),
    "rear_j_per_k": (20e3, 900e3),
    "rear_area_m2": (0.1, 4.0),
    "rear_lever_m": (0.05, 10.0),
    "column_base_w_per_k": (0.5, 60.0),
}


def fit_pct(measured: Array, simulated: Array) -> float:
    """Return 100·(1 − ‖y − ŷ‖ / ‖y − mean(y)‖), as the paper's tool does."""
    return float(100.0 * (1.0 - np.linalg.norm(measured - simulated) / np.linalg.norm(measured - measured.mean())))


def responses(design: QuillDesign, longest_substep_s: float = 60.0) -> tuple[Array, Array, Array]:
    """Return y in µm and T_Q − AT in K after 90 W, and y after +1 K of air, by minute."""
    heated = QuillMachine(design, longest_substep_s=longest_substep_s)
    aired = QuillMachine(design, longest_substep_s=longest_substep_s)
    heat, air = Inputs(heat_w=STEP_W), Inputs(ambient_degc=REST_DEGC + 1.0)
    rows = np.zeros((HORIZON_MIN + 1, 3))
    for k in range(1, HORIZON_MIN + 1):
        heated.advance(60.0, heat)
        aired.advance(60.0, air)
        hot = heated.signals()
        rows[k] = hot["y_um"], hot["t_q_degc"] - hot["at_degc"], aired.signals()["y_um"]
    return rows[:, 0], rows[:, 1], rows[:, 2]


def fit(start: QuillDesign, evaluations: int = 40) -> QuillDesign:
    """Return the design with the best fit to the published responses."""
    names = list(BOUNDS)
    signs = np.array([np.sign(getattr(start, n)) for n in names])
    lower, upper = (np.log([BOUNDS[n][i] for n in names]) for i in (0, 1))
    x0 = np.clip(np.log([abs(getattr(start, n)) for n in names]), lower + 1e-3, upper - 1e-3)
    y, t, a = step_responses(HORIZON_MIN, STEP_W)
    # Dense during fast changes, later uniform in the logarithm of time.
    at = np.unique(np.concatenate([np.arange(1, 60, 3), np.geomspace(60, HORIZON_MIN, 50).astype(int)]))

    def design(x: Array) -> QuillDesign:
        return replace(start, **dict(zip(names, (signs * np.exp(x)).tolist(), strict=True)))

    def errors(x: Array) -> Array:
        y_m, t_m, a_m = responses(design(x))
        # 1 µm, 0.2 K and 0.3 µm weigh the same; a weak prior holds what the responses do not determine.
        return np.concatenate([(y_m - y)[at], (t_m - t)[at] / 0.2, (a_m - a)[at] / 0.3, 0.15 * (x - x0)])

    found = least_squares(
        errors, x0, bounds=(lower, upper), x_scale=0.3, diff_step=1e-3, max_nfev=evaluations, verbose=2
    )
    return design(found.x)


def main() -> None:
    """Print the fit of the responses; with an option, search first."""
    parser = argparse.ArgumentParser(description="fit the simulated quill to the published responses")
    parser.add_argument("--fit", action="store_true", help="search for new dimensions first")
    parser.add_argument("--evaluations", type=int, default=40, help="bound for the search")
    options = parser.parse_args()
    design = QuillDesign()
    if options.fit:
        design = fit(design, options.evaluations)
        for name in BOUNDS:
            sys.stdout.write(f"    {name}: float = {float(f'{getattr(design, name):.3g}')!r}\n")
    published = step_responses(HORIZON_MIN, STEP_W)
    simulated = responses(design, 10.0)
    for name, p, s in zip(("y, 90 W", "T_Q - AT, 90 W", "y, +1 K"), published, simulated, strict=True):
        sys.stdout.write(
            f"{name}: fit {fit_pct(p, s):.1f} %, at 60 min {s[60]:.2f} ({p[60]:.2f}), largest {s.max():.2f} "
            f"({p.max():.2f}), at the end {s[-1]:.2f} ({p[-1]:.2f})\n"
        )


if __name__ == "__main__":
    main()
