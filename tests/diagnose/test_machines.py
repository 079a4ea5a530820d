"""The loop closed on a machine that is no transfer function: effects of every kind, drawn by a seed and sealed."""

import dataclasses

import numpy as np
import pytest

from compensator.diagnose.diagnosis import diagnose
from sim_hardware.physics import Duty, draw_effect
from tests.bench import machines

#: Each draws another kind.
SEEDS = (*range(400, 408), 409, 410, 412)


@pytest.fixture(scope="module")
def first():
    return machines.calibrated()


@pytest.fixture(scope="module")
def results(first):
    model, own_um = first
    return [machines.one(model, own_um, seed, 3.0) for seed in SEEDS]


def test_effects_of_every_kind_are_named(results):
    kinds = {place[0] for place, *_ in results}
    assert len(kinds) == len(SEEDS) == 11
    missed = [(place, named) for place, named, *_ in results if place not in named]
    assert len(missed) <= 1, missed


def test_the_extended_model_takes_the_error_off_a_day_that_nothing_saw(results):
    left = [excess for *_, excess, _ in results if np.isfinite(excess)]
    assert len(left) >= 6
    assert np.median(left) < 0.15
    assert max(left) <= 1.05


def test_what_holds_on_another_day_holds_on_the_blocks_that_were_held_out(first):
    """A step at some time would follow the jumps of what sticks, and hold nowhere else."""
    model, _ = first
    effect = draw_effect(27, 8.0, 24.0)
    assert effect.reveal().describe()["kind"] == "hysteresis"
    (run,) = machines.runs(Duty.working_day(127, hours=24.0), 127, [effect])
    # No channel takes part in it, and each would be searched four times.
    found = diagnose(model, [dataclasses.replace(run, channels={})])
    assert [e.place[0] for e in found.effects] == ["hysteresis"]
    assert found.after.rms_um < 0.4 * found.before.rms_um


def test_nothing_is_named_where_nothing_acts(first):
    model, own_um = first
    assert [machines.one(model, own_um, seed, 0.0)[1] for seed in (500, 501, 502)] == [[], [], []]
