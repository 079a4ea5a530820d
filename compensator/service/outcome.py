"""What one sample led to, as it is recorded and published."""

from __future__ import annotations

from dataclasses import dataclass

from compensator.events import Note
from compensator.messages import SCHEMA, ChannelSample, EstimateMessage, Offset, Sample, State, number
from compensator.model.engine import Estimate, Reference
from compensator.model.thermal_model import ThermalModel
from compensator.service.limits import Limited
from compensator.service.state import ZeroState

NAN = float("nan")

#: A published offset may be used for this many samples.
VALID_SAMPLES = 2.5


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one sample led to.

    Parameters
    ----------
    sample : Sample
        The sample with the guards' verdicts.
    estimate : EstimateMessage
        What the model makes of it.
    offset : Offset
        What is to be published.
    notes : tuple of Note
        Events of this sample.
    """

    sample: Sample
    estimate: EstimateMessage
    offset: Offset
    notes: tuple[Note, ...]


@dataclass(slots=True)
class Values:
    """Usable values of one sample; NaN where a channel is not usable.

    Parameters
    ----------
    t_q, at : float
        Temperatures, °C.
    y : float
        Measured deformation, µm.
    others : dict of str to float
        Every other channel, by its name.
    """

    t_q: float
    at: float
    y: float
    others: dict[str, float]


def values_of(channels: dict[str, ChannelSample]) -> Values:
    """Return what can be used of a sample."""
    usable = {name: number(channel.mean) if channel.quality == "good" else NAN for name, channel in channels.items()}
    return Values(
        t_q=usable.pop("t_q_degc", NAN),
        at=usable.pop("at_degc", NAN),
        y=usable.pop("y_um", NAN),
        others=usable,
    )


def estimate_message(
    sample: Sample, values: Values, estimate: Estimate | None, reference: Reference, zero: ZeroState, y_pred_um: float
) -> EstimateMessage:
    """Return what the model makes of a sample."""
    y = values.y - zero.y_ref
    return EstimateMessage(
        schema=SCHEMA,
        machine=sample.machine,
        seq=sample.seq,
        time_utc_ns=sample.time_utc_ns,
        t_q_ref_degc=reference.t_q_degc,
        at_ref_degc=reference.at_degc,
        y_ref_um=zero.y_ref,
        heat_w=estimate.heat_w if estimate else NAN,
        heat_std_w=estimate.heat_std_w if estimate else NAN,
        y_dtf_um=estimate.y_dtf_um if estimate else NAN,
        y_tdtf_um=estimate.y_tdtf_um if estimate else NAN,
        y_effects_um=list(estimate.y_effects_um) if estimate else [],
        y_base_um=zero.y_base,
        y_pred_um=y_pred_um,
        y_std_um=estimate.y_std_um if estimate else NAN,
        y_rate_um_per_min=estimate.y_rate_um_per_min if estimate else NAN,
        y_um=y,
        residual_um=y - y_pred_um,
    )


def offset_message(
    sample: Sample, model: ThermalModel, std_um: float, state: State, reasons: list[str], limited: Limited | None
) -> Offset:
    """Return what is published."""
    return Offset(
        schema=SCHEMA,
        machine=sample.machine,
        seq=sample.seq,
        time_utc_ns=sample.time_utc_ns,
        valid_for_s=VALID_SAMPLES * model.period_s,
        y_offset_um=limited.offset_um if limited else NAN,
        y_offset_rate_um_per_min=limited.rate_um_per_min if limited else NAN,
        y_offset_std_um=std_um,
        state=state,
        reasons=reasons,
        model_sha256=model.sha256,
    )
