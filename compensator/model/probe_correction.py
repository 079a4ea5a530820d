"""What probes of Y show about a model: an offset and slow relative gains, in a bank of Kalman filters.

With the shares c of the paths and effects in the deformation, a probe of feature f measures

    y − y_free = offset + Σ gain_i · c_i + zero_f + noise

The offset and the gains walk. How fast the offset walks is not known: one filter for each of `WALKS_UM`, weighted by
how well it predicted the probes. Only +, −, ·, / and square roots in a fixed order: the same probes give the same
bits on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from compensator.arrays import Matrix, Vector

#: Walks of the offset, one for each filter, µm/√min.
WALKS_UM = (0.02, 0.042, 0.087, 0.18, 0.38, 0.8)
#: Standard deviation of a relative gain before the first probe: of the DTF, of all others.
DTF_GAIN_STD, GAIN_STD = 0.15, 0.3
#: Walk of a relative gain, part of its standard deviation, 1/√min.
GAIN_WALK = 0.0033
#: Standard deviation of a zero that nothing has shown yet, µm: a first value sets it, whatever it is.
ZERO_STD_UM = 1000.0
#: A probe further off than this many standard deviations of its innovation is refused.
GATE = 4.0
#: So many refused probes that agree are believed; two where a single probe has been taken.
AGREEING = 3
#: Refused probes that lie further apart than this do not support each other, min.
AGREEING_WITHIN_MIN = 720.0
#: Two refused probes agree within this many standard deviations of their difference.
AGREEMENT = 3.0
#: Share of the weights that is spread evenly at each probe, so that a walk that changes is found.
FORGETTING = 0.02
#: Degrees of freedom of the t distribution that weighs the filters; odd, so that no power but whole ones is needed.
_FREEDOM = 7

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
        `probe_outlier` where it was refused; `probe_believed` where it was taken together with refused ones that
        agree with it.
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
class _Refused:
    """A refused probe: what it showed beyond the free run, and when."""

    minutes: float
    deviation_um: float
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
    >>> found.update(13.0, 1.5, 10.0, [10.0, 0.0]).taken
    True
    >>> round(found.correction_um([10.0, 0.0]), 2)
    3.0
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.active = False
        self._features: list[str] = []
        self._refused: list[_Refused] = []
        self._probes = 0
        self._minutes = 0.0
        self._waiting = 0.0
        prior = np.array([ZERO_STD_UM, *(DTF_GAIN_STD if name == "DTF" else GAIN_STD for name in self.names)])
        self._weights = [1.0 / len(WALKS_UM)] * len(WALKS_UM)
        self._x: Matrix = np.zeros((len(WALKS_UM), prior.size))
        self._P: Matrix = np.zeros((len(WALKS_UM), prior.size, prior.size))
        self._P[:, np.arange(prior.size), np.arange(prior.size)] = prior**2
        self._walks = np.tile((GAIN_WALK * prior) ** 2, (len(WALKS_UM), 1))
        self._walks[:, 0] = np.array(WALKS_UM) ** 2
        self._mix()

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
        """Return what is to be added to the deformation of the free run, µm; 0 before the first probe."""
        if not self.active:
            return 0.0
        total = self._mean[0]
        for gain, share in zip(self._mean[1:], contributions_um, strict=False):
            total += gain * share
        return total

    def std_um(self, contributions_um: Sequence[float]) -> float:
        """Return the standard deviation of the corrected deformation, µm: what the probes leave unknown.

        Noise of the temperatures is not included; 0 before the first probe.
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
        probe = _Refused(self._minutes, y_um - predicted_um, std_um, tuple(contributions_um), feature)
        self._absorb_time()
        h = self._row(probe)
        innovation, variance = self._innovation(h, probe)
        std = math.sqrt(variance)
        reason = None
        if abs(innovation) > GATE * std:
            agreeing = self._agreeing(probe)
            if len(agreeing) < min(AGREEING, self._probes + 1):
                self._refused = [*self._refused, probe]
                self._mix()
                return ProbeVerdict(False, OUTLIER, innovation, std)
            reason = BELIEVED
            self._widen(innovation)
            for earlier in agreeing[:-1]:
                self._correct(self._row(earlier), earlier)
        self._correct(h, probe)
        self._refused = []
        self._probes += 1
        self.active = True
        self._mix()
        return ProbeVerdict(True, reason, innovation, std)

    def _expect(self, contributions_um: Sequence[float]) -> None:
        if len(contributions_um) != len(self.names):
            raise ValueError(f"{len(contributions_um)} contributions, expected one for each of {list(self.names)}")

    def _absorb_time(self) -> None:
        """Let the covariances grow by the time since they were last used."""
        states = np.arange(self._walks.shape[1])
        self._P[:, states, states] += self._waiting * self._walks
        self._waiting = 0.0

    def _row(self, probe: _Refused) -> list[float]:
        """Return what of each state the probe shows; a feature that is new gets a zero of its own."""
        if probe.feature not in self._features:
            if self._features:  # The zero of the first feature is in the offset.
                n = self._x.shape[1]
                self._x = np.pad(self._x, ((0, 0), (0, 1)))
                self._P = np.pad(self._P, ((0, 0), (0, 1), (0, 1)))
                self._P[:, n, n] = ZERO_STD_UM**2
                self._walks = np.pad(self._walks, ((0, 0), (0, 1)))
            self._features.append(probe.feature)
        zeros = [1.0 if name == probe.feature else 0.0 for name in self._features[1:]]
        return [1.0, *probe.contributions_um, *zeros]

    def _expected(self, h: list[float], probe: _Refused) -> tuple[Vector, Vector, Matrix]:
        """Return for each filter: innovation, its variance, and the covariance of the states with it."""
        innovation = np.full(len(WALKS_UM), probe.deviation_um)
        column = np.zeros_like(self._x)
        for i, weight in enumerate(h):
            innovation = innovation - weight * self._x[:, i]
            column = column + weight * self._P[:, :, i]
        # A refused probe that is believed later was measured when the offset had not yet walked as far.
        variance = probe.std_um**2 + (self._minutes - probe.minutes) * self._walks[:, 0]
        for i, weight in enumerate(h):
            variance = variance + weight * column[:, i]
        return innovation, variance, column

    def _innovation(self, h: list[float], probe: _Refused) -> tuple[float, float]:
        """Return the innovation of the whole bank and its variance."""
        each, variances, _ = self._expected(h, probe)
        return _mixed(self._weights, each.tolist(), variances.tolist())

    def _correct(self, h: list[float], probe: _Refused) -> None:
        innovation, variance, column = self._expected(h, probe)
        gain = column / variance[:, None]
        self._x = self._x + gain * innovation[:, None]
        self._P = self._P - gain[:, :, None] * column[:, None, :]
        self._P = 0.5 * (self._P + self._P.transpose(0, 2, 1))
        self._weights = _weighted(self._weights, innovation.tolist(), variance.tolist())

    # ------------------------------------------------------------------ probes that do not fit

    def _agreeing(self, probe: _Refused) -> list[_Refused]:
        """Return the refused probes that agree with this one, and it."""
        gains = [row[i] for i, row in enumerate(self._covariance)][1:]
        found = []
        for other in self._refused:
            apart = self._minutes - other.minutes
            variance = probe.std_um**2 + other.std_um**2 + apart * self._growth[0]
            for gain, now, then in zip(gains, probe.contributions_um, other.contributions_um, strict=False):
                variance += gain * (now - then) ** 2
            differ = probe.deviation_um - other.deviation_um
            same = other.feature == probe.feature
            if same and apart <= AGREEING_WITHIN_MIN and differ**2 <= AGREEMENT**2 * variance:
                found.append(other)
        return [*found, probe]

    def _widen(self, jump_um: float) -> None:
        """Admit that the offset may have moved by this much, and that its walk is not known any more."""
        self._P[:, 0, 0] += jump_um**2
        self._weights = [1.0 / len(WALKS_UM)] * len(WALKS_UM)

    # ------------------------------------------------------------------ the mixture

    def _mix(self) -> None:
        """Keep mean, covariance and growth of the whole bank, so that a sample costs little."""
        n = 1 + len(self.names)
        x, p, walks = self._x.tolist(), self._P.tolist(), self._walks.tolist()
        bank = range(len(WALKS_UM))

        def mean(values: Sequence[float]) -> float:
            total = 0.0
            for weight, value in zip(self._weights, values, strict=True):
                total += weight * value
            return total

        self._mean = [mean([x[k][i] for k in bank]) for i in range(n)]
        self._growth = [mean([walks[k][i] for k in bank]) for i in range(n)]
        self._covariance = [
            [
                mean([p[k][i][j] + (x[k][i] - self._mean[i]) * (x[k][j] - self._mean[j]) for k in bank])
                for j in range(i + 1)
            ]
            for i in range(n)
        ]

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
            "weights": list(self._weights),
            "states": self._x.tolist(),
            "covariances": self._P.tolist(),
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
            found = cls(state["names"])
            found.active = bool(state["active"])
            found._features = [str(name) for name in state["features"]]
            found._refused = [
                _Refused(**{**probe, "contributions_um": tuple(probe["contributions_um"])})
                for probe in state["refused"]
            ]
            found._probes = int(state["probes"])
            found._minutes, found._waiting = float(state["minutes"]), float(state["waiting_min"])
            found._weights = [float(weight) for weight in state["weights"]]
            found._x = np.array(state["states"], dtype=float)
            found._P = np.array(state["covariances"], dtype=float)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"state of the probes: {error}") from error
        size = 1 + len(found.names) + max(len(found._features) - 1, 0)
        bank = len(WALKS_UM)
        if found._x.shape != (bank, size) or found._P.shape != (bank, size, size) or len(found._weights) != bank:
            raise ValueError(f"state of the probes of shape {found._x.shape}, expected {(bank, size)}")
        found._walks = np.pad(found._walks, ((0, 0), (0, size - found._walks.shape[1])))
        found._mix()
        return found

    def at_zero(self) -> ProbeCorrection:
        """Return the correction after a zero: the gains stay, the offset and the zeros of the features start anew."""
        self._absorb_time()
        found, gains = ProbeCorrection(self.names), slice(1, 1 + len(self.names))
        found._weights = list(self._weights)
        found._x[:, gains] = self._x[:, gains]
        found._P[:, gains, gains] = self._P[:, gains, gains]
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
        their part is in the offset of this moment.

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
        self._absorb_time()
        old, new = 1 + len(self.names), 1 + len(found.names)
        found.active, found._probes, found._minutes = True, self._probes, self._minutes
        found._features, found._weights = list(self._features), list(self._weights)
        zeros = self._x.shape[1] - old
        # States of the old model, reduced to the corrected deformation and the zeros: T x with covariance T P T'.
        reduced = np.zeros((1 + zeros, self._x.shape[1]))
        reduced[0, :old] = [1.0, *contributions_um]
        reduced[np.arange(1, 1 + zeros), np.arange(old, old + zeros)] = 1.0
        x, p = _transformed(reduced, self._x, self._P)
        # Offset of the new model = total − change − Σ gain_i · c_i, with gains that are not known yet.
        size = new + zeros
        found._x = np.zeros((len(WALKS_UM), size))
        wide = np.zeros((len(WALKS_UM), size, size))
        wide[:, :new, :new] = found._P
        kept = [0, *range(new, size)]
        found._x[:, kept] = x
        found._x[:, 0] -= change_um
        wide[np.ix_(range(len(WALKS_UM)), kept, kept)] = p
        back = np.eye(size)
        back[0, 1:new] = [-share for share in new_contributions_um]
        _, found._P = _transformed(back, found._x, wide)
        found._walks = np.pad(found._walks, ((0, 0), (0, zeros)))
        found._mix()
        return found


def _transformed(matrix: Matrix, x: Matrix, p: Matrix) -> tuple[Matrix, Matrix]:
    """Return T x and T P T' for each filter, summed in a fixed order."""

    def times(right: Matrix) -> Matrix:
        total = np.zeros((right.shape[0], matrix.shape[0], *right.shape[2:]))
        for j in range(matrix.shape[1]):
            total = total + np.multiply.outer(matrix[:, j], right[:, j]).swapaxes(0, 1)
        return total

    return times(x), times(times(p).transpose(0, 2, 1))


def _mixed(weights: Sequence[float], means: Sequence[float], variances: Sequence[float]) -> tuple[float, float]:
    """Return mean and variance of a mixture."""
    mean = 0.0
    for weight, value in zip(weights, means, strict=True):
        mean += weight * value
    variance = 0.0
    for weight, value, own in zip(weights, means, variances, strict=True):
        variance += weight * (own + (value - mean) ** 2)
    return mean, variance


def _weighted(weights: Sequence[float], innovations: Sequence[float], variances: Sequence[float]) -> list[float]:
    """Return the weights after a probe, by the density of a t distribution, of which a share is spread evenly."""
    found = []
    for weight, innovation, variance in zip(weights, innovations, variances, strict=True):
        tail = 1.0 + innovation * innovation / (_FREEDOM * variance)
        found.append(weight / (math.sqrt(variance) * tail * tail * tail * tail))
    total = 0.0
    for value in found:
        total += value
    return [(1.0 - FORGETTING) * value / total + FORGETTING / len(found) for value in found]
