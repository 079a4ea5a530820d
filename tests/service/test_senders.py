"""Every command says in the recording who sent it, and the audit covers that."""

from __future__ import annotations

import dataclasses
import json
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from compensator.config import Zenoh
from compensator.recording.reading import read_messages, recordings
from compensator.service.commands import WAITING_COMMANDS
from compensator.service.publisher import Publisher, Sender, _payload, longest
from compensator.service.session import session_config
from tests.audit.made import MACHINE
from tests.audit.tampering import Line, rewrite
from tests.audit.test_replay import look, replayable
from tests.ports import free_port

ANNA = Sender("anna", "certificate")


def events(folder: Path, kind: str) -> list[dict[str, Any]]:
    found = [json.loads(r.data) for path in recordings(folder, MACHINE) for r in read_messages(path, ("event",))]
    return [event for event in found if event["kind"] == kind]


class Long:
    """A payload that must not be copied."""

    def __init__(self, length: int) -> None:
        self._length = length

    def __len__(self) -> int:
        return self._length

    def to_bytes(self) -> bytes:
        raise MemoryError


@pytest.mark.parametrize(("name", "length"), [("adopt", 1_000_001), ("hold", 10_001), ("probe", 10**12)])
async def test_a_payload_that_is_too_long_is_refused_before_it_is_copied(
    tmp_path: Path, name: str, length: int
) -> None:
    query = SimpleNamespace(payload=Long(length))
    payload = _payload(cast("zenoh.Query", query), longest(name))
    bench = replayable(tmp_path)
    replies: list[Any] = []
    bench.at_sample[2] = lambda: replies.append(bench.daemon.command(name, payload, ANNA))
    await bench.run(4)
    (reply,) = replies
    text = reply.result(timeout=0)["text"] if isinstance(reply, Future) else reply["text"]
    assert text == f"{name}: the payload is longer than {longest(name)} bytes"


async def test_a_hold_is_taken_however_many_commands_wait(tmp_path: Path) -> None:
    bench = replayable(tmp_path)

    def flood() -> None:
        for _ in range(3 * WAITING_COMMANDS):
            bench.daemon.command("zero", b'{"mode": "warm"}', ANNA)
        bench.daemon.command("hold", b"", ANNA)

    bench.at_sample[20] = flood
    await bench.run(40)
    said = [e["text"] for e in events(tmp_path / "rec", "command")]
    assert said == ["zero"] * WAITING_COMMANDS + ["hold"]
    assert "operator_hold" in bench.outcomes[-1].offset.reasons


@pytest.mark.parametrize(
    "more",
    [b"9223372036854775808", b"1" + 400 * b"0", b"-1e300", 500 * b"[" + 500 * b"]"],
    ids=["2^63", "10^400", "-1e300", "nested"],
)
async def test_what_a_payload_says_besides_does_not_prevent_an_audit(tmp_path: Path, more: bytes) -> None:
    bench = replayable(tmp_path)
    payload = b'{"mode": "warm", "more": ' + more + b"}"
    bench.at_sample[10] = lambda: bench.daemon.command("zero", payload, ANNA)
    bench.at_sample[20] = lambda: bench.daemon.command("hold", payload, ANNA)
    await bench.run(30)
    assert "operator_hold" in bench.outcomes[-1].offset.reasons
    assert look(tmp_path / "rec").clean
    kept = [set(event["data"]) for event in events(tmp_path / "rec", "command")]
    assert kept == [{"mode", "command", "by", "by_proof"}, {"command", "by", "by_proof"}]
    assert events(tmp_path / "rec", "error") == []


async def test_a_mode_that_is_no_text_is_refused_in_words(tmp_path: Path) -> None:
    bench = replayable(tmp_path)
    replies: list[Any] = []
    payload = b'{"mode": ' + 500 * b"[" + 500 * b"]" + b"}"
    bench.at_sample[2] = lambda: replies.append(bench.daemon.command("zero", payload, ANNA))
    await bench.run(4)
    assert replies[0]["ok"] is False and replies[0]["text"].startswith("zero list: expected zero with mode auto")


@pytest.mark.parametrize("cited", ["\nstate: ok \x1b[31m", 900_000 * "x"], ids=["line", "long"])
async def test_a_refusal_is_one_short_line_in_the_log_whatever_it_cites(tmp_path: Path, cited: str) -> None:
    bench = replayable(tmp_path)
    payloads = [json.dumps(said).encode() for said in ({"model": "x", "sha256": cited}, {cited: 1})]
    bench.at_sample[2] = lambda: [bench.daemon.command("adopt", payload, ANNA) for payload in payloads]
    await bench.run(4)
    texts = [event["text"] for event in events(tmp_path / "rec", "command_refused")]
    assert len(texts) == 2 and all(text.isprintable() and len(text) <= 2000 for text in texts)


async def test_the_recording_says_who_commanded_whatever_the_payload_says(tmp_path: Path) -> None:
    bench = replayable(tmp_path)
    liar = b'{"mode": "warm", "by": "the boss", "by_proof": "certificate"}'
    bench.at_sample[40] = lambda: bench.daemon.command("zero", liar, Sender("bert", "none"))
    bench.at_sample[50] = lambda: bench.daemon.command("hold", b"", ANNA)
    bench.at_sample[60] = lambda: bench.daemon.command("resume", b"")
    await bench.run(70)
    said = [(e["text"], e["data"]["by"], e["data"]["by_proof"]) for e in events(tmp_path / "rec", "command")]
    assert said == [("zero", "bert", "none"), ("hold", "anna", "certificate"), ("resume", "unnamed", "none")]
    found = look(tmp_path / "rec")
    assert found.clean and found.samples == 70
    # Another name in the place of hers is found.
    changed = []

    def rename(lines: list[Line]) -> list[Line]:
        for i, line in enumerate(lines):
            if line.topic == "event" and b'"by":"anna"' in line.data:
                lines[i] = dataclasses.replace(line, data=line.data.replace(b'"anna"', b'"otto"'))
                changed.append(i)
        return lines

    rewrite(recordings(tmp_path / "rec", MACHINE)[0], rename)
    assert len(changed) == 1 and not look(tmp_path / "rec").clean


async def test_without_proof_nothing_is_obeyed_where_the_network_is_more_than_this_computer(tmp_path: Path) -> None:
    bench = replayable(tmp_path)
    bench.daemon._commands._unproven = False
    answers = []

    def ask() -> None:
        for sender in (Sender(), Sender("anna", "none"), ANNA):
            answers.append(bench.daemon.command("hold", b"", sender))
        answers.append(bench.daemon.command("hold", b"nonsense", ANNA))

    bench.at_sample[40] = ask
    outcomes = await bench.run(45)
    assert [answer["ok"] for answer in answers] == [False, False, True, False]
    assert "thermal/command/hold/<common name" in answers[0]["text"]
    assert "operator_hold" in outcomes[-1].offset.reasons
    assert [e["data"]["by"] for e in events(tmp_path / "rec", "command")] == ["anna"]
    refused = [(e["data"]["by"], e["data"]["name"]) for e in events(tmp_path / "rec", "command_refused")]
    assert refused == [("unnamed", "hold"), ("anna", "hold"), ("anna", "hold")]
    assert look(tmp_path / "rec").clean


async def test_a_flood_of_refused_commands_pushes_no_other_event_out(tmp_path: Path) -> None:
    bench = replayable(tmp_path)
    bench.at_sample[40] = lambda: [bench.daemon.command("hold", b"nonsense", ANNA) for _ in range(3000)]
    await bench.run(42)
    assert len(events(tmp_path / "rec", "command_refused")) == 10
    assert len(events(tmp_path / "rec", "start")) == 1


def test_the_name_stands_in_the_key_and_a_wide_question_is_no_command() -> None:
    heard: list[tuple[str, Sender]] = []
    port = free_port()
    settings = Zenoh(prefix="shop/vmc-07", listen=[f"tcp/127.0.0.1:{port}"])

    def hear(name: str, payload: bytes, sender: Sender) -> dict[str, Any]:
        heard.append((name, sender))
        return {"ok": True, "text": name}

    with Publisher(settings, hear) as service:
        service.publish("offset", b"{}")
        client = session_config(Zenoh(prefix="x", mode="client", connect=settings.listen))
        with zenoh.open(client) as session:

            def ask(key: str) -> list[str]:
                return sorted(str(reply.ok.key_expr) for reply in session.get(key, timeout=10.0) if reply.ok)

            # Whoever looks around gets the latest, and neither zeroes nor holds the machine.
            for key in (
                "**",
                "shop/vmc-07/thermal/**",
                "shop/*/thermal/command/*",
                "shop/vmc-07/thermal/command/*/anna",
            ):
                assert not [one for one in ask(key) if "command" in one]
            assert "shop/vmc-07/thermal/y/offset" in ask("**")
            assert heard == []
            hold = "shop/vmc-07/thermal/command/hold"
            assert ask(hold) == [hold] and ask(f"{hold}/anna") == [f"{hold}/anna"]
            assert ask(f"{hold}/anna/bert") == []
    assert heard == [("hold", Sender()), ("hold", Sender("anna", "none"))]
