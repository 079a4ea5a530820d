"""Undeclared effects: what each is called in a diagnosis, and whether a model can be given it.

Kinds and paths are those of the contract. An effect of physics may have more than one right name: coolant that flows
now and then acts by its temperature and by its flow; a fan alters every surface, so it changes both paths.
"""

from __future__ import annotations

from dataclasses import dataclass

Place = tuple[str, str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """An effect of the catalogue.

    Parameters
    ----------
    places : tuple of (kind, path, channel)
        What it may be called; the first is the usual one. TTF stands for the path of T_Q: in a model without known heat
        that is the DTF.
    deployable : bool
        Whether a model can be given it: its channel is logged, it is no error of Y's measurement.
    acts_on : {"machine", "t_q", "y"}
        The machine itself, the measurement of T_Q, or that of Y.
    """

    places: tuple[Place, ...]
    deployable: bool = True
    acts_on: str = "machine"

    @property
    def channel(self) -> str:
        """Channel that the usual name has, or none."""
        return self.places[0][2] if self.places else ""


def _input(channel: str) -> tuple[Place, ...]:
    return (("input", "", channel),)


_PATHS = ("DTF", "TDTF")

#: Every effect by name.
CATALOGUE: dict[str, Entry] = {
    "none": Entry(places=(), deployable=False),
    "coolant": Entry(places=_input("coolant_degc")),
    "wet": Entry(
        places=(
            ("scheduled", "DTF", "coolant_flow_lpm"),
            ("scheduled", "TDTF", "coolant_flow_lpm"),
            *_input("coolant_flow_lpm"),
            *_input("coolant_degc"),
        )
    ),
    "speed": Entry(places=_input("spindle_rpm")),
    "bearing": Entry(places=_input("spindle_rpm")),
    "fan": Entry(places=tuple(("scheduled", path, "fan_rpm") for path in _PATHS)),
    "floor": Entry(places=_input("floor_degc")),
    "more_power": Entry(places=_input("motor_w")),
    "gain_dtf": Entry(places=(("gain", "DTF", ""),)),
    "gain_tdtf": Entry(places=(("gain", "TDTF", ""),)),
    "time_constant": Entry(places=(("dynamics", "DTF", ""),)),
    "weak_bearing": Entry(places=(*(("dynamics", p, "") for p in _PATHS), *(("gain", p, "") for p in _PATHS))),
    "nonlinear": Entry(places=(("nonlinear", "DTF", ""),)),
    "loose_couple": Entry(places=(("gain", "DTF", ""), ("delay", "TTF", "")), acts_on="t_q"),
    "lag_t_q": Entry(places=(("delay", "TTF", ""),), acts_on="t_q"),
    "delay_t_q": Entry(places=(("delay", "TTF", ""),), acts_on="t_q"),
    "hidden": Entry(places=(("unobserved", "", ""),), deployable=False),
    "drift": Entry(places=(("drift", "", ""),), deployable=False, acts_on="y"),
    "step": Entry(places=(("step", "", ""),), deployable=False, acts_on="y"),
    "period": Entry(places=(("periodic", "", ""),), deployable=False, acts_on="y"),
}

_PHYSICAL = (
    "none",
    "coolant",
    "wet",
    "bearing",
    "fan",
    "floor",
    "loose_couple",
    "more_power",
    "hidden",
    "weak_bearing",
    "drift",
    "step",
    "period",
    "lag_t_q",
    "delay_t_q",
)

#: Effects that each family can have, in the order in which cases go round.
EFFECTS: dict[str, tuple[str, ...]] = {
    "transfer": (
        "none",
        "coolant",
        "speed",
        "floor",
        "gain_dtf",
        "gain_tdtf",
        "time_constant",
        "lag_t_q",
        "delay_t_q",
        "nonlinear",
        "drift",
        "step",
        "period",
        "hidden",
    ),
    "conduction": _PHYSICAL,
    "lumped": _PHYSICAL,
}
