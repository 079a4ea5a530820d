"""Fixtures of the fuzz tests."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.simulated import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    """A daemon on a simulated machine."""
    return Bench(tmp_path)


@pytest.fixture(autouse=True)
def log_as_it_was() -> Iterator[None]:
    """Take the handlers away again that a command sets: their stream is gone after the test."""
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    yield
    root.handlers[:] = before
    root.setLevel(level)
