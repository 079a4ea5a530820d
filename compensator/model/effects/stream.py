"""An effect at work, one sample at a time, and what is open of it."""

from __future__ import annotations

import math
from collections.abc import Iterator

from compensator.arrays import NAN
from compensator.model.effects.base import Effect
from compensator.model.effects.blocks import Block
from compensator.model.effects.signals import Signals


class EffectStream:
    """An effect at work, one sample at a time.

    Parameters
    ----------
    effect : Effect
        Parameters and law.
    period_min : float
        Sample period, min.
    """

    def __init__(self, effect: Effect, period_min: float) -> None:
        self.effect, self.kind, self.channels = effect, effect.kind, effect.measured
        self._awaited = () if effect.acts_in_part else self.channels
        self._blocks: tuple[Block, ...] = effect.blocks(period_min)
        self._steps = [block.step for block in self._blocks]
        # A form with a variance of its own has rows of another meaning.
        rows = () if effect.has_variance else effect.std_factor
        self._moved = tuple(EffectStream(effect.moved(row), period_min) if row else None for row in rows)
        #: By how much its last addition to y would differ with each row of `std_factor`, µm.
        self.deviations_um: tuple[float, ...] = (0.0,) * len(rows)

    def step(self, signals: Signals[float]) -> float:
        """Advance by one sample and return the addition to y, µm; 0 until each of its channels has had a value."""
        y = self._step_itself(signals)
        if self._moved:
            self.deviations_um = tuple(moved.step(signals) - y if moved else 0.0 for moved in self._moved)
        return y

    def _step_itself(self, signals: Signals[float]) -> float:
        for channel in self._awaited:
            if math.isnan(signals.channels.get(channel, NAN)):
                return 0.0
        return float(self.effect.law(signals, self._steps))

    def peek(self, signals: Signals[float]) -> float:
        """Return what `step` would, without a change of state."""
        states = [block.state for block in self._blocks]
        y = self._step_itself(signals)
        for block, state in zip(self._blocks, states, strict=True):
            block.state = state
        return y

    def variance_um2(self) -> float:
        """Return the variance that the effect states for its last addition, µm²."""
        return self.effect.variance_um2(self._blocks)

    def snapshot(self) -> tuple[float, ...]:
        """Return everything that it must remember to continue with the same bits."""
        return tuple(value for block in self._all_blocks() for value in block.state)

    def _all_blocks(self) -> Iterator[Block]:
        yield from self._blocks
        for moved in self._moved:
            if moved:
                yield from moved._all_blocks()

    def restore(self, state: tuple[float, ...]) -> None:
        """Continue from a snapshot."""
        start = 0
        for block in self._all_blocks():
            end = start + len(block.state)
            block.state = tuple(state[start:end])
            start = end
