"""One published offset, every key checked: a message with any error is dropped with a reason."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from .reasons import Reason, printable

#: Version of the messages that this receiver understands.
SCHEMA = 1
#: Longest payload, bytes; an offset has about 300.
PAYLOAD_MAX_BYTES = 65_536
#: Largest number of a message, ten samples a second for 300 years, and latest time, in 2262.
SEQ_MAX, TIME_MAX_NS = 100_000_000_000, 2**63 - 1
#: Axes and angles that a service may publish besides Y.
FURTHER = ("x", "z", "a", "b")
_STATES = ("starting", "ok", "degraded", "hold", "fault")
#: States of which a receiver follows the offset.
USABLE = ("ok", "degraded")
#: Most codes in a message: one for each channel that effects use, and those of the service; and their length.
CODES_MAX, _CODE_LENGTH = 150, 200


class Rejected(Exception):
    """A message that must not be used.

    Parameters
    ----------
    reason : Reason
        Why the message must not be used.
    """

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason.text)
        self.reason = reason


@dataclass(frozen=True, slots=True, kw_only=True)
class OffsetMessage:
    """A checked offset.

    Parameters
    ----------
    machine : str
        Machine that published it.
    seq : int
        Never repeats for a machine.
    time_utc_ns : int
        Time of the measurement, ns since 1970 UTC.
    valid_for_s : float
        Time for which it may be used, s.
    y_offset_um : float or None
        To be added to the commanded Y, µm; a number whenever the state is `ok` or `degraded`.
    y_offset_rate_um_per_min : float
        Rate until the next offset, µm/min; 0 where none is known.
    state : str
        `starting`, `ok`, `degraded`, `hold` or `fault`.
    reasons : tuple of str
        The service's codes.
    unused : tuple of Reason
        What the service publishes besides and a receiver of Y alone does not apply.
    """

    machine: str
    seq: int
    time_utc_ns: int
    valid_for_s: float
    y_offset_um: float | None
    y_offset_rate_um_per_min: float
    state: str
    reasons: tuple[str, ...]
    unused: tuple[Reason, ...] = ()

    @property
    def usable(self) -> bool:
        """Whether a receiver may follow it."""
        return self.state in USABLE


def parse_offset(payload: bytes) -> OffsetMessage:
    """Decode and check a payload; unknown keys are ignored.

    Raises
    ------
    Rejected
        `malformed` or `other_schema`.
    """
    table = decode(payload)
    head = header_of(table)
    offset_um, rate = value_of(table, "y_offset", "um")
    return OffsetMessage(
        y_offset_um=offset_um,
        y_offset_rate_um_per_min=rate,
        unused=_unused(table),
        **head,
        **number_of(table),
    )


def _unused(table: dict[str, Any]) -> tuple[Reason, ...]:
    """Return what the message says of further axes and of a slope, as far as it says it as a service does."""
    axes = table.get("axes")
    known = axes if isinstance(axes, list) and len(axes) <= len(FURTHER) + 1 else []
    further = [axis for axis in FURTHER if axis in known]
    found = [Reason("further_axes", ", ".join(further))] if further else []
    if table.get("y_slope_um_per_m") is not None:
        found.append(Reason("slope_not_applied"))
    return tuple(found)


def header_of(table: dict[str, Any]) -> dict[str, Any]:
    """Check what every offset has but its number, and return it by the names of the fields of a message.

    Raises
    ------
    Rejected
        As `parse_offset`.
    """
    check_schema(table)
    state = table.get("state")
    if state not in _STATES:
        raise malformed("state", state, f"one of {', '.join(_STATES)}")
    machine = table.get("machine")
    if not isinstance(machine, str) or not machine:
        raise malformed("machine", machine, "a name")
    reasons = table.get("reasons")
    if not isinstance(reasons, list) or len(reasons) > CODES_MAX or not all(map(_is_code, reasons)):
        raise malformed("reasons", reasons, f"a list of at most {CODES_MAX} codes")
    return {
        "machine": machine,
        "valid_for_s": seconds(table),
        "state": state,
        "reasons": tuple(reasons),
    }


def number_of(table: dict[str, Any]) -> dict[str, Any]:
    """Return number and time of a message by the names of its fields."""
    return {"seq": integer(table, "seq", SEQ_MAX), "time_utc_ns": integer(table, "time_utc_ns")}


def seconds(table: dict[str, Any]) -> float:
    """Return `valid_for_s`, above 0."""
    valid_for_s = number(table, "valid_for_s")
    if valid_for_s is None or valid_for_s <= 0.0:
        raise malformed("valid_for_s", valid_for_s, "seconds above 0")
    return valid_for_s


def value_of(table: dict[str, Any], name: str, unit: str) -> tuple[float | None, float]:
    """Return a published value and its rate; the value is a number in every state that is followed.

    Parameters
    ----------
    table : dict
        A decoded message.
    name, unit : str
        Such as `y_offset` and `um`.

    Raises
    ------
    Rejected
        `malformed`.
    """
    value, rate = number(table, f"{name}_{unit}"), number(table, f"{name}_rate_{unit}_per_min")
    if value is None and table.get("state") in USABLE:
        raise malformed(f"{name}_{unit}", None, f"a number in state {table['state']}")
    std = number(table, f"{name}_std_{unit}")
    if std is not None and std < 0.0:
        raise malformed(f"{name}_std_{unit}", std, "0 or more")
    return value, rate or 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeWanted:
    """What the status of a service with touch probes says about the next one.

    Parameters
    ----------
    wanted : bool
        Whether a probe is wanted now.
    by_utc_ns : int or None
        When one will be wanted, ns since 1970 UTC; None if this is not foreseen.
    std_um, tolerance_um : float or None
        The standard deviation that asks for it, and what it is compared with, µm; None if not known.
    """

    wanted: bool
    by_utc_ns: int | None
    std_um: float | None
    tolerance_um: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusMessage:
    """A checked status, as far as a control needs it.

    Parameters
    ----------
    time_utc_ns : int
        Time of the sample, ns since 1970 UTC.
    wanted : ProbeWanted or None
        What it says about probes; None for a service without probes.
    """

    time_utc_ns: int
    wanted: ProbeWanted | None


def parse_status(payload: bytes, machine: str) -> StatusMessage:
    """Decode a status and check what it says about probes.

    Raises
    ------
    Rejected
        `malformed`, `other_schema` or `other_machine`.
    """
    table = decode(payload)
    check_schema(table)
    if table.get("machine") != machine:
        raise Rejected(Reason("other_machine", f"{_shown(table.get('machine'))}, expected {machine}"))
    return StatusMessage(time_utc_ns=integer(table, "time_utc_ns"), wanted=_wanted(table))


def _wanted(table: dict[str, Any]) -> ProbeWanted | None:
    wanted = table.get("probe_wanted")
    if wanted is None:
        return None
    if not isinstance(wanted, bool):
        raise malformed("probe_wanted", wanted, "true or false")
    optional = {"wanted_std_um": None, "wanted_tolerance_um": None} | table
    return ProbeWanted(
        wanted=wanted,
        by_utc_ns=None if table.get("wanted_by_ns") is None else integer(table, "wanted_by_ns"),
        std_um=number(optional, "wanted_std_um"),
        tolerance_um=number(optional, "wanted_tolerance_um"),
    )


def decode(payload: bytes) -> dict[str, Any]:
    """Return a JSON object.

    Raises
    ------
    Rejected
        `malformed`.
    """
    if len(payload) > PAYLOAD_MAX_BYTES:
        raise Rejected(Reason("malformed", f"{len(payload)} bytes, expected at most {PAYLOAD_MAX_BYTES}"))
    try:
        table = json.loads(payload.decode("utf-8"), parse_constant=_no_constant, object_pairs_hook=_pairs)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise Rejected(Reason("malformed", f"not JSON: {error}")) from error
    if not isinstance(table, dict):
        raise Rejected(Reason("malformed", "not a JSON object"))
    return table


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def _pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse a key that occurs twice, which is ambiguous."""
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key occurs twice")
    return table


def check_schema(table: dict[str, Any]) -> None:
    """Check the version of a message.

    Raises
    ------
    Rejected
        `other_schema`.
    """
    if integer(table, "schema") != SCHEMA:
        raise Rejected(Reason("other_schema", f"schema {table['schema']}, expected {SCHEMA}"))


def _is_code(value: object) -> bool:
    return isinstance(value, str) and len(value) <= _CODE_LENGTH and value.isprintable()


def malformed(key: str, value: object, expected: str) -> Rejected:
    """Return the error for a key."""
    return Rejected(Reason("malformed", f"{key} = {_shown(value)}, expected {expected}"))


def _shown(value: object) -> str:
    """Return a value as a reason quotes it; what is nested may be nested too deeply for that."""
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "an object"
    return printable(str(value), 40)


def integer(table: dict[str, Any], key: str, most: int = TIME_MAX_NS) -> int:
    """Return a whole number, 0 or more."""
    value = table.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
        raise malformed(key, value, "a whole number")
    return value


def number(table: dict[str, Any], key: str) -> float | None:
    """Return a finite number, or None for null; a missing key or any other value is an error."""
    value = table.get(key, "missing")
    if value is None:
        return None
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise malformed(key, value, "a number or null")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise malformed(key, value, "a finite number")
    return number
