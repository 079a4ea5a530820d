"""Offsets as a service publishes them, written apart from the product."""

from __future__ import annotations

import json
from typing import Any

MACHINE = "vmc-07"
T0_NS = 1_767_592_800_000_000_000


def offset(seq: int, y_um: float | None = 0.0, /, **changes: Any) -> bytes:
    return json.dumps(
        {
            "schema": 1,
            "machine": MACHINE,
            "seq": seq,
            "time_utc_ns": T0_NS + seq * 60_000_000_000,
            "valid_for_s": 150.0,
            "y_offset_um": y_um,
            "y_offset_rate_um_per_min": 0.0,
            "y_offset_std_um": 0.4,
            "state": "ok",
            "reasons": [],
            "model_sha256": "0" * 64,
            **changes,
        }
    ).encode()


def axis_offset(
    axis: str, seq: int, value: float | None = 0.0, /, axes: str = "xyz", rate: float = 0.0, **changes: Any
) -> bytes:
    """One axis of several; `a` and `b` are angles, which act on Y for a tool of 100 mm."""
    unit = "urad" if axis in "ab" else "um"
    own: dict[str, Any] = {"acts_on": "y", "reference_mm": 100.0} if axis in "ab" else {}
    message = json.loads(offset(seq, **{**own, **changes}))
    for key in ("y_offset_um", "y_offset_rate_um_per_min", "y_offset_std_um"):
        del message[key]
    values = {f"{axis}_offset_{unit}": value, f"{axis}_offset_rate_{unit}_per_min": rate}
    values[f"{axis}_offset_std_{unit}"] = 0.4
    return json.dumps({"axis": axis, "axes": list(axes), **values, **message, **changes}).encode()


def slope(um_per_m: float | None, reference_mm: float = 0.0, rate: float = 0.0) -> dict[str, Any]:
    """What a slope of Y adds to its message."""
    return {
        "y_slope_um_per_m": um_per_m,
        "y_slope_rate_um_per_m_per_min": rate,
        "y_slope_std_um_per_m": 0.1,
        "reference_mm": reference_mm,
    }
