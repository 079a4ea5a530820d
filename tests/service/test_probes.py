"""Probes of a machine without a displacement sensor: taken, refused, recorded and replayed; nothing jumps."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compensator.messages import number
from compensator.recording.reading import recordings
from tests.service.living import MACHINE, check_files, largest_step
from tests.service.probed import PROBED, RATE_UM, ProbedMachine


async def test_hourly_probes_take_a_gain_error_away(tmp_path: Path) -> None:
    alone, probed = ProbedMachine(tmp_path / "alone"), ProbedMachine(tmp_path / "probed")
    probed.each_hour(1400)
    await alone.run(1440)
    await probed.run(1440)
    before, after = (np.sqrt(np.mean(machine.left_um()[300:] ** 2)) for machine in (alone, probed))
    print(before, after)
    assert after < 0.35 * before
    assert set(probed.codes()) == {"taken"} and len(probed.codes()) == 23
    assert largest_step(probed.outcomes) <= RATE_UM + 1e-9
    assert check_files(probed) == 1440
