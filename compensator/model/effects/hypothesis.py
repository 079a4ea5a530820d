"""What a kind of effect can say of a whole record: the other half of each effect's file.

A hypothesis is one way in which the model could lack something. Its free parameters are searched, its
amplitudes are linear and solved for:

    residual = fixed(θ) + Σ_j amplitude_j · column_j(θ) + what else there is
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.model.effects.base import kinds
from compensator.model.transfer_function import SampledTransferFunction

#: Lags in a row, and the longest of them, min.
ROW, ROW_LONGEST_MIN = 6, 600.0
#: Weight that holds the gains of a row together.
ROW_RIDGE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordSignals:
    """Signals of the base model over a record, as the effects see them.

    Parameters
    ----------
    period_min : float
        Sample period, min.
    drive, ambient_k, y_dtf_um, y_tdtf_um : numpy.ndarray, shape (n,)
        As in `Signals`.
    channels : mapping of str to numpy.ndarray, shape (n,)
        Auxiliary channels, gaps bridged.
    dtf, tdtf : SampledTransferFunction
        The base model's paths.
    """

    period_min: float
    drive: Vector
    ambient_k: Vector
    y_dtf_um: Vector
    y_tdtf_um: Vector
    channels: Mapping[str, Vector]
    dtf: SampledTransferFunction
    tdtf: SampledTransferFunction

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.drive.size)

    def share(self, path: str) -> Vector:
        """Return the share of a path in y, µm; the TTF's is the DTF's, which it drives."""
        return self.y_tdtf_um if path == "TDTF" else self.y_dtf_um

    def source(self, path: str) -> Vector:
        """Return what drives a path: heat, W (or T_Q − AT, K), or the ambient's change, K."""
        return self.ambient_k if path == "TDTF" else self.drive

    def function(self, path: str) -> SampledTransferFunction:
        """Return a path's transfer function."""
        return self.tdtf if path == "TDTF" else self.dtf


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
        Searched in its logarithm.
    """

    name: str
    low: float
    high: float
    grid: tuple[float, ...]
    log: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypothesis:
    """One way in which the model could lack something.

    Parameters
    ----------
    kind, path, channel, form : str
        Kind and place by the contract; `form` tells variants of the same kind and place apart.
    free : tuple of Free
        Parameters that are searched.
    amplitudes : tuple of str
        Names of the linear parameters, with units.
    """

    kind: ClassVar[str] = ""
    deployable: ClassVar[bool] = True
    #: Least share of the residual's sum of squares that it must take: less is of no use to anybody.
    worth: ClassVar[float] = 0.05
    #: The same beside another effect where forms are not exact: what acts at some time only follows what they leave.
    worth_beside: ClassVar[float] = 0.05
    #: Weight that holds its amplitudes small, against columns of norm 1; 0 leaves them free.
    ridge: ClassVar[float] = 0.0
    path: str = ""
    channel: str = ""
    form: str = ""
    free: tuple[Free, ...] = ()
    amplitudes: tuple[str, ...] = ()

    @property
    def place(self) -> tuple[str, str, str]:
        """Kind, path and channel: what the diagnosis names."""
        return self.kind, self.path, self.channel

    @property
    def parameters(self) -> int:
        """Number of parameters, searched and linear."""
        return len(self.free) + len(self.amplitudes)

    def fixed(self, waves: RecordSignals, values: Sequence[float]) -> Vector | None:
        """Return the part that has no amplitude, µm; None where there is none."""
        return None

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return one column for each amplitude, shape (n, len(amplitudes))."""
        return np.zeros((waves.size, 0))

    def trial(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return columns that a first scan may give any amplitude: the fixed part stands in where there is one."""
        fixed = self.fixed(waves, values)
        columns = self.columns(waves, values)
        return columns if fixed is None else np.column_stack((fixed, columns))

    def named(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, float]:
        """Return every parameter by the name and unit that people read."""
        names = [*(free.name for free in self.free), *self.amplitudes]
        return dict(zip(names, (*values, *amplitudes), strict=True))

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the `[[effect]]` table that the engine runs."""
        raise NotImplementedError

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Return one or two sentences for an engineer."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What a proposal may build on.

    Parameters
    ----------
    channels : tuple of str
        Channels that move.
    has_ambient, has_ttf : bool
        Whether the model has a TDTF and a TTF.
    minutes : float
        Length of the longest record, min.
    period_min : float
        Sample period, min.
    sizes_um : mapping of str to float
        Peak-to-peak share of each path, µm.
    taus_min : mapping of str to tuple of float
        Time constants of each path, min.
    spans : mapping of str to float
        Span of each channel, in its unit.
    zeroed : frozenset of str
        Channels with a zero of their own: they come near 0 and go far from it.
    functions : mapping of str to (tuple of float, tuple of float)
        Coefficients b and a of each path.
    rough : bool
        Whether the model was identified on a machine: effects there are only roughly of any form, so that rows of
        lags are proposed beside the exact forms.
    """

    channels: tuple[str, ...]
    has_ambient: bool
    has_ttf: bool
    minutes: float
    period_min: float
    sizes_um: Mapping[str, float]
    taus_min: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    spans: Mapping[str, float] = field(default_factory=dict)
    zeroed: frozenset[str] = frozenset()
    functions: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(default_factory=dict)
    rough: bool = False

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths that lead to the deformation and move it."""
        return tuple(name for name, size in self.sizes_um.items() if size > 0.0)

    @property
    def row_min(self) -> tuple[float, ...]:
        """Return the time constants of a row of lags, from a sample to a third of the record."""
        longest = min(ROW_LONGEST_MIN, max(self.minutes / 3.0, 20.0 * self.period_min))
        return tuple(float(t) for t in np.geomspace(self.period_min, longest, ROW))

    def tau(self, name: str = "tau_min", low: float = 0.6) -> Free:
        """Return a time constant, from a sample to a third of the record."""
        high = max(self.minutes / 3.0, 10.0 * self.period_min)
        low = low * self.period_min
        grid = tuple(float(t) for t in np.geomspace(low, high, 12))
        return Free(name=name, low=low, high=high, grid=grid)


def lowpass(u: Vector, tau_min: float, period_min: float) -> Vector:
    """Return a signal behind a first-order lag of gain 1, by Tustin's rule, at rest at its first value.

    Examples
    --------
    >>> lowpass(np.array([1.0, 1.0, 2.0]), 5.0, 1.0).round(3)
    array([1.   , 1.   , 1.091])
    """
    from scipy.signal import lfilter

    p = lag_pole(tau_min, period_min)
    half = (1.0 - p) / 2.0
    return np.asarray(lfilter([half, half], [1.0, -p], u - u[0]) + u[0])


def row(u: Vector, taus_min: Sequence[float], period_min: float) -> Matrix:
    """Return a signal behind each of a row of lags, shape (n, len(taus_min))."""
    return np.column_stack([lowpass(u, tau, period_min) for tau in taus_min])


def lag_pole(tau_min: float, period_min: float) -> float:
    """Return Tustin's pole of a lag, not below 0."""
    return max((2.0 * tau_min - period_min) / (2.0 * tau_min + period_min), 0.0)


def late(u: Vector, delay_min: float, period_min: float) -> Vector:
    """Return a signal that comes later by a delay (earlier, if negative); the ends hold."""
    k = np.arange(u.size, dtype=np.float64)
    return np.interp(k - delay_min / period_min, k, u)


Proposer = Callable[[Setting], Iterator[Hypothesis]]
_PROPOSERS: list[Proposer] = []


def proposes(proposer: Proposer) -> Proposer:
    """Register what a kind proposes."""
    _PROPOSERS.append(proposer)
    return proposer


def proposals(setting: Setting) -> list[Hypothesis]:
    """Return every hypothesis of every kind for this data."""
    kinds()
    return [hypothesis for proposer in _PROPOSERS for hypothesis in proposer(setting)]


def shown(value: float) -> str:
    """Return a number as an engineer writes it."""
    return f"{value:.3g}"
