"""`zero`, `hold` and `resume` where no service hears them: one line that says how far they came."""

from __future__ import annotations

import fcntl
import json
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from compensator.cli import main
from compensator.commands.probes import CommandSink
from compensator.config import Zenoh
from compensator.probes.probe import NotSent, Probe
from compensator.probes.settings import Service
from compensator.service import presence
from compensator.service.presence import is_used, sole_user
from compensator.service.publisher import Publisher
from tests.ports import free_port


def operator(folder: Path, port: int) -> str:
    path = folder / "operator.json5"
    path.write_text(json.dumps({"mode": "client", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]}}))
    return str(path)


@pytest.mark.parametrize("command", ["zero", "hold", "resume"])
def test_an_endpoint_at_which_nobody_answers_is_named(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = free_port()
    assert main([command, "--prefix", "shop/vmc-07", "--zenoh", operator(tmp_path, port)]) == 1
    error = capsys.readouterr().err
    assert f"shop/vmc-07: the service cannot be reached: nothing answers at tcp/127.0.0.1:{port}" in error
    assert error.count("\n") == 1


def test_a_wrong_prefix_is_told_from_a_service_that_is_away(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    settings = Zenoh(prefix="shop/vmc-07", mode="peer", listen=[f"tcp/127.0.0.1:{port}"])
    with Publisher(settings, lambda *_: {"ok": True, "text": "held"}):
        assert main(["hold", "--prefix", "shop/vmc-70", "--zenoh", operator(tmp_path, port), "--timeout", "2"]) == 1
        error = capsys.readouterr().err
        assert "no service with that prefix" in error and "services there: shop/vmc-07\n" in error
        assert main(["hold", "--prefix", "shop/vmc-07", "--zenoh", operator(tmp_path, port)]) == 0
        capsys.readouterr()
        assert main(["watch", "--connect", f"tcp/127.0.0.1:{port}", "--prefix", "shop/vmc-70", "--once"]) == 1
        error = capsys.readouterr().err
        assert "no messages below shop/vmc-70" in error and "services there: shop/vmc-07\n" in error


@pytest.mark.parametrize("reply", [[], None, "held", {}, {"ok": "no", "text": "not held"}, {"ok": True, "text": 1}])
def test_an_answer_that_is_not_that_of_a_service_is_no_success(
    reply: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = free_port()
    settings = Zenoh(prefix="shop/vmc-07", mode="peer", listen=[f"tcp/127.0.0.1:{port}"])
    with Publisher(settings, lambda *_: reply):
        assert main(["hold", "--prefix", "shop/vmc-07", "--zenoh", operator(tmp_path, port)]) == 1
        error = capsys.readouterr().err
        assert "the answer is not that of a service" in error and "Traceback" not in error
        service = Service(prefix="shop/vmc-07", send_within_s=60.0, connect=(f"tcp/127.0.0.1:{port}",))
        with pytest.raises(NotSent, match="not that of a service"):
            CommandSink(service, "probes.toml").send(Probe(time_utc_ns=1, measured_um=1.0, offset_applied_um=0.0))


def test_a_service_that_answers_late_may_act_and_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port, asked, told = free_port(), threading.Event(), threading.Event()

    def late(*_: Any) -> Any:
        asked.set()
        told.wait(60.0)
        return {"ok": True, "text": "held"}

    settings = Zenoh(prefix="shop/vmc-07", mode="peer", listen=[f"tcp/127.0.0.1:{port}"])
    with Publisher(settings, late):
        words = ["hold", "--prefix", "shop/vmc-07", "--zenoh", operator(tmp_path, port), "--timeout", "1"]
        code, error = main(words), capsys.readouterr().err
        told.set()
    assert code == 1 and asked.is_set()
    assert "has not answered within 1 s, so it is unknown whether the command acts: look at" in error


def test_a_folder_that_a_service_holds_is_known_to_be_held(tmp_path: Path) -> None:
    assert not is_used(tmp_path, "vmc-07") and list(tmp_path.iterdir()) == []
    with sole_user(tmp_path, "vmc-07"):
        assert is_used(tmp_path, "vmc-07") and not is_used(tmp_path, "vmc-08")
    assert not is_used(tmp_path, "vmc-07")
    with sole_user(tmp_path, "vmc-07"):  # looking did not keep it
        pass


def test_a_start_is_not_refused_because_a_command_looks_at_its_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with sole_user(tmp_path, "vmc-07"):
        pass
    with (tmp_path / "vmc-07.lock").open() as looks:
        fcntl.flock(looks, fcntl.LOCK_SH)  # as `is_used` does
        monkeypatch.setattr(presence.time, "sleep", lambda _: fcntl.flock(looks, fcntl.LOCK_UN))
        with sole_user(tmp_path, "vmc-07"):
            assert is_used(tmp_path, "vmc-07")


def test_a_pipe_in_the_place_of_the_lock_is_asked_without_waiting_for_its_writer(tmp_path: Path) -> None:
    os.mkfifo(lock := tmp_path / "vmc-07.lock")
    asks = threading.Thread(target=lambda: is_used(tmp_path, "vmc-07"), daemon=True)
    asks.start()
    asks.join(5.0)
    try:
        assert not asks.is_alive()
    finally:
        os.close(os.open(lock, os.O_RDWR))
