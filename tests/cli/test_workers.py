"""Large commands on all cores and on a Dask cluster say what they say alone."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from compensator.cli import main
from compensator.commands import diagnose as diagnose_command
from compensator.commands.workers import in_parallel
from compensator.demo.calibration import write_table
from compensator.diagnose import diagnosis
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.findings import Findings, findings_of
from compensator.errors import ServiceError
from tests.audit.made import START_NS, Service
from tests.cli.jobs import ended_job, job
from tests.diagnose.scenarios import draw, record
from tests.shared_folder import search_once

MINUTE_NS = 60_000_000_000
CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a cluster of two workers, in processes of its own."""
    pytest.importorskip("distributed")
    script = tmp_path_factory.mktemp("cluster") / "cluster.py"
    script.write_text(CLUSTER)
    environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as cluster:
        assert cluster.stdin and cluster.stdout
        assert select.select([cluster.stdout], [], [], 100.0)[0], "the cluster does not start"
        yield cluster.stdout.readline().strip()
        cluster.stdin.close()


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    columns, _, _ = record([draw("input", 4)], 79, 10.0)
    path = tmp_path_factory.mktemp("data") / "effect.csv"
    write_table(path, {"t_s": np.arange(columns["y_um"].size) * 60.0, **columns})
    return path


def found(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, object]]:
    code = main([*arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def diagnosed(table: Path, out: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[bytes, object]:
    code, result = found(["diagnose", str(table), "--model", "quill", "--out", str(out), *more], capsys)
    assert code == 0
    return (out / "diagnosis.json").read_bytes(), result["model_sha256"]


def test_a_cluster_audits_and_finds_what_one_process_does(
    tmp_path: Path, scheduler: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Service(tmp_path, start_ns=START_NS + (17 * 60 + 50) * MINUTE_NS).run(30).stop()
    monkeypatch.chdir(tmp_path)
    alone = found(["replay", "."], capsys)
    assert alone[0] == 0
    assert found(["replay", ".", "--scheduler", scheduler], capsys) == alone
    last = max(tmp_path.glob("*.mcap"))
    data = bytearray(last.read_bytes())
    at = data.find(b'"y_offset_um":') + 16
    data[at] ^= 1
    last.write_bytes(data)
    edited = found(["replay", "."], capsys)
    assert edited[0] == 3
    assert found(["replay", ".", "--scheduler", scheduler], capsys) == edited


@pytest.mark.usefixtures("without_pictures")
def test_a_cluster_and_all_cores_diagnose_as_one_process_does(
    tmp_path: Path,
    table: Path,
    scheduler: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Each held-out block by others than this process; what it finds itself in all data is found once."""
    found = list[Findings]()

    def once(evidence: Evidence) -> Findings:
        if not found:
            found.append(findings_of(evidence))
        return found[0]

    monkeypatch.setattr(diagnosis, "findings_of", once)
    with monkeypatch.context() as patch:
        search_once(patch, tmp_path_factory)
        alone = diagnosed(table, tmp_path / "alone", capsys)
    assert diagnosed(table, tmp_path / "cluster", capsys, "--scheduler", scheduler) == alone
    monkeypatch.setattr(diagnose_command, "ALONE", 0)
    assert diagnosed(table, tmp_path / "cores", capsys) == alone


@pytest.mark.parametrize(
    ("address", "code", "words"),
    [("tcp://127.0.0.1:9", 1, "no scheduler answered"), ("nonsense://x", 2, "expected an address")],
)
def test_a_cluster_that_is_not_there_is_said_in_one_line(
    tmp_path: Path,
    address: str,
    code: int,
    words: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("compensator.commands.workers.SCHEDULER_S", 1.0)
    Service(tmp_path).run(3).stop()
    assert main(["replay", str(tmp_path), "--scheduler", address]) == code
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("cores", [1, 2])
def test_independent_jobs_give_their_results_in_order_in_processes_of_their_own(
    cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    told: list[tuple[int, int]] = []
    results = in_parallel([partial(job, i) for i in range(3)], lambda done, total: told.append((done, total)))
    assert [number for number, _ in results] == [0, 1, 2]
    assert {pid == os.getpid() for _, pid in results} == {cores == 1}
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    with pytest.raises(ServiceError, match="job 1 cannot be done"):
        in_parallel([partial(job, i, refused=i == 1) for i in range(3)], lambda done, total: None)


def test_a_process_that_is_ended_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    with pytest.raises(ServiceError, match="one of 2 processes was ended from outside"):
        in_parallel([ended_job, ended_job], lambda done, total: None)
