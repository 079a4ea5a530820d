"""Further outputs of a machine beside the deformation of its first axis: other axes, tilts, slopes.

Heat and ambient are estimated once; each part of a model file is driven by them. An output is a weighted sum of parts:
that of an axis is its part, that of a tilt the difference of two parts by their distance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from compensator.axes import label_of
from compensator.errors import ModelError

if TYPE_CHECKING:
    from compensator.model.thermal_model import ThermalModel

#: What the parts of a model must have in common, because it is the machine's: attribute, and its name in a text.
_SHARED = (
    ("kind", "kind"),
    ("period_s", "sample period"),
    ("inputs", "inputs"),
    ("estimator", "estimator"),
    ("late_t_q", "lateness of T_Q"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """A further output of a machine.

    Parameters
    ----------
    name : str
        Such as `z`.
    weights : tuple of (str, float)
        Parts of the model by name, each with its factor in the sum.
    """

    name: str
    weights: tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class OutputEstimate:
    """A further output after a sample, in its own unit (µm, µrad, µm/m).

    Parameters
    ----------
    dtf, tdtf : float
        Shares of the two paths.
    effects : tuple of float
        Share of each effect, part by part, in the order of the model file.
    value : float
        Predicted value.
    std : float
        Its standard deviation, as `Estimate.y_std_um`.
    rate_per_min : float
        Growth over the next sample, per min.
    """

    dtf: float
    tdtf: float
    effects: tuple[float, ...]
    value: float
    std: float
    rate_per_min: float


def with_outputs(models: Mapping[str, ThermalModel], first: str, outputs: Sequence[Output]) -> ThermalModel:
    """Return the model of the first axis with the further parts that the outputs need.

    Parameters
    ----------
    models : mapping of str to ThermalModel
        All parts of a model file.
    first : str
        Name of the first axis' part.
    outputs : sequence of Output
        Further outputs; with none, the model of the first axis is returned as it is.

    Raises
    ------
    ModelError
        If a part is missing, or does not share the heat and the sample period with the first.
    """
    for output in outputs:
        for name, _ in output.weights:
            if name not in models:
                has = ", ".join(map(label_of, models))
                raise ModelError(f"axis {output.name}: no part axis.{name} in the model, it has: {has}")
    needed = dict.fromkeys(name for output in outputs for name, _ in output.weights if name != first)
    parts = tuple(models[name] for name in needed)
    base = models[first]
    for part in parts:
        _check_shared(base, part)
    return dataclasses.replace(base, parts=parts, outputs=tuple(outputs)) if outputs else base


def _check_shared(base: ThermalModel, part: ThermalModel) -> None:
    differing = [name for key, name in _SHARED if getattr(base, key) != getattr(part, key)]
    sampled = [None if path is None else path.sampled for path in (base.ttf, part.ttf)]
    if sampled[0] != sampled[1]:
        differing.append("TTF")
    if differing:
        raise ModelError(
            f"axis.{part.axis}: another {differing[0]} than axis.{base.axis}; expected that of the machine, for the "
            "heat is estimated once"
        )
