"""Fixtures of the fuzz tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.service.simulated import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    """A daemon on a simulated machine."""
    return Bench(tmp_path)
