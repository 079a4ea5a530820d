"""A machine of several axes: its model, its configuration, and a service on it that is ended and started again."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from compensator.clock import VirtualClock
from compensator.config import Config, LoadedConfig, parse_config
from compensator.messages_axes import AxisOffset
from compensator.model.effects import Effect
from compensator.model.model_file import load_model
from compensator.model.model_writer import dump_axes
from compensator.model.thermal_model import Path as ModelPath
from compensator.model.thermal_model import ThermalModel
from compensator.model.transfer_function import TransferFunction
from compensator.recording.live_file import topics_of
from compensator.recording.numbering import first_sequence
from compensator.recording.reading import recordings
from compensator.recording.recorder import McapRecorder
from compensator.service.axes import planned_outputs
from compensator.service.compensation import Outcome, model_of
from compensator.service.daemon import Daemon
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.transfer.model_store import ModelStore
from compensator.service.transfer.restart import resume
from sim_hardware.physics import MachineOfAxes, PublishedQuill, World, usual_sensors
from sim_hardware.physics.axes import USUAL
from tests.audit.made import CONFIG as ONE_AXIS
from tests.service.promises import Promises
from tests.service.simulated import START_NS, FakeDevice, taking, working_day

MACHINE = "vmc-07"
CHANNELS = ("t_q_degc", "at_degc", "y_um", "coolant_degc", "x_um", "z_um")
LIMITS = "offset_max_um = 200.0\noffset_rate_max_um_per_min = 8.0"
#: Tables of X, Y and Z.
AXES = f"""
[axis.y]
{LIMITS}
[axis.x]
offset_max_um = 60.0
offset_rate_max_um_per_min = 4.0
[axis.z]
offset_max_um = 150.0
offset_rate_max_um_per_min = 8.0
"""
TILT = """
[axis.a]
probes = ["low", "high"]
distance_mm = 200.0
reference_mm = 120.0
offset_max_urad = 400.0
offset_rate_max_urad_per_min = 20.0
"""
SLOPE = """
[axis.y.slope]
slope_max_um_per_m = 120.0
slope_rate_max_um_per_m_per_min = 8.0
reference_mm = 300.0
"""
SENSORS = """
[[channel]]
name = "x_um"
device = "module"
input = 4
[[channel]]
name = "z_um"
device = "module"
input = 5
"""


def config_text(*tables: str, **replaced: str) -> bytes:
    """The text of a configuration: that of one axis, with the limits of Y in their place, and further tables."""
    text = ONE_AXIS.decode()
    assert LIMITS in text
    text = text.replace(LIMITS, "") + SENSORS + "".join(tables or (AXES,))
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    return text.encode()


def part(name: str, *effects: Effect, **changes: Any) -> ThermalModel:
    """A part of the model of the simulated machine, with the time constants and gains of its physics."""
    quill = dataclasses.replace(load_model("quill"), axis="y", alternatives={}, provenance={}, y_std_um=1.0)
    if name == "y":
        return dataclasses.replace(quill, effects=effects, **changes)
    growth = next(one for one in USUAL if one.name.rpartition("_um")[0].removesuffix("_um") == name)

    def lag(gain: float, tau_min: float, unit: str) -> ModelPath:
        function = TransferFunction(numerator=(gain,), denominator=(1.0, tau_min), unit=unit)
        return ModelPath.from_continuous(function, quill.period_s)

    return dataclasses.replace(
        quill,
        axis=name,
        dtf=lag(growth.per_w, growth.heat_tau_min, "um/W"),
        tdtf=lag(growth.per_k, growth.air_tau_min, "um/K"),
        effects=effects,
        **changes,
    )


def model_text(*names: str, parts: Mapping[str, ThermalModel] | None = None) -> bytes:
    """The model file of the simulated machine; `parts` replace those of their names."""
    models = {name: part(name) for name in names} | dict(parts or {})
    return dump_axes(models).encode()


@functools.cache
def _parsed(text: bytes) -> Config:
    """A configuration, which every poll asks for and nobody changes."""
    return parse_config(text, source="test")


class SeveralAxes:
    """A service of several axes on a machine, by default without sensor noise."""

    def __init__(self, folder: Path, config: bytes, model: bytes, *, noise: bool = False) -> None:
        self.folder, self.text, self.configured = folder, config, model
        duty = working_day(1, 72.0)
        usual = usual_sensors(duty.extra_names)
        sensors = usual | {"x_um": usual["y_um"], "z_um": usual["y_um"]} if noise else {}
        self.world = World(MachineOfAxes(PublishedQuill()), duty, sensors, seed=1)
        source = self.world.source if noise else lambda name: functools.partial(self.world.truth, name)
        self.device = FakeDevice([source(name) for name in CHANNELS])
        self.outcomes: list[Outcome] = []
        self.published: list[tuple[str, bytes]] = []
        self.daemon: Daemon | None = None
        self.promises = Promises(patience_s=0.1)

        async def advance(t_s: float) -> None:
            self.world.advance_to(t_s)
            await self.promises.wait(self.config.sampling.poll_interval_s / 60.0)

        self.clock = VirtualClock(START_NS, advance)

    @property
    def config(self) -> Config:
        return _parsed(self.text)

    @property
    def recordings(self) -> list[Path]:
        return recordings(self.folder / "rec", MACHINE)

    @property
    def store(self) -> ModelStore:
        return ModelStore(self.folder / "rec" / "models", self.configured, MACHINE)

    def run(self, samples: int, at_sample: Mapping[int, Any] | None = None) -> None:
        """Start the service, run it, end it cleanly."""
        asyncio.run(self._run(samples, dict(at_sample or {})))

    async def _run(self, samples: int, at_sample: dict[int, Any]) -> None:
        config, data = self.config, self.store.in_use()
        axes = config.axis.names() if config.axis is not None else ()
        loaded = LoadedConfig(config=config, path=self.folder / "machine.toml", data=self.text)
        checkpoint = OffsetCheckpoint(self.folder / "rec", MACHINE, self.folder)
        largest = {one.name: one.bounds.offset_max_um for one in planned_outputs(config.axis)}
        early = checkpoint.read(config.limits.offset_max_um, largest)
        resumed = resume(loaded, model_of(config, data, source="test"), early)
        daemon = self.daemon = Daemon(
            config=config,
            compensation=resumed.compensation,
            devices={"module": self.device},
            recorder=McapRecorder(
                self.folder / "rec",
                MACHINE,
                {"config.toml": self.text, "model.toml": data},
                topics=topics_of(probes=config.probe is not None, loop=False, axes=axes),
                axes=axes,
            ),
            publish=taking(self.published),
            clock=self.clock,
            first_sequence=first_sequence(self.folder / "rec", MACHINE, self.clock.utc_ns(), 60.0),
            recordings=self.folder / "rec",
            store=self.store,
            notes=resumed.notes,
            checkpoint=checkpoint,
        )
        done = 0

        def step(outcome: Outcome) -> None:
            nonlocal done
            done += 1
            self.outcomes.append(outcome)
            at_sample.pop(done, lambda: None)()

        await daemon.run(samples=samples, on_sample=step)

    def command(self, name: str, payload: bytes = b"") -> Any:
        """Send a command; simulated time waits for what takes long."""
        assert self.daemon is not None
        return self.promises.add(self.daemon.command(name, payload))

    def sent(self, topic: str) -> list[dict[str, Any]]:
        """What was published under a name, decoded."""
        return [msgspec.json.decode(data) for name, data in self.published if name == topic]


def by_axis(outcome: Outcome) -> dict[str, AxisOffset]:
    """The offsets of a sample by axis."""
    found = (outcome.offset, *outcome.further)
    return {one.axis: one for one in found if isinstance(one, AxisOffset)}
