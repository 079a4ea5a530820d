"""Forged recordings by the hundred: what was tried, what was found, and whether anybody was deceived."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.fuzz import forgery

#: The forgeries are many small files; what they show has nothing to do with the disk.
MEMORY = Path("/dev/shm")


def report(count: int, seed: int) -> bool:
    """Try so many seeds and print the figures; return whether no audit was deceived."""
    kinds, found = Counter[str](), Counter[str]()
    wrong = []
    began = time.monotonic()
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as place:
        folder = Path(place)
        (folder / "originals").mkdir()
        originals = forgery.Originals(folder / "originals")
        for number in range(seed, seed + count):
            one = folder / str(number)
            one.mkdir()
            tried = forgery.attacked(originals, one, number)
            shutil.rmtree(one)
            kind = "two of these" if " + " in tried.kind else tried.kind
            kinds[kind] += 1
            found[kind] += tried.found
            if tried.deceived:
                wrong.append(f"seed {number}: {tried.kind}: {tried.deceived}")
    print(f"\nforged recordings, seeds {seed} to {seed + count - 1} (tests/fuzz/forgery.py); three audits of each:")
    print("with the key, with key and head, and with the key after the service has started again")
    for kind in sorted(kinds):
        print(f"{kind + ': tried, found by all three':<64} {kinds[kind]}, {found[kind]}")
    print(f"{'deceived about a record that was signed':<64} {len(wrong)}")
    for line in wrong:
        print(f"  {line}")
    print(f"{'seconds':<64} {time.monotonic() - began:.0f}", flush=True)
    return not wrong
