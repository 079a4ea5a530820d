"""For every test: nothing of one is left for the next."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator

import pytest

from compensator.blas import one_thread_from_start

# As the commands do, before a test loads numpy: the two processes of a test run share the cores.
one_thread_from_start()
# A shell starts what runs in the background with SIGINT ignored, and so would every program that a test starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _no_handler_is_left() -> Iterator[None]:
    """A command logs to the stderr of its test; threads that end later would write to what is closed by then."""
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    yield
    root.handlers[:] = [handler for handler in root.handlers if handler in before]
    root.setLevel(level)
