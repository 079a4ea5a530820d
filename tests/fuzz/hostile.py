"""Hostile inputs, each from a kind and a seed alone: payloads, configurations, models, tables, files that are none.

`attempt(kind, seed, folder)` tries one and raises AssertionError, with what was wrong, where it was not survived:
survived is a result or a refusal of one line, in time, with an exit code that says so.
"""

from __future__ import annotations

import contextlib
import functools
import io
import math
import os
import random
import re
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from compensator.cli import main
from compensator.config import Config, parse_config
from compensator.errors import CompensatorError
from compensator.model.model_file import parse_model, read_model_bytes
from compensator.receiver import Receiver, ReceiverError, load_settings
from compensator.service.transfer.model_store import check_model
from tests.audit.made import CONFIG, Service
from tests.fuzz.attacked_receiver import Attack
from tests.fuzz.forged_numbers import NAME, attempt_start, forged
from tests.fuzz.mutation import mutated
from tests.fuzz.payloads import number

#: No input may take longer, s, on a busy computer either.
PATIENCE_S = 60.0
QUILL = read_model_bytes("quill")
TABLE = b"t_s,t_q_degc,at_degc,y_um,heat_w\n" + b"".join(
    f"{60 * i},{20 + 0.01 * i:.2f},20.1,{0.02 * i:.3f},{30 if i > 20 else 0}\n".encode() for i in range(150)
)
RECEIVER = b"""[receiver]
machine = "vmc-07"
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:1"]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6.0
check_clock = true
"""
#: Numbers that TOML can hold and no machine has.
_NUMBERS = (
    "inf",
    "-inf",
    "nan",
    "1e308",
    "-1e308",
    "5e-324",
    "0.0",
    "-0.0",
    "-1.0",
    "1e30",
    "0",
    "9" * 400,
    "9" * 5000,
)
_TEXTS = (
    '""',
    '"\\u0000"',
    '"a\\u0000b"',
    '"../../../../etc/passwd"',
    '"/dev/zero"',
    '"\\n"',
    '"%s"',
    '"' + "x" * 9000 + '"',
)
_VALUE = re.compile(rb"= *([^\n,\]}]+)")


def changed(rng: random.Random, text: bytes) -> bytes:
    """Return a TOML file with one to three of its values replaced by what no engineer writes, or corrupted."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        places = list(_VALUE.finditer(text))
        place = rng.choice(places)
        way = rng.randrange(8)
        if way < 3:
            new = rng.choice(_NUMBERS)
        elif way == 3:
            new = number(rng)
        elif way == 4:
            new = rng.choice(_TEXTS)
        elif way == 5:
            new = "[" + ", ".join([rng.choice(("1.0", "inf", '"a"', "[]"))] * int(10 ** rng.uniform(0, 4.5))) + "]"
        elif way == 6:
            new = rng.choice(("[", "{a = ")) * int(10 ** rng.uniform(0, 4.5))
        else:
            part, between = rng.choice((("k", "."), ('"k"', "."), ("'k'", "."), ('"\\""', "."), ('\\"', ""), ("'", "")))
            new = "1\n" + rng.choice(("", '"', '"""')) + between.join([part] * int(10 ** rng.uniform(0, 5.3))) + " = 1"
        text = text[: place.start(1)] + new.encode() + text[place.end(1) :]
    return mutated(rng.randrange(2**32), text) if rng.randrange(5) == 0 else text


def one_line(work: Callable[[], Any]) -> Any:
    """Return the result of some work, None where it is refused in one line."""
    try:
        return work()
    except CompensatorError as error:
        assert "\n" not in str(error) and len(str(error)) < 2000, str(error)[:3000]
    return None


def configuration(rng: random.Random, folder: Path) -> None:
    """A configuration is refused, or every limit in it is finite and the service can begin with it."""
    data = changed(rng, CONFIG)
    config = one_line(lambda: parse_config(data, source="machine.toml"))
    if config is None:
        return
    limits = config.limits
    assert 0.0 < limits.offset_max_um <= 5000.0 and 0.0 < limits.offset_rate_max_um_per_min <= 1000.0
    one_line(lambda: check_model(config, QUILL, source="quill"))
    (folder / "machine.toml").write_bytes(data)
    command(folder, "check", "--config", "machine.toml")


def model(rng: random.Random, folder: Path) -> None:
    """A model is refused, or a service can run it."""
    data = changed(rng, QUILL)
    if one_line(lambda: parse_model(data, source="model.toml")) is not None:
        one_line(lambda: check_model(_CONFIG, data, source="model.toml"))
    (folder / "model.toml").write_bytes(data)
    (folder / "table.csv").write_bytes(TABLE)
    command(folder, "simulate", "table.csv", "--model", "model.toml", "--out", "out.csv")


def table(rng: random.Random, folder: Path) -> None:
    """A table gives a result or is refused."""
    data = mutated(rng.randrange(2**32), TABLE)
    way = rng.randrange(4)
    if way == 0:
        columns = int(10 ** rng.uniform(0, 5.3))
        data = data.replace(b"heat_w\n", b",".join(b"c%d" % i for i in range(columns)) + b"\n")
    elif way == 1:
        line = data.rpartition(b"\n")[0].rpartition(b"\n")[2] + b"\n"
        data += line * int(10 ** rng.uniform(0, 4))
    elif way == 2:
        data = data.replace(b"20.1", rng.choice(_NUMBERS).encode(), rng.choice((1, -1)))
    (folder / "table.csv").write_bytes(data)
    command(folder, "simulate", "table.csv", "--model", "quill", "--out", "out.csv")


def no_file(rng: random.Random, folder: Path) -> None:
    """What is no regular file of a sensible size is refused wherever a file is named."""
    path = folder / ("it" + rng.choice(("", ".toml", ".csv", ".mcap", ".mat", ".json5", ".pem")))
    way = rng.randrange(7)
    if way == 0:
        os.mkfifo(path)
    elif way == 1:
        path.symlink_to(rng.choice(("/dev/zero", "/dev/urandom", "/dev/full", "/dev/null", "/proc/self/mem")))
    elif way == 2:
        path.symlink_to(path.name)
    elif way == 3:
        path.mkdir()
    elif way == 4:
        with path.open("wb") as file:
            file.truncate(int(10 ** rng.uniform(8.5, 11)))
    elif way == 5:
        path.write_bytes(b"x" * rng.choice((0, 1, 1_000_001)))
    else:
        path.symlink_to("nowhere")
    (folder / "table.csv").write_bytes(TABLE)
    (folder / "c.toml").write_bytes(CONFIG.replace(b'file = "quill"', b'file = "./' + path.name.encode() + b'"'))
    command(
        folder,
        *rng.choice(
            (
                ("check", "--config", path.name),
                ("check", "--config", "c.toml"),
                ("simulate", "table.csv", "--model", path.name, "--out", "out.csv"),
                ("simulate", path.name, "--model", "quill", "--out", "out.csv"),
                ("identify", "table.csv", path.name, "--out", "out.toml"),
                ("export", path.name, "--out", "out.csv"),
                ("replay", path.name),
                ("replay", "table.csv", "--public-key", path.name),
                ("watch", "--once", "--zenoh", path.name),
                ("bridge", "opcua", "--check", "--config", path.name),
                ("bridge", "probes", "--check", "--config", path.name),
                ("router", "--config", path.name),
            )
        ),
    )


def recording(rng: random.Random, folder: Path) -> None:
    """A recording is audited or refused; whatever it says of itself, it costs no memory."""
    path = folder / f"vmc-07_20260105T060000Z{rng.choice(('', '-001'))}.mcap"
    path.write_bytes(mutated(rng.randrange(2**32), _recorded()) if rng.randrange(3) else _without_end(rng))
    with little_memory():
        command(folder, "replay", path.name)
        command(folder, "export", path.name, "--out", "out.csv")


@functools.cache
def _recorded() -> bytes:
    """The bytes of a recording of an hour."""
    with tempfile.TemporaryDirectory() as folder:
        Service(Path(folder)).run(60).stop()
        (path,) = Path(folder).glob("*.mcap")
        return path.read_bytes()


def _without_end(rng: random.Random) -> bytes:
    """A recording of some kilobytes whose only group never ends: messages of zeros."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1000, compression=CompressionType.ZSTD)
    writer.start()
    schema = writer.register_schema("s", "jsonschema", b"{}")
    topics = [f"/{name}" for name in ("sample", "estimate", "offset", "event", "chain")]
    channels = [writer.register_channel(topic, "json", schema) for topic in topics]
    data = bytes(int(10 ** rng.uniform(0, 6.9)))
    for i in range(int(10 ** rng.uniform(0, min(3.0, 8.8 - math.log10(len(data) + 1))))):
        writer.add_message(channels[rng.randrange(2)], i, data, i, sequence=i)
    writer.finish()
    return file.getvalue()


@contextlib.contextmanager
def little_memory() -> Iterator[None]:
    """Check that this process takes no more than 300 MB more for a while."""
    before = _memory_mb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the largest so far is the present one
    yield
    assert _memory_mb("VmHWM") - before < 300.0


def _memory_mb(name: str) -> float:
    (line,) = (one for one in Path("/proc/self/status").read_text(encoding="ascii").splitlines() if name in one)
    return int(line.split()[1]) / 1024.0


def forged_numbers(rng: random.Random, folder: Path) -> None:
    """A service starts with what is on record, and each command has a result or names the place in one line."""
    attempt_start(rng, folder)
    name = f"it/{NAME}"
    (folder / "it").mkdir()
    forged(rng, folder / name)
    command(
        folder,
        *rng.choice(
            (
                ("replay", name),
                ("replay", name, "--model", "quill"),
                ("export", name, "--out", "out.csv"),
                ("report", name, "--out", "out.html"),
                ("diagnose", name, "--model", "quill", "--out", "found"),
            )
        ),
    )


def receiver_settings(rng: random.Random, folder: Path) -> None:
    """Settings of a receiver are refused, or it runs with them, whatever its files are."""
    names = ('"s.json"', '"/"', '"\\u0000"', f'"{"x" * 300}"', '"none/s.json"', '"receiver.toml"', '""')
    text = RECEIVER + f"state_file = {rng.choice(names)}\napplied_file = {rng.choice(names)}\n".encode()
    way = rng.randrange(3)
    (folder / "receiver.toml").write_bytes(text if way == 0 else changed(rng, RECEIVER if way == 1 else text))
    try:
        settings, _ = load_settings(folder / "receiver.toml")
        receiver: Any = Receiver(settings)
    except ReceiverError as error:
        assert "\n" not in str(error) and len(str(error)) < 2000, str(error)[:3000]
        return
    if way == 0:
        receiver._accepted = True
        receiver._save()
        if settings.applied_file:
            receiver.record(1.0)


def payloads(rng: random.Random, folder: Path) -> None:
    """A receiver survives what is published, and follows the service again."""
    Attack(rng, folder, check_clock=rng.random() < 0.5).run(20)


KINDS: dict[str, Callable[[random.Random, Path], None]] = {
    "payloads to a receiver": payloads,
    "configurations": configuration,
    "models": model,
    "tables": table,
    "files that are none": no_file,
    "recordings": recording,
    "recordings with forged numbers": forged_numbers,
    "settings of a receiver": receiver_settings,
}


def attempt(kind: str, seed: int, folder: Path) -> None:
    """Try the input of a kind and a seed.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    seed : int
        Makes the input; the same seed makes the same one.
    folder : pathlib.Path
        An empty folder.
    """
    began = time.monotonic()
    with alarm(PATIENCE_S):
        KINDS[kind](random.Random(seed), folder)
    assert time.monotonic() - began < PATIENCE_S, f"took {time.monotonic() - began:.0f} s"


def command(folder: Path, *arguments: str) -> None:
    """Run a command in a folder, as its user does."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(list(arguments))
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
    said = err.getvalue()
    assert code in (0, 1, 2, 3), (arguments, code)
    assert "Traceback" not in said, said[-3000:]
    if code in (1, 2):
        last = said.rpartition("compensator: ")[2]
        assert last.strip().count("\n") == 0 and len(last) < 2000, (arguments, said[-3000:])


@contextlib.contextmanager
def alarm(seconds: float) -> Iterator[None]:
    """Raise TimeoutError where something does not come back; in the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(*_: object) -> None:
        raise TimeoutError(f"not back after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


_CONFIG: Config = parse_config(CONFIG, source="made")
