"""Who does the work of a large command: this process, one for each core, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager

from compensator import __version__
from compensator.errors import ServiceError, UsageError

#: How long a scheduler is waited for, s.
SCHEDULER_S = 10.0


@contextmanager
def workers(jobs: int, scheduler: str | None) -> Iterator[Executor | None]:
    """Yield what the jobs are handed to, None where this process does them itself.

    Parameters
    ----------
    jobs : int
        How many can be done at once; 1 or less where it is not worth starting a process.
    scheduler : str or None
        Address of a Dask scheduler, such as `tcp://127.0.0.1:8786`. Files are named to the workers, not sent: they must
        find them under the same path.

    Raises
    ------
    ServiceError
        If the scheduler does not answer, has no workers, or these run another version.
    UsageError
        If Dask is not installed, or the address is none.
    """
    if scheduler is not None:
        with _cluster(scheduler) as executor:
            yield executor
        return
    count = min(os.cpu_count() or 1, jobs)
    if count < 2:
        yield None
        return
    # A fresh interpreter for each: whatever threads this one has, none of them is copied.
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


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
        raise ServiceError(f"--scheduler {scheduler}: no scheduler answers there") from error
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
    """Return the version that a worker runs, or that there is none."""
    try:
        from compensator import __version__ as version
    except ImportError:
        return "none of this program"
    return version
