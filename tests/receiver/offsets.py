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
