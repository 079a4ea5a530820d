"""Whatever goes wrong inside, the offset is held and it is said."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import pytest

from compensator.messages import Offset
from drivers.reading import Reading
from tests.service.simulated import Bench


@pytest.mark.parametrize("where", ["driver", "model"])
async def test_a_defect_holds_the_offset_until_resume(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    async def defective() -> Mapping[int, Reading]:
        raise ZeroDivisionError("a defect")

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    def break_it() -> None:
        if where == "driver":
            monkeypatch.setattr(bench.device, "read", defective)
        else:
            monkeypatch.setattr(bench.daemon._compensation, "process", broken)

    bench.at_sample[100] = break_it
    turns = 0

    async def repaired(seconds: float) -> None:
        nonlocal turns
        turns += 1
        if turns == 6 * 110:
            monkeypatch.undo()
        if turns == 6 * 115:
            bench.daemon.command("resume", b"")
        await type(bench.clock).sleep(bench.clock, seconds)

    bench.daemon._clock = _Sleeper(bench.clock, repaired)  # not by monkeypatch, which is undone half-way
    await bench.run(125)
    sent = [msgspec.json.decode(d, type=Offset) for n, d in bench.published if n == "offset"]
    assert [o.seq for o in sent] == list(range(125))
    held = sent[101:109]
    assert all(o.state == "hold" and "internal_error" in o.reasons for o in held)
    assert {o.y_offset_um for o in held} == {sent[99].y_offset_um}
    assert sent[112].state == "hold"  # nobody has looked at it yet
    assert sent[-1].state in ("ok", "degraded")
    told = [msgspec.json.decode(d)["text"] for n, d in bench.published if n == "event"]
    assert "internal error: ZeroDivisionError: a defect" in told


class _Sleeper:
    """A clock whose sleep is replaced."""

    def __init__(self, clock: object, sleep: object) -> None:
        self._inner = clock
        self.sleep = sleep

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)
