"""The interface of every simulated machine: inputs in, true signals out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

REST_DEGC = 20.0
"""Temperature at which every machine starts and at which its displacement is zero, in °C (ISO 1)."""

MAX_SPINDLE_RPM = 8000.0
MAX_FAN_RPM = 3000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """Inputs of the machine during one step.

    Parameters
    ----------
    heat_w : float
        Electrical power of the heater plate, W.
    ambient_degc : float
        Air around the machine, °C.
    coolant_degc, coolant_flow_lpm : float
        Coolant at the inlet, °C, and its flow, litres a minute.
    spindle_rpm, fan_rpm : float
        Speeds, 1/min.
    extras : mapping of str to float
        Channels without an effect; they are passed to the signals under their own names.
    """

    heat_w: float = 0.0
    ambient_degc: float = REST_DEGC
    coolant_degc: float = REST_DEGC
    coolant_flow_lpm: float = 0.0
    spindle_rpm: float = 0.0
    fan_rpm: float = 0.0
    extras: Mapping[str, float] = field(default_factory=dict)

    def channels(self) -> dict[str, float]:
        """Return the inputs that are measured directly, by signal name."""
        return {
            "heat_w": self.heat_w,
            "coolant_degc": self.coolant_degc,
            "coolant_flow_lpm": self.coolant_flow_lpm,
            "spindle_rpm": self.spindle_rpm,
            "fan_rpm": self.fan_rpm,
            **self.extras,
        }


class Plant(Protocol):
    """A simulated machine."""

    def advance(self, dt_s: float, inputs: Inputs) -> None:
        """Advance by `dt_s` seconds with constant inputs."""

    def signals(self) -> dict[str, float]:
        """Return the true values now, by channel name (units in the names)."""
