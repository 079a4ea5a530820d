"""A shop of 200 machines that publish at one instant, through one router; `python -m tests.bench.shop` measures it."""

from __future__ import annotations

from pathlib import Path

from tests.bench.shop import KINDS, measure


def test_nothing_that_200_machines_say_at_once_is_lost(tmp_path: Path) -> None:
    got = measure(tmp_path, period_s=1.0, samples=2)
    assert got.sent == 200 * 2 * len(KINDS)
    assert (got.heard, got.recorded, got.missed) == (got.sent, got.sent, 0)
    assert got.bytes_per_sample > 1500
