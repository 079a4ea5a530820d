"""A working machine and its sensors; time is passed in, and readers may be in other threads."""

from __future__ import annotations

import threading
import zlib
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from sim_hardware.physics.duty import Duty
from sim_hardware.physics.plant import Plant
from sim_hardware.physics.sensors import Sensor, SensorSpec, usual_sensors

Array = NDArray[np.float64]

LONGEST_STEP_S = 10.0
READING_S = 1.0


class World:
    """One machine, its duty cycle and its sensors.

    Parameters
    ----------
    plant : Plant
        :class:`QuillMachine` or :class:`PublishedQuill`, at rest.
    duty : Duty
        Its inputs over time.
    sensors : mapping of str to SensorSpec, optional
        Sensors by channel; by default :func:`usual_sensors`. Channels without one have no reading.
    seed : int
        Seed of all sensors.

    Examples
    --------
    >>> from sim_hardware.physics.published import PublishedQuill
    >>> world = World(PublishedQuill(), Duty.step(heat_w=90.0), seed=1)
    >>> read = world.source("t_q_degc")
    >>> world.advance_to(3600.0)
    >>> abs(read() - world.truth("t_q_degc")) < 0.2
    True
    """

    def __init__(
        self, plant: Plant, duty: Duty, sensors: Mapping[str, SensorSpec] | None = None, seed: int = 0
    ) -> None:
        self.duty = duty
        self._plant = plant
        self._specs = dict(usual_sensors(duty.extra_names) if sensors is None else sensors)
        self._seed = seed
        self._lock = threading.Lock()
        self._t_s = 0.0
        plant.advance(0.0, duty.at(0.0))
        self._truth = plant.signals()
        for name in self._specs:
            if name not in self._truth:
                raise ValueError(f"sensor on {name!r}: the machine has {', '.join(self._truth)}")
        self._sensors = {name: Sensor(spec, seed, name) for name, spec in self._specs.items()}
        self._times: list[float] = [0.0]
        self._rows: list[tuple[float, ...]] = [tuple(self._truth.values())]

    @property
    def t_s(self) -> float:
        """Time that has passed, s."""
        with self._lock:
            return self._t_s

    def advance_to(self, t_s: float) -> None:
        """Advance to `t_s`, in steps that end on the grid of 10 s.

        Raises
        ------
        ValueError
            If `t_s` lies in the past.
        """
        with self._lock:
            if t_s < self._t_s:
                raise ValueError(f"advance_to({t_s}): the world is already at {self._t_s} s")
            while self._t_s < t_s:
                grid = LONGEST_STEP_S * (int((self._t_s + 1e-6) / LONGEST_STEP_S) + 1)
                self._step(min(t_s, grid))

    def source(self, name: str) -> Callable[[], float]:
        """Return a function that reads a channel now; each call draws its own noise.

        Raises
        ------
        KeyError
            If the channel has no sensor.
        """
        sensor = self._sensors[name]

        def read() -> float:
            with self._lock:
                return sensor.read(self._truth[name], self._t_s)

        return read

    def truth(self, name: str) -> float:
        """Return the true value of a channel now."""
        with self._lock:
            return self._truth[name]

    def history(self) -> dict[str, Array]:
        """Return the truth after every step so far, by channel, with ``t_s``."""
        with self._lock:
            table = np.array(self._rows)
            columns = {name: table[:, i].copy() for i, name in enumerate(self._truth)}
            return {"t_s": np.array(self._times), **columns}

    def record(self, period_s: float = 60.0, until_s: float | None = None) -> dict[str, Array]:
        """Advance to the end of the duty cycle, or to `until_s`, and return the table of a logger.

        Each row is the mean of one reading a second over ``(t_s, t_s + period_s]``. The readings draw from
        separate random streams, so that a recording does not depend on earlier readings.

        Returns
        -------
        dict of str to array, each of shape (rows,)
            ``t_s`` from the start of the recording, then the channels that have a sensor. A row all of whose
            readings dropped out is NaN.
        """
        start_s = self.t_s
        self.advance_to(self.duty.duration_s if until_s is None else until_s)
        past = self.history()
        count = int((past["t_s"][-1] - start_s) / period_s + 1e-9)
        each = max(1, round(period_s / READING_S))
        when = start_s + (np.arange(count * each) + 1.0) * (period_s / each)
        # The true value at the end of a step applies to the whole step, because the inputs are constant.
        index = np.minimum(np.searchsorted(past["t_s"], when - 1e-6), len(past["t_s"]) - 1)
        table: dict[str, Array] = {"t_s": np.arange(count, dtype=np.float64) * period_s}
        for name, spec in self._specs.items():
            sensor = Sensor(spec, self._seed + zlib.crc32(b"record"), name)
            readings = sensor.read_many(past[name][index], period_s / each).reshape(count, each)
            there = ~np.isnan(readings)
            number = there.sum(axis=1)
            total = np.where(there, readings, 0.0).sum(axis=1)
            table[name] = np.asarray(np.where(number > 0, total / np.maximum(number, 1), np.nan))
        return table

    def _step(self, t_s: float) -> None:
        self._plant.advance(t_s - self._t_s, self.duty.at(self._t_s))
        self._t_s = t_s
        self._truth = self._plant.signals()
        self._times.append(t_s)
        self._rows.append(tuple(self._truth.values()))
