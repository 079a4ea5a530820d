"""What is shown of a machine is what it is: never an old value as new, never silence as ok."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.clock import NS
from compensator.messages import Candidate, EstimateMessage, Event, Offset, Sample, Status
from compensator.messages_axes import AxesEstimate
from compensator.model.model_file import EFFECTS
from compensator.receiver import Rejected, parse_offset
from compensator.watch import past
from compensator.watch.history import MachineHistory, state_intervals
from compensator.watch.machine import Malformed, WatchedMachine, decoded
from compensator.watch.shop import Shop
from tests.watch.heard import LOOP, START_NS, Clock, axis_offset, estimate, event, offset, sample, status

KEY = "shop/vmc-07/thermal/"


class Heard:
    def __init__(self) -> None:
        self.clock = Clock()
        self.shop = Shop(self.clock)

    def hear(self, **messages: bytes) -> None:
        for kind, payload in messages.items():
            self.shop.receive(KEY + ("y/offset" if kind == "offset" else kind), payload)

    @property
    def machine(self) -> dict[str, Any]:
        found = self.shop.one("shop/vmc-07")
        assert found is not None
        return found


@pytest.fixture
def heard() -> Heard:
    return Heard()


def test_a_machine_that_is_well(heard: Heard) -> None:
    heard.hear(offset=offset(5), sample=sample(5), estimate=estimate(5), status=status(5))
    heard.shop.set_alive(KEY + "alive", True)
    heard.clock.advance(30)
    machine = heard.machine
    assert (machine["machine"], machine["shown"], machine["tone"], machine["alive"]) == ("vmc-07", "ok", "good", True)
    assert (machine["y_offset_um"], machine["residual_um"], machine["t_q_degc"], machine["age_s"]) == (
        -12.34,
        -0.34,
        31.5,
        30,
    )
    assert {share["name"]: share["y_um"] for share in machine["shares"]} == {"DTF": 10.0, "TDTF": 0.84, "gain DTF": 1.5}
    assert machine["warnings"] == []
    json.dumps(machine, allow_nan=False)


def test_what_is_silent_is_never_shown_as_ok(heard: Heard) -> None:
    heard.hear(offset=offset(5), sample=sample(5), estimate=estimate(5))
    heard.clock.advance(150)
    assert heard.machine["shown"] == "ok"
    heard.clock.advance(1)
    machine = heard.machine
    assert (machine["shown"], machine["tone"], machine["state"]) == ("silent", "bad", "ok")
    # The last offset stands with its age; nothing that was measured then looks as if it were of now.
    assert machine["y_offset_um"] == -12.34 and machine["age_s"] == 151
    assert machine["t_q_degc"] is machine["residual_um"] is machine["y_offset_rate_um_per_min"] is None
    assert machine["shares"] == [] and machine["channels"] == {}


def test_values_of_an_older_sample_do_not_stand_beside_a_new_offset(heard: Heard) -> None:
    heard.hear(offset=offset(5), sample=sample(5), estimate=estimate(5))
    for i in range(1, 4):
        heard.clock.advance(60)
        heard.hear(offset=offset(5 + i, START_NS + 60 * i * NS))
    assert heard.machine["shown"] == "ok"
    assert heard.machine["t_q_degc"] is None and heard.machine["residual_um"] is None


def test_a_wall_clock_that_stands_does_not_keep_a_machine_alive(heard: Heard) -> None:
    heard.hear(offset=offset(5))
    heard.clock.monotonic += 151 * NS  # the wall clock was set back meanwhile
    assert heard.machine["shown"] == "silent"


def test_values_of_a_service_whose_clock_is_ahead_expire_like_its_offset(heard: Heard) -> None:
    t = START_NS + 3600 * NS
    wanted = status(5, t, loop=LOOP, **(WANTED | {"probe_wanted": True}))
    heard.hear(offset=offset(5, t), sample=sample(5, t), estimate=estimate(5, t), status=wanted)
    heard.clock.advance(150)
    machine = heard.machine
    assert (machine["shown"], machine["t_q_degc"], machine["y_um"]) == ("ok", 31.5, 12.0)
    assert machine["probe"]["wanted"] and "loop" in machine
    heard.clock.advance(1)
    machine = heard.machine
    assert machine["shown"] == "silent" and machine["channels"] == {} and machine["shares"] == []
    assert machine["t_q_degc"] is machine["y_um"] is machine["residual_um"] is machine["probe"] is None
    assert "loop" not in machine


def test_an_old_offset_that_arrives_now_is_silent_and_the_clocks_are_doubted(heard: Heard) -> None:
    heard.hear(offset=offset(5, START_NS - 600 * NS))
    assert heard.machine["shown"] == "silent"
    assert any("clocks is wrong" in text for text in heard.machine["warnings"])
    assert heard.machine["warning_codes"] == ["old_messages"]


def test_a_missing_channel_is_missing(heard: Heard) -> None:
    heard.hear(
        offset=offset(5, state="degraded", reasons=["t_q_missing", "outside_validity:heat_w"]),
        sample=sample(5, t_q=31.5, quality="open_circuit"),
    )
    machine = heard.machine
    assert machine["t_q_degc"] is None and machine["channels"]["t_q_degc"]["quality"] == "open_circuit"
    assert [reason["code"] for reason in machine["reasons"]] == ["t_q_missing", "outside_validity:heat_w"]
    assert all(reason["means"] and reason["do"] for reason in machine["reasons"])
    assert heard.shop.history("shop/vmc-07")["t_q_degc"] == [None]


def test_a_reason_that_nobody_knows_is_said_to_be_unknown(heard: Heard) -> None:
    heard.hear(offset=offset(5, state="degraded", reasons=["flux_capacitor"]))
    assert "Unknown code" in heard.machine["reasons"][0]["means"]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"nonsense",
        b"[]",
        b"\xff\xfe",
        offset(6, schema=2),
        offset(6, seq=-1),
        offset(6, y_offset_um="3"),
        offset(6, state="splendid"),
        offset(6, time_utc_ns=2**70),
        b'{"schema": 1}',
        b"[" * 100_000,
        b" " * (2**20 + 1),
        offset(6).replace(b"-12.34", b"1e999"),
        offset(6).replace(b"-12.34", b"NaN"),
    ],
)
def test_malformed_messages_are_counted_and_change_nothing(heard: Heard, payload: bytes) -> None:
    heard.hear(offset=offset(5))
    before = heard.machine
    heard.hear(offset=payload)
    after = heard.machine
    assert after["malformed"] == 1 and after["last_malformed"].startswith("offset:") and after["tone"] == "warn"
    changed = {name for name in before if before[name] != after[name]}
    assert changed == {"malformed", "last_malformed", "warnings", "warning_codes", "to_do", "tone", "headline"}
    assert after["to_do"].startswith("1 malformed") and after["to_do"].endswith(
        "which programs publish below the prefix."
    )


@pytest.mark.parametrize(
    "message",
    [{"estimate": estimate(6, effects=(1.5,) * (EFFECTS + 1))}, {"offset": offset(6, reasons=["cold_start"] * 200)}],
)
def test_more_than_any_service_has_is_no_message(heard: Heard, message: dict[str, bytes]) -> None:
    heard.hear(offset=offset(5), estimate=estimate(5, effects=(1.5,) * EFFECTS))
    heard.hear(**message)
    assert (heard.machine["malformed"], heard.machine["seq"], len(heard.machine["shares"])) == (1, 5, EFFECTS + 2)


def test_the_watch_takes_as_many_reasons_as_a_receiver() -> None:
    """A device with a hundred channels that fails gives a reason for each of them."""
    reasons = [f"channel_missing:c{i}" for i in range(151)]
    most, more = (offset(5, state="degraded", reasons=reasons[:count]) for count in (150, 151))
    assert decoded("offset", most).reasons == list(parse_offset(most).reasons) == reasons[:150]
    with pytest.raises(Malformed, match="at most 150"):
        decoded("offset", more)
    with pytest.raises(Rejected, match="at most 150"):
        parse_offset(more)


def test_what_strangers_publish_is_not_kept_for_a_day(heard: Heard) -> None:
    """Memory of a machine is bounded by its number of points and events, not by the length of a message."""
    tracemalloc.start()
    for i in range(60):
        t = START_NS - i * 60 * NS
        heard.hear(
            offset=offset(i, t, reasons=["x" * 400_000]), event=event(i, t, "x" * 9_000, "y" * 9_000, z="z" * 9**6)
        )
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert kept < 3_000_000 and len(heard.machine["events"]) == 50
    assert len(heard.shop.history("shop/vmc-07")["reasons"][0]) == 2000


def test_what_is_repeated_or_late_changes_nothing_and_is_counted(heard: Heard) -> None:
    heard.hear(offset=offset(5), sample=sample(5), estimate=estimate(5))
    heard.hear(offset=offset(4, y_offset_um=99.0), sample=sample(4, t_q=99.0), estimate=estimate(4, residual_um=99.0))
    machine = heard.machine
    assert (machine["y_offset_um"], machine["t_q_degc"], machine["residual_um"]) == (-12.34, 31.5, -0.34)
    assert machine["repeated"] == 1
    assert 99.0 not in heard.shop.history("shop/vmc-07")["y_offset_um"]


def test_a_service_that_counts_anew_is_shown_once_the_newest_offset_has_expired(heard: Heard) -> None:
    high = 10**11
    heard.hear(offset=offset(high), sample=sample(high, t_q=50.0), estimate=estimate(high), status=status(high))
    for number in (5, 6, 7):
        heard.clock.advance(60)
        heard.hear(offset=offset(number, heard.clock.now_ns, state="hold"))
        if number == 6:
            assert (heard.machine["shown"], heard.machine["seq"], heard.machine["repeated"]) == ("ok", high, 2)
    now_ns = heard.clock.now_ns
    heard.hear(sample=sample(7, now_ns), estimate=estimate(7, now_ns, y_um=1.0), status=status(7, now_ns, model="new"))
    machine = heard.machine
    assert (machine["shown"], machine["seq"], machine["t_q_degc"], machine["y_um"], machine["model"]) == (
        "hold",
        7,
        31.5,
        1.0,
        "new",
    )
    assert (machine["missed"], machine["repeated"]) == (0, 0)


def test_a_number_ahead_of_the_offsets_keeps_no_later_message_out(heard: Heard) -> None:
    heard.hear(offset=offset(5), sample=sample(10**11, t_q=50.0), status=status(10**11, model="forged"))
    heard.hear(sample=sample(5), status=status(5))
    assert (heard.machine["t_q_degc"], heard.machine["model"]) == (31.5, "quill")


@pytest.mark.parametrize("valid_for_s", [1e30, 10_001.0, 0.0, -1.0])
def test_an_offset_that_never_expires_is_none(heard: Heard, valid_for_s: float) -> None:
    heard.hear(offset=offset(5, valid_for_s=valid_for_s))
    assert (heard.machine["shown"], heard.machine["malformed"]) == ("unknown", 1)


def test_answers_to_a_question_are_nothing_repeated_or_missed(heard: Heard) -> None:
    heard.shop.receive(KEY + "y/offset", offset(5), asked=True)
    heard.hear(offset=offset(8))
    heard.shop.receive(KEY + "y/offset", offset(7), asked=True)
    assert (heard.machine["seq"], heard.machine["missed"], heard.machine["repeated"]) == (8, 0, 0)


def test_what_was_lost_is_told_from_a_restart(heard: Heard) -> None:
    heard.hear(offset=offset(5), status=status(5))
    heard.hear(offset=offset(8), status=status(8))
    assert heard.machine["missed"] == 2
    heard.hear(offset=offset(20, START_NS + 720 * NS))
    assert heard.machine["missed"] == 13
    heard.hear(status=status(20, started_ns=START_NS + 660 * NS))
    assert heard.machine["missed"] == 2
    assert any("2 message(s) did not arrive" in text for text in heard.machine["warnings"])


def test_two_services_below_one_prefix_are_told(heard: Heard) -> None:
    heard.hear(offset=offset(5))
    heard.hear(offset=offset(3, machine="vmc-08"))
    assert heard.machine["machine"] == "vmc-08" and heard.machine["tone"] == "bad"
    assert any("Two services" in text and "vmc-07" in text for text in heard.machine["warnings"])
    for i in range(1, 12):
        heard.clock.advance(60)
        heard.hear(offset=offset(3 + i, START_NS + i * 60 * NS, machine="vmc-08"))
    assert heard.machine["tone"] == "good" and heard.machine["warnings"] == []


def test_a_service_that_is_gone_is_told_before_its_offset_is_too_old(heard: Heard) -> None:
    heard.hear(offset=offset(5))
    heard.shop.set_alive(KEY + "alive", False)
    assert heard.machine["shown"] == "ok" and heard.machine["tone"] == "warn"
    assert any("liveliness token is gone" in text for text in heard.machine["warnings"])


def test_no_machine_may_cut_whose_further_axis_never_arrived(heard: Heard) -> None:
    heard.hear(offset=axis_offset("y", 5))
    heard.clock.advance(3)  # they come one after the other
    assert heard.machine["warning_codes"] == [] and heard.machine["headline"]["cut"] == "yes"
    heard.clock.advance(3)
    machine = heard.machine
    assert machine["warning_codes"] == ["axis_missing"] and machine["tone"] == "warn"
    assert machine["headline"]["cut"] == "no" and "has arrived for Z." in machine["headline"]["text"]
    heard.hear(**{"z/offset": axis_offset("z", 5)})
    assert heard.machine["warnings"] == [] and heard.machine["headline"]["cut"] == "yes"


@pytest.mark.parametrize(("lost", "label"), [("y", "Y"), ("z", "Z")])
def test_no_machine_may_cut_whose_axis_was_lost_with_the_newest_sample(heard: Heard, lost: str, label: str) -> None:
    heard.hear(**{f"{axis}/offset": axis_offset(axis, 5) for axis in "yz"})
    heard.clock.advance(60)
    kept = next(axis for axis in "yz" if axis != lost)
    heard.hear(**{f"{kept}/offset": axis_offset(kept, 6, heard.clock.now_ns)})
    assert heard.machine["headline"]["cut"] == "yes"
    heard.clock.advance(6)
    assert heard.machine["headline"]["cut"] == "no" and f"for {label}." in heard.machine["warnings"][0]


def test_an_axis_that_stays_away_is_not_taken_to_be_on_its_way_with_each_sample(heard: Heard) -> None:
    heard.hear(**{f"{axis}/offset": axis_offset(axis, 5) for axis in "yz"})
    for seq in (6, 7):
        heard.clock.advance(60)
        heard.hear(**{"y/offset": axis_offset("y", seq, heard.clock.now_ns)})
        assert heard.machine["headline"]["cut"] == ("yes" if seq == 6 else "no")
    heard.hear(**{"y/offset": axis_offset("y", 3, heard.clock.now_ns, machine="vmc-08")})
    assert "axis_missing" not in heard.machine["warning_codes"]  # numbers of another machine


@pytest.mark.parametrize("order", ["yz", "zy"])
def test_no_machine_may_cut_while_an_axis_in_hold_is_on_its_way(heard: Heard, order: str) -> None:
    """The axes of a sample arrive one after the other, and one may be lost."""
    for seq, arriving in ((5, order), (6, order), (7, "y")):
        for axis in arriving:
            held = {"state": "hold", "reasons": ["t_q_missing"]} if axis == "z" else {}
            heard.hear(**{f"{axis}/offset": axis_offset(axis, seq, heard.clock.now_ns, **held)})
            if seq > 5:
                assert (heard.machine["shown"], heard.machine["headline"]["cut"]) == ("hold", "no")
                assert [reason["code"] for reason in heard.machine["reasons"]] == ["t_q_missing"]
        heard.clock.advance(60)
    assert heard.machine["headline"]["cut"] == "no" and heard.machine["warning_codes"] == ["axis_missing"]


def test_an_axis_that_answers_no_query_is_missing_at_once() -> None:
    """`watch --once` shows what was answered and waits for nothing."""
    shop = Shop(Clock())
    shop.receive(KEY + "y/offset", axis_offset("y", 5), asked=True)
    machine = shop.one("shop/vmc-07")
    assert machine is not None and machine["headline"]["cut"] == "no"
    shop.receive(KEY + "z/offset", axis_offset("z", 5), asked=True)
    machine = shop.one("shop/vmc-07")
    assert machine is not None and machine["headline"]["cut"] == "yes"


def test_a_probe_that_sees_more_than_the_service_states_is_told_after_half_an_hour(heard: Heard) -> None:
    def minute(i: int, residual_um: float, **changes: Any) -> None:
        t = START_NS + i * 60 * NS
        heard.hear(offset=offset(i, t, **changes), estimate=estimate(i, t, residual_um=residual_um))
        heard.clock.advance(60)

    for i in range(30):
        minute(i, 9.0 if i % 3 == 0 else 0.4)  # the heat is switched again and again
    assert heard.machine["tone"] == "good" and heard.machine["warning_codes"] == []
    for i in range(30, 60):
        minute(i, -6.5)
    assert heard.machine["tone"] == "warn" and heard.machine["warning_codes"] == ["misfit"]
    assert heard.machine["shown"] == "ok" and "differed by 6.5 µm" in heard.machine["to_do"]
    assert "compensator diagnose" in heard.machine["to_do"] and "Nothing." not in heard.machine["to_do"]
    minute(60, -6.5, y_offset_std_um=4.0)  # one minute changes nothing
    assert heard.machine["warning_codes"] == ["misfit"]
    minute(61, -6.5, state="degraded", reasons=["implausible:model"])
    assert heard.machine["warning_codes"] == []  # the service says it itself


def test_events_say_what_to_do(heard: Heard) -> None:
    heard.hear(event=event(5, ok=False))
    heard.hear(event=event(6, text="couples: answers again", ok=True))
    heard.hear(event=event(7, kind="state", text="hold operator_hold", state="hold", reasons=["operator_hold"]))
    newest, back, gone = heard.machine["events"]
    assert "resume" in newest["do"] and back["do"] == "" and "probe" in gone["do"]


def test_a_text_that_no_service_writes_is_cut(heard: Heard) -> None:
    heard.hear(event=event(5, text="x" * 2000))
    heard.hear(event=event(6, kind="diagnosis", text="x" * 300_000, needs="y" * 300_000))
    heard.hear(event=event(7, kind="z" * 300_000))
    long_kind, long, whole = heard.machine["events"]
    assert (long["text"], long["do"], long_kind["kind"]) == ("x" * 2000 + "…", "y" * 2000 + "…", "z" * 2000 + "…")
    assert whole["text"] == "x" * 2000


@pytest.mark.parametrize(
    ("kind", "data", "expected"),
    [
        ("adopt", {"ok": False}, "previous model"),
        ("adopt", {"ok": True}, ""),
        ("command_refused", {"ok": False}, "who"),
        ("recording", {}, "free space"),
        ("recording", {"removed": ["old.mcap"]}, ""),
        ("start", {}, ""),
    ],
)
def test_an_event_asks_for_something_only_where_something_is_wrong(
    heard: Heard, kind: str, data: dict[str, Any], expected: str
) -> None:
    heard.hear(event=event(5, kind=kind, text="said", **data))
    (found,) = heard.machine["events"]
    assert (expected in found["do"]) if expected else found["do"] == ""


def test_machines_that_need_somebody_stand_first_and_strangers_are_counted(heard: Heard) -> None:
    for name, state in (("a", "ok"), ("b", "hold"), ("c", "degraded")):
        heard.shop.receive(f"shop/{name}/thermal/y/offset", offset(1, machine=name, state=state))
    assert [machine["prefix"] for machine in heard.shop.overview()] == ["shop/b", "shop/c", "shop/a"]
    heard.shop.receive("shop/a/thermal/y/other", b"{}")
    assert heard.shop.ignored == 1 and len(heard.shop.overview()) == 3


def test_effects_have_numbers_where_their_names_do_not_fit() -> None:
    machine = WatchedMachine("shop/vmc-07")
    machine.update("estimate", estimate(5, effects=(1.0, 2.0)), START_NS, 0.0)
    machine.update("status", status(5), START_NS, 0.0)
    assert machine.effects() == ["effect 1", "effect 2"]


def test_the_day_is_one_point_a_minute_with_values_of_one_sample() -> None:
    machine = WatchedMachine("shop/vmc-07")
    for i in range(0, 3600, 10):  # an hour at ten seconds
        t = START_NS + i * NS
        machine.update("offset", offset(i, t, y_offset_um=float(i)), t, i)
        machine.update("sample", sample(i, t, t_q=float(i)), t, i)
        machine.update("estimate", estimate(i, t, residual_um=float(i)), t, i)
    columns = machine.history.columns()
    assert len(columns["t_s"]) == 60
    assert (
        columns["y_offset_um"] == columns["t_q_degc"] == columns["residual_um"] == [60.0 * k + 50.0 for k in range(60)]
    )
    since = machine.history.columns(START_NS + 1800 * NS)
    assert len(since["t_s"]) == 30
    machine.update("offset", offset(10**6, START_NS + 25 * 3600 * NS), START_NS + 25 * 3600 * NS, 0.0)
    assert len(machine.history) == 1


def test_a_message_ahead_of_time_is_no_point_of_the_day(heard: Heard) -> None:
    """One would hold the page, which asks for what is newer than the last point, and would never be a day old."""
    heard.hear(offset=offset(5, START_NS + 240 * NS))  # clocks differ by minutes
    for i in range(3000):
        heard.hear(estimate=estimate(6, START_NS + (3600 + 60 * i) * NS))
        heard.hear(estimate=estimate(6, START_NS - 60 * i * NS))
    t_s = [t - START_NS / NS for t in heard.shop.history("shop/vmc-07")["t_s"]]
    assert t_s[0] == -24 * 3600 and t_s[-1] == 240 and len(t_s) == 24 * 60 + 2
    heard.clock.now_ns -= 3600 * NS  # the clock was ahead
    heard.hear(offset=offset(6, heard.clock.now_ns))
    assert heard.shop.history("shop/vmc-07")["t_s"][-1] == heard.clock.now_ns / NS + 300


def test_a_service_an_hour_ahead_is_shown_with_a_warning_and_without_points(heard: Heard) -> None:
    for number, ahead_s, without in ((5, 240, False), (6, 3600, True)):
        heard.hear(offset=offset(number, START_NS + ahead_s * NS))
        assert (heard.machine["shown"], heard.machine["warning_codes"]) == ("ok", ["clock_ahead"])
        assert ("are without its messages" in heard.machine["to_do"]) == without
    assert len(heard.shop.history("shop/vmc-07")["t_s"]) == 1


def test_a_recorded_message_ahead_of_time_is_not_of_the_last_day(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = [decoded("sample", sample(5 + i, START_NS + i * NS)) for i in (0, 240, 3600)]
    monkeypatch.setattr(past, "recordings", lambda *_: [Path("vmc-07.mcap")])
    monkeypatch.setattr(past, "messages", lambda *_, **__: iter(recorded))
    assert list(past.last_day(Path(), "vmc-07", START_NS)) == recorded[:2]


def test_the_past_of_a_recording_says_nothing_of_now() -> None:
    machine = WatchedMachine("shop/vmc-07")
    for kind, payload in (
        ("offset", offset(3)),
        ("sample", sample(3)),
        ("estimate", estimate(3)),
        ("event", event(3, kind="zero", text="zero")),
    ):
        message = decoded(kind, payload)
        assert isinstance(message, (Offset, Sample, EstimateMessage, Event))
        machine.add_recorded(message, START_NS, 0.0)
    assert machine.shown(START_NS, 0.0) == "unknown" and machine.age_s(START_NS, 0.0) is None
    assert machine.history.columns()["y_offset_um"] == [-12.34]
    assert machine.snapshot(START_NS, 0.0)["t_q_degc"] == 31.5
    assert machine.snapshot(START_NS + 200 * NS, 0.0)["t_q_degc"] is None
    machine.update("event", event(2, START_NS - NS), START_NS, 0.0)
    machine.update("event", event(3, kind="zero", text="zero"), START_NS, 0.0)  # heard again
    assert len(machine.events) == 2


def test_the_recorded_day_of_a_machine_of_several_axes_is_shown() -> None:
    machine = WatchedMachine("shop/vmc-07")
    fields = json.loads(estimate(3)) | {"axes": {"z_pred_um": 4.0, "z_std_um": 0.5}}
    machine.add_recorded(msgspec.convert(fields, AxesEstimate), START_NS, 0.0)
    machine.add_recorded(msgspec.json.decode(sample(3), type=Sample), START_NS, 0.0)
    assert machine.history.columns()["residual_um"] == [-0.34]
    assert machine.snapshot(START_NS, 0.0)["residual_um"] == -0.34
    machine.update("estimate", estimate(4, residual_um=0.5), START_NS, 0.0)
    assert machine.snapshot(START_NS, 0.0)["residual_um"] == 0.5


def test_samples_of_a_slow_model_are_one_interval() -> None:
    day = {"t_s": [0.0, 300.0, 600.0, 2000.0], "state": ["ok"] * 4, "reasons": [""] * 4}
    intervals = [(interval.begin_s, interval.end_s) for interval in state_intervals(day, 750.0)]
    assert intervals == [(2000.0, 2060.0), (0.0, 660.0)]
    assert len(state_intervals(day, 150.0)) == 4


WANTED = {
    "probe_wanted": False,
    "wanted_by_ns": START_NS + 5400 * NS,
    "wanted_why": "",
    "wanted_std_um": 1.2,
    "wanted_tolerance_um": 3.0,
}


def test_whether_a_probe_is_wanted_and_what_probes_add(heard: Heard) -> None:
    heard.hear(offset=offset(5), estimate=estimate(5, y_pred_um=14.34))
    heard.hear(status=status(5))
    assert heard.machine["probe"] is None  # a machine without probes
    assert [share["name"] for share in heard.machine["shares"]] == ["DTF", "TDTF", "gain DTF"]
    heard.hear(status=status(6, START_NS + 60 * NS, **WANTED))
    probe = heard.machine["probe"]
    assert (probe["wanted"], probe["by_ns"], probe["std_um"], probe["why"]) == (False, WANTED["wanted_by_ns"], 1.2, "")
    assert heard.machine["shares"][-1] == {"name": "probes", "y_um": pytest.approx(2.0)}
    changed = {"probe_wanted": True, "wanted_why": "probe_deviation", "wanted_std_um": 3.1}
    heard.hear(status=status(7, START_NS + 120 * NS, **(WANTED | changed)))
    assert heard.machine["probe"]["means"].startswith("The standard deviation exceeds the tolerance")
    heard.clock.advance(600)  # an old status says nothing about now
    assert heard.machine["probe"] is None


def test_a_proposed_model_is_shown_with_its_figures_and_what_a_person_can_answer(heard: Heard) -> None:
    heard.hear(offset=offset(5), estimate=estimate(5, y_pred_um=14.34))
    heard.hear(status=status(5))
    assert "loop" not in heard.machine  # a machine without a loop
    heard.hear(status=status(6, START_NS + 60 * NS, loop=LOOP))
    found = heard.machine["loop"]
    assert "one that has shown itself better is proposed, with input:coolant_degc" in found["line"]
    assert "present 6.9 µm rms, this one 1.2" in found["line"]
    assert [command.split()[1] for command in found["commands"]] == ["adopt", "dismiss"]
    assert all(command.endswith("--config machine.toml") for command in found["commands"])
    assert "goes on" not in found["line"]
    beside = LOOP | {"before_effects": ["gain:DTF"], "before_text": "no verdict: no zero was set yet"}
    heard.hear(status=status(7, START_NS + 120 * NS, loop=beside))
    assert "The one before the last change, with gain:DTF, goes on, too: no verdict" in heard.machine["loop"]["line"]
    others = LOOP | {"others": ["gain:DTF: no verdict", "delay:DTF: last 8 h: present 6.9 µm rms, this one 7.1"]}
    heard.hear(status=status(8, START_NS + 180 * NS, loop=others))
    assert "Compared, too: gain:DTF: no verdict. delay:DTF: last 8 h" in heard.machine["loop"]["line"]
    heard.clock.advance(600)  # an old status says nothing about now
    assert "loop" not in heard.machine


def test_a_candidate_that_is_not_proposed_yet_is_nothing_to_answer(heard: Heard) -> None:
    heard.hear(offset=offset(5), estimate=estimate(5, y_pred_um=14.34))
    heard.hear(status=status(5, loop=LOOP | {"phase": "shadow"}))
    assert heard.machine["loop"]["commands"] == [] and "runs beside" in heard.machine["loop"]["line"]


def test_the_commands_name_the_configuration_that_the_watch_was_given() -> None:
    shop = Shop(Clock(), {"shop/vmc-01": "/etc/vmc 01.toml"})
    for name in ("vmc-01", "vmc-02"):
        shop.receive(f"shop/{name}/thermal/y/offset", offset(3, machine=name))
        shop.receive(f"shop/{name}/thermal/status", status(3, machine=name, loop=LOOP))
        proposed = {"schema": 1, "machine": name, "seq": 3, "time_utc_ns": START_NS, "kind": "loop", "text": "proposed"}
        shop.receive(f"shop/{name}/thermal/event", json.dumps(proposed | {"data": {"step": "propose"}}).encode())
    for name, file in (("vmc-01", "'/etc/vmc 01.toml'"), ("vmc-02", "machine.toml")):
        found = shop.one(f"shop/{name}")
        assert found is not None
        assert [command.partition(" --config ")[2] for command in found["loop"]["commands"]] == [file] * 2
        assert f"dismiss --config {file}`" in found["events"][0]["do"]


def test_of_two_recorded_models_in_shadow_the_candidate_is_drawn() -> None:
    history = MachineHistory()
    history.add(msgspec.json.decode(estimate(5), type=EstimateMessage), START_NS)
    for role, y_um in (("before", 1.0), ("candidate", 2.0), ("before", 3.0)):
        history.add_recorded_candidate(
            Candidate(
                schema=1,
                machine="vmc-07",
                seq=5,
                time_utc_ns=START_NS,
                model_sha256=role,
                role=role,  # type: ignore[arg-type]
                y_pred_um=y_um,
                y_std_um=0.4,
                residual_um=None,
                present_residual_um=None,
                innovations_um=[],
                reasons=[],
                verdict="alike",
                present_rms_um=None,
                candidate_rms_um=None,
                deviations=None,
                hours=0.0,
                probes=0,
            )
        )
    assert history.columns()["candidate_um"] == [2.0]


def test_the_prediction_of_the_shadow_is_in_the_history_of_its_sample() -> None:
    history = MachineHistory()
    history.add(msgspec.json.decode(estimate(5, y_pred_um=14.34), type=EstimateMessage), START_NS)
    assert "candidate_um" not in history.columns()
    for number in (5, 7):  # the other one is of a sample that did not arrive
        history.add_candidate(msgspec.json.decode(status(number, loop=LOOP), type=Status))
    assert history.columns()["candidate_um"] == [11.0]


def test_a_level_that_was_raised_is_no_share_at_the_zero(heard: Heard) -> None:
    heard.hear(offset=offset(5), estimate=estimate(5, y_base_um=-6.0, level_um=6.0))
    assert heard.machine["shares"][-1] == {"name": "level", "y_um": 6.0} and len(heard.machine["shares"]) == 4
    heard.hear(estimate=estimate(6, START_NS + 60 * NS, y_base_um=-4.0, level_um=6.0))
    assert heard.machine["shares"][-2:] == [{"name": "at the zero", "y_um": -2.0}, {"name": "level", "y_um": 6.0}]
