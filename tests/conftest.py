"""For every test: nothing of one is left for the next."""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import pickle
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import settings

from compensator.blas import one_thread_from_start
from tests.shared_folder import search_once

# As the commands do, before a test loads numpy: the processes of a test run share the cores.
one_thread_from_start()
# A shell starts what runs in the background with SIGINT ignored, and so would every program that a test starts.
signal.signal(signal.SIGINT, signal.default_int_handler)
# The same draws in every run, and no deadline by the clock. `pytest --hypothesis-profile default` draws others each
# time, to find what these miss.
settings.register_profile("fixed", derandomize=True, database=None, deadline=None)
settings.load_profile("fixed")


def _no_wait_for_the_disk(descriptor: int) -> None:
    """Check the descriptor only: nobody cuts the power of a test, and the wait is a large part of a simulated day.

    What a test starts as a process of its own, and kills, syncs as it does at a machine.
    """
    os.fstat(descriptor)


os.fsync = _no_wait_for_the_disk


def pytest_collection_finish() -> None:
    """Let the garbage collector leave out what stays: modules and tests, half a million objects at each full round."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)


@pytest.fixture(autouse=True)
def _no_handler_is_left() -> Iterator[None]:
    """A command logs to the stderr of its test; threads that end later would write to what is closed by then."""
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    yield
    root.handlers[:] = [handler for handler in root.handlers if handler in before]
    root.setLevel(level)


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the pages of a test a stand-in for each figure: drawing them takes longer than what most tests look at.

    For tests of figures and words that other tests have drawn: `report/` draws the page of every command.
    """
    monkeypatch.setattr("compensator.report.page.svg", lambda figure, prefix, width=0.0: f'<svg id="{prefix}"></svg>')


@pytest.fixture
def equal_questions_once(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Search once in a test run for what the same model lacks in data that are equal to the bit.

    For tests of what commands and verbs ask and of what they make of the answer. That a search finds the same each time
    and in each process is for `cli/test_workers.py` and `reference/`.
    """
    search_once(monkeypatch, tmp_path_factory)


_drawn: dict[bytes, str] = {}


@pytest.fixture(scope="module")
def equal_pictures_once() -> Iterator[None]:
    """Draw figures that are equal to the bit once: for tests of what several ways to one page put into it.

    That the same figure is drawn the same each time is for tests of `report/`.
    """
    from compensator.report.drawing import svg

    def once(figure: Any, prefix: str, width: float) -> str:
        key = hashlib.sha256(pickle.dumps((figure, prefix, width))).digest()
        if key not in _drawn:
            _drawn[key] = svg(figure, prefix, width)
        return _drawn[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("compensator.report.page.svg", once)
        yield
