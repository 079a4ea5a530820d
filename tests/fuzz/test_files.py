"""Whatever stands in a file: a result or one line that names it, exit code 0 or 2; no traceback, no growth."""

from __future__ import annotations

import functools
import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from compensator.cli import main
from compensator.config import parse_config
from compensator.data.measurement import read
from compensator.errors import CompensatorError, DataError
from compensator.model.model_file import parse_model, read_model_bytes
from compensator.recording.reading import recordings
from compensator.service.compensation import Compensation
from compensator.service.transfer.model_store import ModelStore
from tests.audit.made import CONFIG, Service
from tests.fuzz.mutation import mutated
from tests.service.records import QUILL, day
from tests.service.simulated import TABLE as TABLES
from tests.service.simulated import config

FUZZ = settings(max_examples=50, deadline=None, suppress_health_check=list(HealthCheck))
FEW = settings(FUZZ, max_examples=15)
SEED = st.integers(0, 2**32)
#: A configuration with a device of every family, as an engineer writes it.
WHOLE = (
    CONFIG.replace(b"line = []\n", b"").replace(b'device = [{name = "module"}]\n', b"")
    + b"""
[[channel]]
name = "spindle_rpm"
device = "module"
input = 4
[plausibility]
t_q_below_at_after_min = 15.0
false_alarm_days = 365.0
[plausibility.rest]
channel = "spindle_rpm"
at_most = 1.0
after_min = 300.0
t_q_at_max_k = 0.5
[[line]]
name = "a"
protocol = "modbus-tcp"
host = "127.0.0.1"
tcp_port = 1502
[[line]]
name = "b"
protocol = "dcon"
port = "/dev/ttyUSB0"
baudrate = 9600
[[line]]
name = "c"
protocol = "capancdt"
host = "127.0.0.1"
[[device]]
name = "module"
line = "a"
model = "modbus-map"
address = 1
inputs = [
  {input = 0, unit = "degc", address = 0, type = "float32", word_order = "little"},
  {input = 1, unit = "degc", address = 2, type = "int16", scale = 0.1, bad_values = {"32767" = "open_circuit"}},
  {input = 2, unit = "um", address = 3, type = "int32", minimum = -200.0, maximum = 200.0},
  {input = 3, unit = "degc", address = 5, type = "uint16", scale = 0.1, offset = -10.0},
  {input = 4, unit = "rpm", address = 6, type = "uint32"},
]
[[device]]
name = "bus"
line = "b"
model = "dcon"
address = 2
checksum = true
inputs = [{input = 0, couple = "K"}]
[[device]]
name = "probe"
line = "c"
model = "capancdt-6200"
inputs = [{input = 0}]
"""
)
TABLE = b"t_s,t_q_degc,at_degc,y_um,heat_w,coolant_degc\n" + b"".join(
    f"{60 * i},{20 + 0.01 * i:.3f},20.1,{0.02 * i:.3f},{30 if i > 20 else 0},{21 + i % 3}\n".encode() for i in range(90)
)
STAMPED = b"time_utc,t_q_degc,at_degc,y_um\n" + b"".join(
    f"2026-01-05T06:{i // 60:02d}:{i % 60:02d}Z,{20 + 0.01 * i:.3f},20.1,{0.02 * i:.3f}\n".encode() for i in range(300)
)


CHECKED = config(
    channel=[*TABLES["channel"], {"name": "spindle_rpm", "device": "module", "input": 4}],
    plausibility={"t_q_below_at_after_min": 15.0, "false_alarm_days": 365.0},
)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(scope="module")
def recorded(place: Path) -> bytes:
    service = Service(place / "made").run(20)
    path = service.recorder.path
    service.stop()
    assert path is not None
    return path.read_bytes()


def called(capfd: pytest.CaptureFixture[str], *arguments: str | Path) -> int:
    """Run a command as its user does; check what comes out of it and return the exit code."""
    capfd.readouterr()
    code = main([str(argument) for argument in arguments])
    _, said = capfd.readouterr()
    assert code in (0, 2), (code, said)
    assert "Traceback" not in said
    if code == 2:
        assert said.count("compensator: ") == 1 and said.rstrip().rpartition("compensator: ")[2].count("\n") == 0, said
    return code


def test_the_unchanged_inputs_are_good(place: Path, capfd: pytest.CaptureFixture[str], recorded: bytes) -> None:
    """Or the tests here would try nothing."""
    for name, data in (("c.toml", WHOLE), ("t.csv", TABLE), ("s.csv", STAMPED), ("r.mcap", recorded)):
        (place / name).write_bytes(data)
    assert called(capfd, "check", "--config", place / "c.toml") == 0
    for name in ("t.csv", "s.csv", "r.mcap"):
        assert called(capfd, "simulate", place / name, "--model", "quill", "--out", place / "out.csv") == 0
    assert called(capfd, "export", place / "r.mcap", "--out", place / "out.csv") == 0


@FUZZ
@given(seed=SEED)
def test_configurations(place: Path, capfd: pytest.CaptureFixture[str], seed: int) -> None:
    path = place / "machine.toml"
    path.write_bytes(mutated(seed, WHOLE))
    called(capfd, "check", "--config", path)


@FUZZ
@given(seed=SEED, stamped=st.booleans())
def test_tables(place: Path, capfd: pytest.CaptureFixture[str], seed: int, stamped: bool) -> None:
    path = place / "table.csv"
    path.write_bytes(mutated(seed, STAMPED if stamped else TABLE))
    called(capfd, "simulate", path, "--model", "quill", "--out", place / "out.csv")


@settings(FUZZ, max_examples=8)
@given(seed=SEED)
def test_tables_of_a_calibration(place: Path, capfd: pytest.CaptureFixture[str], seed: int) -> None:
    path = place / "run.csv"
    path.write_bytes(mutated(seed, TABLE))
    called(capfd, "identify", path, "--out", place / "made.toml")


@FUZZ
@given(seed=SEED)
def test_model_files(place: Path, capfd: pytest.CaptureFixture[str], seed: int) -> None:
    path, table = place / "model.toml", place / "good.csv"
    path.write_bytes(mutated(seed, read_model_bytes("quill")))
    table.write_bytes(TABLE)
    called(capfd, "simulate", table, "--model", path, "--out", place / "out.csv")


@pytest.mark.parametrize("time", ["1e308", "1e29", "1e12", "-1e15", "0001-01-01", "9999-12-31T23:59:59Z"])
def test_a_slip_in_a_time_takes_no_memory(place: Path, capfd: pytest.CaptureFixture[str], time: str) -> None:
    path = place / "slip.csv"
    stamped = "-" in time[1:]
    before = b"2026-01-05T06:00:07Z" if stamped else b"4980"
    data = (STAMPED if stamped else TABLE).replace(b"\n" + before + b",", b"\n" + time.encode() + b",")
    assert data not in (STAMPED, TABLE)
    path.write_bytes(data)
    assert called(capfd, "simulate", path, "--model", "quill", "--out", place / "out.csv") == 2


@FEW
@given(seed=SEED)
def test_recordings(place: Path, capfd: pytest.CaptureFixture[str], recorded: bytes, seed: int) -> None:
    path = place / "day.mcap"
    path.write_bytes(mutated(seed, recorded))
    called(capfd, "export", path, "--out", place / "out.csv")
    called(capfd, "simulate", path, "--model", "quill", "--out", place / "out.csv")


@FUZZ
@given(seed=SEED)
def test_stores_of_models(place: Path, seed: int) -> None:
    folder, quill = place / "models", read_model_bytes("quill")
    store = ModelStore(folder, quill, "vmc-07")
    if not (place / "adopted.json").exists():
        store.adopt(quill + b"\n# another\n", name="another", time_utc_ns=1)
        (place / "adopted.json").write_bytes((folder / "adopted.json").read_bytes())
    (folder / "adopted.json").write_bytes(mutated(seed, (place / "adopted.json").read_bytes()))
    for use in (store.in_use, store.before):
        try:
            use()
        except CompensatorError as error:
            assert "\n" not in str(error) and ("adopted" in str(error) or "models" in str(error))


@FUZZ
@given(seed=SEED)
def test_states(seed: int) -> None:
    other = Compensation(CHECKED, QUILL)
    try:
        other.restore(mutated(seed, _state_at_work()))
    except DataError as error:
        assert "\n" not in str(error)
        return
    # What was taken over is gone on with: a number or nothing, never an exception.
    for raw in day(15):
        other.process(raw)
    other.state()


@functools.cache
def _state_at_work() -> bytes:
    compensation = Compensation(CHECKED, QUILL)
    for raw in day(60, lost={"t_q_degc": [range(55, 60)]}):
        compensation.process(raw)
    return compensation.state()


def test_refusals_keep_no_memory(place: Path) -> None:
    """A service that is offered rubbish for a year must not grow by it."""
    path = place / "grow.csv"

    def refuse(read: Callable[[], object]) -> None:
        try:
            read()
        except CompensatorError:
            return

    def all_of(seeds: range) -> None:
        for seed in seeds:
            path.write_bytes(mutated(seed, TABLE))
            refuse(lambda seed=seed: parse_config(mutated(seed, WHOLE), source="x"))  # type: ignore[misc]
            refuse(lambda seed=seed: parse_model(mutated(seed, read_model_bytes("quill")), source="x"))  # type: ignore[misc]
            refuse(lambda: read(path).at_period(60.0))
        gc.collect()

    all_of(range(40))
    tracemalloc.start()
    all_of(range(40))
    first = tracemalloc.get_traced_memory()[0]
    all_of(range(40))
    grown = tracemalloc.get_traced_memory()[0] - first
    tracemalloc.stop()
    assert grown < 100_000, grown
    assert recordings(place, "nobody") == []
