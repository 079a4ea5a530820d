"""One thread for linear algebra: matrices here are small, and sums in another order end in other digits."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def one_thread_from_start() -> None:
    """Have the libraries of this process start no threads: for an entry point, before numpy is loaded."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def in_one_thread(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function while BLAS has one thread, in whatever process this is."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        return function(*args, **kwargs)


def one_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function that computes, so that its figures depend neither on cores nor on who calls it."""

    @functools.wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> T:
        return in_one_thread(function, *args, **kwargs)

    return alone
