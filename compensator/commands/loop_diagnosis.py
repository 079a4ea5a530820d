"""`python -m compensator.commands.loop_diagnosis FOLDER`: a diagnosis that the service starts as a process of its own.

It reads `job.json` and `calibrated.toml` in the folder and writes `diagnosis.json`, `model.toml`, `report.html`, and at
last `result.json`. It limits itself before it reads anything, and ends with the service that started it.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import sys
from contextlib import suppress
from pathlib import Path

from compensator.blas import one_thread_from_start

one_thread_from_start()

from compensator.service.loop.job import CALIBRATED, JOB, RESULT, Job, Result, read_job  # noqa: E402
from compensator.service.loop.weighing import FAILED  # noqa: E402

#: Priority of the process.
NICENESS = 10
#: Largest file that it may write, bytes.
_LARGEST_FILE = 100_000_000
#: `prctl` option of Linux: the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1


def main() -> int:
    """Diagnose what a job names."""
    folder = Path(sys.argv[1])
    job = read_job(folder / JOB)
    why = _limit(job)
    from compensator.errors import CompensatorError

    try:
        result = _diagnose(job, folder) if not why else Result(verdict=FAILED, needs=why)
    except CompensatorError as error:
        result = Result(verdict=FAILED, needs=str(error))
    result.write(folder / RESULT)
    return 0


def _diagnose(job: Job, folder: Path) -> Result:
    from compensator.api.loop_diagnosis import diagnoses_of_table, summarised
    from compensator.input_file import MODEL_BYTES, read_file
    from compensator.service.loop.job import read_record
    from compensator.service.loop.record import table_of_rows

    record = read_record(job)
    table = table_of_rows(record.rows, record.probes, job.machine, zeros_ns=record.zeros_ns)
    model = read_file(folder / CALIBRATED, MODEL_BYTES)
    part, whole = diagnoses_of_table(table, model, probe_std_um=job.probe_std_um)
    part.found.save_all(folder)
    short = summarised(part, whole, model)
    return Result(
        verdict=short.verdict,
        effects=list(short.effects),
        text=short.text,
        needs=short.needs,
        y_moved_utc_ns=short.y_moved_utc_ns,
    )


def take_priority() -> None:
    """Take a low priority.

    `SCHED_BATCH` takes no core from a process that wakes up, such as the service. Of cores that others use it still
    gets some per cent; with `SCHED_IDLE`, or a niceness of 19, it would not end within its time.

    Raises
    ------
    OSError
        If it is not permitted.
    """
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    os.setpriority(os.PRIO_PROCESS, 0, max(NICENESS, os.getpriority(os.PRIO_PROCESS, 0)))


def _limit(job: Job) -> str:
    """Take a low priority and the limits of the job, and end with the parent.

    Returns
    -------
    str
        Why that is not possible: it must not compete with the samples, so nothing is diagnosed then.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != job.parent:  # it ended before
        raise SystemExit(1)
    with suppress(OSError):  # if memory runs out, this process is ended and not the service
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    limits = (
        (resource.RLIMIT_AS, round(job.memory_mb * 1e6)),
        (resource.RLIMIT_CPU, round(job.time_limit_min * 60.0)),
        (resource.RLIMIT_FSIZE, _LARGEST_FILE),
        (resource.RLIMIT_CORE, 0),
    )
    try:
        take_priority()
        for limit, value in limits:
            resource.setrlimit(limit, (value, value))
    except (OSError, ValueError) as error:
        return f"its priority and limits cannot be set ({error}); the unit of the service must permit it"
    return ""


if __name__ == "__main__":
    raise SystemExit(main())
