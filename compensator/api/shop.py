"""The loop over the recordings of one machine of a shop: what it found, would adopt, and needs from a person."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import numpy as np

from compensator.api.loop_diagnosis import diagnosis_in_process
from compensator.clock import HOUR_NS, NS
from compensator.config import Config, LoopSettings
from compensator.errors import CompensatorError, DataError
from compensator.events import CommandName, EventKind, LoopAction, LoopData, Note, command_of
from compensator.messages import EstimateMessage, Offset, Probe, Sample, number
from compensator.recording.container import Container
from compensator.recording.reading import in_order, recordings_in
from compensator.service.compensation import Compensation, Outcome
from compensator.service.loop.run import OfflineLoop
from compensator.service.loop.state import same_effects
from compensator.service.probing import ReceivedProbe
from compensator.service.replay import RecordedStep, execute, setup_of, steps_in
from compensator.service.status import Zero
from compensator.service.transfer.warm_up import RecordedRun

Policy = Literal["propose", "adopt"]
#: Over how long before the end of the recordings an error is that of now, h.
NOW_H = 24.0
#: Most decisions that are kept.
MOST_STEPS = 500
#: Events that tell what the loop did.
LOOP_EVENTS = (EventKind.LOOP, EventKind.DIAGNOSIS, EventKind.ADOPT)
#: After these a candidate is proposed no longer.
_NOT_PROPOSED = (LoopAction.WITHDRAW, LoopAction.ADOPT, LoopAction.END)


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineLoop:
    """What the loop makes of a machine.

    Parameters
    ----------
    folder, machine : str
        Folder of its recordings, and its name; empty where it cannot be read.
    from_utc, to_utc : str
        What they cover.
    is_recorded : bool
        Whether its service has a loop: these are that loop's decisions. Otherwise they were computed now.
    measured_by : {"sensor", "probe", ""}
        What measured Y in the last day.
    first_um, now_um : float, optional
        Error that was left in the last day: with the present model and no loop, and with the loop, µm rms. The first
        only where it was computed.
    effects : tuple of str
        Effects of the last model that was adopted; empty for the calibrated one.
    found, proposed : tuple of str
        Effects of the last candidate of a diagnosis, and of a proposal that stands.
    diagnoses, adopted, gone_back : int
        Numbers; of models those that took over, also where a person has ordered it.
    needs : str
        What a person has to do; empty where nothing.
    steps : tuple of (str, str)
        Time and text of the last decisions.
    error : str
        Why the recordings cannot be used.
    cut : tuple of str
        Files without their end, but for the newest: the service was killed, or they are damaged, which `replay` tells.
    """

    folder: str
    machine: str = ""
    from_utc: str = ""
    to_utc: str = ""
    is_recorded: bool = False
    measured_by: Literal["sensor", "probe", ""] = ""
    first_um: float | None = None
    now_um: float | None = None
    effects: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    proposed: tuple[str, ...] = ()
    diagnoses: int = 0
    adopted: int = 0
    gone_back: int = 0
    needs: str = ""
    steps: tuple[tuple[str, str], ...] = ()
    error: str = ""
    cut: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return it for `--json`."""
        return dataclasses.asdict(self)


def loop_of_machine(folder: Path, policy: Policy) -> MachineLoop:
    """Return what the loop makes of the recordings of one machine.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of its recordings.
    policy : {"propose", "adopt"}
        Policy of the loop that is computed for a machine whose service has none.
    """
    try:
        return _loop_of(folder, policy)
    except (CompensatorError, OSError) as error:
        return MachineLoop(folder=str(folder), error=str(error))


def _loop_of(folder: Path, policy: Policy) -> MachineLoop:
    paths = in_order(recordings_in([folder]))
    with Container(paths[-1]) as container:
        contents = container.survey(whole=False)
        config, model = setup_of(contents, paths[-1].name)
        file = contents.attachments["model.toml"].data
    is_recorded = config.loop is not None and config.loop.is_on
    summary = _Summary(str(folder), config.machine.name, is_recorded=is_recorded)
    if is_recorded:
        for step in _steps(paths, summary.cut):
            summary.add_events((event.kind, event.text, event.data, event.time_utc_ns) for event in step.events)
            if step.estimate is not None and step.offset is not None:
                summary.add(step.estimate, step.offset, [probe for _, probe in step.probes])
        return summary.result()
    if config.probe is None and not any(channel.name == "y_um" for channel in config.channel):
        raise DataError(f"{folder}: nothing measures Y, expected a channel y_um or the table [probe]")
    # A table that is off keeps its other settings: with them the service would decide.
    loop = msgspec.structs.replace(config.loop or LoopSettings(policy=policy), policy=policy)
    config = msgspec.structs.replace(config, loop=loop)
    alone = _Summary("", "", is_recorded=False)
    followed = _Followed(OfflineLoop(config, file, diagnosis_in_process(config)))
    of_loop, of_first = _Fed(config, followed), _Fed(config, Compensation(config, model))
    for step in _steps(paths, summary.cut):
        outcome, first = of_loop.process(step), of_first.process(step)
        if outcome is not None:
            at_ns = outcome.sample.time_utc_ns
            summary.add_events((note.kind, note.text, note.data, at_ns) for note in followed.notes)
            summary.add(outcome.estimate, outcome.offset, outcome.probes)
        if first is not None:
            alone.add(first.estimate, first.offset, first.probes)
    return dataclasses.replace(summary.result(), first_um=alone.now_um)


def _steps(paths: Sequence[Path], cut: list[str]) -> Iterator[RecordedStep]:
    """Yield the groups of all files; `cut` gets those that end without their end, but for the newest."""
    for path in paths:
        with Container(path) as container:
            yield from steps_in(container)
            if path != paths[-1] and not container.contents.ended:
                cut.append(path.name)


# ---------------------------------------------------------------------- what came out


class _Summary:
    """Counts decisions, and keeps the errors of the last day: with the recorded offset, or with a computed one."""

    def __init__(self, folder: str, machine: str, *, is_recorded: bool) -> None:
        self._named = {"folder": folder, "machine": machine}
        self._is_recorded = is_recorded
        self._times = [0, 0]
        self._left: deque[tuple[int, float]] = deque()
        self._probed: deque[tuple[int, float]] = deque()
        self._offsets: deque[tuple[int, float]] = deque()
        #: Exchanges by what they were: a model that was adopted, or gone back to.
        self._exchanged = Counter[str]()
        self._diagnoses = 0
        self._found: tuple[str, ...] = ()
        self._effects: tuple[str, ...] = ()
        #: Effects of the proposal that stands, and the hash of its model.
        self._proposed: tuple[str, ...] = ()
        self._proposed_sha256 = ""
        self._needs = ""
        self._steps: deque[tuple[str, str]] = deque(maxlen=MOST_STEPS)
        #: Files without their end (`MachineLoop.cut`).
        self.cut: list[str] = []

    def add(self, estimate: EstimateMessage, offset: Offset, probes: Iterable[Probe]) -> None:
        """Add a sample."""
        now_ns = estimate.time_utc_ns
        self._times = [self._times[0] or now_ns, now_ns]
        offset_um = number(offset.y_offset_um)
        probed = [(one.time_utc_ns, self._left_at(one)) for one in probes if one.taken]
        for kept, values in (
            (self._left, [(now_ns, number(estimate.y_um) + offset_um)]),
            (self._probed, probed),
            # After the probes: what this sample's offset has learned of them was not applied while they measured.
            (self._offsets, [(now_ns, offset_um)]),
        ):
            kept.extend(one for one in values if math.isfinite(one[1]))
            while kept and kept[0][0] <= now_ns - NOW_H * HOUR_NS:
                kept.popleft()

    def _left_at(self, probe: Probe) -> float:
        """Return the error that a probe shows with the offset of its time, µm."""
        if self._is_recorded:
            return number(probe.measured_um)
        before = (um for at_ns, um in reversed(self._offsets) if at_ns <= probe.time_utc_ns)
        return number(probe.deformation_um) + next(before, math.nan)

    def add_events(self, events: Iterable[tuple[str, str, Any, int]]) -> None:
        """Add events: kind, text, data, time."""
        for kind, text, data, at_ns in events:
            if kind not in LOOP_EVENTS:
                continue
            self._steps.append((_utc(at_ns), text))
            if kind == EventKind.DIAGNOSIS and not data.get("without"):
                self._diagnoses += 1
                self._needs = str(data.get("needs", "")) if data.get("verdict") not in _HEALTHY else ""
            elif kind == EventKind.LOOP:
                self._add_decision(data)
            elif data.get("ok") is True:
                # Not every decision was carried out: a model can end before its exchange.
                effects = data.get("effects")
                self._exchanged[str(data.get("action", LoopAction.ADOPT))] += 1
                self._effects = tuple(map(str, effects)) if isinstance(effects, list) else ()

    def _add_decision(self, data: Any) -> None:
        try:
            found = msgspec.convert(data, LoopData)
        except msgspec.ValidationError:
            return  # of another version
        step, effects = found.step, tuple(found.effects)
        if step == LoopAction.SHADOW:
            self._found = effects
            if self._proposed and same_effects(effects, self._proposed):
                self._proposed_sha256 = found.model_sha256  # newer parameters are proposed in their place
        if step == LoopAction.PROPOSE:
            self._proposed, self._proposed_sha256 = effects, found.model_sha256
        elif step in _NOT_PROPOSED and found.model_sha256 == self._proposed_sha256:
            self._proposed, self._proposed_sha256 = (), ""

    @property
    def now_um(self) -> float | None:
        """Error that was left in the last day; None without measured Y."""
        kept = self._left or self._probed
        return float(np.sqrt(np.mean(np.square([value for _, value in kept])))) if kept else None

    def result(self) -> MachineLoop:
        """Return what the loop made of the machine.

        Raises
        ------
        DataError
            If there were no samples.
        """
        if not self._times[0]:
            raise DataError(f"{self._named['folder']}: no samples in its recordings")
        needs = self._needs
        if self._proposed:
            one = self._proposed_sha256[:12]
            answers = f"compensator adopt --candidate {one} --config FILE, or dismiss {one} --config FILE"
            needs = f"decide on the proposal: {answers}{f'; {needs}' if needs else ''}"
        return MachineLoop(
            folder=self._named["folder"],
            machine=self._named["machine"],
            from_utc=_utc(self._times[0]),
            to_utc=_utc(self._times[1]),
            is_recorded=self._is_recorded,
            measured_by="sensor" if self._left else "probe" if self._probed else "",
            now_um=self.now_um,
            effects=self._effects,
            found=self._found,
            proposed=self._proposed,
            diagnoses=self._diagnoses,
            adopted=self._exchanged[LoopAction.ADOPT],
            gone_back=self._exchanged[LoopAction.BACK],
            needs=needs,
            steps=tuple(self._steps),
            cut=tuple(self.cut),
        )


#: Verdicts after which no person is needed.
_HEALTHY = ("adequate", "explained")


def _utc(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns / NS, UTC):%Y-%m-%dT%H:%MZ}"


# ---------------------------------------------------------------------- recorded samples


class _Followed:
    """A run of the loop that takes recorded samples as a compensation does."""

    def __init__(self, run: OfflineLoop) -> None:
        self._run = run
        self._probes: tuple[ReceivedProbe, ...] = ()
        #: Events of the last sample.
        self.notes: tuple[Note, ...] = ()

    def __getattr__(self, name: str) -> Any:
        """Return what is that of the present compensation alone, such as its model, its status and its zero."""
        return getattr(self._run.compensation, name)

    def resume(self) -> None:
        self._run.resume()

    def pause(self, samples: int | None) -> None:
        self._run.pause(samples)

    def receive_probes(self, probes: Sequence[ReceivedProbe]) -> None:
        self._probes = tuple(probes)

    def process(self, sample: Sample) -> Outcome:
        probes, self._probes = self._probes, ()
        step = self._run.process(sample, probes)
        self.notes = step.events
        return step.outcome


class _Fed:
    """Runs recorded samples through a compensation, with the zeros, probes, holds and pauses of the record."""

    def __init__(self, config: Config, compensation: Compensation | _Followed) -> None:
        self._compensation = cast(Compensation, compensation)
        self._run = RecordedRun(config, self._compensation, probes=True)
        self._begun = False
        self._compensation.begin(None)

    def process(self, step: RecordedStep) -> Outcome | None:
        """Process a recorded group; return the outcome of its sample."""
        if not self._begun and not self._begin(step):
            return None
        for event in step.events:
            if event.kind == EventKind.COMMAND and command_of(event) in (CommandName.HOLD, CommandName.RESUME):
                execute(self._compensation, command_of(event), {})
        return self._run.process(step)

    def _begin(self, step: RecordedStep) -> bool:
        """Begin at the first sample with a zero, with that zero if it was set before."""
        if step.sample is None or step.estimate is None:
            return False
        zero = Zero.set_in(step.estimate)
        if step.zero is None and zero is None:
            return False
        self._begun = True
        if step.zero is None:
            self._compensation.begin(zero)
        return True
