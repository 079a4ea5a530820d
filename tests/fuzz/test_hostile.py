"""Hostile inputs of every kind; `make soak` tries more of them, with seeds that it prints."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.hostile import KINDS, attempt

FEW = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind.startswith("payloads")])
@FEW
@given(seed=st.integers(0, 2**32))
def test_a_result_or_one_line_in_time(kind: str, seed: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        attempt(kind, seed, Path(folder))


def test_a_seed_makes_the_same_input_again(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        attempt("tables", 7, tmp_path / folder)
    assert (tmp_path / "a/table.csv").read_bytes() == (tmp_path / "b/table.csv").read_bytes()
