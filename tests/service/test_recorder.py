"""The recorder: what travels in a file."""

from __future__ import annotations

from pathlib import Path

from mcap.reader import make_reader

from compensator.recording.reading import recordings
from compensator.recording.recorder import McapRecorder
from tests.service.simulated import START_NS


def attached(path: Path) -> dict[str, bytes]:
    with path.open("rb") as file:
        return {a.name: a.data for a in make_reader(file).iter_attachments()}


def test_a_file_carries_the_state_that_it_opens_with(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path, "vmc-07", {"model.toml": b"first"})
    recorder.write([("sample", b"{}")], START_NS, state=b"one")
    recorder.write([("sample", b"{}")], START_NS, state=b"two")  # the file is open: not this one
    recorder.attachments = {"model.toml": b"second"}
    recorder.start_new()
    recorder.start_new()  # nothing is open: nothing happens
    recorder.write([("sample", b"{}")], START_NS, state=b"three")
    recorder.close()
    first, second = recordings(tmp_path, "vmc-07")
    assert attached(first) == {"model.toml": b"first", "state.json": b"one"}
    assert attached(second) == {"model.toml": b"second", "state.json": b"three"}


def test_without_a_state_there_is_no_attachment_of_it(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path, "vmc-07", {})
    recorder.write([("sample", b"{}")], START_NS)
    recorder.close()
    assert attached(recordings(tmp_path, "vmc-07")[0]) == {}
