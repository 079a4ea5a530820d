"""The machine as a shop runs it: no displacement sensor, and a touch probe each hour, one of them with a chip."""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from compensator.clock import NS
from compensator.config import Zenoh, load_config
from compensator.demo.calibration import PERIOD_S
from compensator.demo.day import START_NS, Day, Running, run_day
from compensator.demo.machine import TOUCH_STD_UM
from compensator.errors import ServiceError
from compensator.messages import SCHEMA, Offset, ProbeRequest, Status, number
from compensator.service.command_client import send_probe
from sim_hardware.physics import World
from sim_hardware.physics.effects.base import UndeclaredEffect

#: Time between two probes, and after a probe until the operator sees whether another one is wanted, s.
EVERY_S, LOOK_AFTER_S = 3600.0, 240.0
#: A probe is measured this long after the full hour, between two samples, s.
PAST_HOUR_S = 30.0
#: Error of the probe that finds a chip on the feature, µm, and the first probe that may.
CHIP_UM, FIRST_CHIP = 20.0, 3
#: How long simulated time pauses for messages that take real time, s.
PATIENCE_S, PAUSE_S = 2.0, 0.002
#: Seed of the probe, in addition to that of the day.
PROBE_SEED = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class SentProbe:
    """A probe of the shop.

    Parameters
    ----------
    time_utc_ns : int
        When it was measured, ns since 1970 UTC.
    chip_um : float
        Error by a chip on the feature, µm; 0 without one.
    asked_because : str
        Code of why the service wanted it; empty for those of each hour.
    """

    time_utc_ns: int
    chip_um: float
    asked_because: str


def run_shop_day(
    folder: Path, *, machine: str, hours: float, seed: int, model: str, effects: list[UndeclaredEffect]
) -> tuple[Day, list[SentProbe]]:
    """Run a day of a machine without displacement sensor, with a touch probe each hour.

    Parameters are those of `run_day`.

    Returns
    -------
    (Day, list of SentProbe)
        The day, and the probes in the order of their times.
    """
    shop = HourlyProbes(hours=hours, seed=seed)
    day = run_day(folder, machine=machine, hours=hours, seed=seed, model=model, effects=effects, probe=shop.visit)
    return day, shop.sent


class HourlyProbes:
    """Probes a feature each hour, and once more if the service then wants another probe.

    The probe measures the true deformation of the simulated machine with the offset acting that the control has
    received; it is sent as a command to the running service.

    Parameters
    ----------
    hours : float
        Length of the day, h; a chip lies on the feature in its middle.
    seed : int
        Seed of the noise.
    """

    def __init__(self, *, hours: float, seed: int) -> None:
        self.sent: list[SentProbe] = []
        self._rng = np.random.default_rng([PROBE_SEED, seed])
        self._chip_at = max(FIRST_CHIP, int(hours) // 2)
        self._each_hour = 0
        self._due_s, self._look_s = EVERY_S + PAST_HOUR_S, math.inf
        self._zenoh: Zenoh | None = None
        self._set_um: float | None = None

    async def visit(self, t_s: float, running: Running) -> None:
        """Probe if it is time to.

        Parameters
        ----------
        t_s : float
            Time since the start of the day, s.
        running : Running
            The running day.

        Raises
        ------
        ServiceError
            If the service does not accept the probe.
        """
        if t_s < min(self._due_s, self._look_s):
            return
        offset = await _received(running)
        if offset is None:  # Nobody probes without knowing which offset acts.
            return
        status = msgspec.json.decode(running.received.status, type=Status)
        if t_s >= self._due_s:
            self._due_s += EVERY_S
            self._each_hour += 1
            chip_um = CHIP_UM if self._each_hour == self._chip_at else 0.0
            await self._probe(t_s, running, offset, chip_um, "")
        elif status.probe_wanted is True:
            await self._probe(t_s, running, offset, 0.0, str(status.wanted_why))
        else:
            self._look_s = math.inf

    async def _probe(self, t_s: float, running: Running, offset: Offset, chip_um: float, why: str) -> None:
        time_ns = START_NS + round(t_s * NS)
        applied_um = _applied_um(offset, time_ns)
        found_um = self._deformation_um(running.world) + applied_um + TOUCH_STD_UM * self._rng.normal() + chip_um
        probe = ProbeRequest(
            schema=SCHEMA,
            time_utc_ns=time_ns,
            axis="y",
            measured_um=found_um,
            offset_applied_um=applied_um,
            feature="sphere-1",
            tool="touch-probe",
        )
        self._zenoh = self._zenoh or load_config(running.config).config.zenoh
        reply = await asyncio.to_thread(send_probe, self._zenoh, probe)
        if not reply["ok"]:
            raise ServiceError(f"the service did not accept a probe of the demo: {reply['text']}")
        self.sent.append(SentProbe(time_utc_ns=time_ns, chip_um=chip_um, asked_because=why))
        self._look_s = t_s + LOOK_AFTER_S

    def _deformation_um(self, world: World) -> float:
        """Return the true deformation now, from where the feature was set: at the first sample, µm."""
        if self._set_um is None:
            past = world.history()
            self._set_um = float(past["y_um"][np.searchsorted(past["t_s"], PERIOD_S)])
        return world.truth("y_um") - self._set_um


async def _received(running: Running) -> Offset | None:
    """Return the last published offset once the control has received it and the status; None if it does not."""
    received, until = running.received, time.monotonic() + PATIENCE_S
    while running.outcomes and time.monotonic() < until:
        last = running.outcomes[-1].offset
        if last.y_offset_um is None:
            return None
        has_status = received.status and msgspec.json.decode(received.status, type=Status).seq == last.seq
        if has_status and received.offsets and received.offsets[-1].seq == last.seq:
            return received.offsets[-1]
        await asyncio.sleep(PAUSE_S)
    return None


def _applied_um(offset: Offset, time_ns: int) -> float:
    """Return what a control applies that follows the rate of the offset, µm."""
    minutes = (time_ns - offset.time_utc_ns) / (60.0 * NS)
    return number(offset.y_offset_um) + number(offset.y_offset_rate_um_per_min) * minutes
