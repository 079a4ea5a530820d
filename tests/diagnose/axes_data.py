"""Data of a machine with three axes and an undeclared effect on some of them, from arithmetic that stands here."""

import dataclasses

import numpy as np
from scipy.signal import lfilter

from compensator.model.model_file import load_model
from compensator.model.thermal_model import Path
from compensator.model.transfer_function import TransferFunction
from sim_hardware.physics import Duty
from sim_hardware.physics.published import DEFORMATION_POLES, DTF, TDTF, TTF, TTF_POLES, tustin

#: How far each axis moves by heat and by the ambient, as shares of the published quill.
SCALES = {"x": (0.2, -0.5), "y": (1.0, 1.0), "z": (-1.4, 2.0)}


def models():
    """Models of the three axes without the effect: the published one, scaled."""
    quill = load_model("quill")

    def scaled(path, factor):
        function = path.continuous
        changed = TransferFunction(
            numerator=tuple(factor * c for c in function.numerator),
            denominator=function.denominator,
            unit=function.unit,
        )
        return Path.from_continuous(changed, quill.period_s)

    return {
        axis: dataclasses.replace(
            quill, axis=axis, dtf=scaled(quill.dtf, heat), tdtf=scaled(quill.tdtf, ambient), alternatives={}, sha256=""
        )
        for axis, (heat, ambient) in SCALES.items()
    }


def lag(u, tau_min):
    keep = np.exp(-1.0 / tau_min)
    return lfilter([0.0, 1.0 - keep], [1.0, -keep], u - u[0])


def machine(seed, sizes_um, *, channel="coolant_degc", tau_min=30.0, step_um=None, hours=30.0, noise_um=0.3):
    """A table; `sizes_um`: standard deviation of what the channel adds to each axis, `step_um`: a jump of an axis."""
    rng = np.random.default_rng([seed, 19])
    duty = Duty.working_day(seed, hours=hours)
    n = int(hours * 60)
    columns = {name: np.asarray(values)[: n * 6].reshape(n, 6).mean(axis=1) for name, values in duty.columns.items()}
    heat, ambient = columns["heat_w"], columns["ambient_degc"] - columns["ambient_degc"][0]
    y_dtf = lfilter(*tustin(DTF, DEFORMATION_POLES), heat)
    y_tdtf = lfilter(*tustin(TDTF, DEFORMATION_POLES), ambient)
    t_q = lfilter(*tustin(TTF, TTF_POLES), heat) + columns["ambient_degc"]
    table = {
        "t_s": np.arange(n) * 60.0,
        "t_q_degc": t_q + rng.normal(0.0, 0.01, n),
        "at_degc": columns["ambient_degc"] + rng.normal(0.0, 0.01, n),
    }
    table |= {name: values for name, values in columns.items() if name not in ("heat_w", "ambient_degc")}
    added = lag(columns[channel], tau_min)
    added /= np.std(added)
    for axis, (by_heat, by_ambient) in SCALES.items():
        y = by_heat * y_dtf + by_ambient * y_tdtf + sizes_um.get(axis, 0.0) * added + rng.normal(0.0, noise_um, n)
        y[n // 3 :] += (step_um or {}).get(axis, 0.0)
        table[f"{axis}_um"] = y
    return table
