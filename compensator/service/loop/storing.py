"""Stores the models of the loop's exchanges for the next start, as a task beside the samples."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence

from compensator.clock import Clock
from compensator.config import Config
from compensator.errors import CompensatorError, ServiceError
from compensator.model.effects.names import effect_names
from compensator.service.compensation import model_of
from compensator.service.loop.core import ShadowedLoop
from compensator.service.transfer.model_store import ModelStore, sha256_of

log = logging.getLogger("compensator")


def calibrated_effects(config: Config, store: ModelStore, present: Sequence[str]) -> Sequence[str]:
    """Return the effects of the model that a person decided on last; those of the present one if it cannot be read."""
    try:
        return effect_names(model_of(config, store.calibrated(), source="calibrated model").effects)
    except CompensatorError as error:
        log.error("the calibrated model cannot be read: %s", error)
        return present


class Storing:
    """One model at a time; used in the service's loop only.

    Parameters
    ----------
    store : ModelStore
        Adopted models.
    clock : Clock
        Of the service.
    """

    def __init__(self, store: ModelStore, clock: Clock) -> None:
        self._store, self._clock = store, clock
        self._task: asyncio.Task[None] | None = None
        #: Whether the model of a decided exchange is stored, and why it was not.
        self.is_done = False
        self.refused = ""

    @property
    def is_working(self) -> bool:
        """Whether a model is being stored."""
        return self._task is not None

    def begin(self, core: ShadowedLoop) -> None:
        """Store the model in shadow that replaces the present one; then it is used from the next sample on."""
        action, shadow = core.state.exchange, core.incoming
        assert shadow is not None
        model, now_ns = shadow.compensation.model, self._clock.utc_ns()

        def store() -> None:
            if action == "back" and self._store.has_before(model.sha256):
                self._store.back(name=model.name, time_utc_ns=now_ns, by_loop=True)
            else:
                self._store.adopt(shadow.data, name=model.name, time_utc_ns=now_ns, by_loop=True)

        self._task = asyncio.create_task(self._stored(store))

    def begin_again(self, model: bytes, name: str) -> None:
        """Store the present model again, after another one was stored that has not replaced it."""
        self.is_done = False
        now_ns = self._clock.utc_ns()

        def store() -> None:
            self._store.go_on_with(sha256_of(model), name=name, time_utc_ns=now_ns)

        self._task = asyncio.create_task(self._stored(store, again=True))

    def cancel(self) -> None:
        """Forget what is being stored, and what was."""
        if self._task is not None:
            self._task.cancel()
        self._task = None
        self.is_done, self.refused = False, ""

    async def end(self) -> None:
        """Wait for what is being stored."""
        if self._task is not None:
            await asyncio.gather(self._task, return_exceptions=True)

    async def _stored(self, store: Callable[[], None], *, again: bool = False) -> None:
        try:
            await asyncio.to_thread(store)
            self.is_done = not again
        except ServiceError as error:
            self._refuse(str(error), again=again)
        except Exception as error:
            log.exception("internal error while a model is stored")
            self._refuse(f"the model is not stored: internal error: {type(error).__name__}: {error}", again=again)
        self._task = None

    def _refuse(self, why: str, *, again: bool) -> None:
        if again:
            log.error("the next start uses another model: %s", why)
        else:
            self.refused = why
