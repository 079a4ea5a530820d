"""Machines whose structure itself is drawn, each with an undeclared effect: for developing and judging a diagnosis."""

from sim_hardware.drawn_machines.cases import DEVELOPMENT, SEALED, SEALED_RUNS, Case
from sim_hardware.drawn_machines.catalogue import CATALOGUE, EFFECTS, Entry
from sim_hardware.drawn_machines.drawing import FAMILIES, draw
from sim_hardware.drawn_machines.machine import Machine, Table, Truth

__all__ = [
    "CATALOGUE",
    "DEVELOPMENT",
    "EFFECTS",
    "FAMILIES",
    "SEALED",
    "SEALED_RUNS",
    "Case",
    "Entry",
    "Machine",
    "Table",
    "Truth",
    "draw",
]
