"""Signatures against those who can write the folder: what is covered, what a restart signs, what a head adds."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from mcap.writer import Writer

from compensator.audit.machine_audit import Audit, audit, combine, summary
from compensator.audit.result import RecordingAudit
from compensator.clock import NS
from compensator.codes import RecordingEnd
from compensator.config import load_config
from compensator.errors import ConfigError, UsageError
from compensator.recording import live_file
from compensator.recording.chain import NOTHING
from compensator.recording.container import Container, Damaged
from compensator.recording.finishing import Finisher, Retention, compact
from compensator.recording.head import KEPT, LONGEST, read_head
from compensator.recording.numbering import first_sequence
from compensator.recording.reading import (
    GROUP_BYTES,
    GROUP_RECORDS,
    groups_of,
    recordings,
    records_of,
    values_of,
)
from compensator.recording.signature import Signer, Verifier
from compensator.service.loading import head_file
from tests.audit.attacks import edited_offset, rechained, rechained_all, unsigned_seals, without_seals
from tests.audit.made import CONFIG, MACHINE, Service
from tests.audit.tampering import Line
from tests.audit.test_signatures import write_key


class Shop:
    """A machine with a key, and a head beside its folder."""

    def __init__(self, folder: Path, *, headless: bool = False) -> None:
        private, self.public = write_key(folder, "machine", 7)
        self.rec, self.head, self.signer = folder / "rec", folder / "vmc-07.head.json", Signer(private)
        self.headless = headless

    def start(self, seq: int = 0) -> Service:
        return Service(self.rec, seq=seq, signer=self.signer, head=None if self.headless else self.head)

    @property
    def files(self) -> list[Path]:
        return recordings(self.rec, MACHINE)

    def audit(self, *, head: bool = False) -> Audit:
        return audit(self.files, public_key=self.public, head=self.head if head else None)


@pytest.fixture
def shop(tmp_path: Path) -> Shop:
    return Shop(tmp_path)


def kinds(found: Audit) -> set[str]:
    return {finding.kind for finding in found.findings}


def remarks_of(service: Service) -> list[str]:
    service.recorder._finisher.wait()  # it works in the background
    return [str(data["code"]) for _, data in service.recorder.remarks()]


# ------------------------------------------------------------------ what a signature must cover


def edited_event(lines: list[Line]) -> list[Line]:
    """A change that no replay shows."""
    return [replace(line, data=line.data.replace(b"compensator test", b"compensator hist")) for line in lines]


def all_edits(lines: list[Line]) -> list[Line]:
    return edited_offset(without_seals(lines))


@pytest.mark.parametrize("finished", [False, True])
@pytest.mark.parametrize("edit", [without_seals, all_edits, unsigned_seals])
def test_stripped_signatures_are_a_finding(shop: Shop, edit: Callable[..., list[Line]], finished: bool) -> None:
    shop.start().run(130).stop()
    shop.start(130).run(130).stop()
    assert shop.audit().clean
    rechained_all(shop.files, edit, finished=finished)
    found = shop.audit()
    assert "unsigned" in kinds(found), summary(found)
    assert {finding.file for finding in found.findings if finding.kind == "unsigned"} == {p.name for p in shop.files}


def test_a_stripped_torn_file_before_the_newest_is_a_finding(shop: Shop) -> None:
    shop.start().run(20).stop()
    shop.start(20).run(20).stop()
    rechained(shop.files[0], without_seals, cut=100)
    assert "unsigned" in kinds(shop.audit())


def test_the_newest_file_may_be_unsigned_for_one_interval(shop: Shop) -> None:
    service = shop.start().run(120)
    found = shop.audit()
    assert found.clean
    assert "177 record(s) after the last signature: 59 sample(s), 59 min" in " ".join(found.remarks)
    service.kill()
    rechained(shop.files[0], without_seals)
    found = shop.audit()
    assert kinds(found) == {"unsigned"}
    assert "362 record(s): 120 sample(s), 119 min" in found.findings[0].text


def test_times_that_are_crowded_into_an_interval_do_not_help(shop: Shop) -> None:
    shop.start().run(300).stop()
    start = 0

    def crowded(lines: list[Line]) -> list[Line]:
        nonlocal start
        start = start or lines[0].time_ns
        return [replace(line, time_ns=start + (line.time_ns - start) // 10) for line in without_seals(lines)]

    rechained(shop.files[0], crowded)
    assert "unsigned" in kinds(shop.audit())


def test_a_seal_after_the_clock_was_set_back(shop: Shop) -> None:
    service = shop.start().run(70)
    service.start_ns -= 5 * 3600 * 10**9
    service.run(10)
    service.kill()
    found = shop.audit()
    assert found.clean and found.files[0].signed == 2, summary(found)


# ------------------------------------------------------------------ what a restart signs


def test_a_restart_signs_what_the_head_states(shop: Shop) -> None:
    shop.start().run(5).kill()
    shop.start(5).run(5).kill()
    service = shop.start(10).run(5)
    assert remarks_of(service) == ["recovered"]
    service.stop()
    found = shop.audit(head=True)
    assert found.clean and [file.end for file in found.files] == ["recovered", "recovered", "finished"], summary(found)
    assert not any("after the last signature" in remark for remark in found.remarks)


@pytest.mark.parametrize("torn", [1, 60, 700, 1500])
def test_a_torn_group_is_signed_as_far_as_it_was_written(shop: Shop, torn: int) -> None:
    """A kill within a write leaves any number of its bytes."""
    service = shop.start().run(5)
    # The head is ahead of the file, as after a kill between both.
    data = shop.files[0].read_bytes()
    written = service.recorder._live
    assert written is not None
    service.run(1)
    more = shop.files[0].read_bytes()
    service.kill()
    shop.files[0].write_bytes(more[: len(data) + torn])
    shop.start(6).run(5).stop()
    found = shop.audit()
    assert found.clean, summary(found)


def test_without_a_head_a_torn_end_stays_unsigned_for_good(tmp_path: Path) -> None:
    shop = Shop(tmp_path, headless=True)
    shop.start().run(65).kill()
    shop.start(65).run(5).stop()
    found = shop.audit()
    assert kinds(found) == {"unsigned"} and "4 sample(s), 4 min" in found.findings[0].text
    Shop(tmp_path).start(70).run(5).stop()
    found = shop.audit()
    assert kinds(found) == {"unsigned"} and found.findings[0].file == shop.files[0].name


@pytest.mark.parametrize("edit", [edited_offset, all_edits])
def test_a_restart_does_not_sign_what_it_did_not_write(shop: Shop, edit: Callable[..., list[Line]]) -> None:
    shop.start().run(50).kill()
    rechained(shop.files[0], edit)
    service = shop.start(50).run(5)
    assert "not_as_written" in remarks_of(service)
    service.stop()
    found = shop.audit()
    assert {"unsigned", "broken"} <= kinds(found), summary(found)
    assert not found.files[0].signed


def test_a_torn_file_that_was_cut_off_is_noticed(shop: Shop) -> None:
    shop.start().run(50).kill()
    data = shop.files[0].read_bytes()
    shop.files[0].write_bytes(data[: len(data) * 3 // 4])
    shop.start(50).run(5).stop()
    assert not shop.audit().clean


def test_a_finished_file_made_live_again_is_not_signed(shop: Shop) -> None:
    for seq in (0, 5, 10):
        shop.start(seq).run(5).stop()
    rechained(shop.files[0], all_edits)
    shop.start(15).run(5).stop()
    found = shop.audit()
    assert {"unsigned", "broken"} <= kinds(found) and not found.files[0].signed


# ------------------------------------------------------------------ what a head adds


@pytest.mark.parametrize("killed", [False, True])
def test_a_removed_newest_file_is_noticed_by_the_next_start(shop: Shop, killed: bool) -> None:
    shop.start().run(5).stop()
    service = shop.start(5).run(5)
    service.kill() if killed else service.stop()
    assert shop.audit(head=True).clean
    gone = shop.files[-1]
    gone.unlink()
    found = shop.audit(head=True)
    assert kinds(found) == {"missing_file"} and gone.name in summary(found)
    service = shop.start(10).run(5)
    assert "not_as_written" in remarks_of(service)
    service.stop()
    found = shop.audit()
    assert "missing_file" in kinds(found) and gone.name in summary(found)


def test_all_files_removed_is_said(shop: Shop) -> None:
    shop.start().run(5).stop()
    gone = shop.files[0]
    gone.unlink()
    shop.start(5).run(5).stop()
    assert f"continues {gone.name}" in summary(shop.audit())


def test_the_head_covers_the_newest_file_up_to_the_last_sync(shop: Shop) -> None:
    service = shop.start().run(30)
    service.kill()
    found = shop.audit(head=True)
    # The head is written before the sync: the last group is on disk, and not yet stated as such.
    assert found.clean and "3 record(s) after the last signature: 1 sample(s)" in " ".join(found.remarks)
    rechained(shop.files[0], edited_event)
    assert shop.audit().clean  # within the interval nothing shows it without the head
    found = shop.audit(head=True)
    assert kinds(found) == {"truncated"} and "head" in summary(found)


def test_a_head_that_is_older_than_the_file_is_no_reason_to_accuse(shop: Shop) -> None:
    service = shop.start().run(5)
    old = shop.head.read_bytes()
    service.run(5).kill()
    shop.head.write_bytes(old)
    service = shop.start(10).run(5)
    assert "not_as_written" in remarks_of(service)
    service.stop()
    found = shop.audit()
    assert kinds(found) == {"unsigned"}, summary(found)


@pytest.mark.parametrize("spoil", ["forged", "other", "rubbish", "pipe", "huge"])
def test_a_head_that_is_not_the_machines_is_not_used(shop: Shop, tmp_path: Path, spoil: str) -> None:
    shop.start().run(5).kill()
    rechained(shop.files[0], edited_offset)
    good = msgspec.json.decode(shop.head.read_bytes())
    shop.head.unlink()
    if spoil == "forged":
        good["ends"][0]["synced"] = "00" * 32
        shop.head.write_bytes(msgspec.json.encode(good))
    elif spoil == "other":
        shop.head.write_bytes(msgspec.json.encode(good | {"machine": "vmc-08"}))
    elif spoil == "rubbish":
        shop.head.write_bytes(b"[" * 2000)
    elif spoil == "pipe":
        os.mkfifo(shop.head)
    else:
        shop.head.write_bytes(b" " * (LONGEST + 1))
    with pytest.raises(UsageError) as refused:
        read_head(shop.head, Verifier(shop.public))
    assert "\n" not in str(refused.value)
    service = shop.start(5).run(5)
    assert "head_not_kept" in remarks_of(service)
    service.stop()
    assert "unsigned" in kinds(shop.audit())


def test_a_head_that_cannot_be_written_stops_no_recording(shop: Shop, tmp_path: Path) -> None:
    shop.head = tmp_path / "nowhere" / "head.json"
    service = shop.start().run(5)
    assert remarks_of(service) == ["head_not_kept"]
    service.run(5).stop()
    assert shop.audit().clean


@pytest.mark.parametrize("data", [b"no recording", bytes(3000)])
def test_rubbish_under_the_newest_name_stops_no_recording(shop: Shop, data: bytes) -> None:
    shop.start().run(5).stop()
    (shop.rec / "vmc-07_20991231T000000Z.mcap").write_bytes(data)
    assert first_sequence(shop.rec, MACHINE, 0, 60.0) == 5
    service = shop.start(5).run(5)
    assert "not_as_written" in remarks_of(service)
    service.stop()
    assert len(shop.files) == 3


def test_a_head_needs_the_key(shop: Shop) -> None:
    shop.start().run(2).stop()
    with pytest.raises(UsageError, match="public key"):
        audit(shop.files, head=shop.head)


def test_where_the_head_is_kept(tmp_path: Path) -> None:
    write_key(tmp_path, "machine", 7)
    path = tmp_path / "machine.toml"

    def config(*lines: str) -> None:
        path.write_bytes(CONFIG.replace(b"recording.folder", "\n".join([*lines, "recording.folder"]).encode()))

    config()
    assert head_file(load_config(path)) is None
    config('recording.signing_key = "machine.pem"')
    assert head_file(load_config(path)) == tmp_path / "vmc-07.head.json"
    config('recording.signing_key = "machine.pem"', 'recording.head = "state/head.json"')
    assert head_file(load_config(path)) == tmp_path / "state" / "head.json"
    config('recording.signing_key = "machine.pem"', 'recording.head = "rec/head.json"')
    with pytest.raises(ConfigError, match="in the recording folder"):
        head_file(load_config(path))
    config('recording.head = "head.json"')
    with pytest.raises(ConfigError, match="needs recording"):
        head_file(load_config(path))
    config('recording.signing_key = "machine.pem"', 'recording.head = ""')
    with pytest.raises(ConfigError, match=r"recording\.head = ''"):
        load_config(path)
    (tmp_path / "folder").mkdir()
    for head in ("/dev/null", "folder"):
        config('recording.signing_key = "machine.pem"', f'recording.head = "{head}"')
        with pytest.raises(ConfigError, match="is not a regular file"):
            head_file(load_config(path))
    (tmp_path / "other.pem").hardlink_to(tmp_path / "machine.pem")
    for head in ("machine.pem", "folder/../machine.pem", "other.pem", "machine.toml"):
        config('recording.signing_key = "machine.pem"', f'recording.head = "{head}"')
        with pytest.raises(ConfigError, match="which it would replace"):
            head_file(load_config(path))


def test_what_lies_behind_the_head_is_counted_from_it(shop: Shop) -> None:
    """Nineteen samples lie behind the last seal; the head covers all but the last sync."""
    shop.start().run(80).kill()
    without, (behind,) = shop.audit().files[0], shop.audit(head=True).files
    assert (without.unsigned_samples, without.unsigned_min) == (19, 19.0)
    assert (behind.unsigned_samples, behind.unsigned_min) == (1, 1.0)


# ------------------------------------------------------------------ files without a record, and kills at a seal


@pytest.mark.parametrize("removed", [slice(1, 2), slice(1, 4), slice(0, 2)])
@pytest.mark.parametrize("place", [0, 1])
def test_an_empty_file_between_two_does_not_hide_what_was_removed(shop: Shop, removed: slice, place: int) -> None:
    for i in range(5):
        shop.start(20 * i).run(20).stop()
    files = shop.files
    assert shop.audit(head=True).clean
    for path in files[removed]:
        path.unlink()
    without = shop.audit(head=True)
    # By its name it stands where the removed ones were, or right after the first of those that are left.
    decoy = files[removed][0] if place else files[removed][-1]
    decoy.with_name(decoy.stem.replace("Z", "Z-001") + ".mcap").touch()
    found = shop.audit(head=True)
    assert kinds(found) == kinds(without)
    of_decoy = ("torn", "not_worked_out")
    assert [r.code for r in without.remarks] == [r.code for r in found.remarks if r.code not in of_decoy]
    assert found.clean is (removed.start == 0)


@pytest.mark.parametrize("headless", [False, True])
def test_an_honest_file_without_a_record_is_passed_over(tmp_path: Path, headless: bool) -> None:
    """A kill before the first sync leaves one; without a head, too, the chain goes on from the file before."""
    (tmp_path / "shop").mkdir()
    shop = Shop(tmp_path / "shop", headless=headless)
    shop.start().run(20).stop()
    (shop.rec / f"{MACHINE}_20260105T230000Z.mcap").touch()
    shop.start(1100).run(20).stop()
    first, empty, _ = shop.files
    assert empty.stat().st_size == 0 and shop.audit().clean
    first.unlink()
    assert f"continues {first.name}, which was not given" in " ".join(shop.audit().remarks)


def test_a_later_file_that_states_that_one_before_it_was_empty_is_told_as_such() -> None:
    """As services without a head left it until now."""
    first = RecordingAudit(file="vmc-07_20260105T060000Z.mcap", original="vmc-07_20260105T060000Z.mcap")
    first.machine, first.last, first.previous = MACHINE, "11" * 32, NOTHING.hex()
    empty = RecordingAudit(file="vmc-07_20260105T070000Z.mcap", original="vmc-07_20260105T070000Z.mcap")
    empty.machine, empty.end = MACHINE, RecordingEnd.TORN
    last = replace(first, file="vmc-07_20260105T080000Z.mcap", original="vmc-07_20260105T080000Z.mcap")
    last.last, last.previous_file = "22" * 32, empty.file
    found = combine([first, empty, last])
    assert found.clean and "held no record" in " ".join(found.remarks)
    last.previous = "33" * 32
    assert kinds(combine([first, empty, last])) == {"truncated"}


@pytest.mark.parametrize("minutes", [60, 61, 62])
def test_a_kill_after_the_seal_of_an_hour_leaves_a_whole_recording(shop: Shop, minutes: int) -> None:
    shop.start().run(minutes).kill()
    shop.start(minutes).run(5).stop()
    found = shop.audit(head=True)
    assert found.clean, summary(found)
    assert [file.end for file in found.files] == [RecordingEnd.RECOVERED, RecordingEnd.FINISHED]


@pytest.mark.parametrize("is_end", [False, True], ids=["hour", "stop"])
def test_a_write_that_was_torn_between_a_seal_and_its_place_in_the_chain(shop: Shop, is_end: bool) -> None:
    service = shop.start().run(61)
    live = service.recorder._live
    if is_end and live is not None:
        live.seal("stop", service.now_ns, shop.signer)
        live.sync()
    service.kill()
    shop.files[0].write_bytes(_up_to_last_seal(shop.files[0]))
    compact(shop.files[0], shop.signer, accepted=frozenset(value.hex() for value in values_of(shop.files[0])))
    found = shop.audit()
    assert found.clean, summary(found)


def _up_to_last_seal(path: Path) -> bytes:
    """The bytes of a live recording up to the last seal, without the message of the chain that lists it."""
    end = 0
    with Container(path) as container, suppress(Damaged):
        for record in records_of(container):
            if record.topic == "seal":
                end = container.position
    return path.read_bytes()[:end]


@pytest.mark.parametrize("name", ["20990101T000000Z-copy", "00000000T000000Z", "20260105T060000Z-"])
def test_a_strangers_file_stops_no_recording_and_no_finishing(shop: Shop, name: str) -> None:
    shop.rec.mkdir()
    (shop.rec / f"{MACHINE}_{name}.mcap").touch()
    shop.start().run(10).kill()
    shop.start(10).run(10).stop()
    assert [file.end for file in shop.audit(head=True).files] == [RecordingEnd.RECOVERED, RecordingEnd.FINISHED]
    assert shop.audit(head=True).clean


def test_the_file_before_an_empty_one_may_still_be_without_its_next_seal(shop: Shop) -> None:
    shop.start().run(20).kill()
    (shop.rec / f"{MACHINE}_20260105T230000Z.mcap").touch()
    assert shop.audit().clean and shop.audit(head=True).clean, summary(shop.audit())


def test_an_empty_file_beside_a_running_service_is_not_the_one_before_its_next(shop: Shop) -> None:
    service = shop.start().run(20)
    (shop.rec / f"{MACHINE}_20260105T230000Z.mcap").touch()
    service.recorder.start_new()
    service.run(5).stop()
    assert shop.audit(head=True).clean, summary(shop.audit(head=True))


def test_a_full_disk_that_opens_no_file_forgets_no_end(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    """The head keeps the end of the file that was broken off, however often a new one cannot be begun."""
    shop.start().run(20).kill()
    service = shop.start(20)

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(live_file.os, "write", full)
        for i in range(KEPT + 1):
            with pytest.raises(OSError, match="No space"):
                service.recorder.write([], service.now_ns + i * NS)
    service.run(5).stop()
    assert shop.audit(head=True).clean, summary(shop.audit(head=True))


def test_kills_right_after_the_start_of_a_file_leave_ends_that_are_signed(
    shop: Shop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a computer so busy that a file before is finished only by the ninth start."""
    with monkeypatch.context() as busy:
        busy.setattr(Finisher, "enqueue", lambda *_: None)
        for i in range(KEPT - 1):
            service = shop.start(i)
            service.recorder.write([], service.now_ns)
            service.kill()
    shop.start(KEPT).run(5).stop()
    found = shop.audit(head=True)
    assert found.clean, summary(found)
    assert [file.end for file in found.files] == ["recovered"] * (KEPT - 1) + ["finished"]


def test_a_file_without_a_record_is_none_of_those_that_retention_keeps(shop: Shop) -> None:
    for i in range(3):
        shop.start(10 * i).run(10).stop()
    for hour in (22, 23):
        (shop.rec / f"{MACHINE}_20260105T{hour}0000Z.mcap").touch()
    finisher = Finisher(shop.rec, MACHINE, Retention(keep_days=1), shop.signer)
    finisher.make_room(2**62)
    finisher.wait()
    assert [path.stat().st_size > 0 for path in shop.files] == [True, True, False, False]


def test_a_finished_file_without_a_record_in_the_place_of_another_is_a_finding() -> None:
    names = [f"{MACHINE}_20260105T0{hour}0000Z.mcap" for hour in (6, 7, 8)]
    files = [RecordingAudit(file=name, original=name, machine=MACHINE, samples=1) for name in names]
    for file, value, before in zip(files, ("11", "", "33"), ("", names[0], names[1]), strict=True):
        file.last, file.previous_file = value * 32, before
        file.previous = "22" * 32 if before == names[1] else NOTHING.hex()
    assert "truncated" in kinds(combine(files))


@pytest.mark.parametrize(("count", "size"), [(GROUP_RECORDS + 1, 0), (20, GROUP_BYTES // 16)])
def test_a_group_that_never_ends_is_damage(tmp_path: Path, count: int, size: int) -> None:
    path = tmp_path / "long.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        sample, _ = (writer.register_channel(topic, "json", schema) for topic in ("/sample", "/chain"))
        for i in range(count):
            writer.add_message(sample, i, bytes(size), i, sequence=i)
        writer.finish()
    with Container(path) as container, pytest.raises(Damaged, match="too long"):
        assert all(not group.whole for group in groups_of(container))
