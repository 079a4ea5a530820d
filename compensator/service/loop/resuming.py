"""The loop at the start of the service: continues from the end of the last recording.

The last file is replayed with its own configuration and model, as the compensation is. After a kill between storing a
model and the sample with it, the exchange is completed here. If a person has changed configuration or model, or the
loop has been off, the shadow ends; what was gone back from or dismissed stays known. A stored model whose exchange was
not completed has the level that was decided for it, whatever was changed.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from compensator.clock import HOUR_NS
from compensator.config import Config, LoadedConfig
from compensator.errors import CompensatorError, DataError
from compensator.events import Note
from compensator.model.effects.names import effect_names
from compensator.recording.container import Container
from compensator.recording.naming import began_ns
from compensator.recording.reading import recordings
from compensator.service.compensation import Compensation, Outcome
from compensator.service.loop.core import LOOP_STATE, ShadowedLoop
from compensator.service.loop.replaying import hand_over_all, recorded_loop
from compensator.service.loop.storing import calibrated_effects
from compensator.service.replay import apply, opening_of, setup_of, steps_in
from compensator.service.transfer.model_store import ModelStore
from compensator.service.transfer.restart import Resumed
from compensator.service.transfer.warm_up import usable_steps

log = logging.getLogger("compensator")


@dataclass(slots=True)
class _Replayed:
    """The last recording with a loop, at its end."""

    core: ShadowedLoop
    compensation: Compensation
    config: bytes
    model: bytes
    #: Whether it is the very last recording; otherwise the loop has been off since then.
    is_last: bool


def resume_loop(loaded: LoadedConfig, resumed: Resumed, store: ModelStore) -> ShadowedLoop | None:
    """Return the loop in its state at the end of the last recording, None without `[loop]`.

    After an interrupted exchange `resumed` gets the compensation that continues from the one before; events are added
    to its notes.
    """
    config = loaded.config
    if config.loop is None or not config.loop.is_on:
        return None
    return _continued(loaded, resumed, store)


def _continued(loaded: LoadedConfig, resumed: Resumed, store: ModelStore) -> ShadowedLoop:
    config, present = loaded.config, resumed.compensation
    calibrated = calibrated_effects(config, store, effect_names(present.model.effects))
    try:
        last = _replayed(config, loaded.resolve(config.recording.folder))
    except CompensatorError as error:
        resumed.note(f"the loop starts again without its state: {error}")
        last = None
    except Exception as error:
        # No defect of the loop may keep the service from starting.
        log.exception("internal error of the loop at the start")
        resumed.note(f"the loop starts again without its state: internal error: {type(error).__name__}: {error}")
        last = None
    if last is None:
        core = ShadowedLoop(config, present.model, {})
        core.state.base_effects = list(calibrated)
        return core
    core = last.core
    core.state.missing = 0  # how long the service has been away is known from the last sample on
    is_stored = core.incoming is not None and core.incoming.compensation.model.sha256 == present.model.sha256
    if last.config == loaded.data and last.is_last:
        if last.compensation.model.sha256 == present.model.sha256:
            resumed.notes += core.loop.restarted()
            return core
        if is_stored:
            resumed.notes += _complete(resumed, last)
            return core
    if is_stored and last.is_last:
        present.raise_level(core.state.level_um)  # no zero was set since the decision
    effects, now_ns = effect_names(present.model.effects), present.status.time_utc_ns
    if not last.is_last:
        # No clock was set while it was off, and nothing that it counts went on.
        core.state.time_utc_ns, core.state.misfit_min, core.state.usable_min = now_ns, 0.0, 0.0
    back = last.compensation.model.sha256 != present.model.sha256 and _is_gone_back_to(store, present)
    resumed.notes += core.loop.model_changed(effects, now_ns, calibrated=calibrated, back=back)
    core.drop_ended()
    return ShadowedLoop(config, present.model, core.attachments())


def _is_gone_back_to(store: ModelStore, present: Compensation) -> bool:
    """Return whether a person has gone back to the present model, without the service or just before its end."""
    try:
        return store.was_gone_back_to(present.model.sha256)
    except CompensatorError as error:
        log.error("the changes of the model cannot be read: %s", error)
        return False


def _complete(resumed: Resumed, last: _Replayed) -> list[Note]:
    """Complete an exchange whose model is stored already."""
    old, published = last.compensation, resumed.compensation.status.handover
    # What was published while the disk failed is not in the recording: the offset, and whether it is held.
    old.take_offsets(published.offset_um, published.further)
    old.take_holds(operator_hold=published.operator_hold, internal_error=published.internal_error)
    resumed.compensation, _, notes = last.core.exchange(old, last.model, old.status.time_utc_ns)
    return notes


def _replayed(config: Config, folder: Path) -> _Replayed | None:
    """Replay the last recording with a loop, unless that is so old that nothing it knew counts any longer."""
    machine, is_last = config.machine.name, True
    assert config.loop is not None
    newest_ns: int | None = None
    for path in reversed(recordings(folder, machine)):
        try:
            opening = opening_of(path)
        except DataError:
            continue  # it has the name of a recording and is none
        if "state.json" not in opening:
            continue
        newest_ns = newest_ns or began_ns(path, machine)
        if began_ns(path, machine) < newest_ns - config.loop.watch_h * HOUR_NS:
            return None
        if LOOP_STATE not in opening:
            # One that ends within its opening says nothing of the loop: the service was killed as it began the file.
            is_last = is_last and next(usable_steps(path), None) is None
            continue
        with Container(path) as container:
            contents = container.survey(whole=False)
            compensation = Compensation(*setup_of(contents, path.name))
            compensation.restore(opening["state.json"])
            core = recorded_loop(contents, compensation.model, path.name)
            assert core is not None
            for step in steps_in(container):
                hand_over_all(core, step, compensation.status.time_utc_ns)
                outcome = apply(compensation, step)
                if isinstance(outcome, Outcome):
                    core.process(outcome)
        return _Replayed(core, compensation, opening["config.toml"], opening["model.toml"], is_last)
    return None
