"""A diagnosis that has ended, and its candidate while it is warmed up on the recordings."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from pathlib import Path

from compensator.clock import NS, Clock
from compensator.config import Config
from compensator.errors import CompensatorError
from compensator.service.compensation import Compensation, Outcome, model_of
from compensator.service.loop.core import ShadowedLoop
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.process import Diagnose
from compensator.service.loop.state import Running
from compensator.service.loop.weighing import Weighed, failed, without_effect
from compensator.service.transfer.model_store import ModelStore
from compensator.service.transfer.shadow import Shadow
from compensator.service.transfer.turns import give_way
from compensator.service.transfer.warm_up import warm_up

log = logging.getLogger("compensator")


@dataclass(slots=True)
class Found:
    """A diagnosis that has ended; and its candidate once it is warmed up, with its errors on the record.

    Parameters
    ----------
    wanted : Running
        What was diagnosed.
    weighed : Weighed
        The diagnosis, and what follows from it.
    text : str
        One sentence for people.
    warmed : tuple of Compensation and ErrorBlocks, optional
        The candidate once it is warmed up.
    since : list of Outcome
        Live samples since the warm-up began.
    why : str
        Why the candidate cannot be used; empty if it can.
    """

    wanted: Running
    weighed: Weighed
    text: str
    warmed: tuple[Compensation, ErrorBlocks] | None = None
    since: list[Outcome] = field(default_factory=list)
    why: str = ""

    async def warm_up(self, recordings: Path, config: Config, data: bytes) -> None:
        """Warm the candidate up; `why` says why it cannot be."""

        def warmed() -> tuple[Compensation, ErrorBlocks]:
            model = model_of(config, data, source="candidate")
            error = ErrorBlocks()
            ready = warm_up(recordings, config, model, between_samples=give_way(), probes=True, seen=error.update)
            return ready.compensation, error

        try:
            self.warmed = await asyncio.to_thread(warmed)
        except CompensatorError as error:
            self.why = f"the candidate cannot be warmed up: {error}"
        except Exception as error:
            log.exception("internal error in a warm-up")
            self.why = _internal(error)

    def catch_up(self) -> tuple[Compensation, ErrorBlocks] | None:
        """Return the candidate in its state after the last sample; None if it is not warmed up, or cannot be used."""
        if self.warmed is None or self.why:
            return None
        compensation, errors = self.warmed
        shadow = Shadow(compensation, b"")
        try:
            for outcome in self.since:
                followed = shadow.follow(outcome)
                if followed is not None:
                    errors.update(followed)
        except Exception as error:
            # What runs in shadow already goes on.
            log.exception("internal error in a warm-up")
            self.why = _internal(error)
            return None
        self.since.clear()
        return compensation, errors


async def diagnosed(core: ShadowedLoop, present: bytes, diagnose: Diagnose, store: ModelStore, clock: Clock) -> Found:
    """Make the diagnosis that the loop wants; what goes wrong is a diagnosis that failed.

    `present` is the file of the present model: it may be wanted without one of its effects.
    """
    wanted = core.loop.wanted
    assert wanted is not None
    began_ns = clock.utc_ns()
    try:
        calibrated = await asyncio.to_thread(store.calibrated)
        if wanted.without:
            found = without_effect(present, wanted.without, calibrated=calibrated)
        else:
            found = await diagnose(wanted, calibrated)
        weighed = await asyncio.to_thread(core.weigh, found, calibrated=calibrated)
    except CompensatorError as error:
        found = failed(str(error), without=wanted.without)
        weighed = core.plain(found)
    except Exception as error:
        log.exception("internal error of a diagnosis")
        found = failed(f"internal error: {type(error).__name__}: {error}", without=wanted.without)
        weighed = core.plain(found)
    return Found(wanted, weighed.lasting((clock.utc_ns() - began_ns) / NS), found.text)


def _internal(error: Exception) -> str:
    return f"internal error in the warm-up of the candidate: {type(error).__name__}: {error}"
