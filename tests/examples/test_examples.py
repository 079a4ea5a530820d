"""The examples of deploy/examples, run as their users run them: as programs, from another folder."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import zenoh

from compensator.config import Zenoh
from compensator.demo.day import run_day
from compensator.messages import SCHEMA, Offset, encode
from compensator.recording.reading import read_messages, recordings
from compensator.service.publisher import session_config
from tests.ports import free_port

EXAMPLES = Path(__file__).resolve().parents[2] / "deploy/examples"
PREFIX = "shop/vmc-07"


def run(words: Sequence[str | Path], folder: Path, timeout_s: float = 100.0) -> str:
    done = subprocess.run([str(w) for w in words], cwd=folder, capture_output=True, text=True, timeout=timeout_s)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished recording of two simulated hours."""
    folder = tmp_path_factory.mktemp("day")
    run_day(folder, machine="published", hours=2.0, seed=3)
    return recordings(folder / "recordings", "sim-published")[0]


def figures(day: Path) -> tuple[int, float, float]:
    """Samples, largest deformation and largest remainder, by the project's own reader."""
    rows: dict[int, dict[str, float]] = {}
    for record in read_messages(day, ("estimate", "offset")):
        message = json.loads(record.data)
        rows.setdefault(message["seq"], {}).update({k: message[k] for k in ("y_um", "y_offset_um") if k in message})
    y, offset = (np.array([row[name] for row in rows.values()], dtype=float) for name in ("y_um", "y_offset_um"))
    return y.size, float(np.abs(y).max()), float(np.abs(y + offset).max())


def test_a_subscriber_prints_what_is_published_and_says_when_to_hold(tmp_path: Path) -> None:
    messages = [
        Offset(
            schema=SCHEMA,
            machine="vmc-07",
            seq=48213 + i,
            time_utc_ns=1,
            valid_for_s=150.0,
            y_offset_um=value,
            y_offset_rate_um_per_min=rate,
            y_offset_std_um=0.4,
            state=state,
            reasons=reasons,
            model_sha256="",
        )
        for i, (value, rate, state, reasons) in enumerate(
            (
                (-12.34, -0.81, "ok", []),
                (-13.0, 0.0, "degraded", ["predicting"]),
                (None, None, "starting", ["no_zero"]),
            )
        )
    ]
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with zenoh.open(session_config(Zenoh(prefix=PREFIX, mode="peer", listen=[endpoint]))) as session:
        publisher = session.declare_publisher(f"{PREFIX}/thermal/y/offset")
        matched = threading.Event()
        listener = publisher.declare_matching_listener(lambda status: matched.set() if status.matching else None)
        with subprocess.Popen(
            [sys.executable, EXAMPLES / "subscriber.py", endpoint, PREFIX, "3"],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            try:
                assert matched.wait(60.0)
                for message in messages:
                    publisher.put(encode(message), encoding="application/json")
                out, errors = process.communicate(timeout=60.0)
            finally:
                process.kill()
                listener.undeclare()
    assert process.returncode == 0, errors
    assert out.splitlines() == [
        "48213 ok -12.34 µm -0.81 µm/min",
        "48214 degraded -13.00 µm +0.00 µm/min",
        "48215 starting ['no_zero']: hold",
    ]
    assert len((EXAMPLES / "subscriber.py").read_text(encoding="utf-8").splitlines()) <= 21


def test_pandas_reads_a_recording(day: Path, tmp_path: Path) -> None:
    count, _, left = figures(day)
    out = run([sys.executable, "-W", "error", EXAMPLES / "recording_pandas.py", day], tmp_path)
    assert out.startswith(f"{count} samples, ")
    table = {row.split()[0]: [float(v) for v in row.split()[1:]] for row in out.splitlines()[-4:]}
    assert max(abs(table["min"][2]), abs(table["max"][2])) == pytest.approx(left, abs=0.006)


def test_javascript_reads_a_recording_finished_or_torn(day: Path, tmp_path: Path) -> None:
    install(tmp_path)
    count, largest, left = figures(day)
    out = run(["node", "recording.mjs", day], tmp_path)
    said = re.search(r"(\d+) samples with Y measured: at most ([\d.]+) µm, with the offset ([\d.]+) µm", out)
    assert said is not None, out
    assert int(said[1]) == count
    assert [float(said[2]), float(said[3])] == pytest.approx([largest, left], abs=0.006)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(day.read_bytes()[:-200])
    assert f"{count} samples" in run(["node", "recording.mjs", torn], tmp_path)


def install(folder: Path) -> None:
    """Install the packages of package.json as its user would, or skip in words where that cannot be done here."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("no node or npm on this machine: the example in JavaScript was not run")
    for name in ("package.json", "recording.mjs"):
        shutil.copy(EXAMPLES / name, folder)
    words = [
        "npm",
        "install",
        "--no-audit",
        "--no-fund",
        "--ignore-scripts",
        "--fetch-retries=0",
        "--fetch-timeout=15000",
    ]
    try:
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=60.0, env=dict(os.environ))
    except subprocess.TimeoutExpired:
        pytest.skip("npm reached no registry within a minute: the example in JavaScript was not run")
    if done.returncode:
        pytest.skip(f"npm could not install @mcap/core: the example in JavaScript was not run: {done.stderr[:200]}")
