"""The shop's recording has what arrived, unaltered, whatever ends it."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from mcap.reader import make_reader

from compensator.cli import main
from compensator.clock import NS
from compensator.errors import DataError
from compensator.recording import live_file
from compensator.recording.compaction import rewrite
from compensator.watch import shop_recorder
from compensator.watch.shop_recorder import ShopRecorder
from tests.watch.heard import START_NS, Clock, estimate, event, offset, sample, status

KEY = "shop/vmc-07/thermal/"


def read(path: Path, *, all_of_it: bool = False) -> list[tuple[str, str, int, int, int, bytes]]:
    with path.open("rb") as file:
        return [
            (
                channel.topic,
                schema.name if schema else "",
                message.sequence,
                message.log_time,
                message.publish_time,
                message.data,
            )
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
            if all_of_it or channel.topic != "/summary"
        ]


def recordings(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


def test_everything_is_there_as_it_came(tmp_path: Path) -> None:
    clock = Clock()
    with ShopRecorder(tmp_path, "shop", clock) as recorder:
        sent = [
            (f"shop/{name}/thermal/{rest}", payload)
            for name in ("vmc-07", "vmc-08")
            for rest, payload in (
                ("y/offset", offset(5)),
                ("sample", sample(5)),
                ("estimate", estimate(5)),
                ("status", status(5)),
                ("event", event(5)),
                ("y/offset", b"nonsense"),
                ("strange", b"\xff"),
            )
        ]
        for key, payload in sent:
            clock.advance(1)
            recorder.receive(key, payload)
        recorder.receive(KEY + "y/offset", offset(4), asked=True)
        recorder.set_alive(KEY + "alive", False)
    (path,) = recordings(tmp_path)
    found = read(path)
    known = [one for one in found if not one[0].startswith("/other/") and not one[0].endswith("alive")]
    assert [(one[0], one[5]) for one in known] == [
        ("/" + key, payload) for key, payload in sent if payload not in (b"nonsense", b"\xff")
    ]
    assert [one[5] for one in found if one[0].startswith("/other/")] == [b"nonsense", b"\xff"] * 2
    assert json.loads(found[-1][5]) == {"alive": False}
    first = found[0]
    assert first[1:5] == ("Offset", 5, START_NS + NS, START_NS)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and len(summary.chunk_indexes) == 1
    assert {c.metadata["machine"] for c in summary.channels.values() if c.topic != "/summary"} == {
        "shop/vmc-07",
        "shop/vmc-08",
    }
    assert {s.encoding for s in summary.schemas.values()} == {"jsonschema"}


def test_what_never_arrived_is_counted_and_a_restart_is_not(tmp_path: Path) -> None:
    with ShopRecorder(tmp_path, "shop", Clock()) as recorder:
        for number in (5, 6, 9):
            recorder.receive(KEY + "y/offset", offset(number, START_NS + number * NS))
            recorder.receive(KEY + "sample", sample(number, START_NS + number * NS))
        recorder.receive(KEY + "sample", sample(10, START_NS + 10 * NS))
        other = "shop/vmc-08/thermal/y/offset"
        for number in (100, 200):
            recorder.receive(other, offset(number, START_NS + number * NS))
        recorder.receive("shop/vmc-08/thermal/status", status(200, started_ns=START_NS + 150 * NS))
    result, text = recorder.answer()
    assert result["missed"] == {KEY + "sample": 2, KEY + "y/offset": 2}
    assert "2 of shop/vmc-07/thermal/y/offset" in text
    topic, _, _, _, _, summary = read(recordings(tmp_path)[0], all_of_it=True)[-1]
    assert topic == "/summary" and json.loads(summary) == {name: result[name] for name in json.loads(summary)}


def test_machines_beyond_the_bound_are_recorded_and_their_losses_not_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shop_recorder, "MACHINES", 2)
    keys = [f"shop/n{i}/thermal/sample" for i in range(4)]
    with ShopRecorder(tmp_path, "shop", Clock()) as recorder:
        for number in (5, 7):
            for key in keys:
                recorder.receive(key, sample(number))
    assert recorder.missed() == dict.fromkeys(keys[:2], 1) and len(recorder._numbers) == 2
    assert "losses not counted beyond 2 machines: 4 messages" in recorder.answer()[1]
    assert len(read(recordings(tmp_path)[0])) == 8


def test_each_day_has_its_file(tmp_path: Path) -> None:
    clock = Clock()
    with ShopRecorder(tmp_path, "shop", clock) as recorder:
        for number in range(4):
            recorder.receive(KEY + "y/offset", offset(number))
            clock.advance(12 * 3600)
    assert [path.name for path in recordings(tmp_path)] == ["shop_20260105T060000Z.mcap", "shop_20260106T060000Z.mcap"]
    assert [[one[2] for one in read(path)] for path in recordings(tmp_path)] == [[0, 1], [2, 3]]


def test_a_full_file_is_followed_by_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_file, "FULL", 50_000)
    monkeypatch.setattr(shop_recorder, "PART", 10)
    with ShopRecorder(tmp_path, "shop", Clock()) as recorder:
        for number in range(200):
            recorder.receive(KEY + "y/offset", offset(number))
    assert len(recorder.files) > 1
    assert [one[2] for path in recorder.files for one in read(path)] == list(range(200))


KILLED = """
import os, sys, time
from compensator.clock import SystemClock
from compensator.watch import shop_recorder
from tests.watch.heard import offset
recorder = shop_recorder.ShopRecorder(__import__("pathlib").Path(sys.argv[1]), "shop", SystemClock())
with recorder:
    for number in range(100):
        recorder.receive("shop/vmc-07/thermal/y/offset", offset(number))
    while recorder.messages < 100:
        time.sleep(0.005)
    os.kill(os.getpid(), 9)
"""


def test_a_kill_loses_nothing_that_was_synced_and_the_next_start_finishes_the_file(tmp_path: Path) -> None:
    folder = tmp_path / "shop"
    done = subprocess.run([sys.executable, "-c", KILLED, str(folder)], cwd=Path(__file__).parents[2], check=False)
    assert done.returncode == -9
    (path,) = recordings(folder)
    with path.open("ab") as file:
        file.write(b"\x05" + (400).to_bytes(8, "little") + bytes(100))  # and a part of a record more
    with ShopRecorder(folder, "shop", Clock()):
        pass
    assert [one[2] for one in read(path)] == list(range(100))
    assert [one.name for one in folder.iterdir()] == [path.name]
    assert rewrite(path) is None


def test_a_disk_that_fails_for_a_while_costs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failing, sync = [True], os.fsync

    def fsync(descriptor: int) -> None:
        if failing[0]:
            failing[0] = False
            raise OSError(28, "No space left on device")
        sync(descriptor)

    monkeypatch.setattr(live_file.os, "fsync", fsync)
    monkeypatch.setattr(shop_recorder, "SYNC_S", 0.02)
    with ShopRecorder(tmp_path, "shop", Clock()) as recorder:
        recorder.receive(KEY + "y/offset", offset(1))
        while failing[0]:
            pass
        recorder.receive(KEY + "y/offset", offset(2))
    assert [one[2] for path in recordings(tmp_path) for one in read(path)] == [1, 2]
    assert recorder.not_recorded == 0 and recorder.messages == 2


@pytest.mark.parametrize(("limit", "most"), [("WAITING", 3), ("WAITING_BYTES", 3 * len(offset(0)))])
def test_what_does_not_fit_into_memory_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int
) -> None:
    monkeypatch.setattr(shop_recorder, limit, most)
    recorder = ShopRecorder(tmp_path, "shop", Clock())
    for number in range(5):
        recorder.receive(KEY + "y/offset", offset(number))
    with recorder:
        pass
    assert recorder.not_recorded == 2 and [one[2] for one in read(recordings(tmp_path)[0])] == [2, 3, 4]
    assert recorder.answer()[0]["not_recorded"] == 2


@pytest.mark.parametrize(("limit", "most"), [("WAITING", 3), ("WAITING_BYTES", 3 * len(offset(0)))])
def test_what_a_full_disk_gives_back_does_not_exceed_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int
) -> None:
    monkeypatch.setattr(shop_recorder, limit, most)
    recorder = ShopRecorder(tmp_path, "shop", Clock())
    with monkeypatch.context() as full:
        full.setattr(shop_recorder._File, "sync", Mock(side_effect=OSError(28, "No space left on device")))
        for number in range(5):
            recorder.receive(KEY + "y/offset", offset(number))
            assert not recorder._write_waiting()
    with recorder:
        pass
    assert recorder.not_recorded == 2 and [one[2] for one in read(recordings(tmp_path)[0])] == [2, 3, 4]
    assert recorder.files == recordings(tmp_path)  # those that were given up are not there


def test_damage_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    with ShopRecorder(tmp_path, "shop", Clock()) as recorder:
        recorder.receive(KEY + "y/offset", offset(1))
    path = recordings(tmp_path)[0]
    data = bytearray(path.read_bytes())
    counted: Counter[Any] = Counter()
    for place in range(0, len(data), 97):
        broken = bytearray(data)
        broken[place] ^= 1
        path.write_bytes(broken)
        try:
            rewrite(path)
        except DataError as error:
            counted[type(error).__name__] += 1
        assert path.read_bytes() == broken
    assert counted


def test_one_machine_of_a_shop_becomes_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with ShopRecorder(tmp_path, "shop", Clock()) as recorder:
        for number in range(3):
            time_ns = START_NS + number * 60 * NS
            for name, t_q in (("vmc-07", 31.5), ("vmc-08", 40.0)):
                recorder.receive(f"shop/{name}/thermal/y/offset", offset(number, time_ns))
                recorder.receive(f"shop/{name}/thermal/sample", sample(number, time_ns, t_q=t_q))
                recorder.receive(f"shop/{name}/thermal/estimate", estimate(number, time_ns))
    path, out = recordings(tmp_path)[0], tmp_path / "out.csv"
    assert main(["export", str(path), "--machine", "shop/vmc-08", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.read_text(encoding="utf-8").splitlines()))
    assert [row["t_q_degc"] for row in rows] == ["40.0"] * 3 and rows[0]["y_offset_um"] == "-12.34"
    for machine in ("", "shop/vmc-09"):
        assert main(["export", str(path), "--machine", machine, "--out", str(out)]) == 2
        assert "expected --machine, one of: shop/vmc-07, shop/vmc-08" in capsys.readouterr().err
