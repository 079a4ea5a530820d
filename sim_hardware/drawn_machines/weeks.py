"""Machine-weeks: a drawn machine over days, with effects that begin and end, troubles and pauses.

Two sets as in `cases`: one to develop on, one that judges. No single week of SEALED_WEEKS is examined before it is run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_hardware.drawn_machines.catalogue import CATALOGUE, EFFECTS, Place
from sim_hardware.drawn_machines.drawing import FAMILIES, RISE_K, Draw, UnfairError
from sim_hardware.drawn_machines.duty import PER_MIN, PROFILES, draw_duty
from sim_hardware.drawn_machines.fairness import error_um
from sim_hardware.drawn_machines.machine import Table
from sim_hardware.drawn_machines.measuring import CHANNELS
from sim_hardware.drawn_machines.plant import Response
from sim_hardware.drawn_machines.trouble import (
    DAY_MIN,
    Trouble,
    draw_pauses,
    draw_troubles,
    draw_visits,
    moved_um,
    spoiled,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Families whose weeks are drawn; the lumped machine is wrong in every linear model by more than most effects.
OF_WEEKS = ("transfer", "conduction")
ATTEMPTS = 60
#: An effect that begins has at least so much time before the end, min, and is at least so large while it acts, µm rms.
LEAST_MIN, LEAST_UM = 5 * DAY_MIN // 2, 1.5
#: Standard deviation of a touch probe, µm, and the time between two, min.
PROBE_STD_UM, PROBE_EVERY_MIN = (0.5, 1.5), (30, 60)
#: How often a chip lies on the feature, and how much that shifts a probe, µm.
CHIPS, CHIP_UM = 0.02, (12.0, 30.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spell:
    """An effect while it acts.

    Parameters
    ----------
    effect : str
        Name in the catalogue.
    from_min, to_min : int
        First minute, and the first one after it; the end of the week where the effect stays.
    places : tuple of (kind, path, channel)
        What it may be called.
    deployable : bool
        Whether a model can be given it.
    size_um : float
        Rms of the error that it makes meanwhile in a prediction from T_Q and AT, µm.
    """

    effect: str
    from_min: int
    to_min: int
    places: tuple[Place, ...]
    deployable: bool
    size_um: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchProbe:
    """A touch probe within a minute, and its error: noise, a chip, the feature's own movement, µm."""

    minute: int
    error_um: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineWeek:
    """A machine over some days, one row a minute.

    Parameters
    ----------
    family, seed, published, shop_floor
        As `Machine` has them.
    calibration : Table
        A run without any effect, to identify the model from.
    start_h : float
        Hour of the day at which the week starts.
    columns, healthy : dict of str to array, shape (n,)
        What is read: T_Q, AT, logged channels, `y_um` unless it is probed; NaN is missing. The same with the same noise
        and troubles, but without any effect.
    true_um, healthy_um : array, shape (n,)
        The machine's displacement, and without any effect.
    alone : tuple of (dict of str to array, array)
        For each spell what is read, and the displacement, if no other effect acts; with the same noise and troubles.
    running : array of bool, shape (n,)
        Whether the service runs.
    spells : tuple of Spell
        Undeclared effects.
    troubles : tuple of Trouble
        What must never become part of a model.
    visits : tuple of int
        When a person sees to a trouble and sets a new zero, min.
    probes : tuple of TouchProbe
        Empty with a displacement sensor.
    probe_std_um : float
        Standard deviation of a probe; NaN with a displacement sensor.
    """

    family: str
    seed: int
    published: bool
    shop_floor: bool
    calibration: Table
    start_h: float
    columns: dict[str, Array]
    healthy: dict[str, Array]
    true_um: Array
    healthy_um: Array
    alone: tuple[tuple[dict[str, Array], Array], ...]
    running: Mask
    spells: tuple[Spell, ...]
    troubles: tuple[Trouble, ...]
    visits: tuple[int, ...]
    probes: tuple[TouchProbe, ...]
    probe_std_um: float

    @property
    def minutes(self) -> int:
        """Length."""
        return self.true_um.size


@dataclass(frozen=True, slots=True, kw_only=True)
class Week:
    """A machine-week to be drawn.

    Parameters
    ----------
    family, seed, published, shop_floor
        As `Case` has them.
    effects : tuple of str
        One or two names of the catalogue, or `none`.
    probed : bool
        Whether the machine has touch probes instead of a displacement sensor.
    days : int
        Length.
    """

    family: str
    seed: int
    effects: tuple[str, ...]
    probed: bool
    shop_floor: bool
    published: bool
    days: int = 7

    def draw(self) -> MachineWeek:
        """Return the machine-week; the same to the last bit each time.

        Raises
        ------
        ValueError
            If no draw is fair.
        """
        why = ""
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng([FAMILIES.index(self.family), self.seed, attempt, self.days])
            try:
                return _Draw(self, rng).drawn()
            except UnfairError as error:
                why = str(error)
        raise ValueError(f"{self.family} {self.seed}: no fair week in {ATTEMPTS} draws; the last one: {why}")


class _Draw(Draw):
    """One attempt: a machine whose record is a week."""

    def __init__(self, week: Week, rng: np.random.Generator) -> None:
        super().__init__(rng, week.family, week.effects[0], shop_floor=week.shop_floor, published=week.published)
        self._week, self._rng, self._n = week, rng, week.days * DAY_MIN
        # Without the one-time heating, which leaves days at rest.
        kind = str(rng.choice([kind for kind in PROFILES if kind != "once"]))
        duty = draw_duty(rng, self.habits, week.days * 24.0, kind=kind)
        columns = {name: values[duty.before :] for name, values in duty.columns.items()}
        self.record_duty = dataclasses.replace(duty, columns=columns, before=0)

    def drawn(self) -> MachineWeek:
        """Return the week, or refuse."""
        week, rng, n = self._week, self._rng, self._n
        healthy = self._sized_heat()
        calibration = self._within(self._run(self.calibration_duty, 0.0), "calibration")
        if not RISE_K[0] <= float(np.ptp(calibration.t_q_degc - calibration.at_degc)) <= RISE_K[1]:
            raise UnfairError("T_Q rises too little or too much")
        spells, responses, response = [], [], healthy
        for effect, (begin, end) in zip(week.effects, self._times(), strict=False):
            spell, acted = self._acted(effect, healthy, begin, end)
            spells.append(spell)
            responses.append(acted)
            # Small effects add up; heat that two of them share is neglected.
            response = Response(
                **{
                    f.name: getattr(response, f.name) + getattr(acted, f.name) - getattr(healthy, f.name)
                    for f in dataclasses.fields(response)
                }
            )
        troubles = draw_troubles(rng, week.days, probed=week.probed)
        running = np.ones(n, dtype=bool)
        for begin, end in draw_pauses(rng, week.days):
            running[begin:end] = False
        std_um, probes = self._probes(moved_um(troubles, n)) if week.probed else (float("nan"), ())
        return MachineWeek(
            family=self.family,
            seed=week.seed,
            published=week.published,
            shop_floor=week.shop_floor,
            calibration=self._table(0, calibration, calibration, self.calibration_duty, heat=self.published),
            start_h=self.habits.start_h,
            columns=self._read(response, troubles),
            healthy=self._read(healthy, troubles),
            true_um=response.y_um,
            healthy_um=healthy.y_um,
            alone=tuple((self._read(acted, troubles), acted.y_um) for acted in responses),
            running=running,
            spells=tuple(spells),
            troubles=troubles,
            visits=tuple(minute for minute in draw_visits(rng, troubles) if minute < n),
            probes=probes,
            probe_std_um=std_um,
        )

    def _times(self) -> list[tuple[int, int]]:
        """Return when each effect acts: the first from the second day on, a second one two days or more later."""
        if self._week.effects[0] == "none":
            return []
        begin = int(self._rng.uniform(1.0, self._n / DAY_MIN - 3.5) * DAY_MIN)
        stays, ends = bool(self._rng.random() < 0.5), int(begin + self._rng.uniform(2.5, 4.5) * DAY_MIN)
        times = [(begin, self._n if stays or ends > self._n else ends)]
        if len(self._week.effects) > 1:
            latest = self._n - LEAST_MIN
            times.append((min(int(begin + self._rng.uniform(1.0, 2.5) * DAY_MIN), latest), self._n))
        return times

    def _acted(self, effect: str, healthy: Response, begin: int, end: int) -> tuple[Spell, Response]:
        """Return an effect of a fair size, and the response with it."""
        self.effect, self.entry = effect, CATALOGUE[effect]
        channel = self.entry.channel
        related = ("coolant_degc", "coolant_flow_lpm") if channel.startswith("coolant") else (channel,)
        logged = tuple(name for name in CHANNELS if name in self.sensors.logged or name in related)
        self.sensors = dataclasses.replace(self.sensors, logged=logged)
        strength, _, always = self._sized_effect(healthy)
        self._check_size(self._size_um(healthy, always))
        self._check_imitation(healthy, always)
        on = np.zeros(self._n * PER_MIN, dtype=bool)
        on[begin * PER_MIN : end * PER_MIN] = True
        acted = self._run(self.record_duty, strength, on)
        size_um = float(np.sqrt(np.mean(error_um(healthy, acted)[begin:end] ** 2)))
        if self.entry.deployable and size_um < LEAST_UM:
            raise UnfairError(f"{effect} makes an error of {size_um:.1f} um while it acts")
        spell = Spell(
            effect=effect,
            from_min=begin,
            to_min=end,
            places=self.entry.places,
            deployable=self.entry.deployable,
            size_um=size_um,
        )
        return spell, acted

    def _read(self, response: Response, troubles: Sequence[Trouble]) -> dict[str, Array]:
        """Return what the sensors read."""
        columns = self.sensors.table(np.random.default_rng(self.seeds[1]), response, self.record_duty)
        for name in ("t_s", "y_um") if self._week.probed else ("t_s",):
            del columns[name]
        return spoiled(columns, troubles)

    def _probes(self, moved: Array) -> tuple[float, tuple[TouchProbe, ...]]:
        """Return the standard deviation of a probe, and the probes."""
        rng, probes = self._rng, []
        std_um, every = float(rng.uniform(*PROBE_STD_UM)), int(rng.integers(*PROBE_EVERY_MIN, endpoint=True))
        for minute in range(every, self._n, every):
            error = float(rng.normal(0.0, std_um)) + float(moved[minute] - moved[0])
            if rng.random() < CHIPS:
                error += float(rng.choice([-1.0, 1.0]) * rng.uniform(*CHIP_UM))
            probes.append(TouchProbe(minute=minute, error_um=error))
        return std_um, tuple(probes)


#: Effects that a week may have; errors of Y's measurement are troubles there.
_OF_WEEK = {
    family: tuple(name for name in EFFECTS[family] if name != "none" and CATALOGUE[name].acts_on != "y")
    for family in OF_WEEKS
}


def _weeks(first_seed: int, count: int) -> tuple[Week, ...]:
    """Return the weeks of a set: families by turns, each effect equally often, one week in eight without any."""
    found = []
    for i in range(count):
        family = OF_WEEKS[i % len(OF_WEEKS)]
        turn, effects = i // len(OF_WEEKS), _OF_WEEK[family]
        chosen: tuple[str, ...] = (effects[turn % len(effects)],)
        if turn % 8 == 7:
            chosen = ("none",)
        elif turn % 3 == 2:
            chosen = (*chosen, effects[(turn + 4) % len(effects)])
        found.append(
            Week(
                family=family,
                seed=first_seed + i,
                effects=chosen,
                probed=turn % 3 == 1,
                shop_floor=turn % 2 == 1,
                published=family == "transfer" and turn % 4 < 2,
            )
        )
    return tuple(found)


#: To develop on, as often as is useful.
DEVELOPMENT_WEEKS = _weeks(3000, 100)
#: Each week is run at most once, and none is examined before.
SEALED_WEEKS = _weeks(880_000, 100)
#: Each run of some SEALED_WEEKS: their seeds, and date, version, where its figures are.
SEALED_WEEK_RUNS: tuple[tuple[tuple[int, ...], str], ...] = (
    ((880_000, 880_025, 880_050, 880_075), "2026-11-23, proposals stay; tests/bench/README.md, The loop"),
    ((880_001, 880_026, 880_051, 880_076), "2026-11-24, three candidates at once; tests/bench/README.md, The loop"),
    (
        (
            *(
                880_002,
                880_027,
                880_052,
                880_077,
                880_003,
                880_028,
                880_053,
                880_078,
                880_004,
                880_029,
                880_054,
                880_079,
            ),
            *(880_006, 880_031, 880_056, 880_081, 880_008, 880_033, 880_058),
        ),
        "2026-11-28, what has ended is left out; tests/bench/README.md, The loop",
    ),
    ((880_005, 880_030, 880_055, 880_080), "2026-11-29, levels at a warm zero; tests/bench/README.md, The loop"),
)
