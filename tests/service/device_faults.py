"""What the receiver must see of every fault that a simulated device or line can make.

`EXPECTED` is the table: one row for each carrier and kind of fault. A kind that a simulated device has and that has no
row fails a test, and so does an error or quality of the drivers that no row ever shows.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from compensator.messages import Offset, Sample, number
from compensator.model.model_file import load_model
from compensator.service.compensation import Compensation, Outcome
from sim_hardware.physics import PublishedQuill, SensorSpec, World
from sim_hardware.wire import Rack
from sim_hardware.wire.capancdt import CAPANCDT_FAULTS
from sim_hardware.wire.dcon import DCON_FAULTS
from sim_hardware.wire.faults import INPUT_FAULTS
from sim_hardware.wire.modbus_servers import RTU_FAULTS, TCP_FAULTS
from tests.service.records import sample
from tests.service.simulated import CHANNELS, TABLE, config, working_day
from tests.service.wired import Receiver, WiredMachine

ROLES = ("t_q_degc", "at_degc", "y_um")
#: Carrier of each channel, by layout.
CARRIERS = {
    "apart": ("modbus-rtu", "modbus-tcp", "capancdt"),
    "one line": ("modbus-rtu", "modbus-rtu", "capancdt"),
    "dcon": ("dcon", "dcon", "capancdt"),
    "map": ("map float32", "map int16", "capancdt"),
}
SUPPORTED = {
    "modbus-rtu": RTU_FAULTS | INPUT_FAULTS,
    "modbus-tcp": TCP_FAULTS | INPUT_FAULTS,
    "dcon": DCON_FAULTS | {"bad_crc"} | INPUT_FAULTS,
    "capancdt": CAPANCDT_FAULTS | INPUT_FAULTS,
}
_SILENT = {"device_timeout"}
_GARBLED = {"device_garbled", "device_timeout"}
#: What a request to a line that is gone, or is just coming back, ends in.
_GONE = {"device_disconnected", "device_timeout"}
#: Two replies at once: the second is that of the request, and is taken; the first has been given up by then.
_ALTERNATING = {*_GARBLED, "good"}
HARMLESS: frozenset[str] = frozenset()
OLD = frozenset({"the last value until the guard `stuck`"})
_LINE = {
    "silence": _SILENT,
    "late": _GARBLED,
    "join": _ALTERNATING,
    "garbage": _GARBLED,
    "truncate": _GARBLED,
    "wrong_length": _GARBLED,
    "bad_crc": _GARBLED,
    "disconnect": _GONE,
    "exception": {"device_refused"},
    "split": HARMLESS,
    "frozen": OLD,
    "wild": {"out_of_range"},
}
_COUPLE = {"open": {"open_circuit"}, "over": {"open_circuit", "over_range"}, "under": {"under_range"}}
_CONTROLLER = {
    "late": _ALTERNATING,
    "exception": HARMLESS,
    "gap": HARMLESS,
    "stale_counter": _GARBLED | OLD,
    "open": {"over_range"},
    "over": {"over_range"},
    "under": {"under_range"},
    "wild": {"out_of_range", "over_range"},
}
#: carrier → kind → codes of which one stands in every sample while the fault lasts.
EXPECTED: dict[str, dict[str, frozenset[str]]] = {
    carrier: {kind: frozenset(codes) for kind, codes in rows.items() if kind in SUPPORTED[carrier]}
    for carrier, rows in {
        "modbus-rtu": {**_LINE, **_COUPLE},
        "modbus-tcp": {**_LINE, **_COUPLE},
        "dcon": {**_LINE, **_COUPLE},
        "capancdt": {**_LINE, **_CONTROLLER},
    }.items()
}
#: What only a configured register map can say.
EXPECTED["map float32"] = {"open": frozenset({"invalid"})}
EXPECTED["map int16"] = {"open": frozenset({"stale"})}
PARAMETERS: dict[str, dict[str, float]] = {"late": {"delay_s": 1.0}, "split": {"pieces": 3}, "gap": {"frames": 5}}
#: Beyond the range of the channel; within that of the device.
WILD = {"t_q_degc": 300.0, "at_degc": 200.0, "y_um": 495.0}
#: How far a reading may be from the simulated machine's truth: the step of the coarsest module.
TOLERANCE = {"t_q_degc": 0.11, "at_degc": 0.11, "y_um": 0.1}

#: A minute by the clock of the loop, s: the latest reply arrives in it, and the controller is not taken for silent.
MINUTE_S = 3.0
HOUR = 60
PREDICTED = 10
RATE = float(TABLE["limits"]["offset_rate_max_um_per_min"])
#: Samples before the first fault, and after each: an offset at its largest rate must have arrived.
LEAD, REST = 40, {1: 5, HOUR: 15}
#: An offset after a fault lies within so many of its stated standard deviations of that of a run without it.
WITHIN_STD = {1: 0.4, HOUR: 2.0}


@dataclass(frozen=True, slots=True)
class Episode:
    """Faults on one machine at the same time.

    Parameters
    ----------
    places : tuple of (str, str)
        Channel and kind.
    samples : int
        For how long.
    """

    places: tuple[tuple[str, str], ...]
    samples: int


@dataclass(slots=True)
class Seen:
    """What the receiver saw of an episode."""

    layout: str
    episode: Episode
    codes: dict[str, set[str]] = field(default_factory=dict)
    states: list[str] = field(default_factory=list)
    std_before_um: float = 0.0
    std_most_um: float = 0.0
    distance_um: float = 0.0
    std_after_um: float = 0.0
    #: Samples in which the test machine itself was too slow for a healthy device.
    slow: int = 0


@dataclass(slots=True)
class Course:
    """Episodes of one machine, one after the other."""

    layout: str
    episodes: list[Episode]

    @property
    def samples(self) -> int:
        return LEAD + sum(e.samples + REST[e.samples] for e in self.episodes)


def make_world() -> World:
    """A machine whose sensors have no noise, so that every number can be checked."""
    return World(PublishedQuill(), working_day(1, 48.0), {name: SensorSpec() for name in CHANNELS[:3]}, 1)


@functools.cache
def reference(samples: int) -> np.ndarray:
    """Offsets of a service without wires that always had the truth, µm."""
    world, compensation = make_world(), Compensation(config(channel=TABLE["channel"][:3]), load_model("quill"))
    offsets = []
    for i in range(samples):
        world.advance_to(60.0 * (i + 1))
        values = {name: world.truth(name) for name in ROLES}
        offsets.append(number(compensation.process(sample(i, values)).offset.y_offset_um))
    return np.array(offsets)


async def run_course(rack: Rack, receiver: Receiver, folder: Path, name: str, course: Course) -> list[Seen]:
    """Run a machine through its episodes and check everything that was received.

    Raises
    ------
    AssertionError
        Naming episode, sample and what is wrong.
    """
    machine = WiredMachine(rack, folder, make_world(), name=name, layout=course.layout, receiver=receiver)
    machine.minute_s = MINUTE_S
    truth: list[dict[str, float]] = []
    begins, ends = _timetable(course)

    def after(outcome: Outcome) -> None:
        truth.append({role: machine.world.truth(role) for role in ROLES})
        done = len(machine.outcomes)
        if done in begins:
            for channel, kind in begins[done].places:
                _switch_on(machine, channel, kind)
        faulty = any(begin <= done < begin + e.samples for begin, e in begins.items())
        if not faulty and any(channel.quality != "good" for channel in outcome.sample.channels.values()):
            # Test machines may be slow: simulated time waits for them, but never within a fault.
            machine.waits_for = set(ROLES)
        if done in ends:
            for channel, _ in ends[done].places:
                machine.faults[channel][0].clear()
            # Devices on the line of a fault are asked again, too.
            machine.waits_for = set(ROLES)

    machine.after = after
    await machine.run(course.samples)
    offsets, samples = machine.offsets, machine.samples
    _check_stream(name, course, offsets, samples)
    return [_check(course, begin, e, samples, offsets, truth) for begin, e in begins.items()]


def _timetable(course: Course) -> tuple[dict[int, Episode], dict[int, Episode]]:
    begins, ends, at = {}, {}, LEAD
    for episode in course.episodes:
        begins[at], ends[at + episode.samples] = episode, episode
        at += episode.samples + REST[episode.samples]
    return begins, ends


def _switch_on(machine: WiredMachine, channel: str, kind: str) -> None:
    faults, entry = machine.faults[channel]
    parameters = {"value": WILD[channel]} if kind == "wild" else PARAMETERS.get(kind, {})
    if kind in INPUT_FAULTS:
        faults.set(kind, input=entry, **parameters)
    else:
        faults.set(kind, **parameters)


def _check_stream(name: str, course: Course, offsets: Sequence[Offset], samples: Sequence[Sample]) -> None:
    """Check what holds at all times: one message a minute, each with a number, never a step beyond the rate."""
    assert [o.seq for o in offsets] == [s.seq for s in samples] == list(range(course.samples)), name
    for a, b in itertools.pairwise(offsets):
        assert b.time_utc_ns - a.time_utc_ns == 60_000_000_000
        if a.state != "starting":
            assert a.y_offset_um is not None and b.y_offset_um is not None and b.y_offset_std_um is not None
            assert abs(b.y_offset_um - a.y_offset_um) <= RATE + 1e-9, (name, b)
    assert all(o.state != "starting" for o in offsets[LEAD // 2 :]), name
    for s in samples:
        for channel in s.channels.values():
            assert (channel.quality == "good") == (channel.mean is not None) or channel.device_quality == "good"
            assert channel.mean is None or channel.mean != 0.0


def _check(
    course: Course,
    begin: int,
    episode: Episode,
    samples: Sequence[Sample],
    offsets: Sequence[Offset],
    truth: Sequence[dict[str, float]],
) -> Seen:
    end = begin + episode.samples
    seen = Seen(course.layout, episode, {role: set() for role in ROLES})
    seen.std_before_um = number(offsets[begin - 1].y_offset_std_um)
    carriers = dict(zip(ROLES, CARRIERS[course.layout], strict=True))
    kinds = dict(episode.places)
    held = {role: number(samples[begin - 1].channels[role].mean) for role in ROLES}
    lost, before = 0, seen.std_before_um
    for i in range(begin, end):
        context = (course.layout, episode, i - begin, offsets[i])
        for role in ROLES:
            true = _true(samples, role, truth, i, late=kinds.get(role) == "late")
            _check_channel(samples[i], role, kinds, carriers, course, true, held[role], seen, context)
        missing = [role for role in ROLES[:2] if samples[i].channels[role].quality != "good"]
        lost = lost + 1 if missing else 0
        std = number(offsets[i].y_offset_std_um)
        if missing:
            assert {f"{role[:-5]}_missing" for role in missing} <= set(offsets[i].reasons), context
            # What is left of an earlier fault still fades at first; then nothing but the loss counts.
            assert lost < 30 or std >= before - 1e-9, context
            assert offsets[i].state == ("hold" if lost > PREDICTED else "degraded"), context
            if lost > PREDICTED:
                assert "prediction_expired" in offsets[i].reasons, context
                assert offsets[i].y_offset_um == offsets[i - 1].y_offset_um or lost == PREDICTED + 1, context
            before = std
        elif lost == 0 and not any(OLD & EXPECTED[carriers[c]][k] for c, k in episode.places):
            assert offsets[i].state in ("ok", "degraded"), context
        seen.states.append(offsets[i].state)
        seen.std_most_um = max(seen.std_most_um, std)
    _check_recovery(course, episode, end, samples, offsets, truth, seen)
    return seen


def _true(
    samples: Sequence[Sample], role: str, truth: Sequence[dict[str, float]], i: int, *, late: bool = False
) -> float:
    """Return what a channel should have given.

    A device that was slow gives its value to the next poll, which in real time is the one after; and the controller's
    mean is that of the blocks since the last read, of 10 s at most. Where simulated minutes take milliseconds both may
    reach back over several of them: not so a serial or Modbus device that answered in the sample before. One that is a
    second late is late by dozens.
    """
    answered = role != "y_um" and not late and samples[i - 1].channels[role].quality == "good"
    zero = 250.0 if role == "y_um" else 0.0
    recent = [one[role] + zero for one in truth[max(i - (1 if answered else 60 if late else 12), 0) : i + 1]]
    mean = number(samples[i].channels[role].mean)
    return mean if min(recent) <= mean <= max(recent) else recent[-1]


def _check_channel(
    message: Sample,
    role: str,
    kinds: dict[str, str],
    carriers: dict[str, str],
    course: Course,
    true: float,
    held: float,
    seen: Seen,
    context: tuple[object, ...],
) -> None:
    channel = message.channels[role]
    seen.codes[role].add(channel.quality)
    frozen = kinds.get(role) == "frozen"
    assert channel.quality != "good" or channel.count >= 1, (role, channel, context)
    # A stream that is a second late is late by many simulated minutes.
    behind = role == "y_um" and kinds.get(role) == "late"
    if channel.quality == "good" and not frozen and not behind:
        # Whatever happens on the wire: a value that is given is the machine's own of this minute.
        assert abs(number(channel.mean) - true) <= TOLERANCE[role], (role, channel, true, context)
    elif channel.quality == "good" and frozen:
        assert abs(number(channel.mean) - held) <= TOLERANCE[role] + 0.5, (role, channel, held, context)
    elif channel.quality != "good":
        assert channel.mean is None or channel.device_quality == "good", (role, channel, context)
    expected = EXPECTED[carriers[role]].get(kinds.get(role, ""), HARMLESS)
    shared = len([c for c in carriers.values() if c == carriers[role]]) > 1 or "map" in carriers[role]
    if role not in kinds and channel.quality in _GARBLED:
        seen.slow += 1
    elif role not in kinds and not shared:
        assert channel.quality == "good", (role, channel, context)
    elif role == "y_um" and channel.quality == "good" and context[2] in (0, 1):
        pass  # blocks of before that were still under way; their value has been looked at above
    elif role in kinds and not shared and not OLD & expected:
        in_time = {"good"} if not expected or kinds[role] == "late" else set()  # late may be in time on a busy machine
        assert channel.quality in (expected | _GARBLED | in_time), (role, channel, context)
    elif role in kinds and not OLD & expected and expected:
        # Two faults on one line: one may stand in front of the other, and a reply that was held back may come with the
        # next; what is good has been compared with the truth above.
        every = set().union(*(EXPECTED[carriers[c]].get(k, HARMLESS) for c, k in kinds.items()))
        assert channel.quality in every | _GARBLED | {"good"}, (role, channel, context)


def _check_recovery(
    course: Course,
    episode: Episode,
    end: int,
    samples: Sequence[Sample],
    offsets: Sequence[Offset],
    truth: Sequence[dict[str, float]],
    seen: Seen,
) -> None:
    after = range(end, end + REST[episode.samples])
    last = max((i for i in after if offsets[i].state == "ok"), default=-1)
    context = (course.layout, episode, [(offsets[i].state, offsets[i].reasons) for i in after])
    assert last >= after[-3], context
    for role in ROLES:
        channel = samples[last].channels[role]
        true = _true(samples, role, truth, last)
        assert channel.quality != "good" or abs(number(channel.mean) - true) <= TOLERANCE[role], context
    seen.distance_um = abs(number(offsets[last].y_offset_um) - float(reference(course.samples)[last]))
    seen.std_after_um = number(offsets[last].y_offset_std_um)
    assert seen.distance_um <= WITHIN_STD[episode.samples] * seen.std_after_um, (seen, context)


# ---------------------------------------------------------------------- what is run


def alone(samples: int, *, every_carrier: bool = True) -> list[Course]:
    """Every kind of every carrier, alone; or every kind once, on carriers that take turns."""
    places = [
        ("apart", "t_q_degc"),
        ("apart", "at_degc"),
        ("apart", "y_um"),
        ("dcon", "t_q_degc"),
        ("map", "t_q_degc"),
        ("map", "at_degc"),
    ]
    rows = [
        (layout, role, kind)
        for layout, role in places
        for kind in sorted(EXPECTED[CARRIERS[layout][ROLES.index(role)]])
    ]
    if not every_carrier:
        kinds = sorted({kind for _, _, kind in rows})
        able = [[row for row in rows if row[2] == kind and row[0] != "map"] for kind in kinds]
        rows = [rows_of[i % len(rows_of)] for i, rows_of in enumerate(able)]
    courses = []
    for layout in sorted({row[0] for row in rows}):
        episodes = [Episode(((role, kind),), samples) for where, role, kind in rows if where == layout]
        courses += [Course(layout, list(part)) for part in _parts(episodes, 8 if samples == 1 else 2)]
    return courses


def pairs(samples: int, seed: int) -> list[Course]:
    """Every unordered pair of kinds, also of one kind with itself, each on one of the ways to place it.

    The ways: T_Q and AT on lines of their own, T_Q and Y, AT and Y, and T_Q and AT on one line. They take turns, so
    that every way gets its share of the pairs; which pair meets which way is drawn by the seed.
    """
    kinds = sorted(set().union(*(SUPPORTED[carrier] for carrier in SUPPORTED)))
    every = list(itertools.combinations_with_replacement(kinds, 2))
    random.Random(seed).shuffle(every)
    ways = [("apart", 0, 1), ("apart", 0, 2), ("apart", 1, 2), ("one line", 0, 1)]
    turn, by_layout = itertools.cycle(ways), dict[str, list[Episode]]()
    for a, b in every:
        placed = next(filter(None, (_placed(next(turn), a, b, samples) for _ in range(len(ways)))), None)
        if placed is None:
            assert {a, b} <= CAPANCDT_FAULTS | INPUT_FAULTS, (a, b)
            continue  # both can only be at the one controller
        by_layout.setdefault(placed[0], []).append(placed[1])
    return [
        Course(layout, list(part))
        for layout, episodes in by_layout.items()
        for part in _parts(episodes, 16 if samples == 1 else 2)
    ]


def _placed(way: tuple[str, int, int], a: str, b: str, samples: int) -> tuple[str, Episode] | None:
    layout, i, j = way
    for first, second in ((i, j), (j, i)):
        if a in SUPPORTED[CARRIERS[layout][first]] and b in SUPPORTED[CARRIERS[layout][second]]:
            return layout, Episode(((ROLES[first], a), (ROLES[second], b)), samples)
    return None


def _parts(episodes: Sequence[Episode], size: int) -> Iterator[Sequence[Episode]]:
    for i in range(0, len(episodes), size):
        yield episodes[i : i + size]


def without(courses: Sequence[Course], keep: int, seed: int) -> list[Course]:
    """Return some of the courses, drawn by a seed."""
    chosen = random.Random(seed).sample(range(len(courses)), min(keep, len(courses)))
    return [dataclasses.replace(courses[i]) for i in sorted(chosen)]
