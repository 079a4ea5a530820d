"""Second opinion before another model takes over: both models on the measured Y on record.

Both run through the same replay of the recordings as a warm-up, about the zeros of the record, with the probes of the
record. Compared are the last `COMPARED_H` hours: block means of a displacement sensor, or what each probe showed beyond
the prediction before it. `evidence` says how strongly they speak for one of the models.

Left out: samples before the state of both models is known, without T_Q or AT, while the service suspected a sensor and
not the model, blocks of a sensor that does not change at all, and probes that both models refuse.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from compensator.arrays import Vector
from compensator.clock import NS
from compensator.codes import Reason
from compensator.config import Config
from compensator.errors import CompensatorError, DataError, ServiceError
from compensator.events import ComparisonData, ComparisonVerdict, NotJudged
from compensator.messages import number
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome, slowest_min
from compensator.service.probing import UNKNOWN_UM
from compensator.service.replay import RecordedStep, steps_of
from compensator.service.status import Zero
from compensator.service.transfer.candidate import RecordedRun, Window, window_of
from compensator.service.transfer.evidence import evidence, followed

#: How much of the record is compared, h.
COMPARED_H = 24.0
#: From this number of standard deviations of the difference on a model is better or worse.
DEVIATIONS = 4.0
#: A model whose changes are wrong by more than the present one's by less than this part is not worse.
WORSE_PART = 0.05
#: Fewer changes of block means, or probes, do not judge a model.
FEWEST = 8
#: Length of a block, min, and the part of it that must be measured.
BLOCK_MIN, _MEASURED = 30.0, 0.5
_UNUSABLE = (Reason.COLD_START, Reason.T_Q_MISSING, Reason.AT_MISSING, Reason.T_Q_AT_EXCHANGED)


@dataclass(slots=True)
class _Compared:
    """What both models made of the record; a row of `samples` is block, residuals of both, Y."""

    samples: list[tuple[tuple[int, int], float, float, float]] = field(default_factory=list)
    probes: list[tuple[float, float]] = field(default_factory=list)
    first_ns: int = 0
    #: Samples with measured Y during which a sensor was suspected.
    suspected: int = 0
    offset_change_um: float = math.nan


def second_opinion(
    folder: Path,
    config: Config,
    present: ThermalModel,
    candidate: ThermalModel,
    *,
    between_samples: Callable[[], None] = lambda: None,
) -> ComparisonData:
    """Compare another model with the present one on the recordings.

    Parameters
    ----------
    folder : pathlib.Path
        Recordings.
    config : Config
        Settings of the service.
    present, candidate : ThermalModel
        The two models.
    between_samples : callable
        Called after each sample, so that a thread can yield to the service.
    """
    try:
        slowest = max(slowest_min(model) for model in (present, candidate))
        compared_ns = round(COMPARED_H * 3600 * NS)
        window = window_of(folder, config.machine.name, slowest, between_samples, compared_ns=compared_ns)
        runs = [RecordedRun(config, Compensation(config, model), probes=True) for model in (present, candidate)]
        found = _run(runs, window, window.end_ns - compared_ns, between_samples)
    except (CompensatorError, OSError) as error:
        return not_judged(NotJudged.NO_RECORD, remark=str(error))
    move_um = None if math.isnan(found.offset_change_um) else found.offset_change_um
    hours = (window.end_ns - found.first_ns) / (3600 * NS) if found.first_ns else 0.0
    by_sensor = _judged_by_sensor(found, BLOCK_MIN * 60.0 / present.period_s)
    by_probes = _judged_by_probes(found)
    chosen = by_sensor if by_sensor.why is None or not found.probes else by_probes
    return _with(chosen, hours=hours, offset_change_um=move_um)


def not_judged(why: NotJudged, *, remark: str = "") -> ComparisonData:
    """Return a comparison without a verdict."""
    return ComparisonData(verdict=ComparisonVerdict.NOT_JUDGED, why=why, remark=remark)


def refuse_if_worse(found: ComparisonData, model: ThermalModel, *, force: bool) -> None:
    """Refuse a model that is clearly worse, unless it is forced.

    Raises
    ------
    ServiceError
        With the figures and what to do.
    """
    if found.verdict == ComparisonVerdict.WORSE and not force:
        raise ServiceError(
            f"model {model.name} ({model.sha256[:12]}) is clearly worse: {described(found)}; "
            "check that it is a model of this machine and that measured Y is right, or use --force"
        )


def described(found: ComparisonData) -> str:
    """Return a comparison in words."""
    move = found.offset_change_um
    moves = f"the offset would move by {round(move, 1) + 0.0:+.1f} µm" if move is not None else ""
    if found.present_rms_um is None or found.candidate_rms_um is None:
        return "; ".join(filter(None, (f"not judged: {_why(found)}", moves)))
    probes = f", {found.probes} probe(s)" if found.measured_by == "probe" else ""
    text = (
        f"last {found.hours:.3g} h{probes}: present {found.present_rms_um:.1f} µm rms, "
        f"this one {found.candidate_rms_um:.1f}"
    )
    if found.why is not None:
        text += f" (not judged: {_why(found)})"
    elif found.verdict == ComparisonVerdict.ALIKE or found.deviations is None:
        text += " (no clear difference)"
    else:
        moved = "measured Y has moved by itself, by its changes this one is " if found.y_moved else ""
        text += f" ({moved}{found.verdict} by {abs(found.deviations):.0f} standard deviations of the difference)"
    return "; ".join(filter(None, (text, moves)))


def _why(found: ComparisonData) -> str:
    needed = (
        f"at least {FEWEST} probes" if found.measured_by == "probe" else f"about {(FEWEST + 2) * BLOCK_MIN / 60:g} h"
    )
    return {
        None: "",
        NotJudged.NO_ZERO: "no zero was set yet",
        NotJudged.NO_RECORD: found.remark,
        NotJudged.NO_Y: f"no measured Y in the last {COMPARED_H:g} h of the recordings",
        NotJudged.TOO_LITTLE: f"too little measured Y, {needed} without interruption are needed",
        NotJudged.SUSPECT: "the service suspected a sensor while Y was measured",
        NotJudged.UNRELATED: "measured Y does not move, or follows neither model; check its sensor",
    }[found.why]


# ---------------------------------------------------------------------- the record


def _run(runs: Sequence[RecordedRun], window: Window, from_ns: int, between_samples: Callable[[], None]) -> _Compared:
    """Run both models through the record."""
    found, zeros, models = _Compared(), 0, [run.compensation.model for run in runs]
    block_ns = round(BLOCK_MIN * 60 * NS)
    begun = window.at_rest is not None
    for run in runs:
        run.compensation.begin(None)
        if window.at_rest is not None:
            run.process(window.at_rest)
    for step in _steps(window, between_samples):
        sample = step.sample
        if sample is not None and (sample.seq <= runs[0].seq or sample.time_utc_ns < window.from_ns):
            continue
        if not begun:
            zero = _recorded_zero(step)
            if zero is None:
                continue
            if zero.is_absolute and any(model.inputs == "changes" for model in models):
                raise DataError("no recorded zero, and a previous model used absolute temperatures")
            begun = True
            for run in runs:
                run.compensation.begin(zero)
        zeros += step.zero is not None
        outcomes = [outcome for run in runs if (outcome := run.process(step)) is not None]
        if len(outcomes) == len(runs) and outcomes[0].sample.time_utc_ns > from_ns:
            _compare(found, step, outcomes[0], outcomes[1], (zeros, outcomes[0].sample.time_utc_ns // block_ns))
    present, candidate = (run.compensation for run in runs)
    # As at the exchange: with probes the corrected deformation stays as it is.
    candidate.continue_from(replace(present.status.handover, model_changed=True))
    found.offset_change_um = candidate.status.target_um - present.status.target_um
    return found


def _steps(window: Window, between_samples: Callable[[], None]) -> Iterator[RecordedStep]:
    for path in window.files:
        for step in steps_of(path):
            yield step
            between_samples()


def _recorded_zero(step: RecordedStep) -> Zero | None:
    """Return the zero that was current at a sample; None if there was none."""
    estimate = step.estimate if step.sample is not None else None
    zero = Zero.of_estimate(estimate) if estimate is not None else None
    return zero if zero is not None and not math.isnan(zero.t_q_ref_degc) else None


def _compare(
    found: _Compared, step: RecordedStep, present: Outcome, candidate: Outcome, block: tuple[int, int]
) -> None:
    """Add one sample and its probes."""
    if any(reason in _UNUSABLE for one in (present, candidate) for reason in one.offset.reasons):
        return
    residuals = number(present.estimate.residual_um), number(candidate.estimate.residual_um)
    probes = [
        (number(own.innovation_um), number(other.innovation_um))
        for own, other in zip(present.probes, candidate.probes, strict=True)
        if (own.taken or other.taken)
        and max(number(own.innovation_std_um), number(other.innovation_std_um)) < UNKNOWN_UM
    ]
    is_measured = math.isfinite(sum(residuals))
    if _sensor_suspected(step):
        found.suspected += is_measured
        return
    found.probes += probes
    if is_measured:
        found.samples.append((block, *residuals, number(present.estimate.y_um)))
    if probes or is_measured:
        found.first_ns = found.first_ns or present.sample.time_utc_ns - round(present.sample.period_s * NS)


def _sensor_suspected(step: RecordedStep) -> bool:
    """Return whether the service suspected a sensor, and not the model, at a sample."""
    reasons = step.offset.reasons if step.offset is not None else []
    suspects = [reason for reason in reasons if reason.startswith(Reason.IMPLAUSIBLE)]
    return Reason.T_Q_AT_APART in reasons or (bool(suspects) and f"{Reason.IMPLAUSIBLE}:model" not in suspects)


# ---------------------------------------------------------------------- the verdict


def _judged_by_sensor(found: _Compared, samples_in_block: float) -> ComparisonData:
    if not found.samples:
        return not_judged(NotJudged.SUSPECT if found.suspected else NotJudged.NO_Y)
    present, candidate, y = np.array([row[1:] for row in found.samples]).T
    scores = ComparisonData(
        verdict=ComparisonVerdict.NOT_JUDGED,
        measured_by="sensor",
        samples=present.size,
        present_rms_um=_rms(present),
        candidate_rms_um=_rms(candidate),
    )
    changes = _changes([row[0] for row in found.samples], (present, candidate, y), _MEASURED * samples_in_block)
    own, other, moves = changes
    if own.size < FEWEST:
        still = float(np.mean(np.diff(y) == 0.0)) > 0.5 if y.size > 1 else False
        suspected = NotJudged.SUSPECT if found.suspected > y.size else NotJudged.TOO_LITTLE
        return _with(scores, why=NotJudged.UNRELATED if still else suspected)
    kept = followed(moves, own, own - other, parts=own.size // FEWEST, deviations=DEVIATIONS)
    if np.sum(kept) < FEWEST:
        return _with(scores, why=NotJudged.UNRELATED)
    return _judged(scores, own[kept], own[kept] - other[kept])


def _changes(
    blocks: Sequence[tuple[int, int]], columns: Sequence[Vector], fewest: float
) -> tuple[Vector, Vector, Vector]:
    """Return the changes of both residuals and of Y from each usable block to the next one, about the same zero."""
    rows: list[list[float]] = []
    before: tuple[tuple[int, int], list[float]] | None = None
    edges = [0, *(i for i in range(1, len(blocks)) if blocks[i] != blocks[i - 1]), len(blocks)]
    for begin, end in itertools.pairwise(edges):
        parts = [column[begin:end] for column in columns]
        if end - begin < fewest or np.ptp(parts[-1]) == 0.0:
            before = None
            continue
        block, means = blocks[begin], [float(np.mean(part)) for part in parts]
        if before is not None and before[0] == (block[0], block[1] - 1):
            rows.append([new - old for new, old in zip(means, before[1], strict=True)])
        before = block, means
    own, other, y = np.array(rows).reshape(-1, 3).T
    return own, other, y


def _judged_by_probes(found: _Compared) -> ComparisonData:
    if not found.probes:
        return not_judged(NotJudged.SUSPECT if found.suspected else NotJudged.NO_Y)
    own, other = np.array(found.probes).T
    scores = ComparisonData(
        verdict=ComparisonVerdict.NOT_JUDGED,
        measured_by="probe",
        probes=own.size,
        present_rms_um=_rms(own),
        candidate_rms_um=_rms(other),
    )
    if own.size < FEWEST:
        return _with(scores, why=NotJudged.TOO_LITTLE)
    # Each model has been corrected by the probes before: what a probe shows beyond that is a change already.
    return _judged(scores, own, own - other)


def _judged(scores: ComparisonData, own: Vector, difference: Vector) -> ComparisonData:
    weighed = evidence(own, difference)
    assert scores.present_rms_um is not None and scores.candidate_rms_um is not None
    verdict, is_larger = ComparisonVerdict.ALIKE, scores.candidate_rms_um > scores.present_rms_um
    if weighed.deviations >= DEVIATIONS and weighed.ratio < 1.0:
        verdict = ComparisonVerdict.BETTER
    elif weighed.deviations <= -DEVIATIONS and weighed.ratio > 1.0 + WORSE_PART:
        verdict = ComparisonVerdict.WORSE
    y_moved = verdict != ComparisonVerdict.ALIKE and is_larger != (verdict == ComparisonVerdict.WORSE)
    scores = _with(scores, y_moved=y_moved)
    return _with(scores, verdict=verdict, deviations=weighed.deviations, effective=weighed.effective)


def _rms(values: Vector) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _with(found: ComparisonData, **changes: object) -> ComparisonData:
    return msgspec.structs.replace(found, **changes)
