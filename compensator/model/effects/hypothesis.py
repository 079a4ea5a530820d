"""Hypotheses: ways in which the model could lack something, and the context in which they are proposed.

The searched parameters θ of an effect have bounds and a grid; its linear parameters are solved for:

    residual = fixed(θ) + Σ_j amplitude_j · column_j(θ) + other terms + noise
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from compensator.arrays import Matrix
from compensator.model.effects.base import Effect, forms
from compensator.model.effects.signals import RecordSignals

#: Lags in a filter bank, and the longest of them, min.
BANK, BANK_LONGEST_MIN = 6, 600.0
#: Where a machine may be at rest: at the coolest start of all records, or where T_Q is AT.
COOLEST, EQUAL = "coolest start", "T_Q = AT"
#: End of the names of channels in °C, whose zero is arbitrary: the square of such a value means nothing.
DEGC = "_degc"


@dataclass(frozen=True, slots=True, kw_only=True)
class Free:
    """A parameter that is searched.

    Parameters
    ----------
    name : str
        With its unit.
    low, high : float
        Bounds.
    grid : tuple of float
        Where the search begins.
    log : bool
        Whether its logarithm is searched.
    key : str
        Field of the effect that it goes to, where that is not its name.
    """

    name: str
    low: float
    high: float
    grid: tuple[float, ...]
    log: bool = True
    key: str = ""


#: Kind, path and channel: what the diagnosis names.
Place = tuple[str, str, str]


def place_in_words(place: Place) -> str:
    """Return kind, path and channel in words.

    Examples
    --------
    >>> place_in_words(("input", "", "coolant_degc"))
    'input coolant_degc'
    """
    return " ".join(filter(None, place))


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypothesis:
    """One way in which the model could lack something.

    Parameters
    ----------
    effect : Effect
        The effect with linear parameters of 1; its searched ones are set by `with_values`.
    form : str
        Tells variants of the same kind and place apart.
    free : tuple of Free
        Parameters that are searched.
    amplitudes : tuple of str
        Names of the linear parameters, with units.
    sizes : tuple of float
        How large each of them may be before the data are seen (standard deviation, in its unit), where the machine
        says so: a path changes by about its own gain at most. None: as large as moves y by what it moved.
    path : str
        Path that the diagnosis names, where it is not the effect's own.
    ordered : bool
        Whether the searched parameters are interchangeable, so that only ascending ones are tried.
    rest : str
        Where the machine is at rest, `COOLEST` or `EQUAL`, for an effect that counts from there.
    """

    effect: Effect
    form: str = ""
    free: tuple[Free, ...] = ()
    amplitudes: tuple[str, ...] = ()
    sizes: tuple[float, ...] = ()
    path: str = ""
    ordered: bool = False
    rest: str = COOLEST

    @property
    def place(self) -> Place:
        """Kind, path and channel: what the diagnosis names."""
        return self.effect.kind, self.path or self.effect.path, self.effect.channel

    @property
    def acts_by_temperature(self) -> bool:
        """Whether a measured temperature acts, and by no path of the base."""
        _, path, channel = self.place
        return not path and channel.endswith(DEGC)

    @property
    def label(self) -> str:
        """Kind, place and form in words."""
        return place_in_words(self.place) + (f" ({self.form})" if self.form else "")

    def grid(self) -> list[tuple[float, ...]]:
        """Return the points where a search begins."""
        points = itertools.product(*(free.grid for free in self.free))
        return [p for p in points if not self.ordered or all(a < b for a, b in itertools.pairwise(p))]

    def with_values(self, values: Sequence[float], amplitudes: Sequence[float] | None = None) -> Effect:
        """Return the effect with its searched parameters, and its linear ones where they are given."""
        changes: dict[str, Any] = {}
        for free, value in zip(self.free, values, strict=True):
            changes.setdefault(free.key or free.name, []).append(value)
        for key, some in changes.items():
            changes[key] = tuple(some) if isinstance(getattr(self.effect, key), tuple) else some[0]
        if amplitudes is not None:
            rest = iter(amplitudes)
            for key in self.effect.linear:
                unit = getattr(self.effect, key)
                changes[key] = tuple(itertools.islice(rest, len(unit))) if isinstance(unit, tuple) else next(rest)
        return dataclasses.replace(self.effect, **changes)

    def columns(self, record: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return one column for each amplitude over a record, shape (n, ·), µm; without amplitudes the fixed part."""
        effect = self.with_values(values)
        blocks = effect.blocks(record.period_min)
        if not effect.counts_from_rest or (warm := record.begun(self.rest)).begins_at_rest:
            return effect.columns(record, blocks)
        # Y counts from the start of the record, too: what the effect had there is in its zero and initial state.
        return np.asarray(effect.columns(warm, blocks) - effect.columns(warm.held(), blocks))

    def named(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, float]:
        """Return every parameter by the name and unit that people read."""
        names = [*(free.name for free in self.free), *self.amplitudes]
        given = dict(zip(names, (*values, *amplitudes), strict=True))
        return self.with_values(values, amplitudes).named(given)


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """What is known of model and data when hypotheses are proposed.

    Parameters
    ----------
    has_ambient, has_ttf : bool
        Whether the model has a TDTF and a TTF.
    minutes : float
        Length of the longest record, min.
    span_min : float
        Time from the start of the first record to the end of the last, min.
    period_min : float
        Sample period, min.
    sizes_um : mapping of str to float
        Peak-to-peak share of each path, µm.
    taus_min : mapping of str to tuple of float
        Time constants of each path, min.
    spans : mapping of str to float
        Span of each channel that moves, in its unit.
    first : mapping of str to float
        Where each of them is as the first record begins.
    temperatures : tuple of str
        Channels in °C, whether they move or not: a tank of coolant stays as it is.
    zeroed : frozenset of str
        Channels with a zero of their own: they come near 0 and go far from it. No temperature in °C is one.
    functions : mapping of str to (tuple of float, tuple of float)
        Coefficients b and a of each path.
    gains : mapping of str to (float, float)
        Gain of each path at rest and its standard error, 0 where none is known, in µm per unit of what drives it.
    approximate : bool
        Whether effects match the forms only approximately, as on a machine that the model was identified on:
        filter banks are then proposed in addition to the exact forms.
    has_late_t_q : bool
        Whether the model corrects a late T_Q already.
    begins_warm : bool
        Whether even the coolest start has a T_Q that is not AT.
    """

    has_ambient: bool
    has_ttf: bool
    minutes: float
    span_min: float
    period_min: float
    sizes_um: Mapping[str, float]
    taus_min: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    spans: Mapping[str, float] = field(default_factory=dict)
    first: Mapping[str, float] = field(default_factory=dict)
    temperatures: tuple[str, ...] = ()
    zeroed: frozenset[str] = frozenset()
    functions: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(default_factory=dict)
    gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    approximate: bool = False
    has_late_t_q: bool = False
    begins_warm: bool = False

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that move."""
        return tuple(self.spans)

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths that lead to the deformation and move it."""
        return tuple(name for name, size in self.sizes_um.items() if size > 0.0)

    def change(self, path: str) -> float:
        """Return by which share of it the gain of a path may change: all of it, and more where it is hardly known."""
        gain, std = self.gains.get(path, (math.inf, 0.0))
        return 1.0 + std / abs(gain) if gain else math.inf

    def gain_change(self, path: str) -> float:
        """Return by how much the gain of a path at rest may change, in µm per unit of what drives it."""
        gain, std = self.gains.get(path, (math.inf, 0.0))
        return abs(gain) + std

    def drive_unit(self, path: str) -> str:
        """Return the unit of what drives a path, as names of parameters have it."""
        return "w" if path == "DTF" and self.has_ttf else "k"

    @property
    def bank_min(self) -> tuple[float, ...]:
        """Time constants of a filter bank, from a sample to a third of the record, min."""
        return self.lags_min(BANK)

    def lags_min(self, count: int) -> tuple[float, ...]:
        """Return so many time constants that any slow response is made of, from a sample on, min."""
        longest = min(BANK_LONGEST_MIN, max(self.minutes / 3.0, 20.0 * self.period_min))
        return tuple(float(t) for t in np.geomspace(self.period_min, longest, count))

    def surface(self) -> Free:
        """Return the time constant of a surface that follows what it exchanges heat with, as `tau`, coarser."""
        tau = self.tau("surface_min")
        return dataclasses.replace(tau, grid=tau.grid[2::3], key="")

    def tau(self, name: str = "tau_min") -> Free:
        """Return a time constant, from a sample to a third of the record."""
        high = max(self.minutes / 3.0, 10.0 * self.period_min)
        low = 0.6 * self.period_min
        grid = tuple(float(t) for t in np.geomspace(low, high, 12))
        return Free(name=name, low=low, high=high, grid=grid, key="tau_min")


#: Yields the hypotheses of a kind that are worth a search on this data.
Proposer = Callable[[Context], Iterator[Hypothesis]]
_PROPOSERS: list[Proposer] = []


def proposes(proposer: Proposer) -> Proposer:
    """Register what proposes hypotheses of a kind (function decorator)."""
    _PROPOSERS.append(proposer)
    return proposer


def proposals(context: Context, *, background: bool = False) -> list[Hypothesis]:
    """Return every hypothesis of every kind for this data: the background ones, or all others."""
    forms()
    found = [h for propose in _PROPOSERS for h in propose(context) if h.effect.background == background]
    if not context.begins_warm:
        return found
    # Couples may differ at rest, or the machine was at work: the data say which.
    warm = [h for h in found if h.effect.counts_from_rest and h.effect.path == "DTF"]
    return found + [dataclasses.replace(h, rest=EQUAL, form=f"{h.form}, warm start") for h in warm]


def numbered(name: str, count: int) -> tuple[str, ...]:
    """Return names of the gains of a filter bank."""
    return tuple(f"{name}_{i}" for i in range(1, count + 1))
