"""A simulated machine: conduction, the published functions, duties, sensors and undeclared effects."""

from sim_hardware.physics.axes import Growth, MachineOfAxes
from sim_hardware.physics.conduction import QuillMachine
from sim_hardware.physics.design import QuillDesign
from sim_hardware.physics.duty import Duty
from sim_hardware.physics.effects import UndeclaredEffect, draw_effect
from sim_hardware.physics.plant import Inputs, Plant
from sim_hardware.physics.published import PublishedQuill
from sim_hardware.physics.sensors import Sensor, SensorSpec, usual_sensors
from sim_hardware.physics.world import World

__all__ = [
    "Duty",
    "Growth",
    "Inputs",
    "MachineOfAxes",
    "Plant",
    "PublishedQuill",
    "QuillDesign",
    "QuillMachine",
    "Sensor",
    "SensorSpec",
    "UndeclaredEffect",
    "World",
    "draw_effect",
    "usual_sensors",
]
