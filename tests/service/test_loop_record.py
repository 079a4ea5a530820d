"""The table of a diagnosis: the same from outcomes as from recordings, and what makes each diagnosis fail left out."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from compensator.errors import DataError
from compensator.messages import number
from compensator.service.loop.job import Job, read_record
from compensator.service.loop.record import table_of_rows, usable_table
from compensator.service.loop.run import OfflineLoop
from tests.service.living import MACHINE
from tests.service.looping import Night, machine, shown
from tests.service.test_loop_run import probed, without_sensor
from tests.service.test_loop_service import Asked, Looping
from tests.service.test_restart import QUILL


@pytest.mark.parametrize("zero_at", [400, 1000])
def test_probes_about_each_zero_are_diagnosed(zero_at: int) -> None:
    samples, every = 1441, 30
    loop = OfflineLoop(without_sensor(), QUILL, Night(shown(None, "adequate")))
    source = machine(samples, noise_um=0.0)
    truth: list[float] = []

    def counted():
        """A person sets a zero on the warm machine: what is probed counts from there."""
        for i, one in enumerate(source):
            if i == zero_at:
                loop.compensation.zero("warm")
            truth.append(number(one.channels["y_um"].mean) - (truth[zero_at] if i > zero_at else 0.0))
            channel = one.channels["y_um"]
            one.channels["y_um"] = replace(channel, mean=truth[-1])
            yield one

    steps = probed(loop, counted(), every)
    taken = [probe for step in steps for probe in step.outcome.probes if probe.taken]
    assert len(taken) > 0.8 * samples / every
    table = usable_table([step.outcome for step in steps])
    sample = steps[zero_at].outcome.sample
    assert table.zeros_s[-1] == pytest.approx((sample.time_utc_ns + sample.behind_ns) / 1e9)
    measured = np.isfinite(table.columns["y_um"])
    is_after = table.t_s[measured] > table.zeros_s[-1]
    assert is_after.tolist() == [probe.time_utc_ns > sample.time_utc_ns for probe in taken]
    assert table.columns["y_um"][measured].tolist() == [probe.deformation_um for probe in taken]


def test_a_sensor_that_stood_still_is_left_out_of_the_record_and_what_moves_stays() -> None:
    """A T_Q that was stuck before the service noticed it would have each diagnosis refused for a day and more."""
    rng, rows = np.random.default_rng(3), []
    for i, one in enumerate(machine(600)):
        t_q = one.channels["t_q_degc"]
        held = rows[300][0].channels["t_q_degc"].mean if 300 < i <= 420 else round(t_q.mean + rng.normal(0.0, 0.03), 3)
        channels = one.channels | {"t_q_degc": replace(t_q, mean=held)}
        rows.append((replace(one, channels=channels), None))
    columns = table_of_rows(rows, [], "record").columns
    assert np.flatnonzero(np.isnan(columns["t_q_degc"])).tolist() == list(range(300, 421))
    assert np.isfinite(columns["at_degc"]).all()


async def test_the_process_reads_from_the_recordings_what_the_service_has_seen(tmp_path: Path) -> None:
    service = Looping(tmp_path, shown(None, "adequate"), before_night=20 * 60)
    zero = service.at_sample[120] = Asked(service, "zero", mode="warm")
    await service.run(300)
    assert zero.answer["ok"], zero.answer
    times = [outcome.sample.time_utc_ns for outcome in service.outcomes]
    job = Job(
        recordings=str(service.recordings),
        machine=MACHINE,
        from_utc_ns=times[49],
        to_utc_ns=times[-1],
        probe_std_um=None,
        memory_mb=1000.0,
        time_limit_min=1.0,
        parent=os.getpid(),
    )
    found = read_record(job)
    own, read = usable_table(service.outcomes[50:]), table_of_rows(found.rows, found.probes, "record")
    assert own.t_s.size == 250 and np.array_equal(own.t_s, read.t_s)
    for name, values in own.columns.items():
        assert np.array_equal(values, read.columns[name], equal_nan=True), name
    zeros = [o.sample.time_utc_ns for o in service.outcomes[50:] if any(note.kind == "zero" for note in o.notes)]
    assert len(zeros) == 1 and found.zeros_ns == zeros
    # What has the name of a recording and is none keeps nothing from being diagnosed.
    for name in ("20200101T000000Z", "20990101T000000Z"):
        (service.recordings / f"{MACHINE}_{name}.mcap").write_bytes(b"x\n")
    assert read_record(job) == found


def test_a_time_without_a_sample_is_refused() -> None:
    """The clock was set back before a diagnosis was begun again."""
    with pytest.raises(DataError, match="record: no samples in the time that is diagnosed"):
        usable_table([])
