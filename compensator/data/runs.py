"""Measured runs for the fits: changes from the start, no gaps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Indices, Mask, Vector, stretches_of
from compensator.data.record import SHORT_GAP_SAMPLES, TEMPERATURES, SampledRecord

#: Longest stretch at the start of a run whose mean is its reference, samples.
REST_SAMPLES = 30
#: A signal whose standard deviation is below this multiple of its noise's is noise alone.
NOISE_ALONE = 1.5
#: Shortest stretch between two long gaps that makes a run, samples.
SHORTEST_RUN = 30
#: A gap of T_Q or AT by so many samples longer than usual leaves the heat in it unknown.
HOLE_SAMPLES = 5
#: Four values that follow each other within so many samples are neighbours: they show the noise of a slow signal.
NEIGHBOURS_SAMPLES = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A stretch of data without a long gap.

    Parameters
    ----------
    name : str
        Name of the data, and its part where a long gap split it.
    t_s : numpy.ndarray, shape (n,)
        Time, s.
    difference_k, ambient_k : numpy.ndarray, shape (n,)
        T_Q − AT and AT as changes from the reference, K.
    y_um : numpy.ndarray, shape (n,)
        Measured deformation, µm; NaN where missing.
    heat_w : numpy.ndarray or None, shape (n,)
        Known heat, W.
    reference : tuple of float
        T_Q and AT that the changes count from, °C.
    channels : dict of str to numpy.ndarray, shape (n,)
        Every other column; gaps of up to `SHORT_GAP_SAMPLES` bridged, NaN in longer ones.
    recording : int
        Which of several recordings it is a part of.
    y_std_um : float, optional
        Standard deviation of one measured value of the deformation as it was stated, µm.
    row_s : float
        Usual time between the rows that the samples are made from, s; NaN where it is not known.
    zeros_s : tuple of float
        Where Y was probed: times within it from which on Y counts from another zero, s, each with values on both sides.
    holes : tuple of (int, int)
        First sample and end of each gap of T_Q or AT that was bridged and is longer than usual by more than
        `HOLE_SAMPLES`: how the machine was heated in it is not known. Also of other channels that a model builds on
        (`bridging`).
    """

    name: str
    t_s: Vector
    difference_k: Vector
    ambient_k: Vector
    y_um: Vector
    heat_w: Vector | None
    reference: tuple[float, float]
    channels: dict[str, Vector]
    recording: int = 0
    y_std_um: float | None = None
    row_s: float = math.nan
    zeros_s: tuple[float, ...] = ()
    holes: tuple[tuple[int, int], ...] = ()

    @property
    def period_s(self) -> float:
        """Time between two samples, s."""
        return float(self.t_s[1] - self.t_s[0])

    @property
    def has_sparse_y(self) -> bool:
        """Whether Y was measured now and then, as by a touch probe."""
        return is_sparse(self.y_um)

    @property
    def y_noise_um(self) -> float:
        """White noise of the measured deformation: as stated, or from neighbouring values, µm."""
        return noise_std(self.y_um) if self.y_std_um is None else self.y_std_um

    def covered(self, mask: Mask) -> Mask:
        """Return the samples that measured values stand for: where Y is sparse, all from the first to the last."""
        if not self.has_sparse_y or not mask.any():
            return mask
        at, covered = np.flatnonzero(mask), np.zeros(mask.size, dtype=bool)
        covered[at[0] : at[-1] + 1] = True
        return covered

    def with_zeros(self, zeros_s: Sequence[float]) -> Run:
        """Return the run with the times from which on Y counts from another zero, s.

        Left out are values that show nothing: those of a sample that a zero may divide, whose zero is not known, and a
        single one about a zero.
        """
        if not zeros_s:
            return self
        zeros = np.sort(zeros_s)
        own = self.without_y(np.any(np.abs(self.t_s - zeros[:, None]) < self.period_s, axis=0))
        numbers = np.searchsorted(zeros, own.t_s)
        counts = np.bincount(numbers[np.isfinite(own.y_um) & ~own.in_holes], minlength=zeros.size + 1)
        own = own.without_y(counts[numbers] == 1)
        # Of zeros without values between them the last one is enough. In a hole a value shows nothing.
        return dataclasses.replace(own, zeros_s=tuple(zeros[np.flatnonzero(counts > 1)[1:] - 1].tolist()))

    @property
    def in_holes(self) -> Mask:
        """Samples in which the model lacks an input: what it has of Y there says nothing, shape (n,)."""
        at = np.arange(self.t_s.size)
        return np.asarray(np.any([(begin <= at) & (at < end) for begin, end in ((0, 0), *self.holes)], axis=0))

    def bridging(self, channels: Collection[str]) -> Run:
        """Return the run with a hole where one of some channels is missing for long, on which effects of a model build.

        As with T_Q and AT a line takes the place of what is not known.
        """
        gaps = {name: missing for name in channels if (missing := np.isnan(self.channels.get(name, 0.0))).any()}
        if not gaps:
            return self
        holes, bridged, at = set(self.holes), dict(self.channels), np.arange(self.t_s.size)
        for name, missing in gaps.items():
            values = self.channels[name]
            known = at[~missing]
            bridged[name] = np.interp(at, known, values[known]) if known.size else np.zeros(at.size)
            holes |= set(stretches_of(missing))
        own = dataclasses.replace(self, channels=bridged, holes=tuple(sorted(holes)))
        return own.with_zeros(own.zeros_s)

    @property
    def zero_numbers(self) -> Indices:
        """Number of the zero that Y of each sample counts from, from 0, shape (n,)."""
        return np.searchsorted(self.zeros_s, self.t_s)

    def counting_from(self, reference: tuple[float, float]) -> Run:
        """Return the run with T_Q and AT as changes from another reference, °C."""
        t_q_k, at_k = self.t_q_degc - reference[0], self.at_degc - reference[1]
        return dataclasses.replace(self, difference_k=t_q_k - at_k, ambient_k=at_k, reference=reference)

    def without_y(self, mask: Mask) -> Run:
        """Return the run without some values of Y."""
        return dataclasses.replace(self, y_um=np.where(mask, np.nan, self.y_um))

    @property
    def t_q_degc(self) -> Vector:
        """T_Q, °C."""
        return np.asarray(self.difference_k + self.at_degc + self.reference[0] - self.reference[1])

    @property
    def at_degc(self) -> Vector:
        """AT, °C."""
        return np.asarray(self.ambient_k + self.reference[1])


def runs_of(name: str, record: SampledRecord, *, whole_y: bool = False) -> Iterator[Run]:
    """Yield the runs of a record.

    Parameters
    ----------
    name : str
        Name for messages.
    record : SampledRecord
        Needs `t_q_degc`, `at_degc`, `y_um`; `heat_w` where it is known.
    whole_y : bool
        Whether T_Q or AT that is missing for long is a hole of the one run (`Run.holes`), in place of its end.
    """
    columns = record.columns
    inputs = [*TEMPERATURES, *(["heat_w"] if "heat_w" in columns else [])]
    missing = np.any([np.isnan(columns[c]) for c in inputs], axis=0)
    longest = missing.size if whole_y else SHORT_GAP_SAMPLES
    parts = list(_stretches(missing, longest))
    for i, (first, last) in enumerate(parts, start=1):
        part = {c: v[first:last] for c, v in columns.items()}
        bridged = {
            c: v if c == "y_um" else _bridged(v, longest if c in TEMPERATURES else SHORT_GAP_SAMPLES)
            for c, v in part.items()
        }
        label = name if len(parts) == 1 else f"{name} part {i}"
        run = _run(label, record.t_s[first:last], bridged)
        holes = [hole for column in TEMPERATURES for hole in _holes(np.isnan(part[column]))]
        yield dataclasses.replace(run, row_s=record.row_s, holes=tuple(sorted(set(holes))))


def _run(name: str, t_s: Vector, columns: dict[str, Vector]) -> Run:
    t_q, at, heat = columns["t_q_degc"], columns["at_degc"], columns.get("heat_w")
    difference = t_q - at
    rest = _rest_length((difference, at), heat)
    reference = float(np.mean(t_q[:rest])), float(np.mean(at[:rest]))
    return Run(
        name=name,
        t_s=t_s,
        difference_k=difference - (reference[0] - reference[1]),
        ambient_k=at - reference[1],
        y_um=columns["y_um"] if "y_um" in columns else np.full(t_s.size, np.nan),
        heat_w=heat,
        reference=reference,
        channels={c: v for c, v in columns.items() if c not in (*TEMPERATURES, "y_um", "heat_w")},
    )


def _rest_length(temperatures: Sequence[Vector], heat: Vector | None) -> int:
    """Return how many samples at the start show only noise: their mean is a better zero than one sample."""
    size = min(REST_SAMPLES, temperatures[0].size)
    moved = np.zeros(size, dtype=bool)
    for values in temperatures:
        head, noise = values[:size], noise_std(values)
        # A drift below the noise of one sample cannot be distinguished from it, and costs less than the mean gains.
        drift = np.abs(np.cumsum(head) / np.arange(1, size + 1) - np.median(head[:5]))
        drift[:5] = 0.0
        moved |= (np.abs(head - np.median(head[:5])) > 5.0 * noise + 0.01) | (drift > noise + 0.005)
    if heat is not None:
        moved |= np.abs(heat[:size] - heat[0]) > 1e-9
    return max(1, int(np.argmax(moved)) if moved.any() else size)


def _stretches(missing: Mask, longest: int) -> Iterator[tuple[int, int]]:
    """Yield the stretches between gaps of more than so many samples, without missing ends."""
    present = np.flatnonzero(~missing)
    if present.size == 0:
        return
    breaks = np.flatnonzero(np.diff(present) > longest + 1)
    for group in np.split(present, breaks + 1):
        if group.size >= SHORTEST_RUN:
            yield int(group[0]), int(group[-1]) + 1


def _holes(missing: Mask) -> Iterator[tuple[int, int]]:
    """Yield first sample and end of the gaps that are longer than the usual distance of two values; see `Run.holes`."""
    present = np.flatnonzero(~missing)
    apart = np.diff(present)
    for i in np.flatnonzero(apart > np.median(apart) + HOLE_SAMPLES):
        yield int(present[i]) + 1, int(present[i + 1])


def _bridged(values: Vector, longest: int) -> Vector:
    """Return values without gaps of up to so many samples; what a longer one hides is not known."""
    known = np.flatnonzero(~np.isnan(values))
    if known.size in (0, values.size):
        return values
    at = np.arange(values.size)
    bridged = np.interp(at, known, values[known])
    before, after = (np.searchsorted(known, at, side=side) for side in ("right", "left"))
    ends = np.concatenate([[-1], known, [values.size]])
    # From the value before a sample, or the begin, to the value after it, or the end.
    bridged[ends[after + 1] - ends[before] > longest + 1] = np.nan
    return bridged


def noise_std(*parts: Vector) -> float:
    """Return the standard deviation of white noise on a slow signal, by third differences within its parts.

    The median is insensitive to steps and outliers. A signal in converter steps has many differences of zero; the mean
    square of the lower nine tenths is used then.

    Examples
    --------
    >>> slow = np.sin(np.arange(5000) / 500.0)
    >>> round(noise_std(slow + np.random.default_rng(0).normal(0.0, 0.3, 5000)), 1)
    0.3
    """
    known = [values[~np.isnan(values)] for values in parts]
    differences = np.concatenate([np.diff(v, 3) for v in known])
    if differences.size < 5:
        return 0.0
    size = np.sort(np.abs(differences)) / np.sqrt(20.0)
    typical = float(np.median(size)) / 0.6745
    lower = size[: max(1, int(0.9 * size.size))]
    # The mean square over the lower nine tenths of a normal's magnitudes is 0.6107 of its variance.
    return typical or float(np.sqrt(np.mean(lower**2) / 0.6107))


def is_sparse(values: Vector) -> bool:
    """Whether most values have no neighbours from which their noise could be seen; NaN is missing.

    Examples
    --------
    >>> hourly = np.full(600, np.nan)
    >>> hourly[::60] = 1.0
    >>> is_sparse(hourly), is_sparse(np.ones(600))
    (True, False)
    """
    known = np.flatnonzero(~np.isnan(values))
    if known.size < 4:
        return bool(0 < known.size < values.size)
    return bool(np.mean(known[3:] - known[:-3] > NEIGHBOURS_SAMPLES) > 0.5)


def is_noise(values: Vector, noise: float | None = None) -> bool:
    """Whether a signal holds nothing but white noise, by default that which its neighbours show; NaN is left out."""
    known = values[~np.isnan(values)]
    return float(np.std(known)) < NOISE_ALONE * (noise_std(known) if noise is None else noise)


def noise_of(runs: Sequence[Run]) -> dict[str, float]:
    """Return the noise of `t_q_degc`, `at_degc` and `y_um`, in their units: the largest of all recordings.

    The runs of a recording with many gaps are short, and the noise of the least lucky one is larger than that of all.
    """
    by_recording: dict[int, list[Run]] = {}
    for run in runs:
        by_recording.setdefault(run.recording, []).append(run)

    def largest(name: str) -> float:
        return max(noise_std(*(getattr(run, name) for run in parts)) for parts in by_recording.values())

    found = {name: largest(name) for name in ("t_q_degc", "at_degc", "y_um")}
    if stated := [run.y_std_um for run in runs if run.y_std_um is not None]:
        found["y_um"] = max(stated)
    return found


def walk_std(values: Sequence[Vector], noise: float) -> float:
    """Return the standard deviation of the change per sample, less the sensor's noise."""
    changes = np.concatenate([np.diff(v) for v in values])
    return float(np.sqrt(max(float(np.mean(changes**2)) - 2.0 * noise**2, 0.0))) if changes.size else 0.0
