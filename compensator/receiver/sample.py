"""A sample of several axes, put together from their messages: complete, or not used at all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from .axis_message import LINEAR, TILTS, AxisMessage
from .message import Rejected
from .reasons import Reason

#: Samples whose messages are waited for at a time; a flood of numbers displaces the oldest.
_SAMPLES_MAX = 16
#: Messages of a sample arrive together; after this time one that has not arrived is called missing, s.
MISSING_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """The messages of all axes with one number.

    Parameters
    ----------
    axes : tuple of AxisMessage
        One for each axis, in the order of the settings.
    """

    axes: tuple[AxisMessage, ...]

    @property
    def machine(self) -> str:
        """Return the machine that published it."""
        return self.axes[0].machine

    @property
    def seq(self) -> int:
        """Return the number; never repeats for a machine."""
        return self.axes[0].seq

    @property
    def time_utc_ns(self) -> int:
        """Return the time of the measurement, ns since 1970 UTC."""
        return self.axes[0].time_utc_ns

    @property
    def valid_for_s(self) -> float:
        """Return the time for which it may be used, s."""
        return self.axes[0].valid_for_s

    def of(self, axis: str) -> AxisMessage:
        """Return the message of an axis."""
        return next(message for message in self.axes if message.axis == axis)

    def tilts_of(self, axis: str) -> list[AxisMessage]:
        """Return the angles that act on an axis."""
        return [message for message in self.axes if message.acts_on == axis]


@dataclass(slots=True)
class _Begun:
    since_s: float
    messages: dict[str, AxisMessage] = field(default_factory=dict)
    asked: bool = False
    measured_s: float | None = None  # monotonic clock, where an age was to be checked


@dataclass(frozen=True, slots=True, kw_only=True)
class Completed:
    """A complete sample.

    Parameters
    ----------
    sample : Sample
        The messages.
    age_s : float
        Largest age by the wall clock, s, if the age of any of them is to be checked; else since the first of them
        arrived.
    asked : bool
        Whether an answer to a query is part of it.
    """

    sample: Sample
    age_s: float
    asked: bool


class Assembler:
    """Collects messages until a sample is complete.

    Parameters
    ----------
    axes : iterable of str
        Axes that are applied; others are not waited for.
    """

    def __init__(self, axes: Iterable[str]) -> None:
        names = tuple(axes)
        self.axes = tuple(axis for axis in LINEAR + TILTS if axis in names)
        self._begun: dict[int, _Begun] = {}

    def add(self, now_s: float, message: AxisMessage, age_s: float | None, *, asked: bool) -> Completed | None:
        """Add a message; return the sample if that is complete now.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        message : AxisMessage
            A message of one of the axes.
        age_s : float or None
            Its age by the wall clock, s, if that is to be checked.
        asked : bool
            Whether it is the answer to a query.

        Raises
        ------
        Rejected
            `axes_disagree`: messages with one number that are not of one sample; those that came before are dropped,
            and two that contradict each other, too.
            `axis_not_published`, `axis_not_applied`: the axes are not those of the settings.
        """
        self._check(message)
        begun = self._begun.setdefault(message.seq, _Begun(now_s))
        first = next(iter(begun.messages.values()), message)
        same = _of_one_sample(first, message)
        disagree = Rejected(Reason("axes_disagree", f"number {message.seq}: {first.axis} and {message.axis}"))
        if same and begun.messages.get(message.axis, message) != message:
            del self._begun[message.seq]
            raise disagree
        if not same:
            # Begun anew, or what is left of one sample would spoil each later one with its number.
            begun = self._begun[message.seq] = _Begun(now_s)
        begun.messages[message.axis] = message
        begun.asked |= asked
        if age_s is not None:
            measured_s = now_s - age_s
            begun.measured_s = measured_s if begun.measured_s is None else min(begun.measured_s, measured_s)
        if not same:
            raise disagree
        if len(begun.messages) < len(self.axes):
            while len(self._begun) > _SAMPLES_MAX:
                del self._begun[next(iter(self._begun))]
            return None
        del self._begun[message.seq]
        return Completed(
            sample=Sample(axes=tuple(begun.messages[axis] for axis in self.axes)),
            # An axis that arrives late does not make the others young.
            age_s=now_s - (begun.since_s if begun.measured_s is None else begun.measured_s),
            asked=begun.asked,
        )

    def forget(self, now_s: float, seq: int) -> None:
        """Forget what was begun before the sample that is used now.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        seq : int
            Number of that sample.
        """
        kept = {n: begun for n, begun in self._begun.items() if n > seq and now_s - begun.since_s < MISSING_S}
        self._begun = kept

    def missing(self, now_s: float, after_seq: int) -> Reason | None:
        """Return which axes of the newest sample have not arrived in time; None if none is missing.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        after_seq : int
            Number of the sample that is used.
        """
        late = [seq for seq, begun in self._begun.items() if seq > after_seq and now_s - begun.since_s >= MISSING_S]
        if not late:
            return None
        axes = [axis for axis in self.axes if axis not in self._begun[max(late)].messages]
        return Reason("incomplete", f"number {max(late)} without {', '.join(axes)}")

    def _check(self, message: AxisMessage) -> None:
        absent = [axis for axis in self.axes if axis not in message.axes]
        if absent:
            published = f"{', '.join(absent)}; {', '.join(message.axes)} are"
            raise Rejected(Reason("axis_not_published", published))
        if message.acts_on and message.acts_on not in self.axes:
            detail = f"{message.axis} acts on {message.acts_on}, applied are {', '.join(self.axes)}"
            raise Rejected(Reason("axis_not_applied", detail))


def _of_one_sample(one: AxisMessage, other: AxisMessage) -> bool:
    same = ("axes", "machine", "time_utc_ns", "valid_for_s")
    return all(getattr(one, name) == getattr(other, name) for name in same)
