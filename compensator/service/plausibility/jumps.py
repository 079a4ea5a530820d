"""Jumps of T_Q and AT: a channel that has jumped is not used until evidence speaks for it.

From the jump on, two more engines run beside the one that predicts without the channel:

- *believing* takes the channel as it is;
- *shifted* takes it less the jump: the sensor still follows its temperature, but with another zero.

The channel is accepted again if

- it returns to what the shifted engine expects (a contact is mended): the state becomes that of the shifted engine,
  which knows what happened meanwhile;
- the model agrees with it: over the last samples the believing engine has expected T_Q and AT better than the shifted
  one, by a log likelihood ratio (T_Q follows AT, and heat that rises stays). The state becomes that of the believing
  one;
- measured Y, or two probes, agree with the believing engine and contradict the shifted one;
- an operator says so: `resume` believes it, a zero keeps the state and gives the sensor its new zero.

A jump within `rate_max_per_min` is used at first; with `jump_min_k` both engines run for some samples, unless heat
within its range of validity explains a jump of T_Q. Where the shifted one expects them far better, the channel becomes
suspect and the state that of the shifted engine: what the wrong values did is undone.

Everything here is computed from the samples alone, with scalar floats; the state is part of the compensation's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

from compensator.arrays import NAN
from compensator.codes import SampleQuality
from compensator.config import Config
from compensator.events import EventKind, Implausibility, Note
from compensator.messages import ChannelSample, number
from compensator.model.engine import Engine, EngineState, Estimate
from compensator.model.thermal_model import ThermalModel
from compensator.service.plausibility.guards import TEMPERATURES

#: A value counts as expected within this number of standard deviations.
_NEAR = 4.0
#: A returned value may differ by this part of the jump from the expected one, at most by the other part.
_RETURNED, _RETURNED_MOST = 0.2, 0.5
#: Part of the permitted change that the temperature itself makes; beyond it a suspect channel has jumped again.
_NATURAL = 0.5
#: Consecutive samples for which a channel must be back; doubled by each further jump, up to the last number.
BACK_SAMPLES, MOST_BACK_SAMPLES = 3, 30
#: Further jumps from which on the shifted engine no longer follows the channel: a loose contact has no level.
_UNSTEADY = 2
#: Longest gap that is interpolated once a loose contact is back, in samples: a lost heat is worse than a straight line.
BRIDGED_SAMPLES = 480
#: Samples without a jump after which earlier ones count no more.
FORGOTTEN_SAMPLES = 240
#: Deviations at which one sample's evidence is clipped: a switched heat is not evidence against a sensor.
_CLIP = 5.0
#: Weight of the past in the log likelihood ratio of a suspect channel, by sample: about half an hour.
_KEEP = 1.0 - 1.0 / 30.0
#: Log likelihood ratio, and least number of samples, for the model to agree with a channel.
_AGREES, _AGREES_SAMPLES = 12.0, 10
#: A jump within the permitted rate is watched for this number of samples, and refuted at this log likelihood ratio.
WATCHED_SAMPLES, _REFUTED = 15, 12.0
#: Heat beyond its range of validity by this part of the range cannot explain such a jump of T_Q.
_BEYOND = 0.2
#: Standard deviations of the innovation that such a jump exceeds in any case.
_JUMP = 6.0
#: Y speaks for one engine: its residual within the first, the other's larger by the second, in deviations of Y.
_FITS, _CONTRADICTS = 3.0, 4.0
#: Consecutive samples with Y for which it must.
Y_SAMPLES = 10
#: Probes that must speak for a channel: one may have met a chip.
_PROBES = 2
#: Weight of a new residual in the level before a jump.
_LEVEL = 0.1

NAMES = {"t_q_degc": "T_Q", "at_degc": "AT"}


class Branch(msgspec.Struct, kw_only=True, frozen=True):
    """State of one of the two engines, and its last estimate (None before the first sample)."""

    engine: EngineState
    estimate: Estimate | None = None


class JumpState(msgspec.Struct, kw_only=True):
    """State of the watch.

    Parameters
    ----------
    level_um : float
        Mean of measured Y − prediction over the last samples, µm: what a jump is compared with.
    shifts_k : dict of str to float
        By channel that has jumped: measured − expected, K. Empty if none has.
    first_k : dict of str to float
        The first jump of each of them, K.
    again : int
        Jumps after the first one, also of earlier times until `FORGOTTEN_SAMPLES` have passed.
    quiet : int
        Samples since the last jump or return.
    is_suspect : bool
        Whether these channels are not used; otherwise they are watched.
    samples : int
        Samples since the last jump.
    ratio : float
        Log likelihood ratio of the believing over the shifted engine.
    back : dict of str to int
        Consecutive samples for which each channel has been back.
    at_held : int
        Consecutive samples for which AT has been where it was before the jump.
    y_for : int
        Consecutive samples for which measured Y has spoken for the believing engine.
    probes_for : int
        Probes that have spoken for it.
    believing, shifted : Branch, optional
        The two engines; None if no channel has jumped.
    """

    level_um: float = NAN
    shifts_k: dict[str, float] = {}
    first_k: dict[str, float] = {}
    again: int = 0
    quiet: int = FORGOTTEN_SAMPLES
    is_suspect: bool = False
    samples: int = 0
    ratio: float = 0.0
    back: dict[str, int] = {}
    at_held: int = 0
    y_for: int = 0
    probes_for: int = 0
    believing: Branch | None = None
    shifted: Branch | None = None


@dataclass(slots=True)
class _Run:
    """An engine and its last estimate."""

    engine: Engine
    estimate: Estimate | None = None

    def branch(self) -> Branch:
        return Branch(engine=self.engine.snapshot(), estimate=self.estimate)


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a sample has shown.

    Parameters
    ----------
    estimate : Estimate, optional
        The estimate after this sample, if the engine was given another state; None if it is still to be stepped.
    notes : list of Note
        Events.
    accepted : dict of str to float
        Channels that are used again, with their values, °C.
    """

    estimate: Estimate | None = None
    notes: list[Note] = field(default_factory=list)
    accepted: dict[str, float] = field(default_factory=dict)


class JumpWatch:
    """Watches T_Q and AT of one machine for jumps; without `guards.suspect_jumps` it does nothing."""

    def __init__(self, config: Config, model: ThermalModel) -> None:
        self.is_on = config.guards.suspect_jumps
        self._least_k = config.guards.jump_min_k
        self._model = model
        period_min = model.period_s / 60.0
        self._change_k = {
            channel.name: _NATURAL * (channel.rate_max_per_min or math.inf) * period_min
            for channel in config.channel
            if channel.name in TEMPERATURES
        }
        stated = config.plausibility.residual_std_um if config.plausibility is not None else None
        self._y_std_um = stated or model.y_std_um
        self._state = JumpState()
        self._believing: _Run | None = None
        self._shifted: _Run | None = None

    # ------------------------------------------------------------------ state

    @property
    def suspects(self) -> tuple[str, ...]:
        """Channels that are not used."""
        return tuple(self._state.shifts_k) if self._state.is_suspect else ()

    @property
    def state(self) -> JumpState:
        """State after the last sample."""
        return msgspec.structs.replace(
            self._state,
            believing=self._believing.branch() if self._believing else None,
            shifted=self._shifted.branch() if self._shifted else None,
        )

    def restore(self, state: JumpState | None) -> None:
        """Continue from a state; None if it is that of a version without this watch.

        Raises
        ------
        ValueError
            If it does not belong to the model.
        """
        state = state or JumpState()
        runs = [self._run_of(branch) for branch in (state.believing, state.shifted)]
        if (None in runs) != (not state.shifts_k) or not set(state.shifts_k) <= set(TEMPERATURES):
            raise ValueError("state of a jump that is incomplete")
        self._believing, self._shifted = runs
        self._state = msgspec.structs.replace(
            state,
            believing=None,
            shifted=None,
            shifts_k=dict(state.shifts_k),
            first_k=dict(state.first_k),
            back=dict(state.back),
        )

    def _new_run(self) -> _Run:
        return _Run(Engine(self._model, bridge_samples=BRIDGED_SAMPLES))

    def _run_of(self, branch: Branch | None) -> _Run | None:
        if branch is None:
            return None
        run = self._new_run()
        run.engine.check(branch.engine)
        run.engine.restore(branch.engine)
        run.estimate = branch.estimate
        return run

    def reset(self) -> None:
        """Forget the level of measured Y, and jumps that are only watched: there is another zero or another state."""
        self._state.level_um = NAN
        if not self._state.is_suspect:
            self._end()

    def pass_time(self, samples: int, *, held: bool) -> None:
        """Account for samples that were not measured."""
        for run in (self._believing, self._shifted):
            if run is not None:
                run.estimate = run.engine.skip(samples, held=held)

    def release(self, engine: Engine, *, new_zero: bool) -> tuple[list[str], Estimate | None]:
        """Use suspect channels again because an operator says so.

        Parameters
        ----------
        engine : Engine
            Engine of the compensation; its state becomes that of one of the two engines.
        new_zero : bool
            Whether the sensors have another zero from now on; otherwise their values are believed since the jump.

        Returns
        -------
        list of str
            The channels.
        Estimate or None
            The estimate of the new state; None if nothing was suspect.
        """
        names, believing, shifted = list(self.suspects), self._believing, self._shifted
        if not names or believing is None or shifted is None:
            return [], None
        new_zero = new_zero and self._model.inputs == "changes"
        run = shifted if new_zero else believing
        engine.restore(run.engine.snapshot())
        if new_zero:
            shifts = self._state.shifts_k
            engine.shift_reference(shifts.get("t_q_degc", 0.0), shifts.get("at_degc", 0.0))
        estimate = run.estimate
        self._end()
        return names, estimate

    def _end(self) -> None:
        self._believing = self._shifted = None
        old = self._state
        if old.is_suspect:
            self._state = JumpState(again=old.again, quiet=0)
        else:
            self._state = JumpState(level_um=old.level_um, again=old.again, quiet=old.quiet)

    # ------------------------------------------------------------------ one sample

    def update(
        self, engine: Engine, channels: Mapping[str, ChannelSample], others: Mapping[str, float], y_um: float
    ) -> Judgement:
        """Judge a sample before the engine's step.

        Parameters
        ----------
        engine : Engine
            Engine of the compensation, after the sample before.
        channels : mapping of str to ChannelSample
            Channels with their final quality.
        others : mapping of str to float
            Usable values of the auxiliary channels.
        y_um : float
            Measured Y, µm; NaN if it cannot be used.
        """
        offered = {name: _offered(channels.get(name)) for name in TEMPERATURES}
        jumped = [name for name in TEMPERATURES if _quality(channels.get(name)) == SampleQuality.TOO_FAST]
        notes: list[Note] = []
        if jumped and not self._state.is_suspect:
            self._begin(engine, is_suspect=True)
        elif not self._state.shifts_k and self._least_k is not None:
            jumped = self._watchable(engine, offered)
            if jumped:
                self._begin(engine, is_suspect=False)
        believing, shifted = self._believing, self._shifted
        if believing is None or shifted is None:
            return Judgement()
        found = self._fed(shifted, offered, jumped)
        self._compare_held(engine, offered["at_degc"])
        if found.jumped and self._state.is_suspect:
            believing.engine.restore(shifted.engine.snapshot())
            self._start_evidence()
            notes += [self._jump_note(name) for name in jumped if name in found.jumped]
        self._weigh(believing, shifted, offered, found)
        believing.estimate = believing.engine.step(offered["t_q_degc"], offered["at_degc"], others)
        shifted.estimate = shifted.engine.step(found.values["t_q_degc"], found.values["at_degc"], others)
        self._state.samples += 1
        self._weigh_y(y_um)
        verdict = self._suspected(engine, offered) if self._state.is_suspect else self._watched(engine)
        return Judgement(verdict.estimate, [*notes, *verdict.notes], verdict.accepted)

    def receive_probe(self, innovation_um: float, std_um: float, predicted_um: float) -> None:
        """Compare both engines with a probe.

        Parameters
        ----------
        innovation_um : float
            Probe − prediction of the compensation, µm.
        std_um : float
            Standard deviation of the probe, µm.
        predicted_um : float
            Prediction of the compensation after the last sample, µm, without a correction.
        """
        believing, shifted = self._believing, self._shifted
        if not self.suspects or believing is None or shifted is None or math.isnan(innovation_um):
            return
        if believing.estimate is None or shifted.estimate is None:
            return
        shown_um, std_um = innovation_um + predicted_um, math.hypot(std_um, self._y_std_um)
        if _speaks_for(shown_um, believing.estimate, shifted.estimate, std_um):
            self._state.probes_for += 1

    def observe(self, y_um: float, estimate: Estimate) -> None:
        """Count quiet samples, and follow the level of measured Y − prediction, which a later jump is compared with."""
        state = self._state
        if not self.is_on or state.shifts_k:
            return
        state.quiet = min(state.quiet + 1, FORGOTTEN_SAMPLES)
        if math.isnan(y_um):
            return
        residual = y_um - estimate.y_um
        state.level_um = (
            residual if math.isnan(state.level_um) else state.level_um + _LEVEL * (residual - state.level_um)
        )

    # ------------------------------------------------------------------ inside

    def _begin(self, engine: Engine, *, is_suspect: bool) -> None:
        snapshot = engine.snapshot()
        self._believing, self._shifted = self._new_run(), self._new_run()
        for run in (self._believing, self._shifted):
            run.engine.restore(snapshot)
        old = self._state
        again = old.again + 1 if old.quiet < FORGOTTEN_SAMPLES else 0
        self._state = JumpState(level_um=old.level_um, is_suspect=is_suspect, again=again)

    def _watchable(self, engine: Engine, offered: Mapping[str, float]) -> list[str]:
        """Return the channels that differ from what the engine expects by more than its deviation explains."""
        if math.isnan(offered["t_q_degc"]) or math.isnan(offered["at_degc"]) or self._least_k is None:
            return []
        at_degc, t_q_degc, least_k = offered["at_degc"], offered["t_q_degc"], self._least_k
        # T_Q follows AT if AT is right, and not if it is wrong: only what neither explains is a jump of T_Q.
        with_at, without = engine.forecast(at_degc), engine.forecast(NAN)
        found = []
        if abs(at_degc - without.at_k) > max(least_k, _JUMP * without.at_std_k):
            found.append("at_degc")
        jumps = [t_q_degc - expected.t_q_k for expected in (with_at, without)]
        limits = [max(least_k, _JUMP * expected.t_q_std_k) for expected in (with_at, without)]
        if all(abs(k) > most and not self._is_heat(engine.drive_for(k)) for k, most in zip(jumps, limits, strict=True)):
            found.append("t_q_degc")
        return found

    def _is_heat(self, heat_w: float) -> bool:
        """Return whether there can be so much heat; a short burst of it looks like a jump for many minutes."""
        if "heat_w" not in self._model.validity:
            return True
        low, high = self._model.validity["heat_w"]
        beyond = _BEYOND * (high - low)
        return low - beyond <= heat_w <= high + beyond

    def _start_evidence(self) -> None:
        state = self._state
        state.samples, state.ratio, state.y_for, state.probes_for = 0, 0.0, 0, 0

    def _fed(self, shifted: _Run, offered: Mapping[str, float], jumped: list[str]) -> _Fed:
        """Return what the shifted engine is given: at its own zero, less the jump, or missing at a jump."""
        state = self._state
        values: dict[str, float] = {}
        new: list[str] = []
        for name in TEMPERATURES:
            value = offered[name]
            expected, std = _expected(shifted.engine, name, values.get("at_degc", NAN))
            difference = value - expected
            if math.isnan(value):
                values[name] = NAN
            elif name in state.shifts_k:
                shift = state.shifts_k[name]
                near = max(_NEAR * std, _RETURNED * abs(shift))
                # Where the expectation itself is uncertain by the size of the jump, a return shows nothing.
                back = abs(difference) <= near <= _RETURNED_MOST * abs(state.first_k[name])
                # A heat that is switched may bring it back for a moment.
                unsure = min(state.back.get(name, 0), BACK_SAMPLES)
                state.back[name] = state.back.get(name, 0) + 1 if back else 0
                most = max((1 + unsure) * self._change_k[name], _NEAR * std)
                if back:
                    values[name] = value
                elif state.again >= _UNSTEADY:
                    values[name] = NAN
                elif abs(difference - shift) <= most or not state.is_suspect:
                    values[name] = value - shift
                else:
                    new.append(name)
                    state.again += 1
            elif name in jumped:
                new.append(name)
            else:
                values[name] = value
            if name in new:
                state.shifts_k[name], state.back[name], values[name] = difference, 0, NAN
                state.first_k.setdefault(name, difference)
        return _Fed(values, new)

    def _compare_held(self, engine: Engine, at_degc: float) -> None:
        """Count the samples for which AT is where the engine without it holds it: air that a door let in goes again."""
        state, first_k = self._state, abs(self._state.first_k.get("at_degc", NAN))
        expected, std = _expected(engine, "at_degc", NAN)
        near = max(_NEAR * std, _RETURNED * first_k)
        is_back = list(state.shifts_k) == ["at_degc"] and abs(at_degc - expected) <= near <= _RETURNED_MOST * first_k
        state.at_held = state.at_held + 1 if is_back else 0

    def _weigh(self, believing: _Run, shifted: _Run, offered: Mapping[str, float], fed: _Fed) -> None:
        """Add a sample to the log likelihood ratio; the jump itself speaks for neither."""
        cost = 0.0
        for run, values, sign in ((believing, offered, -0.5), (shifted, fed.values, 0.5)):
            for name in TEMPERATURES:
                if name in fed.jumped or math.isnan(values[name]):
                    continue
                expected, std = _expected(run.engine, name, values["at_degc"])
                cost += sign * min(((values[name] - expected) / std) ** 2, _CLIP * _CLIP)
        keep = _KEEP if self._state.is_suspect else 1.0
        self._state.ratio = keep * self._state.ratio + cost

    def _weigh_y(self, y_um: float) -> None:
        y = self._y_votes(y_um)
        if y is not None:
            self._state.y_for = self._state.y_for + 1 if y else 0

    def _y_votes(self, y_um: float) -> bool | None:
        """Return whether measured Y speaks for the believing engine; None if it cannot speak."""
        state, believing, shifted = self._state, self._believing, self._shifted
        if believing is None or shifted is None or believing.estimate is None or shifted.estimate is None:
            return None
        if math.isnan(y_um) or math.isnan(state.level_um) or not self._y_std_um > 0.0:
            return None
        return _speaks_for(y_um - state.level_um, believing.estimate, shifted.estimate, self._y_std_um)

    def _suspected(self, engine: Engine, offered: Mapping[str, float]) -> Judgement:
        state = self._state
        needed = min(BACK_SAMPLES * 2 ** min(state.again, 8), MOST_BACK_SAMPLES)
        if all(state.back.get(name, 0) >= needed for name in state.shifts_k):
            return self._accept(engine, offered, self._shifted, "has returned to what was expected before")
        if state.at_held >= needed:
            return self._accept(engine, offered, None, "has returned to where it was before")
        if state.y_for >= Y_SAMPLES:
            return self._accept(engine, offered, self._believing, "is used again: measured Y agrees with it")
        if state.probes_for >= _PROBES:
            return self._accept(engine, offered, self._believing, "is used again: probes agree with it")
        if state.ratio >= _AGREES and state.samples >= _AGREES_SAMPLES:
            return self._accept(engine, offered, self._believing, "is used again: the model agrees with it")
        return Judgement()

    def _accept(self, engine: Engine, offered: Mapping[str, float], run: _Run | None, how: str) -> Judgement:
        names = list(self._state.shifts_k)
        notes = [
            Note(
                EventKind.PLAUSIBILITY,
                f"{NAMES[name]} {how}",
                {"code": Implausibility.ACCEPTED, "channel": name, "shift_k": self._state.shifts_k[name]},
            )
            for name in names
        ]
        estimate = None
        if run is not None:
            engine.restore(run.engine.snapshot())
            estimate = run.estimate
        self._end()
        return Judgement(estimate, notes, {name: offered[name] for name in names})

    def _watched(self, engine: Engine) -> Judgement:
        """Decide whether a jump within the permitted rate was one of the sensor."""
        state, shifted = self._state, self._shifted
        assert shifted is not None
        if state.ratio <= -_REFUTED:
            engine.restore(shifted.engine.snapshot())
            estimate = shifted.estimate
            if all(state.back.get(name, 0) > 0 for name in state.shifts_k):
                notes = [self._jump_note(name, "and has returned") for name in state.shifts_k]
                self._end()
            else:
                notes = [self._jump_note(name) for name in state.shifts_k]
                state.is_suspect = True
                self._start_evidence()
            return Judgement(estimate, notes)
        if state.samples >= WATCHED_SAMPLES:
            self._end()
        return Judgement()

    def _jump_note(self, name: str, then: str = "and is not used until evidence speaks for it") -> Note:
        shift = self._state.shifts_k[name]
        return Note(
            EventKind.PLAUSIBILITY,
            f"{NAMES[name]} has jumped by {shift:+.2f} K against what was expected, {then}",
            {"code": Implausibility.JUMPED, "channel": name, "shift_k": shift},
        )


def _speaks_for(y_um: float, believing: Estimate, shifted: Estimate, std_um: float) -> bool:
    for_it, against = abs(y_um - believing.y_um), abs(y_um - shifted.y_um)
    return for_it < _FITS * std_um and against > for_it + _CONTRADICTS * std_um


@dataclass(frozen=True, slots=True)
class _Fed:
    """Values for the shifted engine, °C, and the channels that have jumped in this sample."""

    values: dict[str, float]
    jumped: list[str]


def _expected(engine: Engine, name: str, at_degc: float) -> tuple[float, float]:
    """Return the expected value of a channel and its standard deviation."""
    found = engine.forecast(at_degc)
    return (found.at_k, found.at_std_k) if name == "at_degc" else (found.t_q_k, found.t_q_std_k)


def _quality(channel: ChannelSample | None) -> str:
    return channel.quality if channel is not None else ""


def _offered(channel: ChannelSample | None) -> float:
    """Return the value of a channel, whether it is used or only suspect; NaN if it cannot be one."""
    usable = (SampleQuality.GOOD, SampleQuality.SUSPECT, SampleQuality.TOO_FAST, SampleQuality.T_Q_BELOW_AT)
    return number(channel.mean) if channel is not None and channel.quality in usable else NAN
