"""Numbers in a recording that no recording holds: each reader refuses the file in one line that names the place.

The chain of every file fits: it was computed anew, as somebody does who can write the folder and has no key.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from compensator.audit.machine_audit import audit
from compensator.audit.other_model import compare
from compensator.data.export import export
from compensator.data.files import read_recordings
from compensator.errors import DataError
from compensator.messages import NUMBER_MAX, SEQ_MAX, TIME_MAX_NS
from compensator.model.model_file import load_model
from compensator.recording.reading import recordings
from compensator.report.formats import write
from compensator.report.gathering import read_history
from compensator.report.recordings import page_of
from tests.audit.attacks import rechained
from tests.audit.made import MACHINE, Service
from tests.audit.tampering import Line, find

DIGITS = "9" * 400
#: What is changed, and what each reader but the audit says of it.
IMPOSSIBLE = [
    ("sample", "time_utc_ns", DIGITS, "time_utc_ns"),
    ("sample", "time_utc_ns", "9" * 6000, "out of range"),
    ("sample", "time_utc_ns", "-1", "time_utc_ns"),
    ("sample", "seq", DIGITS, "seq"),
    ("sample", "seq", str(SEQ_MAX + 1), "seq"),
    ("sample", "seq", "-1", "seq"),
    ("sample", "period_s", "1e308", "period_s"),
    ("sample", "mean", "1e308", "channels"),
    ("sample", "spread", "-1.1e30", "channels"),
    ("sample", "count", DIGITS, "channels"),
    ("estimate", "time_utc_ns", DIGITS, "time_utc_ns"),
    ("estimate", "y_pred_um", "1e308", "y_pred_um"),
    ("estimate", "seq", str(2**63 - 1), "seq"),
    ("offset", "time_utc_ns", DIGITS, "time_utc_ns"),
    ("offset", "time_utc_ns", str(-(2**63)), "time_utc_ns"),
    ("offset", "y_offset_um", "1e308", "y_offset_um"),
    ("offset", "y_offset_um", "5001.0", "y_offset_um"),
    ("offset", "valid_for_s", "1e400", "valid_for_s"),
    ("event", "time_utc_ns", DIGITS, "time_utc_ns"),
    ("event", "data", '{"missing":' + DIGITS + "}", "data.missing"),
    ("event", "data", '{"of":[{"hours":1e308}]}', "data.of[...].hours"),
]
#: The largest that a recording may hold: there is a result, and soon.
LARGEST = [
    ("sample", "time_utc_ns", str(TIME_MAX_NS)),
    ("sample", "mean", f"{NUMBER_MAX:.1f}"),
    ("sample", "seq", str(SEQ_MAX)),
    ("sample", "count", str(2**63 - 1)),
    ("estimate", "y_pred_um", f"{-NUMBER_MAX:.1f}"),
    ("offset", "time_utc_ns", str(TIME_MAX_NS)),
    ("offset", "time_utc_ns", "0"),
    ("offset", "y_offset_um", "-5000.0"),
]


def changed(topic: str, key: str, value: str, which: int = -3) -> Callable[[list[Line]], list[Line]]:
    """Return an edit: the first value of a key in one message of a topic."""

    def edit(lines: list[Line]) -> list[Line]:
        at = find(lines, topic, which)
        old = re.compile(rb'("%s":)(?:-?[\d.]+(?:e-?\d+)?|\{\})' % key.encode())
        data, count = old.subn(rb"\g<1>" + value.encode(), lines[at].data, count=1)
        assert count == 1, lines[at].data
        return [*lines[:at], replace(lines[at], data=data), *lines[at + 1 :]]

    return edit


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of some minutes."""
    folder = tmp_path_factory.mktemp("originals")
    Service(folder).run(20).stop()
    Service(folder, seq=20).run(20).stop()
    return folder


def report(path: Path) -> None:
    write(path.parent / "page.html", page_of(read_history([path])))


def exported(path: Path) -> None:
    export(path, path.parent / "table.csv")


def compared(path: Path) -> None:
    compare([path], load_model("quill"))


def measured(path: Path) -> None:
    read_recordings([path], {})


READERS = (report, exported, compared, measured)


@pytest.mark.parametrize(("topic", "key", "value", "place"), IMPOSSIBLE)
def test_what_no_recording_holds_is_refused_with_its_place(
    originals: Path, tmp_path: Path, topic: str, key: str, value: str, place: str
) -> None:
    shutil.copytree(originals, tmp_path / "rec")
    paths = recordings(tmp_path / "rec", MACHINE)
    rechained(paths[1], changed(topic, key, value, -1 if topic == "event" else -3), finished=True)
    for read in READERS:
        # What a reader does not read at all it cannot refuse.
        if (read, topic) in {(measured, "estimate"), (measured, "offset"), (measured, "event"), (exported, "event")}:
            continue
        with pytest.raises(DataError) as error:
            read(paths[1])
        said = str(error.value)
        assert paths[1].name in said and f"/{topic} record " in said and place in said, (read, said)
        assert "\n" not in said and len(said) < 400
    found = audit(paths)
    assert not found.clean and found.files[0].samples == 20 and not found.files[0].findings_count
    at = found.files[1]
    told = [finding.line() for finding in found.findings if f"/{topic} record " in finding.line()]
    # The audit compares estimates and offsets byte by byte, and shows the field that differs.
    assert told or (at.difference is not None and at.difference.topic == topic)


@pytest.mark.parametrize(("topic", "key", "value"), LARGEST)
def test_the_largest_numbers_give_a_result_soon(
    originals: Path, tmp_path: Path, topic: str, key: str, value: str
) -> None:
    shutil.copytree(originals, tmp_path / "rec")
    paths = recordings(tmp_path / "rec", MACHINE)
    rechained(paths[1], changed(topic, key, value), finished=True)
    for read in READERS:
        read(paths[1])
    assert audit(paths).samples == 40
