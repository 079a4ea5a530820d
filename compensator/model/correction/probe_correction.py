"""What probes of Y show about a model: an offset and slow relative gains of its paths and effects.

With the shares c of the paths and effects in the deformation, a probe of feature f measures

    y − y_free = offset + Σ gain_i · c_i + zero_f + noise

The offset and the gains walk. The first feature's zero is in the offset; a further feature has its own, unknown at its
first probe, so that it teaches only changes and makes no jump.

A probe that is more probably wrong than right, by its innovation, is refused; so many refused ones that agree are
believed. The most doubtful of those that were taken stays on probation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from compensator.model.correction.kalman_bank import KalmanBank, Observation
from compensator.model.correction.mapping import map_to_model, map_to_zero, moved_zero
from compensator.model.correction.mixture import mixed, weighted
from compensator.model.correction.probation import Probation
from compensator.model.correction.refused import AGREEING, ComparedProbe, agreeing

#: Standard deviation of a relative gain before the first probe: of the DTF, of all others.
DTF_GAIN_STD, GAIN_STD = 0.12, 0.2
#: Walk of a relative gain, part of that, 1/√min.
GAIN_WALK = 0.001
#: So many refused probes are kept.
REFUSED_KEPT = 20
#: Reasons of a verdict.
OUTLIER, BELIEVED = "probe_outlier", "probe_believed"


@dataclass(frozen=True, slots=True)
class ProbeVerdict:
    """What was made of a probe.

    Parameters
    ----------
    taken : bool
        False where it was refused by its innovation.
    reason : str or None
        `probe_outlier` where it was refused; `probe_believed` where it was taken together with refused ones that agree
        with it.
    innovation_um : float
        Measured less predicted deformation, µm.
    innovation_std_um : float
        Standard deviation that was expected of it, µm.
    """

    taken: bool
    reason: str | None
    innovation_um: float
    innovation_std_um: float


class ProbeCorrection:
    """What probes have shown about the model: an offset, and slow relative gains of the paths and effects.

    Parameters
    ----------
    names : sequence of str
        One for each path and deployed effect, as `Engine.contribution_names`.

    Examples
    --------
    >>> found = ProbeCorrection(["DTF", "TDTF"])
    >>> found.update(403.0, 1.0, 0.0, [0.0, 0.0]).taken
    True
    >>> round(found.correction_um([0.0, 0.0]))
    403
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.active = False
        self._features: list[str] = []
        self._refused: list[ComparedProbe] = []
        self._probes = 0
        self._minutes = 0.0
        self._waiting = 0.0
        self._probation = Probation(self._new_bank())
        self._mix()

    def _new_bank(self) -> KalmanBank:
        stds = [DTF_GAIN_STD if name == "DTF" else GAIN_STD for name in self.names]
        return KalmanBank(stds, [GAIN_WALK * std for std in stds])

    @property
    def is_probed(self) -> bool:
        """Whether a probe was taken since the zero."""
        return self._probes > 0

    @property
    def doubt(self) -> float:
        """Probability that the probe on probation, which the correction is partly made of, was wrong."""
        return self._probation.doubt

    # ------------------------------------------------------------------ each sample

    def step(self, contributions_um: Sequence[float], minutes: float = 1.0) -> None:
        """Advance by one sample.

        Parameters
        ----------
        contributions_um : sequence of float
            Share of each path and effect in the deformation, µm.
        minutes : float
            Time since the sample before, min.
        """
        self._expect(contributions_um)
        self._minutes += minutes
        self._waiting += minutes

    def correction_um(self, contributions_um: Sequence[float]) -> float:
        """Return what is to be added to the deformation of the free run, µm; 0 before the first probe was taken."""
        if not self.active:
            return 0.0
        return weighted((1.0, *contributions_um), self._known.mean)

    def doubted_um(self, contributions_um: Sequence[float]) -> float:
        """Return the part of `std_um` that the doubt of the probe on probation adds, µm; 0 where none is."""
        if len(self._means) == 1:
            return 0.0
        apart = [right - wrong for right, wrong in zip(*self._means, strict=True)]
        return math.sqrt(self.doubt * (1.0 - self.doubt)) * abs(weighted((1.0, *contributions_um), apart))

    def std_um(self, contributions_um: Sequence[float]) -> float:
        """Return the standard deviation of the corrected deformation, µm: what the probes leave unknown.

        It takes the place of the model's own error; noise of the temperatures is not included. 0 before the first
        probe was taken.
        """
        if not self.active:
            return 0.0
        return self._known.std_of((1.0, *contributions_um), self._waiting)

    def growth_um2_per_min(self, contributions_um: Sequence[float]) -> float:
        """Return by how much the square of `std_um` grows in a minute without probes, as the states walk, µm²."""
        if not self.active:
            return 0.0
        return self._known.growth_of((1.0, *contributions_um))

    # ------------------------------------------------------------------ each probe

    def update(
        self, y_um: float, std_um: float, predicted_um: float, contributions_um: Sequence[float], feature: str = ""
    ) -> ProbeVerdict:
        """Correct by a probe.

        Parameters
        ----------
        y_um : float
            Measured deformation, µm.
        std_um : float
            Its standard deviation, µm.
        predicted_um : float
            Deformation of the free run at the time of the probe, µm.
        contributions_um : sequence of float
            Share of each path and effect in it, µm.
        feature : str
            What was probed; each feature has its own zero.

        Returns
        -------
        ProbeVerdict
            Whether it was taken.

        Raises
        ------
        ValueError
            If the standard deviation is not above 0, or a number is missing.
        """
        self._expect(contributions_um)
        if not (std_um > 0.0 and math.isfinite(y_um - predicted_um + std_um + sum(contributions_um))):
            raise ValueError(
                f"probe of {y_um} ± {std_um} µm at {predicted_um} µm, expected numbers and a deviation > 0"
            )
        # The states have walked since they were last used.
        self._probation.advance(self._waiting)
        self._waiting = 0.0
        deviation, shares = y_um - predicted_um, tuple(contributions_um)
        observed = Observation(self._row(shares, feature), deviation, std_um)
        innovation, variance = self._probation.innovation(observed)
        probe = ComparedProbe(self._minutes, deviation, innovation, std_um, shares, feature)
        doubt, reason = self.doubt, None
        self._probation.reconsider(observed)
        supported = agreeing(self._refused, probe, self._known)
        if len(supported) + 1 >= min(AGREEING, self._probes + 2):
            reason = BELIEVED
            self._believe(supported, probe)
            observed = self._observation(probe)
        right = self._probation.weigh(observed).right
        if reason is None and right < 0.5:
            self._probation.refuse(observed, doubt)
            self._refused = [*self._refused[1 - REFUSED_KEPT :], probe]
            if not self.is_probed:  # The first feature is the first of which a probe is taken.
                self._features.clear()
            self._mix()
            return ProbeVerdict(False, OUTLIER, innovation, math.sqrt(variance))
        self._probation.accept(observed, 1.0 - right)
        self._refused = []
        self._probes += 1
        self.active = True
        self._mix()
        return ProbeVerdict(True, reason, innovation, math.sqrt(variance))

    def innovation(
        self, y_um: float, std_um: float, predicted_um: float, contributions_um: Sequence[float], feature: str = ""
    ) -> tuple[float, float]:
        """Return what a probe shows beyond the prediction, and its standard deviation, µm, without correcting by it.

        Parameters
        ----------
        y_um, std_um, predicted_um, contributions_um, feature
            As `update` has them.

        Raises
        ------
        ValueError
            As `update`.
        """
        found = ProbeCorrection.from_dict(self.to_dict()).update(y_um, std_um, predicted_um, contributions_um, feature)
        return found.innovation_um, found.innovation_std_um

    def _expect(self, contributions_um: Sequence[float]) -> None:
        if len(contributions_um) != len(self.names):
            raise ValueError(f"{len(contributions_um)} contributions, expected one for each of {list(self.names)}")

    def _row(self, contributions_um: Sequence[float], feature: str) -> list[float]:
        """Return how much of each state a probe contains; a feature that is new gets a zero of its own."""
        if feature not in self._features:
            if self._features:  # The zero of the first feature is in the offset.
                self._probation.add_zero()
            self._features.append(feature)
        return [1.0, *contributions_um, *(1.0 if name == feature else 0.0 for name in self._features[1:])]

    def _observation(self, probe: ComparedProbe) -> Observation:
        row = self._row(probe.contributions_um, probe.feature)
        return Observation(row, probe.deviation_um, probe.std_um, self._minutes - probe.minutes)

    def _believe(self, supported: Sequence[ComparedProbe], probe: ComparedProbe) -> None:
        """Widen what may have moved, and correct by the refused probes.

        Where one further feature alone shows it, that feature may have moved as well as the machine: its zero is
        unknown again, the offset stays, and its deviation says so.
        """
        features = {one.feature for one in (*supported, probe)}
        alone = len(features) == 1 and probe.feature != self._features[0]
        zero = len(self.names) + self._features.index(probe.feature) if alone else None
        self._probation.widen(probe.innovation_um, zero)
        for earlier in supported:
            self._probation.correct(self._observation(earlier))

    def _mix(self) -> None:
        """Keep what both banks know together, so that a sample costs little."""
        found = self._probation.mixtures(1 + len(self.names), zeroed=not self.is_probed)
        self._means = [each.mean for each in found]
        self._known = mixed(found, self._probation.probabilities)

    # ------------------------------------------------------------------ state

    def to_dict(self) -> dict[str, Any]:
        """Return everything that decides what comes next, for JSON; `from_dict` continues with the same bits."""
        return {
            "names": list(self.names),
            "active": self.active,
            "features": list(self._features),
            "refused": [asdict(probe) for probe in self._refused],
            "probes": self._probes,
            "minutes": self._minutes,
            "waiting_min": self._waiting,
            **self._probation.to_dict(),
        }

    @classmethod
    def from_dict(cls, state: Mapping[str, Any]) -> ProbeCorrection:
        """Continue from what `to_dict` returned.

        Raises
        ------
        ValueError
            If it is not what `to_dict` returns.
        """
        try:
            found = cls([str(name) for name in state["names"]])
            found.active = bool(state["active"])
            found._features = [str(name) for name in state["features"]]
            found._refused = [ComparedProbe.from_dict(probe) for probe in state["refused"]]
            found._probes = int(state["probes"])
            found._minutes, found._waiting = float(state["minutes"]), float(state["waiting_min"])
            for _ in found._features[1:]:
                found._probation.add_zero()
            found._probation.restore(state)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"state of the probes: {error!r}") from error
        found._mix()
        return found

    # ------------------------------------------------------------------ another zero, another model

    def at_zero(self, contributions_um: Sequence[float]) -> ProbeCorrection:
        """Return the correction after a zero: the gains and walks stay, the offset and the zeros start anew.

        The gains go on to act on what the shares grow by from now on, so that the correction is 0 now. Until the next
        probe its deviation is that of a machine whose level is known; the level of the probes may be any.

        Parameters
        ----------
        contributions_um : sequence of float
            Shares of the paths and effects at the zero, as they are counted after it, µm.
        """
        self._expect(contributions_um)
        found = ProbeCorrection(self.names)
        found.active = self.active

        def zeroed(before: KalmanBank) -> KalmanBank:
            fresh = found._new_bank()
            map_to_zero(before, fresh, contributions_um, active=self.active)
            return fresh

        found._probation = self._probation.changed(self._waiting, zeroed)
        found._mix()
        return found

    def move_zero(self, by_um: Sequence[float]) -> None:
        """Account for other shares at the zero: the correction at the zero stays what it was.

        Parameters
        ----------
        by_um : sequence of float
            By how much the shares of the paths and effects at the zero are larger than it was thought, µm.
        """
        self._expect(by_um)
        if self.active:
            self._probation = self._probation.changed(self._waiting, lambda bank: moved_zero(bank, by_um))
            self._waiting = 0.0
            self._mix()

    def transferred(
        self,
        names: Sequence[str],
        contributions_um: Sequence[float],
        new_contributions_um: Sequence[float],
        change_um: float,
    ) -> ProbeCorrection:
        """Return the correction for another model that takes over now, without a jump.

        The corrected deformation and its deviation are the same before and after. The zeros of the features and the
        weights of the walks go over. The gains start anew, for what they corrected may be what the new model explains:
        what they added up to now is in the new offset, which is known as well as the corrected deformation was.

        Parameters
        ----------
        names : sequence of str
            One for each path and effect of the new model.
        contributions_um, new_contributions_um : sequence of float
            Shares in the deformation now: of this model, of the new one, µm.
        change_um : float
            Deformation now of the new model's free run, less this one's, µm.
        """
        self._expect(contributions_um)
        found = ProbeCorrection(names)
        found._expect(new_contributions_um)
        if not self.active:
            return found
        found.active, found._probes, found._minutes = True, self._probes, self._minutes
        found._features = list(self._features)

        def taken_over(before: KalmanBank) -> KalmanBank:
            fresh = found._new_bank()
            map_to_model(before, fresh, contributions_um, new_contributions_um, change_um)
            return fresh

        found._probation = self._probation.changed(self._waiting, taken_over)
        found._mix()
        return found
