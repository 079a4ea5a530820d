"""Plausibility of T_Q, AT and measured Y: exchanged sensors, sensors that drifted apart, a residual that is too large.

Three checks, each on only if the configuration has its limit:

- *exchanged*: T_Q is below AT by more than `guards.t_q_below_at_max_k` for longer than `t_q_below_at_after_min`.
  Without heat both are equal, so exchanged wires show only once the machine heats up; by then the offset has the wrong
  sign. The state is `fault`, latched until `resume` or a zero at rest.
- *at rest*: while a channel shows that nothing heats the machine, T_Q − AT must return to its value at the zero. The
  reason remains until a later rest clears it.
- *residual*: measured − predicted Y against its stated standard deviation, by a two-sided CUSUM on its innovations.
  Model errors are correlated over `residual_correlation_min`, so only what the previous block does not predict counts:
  e = z − φ z'. The threshold follows from the mean time between false alarms, by Siegmund's formula. `isolation` finds
  the sensor that explains the residual best; with `sensor_must_fit` only the model is suspected where no sensor's fault
  explains most of it. The offset continues; its standard deviation includes the residual.

The checks use only the sample and no clock; their state is part of the compensation's.

Source: Page (1954) for the CUSUM; Siegmund, Sequential Analysis (1985), for its mean time between false alarms;
Basseville and Nikiforov (1993), chapter 8, for whitening first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec

from compensator.arrays import NAN
from compensator.codes import Reason
from compensator.config import Config, Plausibility
from compensator.events import EventKind, Implausibility, Note
from compensator.model.thermal_model import ThermalModel
from compensator.service.plausibility.isolation import LEAST_SHARE, LOG_ODDS, FaultFit, FaultIsolation, ResidualBlock

#: Samples in a block of the residual: single minutes after a heat step are not evidence against a sensor.
BLOCK_SAMPLES = 10
#: Fraction of a block that must be usable.
_USABLE = 0.5
#: Number of blocks used for fault isolation, 720 samples.
WINDOW = 72
#: Shift, in standard deviations of the residual, that the CUSUM is designed for.
_SHIFT = 5.0
#: An innovation is clipped at this many of its standard deviations: a few minutes of outliers raise no alarm.
_CLIP = 3.0
#: The alarm ends after this number of consecutive blocks within this number of standard deviations.
QUIET_BLOCKS = 6
_QUIET = 2.0
#: Exchanged sensors are right again after this number of consecutive blocks whose residual is within this share of the
#: prediction, which is this many deviations: exchanged ones predict the contrary, and at rest Y says nothing of them.
_RIGHT_BLOCKS, _RIGHT_SHARE, _MOVED = 2, 0.2, 10.0
#: Mean excess of a Gaussian random walk over a boundary, in its standard deviations (Siegmund).
_EXCESS = 1.166
_DAY_MIN = 1440.0
#: A sample without the channel that shows rest takes so many others of the rest that is wanted: the machine may have
#: worked, but a line that loses one sample in twenty must not switch the check off.
_REST_UNKNOWN = 3.0


#: Names in the state file; states of earlier versions have them too.
_STORED = {"samples": "taken", "blocks_in_alarm": "accused", "quiet_blocks": "calm"}


class PlausibilityState(msgspec.Struct, kw_only=True, rename=_STORED):
    """State of the checks.

    Parameters
    ----------
    below_min : float
        Time for which T_Q has been below AT, min.
    exchanged : bool
        Whether that has lasted too long.
    rest_min : float
        Time for which nothing has heated the machine, min.
    apart : bool
        Whether T_Q − AT had not returned to its value at the last rest.
    samples, used : int
        Samples in the current block, and the usable ones among them.
    sums : tuple of three floats
        Residual, its variance and the prediction, summed over the usable ones.
    blocks : list of ResidualBlock
        The last blocks, the newest last.
    z : float
        Residual of the last usable block in standard deviations; NaN before the first.
    skipped : int
        Unusable blocks since then.
    high, low : float
        The two CUSUMs.
    suspects : list of str
        Likely causes of the alarm; empty without an alarm.
    blocks_in_alarm : int
        Blocks since the alarm.
    quiet_blocks : int
        Consecutive blocks since then whose residual is small again.
    """

    below_min: float = 0.0
    exchanged: bool = False
    rest_min: float = 0.0
    apart: bool = False
    samples: int = 0
    used: int = 0
    sums: tuple[float, float, float] = (0.0, 0.0, 0.0)
    blocks: list[ResidualBlock] = []
    z: float = NAN
    skipped: int = 0
    high: float = 0.0
    low: float = 0.0
    suspects: list[str] = []
    blocks_in_alarm: int = 0
    quiet_blocks: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorEvidence:
    """Input of the checks for one sample; NaN for values that cannot be used.

    Parameters
    ----------
    below_k : float
        AT − T_Q as measured, K, regardless of what each may read; NaN where one of them is wrong by itself.
    apart_k : float
        T_Q − AT as a change since the zero, K.
    rest : float
        Value of the channel that shows whether the machine is at rest.
    residual_um, std_um, predicted_um : float
        Measured − predicted, the prediction's stated standard deviation, and the prediction, µm.
    """

    below_k: float
    apart_k: float
    rest: float
    residual_um: float
    std_um: float
    predicted_um: float


class PlausibilityCheck:
    """The checks of one machine; without `[plausibility]` in the configuration nothing is checked."""

    def __init__(self, config: Config, model: ThermalModel) -> None:
        self._limits = config.plausibility or Plausibility()
        self._below_max_k = config.guards.t_q_below_at_max_k
        # Version 0.1.0 waited for a person after an exchange, and counted rest on over hours without its channel: an
        # audit of its recordings comes to the same states.
        self._watches_jumps = config.guards.suspect_jumps
        self._period_min = model.period_s / 60.0
        self._model_std_um = model.y_std_um
        measured = any(channel.name == "y_um" for channel in config.channel)
        self.residual_std_um = self._limits.residual_std_um or model.y_std_um
        self._watched = measured and self._limits.false_alarm_days is not None and self.residual_std_um > 0.0
        self._has_y = measured
        block_min = BLOCK_SAMPLES * self._period_min
        # No exp(): its last bit depends on the platform, and an audit must come to the same state.
        self._keep = 1.0 / (1.0 + block_min / self._limits.residual_correlation_min)
        #: Standard deviation of an innovation, the CUSUM's allowance, and its threshold.
        self._e_std = math.sqrt(1.0 - self._keep * self._keep)
        self._allowance = 0.5 * _SHIFT * (1.0 - self._keep)
        days = self._limits.false_alarm_days
        self.threshold = (
            cusum_threshold(self._allowance, self._e_std, days * _DAY_MIN / block_min) if days else math.inf
        )
        self._isolation = FaultIsolation(model, BLOCK_SAMPLES, WINDOW, self._keep)
        self.state = PlausibilityState()
        self._notes: list[Note] = []

    @property
    def is_on(self) -> bool:
        """Whether any check is on."""
        return self._watched or self._limits.t_q_below_at_after_min is not None or self._limits.rest is not None

    @property
    def watches_residual(self) -> bool:
        """Whether measured Y is compared with the prediction: not for a model that states no error, for example."""
        return self._watched

    def describe(self) -> str:
        """Describe which checks are on and off."""
        parts = []
        limits = self._limits
        parts.append(
            f"exchanged T_Q and AT after {limits.t_q_below_at_after_min:g} min"
            if limits.t_q_below_at_after_min is not None
            else "exchanged T_Q and AT off (no plausibility.t_q_below_at_after_min)"
        )
        parts.append(
            f"T_Q and AT at rest by {limits.rest.channel}"
            if limits.rest is not None
            else "T_Q and AT at rest off (no plausibility.rest)"
        )
        why = (
            "no plausibility.false_alarm_days"
            if limits.false_alarm_days is None
            else "Y is not measured"
            if not self._has_y
            else "the model states no error: plausibility.residual_std_um"
        )
        parts.append(
            f"residual of {self.residual_std_um:.2g} µm, one false alarm in {limits.false_alarm_days:g} days"
            if self._watched
            else f"residual off ({why})"
        )
        return "; ".join(parts)

    def update(self, evidence: SensorEvidence) -> list[Note]:
        """Check one sample; return its events."""
        self._notes = []
        self._check_exchanged(evidence.below_k)
        self._check_rest(evidence)
        if self._watched:
            self._check_residual(evidence)
        return self._notes

    @property
    def reasons(self) -> list[str]:
        """Current reasons; the offset continues with them."""
        apart: list[str] = [Reason.T_Q_AT_APART] if self.state.apart else []
        return apart + [f"{Reason.IMPLAUSIBLE}:{name}" for name in self.state.suspects]

    @property
    def exchanged(self) -> bool:
        """Whether T_Q and AT seem to be exchanged: no offset is reliable."""
        return self.state.exchanged

    @property
    def error_um(self) -> float:
        """Last residual, µm, during an alarm, else 0: the offset may be wrong by as much."""
        if not self.state.suspects:
            return 0.0
        return next((abs(b.residual_um) for b in reversed(self.state.blocks) if not math.isnan(b.residual_um)), 0.0)

    @property
    def too_large(self) -> bool:
        """Whether the residual exceeds `residual_hold_um`, so that the offset is held."""
        limit = self._limits.residual_hold_um
        return limit is not None and self.error_um > limit

    def reset(self, *, at_rest: bool) -> None:
        """Restart at a zero of measured and predicted Y, and at rest also of T_Q and AT."""
        old = self.state
        self.state = PlausibilityState(below_min=old.below_min, rest_min=old.rest_min)
        if not at_rest:
            self.state.exchanged, self.state.apart = old.exchanged, old.apart

    def acknowledge(self) -> None:
        """Clear the latch of exchanged sensors: an operator, or measured Y, has checked them."""
        self.state.exchanged, self.state.below_min = False, 0.0

    def pass_time(self, samples: int) -> None:
        """Account for samples that were not measured."""
        self.state.rest_min = 0.0
        if self._watches_jumps:
            # A restart of minutes hides no exchange; that of a night says nothing of the evening before.
            self.state.below_min = max(self.state.below_min - samples * self._period_min, 0.0)
        if self._watched:
            nothing = SensorEvidence(below_k=NAN, apart_k=NAN, rest=NAN, residual_um=NAN, std_um=NAN, predicted_um=NAN)
            for _ in range(min(samples, WINDOW * BLOCK_SAMPLES)):
                self._check_residual(nothing)

    def _check_exchanged(self, below_k: float) -> None:
        limit, state = self._limits.t_q_below_at_after_min, self.state
        if limit is None or math.isnan(below_k):
            return
        state.below_min = state.below_min + self._period_min if below_k > self._below_max_k else 0.0
        if state.below_min >= limit and not state.exchanged:
            state.exchanged = True
            self._note(
                Implausibility.EXCHANGED,
                f"T_Q has been more than {self._below_max_k:g} K below AT for {state.below_min:g} min, {below_k:.1f} K "
                f"now: exchanged wires or addresses, or a couple that has come off; suspects: T_Q, AT",
                below_k=below_k,
                minutes=state.below_min,
            )

    def _check_rest(self, evidence: SensorEvidence) -> None:
        rest, state = self._limits.rest, self.state
        if rest is None:
            return
        if math.isnan(evidence.rest):
            if self._watches_jumps:
                known_min = min(state.rest_min, rest.after_min)
                state.rest_min = max(known_min - _REST_UNKNOWN * self._period_min, 0.0)
            return
        state.rest_min = state.rest_min + self._period_min if evidence.rest <= rest.at_most else 0.0
        if state.rest_min < rest.after_min or math.isnan(evidence.apart_k):
            return
        apart = abs(evidence.apart_k) > rest.t_q_at_max_k
        if apart and not state.apart:
            self._note(
                Implausibility.APART,
                f"after {state.rest_min:g} min of rest T_Q and AT differ by {evidence.apart_k:+.2f} K more than at the "
                f"zero, expected within {rest.t_q_at_max_k:g} K; suspects: T_Q, AT, or a zero on a warm machine",
                apart_k=evidence.apart_k,
                minutes=state.rest_min,
            )
        elif state.apart and not apart:
            self._note(Implausibility.TOGETHER, "T_Q and AT have come together at rest")
        state.apart = apart

    def _check_residual(self, evidence: SensorEvidence) -> None:
        state = self.state
        state.samples += 1
        if not math.isnan(evidence.residual_um) and not math.isnan(evidence.std_um):
            residual, variance, predicted = state.sums
            extra = evidence.std_um * evidence.std_um - self._model_std_um * self._model_std_um
            state.sums = (
                residual + evidence.residual_um,
                variance + max(extra, 0.0) + self.residual_std_um * self.residual_std_um,
                predicted + evidence.predicted_um,
            )
            state.used += 1
        if state.samples < BLOCK_SAMPLES:
            return
        n, (residual, variance, predicted) = state.used, state.sums
        if n >= _USABLE * BLOCK_SAMPLES:
            block = ResidualBlock(residual / n, math.sqrt(variance / n), predicted / n)
        else:
            block = ResidualBlock(NAN, 1.0, NAN)
        state.samples, state.used, state.sums = 0, 0, (0.0, 0.0, 0.0)
        blocks = [*state.blocks[-WINDOW + 1 :], block]
        if state.suspects and state.blocks and all(math.isnan(one.residual_um) for one in blocks):
            # An alarm does not end because Y is missing: the last residual that was seen is the size of the error.
            blocks[0] = state.blocks[0]
        state.blocks = blocks
        self._update_cusum(block)

    def _update_cusum(self, block: ResidualBlock) -> None:
        state = self.state
        if math.isnan(block.residual_um):
            state.skipped += 1
            return
        z = block.residual_um / block.std_um
        # Measured and predicted Y are equal at the zero, which precedes the first block.
        keep = self._keep
        for _ in range(min(state.skipped, WINDOW)):
            keep *= self._keep
        before = 0.0 if math.isnan(state.z) else state.z
        e = (z - keep * before) / math.sqrt(1.0 - keep * keep) * self._e_std
        e = max(-_CLIP * self._e_std, min(_CLIP * self._e_std, e))
        state.high = max(0.0, state.high + e - self._allowance)
        state.low = max(0.0, state.low - e - self._allowance)
        state.z, state.skipped = z, 0
        self._end_exchange()
        if state.suspects:
            state.quiet_blocks = state.quiet_blocks + 1 if abs(z) < _QUIET else 0
            if state.quiet_blocks >= QUIET_BLOCKS:
                state.suspects, state.high, state.low, state.quiet_blocks, state.blocks_in_alarm = [], 0.0, 0.0, 0, 0
                self._note(Implausibility.RESIDUAL_OVER, "measured and predicted Y agree again")
                return
        if state.suspects or max(state.high, state.low) > self.threshold:
            self._isolate(block)

    def _end_exchange(self) -> None:
        """Believe that sensors are no longer exchanged once measured Y agrees with what they say of a warm machine."""
        state = self.state
        if not (state.exchanged and self._watches_jumps and state.below_min == 0.0):
            return
        last = state.blocks[-_RIGHT_BLOCKS:]
        if len(last) == _RIGHT_BLOCKS and all(
            abs(b.residual_um) / _RIGHT_SHARE < abs(b.predicted_um) > _MOVED * b.std_um for b in last
        ):
            self.acknowledge()
            self._note(Implausibility.TOGETHER, "measured Y agrees with T_Q and AT: they are not exchanged any more")

    def _isolate(self, block: ResidualBlock) -> None:
        """Find the likely causes; each further block may improve the result until the onset leaves the window."""
        self.state.blocks_in_alarm += 1
        if self.state.blocks_in_alarm > WINDOW // 2:
            return
        ranked, misfit = self._isolation.fits(self.state.blocks)
        named = [fit for fit in ranked if fit.gain >= ranked[0].gain - LOG_ODDS]
        if misfit and self._limits.sensor_must_fit:
            # The best of shapes that all fail names a sensor only if it explains most of the residual.
            named = [fit for fit in named if fit.suspect == "model" or fit.share >= LEAST_SHARE]
        suspects = sorted({fit.suspect for fit in named} | ({"model"} if misfit else set()))
        if suspects == self.state.suspects:
            return
        self.state.suspects = suspects
        self._note(
            Implausibility.RESIDUAL,
            self._describe_alarm(block, named, misfit),
            suspects=suspects,
            residual_um=block.residual_um,
            std_um=block.std_um,
        )

    def _describe_alarm(self, block: ResidualBlock, named: list[FaultFit], misfit: bool) -> str:
        words = [f"{fit.words} since {self._ago(fit)}" if fit.suspect != "model" else fit.words for fit in named]
        if misfit:
            # Version 0.1.0 recorded "none of this": an audit of its recordings compares the text.
            none = "none of this fits well" if words else "no fault of a sensor explains this"
            words.append(f"{none}: something acts that the model does not know")
        return (
            f"measured − predicted Y is {block.residual_um:+.2f} µm where ±{block.std_um:.2f} µm is stated: "
            + ", or ".join(words)
        )

    def _ago(self, fit: FaultFit) -> str:
        return f"{fit.blocks_ago * BLOCK_SAMPLES * self._period_min:g} min"

    def _note(self, code: Implausibility, text: str, **data: Any) -> None:
        # Version 0.1.0 recorded these texts without data: an audit of its recordings compares them.
        self._notes.append(Note(EventKind.PLAUSIBILITY, text, {"code": code, **data}))


def cusum_threshold(allowance: float, std: float, blocks: float) -> float:
    """Return the threshold that a two-sided CUSUM crosses by chance on average once in a number of blocks.

    Siegmund's approximation of the mean time of one side, with increments e − k, e ~ N(0, s²):
    ``(exp(2 Δ b) − 2 Δ b − 1) / (2 Δ²)``, Δ = k / s, b = h / s + 1.166; both sides together cross twice as often.

    Parameters
    ----------
    allowance, std : float
        k and s.
    blocks : float
        Mean time between two false alarms.

    Examples
    --------
    >>> round(cusum_threshold(0.5, 1.0, 465.0), 1)  # the textbook's: 4 at k = 1/2 gives 168, 5 gives 465
    5.0
    """
    delta = allowance / std

    def time(h: float) -> float:
        x = 2.0 * delta * (h / std + _EXCESS)
        return (math.exp(x) - x - 1.0) / (2.0 * delta * delta)

    low, high = 0.0, 60.0 * std / delta
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if time(middle) < 2.0 * blocks else (low, middle)
    return round(high, 6)
