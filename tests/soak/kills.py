"""kill −9 at random moments: what a receiver got is on disk and signed, nothing jumps, every recording audits clean."""

from __future__ import annotations

import json
import random
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from tests.audit.test_signatures import write_key
from tests.ports import free_port
from tests.soak.site import Receiver, Site, check_received, end, is_early

#: When to kill: at any time; when a finished file is being made compact; when a model is being taken over.
MOMENTS = ("any", "any", "any", "compacting", "adopting")


@dataclass
class Killed:
    """What came of it."""

    kills: dict[str, int] = field(default_factory=lambda: dict.fromkeys(MOMENTS, 0))
    offsets: int = 0
    early: int = 0
    early_lost: int = 0
    recorded: int = 0
    files: int = 0
    models: int = 0
    largest_share_of_rate: float = 0.0
    seconds: float = 0.0


class _Round:
    def __init__(self, site: Site, receiver: Receiver, seed: int) -> None:
        self.site, self.receiver, self.random = site, receiver, random.Random(seed)
        base = site.model.read_text(encoding="utf-8")
        self.models = [
            base + f'\n[[effect]]\nkind = "gain"\npath = "DTF"\nchange = {change}\n' for change in (0.1, 0.2)
        ]
        self.result = Killed()

    def kill(self, moment: str, longest_s: float) -> None:
        """Start the service, kill it at some moment, see that all that was received is there."""
        got = len(self.receiver.offsets)
        process = self.site.start()
        try:
            if moment == "compacting":
                moment = self._compacting(got)
            else:
                self.receiver.wait(lambda: len(self.receiver.offsets) > got, f"{moment}: an offset after the start")
            if moment == "any":
                time.sleep(self.random.uniform(0.0, longest_s))
            elif moment == "adopting":
                self._adopt()
                time.sleep(self.random.uniform(0.0, 0.3))
        finally:
            said = end(process)
        assert "Traceback" not in said, said
        self.result.kills[moment] += 1
        self._look()

    def _compacting(self, got: int) -> str:
        """Wait for the copy of a finished file; one that was too quick is left alone."""
        while not any(self.site.recordings.glob("*.part")):
            if len(self.receiver.offsets) > got + 2:
                return "any"
            time.sleep(0.0002)
        return "compacting"

    def _adopt(self) -> None:
        model = self.random.choice(self.models)
        payload = json.dumps({"model": model, "force": True}).encode()
        key = f"{self.site.prefix}/thermal/command/adopt"
        # The reply is not waited for: the service may be dead before.
        self.receiver.session.get(key, lambda reply: None, payload=payload, timeout=5.0)

    def _look(self) -> None:
        on_disk = self.site.on_disk(newest=2)
        for data in self.receiver.offsets[-20:]:
            if not is_early(data) and json.loads(data)["seq"] >= min(on_disk, default=0):
                assert on_disk.get(json.loads(data)["seq"]) == data, data


def run(folder: Path, kills: int, *, seed: int = 1, longest_s: float = 2.0, period_s: float = 0.5) -> Killed:
    """Kill the service so often, then audit everything."""
    began = time.monotonic()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    _, public_key = write_key(folder, "machine", 7)
    with (
        Receiver("shop/vmc-07", mode="peer", listen__endpoints=[endpoint]) as receiver,
        Site(folder, connect=[endpoint], period_s=period_s, extra='signing_key = "machine.pem"') as site,
    ):
        rounds = _Round(site, receiver, seed)
        moments = [MOMENTS[i % len(MOMENTS)] for i in range(kills)]
        rounds.random.shuffle(moments)
        for moment in moments:
            rounds.kill(moment, longest_s)
        with site.service() as last:
            receiver.more(2)
            last.terminate()
            assert last.wait(60) == 0
        result = rounds.result
        judge(site, receiver, result, period_s, public_key)
    result.seconds = time.monotonic() - began
    return result


def judge(site: Site, receiver: Receiver, result: Killed, period_s: float, public_key: Path) -> None:
    """Nothing received is missing, nothing repeats or jumps, everything audits clean."""
    on_disk = site.on_disk()
    for data in receiver.offsets:
        seq = json.loads(data)["seq"]
        if is_early(data):
            result.early += 1
            result.early_lost += seq not in on_disk
        else:
            assert on_disk.get(seq) == data, data
    figures = check_received(receiver.offsets, period_s)
    result.models = len({message["model_sha256"] for message in receiver.messages})
    result.offsets, result.recorded = len(receiver.offsets), len(on_disk)
    result.largest_share_of_rate = figures["largest_share_of_rate"]
    audit = site.replay(public_key)
    assert audit["exit"] == 0, audit
    result.files = len(audit["files"])


def side_by_side(folder: Path, kills: int, machines: int, seed: int) -> list[Killed]:
    """Several machines at once, so that the computer is busy."""
    places = [folder / f"machine-{i}" for i in range(machines)]
    for place in places:
        place.mkdir()
    with ThreadPoolExecutor(machines) as pool:
        jobs = [pool.submit(run, place, kills // machines, seed=seed + i) for i, place in enumerate(places)]
        return [job.result() for job in jobs]
