"""Faults of thermocouples, drawn by a seed: what loose plugs, wrong wires and tired couples do to a day of samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

#: Kinds by what is wrong; the first ones are jumps.
JUMPS = ("jump", "small_jump", "open_then_jump", "loose", "spike")
OTHERS = ("drift", "stuck", "came_off", "exchanged")
TEMPERATURES = ("t_q_degc", "at_degc")
Change = Callable[[int, dict[str, float]], None]


@dataclass(frozen=True, slots=True)
class SensorFault:
    """One fault from a sample to another.

    Parameters
    ----------
    kind : str
        One of `JUMPS` or `OTHERS`.
    channel : str
        Where; of `exchanged` the first of both.
    size : float
        K, or K/h of a drift.
    begin, end : int
        First sample, and first sample after the mend.
    seed : int
        Of what is random in it.
    """

    kind: str
    channel: str
    size: float
    begin: int
    end: int
    seed: int

    def change(self) -> Change:
        """Return what the fault does to the values of each sample, in their order."""
        random = np.random.default_rng([self.seed, 1])
        kept = {"value": math.nan, "bad": 0.0, "rise": math.nan}

        def act(i: int, values: dict[str, float]) -> None:
            if not self.begin <= i < self.end:
                kept["value"] = values[self.channel]
                kept["rise"] = values["t_q_degc"] - values["at_degc"]
                return
            since = i - self.begin
            if self.kind in ("jump", "small_jump", "spike"):
                values[self.channel] += self.size
            elif self.kind == "open_then_jump":
                values[self.channel] = math.nan if since < 4 else values[self.channel] + self.size
            elif self.kind == "loose":
                if random.random() < 0.15 or since == 0:
                    kept["bad"] = self.size * float(random.uniform(0.7, 1.3)) * float(random.random() < 0.7)
                    kept["bad"] = self.size if since == 0 else kept["bad"]
                values[self.channel] += kept["bad"]
            elif self.kind == "drift":
                values[self.channel] += self.size * since / 60.0
            elif self.kind == "stuck":
                values[self.channel] = kept["value"]
            elif self.kind == "came_off":
                # T_Q then shows the air, AT the machine that it hangs on.
                other = TEMPERATURES[self.channel == "t_q_degc"]
                part = 0.9 * (1.0 - math.exp(-(since + 1) / 2.0))
                values[self.channel] += part * (values[other] - values[self.channel])
            else:
                values["t_q_degc"], values["at_degc"] = values["at_degc"], values["t_q_degc"]

        return act


def draw(seed: int, kind: str | None = None, samples: int = 1440) -> SensorFault:
    """Return the fault of a seed in a day of samples; the same seed always gives the same one."""
    random = np.random.default_rng([seed, 17])
    kinds = (*JUMPS, *OTHERS)
    kind = kind or str(random.choice(kinds))
    channel = TEMPERATURES[int(random.integers(2))]
    sign = float(random.choice([-1.0, 1.0]))
    usual = (5.5, 12.0) if channel == "t_q_degc" else (2.5, 8.0)
    low, high = {"small_jump": (1.5, 4.0), "drift": (0.5, 2.0)}.get(kind, usual)
    begin = int(random.integers(120, samples - 700))
    lasts = int(random.integers(2, 10)) if kind == "spike" else int(random.integers(20, 420))
    lasts = max(lasts, 240) if kind == "drift" else lasts
    return SensorFault(kind, channel, sign * float(random.uniform(low, high)), begin, begin + lasts, seed)
