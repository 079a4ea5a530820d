"""Hostile inputs by seed: how many were tried, survived, and which failed."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.fuzz.hostile import KINDS, attempt


@dataclass
class Tried:
    """What came of one kind."""

    kind: str
    tried: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    slowest_s: float = 0.0


def run(count: int, seed: int) -> list[Tried]:
    """Try so many inputs of each kind, from this seed on."""
    return [_kind(kind, count, seed) for kind in KINDS]


def _kind(kind: str, count: int, seed: int) -> Tried:
    found = Tried(kind)
    for one in range(seed, seed + count):
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            try:
                attempt(kind, one, Path(folder))
            except Exception as error:  # noqa: BLE001  whatever it is, it is a finding
                found.failed[one] = f"{type(error).__name__}: {error}"[:300]
        found.tried += 1
        found.slowest_s = max(found.slowest_s, time.monotonic() - began)
    return found
