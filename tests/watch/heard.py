"""Messages as a service publishes them."""

from __future__ import annotations

import json
from typing import Any

from compensator.clock import NS

START_NS = 1_767_592_800 * NS


class Clock:
    """Stands still until it is told."""

    def __init__(self) -> None:
        self.now_ns, self.monotonic = START_NS, 1000 * NS

    def utc_ns(self) -> int:
        return self.now_ns

    def monotonic_ns(self) -> int:
        return self.monotonic

    def advance(self, seconds: float) -> None:
        self.now_ns += round(seconds * NS)
        self.monotonic += round(seconds * NS)


def offset(number: int, time_ns: int = START_NS, **changes: Any) -> bytes:
    message = {
        "schema": 1,
        "machine": "vmc-07",
        "seq": number,
        "time_utc_ns": time_ns,
        "valid_for_s": 150.0,
        "y_offset_um": -12.34,
        "y_offset_rate_um_per_min": -0.81,
        "y_offset_std_um": 0.42,
        "state": "ok",
        "reasons": [],
        "model_sha256": "ab",
    }
    return json.dumps(message | changes).encode()


def axis_offset(axis: str, number: int, time_ns: int = START_NS, **changes: Any) -> bytes:
    """One of several axes; values are those of Y."""
    fields = json.loads(offset(number, time_ns, axis=axis, axes=["y", "z"], **changes))
    return json.dumps({name.replace("y_", f"{axis}_", 1): value for name, value in fields.items()}).encode()


def sample(seq: int, time_ns: int = START_NS, t_q: float | None = 31.5, quality: str = "good") -> bytes:
    def channel(mean: float | None, quality: str = "good") -> dict[str, Any]:
        return {
            "mean": mean,
            "min": mean,
            "max": mean,
            "spread": 0.01,
            "count": 6,
            "polls": 6,
            "quality": quality,
            "device_quality": quality,
            "errors": {} if quality == "good" else {quality: 6},
        }

    return json.dumps(
        {
            "schema": 1,
            "machine": "vmc-07",
            "seq": seq,
            "time_utc_ns": time_ns,
            "period_s": 60.0,
            "channels": {"t_q_degc": channel(t_q, quality), "at_degc": channel(20.5)},
        }
    ).encode()


def estimate(seq: int, time_ns: int = START_NS, effects: tuple[float, ...] = (1.5,), **changes: Any) -> bytes:
    message = {
        "schema": 1,
        "machine": "vmc-07",
        "seq": seq,
        "time_utc_ns": time_ns,
        "t_q_ref_degc": 20.0,
        "at_ref_degc": 20.0,
        "y_ref_um": 0.0,
        "heat_w": 61.0,
        "heat_std_w": 2.0,
        "y_dtf_um": 10.0,
        "y_tdtf_um": 0.84,
        "y_effects_um": list(effects),
        "y_base_um": 0.0,
        "y_pred_um": 12.34,
        "y_std_um": 0.4,
        "y_rate_um_per_min": 0.8,
        "y_um": 12.0,
        "residual_um": -0.34,
    }
    return json.dumps(message | changes).encode()


def status(seq: int, time_ns: int = START_NS, started_ns: int = START_NS - 3600 * NS, **changes: Any) -> bytes:
    message = {
        "schema": 1,
        "machine": "vmc-07",
        "seq": seq,
        "time_utc_ns": time_ns,
        "state": "ok",
        "reasons": [],
        "version": "0.1.0",
        "model": "quill",
        "model_kind": "heat",
        "model_sha256": "ab",
        "started_utc_ns": started_ns,
        "recording": "vmc-07_20260105T060000Z.mcap",
        "devices": {"couples": "ok"},
        "effects": ["gain DTF"],
    }
    return json.dumps(message | changes).encode()


def event(
    seq: int, time_ns: int = START_NS, kind: str = "device", text: str = "couples: no answer", **data: Any
) -> bytes:
    return json.dumps(
        {"schema": 1, "machine": "vmc-07", "seq": seq, "time_utc_ns": time_ns, "kind": kind, "text": text, "data": data}
    ).encode()


#: The status of a loop that proposes a model.
LOOP: dict[str, Any] = {
    "phase": "proposed",
    "diagnosing": False,
    "model_sha256": "c" * 64,
    "effects": ["input:coolant_degc"],
    "since_utc_ns": START_NS - 3600 * NS,
    "y_pred_um": 11.0,
    "verdict": "better",
    "text": "last 12 h: present 6.9 µm rms, this one 1.2 (better: the present one is refuted by 31 "
    "standard deviations)",
    "present_rms_um": 6.9,
    "candidate_rms_um": 1.2,
    "deviations": 31.0,
    "hours": 12.0,
    "probes": 0,
    "adopted_utc_ns": 0,
}
