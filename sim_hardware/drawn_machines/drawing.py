"""Draw a machine by a seed: physics, duties, sensors, an undeclared effect of a fair size, and its three runs."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sim_hardware.drawn_machines.catalogue import CATALOGUE, EFFECTS
from sim_hardware.drawn_machines.conduction import ConductionMachine
from sim_hardware.drawn_machines.duty import PROFILES, Duty, Habits, draw_duty
from sim_hardware.drawn_machines.fairness import error_um, imitated_um
from sim_hardware.drawn_machines.lumped import LumpedMachine
from sim_hardware.drawn_machines.machine import Machine, Table, Truth
from sim_hardware.drawn_machines.measuring import Sensors, mismeasured_t_q, mismeasured_y
from sim_hardware.drawn_machines.plant import Mask, Plant, Response, minutes
from sim_hardware.drawn_machines.transfer import TransferMachine

Array = NDArray[np.float64]

FAMILIES = ("transfer", "conduction", "lumped")
ATTEMPTS = 200
RECORD_H = (6.0, 10.0, 16.0, 24.0, 36.0, 48.0, 72.0, 120.0)
#: Peak to peak of Y on every run, µm.
GROWTH_UM = (20.0, 150.0)
#: Standard deviation of an effect on the record, µm; a late T_Q or a change of the TDTF does little by nature.
SIZE_UM, LEAST_SMALL_UM = (1.5, 30.0), 1.0
SMALL = ("lag_t_q", "delay_t_q", "gain_tdtf")
#: T_Q - AT, peak to peak on the calibration, K.
RISE_K = (2.0, 45.0)
#: Strongest effects of a machine with physics, in the units that the plants name.
STRONGEST = {
    "coolant": 60.0,
    "wet": 60.0,
    "bearing": 1000.0,
    "fan": 6.0,
    "floor": 1.0,
    "more_power": 0.5,
    "hidden": 600.0,
}
#: An effect is this many times larger than Y's noise, and so is what no other channel imitates of it.
OVER_NOISE, OVER_NOISE_SMALL, OVER_IMITATION = 4.0, 3.0, 2.0


class UnfairError(Exception):
    """A draw that nobody could be asked to diagnose, or that is no machine."""


def draw(
    family: str, seed: int, *, effect: str | None = None, shop_floor: bool | None = None, published: bool | None = None
) -> Machine:
    """Draw a machine with its runs.

    Parameters
    ----------
    family : {"transfer", "conduction", "lumped"}
        Physics.
    seed : int
        Same seed and options, same machine to the last bit.
    effect : str, optional
        Undeclared effect, a name of the catalogue; drawn where it is not given.
    shop_floor : bool, optional
        Data as from a shop floor, or clean; drawn where it is not given.
    published : bool, optional
        For `transfer`: exactly the published functions; drawn where it is not given.

    Raises
    ------
    ValueError
        For an unknown family or effect, or if no draw is fair.

    Examples
    --------
    >>> machine = draw("transfer", 1, effect="gain_dtf")
    >>> machine.truth.places
    (('gain', 'DTF', ''),)
    """
    if family not in FAMILIES:
        raise ValueError(f"family {family!r}, expected one of: {', '.join(FAMILIES)}")
    if effect is not None and effect not in EFFECTS[family]:
        raise ValueError(f"effect {effect!r}, expected one of: {', '.join(EFFECTS[family])}")
    random = np.random.default_rng([FAMILIES.index(family), seed])
    effect = effect or str(random.choice(EFFECTS[family]))
    shop_floor = bool(random.random() < 0.5) if shop_floor is None else shop_floor
    published = family == "transfer" and (bool(random.random() < 0.5) if published is None else published)
    why = ""
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([FAMILIES.index(family), seed, attempt])
        try:
            return Draw(rng, family, effect, shop_floor=shop_floor, published=published).machine(seed)
        except UnfairError as error:
            why = str(error)
    raise ValueError(f"{family} {seed}, {effect}: no fair machine in {ATTEMPTS} draws; the last one: {why}")


class Draw:
    """One attempt."""

    def __init__(
        self, rng: np.random.Generator, family: str, effect: str, *, shop_floor: bool, published: bool
    ) -> None:
        self.family, self.effect, self.published = family, effect, published
        self.entry = CATALOGUE[effect]
        self.habits = Habits.drawn(rng)
        if effect == "gain_tdtf":  # Seen only where the air moves.
            swing_k, power_w = float(rng.uniform(2.0, 4.5)), float(rng.uniform(25.0, 60.0))
            self.habits = dataclasses.replace(self.habits, swing_k=swing_k, power_w=power_w)
        self.plant: Plant
        if family == "transfer":
            self.plant = TransferMachine(rng, published=published)
        else:
            self.plant = ConductionMachine(rng) if family == "conduction" else LumpedMachine(rng)
        self.sensors = Sensors.drawn(rng, self.entry.channel, shop_floor=shop_floor)
        kinds = rng.choice(PROFILES, 3, p=(0.3, 0.35, 0.15, 0.2))
        hours = float(rng.choice(RECORD_H)), float(rng.uniform(12.0, 60.0)), float(rng.uniform(10.0, 48.0))
        self.record_duty, self.calibration_duty, self.fresh_duty = (
            draw_duty(rng, self.habits, h, kind=str(kind), use=use)
            for use, h, kind in zip(("record", "calibration", "fresh"), hours, kinds, strict=True)
        )
        self.heat_known = bool(rng.random() < 0.5)
        self.growth_um = float(rng.uniform(30.0, 120.0))
        self.size_um = float(np.exp(rng.uniform(np.log(1.8), np.log(20.0))))
        self.mistimed = {
            "lag_t_q": float(rng.uniform(1.0, 6.0)),
            "delay_t_q": float(rng.integers(1, 5)),
            "loose_couple": float(rng.uniform(0.08, 0.25)),
        }
        self.seeds = [int(s) for s in rng.integers(0, 2**32, 4)]

    def machine(self, seed: int) -> Machine:
        """Return the machine, or refuse."""
        healthy = self._sized_heat()
        strength, unit, response = self._sized_effect(healthy)
        size_um = self._size_um(healthy, response)
        self._check_size(size_um)
        self._check_imitation(healthy, response)
        calibration = self._within(self._run(self.calibration_duty, 0.0), "calibration")
        rise = float(np.ptp(calibration.t_q_degc - calibration.at_degc))
        if not RISE_K[0] <= rise <= RISE_K[1]:
            raise UnfairError(f"T_Q rises by {rise:.1f} K")
        fresh = self._run(self.fresh_duty, 0.0)
        fresh_acted = self._run(self.fresh_duty, strength)
        for each in (fresh, fresh_acted):
            self._within(each, "fresh")
        least = 0.5 * (LEAST_SMALL_UM if self.effect in SMALL else SIZE_UM[0])
        if self.entry.deployable and self._size_um(fresh, fresh_acted) < least:
            raise UnfairError("the effect does not act on the fresh run")
        if self.entry.acts_on == "y":
            fresh_acted = fresh
        truth = Truth(
            effect=self.effect,
            places=self.entry.places,
            inherent=self.plant.inherent,
            deployable=self.entry.deployable,
            strength=strength,
            unit=unit,
            size_um=size_um,
        )
        return Machine(
            family=self.family,
            seed=seed,
            published=self.published,
            shop_floor=self.sensors.shop_floor,
            calibration=self._table(
                0, calibration, calibration, self.calibration_duty, heat=self.heat_known or self.published
            ),
            record=self._table(1, healthy, response, self.record_duty),
            fresh=self._table(2, fresh, fresh_acted, self.fresh_duty, guarded=True),
            healthy=self._table(2, fresh, fresh, self.fresh_duty, guarded=True),
            truth=truth,
            noise_um=self.sensors.y_noise_um,
            noise_k=self.sensors.t_q_noise_k,
        )

    def _run(self, duty: Duty, strength: float, on: Mask | None = None) -> Response:
        """Return the machine's response with the effect, without the time before the recording.

        `on` says at which steps the effect acts; without it always.
        """
        on_machine = self.entry.acts_on == "machine" and self.effect != "none"
        try:
            response = self.plant.run(duty, self.habits, self.effect, strength if on_machine else 0.0, on)
        except ValueError as error:
            raise UnfairError(str(error)) from error
        if self.entry.acts_on == "t_q" and strength:
            t_q = mismeasured_t_q(response.t_q_degc, response.at_degc, self.effect, strength)
            if on is not None:
                t_q = np.where(minutes(on.astype(np.float64)) > 0.5, t_q, response.t_q_degc)
            response = dataclasses.replace(response, t_q_degc=t_q)
        before = duty.before * 15 // 60
        return Response(**{f.name: getattr(response, f.name)[before:] for f in dataclasses.fields(response)})

    def _within(self, response: Response, name: str) -> Response:
        growth = float(np.ptp(response.y_um))
        if not GROWTH_UM[0] <= growth <= GROWTH_UM[1]:
            raise UnfairError(f"{name}: Y moves by {growth:.0f} um")
        return response

    def _sized_heat(self) -> Response:
        """Scale the heat of every run so that Y moves as wanted on the record; return that response."""
        response = self._run(self.record_duty, 0.0)
        for _ in range(0 if self.published else 2):
            factor = float(np.clip(self.growth_um / np.ptp(response.y_um), 0.1, 10.0))
            for duty in (self.record_duty, self.calibration_duty, self.fresh_duty):
                duty.columns["power_w"] *= factor
            response = self._run(self.record_duty, 0.0)
        return self._within(response, "record")

    def _sized_effect(self, healthy: Response) -> tuple[float, str, Response]:
        """Return the effect's strength, its unit, and the response of the record with it."""
        if self.effect == "none":
            return 0.0, "", healthy
        if self.entry.acts_on == "y":
            error = self.size_um * mismeasured_y(np.random.default_rng(self.seeds[3]), healthy.y_um.size, self.effect)
            return self.size_um, "um", dataclasses.replace(healthy, y_um=healthy.y_um + error)
        if self.entry.acts_on == "t_q":
            strength = self.mistimed[self.effect]
            unit = {"lag_t_q": "min", "delay_t_q": "samples"}.get(self.effect, "of T_Q - AT")
            return strength, unit, self._run(self.record_duty, strength)
        strength, unit, scaled = self.plant.first_strength(self.effect)
        response = self._run(self.record_duty, strength)
        for _ in range(3 if scaled else 0):
            found = self._size_um(healthy, response)
            if found < 1e-6:
                raise UnfairError("the effect does not act on the record")
            if abs(found / self.size_um - 1.0) < 0.15:
                break
            limit = STRONGEST.get(self.effect, np.inf) if self.family != "transfer" else np.inf
            wanted = strength * self.size_um / found
            if strength == limit and wanted > limit:
                break
            strength = float(np.clip(wanted, -limit, limit))
            response = self._run(self.record_duty, strength)
        return strength, unit, self._within(response, "record")

    def _size_um(self, healthy: Response, response: Response) -> float:
        return float(np.std(error_um(healthy, response)))

    def _check_size(self, size_um: float) -> None:
        if self.effect == "none":
            return
        small = self.effect in SMALL
        over_noise = (OVER_NOISE_SMALL if small else OVER_NOISE) * self.sensors.y_noise_um
        least = max(LEAST_SMALL_UM if small else SIZE_UM[0], over_noise)
        if not least <= size_um <= SIZE_UM[1]:
            raise UnfairError(f"an effect of {size_um:.2g} um, expected {least:.2g} to {SIZE_UM[1]:g}")

    def _check_imitation(self, healthy: Response, response: Response) -> None:
        """Refuse an effect that another logged channel, or the model's own inputs, could cause just as well."""
        own = {place[2] for place in self.entry.places}
        if own <= {""}:
            return
        channels = {name: self.record_duty.columns[name] for name in self.sensors.logged if name not in own}
        left = imitated_um(error_um(healthy, response), healthy, channels, self.record_duty)
        if left < OVER_IMITATION * float(np.hypot(self.sensors.y_noise_um, 0.3 * self.sensors.shop_floor)):
            raise UnfairError("another channel does the same")

    def _table(
        self,
        number: int,
        healthy: Response,
        response: Response,
        duty: Duty,
        *,
        heat: bool = False,
        guarded: bool = False,
    ) -> Table:
        rng = np.random.default_rng(self.seeds[number])
        return Table(
            columns=self.sensors.table(rng, response, duty, heat=heat, guarded=guarded),
            true_um=healthy.y_um if self.entry.acts_on == "y" else response.y_um,
            part_um=response.y_um - healthy.y_um,
        )
