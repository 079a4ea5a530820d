"""A simulated machine's readings as the samples and probes that a service gets, without devices."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from compensator.clock import NS
from compensator.codes import SampleQuality
from compensator.config import Config
from compensator.messages import SCHEMA, ChannelSample, Offset, ProbeRequest, Sample, number
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome
from compensator.service.probing import ReceivedProbe

#: Readings of a sample.
POLLS = 6


def sample_of(machine: str, seq: int, time_utc_ns: int, values: Mapping[str, float], *, period_s: float) -> Sample:
    """Return a sample of readings; NaN is a broken couple."""
    channels = {name: _channel(float(value)) for name, value in values.items()}
    return Sample(
        schema=SCHEMA, machine=machine, seq=seq, time_utc_ns=time_utc_ns, period_s=period_s, channels=channels
    )


def _channel(value: float) -> ChannelSample:
    is_good = math.isfinite(value)
    quality = SampleQuality.GOOD if is_good else SampleQuality.OPEN_CIRCUIT
    return ChannelSample(
        mean=value,
        min=value,
        max=value,
        spread=0.0 if is_good else math.nan,
        count=POLLS if is_good else 0,
        polls=POLLS,
        quality=quality,
        device_quality=quality,
        errors={} if is_good else {SampleQuality.OPEN_CIRCUIT: POLLS},
    )


def probe_of(shown_um: float, offset: Offset | None, time_utc_ns: int) -> ReceivedProbe | None:
    """Return a touch probe with the offset acting that was published last.

    Parameters
    ----------
    shown_um : float
        Deformation since the first sample, with the errors of the probe, µm.
    offset : Offset or None
        What the control follows, with its rate.
    time_utc_ns : int
        When it is measured, ns since 1970 UTC.

    Returns
    -------
    ReceivedProbe or None
        None where nothing is published yet: nobody probes then.
    """
    if offset is None or offset.y_offset_um is None:
        return None
    minutes = (time_utc_ns - offset.time_utc_ns) / (60.0 * NS)
    applied_um = number(offset.y_offset_um) + number(offset.y_offset_rate_um_per_min) * minutes
    request = ProbeRequest(
        schema=SCHEMA,
        time_utc_ns=time_utc_ns,
        axis="y",
        measured_um=shown_um + applied_um,
        offset_applied_um=applied_um,
        feature="sphere-1",
        tool="touch-probe",
    )
    return ReceivedProbe(request=request, received_utc_ns=time_utc_ns)


def run_alone(config: Config, model: ThermalModel, samples: Sequence[tuple[Sample, float, bool]]) -> list[Outcome]:
    """Run a model over samples without a loop.

    Parameters
    ----------
    samples : sequence of (Sample, float, bool)
        Each with what a probe before it shows, µm, NaN without one, and whether a person sets a new zero before it.
    """
    compensation, outcomes = Compensation(config, model), list[Outcome]()
    for sample, shown_um, is_zero in samples:
        if is_zero:
            compensation.resume()
            compensation.zero("warm")
        if outcomes:
            compensation.pause(sample.seq - outcomes[-1].sample.seq - 1)
        if math.isfinite(shown_um):
            before = outcomes[-1].offset if outcomes else None
            probe = probe_of(shown_um, before, sample.time_utc_ns - round(sample.period_s * NS / 2))
            compensation.receive_probes([probe] if probe is not None else [])
        outcomes.append(compensation.process(sample))
    return outcomes
