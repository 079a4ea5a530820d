"""What is known about a probe before it is compared with the prediction: whether it can be used at all."""

from __future__ import annotations

from datetime import UTC, datetime

from compensator.clock import NS, duration
from compensator.codes import ProbeCode
from compensator.config import Probe as ProbeSettings
from compensator.service.probing.past import offsets_at, predicted_at, published_at
from compensator.service.probing.received import ProbeRefused, ReceivedProbe
from compensator.service.probing.state import KnownProbe, ProbingState

#: A probe this far ahead of the clock here is from the future, s: two clocks never agree exactly.
AHEAD_S = 5.0
#: The same values of the same feature within this time is the same probe, s: two ways may round its time differently.
SAME_S = 1.0
#: Largest number of features between two zeros: each has a zero of its own, which needs a first probe.
MOST_FEATURES = 16
#: Smallest and largest standard deviation that a probe may state, µm.
STD_UM = (0.01, 100.0)


def check_probe(
    probe: ReceivedProbe,
    state: ProbingState,
    settings: ProbeSettings,
    *,
    offset_max_um: float,
    period_s: float,
    kept: int,
) -> None:
    """Check a probe against its bounds, its time, and what was published then.

    Parameters
    ----------
    probe : ReceivedProbe
        The probe.
    state : ProbingState
        The last samples and probes.
    settings : config.Probe
        `[probe]`.
    offset_max_um : float
        Largest offset, µm.
    period_s : float
        Length of a sample, s.
    kept : int
        Number of samples that are kept.

    Raises
    ------
    ProbeRefused
        If it cannot be used; the message says why.
    """
    _check_bounds(probe, settings, offset_max_um)
    _check_time(probe, state, settings, period_s, kept)
    if not probe.is_checked:
        _check_offset(probe, state, settings, period_s)
    request = probe.request
    if request.feature not in state.features and len(state.features) >= MOST_FEATURES:
        raise ProbeRefused(
            ProbeCode.TOO_MANY_FEATURES,
            f"probe: feature {request.feature!r} is one more than the {MOST_FEATURES} since the zero",
        )


def _check_bounds(probe: ReceivedProbe, settings: ProbeSettings, offset_max_um: float) -> None:
    request = probe.request
    if request.axis != "y":
        raise ProbeRefused(ProbeCode.AXIS, f"probe: axis = {request.axis!r}, expected 'y'")
    for name, value, largest in (
        ("measured_um", request.measured_um, settings.measured_max_um),
        ("offset_applied_um", request.offset_applied_um, offset_max_um + settings.match_um),
    ):
        if not abs(value) <= largest:
            raise ProbeRefused(ProbeCode.OUT_OF_BOUNDS, f"probe: {name} = {value:g}, expected at most ±{largest:g}")
    if request.std_um is not None and not STD_UM[0] <= request.std_um <= STD_UM[1]:
        raise ProbeRefused(
            ProbeCode.OUT_OF_BOUNDS, f"probe: std_um = {request.std_um:g}, expected {STD_UM[0]:g} to {STD_UM[1]:g}"
        )


def _check_time(probe: ReceivedProbe, state: ProbingState, settings: ProbeSettings, period_s: float, kept: int) -> None:
    time_ns, samples = probe.request.time_utc_ns, state.samples
    when, late_s = _clock(time_ns), (probe.received_utc_ns - time_ns) / NS
    if late_s < -AHEAD_S:
        raise ProbeRefused(ProbeCode.FUTURE, f"probe of {when}: {duration(-late_s)} ahead of the clock here")
    if late_s > 60.0 * settings.oldest_min:
        raise ProbeRefused(
            ProbeCode.TOO_OLD,
            f"probe of {when}: {duration(late_s)} old, expected at most {settings.oldest_min:g} min",
        )
    if any(_is_same(probe, known) for known in state.known):
        raise ProbeRefused(ProbeCode.DUPLICATE, f"probe of {when}: received before")
    if time_ns <= state.zero_ns:
        raise ProbeRefused(ProbeCode.BEFORE_ZERO, f"probe of {when}: before the zero of {_clock(state.zero_ns)}")
    if not samples:
        raise ProbeRefused(ProbeCode.NO_OFFSET, f"probe of {when}: no offset had been published by then")
    if len(samples) >= kept and time_ns < samples[0].middle_ns:
        since = f"before the oldest sample that is kept, of {_clock(samples[0].time_ns)}"
        raise ProbeRefused(ProbeCode.TOO_OLD, f"probe of {when}: {since}")
    if predicted_at(samples, time_ns, period_s) is None:
        raise ProbeRefused(ProbeCode.TIME_UNKNOWN, f"probe of {when}: there is no prediction for that time")


def _check_offset(probe: ReceivedProbe, state: ProbingState, settings: ProbeSettings, period_s: float) -> None:
    request, samples = probe.request, state.samples
    when = _clock(request.time_utc_ns)
    then = published_at(samples, request.time_utc_ns, period_s)
    if then is None:
        raise ProbeRefused(ProbeCode.TIME_UNKNOWN, f"probe of {when}: no offset was valid at that time")
    low, high = offsets_at(samples, request.time_utc_ns, period_s)
    matches = low - settings.match_um <= request.offset_applied_um <= high + settings.match_um
    if then.is_held:
        text = f"probe of {when}: the offset was held at {then.offset_um:.2f} µm"
        raise ProbeRefused(ProbeCode.DURING_HOLD, text, is_comparable=matches)
    if not matches:
        published = f"{low:.2f}" if high - low < 0.01 else f"{low:.2f} to {high:.2f}"
        raise ProbeRefused(
            ProbeCode.MISMATCH,
            f"probe of {when}: offset_applied_um = {request.offset_applied_um:.2f}, "
            f"published then was {published} (match_um = {settings.match_um:g})",
        )


def _is_same(probe: ReceivedProbe, known: KnownProbe) -> bool:
    request = probe.request
    if request.feature != known.feature:  # Two features of one cycle may have one time.
        return False
    apart_ns = abs(request.time_utc_ns - known.time_ns)
    equal = (request.measured_um, request.offset_applied_um) == (known.measured_um, known.offset_applied_um)
    return apart_ns == 0 or (equal and apart_ns < SAME_S * NS)


def _clock(time_ns: int) -> str:
    try:
        return f"{datetime.fromtimestamp(time_ns // NS, UTC):%H:%M:%S}"
    except (OverflowError, ValueError, OSError):
        return f"{time_ns} ns"
