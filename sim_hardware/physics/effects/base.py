"""Hooks of an undeclared effect in a machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sim_hardware.physics.design import QuillDesign
from sim_hardware.physics.plant import Inputs

Array = NDArray[np.float64]
Places = Mapping[str, Sequence[int]]


class Action:
    """An effect acting in one machine; the hooks of this base do nothing."""

    def forced_factor(self, inputs: Inputs) -> float:
        """Return the factor on the forced film coefficient."""
        return 1.0

    def add_heat(self, heat_w: Array, t_s: float, inputs: Inputs, degc: Array, places: Places) -> None:
        """Add heat in W to the nodes, given their temperatures and where they are."""

    def growth_um(self, growth_um: float) -> float:
        """Return the part of the quill's growth that arrives at its nose, µm; called once a step, in order."""
        return growth_um

    def probe_um(self, t_s: float, y_um: float) -> float:
        """Return the displacement added at the probe, µm."""
        return y_um

    def t_q_degc(self, t_s: float, t_q_degc: float) -> float:
        """Return the temperature that has reached the thermocouple, °C; called once a step, in order."""
        return t_q_degc


class UndeclaredEffect(Action):
    """An undeclared effect: a frozen dataclass of its parameters, units in their names.

    ``kind``, ``path`` and ``channel`` say in the words of the project's diagnosis what a model calibrated
    without the effect lacks. ``thermal`` effects need a machine of masses (:class:`QuillMachine`).
    """

    kind: ClassVar[str] = ""
    path: ClassVar[str | None] = None
    channel: ClassVar[str | None] = None
    thermal: ClassVar[bool] = False

    def alter(self, design: QuillDesign) -> QuillDesign:
        """Return the design with the permanent changes of the effect."""
        return design

    def begin(self) -> Action:
        """Return the acting effect in its initial state; itself where it has no state."""
        return self

    def reveal(self) -> UndeclaredEffect:
        """Return the effect itself."""
        return self

    def describe(self) -> dict[str, object]:
        """Return kind, path, channel and parameters."""
        if not is_dataclass(self):
            raise TypeError(f"{type(self).__name__} is no dataclass")
        parameters = {f.name: getattr(self, f.name) for f in fields(self)}
        return {"kind": self.kind, "path": self.path, "channel": self.channel, "parameters": parameters}


def overriding(actions: Sequence[Action], name: str) -> list[Action]:
    """Return the actions that override the hook of that name."""
    return [a for a in actions if getattr(type(a), name) is not getattr(Action, name)]
