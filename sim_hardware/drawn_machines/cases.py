"""The two fixed sets of cases: one to develop on, one that judges.

SEALED is run at most three times in all, each time whole, and its figures are reported as they fall. No single case of
it is examined before the last run. Every run is entered in SEALED_RUNS, in the same change as its figures.
"""

from __future__ import annotations

from dataclasses import dataclass

from sim_hardware.drawn_machines.catalogue import EFFECTS
from sim_hardware.drawn_machines.drawing import FAMILIES, draw
from sim_hardware.drawn_machines.machine import Machine

COUNTS = {"transfer": 42, "conduction": 30, "lumped": 30}
#: Rounds through the effects in which a `transfer` machine has exactly the published functions.
PUBLISHED_ROUNDS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A machine to be drawn.

    Parameters
    ----------
    family, seed, effect, shop_floor, published
        As `draw` has them.
    """

    family: str
    seed: int
    effect: str
    shop_floor: bool
    published: bool

    def draw(self) -> Machine:
        """Return the machine."""
        return draw(self.family, self.seed, effect=self.effect, shop_floor=self.shop_floor, published=self.published)


def _cases(first_seed: int) -> tuple[Case, ...]:
    """Return the cases of a set: each effect equally often, on clean and on shop-floor data by turns."""
    found = []
    for family in FAMILIES:
        effects = EFFECTS[family]
        for i in range(COUNTS[family]):
            turn, place = divmod(i, len(effects))
            published = family == "transfer" and turn < PUBLISHED_ROUNDS
            shop_floor = (place + turn) % 2 == 1
            case = Case(
                family=family, seed=first_seed + i, effect=effects[place], shop_floor=shop_floor, published=published
            )
            found.append(case)
    return tuple(found)


#: To develop on, as often as is useful.
DEVELOPMENT = _cases(1000)
#: Run at most three times in all.
SEALED = _cases(770_000)
#: Each run of SEALED: date, version, where its figures are.
SEALED_RUNS: tuple[str, ...] = (
    "2026-11-22, after 0.1.0, tests/bench/README.md",
    "2026-11-22, a third of the time and effects known apart, tests/bench/README.md",
    "2026-11-23, effects deployed with the own error beside them, tests/bench/README.md",
)
