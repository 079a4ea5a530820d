"""State of the watch for jumps of T_Q and AT."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from enum import StrEnum
from typing import Literal

import msgspec

from compensator.arrays import NAN
from compensator.messages import Count, Number
from compensator.model.engine import EngineState, Estimate
from compensator.service.plausibility.hindsight import HindsightState

#: Samples without a jump after which earlier ones count no more.
FORGOTTEN_SAMPLES = 240


Exchanged = Literal["no", "perhaps", "yes", "refuted"]


class Phase(StrEnum):
    """What is known of the channels that have jumped."""

    #: No channel has.
    NONE = "none"
    #: They are used and watched: a jump within the permitted rate, or heat, or air.
    WATCHED = "watched"
    #: They are not used.
    SUSPECT = "suspect"
    #: They are not used; until they jumped again they were, and the compensation's engine knows what they showed.
    SUSPECT_AFTER_USE = "suspect_after_use"
    #: They are used, and read otherwise than expected, after samples without them or beside another jump.
    UNCONFIRMED = "unconfirmed"
    #: AT alone, used: it has moved within its permitted rate, and T_Q has not followed.
    AIR = "air"
    #: The same AT has returned; the shifted engine is the one that has believed it meanwhile.
    AIR_RETURNED = "air_returned"


class Branch(msgspec.Struct, kw_only=True, frozen=True):
    """State of one of the two engines, its last estimate, and that of a zero on a warm machine (None before them)."""

    engine: EngineState
    estimate: Estimate | None = None
    at_zero: Estimate | None = None


class ChannelJump(msgspec.Struct, kw_only=True):
    """What a channel that has jumped shows.

    Parameters
    ----------
    size_k : float
        Measured − expected, K.
    std_k : float
        Standard deviation of what was expected at the last jump, K.
    first_k : float
        The first jump, K.
    back : int
        Consecutive samples for which it has been back.
    left_k : float
        If it is back: what is left of its jump, K; 0 where that is too little to be one.
    """

    size_k: Number
    std_k: Number
    first_k: Number
    back: Count = 0
    left_k: Number = 0.0


class JumpState(msgspec.Struct, kw_only=True):
    """State of the watch.

    Parameters
    ----------
    level_um : float
        Mean of measured Y − prediction over the last samples, or Y at a zero since a jump, µm; of the watch as a whole.
    zero_um : float
        Measured Y that stands for no deformation by the zero, µm; of the watch as a whole.
    noise_um2 : float
        Variance of the noise of Y by the last samples without a jump under way, µm²; of the watch as a whole.
    last_um : float
        The last residual of these, µm; NaN if the last sample had none; of the watch as a whole.
    jumps : dict of str to ChannelJump
        By channel that has jumped. Empty if none has.
    steps : int
        Further samples that these jumps have taken.
    again : dict of str to int
        Jumps after the first one, also of earlier times until `FORGOTTEN_SAMPLES` have passed.
    quiet : dict of str to int
        Samples since the last jump or return.
    phase : Phase
        What is known of these channels.
    samples : int
        Samples since the last jump.
    ratio : float
        Log likelihood ratio of the believing over the shifted engine.
    exchanged : {"no", "perhaps", "yes", "refuted"}
        Whether T_Q and AT read each other's temperature; perhaps: the last sample may be a mean of both ways; refuted:
        what they read then was neither.
    moving : int
        Consecutive samples for which AT of `Phase.AIR`, or exchanged channels, have been on their way back.
    at_held : int
        Consecutive samples for which AT has been where it was before the jump.
    as_used : int
        Consecutive samples for which all are where they are expected by what they showed while they were used.
    last : dict of str to float
        Values of the last sample with a jump under way, °C.
    unseen : dict of str to int
        By channel: samples since its last value.
    age, loose : int
        Samples since the first jump, or since what they showed was kept; how many of them had passed at the last jump.
    y_for, y_against : int
        Consecutive samples for which measured Y has spoken for the believing engine, and for the shifted one.
    y_zero_for : int
        The same for the believing engine by the change since the zero.
    y_fits : int
        Samples for which that agrees with the believing engine, and perhaps with both, less some for each other one.
    y_ratio : float
        Log likelihood ratio of the believing engine over the shifted one by measured Y and probes.
    probes_for, probes_against : int
        Probes that have spoken for them.
    probes_fit : int
        Probes in a row that agree with the believing engine, and perhaps with both.
    believing, shifted : Branch, optional
        The two engines; None if no channel has jumped.
    learned_um : float
        By how much probes have changed the correction since a jump, µm; of the watch as a whole.
    zero_in_use : Estimate, optional
        What the compensation's engine had estimated at a zero on a warm machine since then.
    beside : JumpState, optional
        State of the watch of the other channel, while one is suspect.
    hindsight : HindsightState, optional
        Whether suspect channels were wrong before their jump; of the watch as a whole.
    learning : int
        Samples for which Y goes on to correct what they have left in the state; of the watch as a whole.
    in_force : bool
        Whether the model in force suspects them, too, beside which this one runs; omitted if not.
    """

    level_um: float = NAN
    zero_um: float = NAN
    noise_um2: Number = 0.0
    last_um: float = NAN
    jumps: dict[str, ChannelJump] = {}
    steps: Count = 0
    again: dict[str, Count] = {}
    quiet: dict[str, Count] = {}
    phase: Phase = Phase.NONE
    age: Count = 0
    loose: Count = 0
    last: dict[str, Number] = {}
    unseen: dict[str, Count] = {}
    samples: Count = 0
    ratio: Number = 0.0
    exchanged: Exchanged = "no"
    moving: Count = 0
    at_held: Count = 0
    as_used: Count = 0
    y_for: Count = 0
    y_against: Count = 0
    y_zero_for: Count = 0
    y_fits: Count = 0
    y_ratio: Number = 0.0
    probes_for: Count = 0
    probes_fit: Count = 0
    probes_against: Count = 0
    believing: Branch | None = None
    shifted: Branch | None = None
    learned_um: Number = 0.0
    zero_in_use: Estimate | None = None
    beside: JumpState | None = None
    hindsight: HindsightState | None = None
    learning: Count = 0
    in_force: bool = False

    @property
    def is_suspect(self) -> bool:
        """Whether these channels are not used."""
        return self.phase in {Phase.SUSPECT, Phase.SUSPECT_AFTER_USE}

    @property
    def is_unconfirmed(self) -> bool:
        """Whether they are used although nothing confirms them."""
        return self.phase == Phase.UNCONFIRMED or self.is_air

    @property
    def is_air(self) -> bool:
        """Whether AT alone is in question, and may have shown the air."""
        return self.phase in {Phase.AIR, Phase.AIR_RETURNED}

    @property
    def may_be_exchanged(self) -> bool:
        """Whether T_Q and AT may read each other's temperature."""
        return self.exchanged in {"perhaps", "yes"}

    @property
    def is_watched(self) -> bool:
        """Whether further moves may belong to a jump within the permitted rate."""
        return self.phase == Phase.WATCHED or self.is_air

    def keep_what_is_left(self) -> None:
        """Go on with what is left of the jumps of the channels that are back; of AT alone even if that is nothing."""
        left = {name: jump.left_k for name, jump in self.jumps.items() if jump.left_k}
        self._keep(left or dict.fromkeys(self.jumps, 0.0))

    def keep_as_used(self) -> None:
        """Go on with the jumps from before they were used; a channel that has only come and gone is in none."""
        self._keep({name: size for name, size in self.kept_k().items() if size})

    def _keep(self, sizes_k: Mapping[str, float]) -> None:
        self.jumps = {
            name: ChannelJump(size_k=size, std_k=self.jumps[name].std_k, first_k=size) for name, size in sizes_k.items()
        }
        self.start_counts()

    def kept_k(self) -> dict[str, float]:
        """Return by how much each channel is off now, K: what is left of its jump where it is back."""
        return {name: jump.left_k if jump.back else jump.size_k for name, jump in self.jumps.items()}

    def is_back(self, samples: int) -> bool:
        """Return whether all channels have been back for so many samples."""
        return all(jump.back >= samples for jump in self.jumps.values())

    @property
    def leaves_something(self) -> bool:
        """Whether something is left of the jump of a channel that is back."""
        return any(jump.left_k for jump in self.jumps.values())

    @property
    def is_at_alone(self) -> bool:
        """Whether AT alone has jumped."""
        return list(self.jumps) == ["at_degc"]

    def start_counts(self) -> None:
        """Count consecutive samples from here on."""
        self.at_held = self.as_used = self.moving = 0
        for jump in self.jumps.values():
            jump.back = 0

    def start_evidence(self) -> None:
        """Count the evidence from here on."""
        self.samples, self.ratio, self.y_ratio = 0, 0.0, 0.0
        self.y_for = self.y_against = self.y_zero_for = self.y_fits = 0
        self.probes_for = self.probes_against = self.probes_fit = 0

    def suspect(self, phase: Phase = Phase.SUSPECT) -> None:
        """Use the channels no longer that were watched or unconfirmed."""
        self.phase = phase
        self.start_evidence()

    def begun(self, phase: Phase, again: Collection[str] = ()) -> JumpState:
        """Return the state when channels have jumped, some of them perhaps `again`, or may have while not seen."""
        counts = {
            name: count + (name in again)
            for name, count in (dict.fromkeys(again, 0) | self.again).items()
            if self.quiet.get(name, FORGOTTEN_SAMPLES) < FORGOTTEN_SAMPLES
        }
        return JumpState(quiet=self.quiet, phase=phase, unseen=self.unseen, again=counts)

    def ended(self) -> JumpState:
        """Return the state when all channels are used again."""
        quiet = dict.fromkeys(self.jumps, 0) if self.is_suspect else {}
        return JumpState(unseen=self.unseen, again=self.again, quiet=self.quiet | quiet)

    def count_quiet(self, samples: int = 1) -> None:
        """Count samples without a jump under way."""
        self.quiet = {name: n + samples for name, n in self.quiet.items() if n + samples < FORGOTTEN_SAMPLES}

    def remember(self, beside: JumpState) -> None:
        """Take over how often a channel has jumped beside these, and how long ago."""
        self.again, self.quiet = self.again | beside.again, self.quiet | beside.quiet

    @property
    def most_again(self) -> int:
        """How often the loosest of these channels has jumped after its first jump."""
        return max((self.again.get(name, 0) for name in self.jumps), default=0)

    def without_engines(self) -> JumpState:
        """Return a copy without the states of the engines and of the watch beside."""
        engines = dict.fromkeys(("believing", "shifted", "zero_in_use", "beside", "hindsight"))
        return copy.deepcopy(msgspec.structs.replace(self, learning=0, **engines))

    def branches(self) -> list[Branch]:
        """Return the states of all engines, those of the watch beside included."""
        own = [branch for branch in (self.believing, self.shifted) if branch is not None]
        return own + (self.beside.branches() if self.beside is not None else [])
