"""The history of a machine from its recordings: figures, curves and episodes in bounded memory."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field

from compensator.codes import RecordingEnd, State
from compensator.report.envelope import Envelope, Stretches
from compensator.report.story import Story

#: Numbers of events and episodes that are kept; the others are only counted.
EVENTS, EPISODES = 500, 200
#: Number of the last probes that are kept; a probe every ten minutes for two weeks.
PROBES = 2000
#: States in which the offset follows the machine.
FOLLOWED = (State.OK, State.DEGRADED)
#: Shown as a state: the service did not run.
NO_RECORDING = "no recording"


@dataclass(slots=True)
class Spread:
    """Root mean square and largest magnitude of a quantity, with its sign and time.

    Parameters
    ----------
    samples : int
        Number of values.
    peak, at_s : float
        The value of largest magnitude and its time, s since 1970 UTC; NaN without any value.
    """

    samples: int = 0
    peak: float = math.nan
    at_s: float = math.nan
    _squares: float = 0.0

    def add(self, value: float, at_s: float) -> None:
        """Add a value; NaN is ignored."""
        if math.isnan(value):
            return
        self.samples += 1
        self._squares += value * value
        if not abs(value) <= abs(self.peak):
            self.peak, self.at_s = value, at_s

    def join(self, other: Spread) -> None:
        """Add the values of another spread."""
        self.samples += other.samples
        self._squares += other._squares
        if not abs(other.peak) <= abs(self.peak) and other.samples:
            self.peak, self.at_s = other.peak, other.at_s

    @property
    def rms(self) -> float:
        """Root mean square; NaN without any value."""
        return math.sqrt(self._squares / self.samples) if self.samples else math.nan


@dataclass(slots=True)
class Period:
    """Figures of a day, a month, or the whole history.

    Parameters
    ----------
    samples : int
        Number of samples.
    seconds : dict of str to float
        Time in each state, s.
    offset, residual, measured, left, std, probed : Spread
        Offset; measured − predicted; measured deformation; measured + offset; standard deviation of the offset; error
        that probes have found with the offset applied. µm.
    """

    samples: int = 0
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    offset: Spread = field(default_factory=Spread)
    residual: Spread = field(default_factory=Spread)
    measured: Spread = field(default_factory=Spread)
    left: Spread = field(default_factory=Spread)
    std: Spread = field(default_factory=Spread)
    probed: Spread = field(default_factory=Spread)

    def join(self, other: Period) -> None:
        """Add the figures of another period."""
        self.samples += other.samples
        for state, seconds in other.seconds.items():
            self.seconds[state] += seconds
        for name in ("offset", "residual", "measured", "left", "std", "probed"):
            getattr(self, name).join(getattr(other, name))


@dataclass(frozen=True, slots=True)
class ProbeShown:
    """A probe.

    Parameters
    ----------
    at_s : float
        When it was measured, s since 1970 UTC.
    feature : str
        Its feature.
    deformation_um, left_um : float
        Deformation that it shows, and the error that was left with the offset applied, µm; NaN if it was not read.
    predicted_um : float
        Corrected prediction for that time, µm; NaN if it was refused before it was compared.
    taken : bool
        Whether it corrects the prediction.
    code : str
        Why it was refused, or a remark.
    """

    at_s: float
    feature: str
    deformation_um: float
    left_um: float
    predicted_um: float
    taken: bool
    code: str


@dataclass(slots=True)
class Missed:
    """Missing values of a channel.

    Parameters
    ----------
    samples, missing : int
        Samples, and those without a usable value.
    qualities, errors : collections.Counter
        Qualities of the missing values; codes of single bad readings.
    """

    samples: int = 0
    missing: int = 0
    qualities: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True, order=True)
class Episode:
    """An interval in one state other than `ok` with its reasons; `state` is empty where nothing was recorded."""

    seconds: float
    number: int
    first_s: float
    last_s: float
    state: str
    reasons: tuple[str, ...]


@dataclass(slots=True)
class File:
    """A recording.

    Parameters
    ----------
    name : str
        File name.
    samples : int
        Number of samples in it.
    first_s, last_s : float
        Times of the first and last sample, s since 1970 UTC; NaN without any.
    end : str
        `RecordingEnd.FINISHED`, `RecordingEnd.OPEN`, or the byte at which it is damaged.
    """

    name: str
    samples: int = 0
    first_s: float = math.nan
    last_s: float = math.nan
    end: str = RecordingEnd.FINISHED

    def add(self, at_s: float) -> None:
        """Count a sample."""
        self.samples += 1
        self.first_s = at_s if math.isnan(self.first_s) else self.first_s
        self.last_s = at_s


@dataclass(slots=True)
class History:
    """The history of a machine.

    Parameters
    ----------
    machine : str
        Its name.
    files : list of File
        In order of their start.
    curves : dict of str to Envelope
        `offset`, `predicted`, `measured`, `left`, `residual`, `heat`, `share …` and `channel …`.
        `share probes` is the correction by probes.
    states, reasons : dict of str to Stretches
        When each was active; `no recording` counts as a state.
    reason_seconds : dict of str to float
        Time with each reason, s.
    whole : Period
        Figures of the whole history.
    days : dict of str to Period
        Figures by date, UTC.
    channels : dict of str to Missed
        By channel name.
    events : list of (float, str, str)
        Time, kind and text of the last events.
    probes : list of ProbeShown
        The last probes.
    probes_left : Spread
        Error that all probes taken have found with the offset applied, µm.
    probes_count, probes_taken : int
        Numbers of all probes, and of those that correct the prediction.
    events_count, episodes_count : int
        Numbers of all events and episodes.
    episodes : list of Episode
        The longest.
    models : dict of str to (str, float)
        Name and first time of each model, by its SHA-256.
    in_force : dict of str to Stretches
        When each model was in force, by its SHA-256.
    story : Story
        What happened to the models.
    axes : dict of str to Period
        Figures of further axes, tilts and slopes by name, each in its unit; `seconds` counts samples. Their curves are
        `axis NAME offset`, `axis NAME measured`, `axis NAME left`.
    axis_reasons : dict of str to collections.Counter
        Number of samples with each reason, by the same names.
    apart, apart_seconds : dict of (str, str) to Stretches, float
        When a further axis was in another state than Y, and for how long, s, by axis and state.
    """

    machine: str = ""
    files: list[File] = field(default_factory=list)
    curves: dict[str, Envelope] = field(default_factory=dict)
    states: dict[str, Stretches] = field(default_factory=dict)
    reasons: dict[str, Stretches] = field(default_factory=dict)
    reason_seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    whole: Period = field(default_factory=Period)
    days: dict[str, Period] = field(default_factory=dict)
    channels: dict[str, Missed] = field(default_factory=dict)
    events: list[tuple[float, str, str]] = field(default_factory=list)
    probes: list[ProbeShown] = field(default_factory=list)
    probes_left: Spread = field(default_factory=Spread)
    probes_count: int = 0
    probes_taken: int = 0
    events_count: int = 0
    episodes: list[Episode] = field(default_factory=list)
    episodes_count: int = 0
    models: dict[str, tuple[str, float]] = field(default_factory=dict)
    in_force: dict[str, Stretches] = field(default_factory=dict)
    story: Story = field(default_factory=Story)
    axes: dict[str, Period] = field(default_factory=dict)
    axis_reasons: defaultdict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    apart: dict[tuple[str, str], Stretches] = field(default_factory=dict)
    apart_seconds: defaultdict[tuple[str, str], float] = field(default_factory=lambda: defaultdict(float))

    @property
    def first_s(self) -> float:
        """Start of the first sample, s since 1970 UTC."""
        return min(a for s in self.states.values() for a, _ in s.pieces)

    @property
    def last_s(self) -> float:
        """End of the last sample, s since 1970 UTC."""
        return max(b for s in self.states.values() for _, b in s.pieces)
