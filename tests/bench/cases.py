"""Drawn cases judged in processes beside each other."""

import json
import os
from concurrent.futures import ProcessPoolExecutor, as_completed


def judge(cases, judged, out, *, workers=None, resume=False):
    """Judge cases in processes of one thread each; yield what each gave, with what `out` has already first.

    Parameters
    ----------
    cases : sequence
        With `family` and `seed`.
    judged : callable
        A function of a module, which returns a list of dicts for a case that JSON can hold.
    out : Path
        After each case everything so far is written to it.
    workers : int, optional
        As many as there are cores where it is None.
    resume : bool
        Leave out what is in `out`: the results have the `family` and `seed` of their case.
    """
    results = json.loads(out.read_text(encoding="utf-8")) if resume and out.exists() else []
    yield from results
    done = {(r["family"], r["seed"]) for r in results}
    cases = [case for case in cases if (case.family, case.seed) not in done]
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):  # Of the processes that are started now.
        os.environ.setdefault(name, "1")
    with ProcessPoolExecutor(workers or os.cpu_count()) as pool:
        for future in as_completed([pool.submit(judged, case) for case in cases]):
            found = future.result()
            results += found
            out.write_text(json.dumps(results, indent=1), encoding="utf-8")
            yield from found
