"""The endurance runs of `make soak`, short."""

from __future__ import annotations

from pathlib import Path

import pytest

from compensator.audit.machine_audit import summary
from tests.soak import kills, month


@pytest.mark.timeout(300)
def test_killed_again_and_again(tmp_path: Path) -> None:
    result = kills.run(tmp_path, 5, seed=5, longest_s=0.5, period_s=0.25)
    assert sum(result.kills.values()) == 5 and result.kills["adopting"] == 1
    # What a slow disk had not taken when it was published may be lost by a kill, as its reason says.
    assert result.offsets >= 5 and result.recorded >= result.offsets - result.early_lost


@pytest.mark.timeout(300)
def test_a_day_of_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything happens six times as often as in the month; every minute is accounted for."""
    often = {kind: 6.0 * value for kind, value in month.A_DAY.items()}
    monkeypatch.setattr(month, "A_DAY", often)
    result, found = month.run(tmp_path, 1.0, seed=4)
    assert found.clean, summary(found)
    assert result.minutes["not accounted for"] == 0, result.minutes
    assert found.samples == result.samples >= 1400
    assert {"kill", "stop", "full", "hang", "sensor", "device"} <= set(result.happened), result.happened
