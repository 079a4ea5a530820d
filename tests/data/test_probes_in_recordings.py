"""The probes of a recording are its measured Y where no displacement sensor is; refused ones are not."""

import csv
import datetime
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

import compensator as tc
from compensator.data.measurement import measurements, runs_in
from compensator.data.probed import zeros_ns
from compensator.data.runs import is_sparse
from compensator.messages import Event
from compensator.recording.reading import recordings
from compensator.service.loop.record import usable_table
from tests.audit.made import CONFIG
from tests.service.living import MACHINE
from tests.service.probed import PROBE, PROBED, ProbedMachine

WIDE = PROBED.replace(b"measured_max_um = 60.0", b"measured_max_um = 200.0")


def read(machine):
    return tc.read(recordings(machine.recordings, MACHINE))


async def test_probes_are_the_measured_y_of_a_recording(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path, noise_um=0.0)
    machine.each_hour(400, every=30)
    machine.at_sample[200] = lambda: machine.probe(25.0)  # a chip
    truth = {}
    for sample in range(60, 400, 30):
        machine.at_sample[sample] = lambda: (
            truth.update({machine.clock.utc_ns(): machine.truth_um()}),
            machine.probe(),
        )
    await machine.run(420)
    table = read(machine).table
    known = np.isfinite(table.columns["y_um"])
    assert known.sum() == len(truth) == machine.codes().count("taken")
    assert table.columns["y_um"][known] == pytest.approx(list(truth.values()))
    assert "probe_outlier" in machine.codes()
    (record,) = read(machine).at_period(60.0).records
    assert is_sparse(record.columns["y_um"]) and np.isfinite(record.columns["t_q_degc"]).mean() > 0.99


async def test_a_control_that_applied_nothing_shows_the_whole_deformation(tmp_path: Path) -> None:
    """As during a calibration: the service refuses such a probe for its own use, and the recording has it."""
    machine = ProbedMachine(tmp_path, noise_um=0.0, config=WIDE)
    grown = []

    def probe() -> None:
        grown.append(machine.truth_um())
        machine.probe(measured_um=machine.truth_um(), offset_applied_um=0.0)

    for sample in range(60, 150, 30):
        machine.at_sample[sample] = probe
    await machine.run(160)
    assert set(machine.codes()) == {"probe_mismatch"}
    y = read(machine).table.columns["y_um"]
    assert y[np.isfinite(y)] == pytest.approx(grown)


async def test_only_one_feature_is_used_and_said_so(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path, noise_um=0.0)
    machine.each_hour(400)
    machine.at_sample[200] = lambda: machine.probe(feature="bore")
    await machine.run(420)
    found = read(machine)
    assert np.isfinite(found.table.columns["y_um"]).sum() == 6
    assert [remark.code for remark in found.remarks] == ["features_left_out"]


@pytest.mark.parametrize("zero_at", [130, 310])
async def test_probes_about_each_zero_are_told_apart_as_in_the_loop(tmp_path: Path, caplog, zero_at: int) -> None:
    machine = ProbedMachine(tmp_path, noise_um=0.0, config=WIDE)
    machine.each_hour(400, every=30)
    machine.at_sample[zero_at] = lambda: machine.command("zero", b'{"mode": "warm"}')
    # Ordered, and refused: no zero was set.
    machine.at_sample[220] = lambda: machine.command("zero", b'{"mode": "cold"}')
    await machine.run(420)
    (_, zero) = machine.events("zero")
    zero_ns = next(outcome.sample.time_utc_ns for outcome in machine.outcomes if outcome.sample.seq == zero.seq)
    taken = [probe for probe in machine.recorded() if probe.taken]
    level = [probe for probe in taken if (probe.time_utc_ns > zero_ns) == (zero_at < 200)]
    assert len(taken) > len(level) >= 8
    found = read(machine)
    known = np.isfinite(found.table.columns["y_um"])
    assert found.table.columns["y_um"][known].tolist() == [probe.deformation_um for probe in taken]
    loop = usable_table(machine.outcomes)
    measured = np.isfinite(loop.columns["y_um"])
    assert found.table.t_s[known].tolist() == loop.t_s[measured].tolist()
    assert found.table.columns["y_um"][known].tolist() == loop.columns["y_um"][measured].tolist()
    assert found.table.zeros_s == loop.zeros_s and len(loop.zeros_s) == 2
    data = found.at_period(60.0)
    (record,) = data.records
    assert np.isfinite(record.columns["y_um"]).sum() == len(level)
    (remark,) = (remark for remark in data.remarks if remark.code == "zeros_left_out")
    assert f"{len(level)} probe(s); {len(taken) - len(level)} about others left out" in remark
    (run,), remarks = runs_in([found], whole_y=True)
    assert "zeros_left_out" not in [remark.code for remark in remarks]
    numbers = run.zero_numbers[np.isfinite(run.y_um)].tolist()
    assert numbers == [int(probe.time_utc_ns > zero_ns) for probe in taken]
    tc.export(recordings(machine.recordings, MACHINE), tmp_path / "all.csv")
    assert "zeros_left_out" in caplog.text
    with (tmp_path / "all.csv").open() as file:
        exported = [float(row["y_um"]) for row in csv.DictReader(file) if row["y_um"]]
    assert exported == [probe.deformation_um for probe in level]


def test_the_zero_of_a_lost_sample_has_the_time_of_its_event() -> None:
    """A full disk: the event is written with a later sample, and what was ordered is no zero."""
    zero = Event(schema=1, machine=MACHINE, seq=7, time_utc_ns=430, kind="zero", text="")
    ordered = replace(zero, seq=6, kind="command")
    assert zeros_ns([ordered, zero], {6: 360}) == [430]
    assert zeros_ns([ordered, zero], {6: 360, 7: 420}) == [420]


async def test_a_table_of_each_zero_keeps_all_probes(tmp_path: Path) -> None:
    """What the remark advises: a zero was set between two recordings, and each is exported by itself."""
    machine = ProbedMachine(tmp_path, noise_um=0.0, config=WIDE)
    machine.each_hour(400, every=30)
    await machine.run(200)
    machine.at_sample[201] = lambda: machine.command("zero", b'{"mode": "warm"}')
    await machine.run(200)
    files = recordings(machine.recordings, MACHINE)
    tables = [tmp_path / "day1.csv", tmp_path / "day2.csv"]
    for recording, table in zip(files, tables, strict=True):
        tc.export(recording, table)
    runs, _ = runs_in(measurements(tables, "data"))
    taken = sum(probe.taken for probe in machine.recorded())
    assert [run.recording for run in runs] == [0, 1]
    (together,), _ = runs_in([read(machine)])
    assert sum(np.isfinite(run.y_um).sum() for run in runs) == taken > np.isfinite(together.y_um).sum()


async def test_an_exported_table_has_the_probes_of_the_recording(tmp_path: Path, caplog) -> None:
    """What identify and diagnose make of the table is what they make of the recording."""
    machine = ProbedMachine(tmp_path, noise_um=0.0)
    machine.each_hour(400, every=30)
    machine.at_sample[200] = lambda: machine.probe(25.0)  # a chip
    machine.at_sample[215] = lambda: machine.probe(feature="bore")
    await machine.run(420)
    out = tmp_path / "all.csv"
    assert tc.export(recordings(machine.recordings, MACHINE), out) == 420
    taken = [probe for probe in machine.recorded() if probe.taken and probe.feature == "sphere-1"]
    with out.open() as file:
        rows = [row for row in csv.DictReader(file) if row["y_um"]]
    assert len(rows) == len(taken) == 12
    for row, probe in zip(rows, taken, strict=True):
        end_ns = datetime.datetime.fromisoformat(row["time_utc"]).timestamp() * 1e9
        assert 0.0 <= end_ns - probe.time_utc_ns < 60e9
        assert float(row["y_um"]) == probe.deformation_um == probe.measured_um - probe.offset_applied_um
    assert "features_left_out" in caplog.text
    (table,), (recorded,) = (
        tc.read(one).at_period(60.0).records for one in (out, recordings(machine.recordings, MACHINE))
    )
    known = np.isfinite(recorded.columns["y_um"])
    assert np.flatnonzero(np.isfinite(table.columns["y_um"])) == pytest.approx(np.flatnonzero(known), abs=1)
    assert table.columns["y_um"][np.isfinite(table.columns["y_um"])] == pytest.approx(recorded.columns["y_um"][known])


async def test_a_measured_y_is_exported_as_it_was(tmp_path: Path) -> None:
    machine = ProbedMachine(
        tmp_path, noise_um=0.0, config=CONFIG.replace(b"poll_interval_s = 10.0", b"poll_interval_s = 60.0") + PROBE
    )
    machine.at_sample[60] = machine.probe
    await machine.run(90)
    out = tmp_path / "all.csv"
    tc.export(recordings(machine.recordings, MACHINE), out)
    with out.open() as file:
        assert all(row["y_um"] for row in csv.DictReader(file))


async def test_a_mismatch_among_probes_with_an_offset_is_no_measured_y(tmp_path: Path) -> None:
    """A probe that states 0 while the offset acts shows what is left, not the deformation."""
    machine = ProbedMachine(tmp_path, noise_um=0.0)
    machine.each_hour(400)
    machine.at_sample[200] = lambda: machine.probe(offset_applied_um=0.0)
    await machine.run(420)
    assert machine.codes().count("probe_mismatch") == 1
    found = read(machine)
    assert np.isfinite(found.table.columns["y_um"]).sum() == machine.codes().count("taken")
    (remark,) = found.remarks
    assert remark.code == "probes_left_out"
    assert "1 refused probe(s) with offset_applied_um = 0" in remark


async def test_each_recording_says_by_itself_whether_the_control_applied_nothing(tmp_path: Path) -> None:
    """A calibration and a shift after it, exported together: the same values as DATA of both has."""
    machine = ProbedMachine(tmp_path, noise_um=0.0, config=WIDE)
    for sample in range(60, 150, 30):
        machine.at_sample[sample] = lambda: machine.probe(measured_um=machine.truth_um(), offset_applied_um=0.0)
    await machine.run(160)
    machine.each_hour(310, first=220, every=30)
    await machine.run(160)
    files = recordings(machine.recordings, MACHINE)
    assert len(files) == 2 and {"probe_mismatch", "taken"} <= set(machine.codes())
    read_y = read(machine).table.columns["y_um"]
    assert np.isfinite(read_y).sum() == len(machine.recorded())
    tc.export(files, tmp_path / "both.csv")
    with (tmp_path / "both.csv").open() as file:
        exported = [float(row["y_um"]) for row in csv.DictReader(file) if row["y_um"]]
    assert exported == pytest.approx(read_y[np.isfinite(read_y)])


async def test_a_probe_belongs_to_the_sample_whose_polls_are_around_it(tmp_path: Path) -> None:
    """The label of a sample is its end, and the mean of its polls half a minute older."""
    machine = ProbedMachine(tmp_path, config=PROBED.replace(b"poll_interval_s = 60.0", b"poll_interval_s = 10.0"))
    polls = iter(range(1, 700))
    probed = {6 * 70 + 1, 6 * 80 + 3, 6 * 90 + 5}  # 10, 30 and 50 s after a sample

    def at_poll() -> None:
        if next(polls) in probed:
            machine.probe()

    machine.at_poll = at_poll
    await machine.run(100)
    assert machine.codes() == ["taken"] * 3
    out = tmp_path / "all.csv"
    tc.export(recordings(machine.recordings, MACHINE), out)
    for one in (recordings(machine.recordings, MACHINE), out):
        (record,) = tc.read(one).at_period(60.0).records
        assert np.flatnonzero(np.isfinite(record.columns["y_um"])).tolist() == [70, 80, 90]
