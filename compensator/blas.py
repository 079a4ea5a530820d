"""One thread for linear algebra: matrices are small, and sums in another order would change the last digits."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterator
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def one_thread_from_start() -> None:
    """Limit the numerical libraries of this process to one thread; for entry points, before numpy is imported."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@contextlib.contextmanager
def _same_environment() -> Iterator[None]:
    """Take away what an import sets: threadpoolctl lets two copies of Intel's OpenMP run side by side."""
    name = "KMP_DUPLICATE_LIB_OK"
    was_set = name in os.environ
    yield
    if not was_set:
        os.environ.pop(name, None)


def in_one_thread(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function while BLAS is limited to one thread, in any process."""
    with _same_environment():
        from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        return function(*args, **kwargs)


def one_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function so that its results do not depend on the number of cores or on the caller."""

    @functools.wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> T:
        return in_one_thread(function, *args, **kwargs)

    return alone
