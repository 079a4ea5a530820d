"""Two models compared on measured Y or another axis, sample by sample: for the second opinion, and for a shadow.

Compared are block means of a displacement sensor, as changes from one block to the next, or what each probe showed
beyond the prediction before it. `evidence` says how strongly they speak for one of the models.

The caller leaves out what must not judge: samples without T_Q or AT, or while a sensor is suspected.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from compensator.arrays import Vector, rms_of
from compensator.axes import FIRST
from compensator.clock import HOUR_NS, NS
from compensator.diagnose.residual.change import BLOCK_MIN
from compensator.events import ComparisonData, ComparisonVerdict, NotJudged
from compensator.messages import number
from compensator.messages_axes import AxesEstimate
from compensator.service.outcome import Outcome
from compensator.service.probing import UNKNOWN_UM
from compensator.service.transfer.refutation import evidence, followed

#: From this number of standard deviations on one of the models is refuted: by the likelihood (`evidence`).
DEVIATIONS = 4.0
#: A model that refutes the other one must be better than one that is neither better nor worse by this part of them.
SURE_PART = 0.5
#: A model whose changes are wrong by more than the present one's by less than this part is not worse.
WORSE_PART = 0.05
#: Fewer changes of block means, or probes, do not judge a model.
FEWEST_CHANGES = 8
#: The part of a block that must be measured.
_MEASURED = 0.5
BLOCK_NS = round(BLOCK_MIN * 60 * NS)


def moved(time_utc_ns: int, by_ns: int) -> int:
    """Return a time after the clock was set, ns since 1970 UTC; 0, which is none, stays."""
    return max(time_utc_ns + by_ns, 1) if time_utc_ns else 0


class Block(msgspec.Struct, frozen=True, array_like=True):
    """A block of samples about one zero.

    Parameters
    ----------
    zeros, number : int
        Number of the zero, and of the block since 1970.
    samples : int
        Samples with measured Y.
    squares : tuple of two floats
        Sums of squares of the residuals of both models, µm².
    means : tuple of three floats, optional
        Means of both residuals and of Y, µm; None if too little was measured, or Y did not change at all.
    """

    zeros: int
    number: int
    samples: int
    squares: tuple[float, float]
    means: tuple[float, float, float] | None


class ComparedProbe(msgspec.Struct, frozen=True, array_like=True):
    """What a probe showed beyond the predictions of both models, µm, and the time of its sample."""

    time_utc_ns: int
    own_um: float
    other_um: float


class ComparisonState(msgspec.Struct, kw_only=True):
    """Everything that was compared.

    Parameters
    ----------
    zeros : int
        Zeros so far.
    rows : list of three floats
        Residuals of both models and Y of the samples of the open block, µm.
    number : int
        Number of the open block.
    blocks : list of Block
        The blocks before it.
    probes : list of ComparedProbe
        The probes.
    first_ns, last_ns : int
        Begin of the first compared value and time of the last sample, ns since 1970 UTC; 0 before.
    suspected, steps, still : int
        Samples with measured Y while a sensor was suspected; steps of Y, and those of them without any change.
    suspected_squares : tuple of two floats
        Sums of squares of the residuals of both models in the samples that a sensor was suspected in, µm²: shown, and
        judged by nobody.
    y_um : float, optional
        The last measured Y.
    model_ns : int
        Since when the other model has been compared, ns since 1970 UTC; 0: all the time. Before it was another one
        with the same effects.
    """

    zeros: int = 0
    rows: list[tuple[float, float, float]] = []
    number: int = 0
    blocks: list[Block] = []
    probes: list[ComparedProbe] = []
    first_ns: int = 0
    last_ns: int = 0
    suspected: int = 0
    steps: int = 0
    still: int = 0
    suspected_squares: tuple[float, float] = (0.0, 0.0)
    y_um: float | None = None
    model_ns: int = 0

    @property
    def own_probes(self) -> list[ComparedProbe]:
        """The probes since the other model has been compared itself."""
        return [probe for probe in self.probes if probe.time_utc_ns >= self.model_ns]

    def move_clock(self, by_ns: int) -> None:
        """Move all times, as the clock was set."""
        by = round(by_ns / BLOCK_NS)
        self.number += by
        self.blocks = [msgspec.structs.replace(block, number=block.number + by) for block in self.blocks]
        self.probes = [msgspec.structs.replace(one, time_utc_ns=one.time_utc_ns + by_ns) for one in self.probes]
        self.first_ns, self.last_ns, self.model_ns = (
            moved(at, by_ns) for at in (self.first_ns, self.last_ns, self.model_ns)
        )


class Comparison:
    """Compares two models.

    Parameters
    ----------
    period_s : float
        Length of a sample, s.
    state : ComparisonState, optional
        What was compared before.
    axis : str
        The axis whose measured values count; probes are of Y.
    """

    def __init__(self, period_s: float, state: ComparisonState | None = None, *, axis: str = FIRST) -> None:
        self._fewest = _MEASURED * BLOCK_MIN * 60.0 / period_s
        self._period_s, self._axis = period_s, axis
        self.state = state if state is not None else ComparisonState()

    def add(self, present: Outcome, candidate: Outcome, *, suspected: bool) -> bool:
        """Add a sample with its probes; return whether the verdict may have changed.

        Parameters
        ----------
        present, candidate : Outcome
            Outcomes of the sample by both models; with the same probes.
        suspected : bool
            Whether a sensor is suspected: the sample is counted, but not compared.
        """
        (own_um, measured_um), (other_um, _) = (_measured(one, self._axis) for one in (present, candidate))
        residuals = own_um, other_um
        probes = [
            (number(own.innovation_um), number(other.innovation_um))
            for own, other in zip(present.probes, candidate.probes, strict=True)
            if self._axis == FIRST
            and (own.taken or other.taken)
            and all(number(one.innovation_std_um) < UNKNOWN_UM for one in (own, other))
        ]
        state, is_measured, now_ns = self.state, math.isfinite(sum(residuals)), present.sample.time_utc_ns
        if suspected:
            if is_measured:
                state.suspected += 1
                own, other = state.suspected_squares
                state.suspected_squares = own + own_um**2, other + other_um**2
            return False
        if not (probes or is_measured):
            return False
        state.first_ns = state.first_ns or now_ns - round(present.sample.period_s * NS)
        state.last_ns = now_ns
        state.probes += [ComparedProbe(now_ns, *pair) for pair in probes]
        return (self._add_measured(*residuals, measured_um, now_ns) if is_measured else False) or bool(probes)

    def set_zero(self) -> None:
        """Begin a new block: Y before and after a zero are not comparable."""
        self._close()
        self.state.zeros += 1

    def go_on_with(self, time_utc_ns: int) -> None:
        """Compare another model with the same effects from now on: what the one before has shown counts for it.

        It was found later, so each value is judged by a model that did not know it.
        """
        self.set_zero()
        self.state.model_ns = time_utc_ns

    def forget_before(self, time_utc_ns: int, keep_probes: int) -> None:
        """Forget what is older than a time, but for the last probes."""
        state, oldest = self.state, time_utc_ns // BLOCK_NS
        state.blocks = [block for block in state.blocks if block.number >= oldest]
        older = len([probe for probe in state.probes if probe.time_utc_ns < time_utc_ns])
        state.probes = state.probes[max(min(older, len(state.probes) - keep_probes), 0) :]
        begins = [state.blocks[0].number * BLOCK_NS] if state.blocks else []
        begins += [state.probes[0].time_utc_ns] if state.probes else []
        state.first_ns = max(state.first_ns, min(begins, default=state.first_ns)) if state.first_ns else 0

    @property
    def judged_h(self) -> float:
        """Time of the usable blocks, h; without the open one."""
        return sum(block.means is not None for block in self.state.blocks) * BLOCK_MIN / 60.0

    @property
    def residuals_um(self) -> list[tuple[int, float, float]]:
        """Number of each usable block since the last zero, and mean residual of the present and the other model, µm."""
        since = [block for block in self.state.blocks if block.zeros == self.state.zeros]
        return [(block.number, *block.means[:2]) for block in since if block.means is not None]

    @property
    def level_um(self) -> float:
        """Mean of the other model's residual less that of the present one since the last zero, µm; 0 if unknown."""
        return float(np.mean([other - own for _, own, other in self.residuals_um] or [0.0]))

    def verdict(self, *, deviations: float = DEVIATIONS) -> ComparisonData:
        """Return the verdict on what was compared.

        Parameters
        ----------
        deviations : float
            From this number of standard deviations on one of the models is refuted (`evidence`).
        """
        by_sensor = self._by_sensor(deviations)
        chosen = by_sensor if by_sensor.why is None or not self.state.probes else self._by_probes(deviations)
        hours = (self.state.last_ns - self.state.first_ns) / HOUR_NS
        return changed(chosen, hours=hours)

    def of_itself(self) -> Comparison:
        """Return what was compared since the other model has been, without the one before it."""
        return self._since(self.state.model_ns)

    def latest(self, *, deviations: float = DEVIATIONS) -> ComparisonData | None:
        """Return the verdict on the latest hours that speak most for the other model; None while there is too little.

        What was true of the hours before may have ended. Each begin, a third earlier than the next one, is a case of
        its own, so together they must show more.
        """
        state = self.state
        is_probed = self.verdict(deviations=deviations).measured_by == "probe"
        probes_ns = [one.time_utc_ns for one in state.probes]
        times_ns = probes_ns if is_probed else [one.number * BLOCK_NS for one in state.blocks]
        counts = [FEWEST_CHANGES + 1]
        while counts[-1] < len(times_ns):
            counts.append(math.ceil(counts[-1] * 4 / 3))
        begins_ns = [times_ns[-count] for count in counts[:-1]]
        wanted = math.sqrt(deviations**2 + 2.0 * math.log(max(len(begins_ns), 1)))
        found = [self._since(begin_ns).verdict(deviations=wanted) for begin_ns in begins_ns]
        shows = [-math.inf if one.deviations is None else one.deviations for one in found]
        return found[shows.index(max(shows))] if found else None

    def _since(self, time_utc_ns: int) -> Comparison:
        """Return what was compared since a time."""
        state = self.state
        blocks = [block for block in state.blocks if block.number * BLOCK_NS >= time_utc_ns]
        probes = [probe for probe in state.probes if probe.time_utc_ns >= time_utc_ns]
        first_ns = max(state.first_ns, time_utc_ns)
        return Comparison(
            self._period_s,
            msgspec.structs.replace(state, blocks=blocks, probes=probes, first_ns=first_ns),
            axis=self._axis,
        )

    def is_itself_better(self) -> bool:
        """Return whether the other model is the better one since it has been compared, however clearly."""
        own = self.of_itself().state
        values, other, _ = _changes(own.blocks)
        if values.size < FEWEST_CHANGES:
            values, other = np.array([(probe.own_um, probe.other_um) for probe in own.probes]).reshape(-1, 2).T
        return values.size >= FEWEST_CHANGES and evidence(values, values - other).likelihood > 0.0

    # ------------------------------------------------------------------ blocks

    def _add_measured(self, own: float, other: float, y_um: float, now_ns: int) -> bool:
        state, block = self.state, now_ns // BLOCK_NS
        closed = bool(state.rows) and block != state.number
        if closed:
            self._close()
        state.number = block
        state.rows = [*state.rows, (own, other, y_um)]
        if state.y_um is not None:
            state.steps, state.still = state.steps + 1, state.still + (y_um == state.y_um)
        state.y_um = y_um
        return closed

    def _close(self) -> None:
        self.state.blocks, self.state.rows = self._blocks(), []

    def _blocks(self) -> list[Block]:
        """Return all blocks, with the open one as far as it goes."""
        state = self.state
        if not state.rows:
            return state.blocks
        own, other, y = np.array(state.rows).T
        means = None
        if y.size >= self._fewest and np.ptp(y) != 0.0:
            means = float(np.mean(own)), float(np.mean(other)), float(np.mean(y))
        squares = float(np.sum(own**2)), float(np.sum(other**2))
        return [*state.blocks, Block(state.zeros, state.number, y.size, squares, means)]

    # ------------------------------------------------------------------ the verdict

    def _by_sensor(self, deviations: float) -> ComparisonData:
        state, blocks = self.state, self._blocks()
        samples = sum(block.samples for block in blocks)
        if not samples and state.suspected:
            own_rms, other_rms = (math.sqrt(square / state.suspected) for square in state.suspected_squares)
            shown = not_judged(NotJudged.SUSPECT)
            return changed(shown, measured_by="sensor", present_rms_um=own_rms, candidate_rms_um=other_rms)
        if not samples:
            return not_judged(NotJudged.NO_Y)
        own_rms, other_rms = _about_zero(blocks, self._fewest)
        scores = ComparisonData(
            verdict=ComparisonVerdict.NOT_JUDGED,
            measured_by="sensor",
            samples=samples,
            present_rms_um=own_rms,
            candidate_rms_um=other_rms,
        )
        own, other, moves = _changes(blocks)
        if own.size < FEWEST_CHANGES:
            still = state.still > 0.5 * state.steps
            suspected = NotJudged.SUSPECT if state.suspected > samples else NotJudged.TOO_LITTLE
            return changed(scores, why=NotJudged.UNRELATED if still else suspected)
        kept = followed(moves, own, own - other, parts=own.size // FEWEST_CHANGES, deviations=deviations)
        if np.sum(kept) < FEWEST_CHANGES:
            return changed(scores, why=NotJudged.UNRELATED)
        return self._judged(scores, own[kept], own[kept] - other[kept], deviations)

    def _by_probes(self, deviations: float) -> ComparisonData:
        own, other = np.array([(probe.own_um, probe.other_um) for probe in self.state.probes]).T
        scores = ComparisonData(
            verdict=ComparisonVerdict.NOT_JUDGED,
            measured_by="probe",
            probes=own.size,
            present_rms_um=rms_of(own),
            candidate_rms_um=rms_of(other),
        )
        if own.size < FEWEST_CHANGES:
            return changed(scores, why=NotJudged.TOO_LITTLE)
        # Each model has been corrected by the probes before: what a probe shows beyond that is a change already.
        return self._judged(scores, own, own - other, deviations)

    def _judged(self, scores: ComparisonData, own: Vector, difference: Vector, deviations: float) -> ComparisonData:
        weighed = evidence(own, difference)
        # What refutes a model may still be no better than it: by half as many deviations it must be.
        shown, also = weighed.likelihood, SURE_PART * deviations
        assert scores.present_rms_um is not None and scores.candidate_rms_um is not None
        verdict, is_larger = ComparisonVerdict.ALIKE, scores.candidate_rms_um > scores.present_rms_um
        if shown >= deviations and weighed.deviations >= also and weighed.ratio < 1.0:
            verdict = ComparisonVerdict.BETTER
        elif shown <= -deviations and weighed.deviations <= -also and weighed.ratio > 1.0 + WORSE_PART:
            verdict = ComparisonVerdict.WORSE
        y_moved = verdict != ComparisonVerdict.ALIKE and is_larger != (verdict == ComparisonVerdict.WORSE)
        scores = changed(scores, verdict=verdict, y_moved=y_moved, ratio=weighed.ratio)
        return changed(scores, deviations=shown, effective=weighed.effective)


def not_judged(why: NotJudged, *, remark: str = "") -> ComparisonData:
    """Return a comparison without a verdict."""
    return ComparisonData(verdict=ComparisonVerdict.NOT_JUDGED, why=why, remark=remark)


def changed(found: ComparisonData, **changes: object) -> ComparisonData:
    """Return a comparison with some of its data replaced."""
    return msgspec.structs.replace(found, **changes)


def _measured(outcome: Outcome, axis: str) -> tuple[float, float]:
    """Return residual and measured deformation of an axis, µm; NaN where it was not measured."""
    estimate = outcome.estimate
    if axis == FIRST:
        return number(estimate.residual_um), number(estimate.y_um)
    assert isinstance(estimate, AxesEstimate)
    residual, measured = (estimate.axes[f"{axis}_{name}"] for name in ("residual_um", "um"))
    assert not isinstance(residual, list)
    assert not isinstance(measured, list)
    return number(residual), number(measured)


def _about_zero(blocks: list[Block], fewest: float) -> tuple[float, float]:
    """Return the root mean squares of both residuals, µm: about the last zero if enough was measured since, or all."""
    last = [block for block in blocks if block.zeros == blocks[-1].zeros]
    used = last if sum(block.samples for block in last) >= 2 * FEWEST_CHANGES * fewest else blocks
    samples = sum(block.samples for block in used)
    own, other = (math.sqrt(sum(block.squares[i] for block in used) / samples) for i in (0, 1))
    return own, other


def _changes(blocks: list[Block]) -> tuple[Vector, Vector, Vector]:
    """Return the changes of both residuals and of Y from each usable block to the next one, about the same zero."""
    rows: list[list[float]] = []
    before: Block | None = None
    for block in blocks:
        if block.means is None:
            before = None
            continue
        if before is not None and (before.zeros, before.number) == (block.zeros, block.number - 1):
            assert before.means is not None
            rows.append([new - old for new, old in zip(block.means, before.means, strict=True)])
        before = block
    own, other, y = np.array(rows).reshape(-1, 3).T
    return own, other, y
