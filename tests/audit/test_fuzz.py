"""Whatever bytes a recording has: a verdict or one line, no traceback, no hang, and no changed byte unseen."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from compensator.audit.machine_audit import Audit, audit
from compensator.errors import CompensatorError, DataError
from compensator.recording.container import MAGIC, Container
from compensator.recording.finishing import compact
from compensator.recording.reading import last_value, read_messages
from tests.audit.made import Service
from tests.audit.tampering import rewrite

FUZZ = settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The same six samples: compact, finished without chunks, and live."""
    folder = tmp_path_factory.mktemp("fuzz")
    service = Service(folder).run(6)
    path = service.recorder.path
    assert path is not None
    live = path.read_bytes()
    service.stop()
    compacted = path.read_bytes()
    rewrite(path, chunked=False)
    return {"live": live, "compact": compacted, "finished": path.read_bytes()}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("place") / "vmc-07_20260105T060000Z.mcap"


def verdict(path: Path, data: bytes) -> Audit | None:
    """Audit bytes; None where they are refused in one line."""
    path.write_bytes(data)
    try:
        found = audit([path])
    except CompensatorError as error:
        assert "\n" not in str(error) and error.exit_code == 2
        return None
    for finding in found.findings:
        assert "\n" not in finding.line()
    return found


@FUZZ
@given(data=st.binary(max_size=3000), magic=st.booleans())
def test_random_bytes(place: Path, data: bytes, magic: bool) -> None:
    data = (MAGIC if magic else b"") + data
    found = verdict(place, data)
    assert found is None or (not found.samples and not found.clean)
    begins = MAGIC.startswith(data[: len(MAGIC)])
    # It has the name of a recording: that it is none is a finding with its place.
    assert begins or (found is not None and "byte 0" in found.findings[0].line())
    with _nothing() if begins else pytest.raises(DataError):
        list(read_messages(place))


def _nothing() -> object:
    from contextlib import nullcontext

    return nullcontext()


@FUZZ
@given(code=st.integers(0, 255), length=st.sampled_from([0, 1, 21, 22, 2**16, 2**26, 2**31, 2**40, 2**63, 2**64 - 1]))
def test_records_of_any_kind_and_length(files: dict[str, bytes], place: Path, code: int, length: int) -> None:
    live = files["live"]
    found = verdict(place, live + struct.pack("<BQ", code, length) + b"x" * 50)
    assert found is not None and found.samples == 6
    if length <= 22 or code == 0 or code > 15 or length > 2**26:
        assert not found.clean
    verdict(place, MAGIC + struct.pack("<BQ", code, length) + b"x" * 50)


@pytest.mark.parametrize("kind", ["compact", "finished"])
@FUZZ
@given(seed=st.integers(0, 2**32))
def test_no_changed_byte_of_a_finished_file_is_unseen(
    files: dict[str, bytes], place: Path, kind: str, seed: int
) -> None:
    rng = random.Random(seed)
    data = bytearray(files[kind])
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    found = verdict(place, bytes(data))
    assert found is None or not found.clean


@FUZZ
@given(seed=st.integers(0, 2**32))
def test_no_changed_byte_of_a_live_file_is_unseen(files: dict[str, bytes], place: Path, seed: int) -> None:
    rng = random.Random(seed)
    data = bytearray(files["live"])
    # In front of the first channel stands the name of the library, which says nothing about the machine.
    first = len(MAGIC) + 9 + data[9]
    at = rng.randrange(first, len(data))
    data[at] ^= 1 << rng.randrange(8)
    found = verdict(place, bytes(data))
    assert found is None or not found.clean


@FUZZ
@given(seed=st.integers(0, 2**32), kind=st.sampled_from(["live", "compact", "finished"]))
def test_wild_changes_give_a_verdict_and_recovery_never_fails_badly(
    files: dict[str, bytes], place: Path, seed: int, kind: str
) -> None:
    rng = random.Random(seed)
    data = bytearray(files[kind])
    for _ in range(rng.randrange(1, 5)):
        at = rng.randrange(len(data))
        what = rng.randrange(4)
        if what == 0:
            del data[at : at + rng.randrange(1, 2000)]
        elif what == 1:
            data[at:at] = rng.randbytes(rng.randrange(1, 200))
        elif what == 2:
            data[at : at + 8] = struct.pack("<Q", rng.choice([0, 2**20, 2**32, 2**63]))
        else:
            begin = rng.randrange(len(data))
            data[at:at] = data[begin : begin + rng.randrange(1, 500)]
    original = bytes(data)
    verdict(place, original)
    try:
        last_value(place)
        list(read_messages(place))
        compact(place)
    except DataError:
        assert place.read_bytes() == original
    else:
        verdict(place, place.read_bytes())
    assert list(place.parent.iterdir()) == [place]


def test_a_chunk_that_claims_to_be_huge_is_not_unpacked(files: dict[str, bytes], place: Path) -> None:
    data = bytearray(files["compact"])
    at = data.index(b"zstd") - 4 - 12  # the size that it is said to have uncompressed
    for size in (2**40, 2**63, 10):
        changed = bytearray(data)
        changed[at : at + 8] = struct.pack("<Q", size)
        place.write_bytes(changed)
        with Container(place) as container, pytest.raises(DataError, match="chunk"):
            list(container.messages())
