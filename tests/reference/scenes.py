"""What happens in the recordings of the reference, each scene in a folder of its own."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from compensator.signature import Signer
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from compensator.recording import recordings
from drivers.errors import DeviceTimeout
from drivers.reading import Reading
from tests.reference.machine import MACHINE, START_NS, Machine, checked, disk
from tests.reference.models import MODELS

HOUR_NS = 3_600_000_000_000
AUXILIARY = ("coolant_degc", "spindle_rpm", "fan_rpm")
CONFIG = """
[machine]
name = "vmc-07"
[model]
file = "quill"
[sampling]
poll_interval_s = 20.0
[limits]
offset_max_um = 200.0
offset_rate_max_um_per_min = 8.0
[limits.validity]
t_q_degc = [10.0, 60.0]
at_degc = [10.0, 35.0]
[loss]
predict_for_min = 10.0
[zero]
rest_rate_um_per_min = 0.2
[guards]
t_q_below_at_max_k = 2.0
[zenoh]
prefix = "shop/vmc-07"
listen = ["tcp/127.0.0.1:7447"]
[recording]
folder = "recordings"
[[line]]
name = "lan"
protocol = "modbus-tcp"
host = "127.0.0.1"
tcp_port = 5020
[[device]]
name = "module"
line = "lan"
model = "modbus-map"
address = 1
inputs = [
  { input = 0, unit = "degc", function = 4, address = 0, type = "int16", scale = 0.01 },
  { input = 1, unit = "degc", function = 4, address = 1, type = "int16", scale = 0.01 },
  { input = 2, unit = "um", function = 4, address = 2, type = "int16", scale = 0.01 },
  { input = 3, unit = "degc", function = 4, address = 3, type = "int16", scale = 0.01 },
  { input = 4, unit = "rpm", function = 4, address = 4, type = "int16" },
  { input = 5, unit = "rpm", function = 4, address = 5, type = "int16" },
]
[[channel]]
name = "t_q_degc"
device = "module"
input = 0
range = [0.0, 80.0]
rate_max_per_min = 5.0
stuck_after_min = 60.0
[[channel]]
name = "at_degc"
device = "module"
input = 1
range = [0.0, 50.0]
rate_max_per_min = 2.0
stuck_after_min = 60.0
[[channel]]
name = "y_um"
device = "module"
input = 2
range = [-200.0, 200.0]
rate_max_per_min = 30.0
stuck_after_min = 60.0
"""
PLAUSIBILITY = """
[plausibility]
t_q_below_at_after_min = 10.0
false_alarm_days = 30.0
residual_std_um = 1.0
residual_hold_um = 25.0
[plausibility.rest]
channel = "spindle_rpm"
at_most = 1.0
after_min = 20.0
t_q_at_max_k = 3.0
"""


def config(*pairs: tuple[str, str], channels: tuple[str, ...] = AUXILIARY[:1], also: str = "") -> bytes:
    """Return the usual configuration with auxiliary channels and some texts in the place of others."""
    text = CONFIG
    for old, new in pairs:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    for name in channels:
        text += f'[[channel]]\nname = "{name}"\ndevice = "module"\ninput = {3 + AUXILIARY.index(name)}\n'
    return checked((text + also).encode())


def machine(folder: Path, model: str = "quill.toml", conf: bytes | None = None, **more: object) -> Machine:
    """Return a machine with one of the models."""
    return Machine(folder, conf or config(), MODELS[model], **more)  # type: ignore[arg-type]


# ---------------------------------------------------------------------- scenes


def plain(folder: Path) -> Machine:
    """Two hours and a quarter in which nothing happens."""
    one = machine(folder)
    one.run(135)
    return one


def restarts(folder: Path) -> Machine:
    """A clean stop of 8 min, which is bridged, and one of 70 min, after which the state is unknown."""
    one = machine(folder, conf=config(also="[restart]\nbridge_max_min = 40.0\n"), seed=2)
    one.run(50)
    one.sleep(8.0)
    one.run(20)
    one.sleep(70.0)
    one.run(12)
    return one


def killed(folder: Path) -> Machine:
    """A kill that tears the file, which the next start finishes, and its own file, which nobody finishes."""
    one = machine(folder, seed=13)
    one.run_and_kill(40, torn=1000)
    one.sleep(3.0)
    one.run_and_kill(12, torn=33)
    return one


def commands(folder: Path) -> Machine:
    """Zero at rest and warm, hold and resume."""
    one = machine(folder, seed=1)
    for sample, name, payload in (
        (20, "zero", b'{"mode":"rest"}'),
        (45, "hold", b""),
        (50, "zero", b'{"mode":"warm"}'),
        (51, "resume", b""),
        (62, "zero", b""),
        (66, "hold", b""),
        (66, "resume", b""),
        (72, "hold", b""),
        (77, "resume", b""),
        (80, "zero", b'{"mode":"sideways"}'),
    ):
        one.at(sample, name, payload)
    one.run(90)
    return one


def losses(folder: Path) -> Machine:
    """Sensors lost and found again, for a sample, for some, and beyond what is predicted; the device itself gone."""
    one = machine(folder, seed=4)
    one.lose(0, at=50, until=51)
    one.lose(1, at=56, until=61)
    one.lose(0, 2, at=66, until=84)
    one.do(92, lambda: setattr(one.device, "error", DeviceTimeout("module", "no answer")))
    one.do(95, lambda: setattr(one.device, "error", None))
    one.lose(0, at=98, until=99, reading=Reading.good(75.0))
    one.lose(2, at=101, until=104, reading=Reading.good(400.0))
    one.run(108)
    return one


def limits(folder: Path) -> Machine:
    """An offset that comes to its limit, at the permitted rate."""
    conf = config(
        ("offset_max_um = 200.0", "offset_max_um = 6.0"),
        ("offset_rate_max_um_per_min = 8.0", "offset_rate_max_um_per_min = 0.4"),
    )
    one = machine(folder, conf=conf, seed=21)
    one.lose(0, at=60, until=63)
    one.run(72)
    return one


def adopted(folder: Path) -> Machine:
    """Another model is adopted and left again, one is refused; after the end the configuration is another one."""
    conf = config(("offset_rate_max_um_per_min = 8.0", "offset_rate_max_um_per_min = 2.0"))
    one = machine(folder, conf=conf, seed=36)
    one.adopt(50, MODELS["stronger.toml"])
    one.adopt(56, MODELS["effects.toml"])  # needs channels that are not configured
    one.at(68, "back")
    one.run(84)
    one.config = config(("offset_rate_max_um_per_min = 8.0", "offset_rate_max_um_per_min = 3.0"))
    one.sleep(4.0)
    one.run(12)
    return one


def effects(folder: Path) -> Machine:
    """A model with every effect that can be deployed, a lost channel, and a stop that is bridged."""
    one = machine(folder, "effects.toml", config(channels=AUXILIARY), seed=38)
    one.lose(3, at=40, until=46)
    one.lose(0, at=60, until=64)
    one.run(80)
    one.sleep(5.0)
    one.run(20)
    return one


def direct(folder: Path) -> Machine:
    """A model that knows no heat."""
    one = machine(folder, "direct.toml", seed=48)
    one.lose(0, at=40, until=43)
    one.run(50)
    return one


def direct_inverse(folder: Path) -> Machine:
    """A model that knows no heat and takes temperatures as they are, with the reversed function."""
    one = machine(folder, "direct-inverse.toml", seed=45)
    one.lose(0, at=40, until=43)
    one.run(50)
    return one


def inverse(folder: Path) -> Machine:
    """The reversed TTF in the place of the Kalman filter, with the alternative TDTF of the model."""
    one = machine(folder, "inverse.toml", config(('file = "quill"', 'file = "quill"\nalternative = "TDTF-I"')), seed=55)
    one.lose(0, at=40, until=44)
    one.lose(1, at=50, until=52)
    one.run(58)
    return one


def gap(folder: Path) -> Machine:
    """The wall clock is set forward and back, and the computer sleeps for some minutes."""
    one = machine(folder, seed=30)
    one.do(25, lambda: one.clock.set_wall_clock(1500.0))
    one.do(40, lambda: one.stand_still(7.5))
    one.do(55, lambda: one.clock.set_wall_clock(-600.0))
    one.run(62)
    return one


def trouble(folder: Path) -> Machine:
    """The disk does not take the recording for some minutes, with commands meanwhile; then an internal error."""
    one = machine(folder, seed=41)
    with disk() as fill:
        one.do(10, lambda: fill(True))
        one.at(12, "hold")
        one.do(16, lambda: fill(False))
        one.at(19, "resume")
        one.at(35, "resume")
        one.run(40, broken=30)
    return one


def suspects(folder: Path) -> Machine:
    """Measured Y goes away from the model; then T_Q and AT are exchanged."""
    one = machine(folder, conf=config(channels=AUXILIARY[1:2], also=PLAUSIBILITY), seed=29)
    one.lose(2, at=35, until=90, reading=Reading.good(-60.0))
    one.lose(0, at=92, until=108, reading=Reading.good(15.0))
    one.at(111, "resume")
    one.run(115)
    return one


def signed(folder: Path) -> Machine:
    """Seals of each hour and of each end are signed; the first end is that of a kill."""
    key = Ed25519PrivateKey.from_private_bytes(bytes([7]) * 32)
    private = folder / "machine.pem"
    private.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    one = machine(folder, seed=15, signer=Signer(private))
    one.run_and_kill(64)
    one.sleep(2.0)
    one.run(12)
    return one


def series(folder: Path) -> Machine:
    """Samples of five minutes: over midnight, and a restart after an hour and a quarter."""
    conf = config(("poll_interval_s = 20.0", "poll_interval_s = 60.0"))
    one = machine(folder, "slow.toml", conf, seed=22, start_ns=START_NS + 15 * HOUR_NS)
    one.run(36 + 24)
    one.sleep(75.0)
    one.run(20)
    return one


SCENES: dict[str, Callable[[Path], Machine]] = {
    scene.__name__: scene
    for scene in (
        plain,
        restarts,
        killed,
        commands,
        losses,
        limits,
        adopted,
        effects,
        direct,
        direct_inverse,
        inverse,
        gap,
        trouble,
        suspects,
        signed,
        series,
    )
}


def make(name: str, out: Path) -> list[bytes]:
    """Play a scene, keep its recordings, and return the offsets that were published."""
    with tempfile.TemporaryDirectory() as folder:
        one = SCENES[name](Path(folder))
        out.mkdir(parents=True)
        for path in recordings(one.recordings, MACHINE):
            shutil.copyfile(path, out / path.name)
    return one.published


def public_key(number: int) -> bytes:
    """Return a public key: of the signing machine (7), or of another one."""
    key = Ed25519PrivateKey.from_private_bytes(bytes([number]) * 32).public_key()
    return key.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
