"""A service without loop, devices and clock: the real compensation and the real recorder, as the daemon drives them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from compensator.config import parse_config
from compensator.messages import SCHEMA, Event, Sample, encode
from compensator.model.model_file import parse_model, read_model_bytes
from compensator.recording.recorder import McapRecorder
from compensator.service.compensation import Compensation
from tests.service.records import sample
from tests.service.simulated import START_NS

MACHINE = "vmc-07"
MINUTE_NS = 60_000_000_000
CONFIG = b"""
machine.name = "vmc-07"
model.file = "quill"
sampling.poll_interval_s = 10.0
loss.predict_for_min = 10.0
zero.rest_rate_um_per_min = 0.2
guards.t_q_below_at_max_k = 2.0
zenoh.prefix = "shop/vmc-07"
recording.folder = "rec"
line = []
device = [{name = "module"}]
[limits]
offset_max_um = 200.0
offset_rate_max_um_per_min = 8.0
validity = {t_q_degc = [10.0, 60.0], at_degc = [10.0, 35.0]}
[[channel]]
name = "t_q_degc"
device = "module"
input = 0
range = [0.0, 80.0]
rate_max_per_min = 5.0
stuck_after_min = 60.0
[[channel]]
name = "at_degc"
device = "module"
input = 1
range = [0.0, 50.0]
rate_max_per_min = 2.0
stuck_after_min = 60.0
[[channel]]
name = "y_um"
device = "module"
input = 2
range = [-200.0, 200.0]
rate_max_per_min = 30.0
stuck_after_min = 60.0
[[channel]]
name = "coolant_degc"
device = "module"
input = 3
"""
QUILL = read_model_bytes("quill")


def other_model() -> bytes:
    """The published model with a DTF that is 20 % stronger at rest."""
    text = QUILL.decode()
    changed = text.replace("[0.0001065, ", "[0.0001278, ").replace('name = "quill"', 'name = "other"')
    assert changed != text
    return changed.encode()


def readings(count: int, first: int = 0) -> Iterator[dict[str, float]]:
    """Temperatures and deformation of a machine that works for an hour and rests for one, quickly made."""
    for i in range(first, first + count):
        load = 0.5 - 0.5 * math.cos(i / 60.0 * math.pi / 2)
        noise = math.sin(12.9898 * i) * 43758.5453 % 1.0 - 0.5
        yield {
            "t_q_degc": 20.0 + 6.0 * load + 0.04 * noise,
            "at_degc": 20.0 + 0.6 * math.sin(i / 200.0) + 0.02 * noise,
            "y_um": 30.0 * load + 0.4 * noise,
            "coolant_degc": 21.0 + 0.1 * noise,
        }


class Service:
    """Makes recordings.

    `model` is taken over with the next file after `adopt`; `kill` leaves the live file as it is.
    """

    def __init__(
        self,
        folder: Path,
        *,
        config: bytes = CONFIG,
        model: bytes = QUILL,
        seq: int = 0,
        start_ns: int = START_NS,
        state: bytes = b"",
        **recorder: Any,
    ) -> None:
        self.folder = folder
        self.config = parse_config(config, source="test")
        self.recorder = McapRecorder(folder, MACHINE, {"config.toml": config, "model.toml": model}, **recorder)
        self.compensation = Compensation(self.config, parse_model(model, source="test"))
        if state:
            self.compensation.restore(state)
        self.seq, self.start_ns = seq, start_ns
        self.events: list[Event] = []
        self.commands: list[tuple[str, dict[str, Any]]] = []
        self._failing = False
        self.note("start", "compensator test")

    @property
    def now_ns(self) -> int:
        return self.start_ns + self.seq * MINUTE_NS

    def note(self, kind: str, text: str, data: Mapping[str, Any] | None = None) -> None:
        self.events.append(
            Event(
                schema=SCHEMA,
                machine=MACHINE,
                seq=self.seq,
                time_utc_ns=self.now_ns,
                kind=kind,
                text=text,
                data=dict(data or {}),
            )
        )

    def command(self, name: str, **data: Any) -> None:
        self.commands.append((name, data))

    def adopt(self, model: bytes) -> None:
        new = Compensation(self.config, parse_model(model, source="test"))
        status = self.compensation.status
        new.begin(status.zero)
        changed = not math.isnan(status.target_um)
        new.continue_from(msgspec.structs.replace(status.handover, model_changed=changed))
        self.compensation = new
        self.recorder.attachments = {**self.recorder.attachments, "model.toml": model}
        self.recorder.start_new()
        self.note("model", "another model")

    def fail(self, text: str = "internal error: ValueError: test") -> None:
        """An error of the service's own: the offset is held without a sample."""
        state = self.compensation.state()
        self.note("error", text)
        self.compensation.fail()
        offset = encode(self.compensation.held_axes(MACHINE, self.seq, self.now_ns)[0])
        self._write([("offset", offset)], state)
        self.seq += 1

    def take(self, values: dict[str, float], *, disk: bool = True, lost: bool = False) -> Sample:
        """One sample; the disk may refuse it, or the service may not be there to take it."""
        raw = msgspec.structs.replace(sample(self.seq, values), time_utc_ns=self.now_ns)
        if lost:
            self.seq += 1
            return raw
        state = self.compensation.state()
        for name, data in self.commands:
            self.note("command", name, data | {"command": name})
            getattr(self.compensation, name)(**data)
        self.commands = []
        outcome = self.compensation.process(raw)
        for note in outcome.notes:
            self.note(*note)
        offset = outcome.offset
        if self._failing:
            offset = msgspec.structs.replace(
                offset,
                state="degraded" if offset.state == "ok" else offset.state,
                reasons=[*offset.reasons, "recording_failed"],
            )
        records = [
            ("sample", encode(outcome.sample)),
            ("estimate", encode(outcome.estimate)),
            ("offset", encode(offset)),
        ]
        if disk:
            self._write(records, state)
        elif not self._failing:
            self._failing = True
            self.recorder._give_up()
            self.note("recording", "the disk does not take the recording: [Errno 28] No space left on device")
        self.seq += 1
        return raw

    def run(self, count: int) -> Service:
        for values in readings(count, self.seq):
            self.take(values)
        return self

    def stop(self) -> None:
        self.note("stop", "the service ends")
        self._write([], self.compensation.state())
        self.recorder.close()

    def kill(self) -> None:
        live = self.recorder._live
        self.recorder._live = None
        self.recorder._finisher.wait()
        if live is not None:
            import os

            os.close(live._descriptor)

    def _write(self, records: list[tuple[str, bytes]], state: bytes) -> None:
        events = [("event", encode(event)) for event in self.events]
        self.recorder.write([*events, *records], self.now_ns, state=state)
        self.events = []
        if self._failing:
            self._failing = False
            self.note("recording", "the disk takes the recording again")
