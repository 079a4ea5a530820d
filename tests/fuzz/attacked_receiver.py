"""A receiver to which strangers send whatever they like, on a virtual clock and without a wire."""

from __future__ import annotations

import random
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import zenoh

from compensator.receiver import Applied, Receiver, Settings
from tests.fuzz.payloads import payload
from tests.receiver.offsets import MACHINE, T0_NS, offset

MAX_UM, RATE, PERIOD_S = 60.0, 60.0, 60.0
#: After the last hostile message a good service is followed at the latest after the longest validity and the messages
#: that restart the count.
WITHIN_S = 600.0 + 5.0 * PERIOD_S


class Channel:
    """What Zenoh hands over."""

    def __init__(self) -> None:
        self.items: list[Any] = []

    def try_recv(self) -> Any:
        return self.items.pop(0) if self.items else None

    def put(self, data: bytes) -> None:
        self.items.append(SimpleNamespace(payload=zenoh.ZBytes(data), kind=zenoh.SampleKind.PUT))

    def put_reply(self, data: bytes) -> None:
        self.put(data)
        self.items.append(SimpleNamespace(ok=self.items.pop()))


@dataclass
class Result:
    """What came of it."""

    payloads: int = 0
    dropped: int = 0
    restarted: int = 0
    used: int = 0


class Attack:
    """One receiver, its clock, and the payloads.

    Parameters
    ----------
    rng : random.Random
        Where everything comes from.
    folder : pathlib.Path
        For the state file.
    check_clock : bool
        Setting of the receiver.
    """

    def __init__(self, rng: random.Random, folder: Path, *, check_clock: bool) -> None:
        self.rng, self.now_s = rng, 0.0
        self.settings = Settings(
            machine=MACHINE,
            prefix="shop/vmc-07",
            connect=("tcp/127.0.0.1:1",),
            offset_max_um=MAX_UM,
            offset_rate_max_um_per_min=RATE,
            check_clock=check_clock,
            state_file=str(folder / "state.json"),
        )
        self.result = Result()
        self.seq = 1000
        self.begin(rng.uniform(-MAX_UM, MAX_UM))

    def begin(self, applied_um: float) -> None:
        """Start the receiver, again with the state that it saved."""
        self.receiver = Receiver(
            self.settings, applied_um=applied_um, clock=lambda: self.now_s, utc_ns=lambda: self.utc_ns
        )
        self.applied_um = applied_um
        wired: Any = self.receiver
        wired._session = SimpleNamespace(close=lambda: None)
        self.offsets, self.statuses, self.answers = Channel(), Channel(), Channel()
        wired._offsets, wired._statuses, wired._tokens = self.offsets, self.statuses, Channel()
        wired._answers, wired._status_answers = [self.answers], [self.answers]

    @property
    def utc_ns(self) -> int:
        return T0_NS + round(self.now_s * 1e9)

    def poll(self, after_s: float) -> Applied:
        """Go on in time; nothing may jump, and all that is shown can be shown."""
        self.now_s += after_s
        applied = self.receiver.poll()
        moved = abs(applied.offset_um - self.applied_um)
        assert moved <= RATE / 60.0 * min(after_s, 1.0) + 1e-9, (moved, applied)
        assert abs(applied.offset_um) <= MAX_UM
        if applied.state in ("starting", "holding"):
            assert moved == 0.0 and applied.reasons
        assert len((applied.text + applied.steady_reasons).encode()) < 100_000
        assert self.receiver.probe_wanted is None or self.receiver.probe_wanted.wanted in (True, False)
        self.applied_um = applied.offset_um
        return applied

    def send(self) -> None:
        """Send one hostile payload somewhere."""
        data = payload(self.rng, self.utc_ns)
        self.result.payloads += 1
        if (way := self.rng.randrange(8)) == 0:
            self.statuses.put(data)
        elif way == 1:
            self.answers.put_reply(data)
        else:
            self.offsets.put(data)

    def run(self, payloads: int) -> Result:
        """Attack, restart now and then, then let an honest service go on."""
        for _ in range(payloads):
            for _ in range(self.rng.choice((1, 1, 2, 40))):
                self.send()
            self.poll(self.rng.choice((0.0, 0.1, 0.5, 20.0, 61.0, 700.0)))
            if self.rng.randrange(10) == 0:
                self.honest()
            if self.rng.randrange(30) == 0:
                self.begin(self.applied_um)
        for channel in (self.offsets, self.statuses, self.answers):
            channel.items.clear()
        self.recover()
        self.result.dropped = sum(self.receiver.follower.dropped.values())
        return self.result

    def honest(self) -> None:
        """Publish as the service does."""
        self.seq += 1
        self.offsets.put(offset(self.seq, 7.0, time_utc_ns=self.utc_ns))

    def recover(self) -> None:
        """An honest service is followed again, in time and to its value."""
        applied, began_s = None, self.now_s
        while applied is None or not (applied.state == "following" and applied.seq == self.seq):
            assert self.now_s - began_s <= WITHIN_S, (applied, self.seq)
            self.honest()
            applied = self.poll(0.0)
            codes = {reason.code for reason in applied.reasons}
            self.result.restarted += "count_restarted" in codes
            for _ in range(60):
                applied = self.poll(PERIOD_S / 60.0)
        for _ in range(3):
            self.honest()
            for _ in range(60):
                applied = self.poll(PERIOD_S / 60.0)
        assert abs(applied.offset_um - 7.0) < 0.011, applied
