"""The loop in a replay: what reached it from outside is recorded as events, and everything else follows again."""

from __future__ import annotations

from contextlib import suppress

from compensator.errors import CompensatorError, DataError, ServiceError
from compensator.events import CommandName, DiagnosisData, EventKind, LoopAction, LoopData, Note, command_of, data_of
from compensator.messages import Event
from compensator.model.thermal_model import ThermalModel
from compensator.recording.container import Contents
from compensator.service.loop.core import LOOP_STATE, ShadowedLoop
from compensator.service.loop.ending import FAILED_OUTSIDE
from compensator.service.replay import RecordedStep, setup_of

#: Decisions that a replay must make again.
_DECIDED = (
    LoopAction.DIAGNOSE,
    LoopAction.SHADOW,
    LoopAction.NOTHING,
    LoopAction.PROPOSE,
    LoopAction.WITHDRAW,
    LoopAction.ADOPT,
    LoopAction.BACK,
    LoopAction.WAIT,
    LoopAction.WAIT_OVER,
)


def hand_over_all(core: ShadowedLoop, step: RecordedStep, now_ns: int) -> list[Note]:
    """Hand over what reached the loop before the sample of a group; return the decisions that followed.

    `now_ns` is the time of the last sample, ns since 1970 UTC.
    """
    held = step.offset if step.sample is None else None
    seq = step.sample.seq if step.sample is not None else held.seq if held is not None else None
    return [note for event in step.events if event.seq == seq for note in hand_over(core, event, now_ns)]


def hand_over(core: ShadowedLoop, event: Event, now_ns: int) -> list[Note]:
    """Hand a recorded event over to the loop, if it came from outside; return the decisions that followed."""
    if event.kind == EventKind.COMMAND:
        name = command_of(event)
        if name == CommandName.DISMISS:
            with suppress(ServiceError):
                return core.loop.dismiss(now_ns, _meant(event))
        if name == CommandName.RESUME:
            core.resume()
        elif name == CommandName.ADOPT and event.data.get("candidate") is True:
            with suppress(ServiceError):
                return core.loop.accept(_meant(event))
    elif event.kind == EventKind.DIAGNOSIS:
        found = data_of(event, DiagnosisData)
        return core.receive(found, now_ns) if found is not None else []
    elif event.kind == EventKind.LOOP:
        data = data_of(event, LoopData)
        if data is not None and data.step in (LoopAction.SHADOW, LoopAction.NOTHING):
            # When a warm-up ends is an input, as a diagnosis is: what follows from it has not begun yet.
            return core.loop.begin()
        if data is not None and data.step == LoopAction.END and data.why == FAILED_OUTSIDE:
            core.loop.give_up_one(data.model_sha256, event.text)
    return []


def _meant(event: Event) -> str:
    """Return the hash of the candidate that an answer was about; empty in recordings without it."""
    sha256 = event.data.get("sha256", "")
    return sha256 if isinstance(sha256, str) else ""


def recorded_loop(contents: Contents, present: ThermalModel, file: str) -> ShadowedLoop | None:
    """Return the loop of a recording in its state at the start of the file; None if it has none.

    Raises
    ------
    CompensatorError
        If its state or the model in shadow cannot be used.
    """
    found = {name: part.data for name, part in contents.attachments.items()}
    if LOOP_STATE not in found:
        return None
    try:
        config, _ = setup_of(contents, file)
        return ShadowedLoop(config, present, found)
    except CompensatorError as error:
        raise DataError(f"{file}: {error}") from error


def decisions_in(step: RecordedStep) -> list[Event]:
    """Return the recorded decisions of the sample of a group, which a replay must make again."""
    seq = step.sample.seq if step.sample is not None else None
    found = []
    for event in step.events:
        data = data_of(event, LoopData) if event.kind == EventKind.LOOP and event.seq == seq else None
        if data is not None and data.step in _DECIDED and data.why != "again":
            found.append(event)
    return found
