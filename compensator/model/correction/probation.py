"""The most doubtful probe that was taken: one bank takes it for right, another one for wrong, until later ones decide.

Until then the estimate is the mean of both, weighted by their probabilities, and its covariance includes how far they
lie apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from compensator.model.correction.kalman_bank import KalmanBank, Observation, Weighing
from compensator.model.correction.mixture import Mixture, mixed


class Probation:
    """What all probes have shown, with the most doubtful one on probation.

    Parameters
    ----------
    bank : KalmanBank
        Before any probe.
    """

    def __init__(self, bank: KalmanBank) -> None:
        self._bank = bank
        # The bank that takes the probe on probation for a wrong one, and the probability that it was.
        self._without: KalmanBank | None = None
        self._doubt = 0.0

    @property
    def doubt(self) -> float:
        """Probability that the probe on probation was wrong; 0 where none is."""
        return self._doubt if self._without is not None else 0.0

    @property
    def probabilities(self) -> list[float]:
        """Probability of each of the mixtures."""
        return [1.0] if self._without is None else [1.0 - self._doubt, self._doubt]

    def mixtures(self, n: int, *, zeroed: bool) -> list[Mixture]:
        """Return what each bank knows of the first `n` states; see `KalmanBank.mixture`."""
        return [bank.mixture(n, zeroed=zeroed) for bank in self._banks()]

    def add_zero(self) -> None:
        """Add the zero of a further feature."""
        for bank in self._banks():
            bank.add_zero()

    def advance(self, minutes: float) -> None:
        """Let the states walk for a time, min."""
        for bank in self._banks():
            bank.advance(minutes)

    # ------------------------------------------------------------------ a probe

    def innovation(self, probe: Observation) -> tuple[float, float]:
        """Return the innovation of both banks together, µm, and its variance, µm²."""
        found = [bank.innovation(probe) for bank in self._banks()]
        both = mixed([Mixture([mean], [[variance]], [0.0]) for mean, variance in found], self.probabilities)
        return both.mean[0], both.covariance[0][0]

    def weigh(self, probe: Observation) -> Weighing:
        """Return what the more probable bank says of a probe; see `KalmanBank.weigh`."""
        return self._bank.weigh(probe)

    def reconsider(self, probe: Observation) -> None:
        """Let the bank that takes the probe on probation for a wrong one take over where this one makes it probable."""
        if self._without is None:
            return
        undone = self._without.weigh(probe)
        doubt = self._doubt * undone.density
        belief = (1.0 - self._doubt) * self._bank.weigh(probe).density
        if doubt >= belief and undone.right < 0.5:
            return  # Wrong for both banks: it will be refused, and a refused probe moves nothing.
        self._doubt = doubt / (doubt + belief)
        if self._doubt > 0.5:
            self._bank, self._without, self._doubt = self._without, self._bank, 1.0 - self._doubt

    def accept(self, probe: Observation, doubt: float) -> None:
        """Correct by a probe; it goes on probation where it is more doubtful than the one that is.

        Parameters
        ----------
        probe : Observation
            The probe.
        doubt : float
            Probability that it is wrong.
        """
        if self._without is None or self._doubt < doubt:
            self._without, self._doubt = self._bank.copy(), doubt
            self._without.correct_by_wrong(probe)
        else:
            self._without.correct(probe)
        self._bank.correct(probe)

    def refuse(self, probe: Observation, doubt: float) -> None:
        """Let a refused probe weigh the walks and move nothing.

        Parameters
        ----------
        probe : Observation
            The probe.
        doubt : float
            The doubt before it was reconsidered.
        """
        for bank in self._banks():
            bank.weights = bank.weigh(probe).weights
        self._doubt = doubt

    def widen(self, jump_um: float, zero: int | None) -> None:
        """Admit that the offset may have moved, and end the probation; see `KalmanBank.widen`."""
        self._without = None
        self._bank.widen(jump_um, zero)

    def correct(self, probe: Observation) -> None:
        """Correct by an earlier probe that is believed now."""
        self._bank.correct(probe)

    def _banks(self) -> list[KalmanBank]:
        return [self._bank, *([self._without] if self._without is not None else [])]

    # ------------------------------------------------------------------ state

    def changed(self, minutes: float, change: Callable[[KalmanBank], KalmanBank]) -> Probation:
        """Return the same with other banks.

        Parameters
        ----------
        minutes : float
            For how long the states have walked since they were last used, min.
        change : callable
            Returns the bank that takes the place of one, which may be changed.
        """
        found = []
        for bank in self._banks():
            now = bank.copy()
            now.advance(minutes)
            found.append(change(now))
        result = Probation(found[0])
        result._without, result._doubt = found[1] if len(found) > 1 else None, self._doubt
        return result

    def to_dict(self) -> dict[str, Any]:
        """Return the state, for JSON."""
        return {
            "bank": self._bank.to_dict(),
            "without": self._without.to_dict() if self._without is not None else None,
            "doubt": self._doubt,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from what `to_dict` returned, with the same states.

        Raises
        ------
        KeyError, TypeError, ValueError
            If it is not what `to_dict` returns.
        """
        self._doubt = float(state["doubt"])
        if state["without"] is not None:
            self._without = self._bank.copy()
            self._without.restore(state["without"])
        self._bank.restore(state["bank"])
