"""What all logged channels could explain, and how much of that the named effects do."""

from __future__ import annotations

from dataclasses import dataclass

#: Named effects that explain less than this of what the channels explain fall short of it, %. It is what an engineer
#: would act on, and no bound of statistics.
SHORT_PCT = 80.0
#: Channels that remove less than this share of the mean square explain next to nothing.
LITTLE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Ceiling:
    """What the best linear use of all logged channels leaves on data that took no part.

    Parameters
    ----------
    rms_um : float
        Its residual, µm.
    explained_pct : float
        How much of what it removes the named effects remove, %.
    least_rms_um : float, optional
        The smallest residual of this, the named effects, and these with the remainder, µm; None: it is `rms_um`.
    """

    rms_um: float
    explained_pct: float
    least_rms_um: float | None = None

    def shows_something(self, before_um: float) -> bool:
        """Return whether the channels remove more than next to nothing of a residual, µm rms."""
        return bool(before_um > 0.0 and 1.0 - (self.rms_um / before_um) ** 2 >= LITTLE)

    def is_missed(self, before_um: float) -> bool:
        """Return whether the named effects explain clearly less of a residual than the channels can."""
        return self.shows_something(before_um) and self.explained_pct < SHORT_PCT

    @property
    def least_um(self) -> float:
        """The smallest residual of all that was tried, µm."""
        return self.rms_um if self.least_rms_um is None else self.least_rms_um
