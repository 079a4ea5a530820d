"""The base model over measured runs: its signals, and what proposals of effects may build on."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Container, Sequence

import numpy as np

from compensator.arrays import Vector
from compensator.data.runs import Run, noise_std
from compensator.diagnose.residual.no_causes import DISPLACEMENT
from compensator.diagnose.residual.noise import drive_of
from compensator.diagnose.residual.smoothing import course
from compensator.model.effects.base import filters
from compensator.model.effects.hypothesis import COOLEST, DEGC, EQUAL, Context
from compensator.model.effects.signals import COLD, RecordSignals, Warmth
from compensator.model.engine import Engine
from compensator.model.late_observer import observe
from compensator.model.thermal_model import ThermalModel
from compensator.model.transfer_function import SampledTransferFunction

#: A channel whose span is less than this many of its noise deviations does not move.
MOVES = 8.0
#: Samples whose median is where a channel is as a record begins.
BEGINS = 10
#: A channel has a zero, so that its square may act, if it comes as near to 0 as this share of its span.
ZEROED = 0.05
#: A record begins warm if what the machine had at its start is more than this share of the span of the DTF's share.
WARM_SHARE = 0.05


def without_noise(run: Run) -> Run:
    """Return a run with the courses of T_Q and AT in place of their readings, which count from where these begin.

    A lag is at rest at its first input. By what a course begins beside the reference the plain inverse would begin with
    hundreds of W: as a state of hours they look like a drift, and the engine does not have them.
    """
    t_q, at = run.difference_k + run.ambient_k, run.ambient_k
    t_q, at = course(t_q, noise_std(t_q)), course(at, noise_std(at))
    own = dataclasses.replace(run, difference_k=t_q - at, ambient_k=at)
    return own.counting_from((own.t_q_degc[0], own.at_degc[0]))


def beginnings(runs: Sequence[Run]) -> list[float]:
    """Return when each run begins after the start of the first, min: by its own time, or after the one before."""
    begins: list[float] = []
    end = first = runs[0].t_s[0]
    for run in runs:
        start = max(end, run.t_s[0])
        begins.append(float(start - first) / 60.0)
        end = start + run.t_s[-1] - run.t_s[0]
    return begins


def signals_of(model: ThermalModel, run: Run, number: int = 0, begins_min: float = 0.0) -> RecordSignals:
    """Run the base model's paths over a run.

    The heat is that of the plain inverse, without lag and linear; where the model corrects a late T_Q, that of the
    engine, which cannot know more.
    """
    tdtf = model.tdtf.sampled if model.tdtf else SampledTransferFunction(b=(0.0,), a=(1.0,), period_s=model.period_s)
    if model.late_t_q is None:
        drive, ambient_k = drive_of(model, run.difference_k), run.ambient_k
        t_q_degc, at_degc = run.t_q_degc, run.at_degc
        y_dtf_um, y_tdtf_um = model.dtf.sampled.response(drive), tdtf.response(ambient_k)
    else:
        t_q_ref, at_ref = run.reference
        seen = observe(model, run.t_q_degc - t_q_ref, run.at_degc - at_ref)
        t_q_degc, at_degc = seen.t_q_k + t_q_ref, seen.ambient_k + at_ref
        drive, ambient_k, y_dtf_um, y_tdtf_um = seen.drive, seen.ambient_k, seen.y_dtf_um, seen.y_tdtf_um
    return RecordSignals(
        period_min=model.period_s / 60.0,
        drive=drive,
        ambient_k=ambient_k,
        t_q_degc=t_q_degc,
        at_degc=at_degc,
        y_dtf_um=y_dtf_um,
        y_tdtf_um=y_tdtf_um,
        channels={name: values for name, values in run.channels.items() if np.isfinite(values).all()},
        share_of_ambient=model.dtf.sampled.response(drive_of(model, run.ambient_k)),
        number=number,
        begins_min=begins_min,
    )


def with_warmths(model: ThermalModel, runs: Sequence[Run], signals: Sequence[RecordSignals]) -> list[RecordSignals]:
    """Return the signals of runs with what the machine may have had at the start of each.

    T_Q − AT there would be held by a heat whose share of y is known. How the machine became so warm is not, so the
    initial state of the paths is left out; it dies away.
    """
    heat_per_k = 1.0 / model.ttf.sampled.dc_gain if model.ttf else 1.0
    um_per_k = model.dtf.sampled.dc_gain * heat_per_k
    starts_k = [run.reference[0] - run.reference[1] for run in runs]
    least_um = WARM_SHARE * max(float(np.ptp(record.y_dtf_um)) for record in signals)

    def warmth(above_k: float) -> Warmth:
        warm = Warmth(drive=heat_per_k * above_k, y_dtf_um=um_per_k * above_k)
        return warm if abs(warm.y_dtf_um) > least_um else COLD

    coolest = min(starts_k)
    return [
        dataclasses.replace(record, warmths={COOLEST: warmth(start - coolest), EQUAL: warmth(start)})
        for start, record in zip(starts_k, signals, strict=True)
    ]


def effects_of(model: ThermalModel, run: Run) -> Vector:
    """Return what the effects that the model already has add, µm."""
    if not model.effects:
        return np.zeros(run.t_s.size)
    if model.late_t_q is None:
        model = dataclasses.replace(model, estimator=dataclasses.replace(model.estimator, method="inverse"))
    engine = Engine(model)
    engine.set_reference(*run.reference)
    return np.array([sum(e.y_effects_um) for e in engine.run(run.t_q_degc, run.at_degc, run.channels)])


def warm_effects_of(model: ThermalModel, record: RecordSignals, rest: str) -> Vector:
    """Return what the effects that a model has already add besides, µm, as the record begins if it is at rest there.

    An effect that is not linear in a path is another one around another point, as for new ones (`Hypothesis.columns`).
    """
    added, warm = np.zeros(record.size), record.begun(rest)
    if warm.begins_at_rest:
        return added
    for effect in model.effects:
        if effect.counts_from_rest and effect.path == "DTF":
            run = [effect.law(each, filters(effect.blocks(each.period_min))) for each in (warm, warm.held(), record)]
            added = added + run[0] - run[1] - run[2]
    return added


def late_error_um(model: ThermalModel, runs: Sequence[Run], signals: Sequence[RecordSignals]) -> float:
    """Return what the engine does not know in time of a late T_Q: against a correction with the future, µm rms."""
    late = next((effect for effect in model.effects if effect.lateness is not None), None)
    if late is None:
        return 0.0
    prompt, errors = model.with_prompt_t_q(), []
    for run, own in zip(runs, signals, strict=True):
        seen = signals_of(prompt, run)
        errors.append(own.y_dtf_um - seen.y_dtf_um - late.columns(seen, ())[:, 0])
    return float(np.std(np.concatenate(errors)))


def context_of(model: ThermalModel, signals: Sequence[RecordSignals], apart: Container[str] = ()) -> Context:
    """Return what proposals may build on: paths, gains, and channels that move, but for those that are no causes."""
    common = [name for name in signals[0].channels if all(name in record.channels for record in signals)]
    spans, zeroed = {}, set()
    usable = [name for name in common if name not in apart and not name.endswith(DISPLACEMENT)]
    for name in usable:
        values = np.concatenate([record.channels[name] for record in signals])
        if np.ptp(values) > MOVES * noise_std(values) and np.ptp(values) > 0.0:
            spans[name] = float(np.ptp(values))
            if np.min(np.abs(values)) < ZEROED * np.ptp(values) and not name.endswith(DEGC):
                zeroed.add(name)
    paths = {name: path.sampled for name, path in (("DTF", model.dtf), ("TDTF", model.tdtf)) if path is not None}
    both = (("DTF", model.dtf), ("TDTF", model.tdtf))
    known = {name: path.gain_with_std() for name, path in both if path is not None}
    gains = {name: (gain, std if math.isfinite(std) else 0.0) for name, (gain, std) in known.items()}
    sizes = {name: max(float(np.ptp(record.share(name))) for record in signals) for name in ("DTF", "TDTF")}
    return Context(
        has_ambient=model.tdtf is not None,
        has_ttf=model.ttf is not None,
        minutes=max(record.size for record in signals) * signals[0].period_min,
        span_min=signals[-1].begins_min + signals[-1].size * signals[-1].period_min,
        period_min=signals[0].period_min,
        sizes_um=sizes,
        taus_min={name: tuple(t for t in path.time_constants_min() if t > 0.0) for name, path in paths.items()},
        spans=spans,
        first={name: float(np.median(signals[0].channels[name][:BEGINS])) for name in spans},
        temperatures=tuple(name for name in usable if name.endswith(DEGC)),
        zeroed=frozenset(zeroed),
        approximate=model.held_out_rms_um is not None,
        has_late_t_q=model.late_t_q is not None,
        functions={name: (path.b, path.a) for name, path in paths.items()},
        gains=gains,
        begins_warm=all(record.warmths.get(EQUAL, COLD) != COLD for record in signals),
    )
