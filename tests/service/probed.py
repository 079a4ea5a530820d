"""A machine without a displacement sensor, whose model is wrong by some percent and whose Y is probed."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

from compensator.config import parse_config
from compensator.messages import Probe, Status, number
from compensator.model.model_file import read_model_bytes
from compensator.recording.reading import messages, recordings
from tests.audit.made import CONFIG
from tests.service.living import MACHINE, Machine

PROBE = b"""
[probe]
std_um = 1.0
measured_max_um = 60.0
largest_um = 40.0
tolerance_um = 3.0
"""
#: The configuration of `tests.audit.made`, without the sensor of Y.
SENSOR = CONFIG.index(b'[[channel]]\nname = "y_um"')
COOLANT = CONFIG.index(b'[[channel]]\nname = "coolant_degc"')
PROBED = (CONFIG[:SENSOR] + CONFIG[COOLANT:] + PROBE).replace(b"poll_interval_s = 10.0", b"poll_interval_s = 60.0")
RATE_UM = 8.0


class ProbedMachine(Machine):
    """A machine that grows by `gain` times the published model, with some noise of the probe."""

    def __init__(self, folder: Path, *, gain: float = 1.1, config: bytes = PROBED, noise_um: float = 0.5) -> None:
        super().__init__(folder, parse_config(config, source="test"), read_model_bytes("quill"))
        self.config_bytes = config
        self.gain = gain
        self.rng, self.noise_um = np.random.default_rng(1), noise_um
        self.replies: list[Any] = []
        self.statuses: list[Status] = []
        sources = ("t_q_degc", "at_degc", "y_um", "coolant_degc")
        self.device.sources = [functools.partial(self.world.truth, name) for name in sources]

    def truth_um(self) -> float:
        """Deformation of the machine now."""
        return self.gain * self.world.truth("y_um")

    def applied_um(self) -> float:
        """Offset that the control follows now."""
        offset = self.outcomes[-1].offset
        since_min = (self.clock.utc_ns() - offset.time_utc_ns) / 60e9
        return number(offset.y_offset_um) + number(offset.y_offset_rate_um_per_min) * since_min

    def measured(self, wrong_um: float = 0.0, **changes: Any) -> dict[str, Any]:
        """What a probe measures now."""
        applied = self.applied_um()
        noise = self.noise_um * self.rng.normal()
        return {
            "schema": 1,
            "time_utc_ns": self.clock.utc_ns(),
            "axis": "y",
            "measured_um": self.truth_um() + applied + noise + wrong_um,
            "offset_applied_um": applied,
            "feature": "sphere-1",
            **changes,
        }

    def send(self, payload: dict[str, Any] | bytes) -> None:
        data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
        self.replies.append(self.command("probe", data))

    def probe(self, wrong_um: float = 0.0, **changes: Any) -> None:
        """Probe now."""
        self.send(self.measured(wrong_um, **changes))

    def each_hour(self, until: int, first: int = 60, every: int = 60) -> None:
        """Probe each hour."""
        for sample in range(first, until, every):
            self.at_sample[sample] = self.probe

    def recorded(self) -> list[Probe]:
        """Return the recorded probes of all files."""
        return [probe for path in recordings(self.recordings, MACHINE) for probe in messages(path, ("probe",))]

    def codes(self) -> list[str]:
        return [probe.code if not probe.taken else probe.code or "taken" for probe in self.recorded()]

    def left_um(self) -> np.ndarray:
        """Deformation that is left at each sample; it grows with the world, so it is noted while running."""
        return np.array(self.left)

    left: list[float]

    async def run(self, samples: int, until: Any = None) -> None:  # type: ignore[override]
        self.left = getattr(self, "left", [])

        def note(outcome: Any) -> bool:
            self.left.append(self.truth_um() + number(outcome.offset.y_offset_um))
            return bool(until is not None and until(outcome))

        await super().run(samples, note)

    def last_status(self) -> dict[str, Any]:
        return next(json.loads(data) for name, data in reversed(self.published) if name == "status")  # type: ignore[no-any-return]
