"""Every kind of tampering is found and named; what a kill leaves is not called tampering."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from compensator.audit.findings import Finding
from compensator.audit.machine_audit import Audit, audit, summary
from compensator.audit.pages import audit_page
from compensator.audit.verdict import verdict
from compensator.recording.container import Attachment, Contents
from compensator.recording.reading import in_order, recordings
from tests.audit.made import MACHINE, MINUTE_NS, Service
from tests.audit.tampering import Line, find, group, lines_of, rewrite, with_new_values
from tests.service.simulated import START_NS

#: 23:46, so that the fifteenth sample opens the next day.
EVENING_NS = START_NS + (17 * 60 + 46) * MINUTE_NS


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three days: 14, 20 and 12 samples; the third is another run."""
    folder = tmp_path_factory.mktemp("made")
    service = Service(folder, start_ns=EVENING_NS)
    service.run(10)
    service.command("hold")
    service.run(10)
    service.command("resume")
    service.run(14).stop()
    Service(folder, start_ns=EVENING_NS + 60 * MINUTE_NS, seq=34).run(12).stop()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "rec"))


def look(folder: Path) -> Audit:
    return audit(recordings(folder, MACHINE))


def second(folder: Path) -> Path:
    return recordings(folder, MACHINE)[1]


def only(found: Audit) -> Finding:
    assert len(found.findings) == found.findings_count == 1, "\n".join(f.line() for f in found.findings)
    return found.findings[0]


def test_untouched_recordings_are_clean_and_compact(folder: Path) -> None:
    found = look(folder)
    assert found.clean and found.samples == 46 and found.findings == ()
    assert [file.end for file in found.files] == ["finished"] * 3
    assert [file.began for file in found.files] == ["start", "day", "start"]
    assert not found.remarks


def test_writing_a_file_again_in_another_layout_changes_nothing(folder: Path) -> None:
    before = look(folder)
    for chunked in (False, True):
        for path in recordings(folder, MACHINE):
            rewrite(path, chunked=chunked)
        found = look(folder)
        assert found.clean and [f.last for f in found.files] == [f.last for f in before.files]


# ------------------------------------------------------------------ a record

EDITS = {
    "sample": (b'"spread":0.01', b'"spread":0.02'),
    "estimate": (b'"y_base_um":0.0', b'"y_base_um":0.5'),
    "offset": (b'"valid_for_s":150.0', b'"valid_for_s":950.0'),
    "event": (b'"kind":"', b'"kind":"x'),
    "chain": (b'"topic":"sample"', b'"topic":"simple"'),
    "seal": (b'"reason":"stop"', b'"reason":"hour"'),
}


@pytest.mark.parametrize("chunked", [False, True])
@pytest.mark.parametrize("topic", list(EDITS))
def test_an_edited_record_is_named(folder: Path, topic: str, chunked: bool) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    at = find(lines, topic, 7 if topic in ("sample", "estimate", "offset", "chain") else -1)
    edited = lines[at].edited(*EDITS[topic])
    rewrite(path, lambda lines: [*lines[:at], edited, *lines[at + 1 :]], chunked=chunked)
    finding = next(f for f in look(folder).findings if f.kind == "altered")
    assert (finding.file, finding.topic, finding.sequence, finding.time_utc_ns) == (
        path.name,
        topic,
        edited.sequence,
        edited.time_ns,
    )
    assert f"/{topic} record {edited.sequence} 2026-01-0" in finding.line()


def test_one_bit_in_the_file_itself_is_damage_or_named(folder: Path) -> None:
    path = second(folder)
    rewrite(path, chunked=False)
    data = bytearray(path.read_bytes())
    place = data.index(b'"mean":', data.index(b'"seq":25,'))
    data[place + 9] ^= 1
    path.write_bytes(data)
    kinds = {(f.kind, f.topic) for f in look(folder).findings}
    assert ("altered", "sample") in kinds and ("damaged", "") in kinds  # the chain names it, the CRC sees it, too


def test_another_time_or_number_is_an_edit(folder: Path) -> None:
    path = second(folder)
    original = path.read_bytes()
    lines, _ = lines_of(path)
    at = find(lines, "offset", 5)
    for changed in (replace(lines[at], time_ns=lines[at].time_ns + 1), replace(lines[at], sequence=9999)):
        path.write_bytes(original)
        rewrite(path, lambda lines, changed=changed: [*lines[:at], changed, *lines[at + 1 :]])
        found = look(folder)
        assert any(f.topic == "offset" and f.sequence == lines[at].sequence for f in found.findings)


@pytest.mark.parametrize("topic", ["sample", "estimate", "offset"])
def test_a_removed_record_is_named(folder: Path, topic: str) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    at = find(lines, topic, 9)
    rewrite(path, lambda lines: lines[:at] + lines[at + 1 :])
    finding = only(look(folder))
    assert (finding.kind, finding.topic, finding.sequence) == ("removed", topic, lines[at].sequence)
    assert finding.time_utc_ns == lines[at].time_ns


def test_a_removed_group_is_named_by_its_numbers(folder: Path) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    begin, _ = group(lines, 5)
    _, end = group(lines, 7)
    rewrite(path, lambda lines: lines[:begin] + lines[end:])
    finding = only(look(folder))
    assert finding.kind == "removed"
    assert f"records {lines[begin].sequence} to {lines[end - 1].sequence} are missing" in finding.text


def test_a_removed_message_of_the_chain_is_named(folder: Path) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    at = find(lines, "chain", 6)
    rewrite(path, lambda lines: lines[:at] + lines[at + 1 :])
    finding = only(look(folder))
    assert (finding.kind, finding.topic, finding.sequence) == ("removed", "chain", lines[at].sequence)


def test_without_its_first_message_the_chain_is_not_whole(folder: Path) -> None:
    rewrite(second(folder), lambda lines: lines[1:])
    found = look(folder)
    assert any((f.kind, f.topic, f.sequence) == ("removed", "chain", 0) for f in found.findings)


def test_without_any_message_of_the_chain(folder: Path) -> None:
    rewrite(second(folder), lambda lines: [line for line in lines if line.topic not in ("chain", "seal")])
    assert any(f.kind == "removed" and "chain" in f.topic for f in look(folder).findings)


def test_a_neatly_shortened_end_lacks_its_seal(folder: Path) -> None:
    path = recordings(folder, MACHINE)[2]
    rewrite(path, lambda lines: lines[: find(lines, "chain", -4) + 1])
    finding = only(look(folder))
    assert (finding.kind, finding.topic) == ("removed", "seal")


def test_a_neatly_shortened_end_without_the_files_end_is_told_by_the_next_file(folder: Path) -> None:
    path = second(folder)
    rewrite(path, lambda lines: lines[: find(lines, "chain", -4) + 1], chunked=False)
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b'"records":[')])  # no end: as if the service had been killed
    finding = only(look(folder))
    assert (finding.kind, finding.file) == ("truncated", path.name)


@pytest.mark.parametrize("where", [0, 2])
def test_an_inserted_record_is_named(folder: Path, where: int) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    at = find(lines, "sample", 6) + where
    forged = replace(lines[find(lines, "offset", 3)], sequence=7777, time_ns=lines[at].time_ns)
    rewrite(path, lambda lines: [*lines[:at], forged, *lines[at:]])
    found = look(folder)
    assert any((f.kind, f.topic, f.sequence) == ("inserted", "offset", 7777) for f in found.findings)


def test_a_record_that_stands_twice_is_named(folder: Path) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    at = find(lines, "estimate", 6)
    rewrite(path, lambda lines: [*lines[:at], lines[at], *lines[at:]])
    finding = only(look(folder))
    assert (finding.kind, finding.topic, finding.sequence) == ("inserted", "estimate", lines[at].sequence)


def test_a_group_that_stands_twice_is_named(folder: Path) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    begin, end = group(lines, 6)
    rewrite(path, lambda lines: lines[:end] + lines[begin:])
    finding = next(f for f in look(folder).findings)
    assert finding.kind == "inserted" and finding.sequence == lines[begin].sequence


def test_swapped_records_of_a_sample_are_named(folder: Path) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    at = find(lines, "estimate", 6)
    assert lines[at + 1].topic == "offset"
    rewrite(path, lambda lines: [*lines[:at], lines[at + 1], lines[at], *lines[at + 2 :]])
    finding = only(look(folder))
    assert (finding.kind, finding.sequence) == ("reordered", lines[at + 1].sequence)


def test_swapped_records_of_two_samples_are_named(folder: Path) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    a, b = find(lines, "offset", 4), find(lines, "offset", 11)

    def swap(lines: list[Line]) -> list[Line]:
        lines[a], lines[b] = lines[b], lines[a]
        return lines

    rewrite(path, swap)
    found = look(folder)
    moved = {(f.topic, f.sequence) for f in found.findings if f.kind == "reordered"}
    assert moved == {("offset", lines[a].sequence), ("offset", lines[b].sequence)}


def test_swapped_groups_are_named(folder: Path) -> None:
    path = second(folder)
    lines, _ = lines_of(path)
    (a, b), (c, d) = group(lines, 4), group(lines, 5)
    assert b == c
    rewrite(path, lambda lines: [*lines[:a], *lines[c:d], *lines[a:b], *lines[d:]])
    findings = look(folder).findings
    assert {f.kind for f in findings} == {"reordered"} and findings[0].sequence == lines[a].sequence


@pytest.mark.parametrize("topic", ["sample", "estimate", "offset"])
def test_with_the_values_of_the_file_computed_anew_the_next_file_tells(folder: Path, topic: str) -> None:
    path = second(folder)
    lines, contents = lines_of(path)
    at = find(lines, topic, 7)
    lines[at] = lines[at].edited(*EDITS[topic])
    rewrite(path, lambda _: with_new_values(lines, contents))
    found = look(folder)
    # The seal at its end was made over the true values, and the next file goes on from them.
    assert {(f.kind, f.topic) for f in found.findings} == {("altered", "seal"), ("broken", "")}
    if topic != "sample":  # and what the engine makes of the sample is not what stands there
        assert found.difference is not None and found.difference.topic == topic


# ------------------------------------------------------------------ attachments, metadata, channels


def edit_model(contents: Contents) -> None:
    part = contents.attachments["model.toml"]
    contents.attachments["model.toml"] = replace(part, data=part.data.replace(b"0.05", b"0.06"))


def edit_state(contents: Contents) -> None:
    part = contents.attachments["state.json"]
    contents.attachments["state.json"] = replace(part, data=part.data.replace(b'"wanted":false', b'"wanted":true'))


def edit_metadata(contents: Contents) -> None:
    contents.metadata["run"]["python"] = "2.7"


def edit_previous(contents: Contents) -> None:
    contents.metadata["run"]["previous_chain"] = "ab" * 32


def edit_schema(contents: Contents) -> None:
    contents.channels[1] = replace(contents.channels[1], schema=b"{}")


def remove_config(contents: Contents) -> None:
    del contents.attachments["config.toml"]


def add_attachment(contents: Contents) -> None:
    contents.attachments["note.txt"] = Attachment("note.txt", "text/plain", 0, 0, b"all is well")


@pytest.mark.parametrize(
    ("edit", "kind", "name"),
    [
        (edit_model, "altered", "attachment model.toml"),
        (edit_state, "altered", "attachment state.json"),
        (edit_metadata, "altered", "metadata run"),
        (edit_previous, "altered", "metadata run"),
        (edit_schema, "altered", "channel /sample"),
        (remove_config, "removed", "attachment config.toml"),
        (add_attachment, "inserted", "attachment note.txt"),
    ],
)
def test_what_the_file_opens_with_is_covered(
    folder: Path, edit: Callable[[Contents], None], kind: str, name: str
) -> None:
    rewrite(second(folder), contents=edit)
    assert (kind, name) in {(f.kind, f.topic) for f in look(folder).findings}


def test_a_name_with_thousands_of_digits_in_the_metadata_is_named(folder: Path) -> None:
    """Python reads no number that long; the other files are audited nonetheless."""

    def numbered(contents: Contents) -> None:
        contents.run["file"] = f"{MACHINE}_20260105T000000Z-{'1' * 5000}.mcap"

    rewrite(second(folder), contents=numbered)
    found = look(folder)
    assert found.samples == 46
    assert any(finding.file == second(folder).name and finding.topic == "metadata run" for finding in found.findings)
    assert in_order(recordings(folder, MACHINE))


def test_an_attachment_added_later_is_named(folder: Path) -> None:
    rewrite(second(folder), late=Attachment("late.txt", "text/plain", 0, 0, b"x"))
    finding = only(look(folder))
    assert (finding.kind, finding.topic) == ("inserted", "attachment late.txt")


# ------------------------------------------------------------------ files


def test_swapped_files_are_named(folder: Path) -> None:
    first, other, _ = recordings(folder, MACHINE)
    a, b = first.read_bytes(), other.read_bytes()
    first.write_bytes(b)
    other.write_bytes(a)
    findings = look(folder).findings
    assert {(f.kind, f.file) for f in findings if "the name of another file" in f.text} == {
        ("reordered", first.name),
        ("reordered", other.name),
    }


@pytest.mark.parametrize("name", ["{}x.mcap", "again/{}.mcap"])
def test_a_copy_of_the_first_file_beside_it_is_named(folder: Path, name: str) -> None:
    """It begins a chain as the first one does, and the next file continues from it as well."""
    first, *others = recordings(folder, MACHINE)
    copy = folder / name.format(first.stem)
    copy.parent.mkdir(exist_ok=True)
    shutil.copy(first, copy)
    for paths in ([first, copy, *others], [copy, first]):
        finding = only(audit(paths))
        assert finding.kind == "inserted"
        assert "is a copy of" in finding.text and first.name in finding.text


def test_a_file_that_is_missing_between_others_is_named(folder: Path) -> None:
    first, gone, last = recordings(folder, MACHINE)
    gone.unlink()
    finding = only(look(folder))
    assert (finding.kind, finding.file) == ("missing_file", last.name)
    assert gone.name in finding.text and first.name in finding.text


def test_the_oldest_file_may_be_gone(folder: Path) -> None:
    first, *_ = recordings(folder, MACHINE)
    first.unlink()
    found = look(folder)
    assert found.clean
    assert any(f"continues {first.name}, which was not given" in remark for remark in found.remarks)


def test_another_recording_in_its_place_is_told(folder: Path, tmp_path: Path) -> None:
    """A whole run made up again: each file fits by itself, and the next one does not go on from it."""
    forged = tmp_path / "forged"
    Service(forged, start_ns=EVENING_NS).run(34).stop()
    path = second(folder)
    shutil.copy(forged / path.name, path)
    assert {(f.kind, f.file) for f in look(folder).findings} == {
        ("broken", path.name),
        ("broken", recordings(folder, MACHINE)[2].name),
    }


# ------------------------------------------------------------------ the end


@pytest.mark.parametrize("garbage", [b"x", b"\0" * 5, b"garbage" * 100, bytes(range(256))])
def test_garbage_behind_the_end_is_damage(folder: Path, garbage: bytes) -> None:
    path = second(folder)
    path.write_bytes(path.read_bytes() + garbage)
    finding = only(look(folder))
    assert finding.kind == "damaged" and "after the end" in finding.text


@pytest.mark.parametrize("which", [1, 2])
def test_a_finished_file_cut_anywhere_is_truncated(folder: Path, which: int) -> None:
    path = recordings(folder, MACHINE)[which]
    data = path.read_bytes()
    for cut in [*range(60, len(data), 211), len(data) - 1]:
        path.write_bytes(data[:cut])
        kinds = {f.kind for f in look(folder).findings}
        assert kinds == {"truncated"}, cut


def test_a_file_of_which_nothing_is_left_is_told_by_the_next_one(folder: Path) -> None:
    path = second(folder)
    path.write_bytes(path.read_bytes()[:20])
    finding = only(look(folder))
    assert (finding.kind, finding.file) == ("truncated", path.name)


@pytest.mark.parametrize("left", [0, 5, 20])
def test_what_the_last_file_held_is_not_said_to_be_proven(folder: Path, left: int) -> None:
    """A kill as a file begins leaves such a one, so it is no finding; but nothing shows that it never held a record."""
    path = recordings(folder, MACHINE)[-1]
    path.write_bytes(path.read_bytes()[:left])  # magic and a part of the header: alike in every file
    found = look(folder)
    assert found.clean and [file.file for file in found.perhaps_emptied] == [path.name]
    assert verdict(found).startswith("Proven in part: ")
    assert "3 recording(s); 1 of them without a record, which may have been removed" in verdict(found)
    (remark,) = found.remarks
    assert remark.code == "torn" and f"{path.name}: ends before the first record ({left} bytes), and no" in remark
    assert "between the first and the last of them nothing was changed, removed" in summary(found)
    # The next start continues from the file before, and so shows that this one held nothing then.
    Service(folder, start_ns=EVENING_NS + 80 * MINUTE_NS, seq=50).run(5).stop()
    assert not look(folder).perhaps_emptied and "no later file" not in " ".join(look(folder).remarks)


@pytest.mark.parametrize("missing", [False, True])
def test_between_two_chains_nothing_is_said_to_be_proven(folder: Path, tmp_path: Path, missing: bool) -> None:
    """A new installation begins a chain of its own; so does whoever removes what was before."""
    Service(tmp_path / "new", start_ns=EVENING_NS + 80 * MINUTE_NS, seq=50).run(5).stop()
    paths = [*recordings(folder, MACHINE), *recordings(tmp_path / "new", MACHINE)]
    if missing:
        del paths[2]
    found = audit(paths)
    assert found.clean and found.restarts == (paths[-1].name,)
    assert verdict(found).startswith("Proven in part: ")
    assert f"before {paths[-1].name}, which begins a new chain, files may be missing" in verdict(found)
    assert "within each of the 2 chains nothing was changed" in summary(found)
    assert "reproduces every estimate and every offset, bit for bit" in summary(found)  # all were replayed
    rows = {str(row[0]): row[1:] for row in audit_page(found).blocks[1].rows}  # type: ignore[union-attr]
    outcome, how = rows["No file is missing between the first and the last"]
    assert str(outcome).startswith("–") and how == f"a new chain begins with {paths[-1].name}"


def test_a_live_file_cut_anywhere_is_what_a_kill_leaves(folder: Path, tmp_path: Path) -> None:
    service = Service(tmp_path / "live", start_ns=EVENING_NS).run(8)
    path = service.recorder.path
    assert path is not None
    data = path.read_bytes()
    service.kill()
    ends = set()
    for cut in [*range(40), *range(40, len(data), 101), len(data)]:
        path.write_bytes(data[:cut])
        found = audit([path])
        # What ends before its first record is no sign of a change, but proves nothing.
        kinds = [finding.kind for finding in found.findings]
        assert kinds == ([] if found.files[0].last else ["empty"]), (cut, found.findings)
        assert found.files[0].end in ("open", "torn") and any(path.name in remark for remark in found.remarks)
        ends.add(found.files[0].end)
    assert ends == {"open", "torn"}


def test_a_length_changed_in_a_live_file_is_no_torn_end(tmp_path: Path) -> None:
    service = Service(tmp_path, start_ns=EVENING_NS).run(8)
    path = service.recorder.path
    assert path is not None
    data = bytearray(path.read_bytes())
    service.kill()
    place = data.index(b'{"schema":1,"machine":"vmc-07","seq":5,') - 31
    data[place + 3] = 0x40  # the length of this record: 4 MiB more
    path.write_bytes(data)
    finding = only(audit([path]))
    assert finding.kind == "damaged" and "its content is complete" in finding.text


def test_a_kill_is_no_tampering_and_the_next_file_goes_on(tmp_path: Path) -> None:
    service = Service(tmp_path, start_ns=EVENING_NS).run(8)
    path = service.recorder.path
    assert path is not None
    service.kill()
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b'"records":[')])  # sample, estimate and offset are whole, the chain is not
    Service(tmp_path, start_ns=EVENING_NS + 10 * MINUTE_NS, seq=8).run(5).stop()
    found = look(tmp_path)
    assert found.clean and [f.end for f in found.files] == ["recovered", "finished"]
    assert found.files[0].samples == 8 and "killed" in found.remarks[0]
    # Less than was there at that restart: somebody was at it afterwards.
    path = recordings(tmp_path, MACHINE)[0]
    rewrite(path, lambda lines: lines[: find(lines, "chain", -5) + 1])
    assert {f.kind for f in look(tmp_path).findings} == {"removed", "broken"}


def test_findings_of_what_a_file_opens_with_come_in_one_order(folder: Path) -> None:
    """An auditor compares two audits; a set would give another order in each process."""

    def strip(contents: Contents) -> None:
        contents.attachments.clear()

    rewrite(second(folder), contents=strip)
    topics = [f.topic for f in look(folder).findings if f.kind == "removed"]
    assert len(topics) >= 3 and topics == sorted(topics)
