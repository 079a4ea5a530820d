"""Payloads of every form that a topic can carry, from a random generator: anything but a list of known ones."""

from __future__ import annotations

import json
import random

from tests.fuzz.mutation import mutated
from tests.receiver.offsets import MACHINE, T0_NS, axis_offset, offset, slope

#: Numbers at which programs fail.
_EDGES = (0, 1, -1, 2**31, 2**53, 2**63 - 1, 2**63, 2**64, 10**18, 10**11, 10**12)
_TEXTS = ("", MACHINE, "ok", "degraded", "hold", "fault", "starting", "\ud800", "\x1b[2J", "\n", "µ∞", "a" * 500)
_KEYS = ("schema", "machine", "seq", "time_utc_ns", "valid_for_s", "y_offset_um", "y_offset_rate_um_per_min")
_MORE_KEYS = ("y_offset_std_um", "state", "reasons", "probe_wanted", "wanted_by_ns", "wanted_std_um", "model_sha256")
#: What a message of one axis of several, and the length of the tool, have besides.
_AXIS_KEYS = (
    "axis",
    "axes",
    "acts_on",
    "reference_mm",
    "{}_offset_um",
    "{}_offset_rate_um_per_min",
    "{}_offset_urad",
    "{}_offset_rate_urad_per_min",
    "y_slope_um_per_m",
    "y_slope_rate_um_per_m_per_min",
    "y_slope_std_um_per_m",
    "tool_length_mm",
)
_AXIS_TEXTS = ('"y"', '"z"', '"a"', '["y","z","a"]', '["y"]', '["z","z"]', "[[]]", '["y",3]', '[{"a":1}]')


def number(rng: random.Random) -> str:
    """Return a number as JSON, or nearly so: small, at an edge, of any size, of any number of digits."""
    way = rng.randrange(7)
    if way == 0:
        return str(rng.choice(_EDGES) + rng.randrange(-2, 3))
    if way == 1:
        return rng.choice("123456789") + "".join(rng.choices("0123456789", k=rng.randrange(6000)))
    if way == 2:
        return f"{rng.uniform(-1, 1)}e{rng.randrange(-400, 400)}"
    if way == 3:
        return rng.choice(("NaN", "Infinity", "-Infinity", "-0", "0.0", "-0.0", "1e999", "5e-324", "1E+2", "+1", "0x1"))
    if way == 4:
        return str(rng.getrandbits(rng.randrange(1, 80)) * rng.choice((1, 1, -1)))
    return repr(rng.uniform(-200.0, 200.0)) if way == 5 else str(rng.randrange(100_000))


def value(rng: random.Random, depth: int = 0) -> str:
    """Return any JSON value as text, or nearly so."""
    way = rng.randrange(10 if depth < 4 else 6)
    if way < 3:
        return number(rng)
    if way == 3:
        return rng.choice(("null", "true", "false", "nul", ""))
    if way < 6:
        some = "".join(map(chr, (rng.randrange(0xD800) for _ in range(rng.randrange(6)))))
        return json.dumps(rng.choice((*_TEXTS, some)), ensure_ascii=rng.random() < 0.9)
    if way == 6:
        deep = int(10 ** rng.uniform(0.0, 4.3))
        return rng.choice(("[", '{"a":')) * deep + "1" + rng.choice(("]", "}", "")) * deep
    inside = [value(rng, depth + 1) for _ in range(rng.randrange(4))]
    if way == 7:
        return "[" + ",".join(inside) + "]"
    return "{" + ",".join(f"{json.dumps(rng.choice(_KEYS))}:{one}" for one in inside) + "}"


def message(rng: random.Random, now_ns: int = T0_NS, axis: str = "") -> str:
    """Return an offset that a service could have published now, with up to three of its keys changed.

    Parameters
    ----------
    rng : random.Random
        Where it comes from.
    now_ns : int
        Time around which it was measured, ns since 1970 UTC.
    axis : str
        One axis of several; without it a machine with Y alone.
    """
    seq, um = rng.randrange(200), rng.uniform(-60.0, 60.0)
    if axis:
        line = slope(rng.uniform(-60.0, 60.0), rng.uniform(0.0, 500.0)) if axis == "y" and rng.randrange(2) else {}
        table = json.loads(axis_offset(axis, seq, um, axes="yza", **line))
    else:
        table = json.loads(offset(seq, um))
    table["time_utc_ns"] = now_ns - rng.randrange(-10, 400) * 1_000_000_000
    pairs = {key: json.dumps(one) for key, one in table.items()}
    names = (*_KEYS, *_MORE_KEYS, "other")
    if axis:
        names = (*names, *(name.format(axis) for name in _AXIS_KEYS))
    for _ in range(rng.choice((0, 1, 1, 2, 3))):
        key = rng.choice(names)
        if rng.randrange(8) == 0:
            pairs.pop(key, None)
        elif axis and rng.randrange(4) == 0:
            pairs[key] = rng.choice(_AXIS_TEXTS)
        else:
            pairs[key] = number(rng) if rng.random() < 0.6 else value(rng)
    items = [f"{json.dumps(key)}:{one}" for key, one in pairs.items()]
    if rng.randrange(15) == 0:
        items.append(rng.choice(items))
    return "{" + ",".join(items) + "}"


def payload(rng: random.Random, now_ns: int = T0_NS, axis: str = "") -> bytes:
    """Return any payload.

    Parameters
    ----------
    rng : random.Random
        Where it comes from.
    now_ns : int
        Time around which messages are made, ns since 1970 UTC.
    axis : str
        As in `message`.
    """
    way = rng.randrange(10)
    if way == 0:
        return rng.randbytes(rng.randrange(300))
    if way == 1:
        return value(rng).encode("utf-8", "surrogatepass")
    if way == 2:
        return mutated(rng.randrange(2**32), message(rng, now_ns, axis).encode("utf-8", "surrogatepass"))
    if way == 3 and rng.randrange(10) == 0:
        return rng.choice((b" ", b"9", b"[", b'"', b"{}", b"\x00")) * 70_000
    return message(rng, now_ns, axis).encode("utf-8", "surrogatepass")
