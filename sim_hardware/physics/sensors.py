"""Sensors between the true value and the wire: bias, noise, quantisation, lag, outliers, dropouts."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BLOCK = 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSpec:
    """Errors of a sensor, in the unit of its channel unless stated otherwise.

    Parameters
    ----------
    bias : float
        Added to every reading.
    noise_std : float
        Standard deviation of white noise.
    quantum : float
        Step of the converter; 0: none.
    lag_s : float
        Time constant, s.
    outlier_share, outlier_size : float
        Share of readings with an error of up to `outlier_size`, and that size.
    dropout_share : float
        Share of readings that are missing (NaN).
    """

    bias: float = 0.0
    noise_std: float = 0.0
    quantum: float = 0.0
    lag_s: float = 0.0
    outlier_share: float = 0.0
    outlier_size: float = 0.0
    dropout_share: float = 0.0


class Sensor:
    """One sensor with its own random number stream.

    Parameters
    ----------
    spec : SensorSpec
        Errors of the sensor.
    seed : int
        Seed; the same seed gives the same readings.
    name : str
        Channel; sensors of one seed and different names are independent.

    Examples
    --------
    >>> Sensor(SensorSpec(bias=0.3, quantum=0.1)).read(20.02)
    20.3
    """

    def __init__(self, spec: SensorSpec, seed: int = 0, name: str = "") -> None:
        self.spec = spec
        self._random = np.random.default_rng([seed, zlib.crc32(name.encode())])
        self._plain = spec.noise_std == spec.outlier_share == spec.dropout_share == 0.0
        self._drawn: list[tuple[float, float, float]] = []
        self._lagged = math.nan
        self._last_s = math.nan

    def read(self, true_value: float, t_s: float | None = None) -> float:
        """Return a reading; NaN for a dropout.

        Raises
        ------
        ValueError
            If the sensor has a lag and no time `t_s` is given.
        """
        spec = self.spec
        if spec.lag_s > 0.0:
            if t_s is None:
                raise ValueError(f"a sensor with a lag of {spec.lag_s} s needs the time of each reading")
            true_value = self._lag(true_value, t_s)
        value = true_value + spec.bias
        if not self._plain:
            if not self._drawn:
                noise, chance, size = self._draw(_BLOCK)
                self._drawn = list(zip(noise.tolist(), chance.tolist(), size.tolist(), strict=True))[::-1]
            noise_1, chance_1, size_1 = self._drawn.pop()
            if chance_1 < spec.dropout_share:
                return math.nan
            value += noise_1 + (size_1 if chance_1 > 1.0 - spec.outlier_share else 0.0)
        return round(value / spec.quantum) * spec.quantum if spec.quantum else value

    def read_many(self, true_values: Array, period_s: float) -> Array:
        """Return readings of values that follow each other at a period, shape (n,)."""
        spec = self.spec
        values = np.asarray(true_values, dtype=np.float64)
        if spec.lag_s > 0.0:
            values = np.array([self._lag(float(v), i * period_s) for i, v in enumerate(values)])
        values = values + spec.bias
        if not self._plain:
            noise, chance, size = self._draw(len(values))
            values = values + noise + np.where(chance > 1.0 - spec.outlier_share, size, 0.0)
            values[chance < spec.dropout_share] = np.nan
        return np.round(values / spec.quantum) * spec.quantum if spec.quantum else values

    def _draw(self, n: int) -> tuple[Array, Array, Array]:
        noise = self.spec.noise_std * self._random.standard_normal(n)
        chance = self._random.random(n)
        size = self.spec.outlier_size * self._random.uniform(-1.0, 1.0, n)
        return noise, chance, size

    def _lag(self, true_value: float, t_s: float) -> float:
        if math.isnan(self._lagged):
            self._lagged = true_value
        else:
            keep = math.exp(-max(0.0, t_s - self._last_s) / self.spec.lag_s)
            self._lagged = true_value + keep * (self._lagged - true_value)
        self._last_s = t_s
        return self._lagged


def usual_sensors(
    extras: Sequence[str] = (),
    temperature_noise_k: float = 0.02,
    y_noise_um: float = 0.3,
    heat_known: bool = False,
) -> dict[str, SensorSpec]:
    """Return the sensors of a usual set-up: thermocouples, a capacitive probe and the control's own values.

    `extras` are the channels of a duty cycle without an effect; with `heat_known`, a wattmeter measures the heater.
    """
    couple = SensorSpec(noise_std=temperature_noise_k, quantum=0.01)
    usual = {
        "t_q_degc": couple,
        "at_degc": couple,
        "y_um": SensorSpec(noise_std=y_noise_um),
        "coolant_degc": couple,
        "base_degc": couple,
        "spindle_rpm": SensorSpec(quantum=1.0),
        "fan_rpm": SensorSpec(quantum=1.0),
        "coolant_flow_lpm": SensorSpec(noise_std=0.02, quantum=0.01),
        **dict.fromkeys(extras, couple),
    }
    return {**usual, "heat_w": SensorSpec(quantum=0.1)} if heat_known else usual
