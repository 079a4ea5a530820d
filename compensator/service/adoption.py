"""Prepares another model while the service runs: checks it, warms it up on the recordings, stores it.

All of this runs on a thread of its own that yields to samples; the swap itself lies between two samples and is the
daemon's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compensator.config import Config
from compensator.errors import CompensatorError, DataError, ModelError, ServiceError
from compensator.events import CommandName
from compensator.messages import Sample
from compensator.model.model_file import parse_model
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation
from compensator.service.model_store import ModelStore, sha256_of
from compensator.service.state import ZeroMode
from compensator.service.warm_up import WARM_UP, WarmUp, warm_up

#: Longest payload of a command that brings a model, bytes.
LONGEST_MODEL = 1_000_000
#: Number of samples of a warm-up after which the thread sleeps for a moment, so that it never delays a sample.
LET_OTHERS = 10
MOMENT_S = 0.001


def check_model(config: Config, data: bytes, *, source: str) -> ThermalModel:
    """Read a model file and check that the service of a configuration can run it.

    Raises
    ------
    ModelError
        One line that names what is wrong: the file, its dynamics, a channel that it needs, its period.
    """
    model = parse_model(data, source=source)
    try:
        if config.model.alternative:
            model = model.with_alternative(config.model.alternative)
        Compensation(config, model)
    except CompensatorError as error:
        raise ModelError(f"{source}: {error}") from error
    polls = model.period_s / config.sampling.poll_interval_s
    if abs(polls - round(polls)) > 1e-9 or polls < 1:
        raise ModelError(
            f"{source}: sample_period_s = {model.period_s:g}, "
            f"expected a whole multiple of sampling.poll_interval_s = {config.sampling.poll_interval_s:g}"
        )
    return model


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What a command asks for.

    Parameters
    ----------
    action : {"adopt", "back"}
        Which command.
    sha256 : str
        Hash of the model file, empty where the command does not name one.
    text : str
        The model file, empty where it is in the store already.
    force : bool
        Adopt it even where the recordings do not determine its state.
    """

    action: str
    sha256: str = ""
    text: str = ""
    force: bool = False

    @classmethod
    def of(cls, action: str, arguments: dict[str, Any]) -> Wanted:
        """Read the arguments of a command.

        Raises
        ------
        ServiceError
            Saying what was expected.
        """
        known = {"sha256": str, "model": str, "force": bool}
        for key, value in arguments.items():
            if key not in known or not isinstance(value, known[key]):
                expected = "sha256 and model (texts), force (true or false)"
                raise ServiceError(f"{action}: {key!r} = {str(value)[:40]!r}, expected {expected}")
        wanted = cls(
            action=action,
            sha256=arguments.get("sha256", ""),
            text=arguments.get("model", ""),
            force=arguments.get("force", False),
        )
        if action == CommandName.ADOPT and not (wanted.sha256 or wanted.text):
            raise ServiceError("adopt: expected model, the text of a model file, or sha256, that of one adopted before")
        if wanted.text and wanted.sha256 and sha256_of(wanted.text.encode()) != wanted.sha256:
            raise ServiceError(f"adopt: the model's sha256 is {sha256_of(wanted.text.encode())}, not {wanted.sha256}")
        return wanted


@dataclass(frozen=True, slots=True, kw_only=True)
class Prepared:
    """A model that is ready to be adopted.

    Parameters
    ----------
    data : bytes
        The model file.
    warm : WarmUp
        Its compensation at the last recorded sample.
    """

    data: bytes
    warm: WarmUp

    def catch_up(self, sample: Sample, zero: ZeroMode | None) -> None:
        """Run a sample that came during the warm-up; one that is in the recording is left out."""
        compensation = self.warm.compensation
        seq, _ = compensation.last
        if sample.seq <= seq:
            return
        if seq >= 0:
            # Numbers between were not on disk in time for the warm-up.
            compensation.pause(sample.seq - seq - 1)
        if zero is not None:
            compensation.zero(zero)
        compensation.process(sample)


class Adoption:
    """Prepares models for the service of one configuration.

    Parameters
    ----------
    config : Config
        Settings.
    folder : pathlib.Path
        Recordings.
    store : ModelStore
        Where adopted models are kept.
    """

    def __init__(self, config: Config, folder: Path, store: ModelStore) -> None:
        self._config = config
        self._folder = folder
        self._store = store

    def prepare(self, wanted: Wanted, running: ThermalModel, zero: dict[str, float] | None, now_ns: int) -> Prepared:
        """Make the model ready and store it for the next start; this takes a while.

        Parameters
        ----------
        wanted : Wanted
            What is asked for.
        running : ThermalModel
            The model in use.
        zero : dict or None
            The zero in force, None before the first.
        now_ns : int
            Now, ns since 1970 UTC.

        Raises
        ------
        CompensatorError
            Why it is refused, in one line.
        """
        data = self._data(wanted)
        model = check_model(self._config, data, source=f"model {sha256_of(data)[:12]}")
        if model.sha256 == running.sha256:
            raise ServiceError(f"model {model.name} ({model.sha256[:12]}) is the service's model already")
        if model.period_s != running.period_s:
            raise ServiceError(
                f"model {model.name}: sample_period_s = {model.period_s:g}, the service runs at {running.period_s:g} s"
            )
        prepared = Prepared(data=data, warm=self._warmed(model, zero, wanted.force))
        if wanted.action == CommandName.BACK:
            self._store.back(name=model.name, time_utc_ns=now_ns)
        else:
            self._store.adopt(data, name=model.name, time_utc_ns=now_ns)
        return prepared

    def _data(self, wanted: Wanted) -> bytes:
        if wanted.action == CommandName.ADOPT:
            return wanted.text.encode() if wanted.text else self._store.load(wanted.sha256)
        before = self._store.before()
        if before is None:
            raise ServiceError("back: the configured model is in use, there is none before it")
        return before

    def _warmed(self, model: ThermalModel, zero: dict[str, float] | None, force: bool) -> WarmUp:
        if zero is None:
            compensation = Compensation(self._config, model)
            return WarmUp(compensation=compensation, samples=0, minutes=0.0, known=True)
        try:
            warm = warm_up(self._folder, self._config, model, let_others=_let_others())
        except DataError as error:
            if not force:
                raise ServiceError(f"model {model.name}: no warm-up: {error}; {_ADVICE}") from error
            compensation = Compensation(self._config, model)
            compensation.begin(**zero)
            return WarmUp(compensation=compensation, samples=0, minutes=0.0, known=False)
        if not warm.known and not force:
            slowest = warm.compensation.slowest_min
            raise ServiceError(
                f"model {model.name}: the recordings reach back {warm.minutes / 60.0:.1f} h without a gap, its slowest "
                f"time constant is {slowest / 60.0:.1f} h and {WARM_UP:g} of them are wanted; its offset would be "
                f"known to ±{warm.compensation.std_um:.1f} µm only (standard deviation); {_ADVICE}"
            )
        return warm


_ADVICE = "wait, zero the machine at rest, or adopt it nevertheless with --force"


def _let_others() -> Callable[[], None]:
    """Return a function that lets the thread of the service run first, every few samples."""
    count = 0

    def pause() -> None:
        nonlocal count
        count += 1
        if count % LET_OTHERS == 0:
            time.sleep(MOMENT_S)

    return pause
