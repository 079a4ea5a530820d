"""Reports of progress: what a long calculation calls with the steps done and their number."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

#: Called with the steps done and their number.
Progress = Callable[[int, int], None]
#: Applies a function to each of some values, like `map`: in this process or in the workers of an executor.
ExecutorMap = Callable[..., Iterable[Any]]


def unreported(done: int, total: int) -> None:
    """Report nothing."""


def after(progress: Progress, steps: int) -> Progress:
    """Return what reports a calculation that follows these many steps of another as their continuation."""
    return lambda done, total: progress(steps + done, steps + total)
