"""Prepares another model while the service runs: checks it, warms it up on the recordings, stores it.

All of this runs on a thread of its own that gives way to samples; the swap lies between two samples, see `swap`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from compensator.config import Config
from compensator.errors import CompensatorError, DataError, ModelError, ServiceError
from compensator.events import CommandName
from compensator.model.model_file import parse_model
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, slowest_min
from compensator.service.status import Zero
from compensator.service.transfer.candidate import WARM_UP, ModelCandidate, warm_up
from compensator.service.transfer.model_store import ModelStore, sha256_of

#: Longest payload of a command that brings a model, bytes.
LONGEST_MODEL = 1_000_000
#: Number of samples of a warm-up after which the thread sleeps for a moment, so that it never delays a sample.
SAMPLES_PER_TURN = 10
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


class ModelRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Arguments of the commands `adopt` and `back`.

    Parameters
    ----------
    sha256 : str
        Hash of the model file, empty where the command does not name one.
    model : str
        The model file, empty where it is in the store already.
    force : bool
        Adopt it even where the recordings do not determine its state.
    """

    sha256: str = ""
    model: str = ""
    force: bool = False

    @classmethod
    def of(cls, action: str, arguments: dict[str, Any]) -> ModelRequest:
        """Read the arguments of a command.

        Raises
        ------
        ServiceError
            Saying what was expected.
        """
        try:
            request = msgspec.convert(arguments, cls)
        except msgspec.ValidationError as error:
            expected = "sha256 and model (texts), force (true or false)"
            raise ServiceError(f"{action}: {error}; expected {expected}") from error
        if action == CommandName.ADOPT and not (request.sha256 or request.model):
            raise ServiceError("adopt: expected model, the text of a model file, or sha256, that of one adopted before")
        if request.model and request.sha256 not in ("", found := sha256_of(request.model.encode())):
            raise ServiceError(f"adopt: the model's sha256 is {found}, not {request.sha256}")
        return request


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

    def prepare(
        self, action: str, request: ModelRequest, running: ThermalModel, zero: Zero | None, now_ns: int
    ) -> tuple[bytes, ModelCandidate]:
        """Make a model ready and store it for the next start; this takes a while.

        Parameters
        ----------
        action : {"adopt", "back"}
            Which command.
        request : ModelRequest
            Its arguments.
        running : ThermalModel
            The model in use.
        zero : Zero or None
            The zero in force, None before the first.
        now_ns : int
            Now, ns since 1970 UTC.

        Returns
        -------
        bytes
            The model file.
        ModelCandidate
            Its compensation at the last recorded sample.

        Raises
        ------
        CompensatorError
            Why it is refused, in one line.
        """
        data = self._data(action, request)
        model = check_model(self._config, data, source=f"model {sha256_of(data)[:12]}")
        if model.sha256 == running.sha256:
            raise ServiceError(f"model {model.name} ({model.sha256[:12]}) is the service's model already")
        if model.period_s != running.period_s:
            raise ServiceError(
                f"model {model.name}: sample_period_s = {model.period_s:g}, the service runs at {running.period_s:g} s"
            )
        candidate = self._candidate(model, zero, request.force)
        if action == CommandName.BACK:
            self._store.back(name=model.name, time_utc_ns=now_ns)
        else:
            self._store.adopt(data, name=model.name, time_utc_ns=now_ns)
        return data, candidate

    def _data(self, action: str, request: ModelRequest) -> bytes:
        if action == CommandName.ADOPT:
            return request.model.encode() if request.model else self._store.load(request.sha256)
        before = self._store.before()
        if before is None:
            raise ServiceError("back: the configured model is in use, there is none before it")
        return before

    def _candidate(self, model: ThermalModel, zero: Zero | None, force: bool) -> ModelCandidate:
        if zero is None:
            return ModelCandidate(compensation=Compensation(self._config, model))
        try:
            candidate = warm_up(self._folder, self._config, model, between_samples=_give_way())
        except DataError as error:
            if not force:
                raise ServiceError(f"model {model.name}: no warm-up: {error}; {_ADVICE}") from error
            compensation = Compensation(self._config, model)
            compensation.begin(zero)
            return ModelCandidate(compensation=compensation)
        if not candidate.is_known and not force:
            raise ServiceError(
                f"model {model.name}: the recordings reach back {candidate.minutes / 60.0:.1f} h without a gap, its "
                f"slowest time constant is {slowest_min(model) / 60.0:.1f} h and {WARM_UP:g} of them are wanted; its "
                f"offset would be known to ±{candidate.compensation.status.std_um:.1f} µm only (standard deviation); "
                f"{_ADVICE}"
            )
        return candidate


_ADVICE = "wait, zero the machine at rest, or adopt it nevertheless with --force"


def _give_way() -> Callable[[], None]:
    """Return a function that lets the thread of the service run first, every few samples."""
    count = 0

    def pause() -> None:
        nonlocal count
        count += 1
        if count % SAMPLES_PER_TURN == 0:
            time.sleep(MOMENT_S)

    return pause
