"""Faults that a test switches on and off while the simulated device is running.

Faults of a device act on the transmitted bytes, faults of an input on the value that the device
measures there.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from types import MappingProxyType

DEVICE_FAULTS = frozenset(
    {
        "silence",
        "exception",
        "garbage",
        "bad_crc",
        "wrong_length",
        "truncate",
        "late",
        "disconnect",
        "split",
        "join",
        "stale_counter",
        "gap",
    }
)
INPUT_FAULTS = frozenset({"open", "over", "under", "frozen", "wild"})
REQUIRED = {"late": "delay_s", "wild": "value"}

Parameters = Mapping[str, object]
_NONE: Parameters = MappingProxyType({})


class Faults:
    """Hold the faults of one device or line.

    May be used from any thread. `set` and `clear` return when the device's server has applied the change, so that
    it affects the next request.

    Examples
    --------
    >>> faults = Faults()
    >>> faults.set("open", input=2)
    >>> faults.set("silence", times=1)
    >>> faults.of_input(2)
    {'open': mappingproxy({})}
    >>> faults.use("silence") is not None, faults.use("silence") is not None
    (True, False)
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Replaced, never changed in place: the server thread reads without the lock.
        self._device: dict[str, Parameters] = {}
        self._inputs: dict[int, dict[str, Parameters]] = {}
        self._supported = DEVICE_FAULTS | INPUT_FAULTS
        self._listeners: list[Callable[[], None]] = []

    def set(self, fault: str, *, input: int | None = None, **parameters: object) -> None:  # noqa: A002
        """Switch a fault on.

        Parameters
        ----------
        fault : str
            A name of `DEVICE_FAULTS`, or of `INPUT_FAULTS` together with `input`.
        input : int, optional
            Number of the input, as the module counts its inputs.
        **parameters
            `code` of "exception"; `delay_s` of "late" (s); `value` of "wild" (the input's unit); `frames` of
            "gap"; `pieces` and `pause_s` of "split" (s). Every fault of a device also takes `times`: the
            number of replies after which it is cleared automatically.

        Raises
        ------
        ValueError
            If the fault is unknown, does not exist on this kind of line, or lacks its parameter.
        """
        known = DEVICE_FAULTS if input is None else INPUT_FAULTS
        if fault not in known:
            where = "a device" if input is None else "an input"
            raise ValueError(f"no fault {fault!r} of {where}: {', '.join(sorted(known))}")
        if fault not in self._supported:
            raise ValueError(f"fault {fault!r} does not exist on this device: {', '.join(sorted(self._supported))}")
        needed = REQUIRED.get(fault)
        if needed is not None and needed not in parameters:
            raise ValueError(f"fault {fault!r} needs {needed}=")
        frozen = MappingProxyType(dict(parameters))
        with self._lock:
            if input is None:
                self._device = {**self._device, fault: frozen}
            else:
                self._inputs = {**self._inputs, input: {**self._inputs.get(input, {}), fault: frozen}}
        self._tell()

    def clear(self, fault: str | None = None, *, input: int | None = None) -> None:  # noqa: A002
        """Switch one fault off, or all of them.

        Without arguments everything is cleared; with `input` only, all faults of that input; with `fault`
        only, that fault of the device.
        """
        with self._lock:
            if input is not None:
                left = {} if fault is None else dict(self._inputs.get(input, {}))
                left.pop(fault or "", None)
                self._inputs = {k: v for k, v in {**self._inputs, input: left}.items() if v}
            elif fault is not None:
                self._device = {k: v for k, v in self._device.items() if k != fault}
            else:
                self._device, self._inputs = {}, {}
        self._tell()

    @property
    def any_of_device(self) -> bool:
        """Whether any fault of the whole device is on."""
        return bool(self._device)

    def active(self, fault: str) -> bool:
        """Return whether a fault of the whole device is on, without counting a reply of its `times`."""
        return fault in self._device

    def use(self, fault: str) -> Parameters | None:
        """Return the parameters of a fault of the device if it is on, and count one reply of its `times`."""
        parameters = self._device.get(fault)
        if parameters is None or "times" not in parameters:
            return parameters
        left = _integer(parameters["times"]) - 1
        with self._lock:
            rest = {k: v for k, v in self._device.items() if k != fault}
            self._device = {**rest, fault: MappingProxyType({**parameters, "times": left})} if left > 0 else rest
        return parameters

    def of_input(self, number: int) -> Mapping[str, Parameters]:
        """Return the faults of one input."""
        return self._inputs.get(number, {})

    def restrict(self, supported: frozenset[str]) -> None:
        """Accept only the given faults of the device from now on (those that exist on its line).

        Raises
        ------
        ValueError
            If one that is on already is not among them.
        """
        alien = self._device.keys() - supported
        if alien:
            raise ValueError(f"fault {', '.join(sorted(alien))} does not exist on this line")
        self._supported = supported | INPUT_FAULTS

    def listen(self, listener: Callable[[], None]) -> None:
        """Call `listener` after each change, in the thread that made it."""
        self._listeners.append(listener)

    def _tell(self) -> None:
        for listener in tuple(self._listeners):
            listener()


class Layers:
    """The faults of a line and of a device on it as one.

    Parameters
    ----------
    *faults : Faults
        The first that has a fault on decides its parameters.
    """

    __slots__ = ("_faults",)

    def __init__(self, *faults: Faults) -> None:
        self._faults = faults

    @property
    def quiet(self) -> bool:
        """Whether no fault of a device is on."""
        return not any(each.any_of_device for each in self._faults)

    def use(self, fault: str) -> Parameters | None:
        """Return the parameters of a fault that is on, else None; see `Faults.use`."""
        for each in self._faults:
            parameters = each.use(fault)
            if parameters is not None:
                return parameters
        return None


def number(parameters: Parameters, key: str, default: float) -> float:
    """Return a numeric parameter of a fault."""
    value = parameters.get(key, default)
    if not isinstance(value, (int, float)):
        raise TypeError(f"{key} must be a number, not {value!r}")
    return float(value)


def _integer(value: object) -> int:
    if not isinstance(value, int):
        raise TypeError(f"times must be a whole number, not {value!r}")
    return value
