"""The adopted models, stored with the recordings: the one in use, and the previous ones.

An adopted model is used until the configured model is changed: the configuration has precedence.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import UNSET, UnsetType

from compensator.atomic_write import make_folder, replace_file
from compensator.config import Config
from compensator.errors import CompensatorError, ModelError, ServiceError
from compensator.input_file import MODEL_BYTES, RESULT_BYTES, read_file
from compensator.messages import UNREADABLE
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, model_of

_FILE = "adopted.json"


class Adopted(msgspec.Struct, frozen=True, kw_only=True):
    """A change of the model: hash and name of the model from then on, time, command, and whether the loop did it."""

    sha256: str
    name: str
    time_utc_ns: int
    action: Literal["adopt", "back"] = "adopt"
    by: Literal["loop"] | UnsetType = UNSET


class _Contents(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """`adopted.json`: the machine, the models in use, the present one last, and every change.

    Files of version 0.1.0 name no machine.
    """

    schema: Literal[1] = 1
    machine: str | UnsetType = UNSET
    configured_sha256: str
    in_use: list[Adopted] = []
    history: list[Adopted] = []


class _DamagedError(ServiceError):
    """The list of adopted models cannot be read."""


class ModelStore:
    """Models that were adopted for one configuration.

    Parameters
    ----------
    folder : pathlib.Path
        Created with the first model.
    configured : bytes
        The model file that the configuration names.
    machine : str
        Name of the machine: the models of another one are not its own.

    Raises
    ------
    ServiceError
        By any method, if the folder cannot be used; the message names the file.
    """

    def __init__(self, folder: Path, configured: bytes, machine: str) -> None:
        self.folder = folder
        self.configured = configured
        self._machine = machine
        self._configured_sha256 = sha256_of(configured)

    def in_use(self) -> bytes:
        """Return the model file in use."""
        adopted = self._read().in_use
        return self.load(adopted[-1].sha256) if adopted else self.configured

    def before(self) -> bytes:
        """Return the model file to which `back` returns; ServiceError if no model is adopted."""
        adopted = self._read().in_use
        if not adopted:
            raise ServiceError("back: the configured model is in use; no previous model was adopted")
        return self.load(adopted[-2].sha256) if len(adopted) > 1 else self.configured

    def calibrated(self) -> bytes:
        """Return the model file that a person adopted last, or else the configured one."""
        by_person = [one for one in self._read().in_use if one.by is UNSET]
        return self.load(by_person[-1].sha256) if by_person else self.configured

    def has_before(self, sha256: str) -> bool:
        """Return whether `back` would return to the model of a hash."""
        in_use = self._read().in_use
        return bool(in_use) and sha256 == (in_use[-2].sha256 if len(in_use) > 1 else self._configured_sha256)

    def was_gone_back_to(self, sha256: str) -> bool:
        """Return whether the last change was a person's `back` to the model of a hash."""
        last = next(reversed(self._read().history), None)
        return last is not None and (last.sha256, last.action, last.by) == (sha256, "back", UNSET)

    def load(self, sha256: str) -> bytes:
        """Return a model file of the store."""
        if re.fullmatch("[0-9a-f]{64}", sha256) is None:
            raise ServiceError(f"adopted model: sha256 = {sha256[:70]!r}, expected 64 hexadecimal digits")
        path = self.folder / f"{sha256}.toml"
        try:
            data = read_file(path, MODEL_BYTES)
        except OSError as error:
            raise ServiceError(f"{path}: {error.strerror or error}; expected an adopted model") from error
        if sha256_of(data) != sha256:
            raise ServiceError(f"{path}: sha256 {sha256_of(data)}, expected that of its name; the file was changed")
        return data

    def adopt(self, data: bytes, *, name: str, time_utc_ns: int, by_loop: bool = False) -> None:
        """Store a model and use it from now on; a damaged list of adopted models is put aside."""
        try:
            contents = self._read()
        except _DamagedError:
            self._put_aside()
            contents = self._read()
        by: Literal["loop"] | UnsetType = "loop" if by_loop else UNSET
        entry = Adopted(sha256=sha256_of(data), name=name, time_utc_ns=time_utc_ns, by=by)
        contents.in_use.append(entry)
        contents.history.append(entry)
        self._store(f"{entry.sha256}.toml", data)
        self._write(contents)

    def back(self, *, name: str, time_utc_ns: int, by_loop: bool = False) -> None:
        """Return to the previous model; the file of the present one remains."""
        contents = self._read()
        by: Literal["loop"] | UnsetType = "loop" if by_loop else UNSET
        if contents.in_use:
            contents.in_use.pop()
        sha256 = contents.in_use[-1].sha256 if contents.in_use else self._configured_sha256
        contents.history.append(Adopted(sha256=sha256, name=name, time_utc_ns=time_utc_ns, action="back", by=by))
        self._write(contents)

    def go_on_with(self, sha256: str, *, name: str, time_utc_ns: int) -> None:
        """Use the model from before the last change again, which has failed; who had adopted it stays known."""
        contents, was_adopted = self._read(), False
        in_use, history = contents.in_use, contents.history
        if in_use and history and history[-1].action == "adopt":
            was_adopted, _ = True, in_use.pop()
        entry = Adopted(sha256=sha256, name=name, time_utc_ns=time_utc_ns)
        if sha256 != (in_use[-1].sha256 if in_use else self._configured_sha256):
            known = [one for one in history if (one.sha256, one.action) == (sha256, "adopt")]
            in_use.append(known[-1] if known else entry)
        by = in_use[-1].by if in_use else UNSET
        history.append(msgspec.structs.replace(entry, action="back" if was_adopted else "adopt", by=by))
        self._write(contents)

    # ------------------------------------------------------------------ files

    def _read(self) -> _Contents:
        path = self.folder / _FILE
        try:
            contents = msgspec.json.decode(read_file(path, RESULT_BYTES), type=_Contents)
        except FileNotFoundError:
            return _Contents(machine=self._machine, configured_sha256=self._configured_sha256)
        except OSError as error:
            raise ServiceError(f"{path}: {error.strerror or error}") from error
        except UNREADABLE as error:
            raise _DamagedError(f"{path}: {error}; adopt a model, or remove it to use the configured one") from error
        if contents.machine not in (UNSET, self._machine):
            raise ServiceError(
                f"{path}: of machine {contents.machine}, expected {self._machine}: each machine needs a "
                "folder of its own (recording.folder, or model.store)"
            )
        contents.machine = self._machine
        if contents.configured_sha256 != self._configured_sha256:
            contents.configured_sha256, contents.in_use = self._configured_sha256, []
        return contents

    def _put_aside(self) -> None:
        path = self.folder / _FILE
        try:
            path.replace(path.with_suffix(".damaged"))
        except OSError as error:
            raise ServiceError(f"{path}: {error.strerror or error}; the model is not stored") from error

    def _write(self, contents: _Contents) -> None:
        self._store(_FILE, msgspec.json.format(msgspec.json.encode(contents)))

    def _store(self, name: str, data: bytes) -> None:
        path = self.folder / name
        try:
            # `adopt` by root, beside a service that is stopped.
            owner = make_folder(self.folder)
            replace_file(path, data, mode=0o644, owner=owner)
        except OSError as error:
            raise ServiceError(f"{path}: {error.strerror or error}; the model is not stored") from error


def sha256_of(data: bytes) -> str:
    """Return the hash of a model file."""
    return hashlib.sha256(data).hexdigest()


def check_model(config: Config, data: bytes, *, source: str) -> ThermalModel:
    """Read a model file and check that the service of a configuration can run it.

    Raises
    ------
    ModelError
        If the file, its dynamics, a channel that it needs, or its period is wrong; the message is one line.
    """
    try:
        model = model_of(config, data, source=source)
        Compensation(config, model)
    except CompensatorError as error:
        text = str(error)
        raise ModelError(text if text.startswith(f"{source}: ") else f"{source}: {text}") from error
    if config.sampling.polls_of(model.period_s) is None:
        raise ModelError(
            f"{source}: sample_period_s = {model.period_s:g}, "
            f"expected a whole multiple of sampling.poll_interval_s = {config.sampling.poll_interval_s:g}"
        )
    return model
