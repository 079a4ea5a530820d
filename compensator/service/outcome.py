"""Values of a sample, and its outcome."""

from __future__ import annotations

import msgspec
from msgspec import UNSET

from compensator.arrays import NAN
from compensator.codes import SampleQuality
from compensator.events import EventKind, Note
from compensator.messages import SCHEMA, ChannelSample, EstimateMessage, Offset, Probe, Sample, number
from compensator.messages_axes import AxesEstimate, AxisOffset
from compensator.model.engine import Engine, Estimate
from compensator.service.state import ZeroState


class Outcome(msgspec.Struct, frozen=True):
    """Outcome of one sample: the sample with final qualities, estimate, offset, events, and the decided probes.

    On a machine of several axes `offset` is that of Y, and `further` are those of the other axes.
    """

    sample: Sample
    estimate: EstimateMessage
    offset: Offset
    notes: tuple[Note, ...]
    probes: tuple[Probe, ...] = ()
    further: tuple[AxisOffset, ...] = ()


def sets_zero(outcome: Outcome) -> bool:
    """Return whether a zero was set at a sample."""
    return any(note.kind == EventKind.ZERO for note in outcome.notes)


def sets_zero_at_rest(outcome: Outcome) -> bool:
    """Return whether a zero at rest was set at a sample."""
    return any(note.kind == EventKind.ZERO and note.data["mode"] == "rest" for note in outcome.notes)


class Values(msgspec.Struct):
    """Usable values of one sample; NaN where a channel is not usable.

    Parameters
    ----------
    t_q, at : float
        Temperatures, °C.
    y : float
        Measured deformation, µm.
    others : dict of str to float
        All other channels, by name.
    """

    t_q: float
    at: float
    y: float
    others: dict[str, float]

    @classmethod
    def of(cls, channels: dict[str, ChannelSample]) -> Values:
        """Return the usable values of a sample."""
        good = SampleQuality.GOOD
        usable = {name: number(channel.mean) if channel.quality == good else NAN for name, channel in channels.items()}
        return cls(
            t_q=usable.pop("t_q_degc", NAN),
            at=usable.pop("at_degc", NAN),
            y=usable.pop("y_um", NAN),
            others=usable,
        )


class Prediction(msgspec.Struct, frozen=True):
    """Deformation since the zero, its standard deviation, µm, and its growth over the next sample, µm/min.

    All are NaN before the first zero. A correction by probes is included; `is_limited` if it has reached its limit.
    """

    y_um: float = NAN
    std_um: float = NAN
    rate_um_per_min: float = NAN
    is_limited: bool = False


def estimate_message(
    sample: Sample,
    values: Values,
    estimate: Estimate | None,
    engine: Engine,
    zero: ZeroState,
    prediction: Prediction,
    axes: dict[str, float | list[float] | None] | None = None,
) -> EstimateMessage:
    """Return the estimate as a message: shares of the model, and the prediction with the correction by probes.

    `axes` are the values of further axes by name; None on a machine with Y alone.
    """
    y, reference = values.y - zero.y_ref, engine.reference
    t_q_shift_k, at_shift_k = engine.shifted_k
    own = EstimateMessage(
        schema=SCHEMA,
        machine=sample.machine,
        seq=sample.seq,
        time_utc_ns=sample.time_utc_ns,
        t_q_ref_degc=reference.t_q_degc,
        at_ref_degc=reference.at_degc,
        y_ref_um=zero.y_ref,
        t_q_shift_k=t_q_shift_k or UNSET,
        at_shift_k=at_shift_k or UNSET,
        heat_w=estimate.heat_w if estimate else NAN,
        heat_std_w=estimate.heat_std_w if estimate else NAN,
        y_dtf_um=estimate.y_dtf_um if estimate else NAN,
        y_tdtf_um=estimate.y_tdtf_um if estimate else NAN,
        y_effects_um=list(estimate.y_effects_um) if estimate else [],
        y_base_um=zero.y_base,
        level_um=zero.level or UNSET,
        y_pred_um=prediction.y_um,
        y_std_um=prediction.std_um,
        y_rate_um_per_min=prediction.rate_um_per_min,
        y_um=y,
        residual_um=y - prediction.y_um,
    )
    if axes is None:
        return own
    return AxesEstimate(**msgspec.structs.asdict(own), axes=axes)
