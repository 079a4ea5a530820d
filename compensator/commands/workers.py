"""Workers of a long-running command: this process, one process for each core, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from compensator import __version__
from compensator.blas import in_one_thread
from compensator.errors import ServiceError, UsageError
from compensator.progress import Progress

#: Time to wait for a scheduler, s.
SCHEDULER_S = 10.0


@contextmanager
def workers(jobs: int, scheduler: str | None) -> Iterator[Executor | None]:
    """Yield an executor; None if the work is done in this process.

    Parameters
    ----------
    jobs : int
        Number of jobs that can run in parallel; 1 or less if starting processes would take longer.
    scheduler : str or None
        Address of a Dask scheduler, such as `tcp://127.0.0.1:8786`. Workers receive the paths of files, not
        their content.

    Raises
    ------
    ServiceError
        If the scheduler does not answer, its workers are missing or of another version, or a process was ended.
    UsageError
        If Dask is not installed, or the address is invalid.
    """
    if scheduler is not None:
        with _cluster(scheduler) as executor:
            yield executor
        return
    count = min(os.cpu_count() or 1, jobs)
    if count < 2:
        yield None
        return
    # Each worker is a new interpreter: threads of this one are not copied.
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            words = f"one of {count} processes was ended from outside, as the system does where memory runs out"
            raise ServiceError(f"{words}; free some, and start again") from error
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def in_parallel(jobs: Sequence[Callable[[], Any]], progress: Progress, *, scheduler: str | None = None) -> list[Any]:
    """Do independent jobs, one process for each as far as there are cores, and return their results in order.

    Parameters
    ----------
    jobs : sequence of callable
        Without arguments; like their results they can be pickled. The longest first.
    progress : callable
        Called with how many jobs of how many are done.
    scheduler : str, optional
        See `workers`.

    Raises
    ------
    ServiceError, UsageError
        As `workers` does.
    """
    progress(0, len(jobs))
    with workers(len(jobs), scheduler) as executor:
        if executor is None:
            results = []
            for job in jobs:
                results.append(in_one_thread(job))
                progress(len(results), len(jobs))
            return results
        pending = [executor.submit(in_one_thread, job) for job in jobs]
        for done, one in enumerate(as_completed(pending), start=1):
            one.result()
            progress(done, len(jobs))
        return [one.result() for one in pending]


@contextmanager
def _cluster(scheduler: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise UsageError("--scheduler: needs Dask: pip install quill-compensator[cluster]") from error
    try:
        client = Client(scheduler, timeout=SCHEDULER_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except ValueError as error:
        raise UsageError(f"--scheduler {scheduler}: {error}, expected an address such as tcp://host:8786") from error
    except OSError as error:
        raise ServiceError(f"--scheduler {scheduler}: no scheduler answered") from error
    with client:
        found = client.run(_version)
        if not found:
            raise ServiceError(f"--scheduler {scheduler}: has no workers")
        for worker, version in found.items():
            if version != __version__:
                raise ServiceError(f"--scheduler {scheduler}: {worker} has version {version}, expected {__version__}")
        with client.get_executor(pure=False) as executor:  # type: ignore[no-untyped-call]
            yield executor


def _version() -> str:
    """Return the version that a worker runs."""
    try:
        from compensator import __version__ as version
    except ImportError:
        return "no compensator"
    return version
