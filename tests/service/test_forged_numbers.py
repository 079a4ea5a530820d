"""Recordings whose numbers somebody has set who can write their folder: the service starts with a number of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from compensator.clock import NS
from compensator.messages import SEQ_MAX, TIME_MAX_NS
from compensator.receiver.message import SEQ_MAX as RECEIVED_SEQ_MAX
from compensator.receiver.message import TIME_MAX_NS as RECEIVED_TIME_MAX_NS
from compensator.recording.numbering import first_sequence, last_sequence
from compensator.recording.reading import recordings
from tests.audit.attacks import rechained
from tests.audit.made import MACHINE, MINUTE_NS
from tests.audit.tampering import Line
from tests.audit.test_bounds import DIGITS, changed
from tests.audit.test_heads import Shop, remarks_of
from tests.service.living import Machine, largest_step
from tests.service.simulated import START_NS

#: Periods of a minute from 2020 to the start of the recordings.
PERIODS = (START_NS - 1_577_836_800 * NS) // MINUTE_NS


def renumbered(lines: list[Line], seq: int, of: int) -> list[Line]:
    """Give all messages of one sample another number."""
    old, new = f'"seq":{of},'.encode(), f'"seq":{seq},'.encode()
    return [replace(line, data=line.data.replace(old, new, 1)) for line in lines]


def test_the_receiver_has_the_same_bounds() -> None:
    assert (SEQ_MAX, TIME_MAX_NS) == (RECEIVED_SEQ_MAX, RECEIVED_TIME_MAX_NS)


@pytest.mark.parametrize(
    ("topic", "key", "value"),
    [
        ("sample", "time_utc_ns", DIGITS),
        ("sample", "seq", DIGITS),
        ("sample", "seq", str(2**63 - 2)),
        ("sample", "mean", "1e308"),
        ("offset", "time_utc_ns", str(-(2**63))),
        ("offset", "seq", str(2**63 - 2)),
        ("offset", "y_offset_um", "1e9"),
        ("event", "data", '{"missing":' + DIGITS + "}"),
    ],
)
@pytest.mark.parametrize("how", ["again", "another configuration"])
async def test_the_service_starts_and_says_which_record_it_cannot_use(
    tmp_path: Path, how: str, topic: str, key: str, value: str
) -> None:
    machine = Machine(tmp_path)
    await machine.run_and_kill(20)
    path = recordings(machine.recordings, MACHINE)[-1]
    rechained(path, changed(topic, key, value, 0 if topic == "event" else -1))
    if how == "another configuration":
        machine.config_bytes = b"another one"
    before = machine.outcomes[-1].sample.seq
    await machine.run(3)
    told = [event.text for event in machine.events("restart") if "a recording " in event.text]
    assert len(told) == 1 and path.name in told[0] and f"/{topic} record" in told[0] and "\n" not in told[0]
    if topic != "event":
        # What came before the record counts: the offset goes on from the last but one that was published.
        assert "is used up to a record that cannot be" in told[0]
        assert largest_step(machine.outcomes[19:21]) <= 2 * 8.0
        assert not any("cannot be restored" in event.text for event in machine.events("restart"))
    numbers = [outcome.sample.seq for outcome in machine.outcomes[20:]]
    assert numbers == [before + 1, before + 2, before + 3]
    # And at the start after it, over the file that was made now.
    await machine.run(3)
    assert [outcome.sample.seq for outcome in machine.outcomes[23:]] == [before + 4, before + 5, before + 6]
    assert largest_step(machine.outcomes[20:]) <= 8.0 + 1e-9


@pytest.mark.parametrize("seq", [SEQ_MAX, SEQ_MAX // 2, 10**10])
def test_a_number_that_no_machine_has_by_now_is_not_taken(tmp_path: Path, seq: int) -> None:
    """Else receivers would soon refuse every number, and no lower one brings them back while it counts on."""
    shop = Shop(tmp_path, headless=True)
    shop.start(PERIODS).run(5).kill()
    now_ns = START_NS + 10 * MINUTE_NS
    rechained(shop.files[-1], lambda lines: renumbered(lines, seq, PERIODS + 4))
    told: list[str] = []
    first = first_sequence(shop.rec, MACHINE, now_ns, 60.0, remark=lambda file, text: told.append(f"{file}: {text}"))
    assert first == PERIODS + 10
    assert len(told) == 1 and shop.files[-1].name in told[0] and str(seq) in told[0]
    # A clock that was never set knows less, but not nothing.
    assert first_sequence(shop.rec, MACHINE, 0, 60.0) == PERIODS + 4
    service = shop.start(first)
    assert service.recorder.first_sequence(now_ns, 60.0) == first
    assert "not_as_written" in remarks_of(service)


def test_a_number_ahead_of_the_clock_is_taken_from_an_honest_recording(tmp_path: Path) -> None:
    """The clock was a month ahead, or the model had a shorter period."""
    shop = Shop(tmp_path)
    for ahead in (43_200, 6 * PERIODS):
        shop.start(PERIODS + ahead).run(3).kill()
        service = shop.start(0)
        assert service.recorder.first_sequence(START_NS, 60.0) == PERIODS + ahead + 3
        assert first_sequence(shop.rec, MACHINE, START_NS, 60.0) == PERIODS + ahead + 3
        assert remarks_of(service) == []


@pytest.mark.parametrize("seq", [PERIODS + 1000, 10**9])
def test_a_number_behind_the_head_is_not_taken(tmp_path: Path, seq: int) -> None:
    """It is possible by itself; only the head tells that nobody wrote it."""
    shop = Shop(tmp_path)
    shop.start(PERIODS).run(30).kill()
    rechained(shop.files[-1], lambda lines: [*lines[:-4], *renumbered(lines[-4:], seq, PERIODS + 29)])
    assert first_sequence(shop.rec, MACHINE, START_NS, 60.0) == seq + 1
    # The group before is what the head states as written.
    assert shop.start().recorder.first_sequence(START_NS, 60.0) == PERIODS + 29


@pytest.mark.parametrize("set_back_min", [0, 10, 600])
def test_a_service_whose_head_could_not_be_written_has_published_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, set_back_min: int
) -> None:
    shop, ahead = Shop(tmp_path), 2 * PERIODS
    service = shop.start(ahead)
    service.start_ns = START_NS - ahead * MINUTE_NS  # the numbers are ahead, the clock is right
    service.run(5)
    with monkeypatch.context() as patched:
        patched.setattr("compensator.recording.head.replace_file", Mock(side_effect=OSError(30, "read-only")))
        service.run(30)
        service.recorder.start_new()
        service.run(20).kill()
    later_ns = START_NS + (56 - set_back_min) * MINUTE_NS
    assert shop.start().recorder.first_sequence(later_ns, 60.0) == ahead + 55
    # A number ahead of the time and of the samples since then is none of its numbers.
    rechained(shop.files[-1], lambda lines: [*lines[:-4], *renumbered(lines[-4:], ahead + 1000, ahead + 54)])
    assert shop.start().recorder.first_sequence(later_ns, 60.0) == ahead + 54


@pytest.mark.parametrize("way", ["newest rewritten", "newest removed", "newer added", "all rewritten"])
def test_only_the_chain_of_the_head_counts(tmp_path: Path, way: str) -> None:
    shop = Shop(tmp_path)
    shop.start(PERIODS).run(5).stop()
    shop.start(PERIODS + 5).run(5).kill()
    old, new = shop.files

    def forged(lines: list[Line]) -> list[Line]:
        return renumbered(lines, 10**9, PERIODS + 1)

    honest = shop.start().recorder._keeper
    assert honest is not None and last_sequence(shop.rec, MACHINE, keeper=honest) == PERIODS + 9
    if way == "newest rewritten":
        rechained(new, lambda lines: renumbered(lines, 10**9, PERIODS + 6))
    elif way == "newest removed":
        new.unlink()
        rechained(old, forged)
    elif way == "newer added":
        copy = new.with_name(f"{MACHINE}_20260105T235959Z.mcap")
        copy.write_bytes(old.read_bytes())
        rechained(copy, forged)
    else:
        rechained(old, forged)
        rechained(new, lambda lines: renumbered(lines, 10**9, PERIODS + 6))
    expected = PERIODS + 9 if way == "newer added" else -1
    if way == "newest rewritten":
        # Of the older file the head of an earlier run still knows the end.
        expected = PERIODS + 4
    assert last_sequence(shop.rec, MACHINE, keeper=honest) == expected
    assert shop.start().recorder.first_sequence(START_NS + 10 * MINUTE_NS, 60.0) == PERIODS + 10


def test_without_a_sample_in_the_newest_file_the_chain_leads_to_the_one_before(tmp_path: Path) -> None:
    shop = Shop(tmp_path)
    shop.start(2 * PERIODS).run(5).stop()
    shop.start(2 * PERIODS + 5).stop()  # its events only
    service = shop.start()
    assert service.recorder._keeper is not None
    service.recorder._keeper.ends = service.recorder._keeper.ends[-1:]
    assert len(shop.files) == 2
    assert service.recorder.first_sequence(START_NS, 60.0) == 2 * PERIODS + 5
    rechained(shop.files[0], lambda lines: renumbered(lines, 10**9, 2 * PERIODS + 1))
    assert service.recorder.first_sequence(START_NS, 60.0) == PERIODS
