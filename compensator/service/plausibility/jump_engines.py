"""The two engines of a jump: one believes the channel that has jumped, one takes it less the jump."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from compensator.arrays import NAN
from compensator.model.engine import Engine, EngineState, Estimate
from compensator.model.thermal_model import ThermalModel
from compensator.service.plausibility.guards import TEMPERATURES
from compensator.service.plausibility.hindsight import beyond_heat
from compensator.service.plausibility.jump_signs import NEAR
from compensator.service.plausibility.jump_state import Branch, ChannelJump, JumpState, Phase
from compensator.service.plausibility.swapped import Natural, Ways, exchange_of, other_way_round, ways, what_fits

#: A returned value may differ by this part of the jump from the expected one, at most by the other part.
_RETURNED, _RETURNED_MOST = 0.2, 0.5
#: Consecutive samples for which a channel must be back; doubled by each further jump, up to the last number.
BACK_SAMPLES, MOST_BACK_SAMPLES = 3, 30
#: Further samples that one jump may take: a contact that gives way in 3 min is none that comes and goes.
_MOST_STEPS = 2
#: Further jumps from which on the shifted engine no longer follows the channel: a loose contact has no level.
_UNSTEADY = 2
#: Samples for which AT may be on its way back from a jump within the permitted rate; slower moves are the air's.
_MOST_MOVING = 3
#: Samples for which exchanged channels may be neither the one nor the other way, as beside a door; fewer before they
#: are sure to be.
_MOST_CHANGING = 60
#: Samples without a channel that can hide a jump; one missing sample is a reading that failed.
UNSEEN_SAMPLES = 2
#: Longest gap that is interpolated once a loose contact is back, in samples: a lost heat is worse than a straight line.
BRIDGED_SAMPLES = 480
#: Deviations at which one sample's evidence is clipped: a switched heat is not evidence against a sensor.
_CLIP = 5.0
#: Weight of the past in the log likelihood ratio of a suspect channel, by sample: it counts about 30 samples.
_KEEP = 1.0 - 1.0 / 30.0
#: Deviations from which on a heat outside of the range of validity cannot be.
_BEYOND = 2.0
#: Y speaks for an engine whose residual is within the first, and smaller than the other's by the second, in deviations
#: of Y; for the shifted one also within the third part of the other's: how far a sensor jumped is not known exactly.
_FITS, _CONTRADICTS, _FITS_PART = 3.0, 4.0, 0.1


@dataclass(slots=True)
class EngineRun:
    """An engine, its last estimate, and that of a zero on a warm machine if one was set since it runs."""

    engine: Engine
    estimate: Estimate | None = None
    at_zero: Estimate | None = None

    def branch(self) -> Branch:
        """Return its state."""
        return Branch(engine=self.engine.snapshot(), estimate=self.estimate, at_zero=self.at_zero)

    @property
    def grown_um(self) -> float:
        """Predicted deformation since that zero, µm; NaN without an estimate."""
        return grown(self.estimate, self.at_zero)[0] if self.estimate is not None else NAN


@dataclass(frozen=True, slots=True)
class Fed:
    """Values for the shifted engine, °C; the channels that have jumped in this sample; whether it shows an exchange."""

    values: dict[str, float]
    jumped: list[str]
    is_exchange: bool = False


class _Move(Enum):
    """What a channel does in a sample, as the shifted engine sees it."""

    #: It is where it is expected, but for what is left of its jump.
    BACK = "back"
    #: It keeps its jump.
    FOLLOWS = "follows"
    #: It has no level: it is on its way back, or a loose contact.
    NOWHERE = "nowhere"
    #: It jumps, or goes on with the same jump.
    JUMPS, GOES_ON = "jumps", "goes on"


class JumpEngines:
    """The engine that takes a channel as it is, and the one that takes it less its jump.

    Parameters
    ----------
    believing, shifted : EngineRun
        The engines.
    zero_in_use : Estimate, optional
        What the compensation's engine had estimated at a zero on a warm machine, if one was set since they run.

    Attributes
    ----------
    has_given : bool
        Whether the compensation's engine was given the state of one of them in this sample.
    """

    def __init__(self, believing: EngineRun, shifted: EngineRun, zero_in_use: Estimate | None = None) -> None:
        self.believing, self.shifted, self.zero_in_use = believing, shifted, zero_in_use
        self.has_given = False

    @classmethod
    def begin(
        cls, model: ThermalModel, state: EngineState, estimate: Estimate | None, at_zero: Estimate | None
    ) -> JumpEngines:
        """Start both from the compensation's engine, its last estimate and that of a zero that counts."""
        runs = (_new_run(model), _new_run(model))
        for run in runs:
            run.engine.restore(state)
            run.estimate, run.at_zero = estimate, at_zero
        return cls(*runs, at_zero)

    @classmethod
    def restored(cls, model: ThermalModel, state: JumpState) -> JumpEngines | None:
        """Return the engines of a state; None if no channel has jumped.

        Raises
        ------
        ValueError
            If the state does not belong to the model, or is incomplete.
        """
        believing, shifted = (_run_of(model, branch) for branch in (state.believing, state.shifted))
        are_both = believing is not None and shifted is not None
        is_open = bool(state.jumps)
        if not (are_both == is_open == (state.phase != Phase.NONE)) or not set(state.jumps) <= set(TEMPERATURES):
            raise ValueError("state of a jump that is incomplete")
        if state.may_be_exchanged and len(state.jumps) != len(TEMPERATURES):
            raise ValueError("state of an exchange of one channel")
        if not set(state.jumps) <= set(state.last):
            raise ValueError("state of a jump of a channel without a value")
        beside = state.beside
        if beside is not None and not (
            state.is_suspect and len(state.jumps) == 1 and not set(beside.jumps) & set(state.jumps)
        ):
            raise ValueError("state of a jump beside none")
        if believing is None or shifted is None:
            return None
        return cls(believing, shifted, _checked(model, state.zero_in_use))

    def set_zero(self, used: Estimate | None) -> None:
        """Count what each of them predicts from the last sample on: a zero is not of one of two answers.

        Parameters
        ----------
        used : Estimate or None
            That of the compensation's engine.
        """
        self.believing.at_zero, self.shifted.at_zero = self.believing.estimate, self.shifted.estimate
        self.zero_in_use = used

    def take_zero(self, at_zero: Estimate | None) -> None:
        """Count from a zero on that is older than they are."""
        self.believing.at_zero = self.shifted.at_zero = self.zero_in_use = at_zero

    def shift_reference(self, t_q_k: float, at_k: float) -> None:
        """Account for another zero of the sensors, K."""
        for run in (self.believing, self.shifted):
            run.engine.shift_reference(t_q_k, at_k)

    def give(self, engine: Engine, run: EngineRun) -> Estimate | None:
        """Give the compensation's engine the state of one of them, with its zero, and return its estimate."""
        engine.restore(run.engine.snapshot())
        self.zero_in_use, self.has_given = run.at_zero, True
        return run.estimate

    def pass_time(self, samples: int, *, held: bool) -> None:
        """Account for samples that were not measured."""
        for run in (self.believing, self.shifted):
            run.estimate = run.engine.skip(samples, held=held)

    def believe_from_used(self, engine: Engine) -> None:
        """Let the believing engine go on from the compensation's: the channel jumps again."""
        self.believing.engine.restore(engine.snapshot())
        self.believing.at_zero = self.zero_in_use

    def believe_from_shifted(self) -> None:
        """Let the believing engine go on from the shifted one: the channel jumps again, or what it showed was wrong."""
        self.believing.engine.restore(self.shifted.engine.snapshot())
        self.believing.at_zero = self.shifted.at_zero

    def go_without(
        self, engine: Engine, suspects: Sequence[str], offered: Mapping[str, float], others: Mapping[str, float]
    ) -> Estimate:
        """Step the compensation's engine without suspect channels, and let it bridge as long as these engines do.

        Parameters
        ----------
        engine : Engine
            Engine of the compensation.
        suspects : sequence of str
            Channels that are not used.
        offered, others : mapping of str to float
            Measured temperatures, °C, and usable values of the auxiliary channels.
        """
        without = Engine(engine.model, bridge_samples=BRIDGED_SAMPLES)
        without.restore(engine.snapshot())
        values = {name: NAN if name in suspects else value for name, value in offered.items()}
        estimate = without.step(values["t_q_degc"], values["at_degc"], others)
        engine.restore(without.snapshot())
        return estimate

    def step(
        self,
        offered: Mapping[str, float],
        fed: Mapping[str, float],
        others: Mapping[str, float],
        stepped: Estimate | None,
    ) -> None:
        """Step both by a sample, each by its values; `stepped` is the estimate of the shifted one if it already is."""
        self.believing.estimate = self.believing.engine.step(offered["t_q_degc"], offered["at_degc"], others)
        self.shifted.estimate = stepped or self.shifted.engine.step(fed["t_q_degc"], fed["at_degc"], others)

    def feed(
        self,
        state: JumpState,
        offered: Mapping[str, float],
        jumped: list[str],
        change_k: Mapping[str, float],
        least_k: float,
    ) -> Fed:
        """Return what the shifted engine is given: at its own zero, less the jump, or missing at a jump.

        Parameters
        ----------
        state : JumpState
            State of the watch; jumps and returns are entered.
        offered : mapping of str to float
            Measured values, °C.
        jumped : list of str
            Channels that have jumped in this sample by their rate, or by what the engine expects.
        change_k : mapping of str to float
            By channel: part of the permitted change of a sample that the temperature itself makes, K.
        least_k : float
            Smallest jump that is looked for, K: from there on what is left of one after a return is another zero.
        """
        if state.may_be_exchanged:
            exchanged = self._feed_exchanged(
                state, offered, Natural(least_k, change_k["t_q_degc"], change_k["at_degc"])
            )
            if exchanged is not None:
                return exchanged
            state.exchanged = "refuted"
        values: dict[str, float] = {}
        new: list[str] = []
        for name in TEMPERATURES:
            value = offered[name]
            expected, std = expected_value(self.shifted.engine, name, values.get("at_degc", NAN))
            difference = value - expected
            if math.isnan(value):
                values[name] = NAN
                continue
            if name in state.jumps:
                move = _move(state, name, difference, std, change_k[name], least_k, is_fast=name in jumped)
            else:
                move = _Move.JUMPS if name in jumped else _Move.BACK
            if move == _Move.BACK:
                values[name] = value - (state.jumps[name].left_k if name in state.jumps else 0.0)
            elif move == _Move.FOLLOWS:
                values[name] = value - state.jumps[name].size_k
            else:
                values[name] = NAN
            if move in {_Move.JUMPS, _Move.GOES_ON}:
                new.append(name)
                _enter_jump(state, name, difference, std, goes_on=move == _Move.GOES_ON)
        is_asked = state.exchanged == "no" and (state.age == 0 or not state.is_unconfirmed)
        if new and is_asked and not is_unsteady(state) and not any(map(math.isnan, offered.values())):
            state.exchanged = exchange_of(self.shifted.engine, offered)
            # Beside AT that has jumped T_Q may look like one whose heat is switched off.
            for name in TEMPERATURES if state.may_be_exchanged else ():
                if name not in new:
                    new.append(name)
                    expected, std = expected_value(self.shifted.engine, name, NAN)
                    _enter_jump(state, name, offered[name] - expected, std, goes_on=False)
                values[name] = NAN
        return Fed(values, new, state.exchanged == "yes")

    def _feed_exchanged(self, state: JumpState, offered: Mapping[str, float], natural: Natural) -> Fed | None:
        """Return what the shifted engine is given of exchanged channels; None if they are no longer."""
        is_missing, engine = any(map(math.isnan, offered.values())), self.shifted.engine
        found = Ways.NEITHER if is_missing else ways(engine, offered, natural, is_doubtful=state.moving > 0)
        for jump in state.jumps.values():
            jump.back = jump.back + 1 if found == Ways.STRAIGHT else 0
        if found == Ways.NEITHER:
            state.moving += not is_missing
            most = _MOST_CHANGING if state.exchanged == "yes" else _MOST_MOVING
            if state.moving >= most:
                return None
            is_sure = not is_missing and state.exchanged == "yes"
            return Fed(
                what_fits(engine, offered, natural) if is_sure else dict.fromkeys(TEMPERATURES, NAN),
                [],
            )
        state.moving = 0
        is_straight = found in {Ways.STRAIGHT, Ways.RATHER_STRAIGHT}
        is_new = found == Ways.SWAPPED and state.exchanged == "perhaps"
        state.exchanged = "yes" if is_new else state.exchanged
        return Fed(dict(offered) if is_straight else other_way_round(offered), [], is_new)

    def goes_away(self, state: JumpState, offered: Mapping[str, float]) -> bool:
        """Return whether the channels that have jumped move further away from what the shifted engine expects."""
        for name in state.jumps:
            expected, _ = expected_value(self.shifted.engine, name, offered["at_degc"])
            last = state.last.get(name, NAN)
            if not (offered[name] - last) * (last - expected) > 0.0:
                return False
        return True

    def may_be(self, state: JumpState, offered: Mapping[str, float]) -> bool:
        """Return whether none is missing, and those that have jumped are where the shifted engine expects them."""
        if any(map(math.isnan, offered.values())):
            return False
        for name in state.jumps:
            expected, std = expected_value(self.shifted.engine, name, offered["at_degc"])
            if abs(offered[name] - expected) > NEAR * std:
                return False
        return True

    def fits(self, engine: Engine, state: JumpState, offered: Mapping[str, float]) -> bool:
        """Return whether an engine expects the channels that have jumped rather than the shifted one does."""
        ratio = 0.0
        for name in state.jumps:
            if not math.isnan(offered[name]):
                for one, sign in ((engine, 1.0), (self.shifted.engine, -1.0)):
                    expected, std = expected_value(one, name, offered["at_degc"])
                    ratio -= sign * (0.5 * ((offered[name] - expected) / std) ** 2 + math.log(std))
        return ratio >= 0.0

    def weigh(self, state: JumpState, offered: Mapping[str, float], fed: Fed) -> None:
        """Add a sample to the log likelihood ratio; the jump itself speaks for neither."""
        if is_unsteady(state) or state.may_be_exchanged:
            # The shifted engine goes without the channel: this would compare what they know, not whether it is right.
            # Of exchanged ones it is given what fits.
            return
        cost = 0.0
        for run, values, sign in ((self.believing, offered, -0.5), (self.shifted, fed.values, 0.5)):
            for name in TEMPERATURES:
                if name in fed.jumped or math.isnan(fed.values[name]):
                    continue
                expected, std = expected_value(run.engine, name, values["at_degc"])
                cost += sign * min(((values[name] - expected) / std) ** 2, _CLIP * _CLIP)
                if state.is_unconfirmed:
                    # After samples without the channel the two engines are not equally sure.
                    cost += sign * 2.0 * math.log(std)
        keep = _KEEP if state.is_suspect else 1.0
        state.ratio = keep * state.ratio + cost
        believed = self.believing.estimate
        if believed is not None and beyond_heat(self.believing.engine.model, believed) > _BEYOND:
            # What agrees with a heat that cannot be does not agree.
            state.ratio = min(state.ratio, 0.0)

    def swap(self) -> None:
        """Believe what the shifted engine expected: the other one is the doubt from here on."""
        self.believing, self.shifted = self.shifted, self.believing

    def agree(self) -> bool:
        """Return whether both predict the same, within the standard deviation of one."""
        one = self.believing.estimate
        return one is not None and abs(self.believing.grown_um - self.shifted.grown_um) <= one.y_std_um

    def fits_y(self, grown_um: float, std_um: float) -> bool:
        """Return whether a value of Y, see `speaks`, agrees with the believing engine."""
        return abs(grown_um - self.believing.grown_um) < _FITS * std_um

    def favours(self, grown_um: float, std_um: float) -> float:
        """Return the log likelihood ratio of a value of Y, see `speaks`, for the believing engine.

        It is 0 where neither agrees with the value.
        """
        believing, shifted = (abs(grown_um - run.grown_um) / std_um for run in (self.believing, self.shifted))
        if min(believing, shifted) >= _FITS:
            return 0.0
        return 0.5 * (min(shifted, _CLIP) ** 2 - min(believing, _CLIP) ** 2)

    def speaks(self, grown_um: float, std_um: float) -> int:
        """Return for which engine a value of Y speaks: it agrees with that one and contradicts the other.

        Parameters
        ----------
        grown_um, std_um : float
            Deformation since the zero by that value, and its standard deviation, µm.

        Returns
        -------
        int
            1 for the believing engine, -1 for the shifted one, 0 for neither.
        """
        believing, shifted = (abs(grown_um - run.grown_um) / std_um for run in (self.believing, self.shifted))
        if believing < _FITS and shifted > believing + _CONTRADICTS:
            return 1
        return -1 if shifted < max(_FITS, _FITS_PART * believing) and believing > shifted + _CONTRADICTS else 0


def _move(
    state: JumpState, name: str, difference: float, std: float, change_k: float, least_k: float, *, is_fast: bool
) -> _Move:
    """Find what a channel that has jumped does now; its counts are kept in the state."""
    jump = state.jumps[name]
    shift = jump.size_k
    # A heat that is switched may bring T_Q back for a moment.
    unsure = min(jump.back, BACK_SAMPLES) if name == "t_q_degc" else 0
    if state.is_air:  # AT on its way back widens what is expected, not where it was
        is_back = abs(difference) <= (_RETURNED * abs(shift) if shift else NEAR * std)
    else:
        is_back = _has_returned(difference, std, shift, jump.first_k)
        # One sample after others without it may have been wrong: what is expected is as uncertain as it was then.
        is_back |= not (state.is_suspect or is_unsteady(state)) and abs(difference) <= _RETURNED * abs(shift)
    back = jump.back
    is_settling = 0 < back < needed_samples(state) and not state.is_air
    if is_settling and abs(difference - jump.left_k) > max(NEAR * std, 0.5 * least_k):
        back = 0  # what is left of a jump is where the channel comes to rest
    jump.back = back + 1 if is_back else 0
    if jump.back <= 1:
        is_part = is_back and abs(difference) > max(0.0 if state.is_air else NEAR * std, least_k)
        jump.left_k = difference if is_part else 0.0
    if is_back:
        state.moving = 0
        return _Move.BACK
    if is_fast and not state.is_suspect:
        return _Move.JUMPS
    if is_unsteady(state):
        return _Move.NOWHERE
    if state.is_air and shift and difference / shift < 1.0 - _RETURNED and state.moving < _MOST_MOVING:
        # A door closes: where AT comes to rest says whether it is back.
        state.moving += 1
        return _Move.NOWHERE
    if not state.is_suspect or abs(difference - shift) <= max((1 + unsure) * change_k, NEAR * std):
        state.moving = 0
        return _Move.FOLLOWS
    is_same_way = (difference - shift) * shift > 0.0
    return _Move.GOES_ON if is_same_way and state.samples == 1 and state.steps < _MOST_STEPS else _Move.JUMPS


def _enter_jump(state: JumpState, name: str, difference: float, std: float, *, goes_on: bool) -> None:
    """Enter a jump, or the next step of one, in the state."""
    before = state.jumps.get(name) if state.is_suspect else None
    state.steps += before is not None and goes_on
    if before is not None and not goes_on:
        state.again[name] = state.again.get(name, 0) + 1
    if state.phase == Phase.AIR_RETURNED:
        state.phase = Phase.AIR
    # What goes on to move, from sample to sample or while it is only watched, is one jump; a suspect channel that had
    # come to rest has jumped again.
    first_k = before.first_k if before is not None and not goes_on else difference
    state.jumps[name] = ChannelJump(size_k=difference, std_k=std, first_k=first_k)


def is_unsteady(state: JumpState) -> bool:
    """Return whether the channels that have jumped are those of a loose contact: the shifted engine goes without."""
    return state.most_again >= _UNSTEADY and not state.is_air and (state.is_suspect or state.is_unconfirmed)


def needed_samples(state: JumpState) -> int:
    """Return for how many samples a suspect channel must be back, or come to rest."""
    return min(BACK_SAMPLES << min(state.most_again, 8), MOST_BACK_SAMPLES)


def moves(state: JumpState, offered: Mapping[str, float], change_k: Mapping[str, float]) -> bool:
    """Return whether a loose contact jumps from the last sample to this one, or is open."""
    return any(
        state.unseen.get(name, 0) >= UNSEEN_SAMPLES or abs(offered[name] - state.last.get(name, NAN)) > change_k[name]
        for name in state.jumps
    )


def count_held(state: JumpState, engine: Engine, at_degc: float, least_k: float) -> None:
    """Count the samples for which AT is where the engine without it holds it: air that a door let in goes again.

    Parameters
    ----------
    state : JumpState
        State of the watch, which keeps the count.
    engine : Engine
        Engine of the compensation.
    at_degc : float
        Measured AT, °C.
    least_k : float
        Smallest jump that is looked for, K.
    """
    expected, std = expected_value(engine, "at_degc", NAN)
    jump, difference = state.jumps.get("at_degc"), at_degc - expected
    # Air goes back little by little. A couple that is half pushed in jumps back, and part of the way.
    is_back = (
        jump is not None
        and state.is_at_alone
        and (abs(difference) <= least_k or (jump.size_k == jump.first_k and not jump.left_k))
        and _has_returned(difference, std, jump.first_k, jump.first_k)
    )
    state.at_held = state.at_held + 1 if is_back else 0


def count_as_used(state: JumpState, engine: Engine, offered: Mapping[str, float]) -> None:
    """Count the samples for which all channels are where they are expected by what they showed while they were used.

    Parameters
    ----------
    state : JumpState
        State of the watch, which keeps the count.
    engine : Engine
        Engine of the compensation, which goes on without them.
    offered : mapping of str to float
        Measured temperatures, °C.
    """
    is_as_used = state.phase == Phase.SUSPECT_AFTER_USE
    for name, jump in state.jumps.items():
        expected, std = expected_value(engine, name, NAN if "at_degc" in state.jumps else offered["at_degc"])
        # As for a return: where the expectation itself is uncertain by the size of the jump, it shows nothing.
        near = NEAR * std
        is_as_used &= abs(offered[name] - expected) <= near <= _RETURNED_MOST * max(abs(jump.first_k), abs(jump.size_k))
    state.as_used = state.as_used + 1 if is_as_used else 0


def expected_value(engine: Engine, name: str, at_degc: float) -> tuple[float, float]:
    """Return the expected value of a channel and its standard deviation, °C and K."""
    found = engine.forecast(at_degc)
    return (found.at_k, found.at_std_k) if name == "at_degc" else (found.t_q_k, found.t_q_std_k)


def shifts_against(engine: Engine, state: JumpState) -> dict[str, float]:
    """Return by how much the last values of the channels that have jumped differ from what an engine expects, K."""
    at_degc = NAN if "at_degc" in state.jumps else state.last.get("at_degc", NAN)
    return {name: state.last[name] - expected_value(engine, name, at_degc)[0] for name in state.jumps}


def grown(estimate: Estimate, at_zero: Estimate | None) -> list[float]:
    """Return Y, µm, and the further outputs in their units, since a zero on a warm machine if one was set."""
    values = _values(estimate)
    if at_zero is None:
        return values
    return [value - zero for value, zero in zip(values, _values(at_zero), strict=True)]


def contradicts(grown_um: float, std_um: float, estimate: Estimate, at_zero: Estimate | None) -> bool:
    """Return whether a value of Y, see `JumpEngines.speaks`, does not agree with an estimate; not where it is NaN."""
    return abs(grown_um - grown(estimate, at_zero)[0]) >= _FITS * std_um


def stds(estimate: Estimate) -> list[float]:
    """Return the standard deviations of Y, µm, and of the further outputs in their units."""
    return [estimate.y_std_um, *(output.std for output in estimate.outputs)]


def _values(estimate: Estimate) -> list[float]:
    return [estimate.y_um, *(output.value for output in estimate.outputs)]


def _has_returned(difference: float, std: float, shift: float, first: float) -> bool:
    near = max(NEAR * std, _RETURNED * abs(shift))
    # Where the expectation itself is uncertain by the size of the jump, a return shows nothing.
    return abs(difference) <= near <= _RETURNED_MOST * max(abs(first), abs(shift))


def _new_run(model: ThermalModel) -> EngineRun:
    return EngineRun(Engine(model, bridge_samples=BRIDGED_SAMPLES))


def _run_of(model: ThermalModel, branch: Branch | None) -> EngineRun | None:
    if branch is None:
        return None
    run = _new_run(model)
    run.engine.check(branch.engine)
    run.engine.restore(branch.engine)
    run.estimate, run.at_zero = _checked(model, branch.estimate), _checked(model, branch.at_zero)
    return run


def _checked(model: ThermalModel, estimate: Estimate | None) -> Estimate | None:
    """Return an estimate of a state if it can be one of the model."""
    if estimate is not None and len(estimate.outputs) != len(model.outputs):
        raise ValueError(f"state of a jump with {len(estimate.outputs)} further outputs")
    if estimate is not None and len(estimate.y_effects_um) != len(model.effects):
        raise ValueError(f"state of a jump with {len(estimate.y_effects_um)} effects")
    return estimate
