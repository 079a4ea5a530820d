"""`input`, form `flow`: a fluid that flows now and then heats or cools what it wets.

y += Σ_i L(τ_i) · [gain_i · X(φ, F − T_Q) + gain_air_i · X(φ, F − AT)], less that at the start

with F the temperature of the fluid, φ the flow as a share of its span, and X what the film exchanges (`Exchange`). What
is wetted lies between T_Q and AT in temperature, so both differences act. The more flows, the better a film conducts,
until what is behind it limits the heat: at φ = h half of what a large flow would carry, once what is wetted has
followed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from compensator.model.effects.base import (
    BankEffect,
    Effect,
    Run,
    channel_name,
    number,
    numbers,
    only,
    optional_number,
    register,
)
from compensator.model.effects.blocks import Block, FilterBank, FromStart, S, exchanges
from compensator.model.effects.hypothesis import Context, Free, Hypothesis, numbered, proposes
from compensator.model.effects.input import NEEDS_CHANNEL, half_time_min
from compensator.model.effects.seen import FLOWS, POWERS, Seen, digits, quantity, unit_in, with_unit
from compensator.model.effects.signals import Signals


@register
class Flow(BankEffect, Effect):
    """A fluid whose flow and temperature are measured."""

    kind = "input"
    linear = ("gain", "gain_air")
    form: str = only(default="flow")
    channel: str = channel_name()
    fluid: str = channel_name()
    span: float = number(1e-12)
    half: float = number(1e-6, 1e6)
    surface_min: float = optional_number(0.0, 1e5, default=0.0)
    tau_min: tuple[float, ...] = numbers(0.0, 1e5)
    gain: tuple[float, ...] = numbers()
    gain_air: tuple[float, ...] = numbers()

    @property
    def off_at_zero(self) -> tuple[str, ...] | None:
        return (self.channel,)

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        films = exchanges(self.half, self.surface_min, period_min)
        return *films, FromStart(), FromStart(), FilterBank(self.tau_min, (self.gain, self.gain_air), period_min)

    def inputs(self, signals: Signals[S], run: Sequence[Run[S]]) -> tuple[S, ...]:
        flow = signals.channels[self.channel] / self.span
        flow = 0.5 * (flow + abs(flow))  # noise about 0 is no flow
        fluid = signals.channels[self.fluid]
        return run[2](run[0](flow, fluid - signals.t_q_degc)), run[3](run[1](flow, fluid - signals.at_degc))

    @property
    def channels(self) -> tuple[str, ...]:
        return self.channel, self.fluid

    def named(self, given: dict[str, float]) -> dict[str, float]:
        """Return the gain at rest by the fluid's temperature at the largest flow, the time to half of it, and h."""
        found = {"gain_um_per_k": math.fsum(self._gains), "half_time_min": self.half_time_min()}
        return found | {with_unit("half_flow", self.channel): self.half * self.span}

    @property
    def _gains(self) -> tuple[float, ...]:
        """Gain behind each lag by the fluid's temperature."""
        return tuple(a + b for a, b in zip(self.gain, self.gain_air, strict=True))

    def half_time_min(self) -> float:
        """Return the time to half of the response at rest to the largest flow, min."""
        kappa = 1.0 / self.half
        # What is wetted follows with this time constant under the largest flow.
        follows = self.surface_min / (1.0 + kappa)
        if not follows:
            return half_time_min(self.tau_min, self._gains)
        # Two lags in a row are a sum of two, unless they are the same.
        taus = [tau if abs(tau - follows) > 1e-5 * follows else follows * (1.0 + 1e-5) for tau in self.tau_min]
        shares = [kappa * follows / (tau - follows) for tau in taus]
        own = [gain * (1.0 - share) for gain, share in zip(self._gains, shares, strict=True)]
        shared = math.fsum(gain * share for gain, share in zip(self._gains, shares, strict=True))
        return half_time_min((*taus, follows), (*own, shared))

    def explain(self, seen: Seen) -> str:
        assert seen.channel is not None
        gain, most = digits(math.fsum(self._gains)), quantity(seen.channel.ends(self.channel)[1], self.channel)
        return (
            f"{seen.words}: while {self.channel} flows, {self.fluid} acts on the machine by its differences to T_Q and "
            f"to the air: {gain} µm/K at {most}, half of it after {digits(self.half_time_min())} min. The base model "
            f"lacks this fluid, which heats or cools what it wets{NEEDS_CHANNEL}."
        )


@register
class FlowBank(Flow):
    """The same through a filter bank of given lags: for a response whose form is not known."""

    has_any_form = True


@proposes
def flows(context: Context) -> Iterator[Hypothesis]:
    """Propose every temperature as that of a fluid whose flow is a channel with a zero of its own; a power is none."""
    half = Free(name="half", low=0.01, high=100.0, grid=(0.03, 0.3, 3.0))
    one, several = context.tau(), context.bank_min
    for channel in sorted(context.zeroed):
        if unit_in(channel) in POWERS:
            continue
        is_flow = unit_in(channel) in FLOWS
        # A speed in the place of a flow fits too much if a surface may follow it, too.
        searched = (half, context.surface()) if is_flow else (half,)
        for fluid in context.temperatures:
            # A fluid that stays as warm as it is shows by its flow alone; with a speed that is something else.
            if fluid not in context.spans and not is_flow:
                continue
            place: dict[str, Any] = {"channel": channel, "fluid": fluid, "span": context.spans[channel], "half": 1.0}
            form = f"flow of {fluid}"
            if context.approximate:
                ones = (1.0,) * len(several)
                bank = FlowBank(**place, tau_min=several, gain=ones, gain_air=ones)
                names = (*numbered("gain", len(several)), *numbered("gain_air", len(several)))
                yield Hypothesis(effect=bank, form=f"row, {form}", free=searched, amplitudes=names)
            else:
                lag = Flow(**place, tau_min=(0.0,), gain=(1.0,), gain_air=(1.0,))
                gains = ("gain_um_per_k", "gain_air_um_per_k")
                yield Hypothesis(effect=lag, form=form, free=(half, one), amplitudes=gains)
