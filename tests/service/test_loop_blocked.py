"""What keeps the loop from a diagnosis for days: a clock that was ahead."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.events import DiagnosisData
from compensator.service.loop.loop import Loop
from tests.service.simulated import START_NS

YEAR_NS = 365 * 86_400 * NS


def outcome(time_utc_ns: int) -> Any:
    """An outcome without measured Y, as far as the loop looks at it."""
    return SimpleNamespace(
        sample=SimpleNamespace(time_utc_ns=time_utc_ns, period_s=60.0),
        estimate=SimpleNamespace(residual_um=math.nan, y_um=math.nan),
        offset=SimpleNamespace(reasons=[]),
        notes=[],
        probes=(),
    )


def diagnosed(loop: Loop, hours: int, ahead_ns: Callable[[int], int]) -> list[tuple[int, str]]:
    """Run a loop for some hours, in which each diagnosis finds nothing; return when each begins, min, and why."""
    found = []
    for i in range(1, 60 * hours):
        now_ns = START_NS + 60 * i * NS + ahead_ns(i)
        one = outcome(now_ns)
        notes = loop.step(one, {place.sha256: one for place in loop.state.taken})
        found += [(i, note.data["why"]) for note in notes if note.data["step"] == "diagnose"]
        if loop.state.diagnosis is not None:
            loop.receive(DiagnosisData(verdict="adequate", effects=[]), now_ns)
    return found


def test_a_clock_that_was_ahead_for_some_minutes_keeps_nothing_from_being_diagnosed() -> None:
    loop = Loop(LoopSettings(policy="adopt"), 60.0, [])
    found = diagnosed(loop, 24, ahead_ns=lambda i: YEAR_NS if 100 <= i < 110 else 0)
    assert [why for i, why in found if i > 110] == ["planned", "planned"]
    assert loop.state.diagnosed_utc_ns < START_NS + YEAR_NS
