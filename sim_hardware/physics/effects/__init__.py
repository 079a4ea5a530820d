"""Undeclared effects: what a machine may have that its calibration never saw."""

from sim_hardware.physics.effects.base import Action, UndeclaredEffect
from sim_hardware.physics.effects.draw import SealedEffect, draw_effect
from sim_hardware.physics.effects.mechanical import (
    Cycle,
    LateSensor,
    MountSlip,
    ProbeDrift,
    SizeDependent,
    StickSlip,
    WrongStrength,
)
from sim_hardware.physics.effects.thermal import (
    BearingFriction,
    CoolantJacket,
    FanMotor,
    FanOnFilm,
    HiddenSource,
    SecondMass,
    WetGuide,
)

__all__ = [
    "Action",
    "BearingFriction",
    "CoolantJacket",
    "Cycle",
    "FanMotor",
    "FanOnFilm",
    "HiddenSource",
    "LateSensor",
    "MountSlip",
    "ProbeDrift",
    "SealedEffect",
    "SecondMass",
    "SizeDependent",
    "StickSlip",
    "UndeclaredEffect",
    "WetGuide",
    "WrongStrength",
    "draw_effect",
]
