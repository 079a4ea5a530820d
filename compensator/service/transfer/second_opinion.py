"""Second opinion before another model takes over: both models on the measured Y on record, and every other axis.

Both run through the same replay of the recordings as a warm-up, about the zeros of the record, with the probes of the
record. Compared are the last `COMPARED_H` hours (`two_models`), each axis that is measured by its own values.

Left out: samples before the state of both models is known, without T_Q or AT, while the service suspected a sensor and
not the model, blocks of a sensor that does not change at all, and probes that both models refuse.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from compensator.axes import FIRST, AxisWords, label_of
from compensator.clock import HOUR_NS
from compensator.codes import Reason
from compensator.config import Config
from compensator.diagnose.residual.change import BLOCK_MIN
from compensator.errors import CompensatorError, DataError, ServiceError
from compensator.events import ComparisonData, ComparisonVerdict, NotJudged
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome, slowest_min
from compensator.service.replay import RecordedStep
from compensator.service.status import Zero
from compensator.service.transfer.two_models import FEWEST_CHANGES, Comparison, changed, not_judged
from compensator.service.transfer.warm_up import RecordedRun, Window, usable_steps, window_of

#: How much of the record is compared, h.
COMPARED_H = 24.0
_Y_SUSPECTED = f"{Reason.IMPLAUSIBLE}:y_um"
_UNUSABLE = (Reason.COLD_START, Reason.T_Q_MISSING, Reason.AT_MISSING, Reason.T_Q_AT_EXCHANGED)


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
        compared_ns = round(COMPARED_H * HOUR_NS)
        window = window_of(folder, config.machine.name, slowest, between_samples, compared_ns=compared_ns)
        runs = [RecordedRun(config, Compensation(config, model), probes=True) for model in (present, candidate)]
        found, moves_um = _run(runs, window, window.end_ns - compared_ns, between_samples)
    except (CompensatorError, OSError) as error:
        return not_judged(NotJudged.NO_RECORD, remark=str(error))
    verdicts = {}
    for axis, comparison in found.items():
        first_ns = comparison.state.first_ns
        hours = (window.end_ns - first_ns) / HOUR_NS if first_ns else 0.0
        verdicts[axis] = changed(comparison.verdict(), hours=hours, offset_change_um=moves_um.get(axis))
    own = verdicts.pop(FIRST)
    return changed(own, axes=verdicts)


def refuse_if_worse(found: ComparisonData, model: ThermalModel, *, force: bool) -> None:
    """Refuse a model that is clearly worse on an axis, unless it is forced.

    Raises
    ------
    ServiceError
        With the figures and what to do.
    """
    worse = worse_axes(found)
    if not worse or force:
        return
    names = " and ".join(map(label_of, worse))
    said = _of_axes(worse).partition(": ")[2] if len(worse) == 1 else _of_axes(worse)
    raise ServiceError(
        f"model {model.name} ({model.sha256[:12]}) is clearly worse{f' on {names}' if found.axes else ''}: {said}; "
        f"check that it is a model of this machine and that measured {names} is right, or use --force"
    )


def worse_axes(found: ComparisonData) -> dict[str, ComparisonData]:
    """Return the axes on which a model is clearly worse."""
    return {axis: one for axis, one in found.by_axis().items() if one.verdict == ComparisonVerdict.WORSE}


def without_move(found: ComparisonData) -> ComparisonData:
    """Return a comparison without what the offset would have moved by: it has moved, the correction included."""
    axes = {axis: changed(one, offset_change_um=None) for axis, one in found.axes.items()}
    return changed(found, offset_change_um=None, axes=axes)


def described(found: ComparisonData) -> str:
    """Return a comparison in words."""
    return _of_axes(found.by_axis()) if found.axes else _described(found)


def _of_axes(found: Mapping[str, ComparisonData]) -> str:
    return ". ".join(f"{label_of(axis)}: {AxisWords(axis)(_described(one))}" for axis, one in found.items())


def _described(found: ComparisonData) -> str:
    move = found.offset_change_um
    moves = f"the offset would move by {round(move, 1) + 0.0:+.1f} µm" if move is not None else ""
    if found.present_rms_um is None or found.candidate_rms_um is None:
        return "; ".join(filter(None, (f"no verdict: {_why(found)}", moves)))
    probes = f", {found.probes} probe(s)" if found.measured_by == "probe" else ""
    rms = f"present {found.present_rms_um:.1f} µm rms, this one {found.candidate_rms_um:.1f}"
    if found.why is not None:
        text = f"{rms} (no verdict: {_why(found)})"
    elif found.verdict == ComparisonVerdict.ALIKE or found.deviations is None:
        text = f"{rms} (no clear difference)"
    else:
        refuted = "the present one" if found.verdict == ComparisonVerdict.BETTER else "it"
        shown = f"{refuted} is refuted by {abs(found.deviations):.0f} standard deviations"
        text = f"{rms} ({found.verdict}: {shown})"
        if found.y_moved:
            # Its figures are not those of the verdict, and come last.
            times = f"its error changes {found.ratio:.2g} times as much; " if found.ratio is not None else ""
            text = (
                f"by the changes of measured Y this one is {found.verdict} than the present one ({times}{shown}); "
                f"about the zero it looks otherwise ({rms})"
            )
    return "; ".join(filter(None, (f"last {found.hours:.3g} h{probes}: {text}", moves)))


def _why(found: ComparisonData) -> str:
    needed = (
        f"at least {FEWEST_CHANGES} probes"
        if found.measured_by == "probe"
        else f"about {(FEWEST_CHANGES + 2) * BLOCK_MIN / 60:g} h"
    )
    return {
        None: "",
        NotJudged.NO_ZERO: "no zero was set yet",
        NotJudged.NO_RECORD: found.remark,
        NotJudged.NO_Y: f"no measured Y in the last {COMPARED_H:g} h of the recordings",
        NotJudged.NOT_YET: "nothing has been compared yet",
        NotJudged.TOO_LITTLE: f"too little measured Y, {needed} without interruption are needed",
        NotJudged.SUSPECT: (
            f"nothing is compared while a sensor is suspected under both models ({found.remark})"
            if found.remark
            else "the service suspected a sensor while Y was measured"
        ),
        NotJudged.UNRELATED: "measured Y does not move, or follows neither model; check its sensor",
    }[found.why]


# ---------------------------------------------------------------------- the record


def _run(
    runs: Sequence[RecordedRun], window: Window, from_ns: int, between_samples: Callable[[], None]
) -> tuple[dict[str, Comparison], dict[str, float]]:
    """Run both models through the record, each axis by itself; return also by how much its offset would move, µm."""
    models = [run.compensation.model for run in runs]
    axes = (FIRST, *(one.axis for one in runs[0].compensation.outputs.planned if one.column in runs[0].channels))
    found = {axis: Comparison(models[0].period_s, axis=axis) for axis in axes}
    begun = window.at_rest is not None
    for run in runs:
        run.compensation.begin(None)
        if window.at_rest is not None:
            run.process(window.at_rest)
            run.begin_at_level(window)
    for step in _steps(window, between_samples):
        sample = step.sample
        if sample is not None and (sample.seq <= runs[0].seq or sample.time_utc_ns < window.from_ns):
            continue
        if not begun:
            zero = Zero.set_in(step.estimate) if step.sample is not None else None
            if zero is None:
                continue
            if zero.is_absolute and any(model.inputs == "changes" for model in models):
                raise DataError("no recorded zero, and a previous model used absolute temperatures")
            begun = True
            for run in runs:
                run.compensation.begin(zero)
                run.begin_at_level(window)
        levels_um = [run.compensation.level_um for run in runs]
        outcomes = [outcome for run in runs if (outcome := run.process(step)) is not None]
        # What a model left before its level was raised is not comparable either.
        if step.zero is not None or levels_um != [run.compensation.level_um for run in runs]:
            for comparison in found.values():
                comparison.set_zero()
        if len(outcomes) == len(runs) and outcomes[0].sample.time_utc_ns > from_ns:
            _compare(found, step, outcomes[0], outcomes[1])
    present, candidate = (run.compensation for run in runs)
    # As at the exchange: with probes the corrected deformation stays as it is.
    candidate.continue_from(msgspec.structs.replace(present.status.handover, model_changed=True))
    before, after = ({FIRST: one.status.target_um, **one.further_targets} for one in (present, candidate))
    moves = {axis: after[axis] - before[axis] for axis in axes}
    return found, {axis: move for axis, move in moves.items() if not math.isnan(move)}


def _steps(window: Window, between_samples: Callable[[], None]) -> Iterator[RecordedStep]:
    for path in window.files:
        for step in usable_steps(path):
            yield step
            between_samples()


def _compare(found: Mapping[str, Comparison], step: RecordedStep, present: Outcome, candidate: Outcome) -> None:
    """Add one sample and its probes."""
    if is_unusable(present, candidate):
        return
    reasons = step.offset.reasons if step.offset is not None else ()
    for axis, comparison in found.items():
        # The sensor of Y says nothing of the other axes; suspected temperatures are those of all.
        concerned = reasons if axis == FIRST else [one for one in reasons if one != _Y_SUSPECTED]
        comparison.add(present, candidate, suspected=sensor_suspected(concerned))


def is_unusable(*outcomes: Outcome) -> bool:
    """Return whether one of the predictions of a sample lacks a temperature or a known state."""
    return any(reason in _UNUSABLE for outcome in outcomes for reason in outcome.offset.reasons)


def sensor_suspected(reasons: Sequence[str]) -> bool:
    """Return whether the service suspected a sensor, and not the model, at a sample with these reasons."""
    suspects = [reason for reason in reasons if reason.startswith(Reason.IMPLAUSIBLE)]
    return Reason.T_Q_AT_APART in reasons or (bool(suspects) and f"{Reason.IMPLAUSIBLE}:model" not in suspects)
