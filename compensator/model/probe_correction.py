"""What probes of Y show about a model: an offset and slow relative gains of its paths and effects.

With the shares c of the paths and effects in the deformation, a probe of feature f measures

    y − y_free = offset + Σ gain_i · c_i + zero_f + noise

The offset and the gains walk. The first feature's zero is in the offset; a further feature has its own, unknown at its
first probe, so that it teaches only changes and makes no jump.

A probe that is more probably wrong than right, by its innovation, is refused; so many refused ones that agree are
believed. The most doubtful of those that were taken stays on probation: a second bank takes it for a wrong one, and
takes over once the later probes make that more probable. Until then the correction is the mean of both, weighted by
their probabilities, and its deviation includes how far they lie apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from compensator.model.filter_bank import SIZE, WRONG_UM, Expected, FilterBank, Mixture, Weighing, mixed, transformed

#: Standard deviation of a relative gain before the first probe: of the DTF, of all others.
DTF_GAIN_STD, GAIN_STD = 0.12, 0.2
#: Walk of a relative gain, part of that, 1/√min.
GAIN_WALK = 0.001
#: So many refused probes that agree are believed; two before a second probe was taken.
AGREEING = 3
#: Refused probes that lie further apart than this do not support each other, min.
AGREEING_WITHIN_MIN = 720.0
#: So many refused probes are kept.
REFUSED_KEPT = 20
#: Refused probes agree within this many standard deviations of their difference.
AGREEMENT = 3.0
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


@dataclass(frozen=True, slots=True)
class _Probe:
    """A probe: when, what it showed beyond the free run and beyond the correction, and what of each state it shows."""

    minutes: float
    deviation_um: float
    innovation_um: float
    std_um: float
    contributions_um: tuple[float, ...]
    feature: str


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
        self._refused: list[_Probe] = []
        self._probes = 0
        self._minutes = 0.0
        self._waiting = 0.0
        self._bank = self._new_bank()
        # The bank that takes a probe for a wrong one, and the probability that it was.
        self._without: FilterBank | None = None
        self._doubt = 0.0
        self._mix()

    def _new_bank(self) -> FilterBank:
        stds = [DTF_GAIN_STD if name == "DTF" else GAIN_STD for name in self.names]
        return FilterBank(stds, [GAIN_WALK * std for std in stds])

    @property
    def is_probed(self) -> bool:
        """Whether a probe was taken since the zero."""
        return self._probes > 0

    @property
    def doubt(self) -> float:
        """Probability that the probe on probation, which the correction is partly made of, was wrong."""
        return self._doubt if self._without is not None else 0.0

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
        total = self._mean[0]
        for gain, share in zip(self._mean[1:], contributions_um, strict=True):
            total += gain * share
        return total

    def doubted_um(self, contributions_um: Sequence[float]) -> float:
        """Return the part of `std_um` that the doubt of the probe on probation adds, µm; 0 where none is."""
        if len(self._means) == 1:
            return 0.0
        right, wrong = self._means
        apart = right[0] - wrong[0]
        for one, other, share in zip(right[1:], wrong[1:], contributions_um, strict=True):
            apart += (one - other) * share
        return math.sqrt(self._doubt * (1.0 - self._doubt)) * abs(apart)

    def std_um(self, contributions_um: Sequence[float]) -> float:
        """Return the standard deviation of the corrected deformation, µm: what the probes leave unknown.

        It takes the place of the model's own error; noise of the temperatures is not included. 0 before the first
        probe was taken.
        """
        if not self.active:
            return 0.0
        h = (1.0, *contributions_um)
        variance = 0.0
        for i, row in enumerate(self._covariance):
            part = 0.0
            for j in range(i):
                part += row[j] * h[j]
            variance += h[i] * (2.0 * part + h[i] * (row[i] + self._waiting * self._growth[i]))
        return math.sqrt(max(variance, 0.0))

    def growth_um2_per_min(self, contributions_um: Sequence[float]) -> float:
        """Return by how much the square of `std_um` grows in a minute without probes, as the states walk, µm²."""
        if not self.active:
            return 0.0
        total = 0.0
        for growth, share in zip(self._growth, (1.0, *contributions_um), strict=True):
            total += growth * share * share
        return total

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
        self._advance()
        h = self._row(contributions_um, feature)
        deviation = y_um - predicted_um
        innovation, variance = self._innovation(h, deviation, std_um)
        probe = _Probe(self._minutes, deviation, innovation, std_um, tuple(contributions_um), feature)
        doubt = self._doubt
        self._reconsider(probe)
        reason = None
        weighing = self._weigh(self._bank, probe)
        agreeing = self._agreeing(probe)
        if len(agreeing) + 1 >= min(AGREEING, self._probes + 2):
            reason = BELIEVED
            self._believe(agreeing, probe)
            weighing = self._weigh(self._bank, probe)
        elif weighing.right < 0.5:
            for bank in self._banks():
                bank.weights = self._weigh(bank, probe).weights
            self._doubt = doubt  # A refused probe moves nothing.
            self._refused = [*self._refused[1 - REFUSED_KEPT :], probe]
            if not self.is_probed:  # The first feature is the first of which a probe is taken.
                self._features.clear()
            self._mix()
            return ProbeVerdict(False, OUTLIER, innovation, math.sqrt(variance))
        self._accept(probe, 1.0 - weighing.right)
        return ProbeVerdict(True, reason, innovation, math.sqrt(variance))

    def _expect(self, contributions_um: Sequence[float]) -> None:
        if len(contributions_um) != len(self.names):
            raise ValueError(f"{len(contributions_um)} contributions, expected one for each of {list(self.names)}")

    def _advance(self) -> None:
        """Let the states walk for the time since they were last used."""
        for bank in self._banks():
            bank.advance(self._waiting)
        self._waiting = 0.0

    def _banks(self) -> list[FilterBank]:
        return [self._bank, *([self._without] if self._without is not None else [])]

    def _row(self, contributions_um: Sequence[float], feature: str) -> list[float]:
        """Return what of each state a probe shows; a feature that is new gets a zero of its own."""
        if feature not in self._features:
            if self._features:  # The zero of the first feature is in the offset.
                for bank in self._banks():
                    bank.add_zero()
            self._features.append(feature)
        return [1.0, *contributions_um, *(1.0 if name == feature else 0.0 for name in self._features[1:])]

    def _expected(self, bank: FilterBank, probe: _Probe) -> Expected:
        h = self._row(probe.contributions_um, probe.feature)
        return bank.expected(h, probe.deviation_um, probe.std_um, self._minutes - probe.minutes)

    def _weigh(self, bank: FilterBank, probe: _Probe) -> Weighing:
        return bank.weigh(self._expected(bank, probe))

    def _innovation(self, h: Sequence[float], deviation_um: float, std_um: float) -> tuple[float, float]:
        """Return the innovation of both banks together, µm, and its variance, µm²."""
        found = [bank.innovation(bank.expected(h, deviation_um, std_um)) for bank in self._banks()]
        both = mixed([Mixture([mean], [[variance]], [0.0]) for mean, variance in found], self._probabilities())
        return both.mean[0], both.covariance[0][0]

    def _reconsider(self, probe: _Probe) -> None:
        """Let the bank that takes the probe on probation for a wrong one take over where this one makes it probable."""
        if self._without is None:
            return
        undone = self._weigh(self._without, probe)
        doubt = self._doubt * undone.density
        belief = (1.0 - self._doubt) * self._weigh(self._bank, probe).density
        if doubt >= belief and undone.right < 0.5:
            return  # Wrong for both banks: it will be refused, and a refused probe moves nothing.
        self._doubt = doubt / (doubt + belief)
        if self._doubt > 0.5:
            self._bank, self._without, self._doubt = self._without, self._bank, 1.0 - self._doubt

    def _accept(self, probe: _Probe, doubt: float) -> None:
        """Correct by a probe; it goes on probation where it is more doubtful than the one that is."""
        if self._without is None or self._doubt < doubt:
            self._without, self._doubt = self._bank.copy(), doubt
            self._without.correct_by_wrong(
                self._expected(self._without, replace(probe, std_um=math.hypot(probe.std_um, WRONG_UM)))
            )
        else:
            self._without.correct(self._expected(self._without, probe))
        self._bank.correct(self._expected(self._bank, probe))
        self._refused = []
        self._probes += 1
        self.active = True
        self._mix()

    def _mix(self) -> None:
        """Keep mean, covariance and growth of both banks together, so that a sample costs little."""
        states = 1 + len(self.names)
        found = [bank.mixture(states, zeroed=not self.is_probed) for bank in self._banks()]
        self._means = [each.mean for each in found]
        self._mean, self._covariance, self._growth = mixed(found, self._probabilities())

    def _probabilities(self) -> list[float]:
        return [1.0] if self._without is None else [1.0 - self._doubt, self._doubt]

    # ------------------------------------------------------------------ probes that do not fit

    def _agreeing(self, probe: _Probe) -> list[_Probe]:
        """Return the refused probes that agree with this one."""
        found = []
        for other in self._refused:
            apart = self._minutes - other.minutes
            variance = probe.std_um**2 + other.std_um**2 + apart * self._growth[0]
            shares = zip(probe.contributions_um, other.contributions_um, strict=True)
            for i, (now, then) in enumerate(shares, start=1):
                variance += self._covariance[i][i] * (now - then) ** 2
            differ = probe.innovation_um - other.innovation_um
            if apart <= AGREEING_WITHIN_MIN and differ**2 <= AGREEMENT**2 * variance:
                found.append(other)
        return found

    def _believe(self, agreeing: Sequence[_Probe], probe: _Probe) -> None:
        """Widen what may have moved, and correct by the refused probes.

        Where one further feature alone shows it, that feature may have moved as well as the machine: its zero is
        unknown again, the offset stays, and its deviation says so.
        """
        features = {one.feature for one in (*agreeing, probe)}
        alone = len(features) == 1 and probe.feature != self._features[0]
        zero = len(self.names) + self._features.index(probe.feature) if alone else None
        self._without = None
        self._bank.widen(probe.innovation_um, zero)
        for earlier in agreeing:
            self._bank.correct(self._expected(self._bank, earlier))

    # ------------------------------------------------------------------ state, another model

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
            "bank": self._bank.to_dict(),
            "without": self._without.to_dict() if self._without is not None else None,
            "doubt": self._doubt,
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
            found._refused = [
                _Probe(**{**probe, "contributions_um": tuple(map(float, probe["contributions_um"]))})
                for probe in state["refused"]
            ]
            found._probes, found._doubt = int(state["probes"]), float(state["doubt"])
            found._minutes, found._waiting = float(state["minutes"]), float(state["waiting_min"])
            for _ in found._features[1:]:
                found._bank.add_zero()
            if state["without"] is not None:
                found._without = found._bank.copy()
                found._without.restore(state["without"])
            found._bank.restore(state["bank"])
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"state of the probes: {error!r}") from error
        found._mix()
        return found

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
        found, states = ProbeCorrection(self.names), 1 + len(self.names)
        found.active, found._doubt = self.active, self._doubt
        since = np.eye(states)
        since[0, 1:] = [-share for share in contributions_um]

        def zeroed(before: FilterBank) -> FilterBank:
            bank, gains = found._new_bank(), slice(1, states)
            bank.x[:, gains], bank.P[:, gains, gains] = before.x[:, gains], before.P[:, gains, gains]
            if self.active:
                bank.x, bank.P = transformed(since, bank.x, bank.P)
            bank.weights = before.weights_of_walks()
            bank.mean_weights = list(bank.weights)
            return bank

        found._bank, found._without = self._each_bank(zeroed)
        found._mix()
        return found

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
        found._features, found._doubt = list(self._features), self._doubt
        found._bank, found._without = self._each_bank(
            lambda before: found._taking_over(before, contributions_um, new_contributions_um, change_um)
        )
        found._mix()
        return found

    def _each_bank(self, changed: Callable[[FilterBank], FilterBank]) -> tuple[FilterBank, FilterBank | None]:
        """Return both banks, as they are now, changed."""
        found = []
        for bank in self._banks():
            now = bank.copy()
            now.advance(self._waiting)
            found.append(changed(now))
        return found[0], found[1] if len(found) > 1 else None

    def _taking_over(
        self,
        before: FilterBank,
        contributions_um: Sequence[float],
        new_contributions_um: Sequence[float],
        change_um: float,
    ) -> FilterBank:
        """Return a bank with these names for one of another model."""
        bank, old, new = self._new_bank(), 1 + len(contributions_um), 1 + len(self.names)
        zeros = len(self._features) - 1 if self._features else 0
        # The old model's states, reduced to the correction as it is now and the zeros.
        reduced = np.zeros((1 + zeros, old + zeros))
        reduced[0, :old] = [1.0, *contributions_um]
        reduced[np.arange(1, 1 + zeros), np.arange(old, old + zeros)] = 1.0
        x, p = transformed(reduced, before.x, before.P)
        # The new offset is that correction, less the change of the free run, less what the new gains add now.
        for _ in range(zeros):
            bank.add_zero()
        kept = [0, *range(new, new + zeros)]
        bank.x[:, kept] = x
        bank.x[:, 0] -= change_um
        bank.P[np.ix_(range(SIZE), kept, kept)] = p
        offset = np.eye(new + zeros)
        offset[0, 1:new] = [-share for share in new_contributions_um]
        bank.x, bank.P = transformed(offset, bank.x, bank.P)
        bank.weights, bank.mean_weights = list(before.weights), list(before.mean_weights)
        return bank
