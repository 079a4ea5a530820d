"""The service: polls devices, makes samples, lets the compensation decide, records, publishes.

The order within a sample is fixed: everything is on disk before the offset goes out.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

import msgspec

from compensator import __version__
from compensator.clock import Clock
from compensator.config import Config
from compensator.errors import CompensatorError, ServiceError
from compensator.messages import SCHEMA, Event, Sample, Status, encode
from compensator.service.adoption import LONGEST_MODEL, Adoption, Prepared, Wanted
from compensator.service.compensation import Compensation, Outcome
from compensator.service.grid import Grid
from compensator.service.publisher import COMMANDS, Reply
from compensator.service.retrace import obey, samples_between
from compensator.service.sampling import ChannelCollector
from drivers.errors import DriverError
from drivers.reading import Device, Reading

log = logging.getLogger("compensator")

#: Part of the poll interval that a sample waits for devices at most.
WAIT_PART = 0.5
#: Longest payload of a command that brings no model, bytes.
LONGEST_COMMAND = 10_000


@dataclass(slots=True)
class _DeviceState:
    """A device with the poll that is under way and its last error."""

    device: Device
    task: asyncio.Task[Mapping[int, Reading]] | None = None
    error: str = ""
    answered: bool = True


@dataclass(slots=True)
class Latency:
    """Seconds from the last byte read to the offset published, for each sample."""

    seconds: list[float] = field(default_factory=list)

    def add(self, value: float, keep: int = 10_000) -> None:
        """Keep the newest values."""
        self.seconds.append(value)
        if len(self.seconds) > keep:
            del self.seconds[: keep // 2]


@dataclass(slots=True)
class _Adopting:
    """A model that is being taken over, with the samples that came meanwhile."""

    wanted: Wanted
    reply: Future[dict[str, Any]]
    since: list[Outcome] = field(default_factory=list)
    prepared: Prepared | None = None
    task: asyncio.Task[None] | None = None


class Daemon:
    """The service of one machine.

    Parameters
    ----------
    config : Config
        Settings.
    compensation : Compensation
        What decides.
    devices : mapping of str to Device
        Open or not; a device opens itself when it is read.
    recorder : Recorder
        Where every sample goes first.
    publish : callable
        Takes a message's name and its JSON; never waits.
    clock : Clock
        Handed in.
    first_sequence : int
        Sequence number of the first sample.
    adoption : Adoption, optional
        Prepares other models; without it the commands `adopt` and `back` are refused.
    notes : sequence of (str, str, dict)
        Events of what went before: kind, text and data.
    """

    def __init__(
        self, *, config: Config, compensation: Compensation, devices: Mapping[str, Device],
        recorder: Any, publish: Callable[[str, bytes], None], clock: Clock, first_sequence: int,
        adoption: Adoption | None = None, notes: Sequence[tuple[str, str, dict[str, Any]]] = (),
    ) -> None:  # fmt: skip
        self._config = config
        self._compensation = compensation
        self._devices = {name: _DeviceState(device) for name, device in devices.items()}
        self._recorder = recorder
        self._publish = publish
        self._clock = clock
        self._sequence = first_sequence
        fraction = config.sampling.min_good_fraction
        self._collectors = {channel.name: ChannelCollector(fraction) for channel in config.channel}
        self._events: list[Event] = []
        self._commands: asyncio.Queue[tuple[str, dict[str, Any]]] = asyncio.Queue(maxsize=100)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop = False
        self._recording_failed = False
        self._started_utc_ns = clock.utc_ns()
        self._last_state = ""
        self._adoption = adoption
        self._adopting: _Adopting | None = None
        self._earlier = notes
        self._first = True
        #: Whether a sample broke off half-way, so that its file cannot give the state after it.
        self._broken_off = False
        self.latency = Latency()

    # ------------------------------------------------------------------ running

    async def run(self, *, samples: int | None = None, on_sample: Callable[[Outcome], None] | None = None) -> None:
        """Run until `stop` or for a number of samples.

        Parameters
        ----------
        samples : int, optional
            Stop after so many.
        on_sample : callable, optional
            Called with the outcome after each sample was published.
        """
        self._loop = asyncio.get_running_loop()
        period_s = self._compensation.model.period_s
        polls = max(1, round(period_s / self._config.sampling.poll_interval_s))
        grid = Grid(self._clock, period_s, polls)
        self._note("start", f"compensator {__version__} with model {self._compensation.model.name}")
        for kind, text, data in self._earlier:
            self._note(kind, text, data)
        done = 0
        try:
            while not self._stop and (samples is None or done < samples):
                await self._clock.sleep(grid.seconds_to_next_poll())
                if self._stop:
                    break
                label_ns, last = grid.label_ns, grid.polled()
                outcome = await self._turn(period_s / polls, label_ns if last else None)
                if last:
                    self._tell_clock_step(grid.next_sample())
                    done += 1
                if outcome is not None and on_sample is not None:
                    on_sample(outcome)
        finally:
            await self._close()

    async def _turn(self, interval_s: float, label_ns: int | None) -> Outcome | None:
        """Poll, and make the sample where one ends here; whatever goes wrong, the offset is held and it is said.

        This is the supervisor, the one place that catches everything: a defect in any room must not leave the
        machine without a word, and must never move the offset.
        """
        try:
            await self._poll(interval_s)
            return self._sample(label_ns) if label_ns is not None else None
        except Exception as error:
            log.exception("internal error")
            self._note("error", f"internal error: {type(error).__name__}: {error}")
            self._compensation.fail()
            if label_ns is not None:
                self._hold(label_ns)
            return None

    def _hold(self, label_ns: int) -> None:
        """Publish that the last offset stands, without the sample that could not be worked on."""
        offset = encode(self._compensation.held(self._config.machine.name, self._sequence, label_ns))
        self._record([("offset", offset)], label_ns)
        self._publish("offset", offset)
        self._sequence += 1

    def stop(self) -> None:
        """End the run after the poll under way; the recording is finished."""
        self._stop = True

    async def _close(self) -> None:
        self._stop = True
        await self._end_adoption()
        self._note("stop", "the service ends")
        self._record([], self._clock.utc_ns())
        try:
            self._recorder.close()
        except OSError as error:
            self._publish_event("recording", f"the recording could not be finished: {error}")
        for state in self._devices.values():
            if state.task is not None:
                state.task.cancel()
        tasks = [state.task for state in self._devices.values() if state.task is not None]
        await asyncio.gather(*tasks, return_exceptions=True)

    # ------------------------------------------------------------------ polling

    async def _poll(self, interval_s: float) -> None:
        """Ask every device once; wait for those that answered last time, and not long for them."""
        for state in self._devices.values():
            if state.task is None:
                state.task = asyncio.create_task(self._read(state.device))
        awaited = [state.task for state in self._devices.values() if state.task is not None and state.answered]
        await self._clock.settle(awaited, WAIT_PART * interval_s)
        results = {name: self._collect(state) for name, state in self._devices.items()}
        for channel in self._config.channel:
            readings, error = results[channel.device]
            self._collectors[channel.name].add(readings.get(channel.input) if readings else None, error)

    async def _read(self, device: Device) -> Mapping[int, Reading]:
        return await device.read()

    def _collect(self, state: _DeviceState) -> tuple[Mapping[int, Reading] | None, str | None]:
        """Take the result of a device's poll; one that is still under way counts as missing."""
        if state.task is None or not state.task.done():
            state.answered = False
            return None, "device_timeout"
        task, state.task = state.task, None
        state.answered = True
        error = task.exception()
        if error is None:
            self._tell_device(state, "")
            return task.result(), None
        if not isinstance(error, DriverError):
            raise error
        state.answered = error.code != "device_timeout"
        self._tell_device(state, str(error))
        return None, error.code

    def _tell_device(self, state: _DeviceState, error: str) -> None:
        """Note once when a device goes, and once when it comes back."""
        if bool(error) != bool(state.error):
            name = state.device.name
            self._note("device", error or f"{name}: answers again", {"device": name, "ok": not error})
        state.error = error

    # ------------------------------------------------------------------ one sample

    def _sample(self, label_ns: int) -> Outcome:
        began = time.perf_counter()
        self._pass_pause(label_ns)
        self._swap()
        if self._broken_off:
            self._start_new_file()
        state = self._compensation.state()
        self._broken_off = True
        self._obey()
        raw = Sample(
            schema=SCHEMA, machine=self._config.machine.name, seq=self._sequence, time_utc_ns=label_ns,
            period_s=self._compensation.model.period_s,
            channels={name: collector.close() for name, collector in self._collectors.items()},
        )  # fmt: skip
        outcome = self._compensation.process(raw)
        self._broken_off = False
        for kind, text in outcome.notes:
            self._note(kind, text)
        outcome = self._with_recording_state(outcome)
        self._tell_state(outcome)
        records = [
            ("sample", encode(outcome.sample)),
            ("estimate", encode(outcome.estimate)),
            ("offset", encode(outcome.offset)),
        ]
        if not self._record(records, label_ns, state):
            outcome = self._with_recording_state(outcome)
            records[2] = ("offset", encode(outcome.offset))
        self._publish("offset", records[2][1])
        self.latency.add(time.perf_counter() - began)
        self._publish("sample", records[0][1])
        self._publish("estimate", records[1][1])
        self._publish("status", encode(self._status(outcome)))
        self._sequence += 1
        if self._adopting is not None:
            self._adopting.since.append(outcome)
        return outcome

    def _pass_pause(self, label_ns: int) -> None:
        """Tell the compensation, before its first sample, for how long nobody measured."""
        first, self._first = self._first, False
        _, last_ns = self._compensation.last
        if not first or last_ns == 0:
            return
        period_s = self._compensation.model.period_s
        missing, bridged = samples_between(last_ns, label_ns, period_s), self._compensation.bridge_max_min
        minutes = missing * period_s / 60.0
        data: dict[str, Any] = {"missing": missing, "minutes": minutes, "bridged": minutes <= bridged}
        text = f"{missing} sample(s) are missing between the last recording and now; "
        if label_ns <= last_ns:
            text = (
                "the wall clock stands before the end of the last recording: how long the service was away is unknown"
            )
            data = {"missing": None, "minutes": None, "bridged": False}
            self._compensation.pause_of_unknown_length()
        else:
            self._compensation.pause(missing)
            text += (
                f"{minutes:.0f} min are bridged" if minutes <= bridged
                else f"{minutes / 60.0:.1f} h cannot be bridged (restart.bridge_max_min, here {bridged:.0f} min)"
            )  # fmt: skip
        self._note("restart", text, data | {"y_std_um": self._compensation.std_um})

    def _record(self, records: list[tuple[str, bytes]], time_utc_ns: int, state: bytes | None = None) -> bool:
        """Bring records and waiting events to disk; tell whether it worked.

        `state` is that before the sample among the records; without one it is as it is now.
        """
        events = [("event", encode(event)) for event in self._events]
        state = self._compensation.state() if state is None else state
        try:
            self._recorder.write([*events, *records], time_utc_ns, state=state)
        except OSError as error:
            if not self._recording_failed:
                self._recording_failed = True
                self._note("recording", f"the disk does not take the recording: {error}")
            return False
        if self._recording_failed:
            self._recording_failed = False
            self._note("recording", "the disk takes the recording again")
        self._events = self._events[len(events) :]
        for text, data in self._recorder.remarks():
            self._note("recording", text, data)
        return True

    def _with_recording_state(self, outcome: Outcome) -> Outcome:
        """Say in the offset that the disk does not take the recording."""
        offset = outcome.offset
        if not self._recording_failed or "recording_failed" in offset.reasons:
            return outcome
        state = "degraded" if offset.state == "ok" else offset.state
        changed = msgspec.structs.replace(offset, state=state, reasons=[*offset.reasons, "recording_failed"])
        return Outcome(outcome.sample, outcome.estimate, changed, outcome.notes)

    def _status(self, outcome: Outcome) -> Status:
        model = self._compensation.model
        return Status(
            schema=SCHEMA, machine=self._config.machine.name, seq=outcome.offset.seq,
            time_utc_ns=outcome.offset.time_utc_ns, state=outcome.offset.state, reasons=outcome.offset.reasons,
            version=__version__, model=model.name, model_kind=model.kind, model_sha256=model.sha256,
            started_utc_ns=self._started_utc_ns,
            recording=self._recorder.path.name if self._recorder.path else "",
            devices={name: state.error or "ok" for name, state in self._devices.items()},
        )  # fmt: skip

    # ------------------------------------------------------------------ events and commands

    def _note(self, kind: str, text: str, data: dict[str, Any] | None = None) -> None:
        """Keep an event for the recording and publish it."""
        event = Event(
            schema=SCHEMA, machine=self._config.machine.name, seq=self._sequence,
            time_utc_ns=self._clock.utc_ns(), kind=kind, text=text, data=data or {},
        )  # fmt: skip
        # Bounded, so that a disk that is gone for long costs no memory; the newest are kept.
        self._events = [*self._events[-999:], event]
        self._publish("event", encode(event))

    def _publish_event(self, kind: str, text: str) -> None:
        self._note(kind, text)

    def _tell_state(self, outcome: Outcome) -> None:
        offset = outcome.offset
        now = " ".join([offset.state, *offset.reasons])
        if now != self._last_state:
            self._note("state", now, {"state": offset.state, "reasons": offset.reasons})
            self._last_state = now

    def _tell_clock_step(self, seconds: float) -> None:
        if seconds:
            self._note("clock", f"the wall clock was set by {seconds:+.1f} s", {"seconds": seconds})

    def command(self, name: str, payload: bytes) -> Reply:
        """Take a command from another thread; it acts at the next sample.

        Parameters
        ----------
        name : str
            `zero`, `hold`, `resume`, `adopt` or `back`.
        payload : bytes
            Empty or a JSON object. `zero` takes `mode`: `auto`, `rest` or `warm`; `adopt` takes `model`, the text of a
            model file, or `sha256`, that of one adopted before, or both; `adopt` and `back` take `force`.

        Returns
        -------
        dict or Future of dict
            `ok` and `text`; a promise of them for `adopt` and `back`, whose warm-up takes its time.
        """
        brings_model = name in ("adopt", "back")
        if len(payload) > (LONGEST_MODEL if brings_model else LONGEST_COMMAND):
            return _refusal(f"{name}: the payload has {len(payload)} bytes, more than a command may have")
        try:
            arguments = msgspec.json.decode(payload, type=dict[str, Any]) if payload else {}
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return _refusal(f"{name}: the payload is no JSON object")
        mode = arguments.get("mode", "auto")
        if name not in COMMANDS or (name == "zero" and mode not in ("auto", "rest", "warm")):
            return _refusal(
                f"{name} {mode!r}: expected zero with mode auto, rest or warm, hold, resume, adopt with a model, back"
            )
        if self._loop is None or self._stop or self._commands.full():
            return _refusal("the service cannot take a command now")
        if brings_model:
            return self._adopt_later(name, arguments)
        self._loop.call_soon_threadsafe(self._enqueue, name, arguments)
        return {"ok": True, "text": f"{name}: acts at the next sample"}

    def _enqueue(self, name: str, arguments: dict[str, Any]) -> None:
        if not self._commands.full():
            self._commands.put_nowait((name, arguments))

    def _obey(self) -> None:
        while not self._commands.empty():
            name, arguments = self._commands.get_nowait()
            self._note("command", name, arguments)
            obey(self._compensation, name, arguments)

    # ------------------------------------------------------------------ another model

    def _adopt_later(self, name: str, arguments: dict[str, Any]) -> Reply:
        assert self._loop is not None
        try:
            wanted = Wanted.of(name, arguments)
        except ServiceError as error:
            return _refusal(str(error))
        reply: Future[dict[str, Any]] = Future()
        self._loop.call_soon_threadsafe(self._begin_adoption, wanted, reply)
        return reply

    def _begin_adoption(self, wanted: Wanted, reply: Future[dict[str, Any]]) -> None:
        if self._adoption is None or self._stop or self._adopting is not None:
            why = "another model is under way" if self._adopting is not None else "this service takes no model now"
            reply.set_result(_refusal(f"{wanted.action}: {why}"))
            return
        # The text of the model is not repeated here: it travels in the recording that begins with it.
        self._note("command", wanted.action, {"sha256": wanted.sha256, "force": wanted.force})
        self._adopting = _Adopting(wanted, reply)
        self._adopting.task = asyncio.create_task(self._prepare(self._adoption, self._adopting))
        self._adopting.task.add_done_callback(self._tell_refusal)

    async def _prepare(self, adoption: Adoption, adopting: _Adopting) -> None:
        """Have the model made ready on another thread; then answer. The swap is the next sample's."""
        running = self._compensation
        zero = running.zero_that_stands if running.has_reference else None
        prepared = await asyncio.to_thread(adoption.prepare, adopting.wanted, running.model, zero, self._clock.utc_ns())
        adopting.prepared = prepared
        model = prepared.compensation.model
        how = f"warmed up on {prepared.samples} sample(s) of {prepared.minutes / 60.0:.1f} h"
        if not prepared.known:
            how += f", too little to know its state: standard deviation {prepared.compensation.std_um:.1f} µm for now"
        adopting.reply.set_result({
            "ok": True, "text": f"model {model.name} ({model.sha256[:12]}) is taken over at the next sample, {how}",
            "model": model.name, "model_sha256": model.sha256, "warm_up_min": prepared.minutes,
            "warm_up_samples": prepared.samples, "state_known": prepared.known,
        })  # fmt: skip

    def _tell_refusal(self, task: asyncio.Task[None]) -> None:
        """Answer that nothing comes of it, whatever the reason: the running model goes on."""
        adopting, error = self._adopting, None if task.cancelled() else task.exception()
        if adopting is None or error is None:
            return
        self._adopting = None
        text = str(error)
        if not isinstance(error, CompensatorError):
            log.error("internal error", exc_info=error)
            text = f"internal error: {type(error).__name__}: {error}"
        self._note("adopt", f"refused: {text}", {"ok": False, "action": adopting.wanted.action})
        adopting.reply.set_result(_refusal(text))

    def _swap(self) -> None:
        """Put a model that is ready in the place of the running one."""
        adopting = self._adopting
        if adopting is None or adopting.prepared is None:
            return
        self._adopting = None
        old, prepared = self._compensation, adopting.prepared
        new = prepared.compensation
        for outcome in adopting.since:
            zeroed = any(kind == "zero" for kind, _ in outcome.notes)
            how = "rest" if outcome.estimate.y_base_um == 0.0 else "warm"
            prepared.catch_up(outcome.sample, how if zeroed else None)  # type: ignore[arg-type]
        difference = new.target_um - old.target_um
        new.succeed(old)
        self._compensation = new
        self._recorder.attachments = {**self._recorder.attachments, "model.toml": prepared.data}
        self._start_new_file()
        named = [f"{one.model.name} ({one.model.sha256[:12]})" for one in (new, old)]
        self._note(
            "adopt",
            f"model {named[0]} in the place of {named[1]}, "
            f"warm-up {prepared.minutes / 60.0:.1f} h, the offset is to move by {difference:+.2f} µm",
            {
                "ok": True, "action": adopting.wanted.action, "old_sha256": old.model.sha256,
                "new_sha256": new.model.sha256, "warm_up_min": prepared.minutes, "warm_up_samples": prepared.samples,
                "state_known": prepared.known, "difference_um": difference, "y_std_um": new.std_um,
            },
        )  # fmt: skip

    def _start_new_file(self) -> None:
        try:
            self._recorder.start_new()
        except OSError as error:
            self._note("recording", f"the recording could not be finished: {error}")

    async def _end_adoption(self) -> None:
        """Let the adoption under way be answered: a model that was kept is used at the next start."""
        await asyncio.sleep(0)  # one that was asked for just now is refused
        adopting = self._adopting
        if adopting is not None and adopting.task is not None:
            await asyncio.gather(adopting.task, return_exceptions=True)


def _refusal(text: str) -> dict[str, Any]:
    return {"ok": False, "text": text}
