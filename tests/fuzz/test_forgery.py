"""Recordings changed in drawn ways: whoever has the public key is not deceived about what was signed."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.fuzz.forgery import ATTACKS, Originals, attacked, deceived

SEEDS = range(72)


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Originals:
    return Originals(tmp_path_factory.mktemp("originals"))


@pytest.mark.parametrize("part", range(4))
def test_nobody_is_deceived(originals: Originals, tmp_path: Path, part: int) -> None:
    kinds: Counter[str] = Counter()
    for seed in list(SEEDS)[part::4]:
        folder = tmp_path / str(seed)
        folder.mkdir()
        tried = attacked(originals, folder, seed)
        assert not tried.deceived, f"seed {seed}: {tried}"
        kinds[tried.kind] += tried.found
    assert sum(kinds.values()) >= 6 and {one for kind in kinds for one in kind.split(" + ")} <= set(ATTACKS)


def test_the_check_itself_sees_a_change(originals: Originals, tmp_path: Path) -> None:
    """Else nothing above could fail."""
    import shutil

    shutil.copytree(originals.folder / "rec", tmp_path / "rec")
    assert deceived(originals, tmp_path, head=True) == ""
    newest = tmp_path / "rec" / originals.names[-1]
    newest.write_bytes(newest.read_bytes()[:-6000])
    assert deceived(originals, tmp_path, head=False) == ""
    assert originals.names[-1] in deceived(originals, tmp_path, head=True)
    (tmp_path / "rec" / originals.names[1]).unlink()
    assert "missing" in deceived(originals, tmp_path, head=False)
