"""Probes of one compensation: which of them can be used, the correction that they give, and when another is wanted.

    predicted deformation = model + correction,   deformation of a probe = measured − applied offset

The correction is limited to `probe.largest_um`. It goes on while the offset is held or a temperature is missing: what
is known stays known, and its standard deviation grows. No clock, socket or file, as in `compensation`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec

from compensator.arrays import NAN
from compensator.clock import NS
from compensator.codes import ProbeCode
from compensator.config import Config
from compensator.config import Probe as ProbeSettings
from compensator.errors import DataError
from compensator.events import EventKind, Note, ProbeData
from compensator.messages import Probe
from compensator.model.correction import ProbeCorrection
from compensator.service.probing.checks import check_probe
from compensator.service.probing.past import predicted_at
from compensator.service.probing.received import UNKNOWN_UM, ProbeRefused, ReceivedProbe, Verdict, recorded_probe
from compensator.service.probing.state import UNKNOWN_NS, KnownProbe, PastSample, ProbingState
from compensator.service.probing.wanted import Wanted, wanted_after

#: Samples that are kept beyond `probe.oldest_min`: a probe is compared with the one after it, and waits for a sample.
_MORE_SAMPLES = 4
#: Largest number of samples that are kept: they are a part of the state, which is encoded at each sample.
MOST_SAMPLES = 300
#: Largest number of compared probes that are kept to recognise duplicates.
_KNOWN = 100
#: Refusals after which no other probe is wanted: the same value is known already, or none can be used.
_NOT_ASKED = (ProbeCode.DUPLICATE, ProbeCode.TOO_MANY_FEATURES, ProbeCode.AXIS)


class Corrected(msgspec.Struct, frozen=True, kw_only=True):
    """What the probes add to the prediction of a sample; all zero before the first probe.

    Parameters
    ----------
    y_um, rate_um_per_min : float
        Correction of the deformation, and of its growth.
    std_um : float
        Standard deviation of the corrected deformation; NaN if no probe was taken.
    is_limited : bool
        Whether the correction has reached its limit.
    """

    y_um: float = 0.0
    rate_um_per_min: float = 0.0
    std_um: float = NAN
    is_limited: bool = False


@dataclass(frozen=True, slots=True)
class ProbingHandover:
    """State that the probes pass on to another model; without one nothing is known of what was published."""

    state: ProbingState | None = None


class Probing:
    """Probes of one compensation.

    Parameters
    ----------
    settings : config.Probe
        `[probe]`.
    names : sequence of str
        Paths and effects of the model (`Engine.contribution_names`).
    offset_max_um : float
        Largest offset, µm.
    period_s : float
        Length of a sample, s.
    """

    def __init__(self, settings: ProbeSettings, names: Sequence[str], *, offset_max_um: float, period_s: float) -> None:
        self._settings = settings
        self._names = tuple(names)
        self._offset_max_um = offset_max_um
        self._period_s = period_s
        self._kept = min(math.ceil(60.0 * settings.oldest_min / period_s), MOST_SAMPLES) + _MORE_SAMPLES
        self._correction = ProbeCorrection(names)
        self._state = ProbingState(correction={})

    @classmethod
    def of(cls, config: Config, names: Sequence[str], period_s: float) -> Probing | None:
        """Return the probes of a configuration; None without `[probe]`."""
        if config.probe is None:
            return None
        return cls(config.probe, names, offset_max_um=config.limits.offset_max_um, period_s=period_s)

    # ------------------------------------------------------------------ state

    @property
    def state(self) -> ProbingState:
        """Everything that determines what comes next."""
        return replace(self._state, correction=self._correction.to_dict())

    def restore(self, state: ProbingState) -> None:
        """Continue from a state, with the same bits.

        Raises
        ------
        DataError
            If it belongs to another model or cannot be used; nothing is changed then.
        """
        try:
            correction = ProbeCorrection.from_dict(state.correction)
        except ValueError as error:
            raise DataError(f"state: {error}") from error
        sizes = {len(sample.contributions_um) for sample in state.samples} | {len(correction.names)}
        numbers = [n for s in state.samples for n in (s.y_um, s.rate_um_per_min, s.noise_um, *s.contributions_um)]
        if not all(map(math.isfinite, numbers)):
            raise DataError("state: a number of the samples for probes is not finite")
        if correction.names != self._names or sizes != {len(self._names)}:
            raise DataError(f"state: probes of {list(correction.names)}, expected {list(self._names)}")
        self._correction, self._state = correction, state

    @property
    def handover(self) -> ProbingHandover:
        """State for a successor."""
        return ProbingHandover(self.state)

    def continue_from(self, handover: ProbingHandover) -> None:
        """Continue from the probes of another compensation, at the same sample.

        The samples are those that this one has predicted, with the offsets that the other one has published. What it
        has learned itself from the probes since the same zero stays: with that it was compared.
        """
        before = handover.state or ProbingState(correction={})
        own = {sample.time_ns: sample for sample in self._state.samples}
        common = [sample for sample in before.samples if sample.time_ns in own]
        has_learned = self._correction.active and 0 < self._state.zero_ns == before.zero_ns
        if not (common and common[-1] is before.samples[-1]):
            # The successor has no prediction yet, so there is nothing that the correction could be added to.
            self._correction = ProbeCorrection(self._names)
        elif not has_learned:
            # The gains of another model start anew: what they correct at this moment goes into the offset.
            then, now = common[-1], own[common[-1].time_ns]
            self._correction = ProbeCorrection.from_dict(before.correction).transferred(
                self._names, then.contributions_um, now.contributions_um, now.y_um - then.y_um
            )
        self._state = ProbingState(
            correction={},
            samples=[_as_published(own[sample.time_ns], sample) for sample in common],
            known=before.known,
            features=before.features if self._correction.active else [],
            zero_ns=before.zero_ns,
            refused=before.refused,
        )

    def set_zero(self, time_ns: int, contributions_um: Sequence[float] | None) -> None:
        """Forget what belongs to the previous zero; what the probes have shown about the gains stays.

        Parameters
        ----------
        time_ns : int
            Time of the zero, ns since 1970 UTC.
        contributions_um : sequence of float, optional
            Share of each path and effect at the zero; None if they are counted from it.
        """
        self._correction = self._correction.at_zero(contributions_um or [0.0] * len(self._names))
        self._state = ProbingState(correction={}, known=self._state.known, zero_ns=time_ns)

    def move_zero(self, before_um: Sequence[float], now_um: Sequence[float]) -> None:
        """Account for other shares of each path and effect at the zero: the engine's state was wrong then."""
        self._correction.move_zero([now - before for before, now in zip(before_um, now_um, strict=True)])

    def raise_level(self, um: float) -> None:
        """Raise what was predicted for the last samples by a constant, µm: probes of their time are still to come."""
        self._state.samples = [msgspec.structs.replace(sample, y_um=sample.y_um + um) for sample in self._state.samples]

    def pass_time(self, contributions_um: Sequence[float], minutes: float) -> None:
        """Advance over samples that were not measured."""
        self._correction.step(contributions_um, minutes)

    # ------------------------------------------------------------------ one sample

    def add(self, sample: PastSample) -> None:
        """Advance to a sample, before its offset is known."""
        if self._state.samples and sample.time_ns <= self._state.samples[-1].time_ns:
            # The clock was set back: which sample a time belongs to is not known any more.
            self._state.samples, self._state.zero_ns = [], min(self._state.zero_ns, UNKNOWN_NS)
            self._state.known = [known for known in self._state.known if known.time_ns < sample.time_ns]
        self._correction.step(sample.contributions_um, self._period_s / 60.0)
        self._state.samples = [*self._state.samples[1 - self._kept :], sample]

    def publish(self, offset_um: float, rate_um_per_min: float, *, is_held: bool) -> None:
        """Add the offset of the last sample."""
        last = self._state.samples[-1]
        self._state.samples[-1] = msgspec.structs.replace(
            last, offset_um=offset_um, offset_rate_um_per_min=rate_um_per_min, is_held=is_held
        )

    def corrected(self, contributions_um: Sequence[float], noise_um: float) -> Corrected:
        """Return what the probes add to the prediction after the last sample.

        Parameters
        ----------
        contributions_um : sequence of float
            Share of each path and effect.
        noise_um : float
            Standard deviation of the prediction that sensor noise and missing samples cause.
        """
        if not self._correction.active:
            return Corrected()
        correction, largest = self._correction, self._settings.largest_um
        whole_um = correction.correction_um(contributions_um)
        std_um = math.hypot(correction.std_um(contributions_um), noise_um)
        if abs(whole_um) > largest:
            y_um = math.copysign(largest, whole_um)
            return Corrected(y_um=y_um, std_um=math.hypot(std_um, whole_um - y_um), is_limited=True)
        rate = 0.0
        if len(self._state.samples) > 1:
            # As the paths have grown over the last sample: how they will grow over the next is not known here.
            before, last = self._state.samples[-2:]
            minutes = (last.time_ns - before.time_ns) / (60.0 * NS)
            rate = (whole_um - correction.correction_um(before.contributions_um)) / minutes
        return Corrected(y_um=whole_um, rate_um_per_min=rate, std_um=std_um)

    # ------------------------------------------------------------------ probes

    def check(self, probe: ReceivedProbe, waiting: Sequence[ReceivedProbe] = ()) -> None:
        """Check a probe against what was published, without comparing it with the prediction.

        Parameters
        ----------
        probe : ReceivedProbe
            The probe.
        waiting : sequence of ReceivedProbe
            Probes that wait for the next sample before it.

        Raises
        ------
        ProbeRefused
            If it cannot be used.
        """
        known = [*self._state.known, *(_known(earlier) for earlier in waiting)]
        check_probe(
            probe,
            replace(self._state, known=known) if waiting else self._state,
            self._settings,
            offset_max_um=self._offset_max_um,
            period_s=self._period_s,
            kept=self._kept,
        )

    def decide(self, machine: str, seq: int, probe: ReceivedProbe) -> tuple[Probe, Note, float]:
        """Decide a probe that arrived since the last sample.

        Returns
        -------
        Probe, Note, float
            Its record, its event, and what it shows beyond the prediction, µm: known also of a probe that was right but
            came while the offset was held, by which nothing is corrected; NaN if not known.
        """
        verdict = self._decide(probe)
        record = recorded_probe(machine, seq, probe, verdict)
        compared = not math.isnan(verdict.innovation_um)
        data = ProbeData(
            taken=record.taken,
            code=record.code,
            probe_utc_ns=record.time_utc_ns,
            feature=record.feature,
            innovation_um=record.innovation_um if compared else None,
            innovation_std_um=record.innovation_std_um if compared else None,
            by=record.by,
            by_proof=record.by_proof,
        )
        return record, Note(EventKind.PROBE, verdict.text, data.table()), verdict.shown_um

    def _decide(self, probe: ReceivedProbe) -> Verdict:
        try:
            self.check(probe)
        except ProbeRefused as refused:
            if refused.code not in _NOT_ASKED:
                self._state.refused = refused.code
            shown_um = NAN
            if refused.is_comparable:
                innovation_um, std_um = self._correction.innovation(*self._compared(probe))
                shown_um = innovation_um if std_um < UNKNOWN_UM else NAN
                self._remember(probe)
            return Verdict(taken=False, code=refused.code, text=str(refused), shown_um=shown_um)
        request = probe.request
        deformation_um, std_um, predicted_um, contributions_um, feature = self._compared(probe)
        found = self._correction.update(deformation_um, std_um, predicted_um, contributions_um, feature)
        self._remember(probe)
        if request.feature not in self._state.features:
            self._state.features = [*self._state.features, request.feature]
        self._state.refused = "" if found.taken else ProbeCode.OUTLIER
        return Verdict.of(found, deformation_um, predicted_um)

    def _remember(self, probe: ReceivedProbe) -> None:
        self._state.known = [*self._state.known[1 - _KNOWN :], _known(probe)]

    def _compared(self, probe: ReceivedProbe) -> tuple[float, float, float, tuple[float, ...], str]:
        """Return what the correction compares: deformation, its deviation, prediction with its shares, feature."""
        request = probe.request
        predicted = predicted_at(self._state.samples, request.time_utc_ns, self._period_s)
        assert predicted is not None
        std_um = request.std_um if request.std_um is not None else self._settings.std_um
        deformation_um = request.measured_um - request.offset_applied_um
        noise_um = math.hypot(std_um, predicted.noise_um)
        return deformation_um, noise_um, predicted.y_um, predicted.contributions_um, request.feature

    def wanted(self, y_std_um: float) -> Wanted:
        """Return whether, by when and why a probe is wanted after the last sample.

        Parameters
        ----------
        y_std_um : float
            Standard deviation of the prediction, µm.
        """
        return wanted_after(self._state, self._correction, y_std_um, self._settings.tolerance_um)


def _known(probe: ReceivedProbe) -> KnownProbe:
    request = probe.request
    return KnownProbe(request.time_utc_ns, request.measured_um, request.offset_applied_um, request.feature)


def _as_published(own: PastSample, published: PastSample) -> PastSample:
    return msgspec.structs.replace(
        own,
        offset_um=published.offset_um,
        offset_rate_um_per_min=published.offset_rate_um_per_min,
        is_held=published.is_held,
    )
