"""`make soak`: 200 kills of the service, a month of everything that can happen, hostile inputs; a table of figures."""

from __future__ import annotations

import argparse
import logging
import tempfile
from pathlib import Path

from compensator.audit.machine_audit import summary
from compensator.commands.stopping import stoppable
from tests.fuzz import test_sensor_faults as sensor_faults
from tests.soak import forgeries, hostile, kills, month

#: The month writes no faster than the disk syncs; what it shows has nothing to do with that.
MEMORY = Path("/dev/shm")


def row(name: str, value: object) -> None:
    print(f"{name:<64} {value}", flush=True)


def report_month(days: float, seed: int) -> bool:
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        result, found = month.run(Path(folder), days, seed=seed)
    print(f"\nsimulated month: {days:g} days, seed {seed}")
    row("what happened", ", ".join(f"{kind} {count}" for kind, count in result.happened.most_common()))
    row("offsets published", ", ".join(f"{state} {count}" for state, count in result.states.most_common()))
    for kind, minutes in result.minutes.items():
        row(f"minutes: {kind}", f"{minutes:.0f}")
    row("largest step of the offset, µm (permitted 8)", f"{result.largest_step_um:.3f}")
    row("published before on disk", result.early)
    days_mb = result.rss_mb
    row(
        "resident memory after day 1, half, end, MB",
        ", ".join(f"{days_mb[i]:.0f}" for i in (0, len(days_mb) // 2, -1)) if days_mb else "–",
    )
    row("seconds: the month, its audit", f"{result.seconds:.0f}, {result.audit_seconds:.0f}")
    row(
        "audit of all files",
        f"{'clean' if found.clean else 'NOT CLEAN'}, {result.files} files, {found.samples} samples",
    )
    if not found.clean:
        print(summary(found))
    return found.clean and not result.minutes["not accounted for"]


def report_kills(count: int, machines: int, seed: int) -> bool:
    print(f"\nkill −9, {machines} machines side by side, seed {seed}")
    with tempfile.TemporaryDirectory() as folder:
        try:
            results = kills.side_by_side(Path(folder), count, machines, seed)
        except AssertionError as error:
            row("FAILED", error)
            return False
    for moment in dict.fromkeys(kills.MOMENTS):
        row(f"kills: {moment}", sum(result.kills[moment] for result in results))
    row("offsets received, all on disk to the bit", sum(result.offsets - result.early for result in results))
    row(
        "published before on disk and saying so; of these not on disk",
        f"{sum(r.early for r in results)}; {sum(r.early_lost for r in results)}",
    )
    row("samples on disk, files, audited clean", f"{sum(r.recorded for r in results)}, {sum(r.files for r in results)}")
    row(
        "largest change between two offsets, share of the permitted",
        f"{max(r.largest_share_of_rate for r in results):.2f}",
    )
    row("seconds", f"{max(result.seconds for result in results):.0f}")
    return True


def report_hostile(count: int, seed: int) -> bool:
    results = hostile.run(count, seed)
    print(f"\nhostile inputs, seeds {seed} to {seed + count - 1} (tests/fuzz/hostile.py: attempt(kind, seed, folder))")
    for result in results:
        survived = result.tried - len(result.failed)
        figures = f"tried {result.tried}, survived {survived}, failed {len(result.failed)}"
        row(result.kind, f"{figures}; slowest {result.slowest_s:.1f} s")
        for one, why in result.failed.items():
            print(f"  seed {one}: {why}")
    return not any(result.failed for result in results)


def report_faults(count: int, seed: int) -> bool:
    day = sensor_faults.working_day()
    healthy = sensor_faults.run(day)[0]
    found = [sensor_faults.missed(day, healthy, seed + i) for i in range(count)]
    print(f"\nfaults of thermocouples, seeds {seed} to {seed + count - 1}")
    row("days with a fault; of these with a jump of the offset or a jump believed", f"{count}; {sum(map(bool, found))}")
    for text in filter(None, found):
        print(text)
    return not any(found)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description="Endurance of the service.")
    parser.add_argument("--kills", type=int, default=200, help="number of kills (default 200)")
    parser.add_argument("--machines", type=int, default=4, help="machines side by side (default 4)")
    parser.add_argument("--days", type=float, default=30.0, help="length of the month (default 30)")
    parser.add_argument("--hostile", type=int, default=300, help="hostile inputs of each kind (default 300)")
    parser.add_argument("--forgeries", type=int, default=300, help="number of forged recordings (default 300)")
    parser.add_argument("--faults", type=int, default=50, help="faults of thermocouples (default 50)")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    # What the service says of defects that were put in on purpose would bury the table.
    logging.getLogger("compensator").addHandler(logging.NullHandler())
    good = report_month(given.days, given.seed) if given.days else True
    good = report_faults(given.faults, given.seed) and good if given.faults else good
    if given.kills:
        good = report_kills(given.kills, given.machines, given.seed) and good
    if given.hostile:
        good &= report_hostile(given.hostile, given.seed)
    if given.forgeries:
        good = forgeries.report(given.forgeries, given.seed) and good
    return 0 if good else 1


if __name__ == "__main__":
    stoppable()
    raise SystemExit(main())
