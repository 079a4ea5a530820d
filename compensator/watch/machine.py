"""The state of one machine from its messages; no clock, socket or file."""

from __future__ import annotations

import math
from collections import deque
from itertools import islice
from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from compensator.clock import NS
from compensator.codes import Reason, Remark, State, WatchWarning
from compensator.events import EventKind, pause_of
from compensator.messages import (
    SCHEMA,
    UNREADABLE,
    Candidate,
    EstimateMessage,
    Event,
    Offset,
    Sample,
    Status,
    read_message,
)
from compensator.messages_axes import ALL_MESSAGES, OFFSETS, UNITS, AxisOffset, axis_of, names_axes, topic_of
from compensator.receiver.message import CODES_MAX
from compensator.watch.axes import axis_snapshot, missing_axes, worst
from compensator.watch.cutting import ATTENTION, FORBID, Headline, headline
from compensator.watch.history import AHEAD_NS, MachineHistory, usable
from compensator.watch.sequence import Sequence
from compensator.watch.words import (
    CONFIG,
    TONES,
    ExplainedCode,
    Tone,
    age,
    explained,
    explained_together,
    loop_commands,
    loop_text,
    to_do,
)

#: Kinds of messages by the part of their key after `thermal/`.
KINDS = {
    **{f"{axis}/offset": topic_of(axis) for axis in UNITS},
    **{kind: kind for kind in ("sample", "estimate", "status", "event")},
}
#: Longest payload that is decoded, bytes; those of services are below 64 KiB.
LONGEST = 2**20
#: Events kept of each machine.
EVENTS = 50
#: Longest payload of an event whose data are kept as they are, bytes.
EVENT_BYTES = 2**16
#: Most effects of a model (`model/model_file.py`, which would bring NumPy with it).
EFFECTS = 100
#: Longest text of an event that is kept and shown whole, characters; those of services are a few lines at most.
TEXT = 2000
#: Interval of the median of |measured − predicted|, min, and its limit in standard deviations and in µm.
MISFIT_MIN, MISFIT_STDS, MISFIT_UM = 30, 5.0, 1.0
#: A message farther ahead of this computer's clock than this shows that the clocks differ, s.
AHEAD_S = 5.0
#: The offsets of the axes of one sample arrive one after the other, within this time, s.
TOGETHER_S = 5.0
#: Values of a snapshot that are copied from the messages.
_OFFSET = ("state", "seq", "time_utc_ns", "valid_for_s", "y_offset_um", "y_offset_std_um", "model_sha256")
_ESTIMATE = ("y_um", "y_pred_um", "residual_um", "heat_w", "heat_std_w")
_STATUS = ("version", "model", "model_kind", "started_utc_ns", "recording", "devices")

#: Where the newest message of each kind is kept.
_KEPT = {"_sample": Sample, "_estimate": EstimateMessage, "_status": Status}
_DECODERS: dict[str, msgspec.json.Decoder[Any]] = {
    kind: msgspec.json.Decoder(ALL_MESSAGES[kind]) for kind in KINDS.values()
}
#: Of Y on a machine of several axes.
_OF_SEVERAL: msgspec.json.Decoder[Any] = msgspec.json.Decoder(OFFSETS["y"])


class Malformed(ValueError):
    """A payload that does not follow its schema."""


def decoded(kind: str, payload: bytes) -> Any:
    """Decode a message.

    Raises
    ------
    Malformed
        If it does not follow its schema.
    """
    if len(payload) > LONGEST:
        raise Malformed(f"{kind}: {len(payload)} bytes, expected at most {LONGEST}")
    try:
        decoder: msgspec.json.Decoder[Any] = (
            _OF_SEVERAL if kind == "offset" and names_axes(payload) else _DECODERS[kind]
        )
        message = read_message(decoder, payload)
    except UNREADABLE as error:
        raise Malformed(f"{kind}: {error}") from error
    if message.schema != SCHEMA:
        raise Malformed(f"{kind}: schema = {message.schema}, expected {SCHEMA}")
    for name, most in (("y_effects_um", EFFECTS), ("reasons", CODES_MAX)):
        count = len(getattr(message, name, ()))
        if count > most:  # each of them would be kept for a day
            raise Malformed(f"{kind}: {count} {name}, expected at most {most}")
    return message


class WatchedMachine:
    """One machine.

    Parameters
    ----------
    prefix : str
        Part of its keys before `/thermal/`.
    config : str
        Its configuration file, for the commands that a person is shown.
    """

    def __init__(self, prefix: str, config: str = CONFIG) -> None:
        self.prefix, self.config = prefix, config
        self.name = prefix.rpartition("/")[2]
        #: Whether its liveliness token exists; None if unknown.
        self.alive: bool | None = None
        self.numbers = Sequence()
        self.history = MachineHistory()
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self.malformed = 0
        self.last_malformed = ""
        self._offset: Offset | None = None
        self._sample: Sample | None = None
        self._estimate: EstimateMessage | None = None
        self._status: Status | None = None
        #: Offsets of further axes.
        self._axes: dict[str, AxisOffset] = {}
        self._arrived_s = 0.0
        #: When an offset of any axis was last received that is no answer to a query: answers arrive late.
        self._axis_arrived_s = -math.inf
        #: Number of the offset of Y before the last one, −1 if there is none.
        self._seq_before = -1
        #: When the other kept messages arrived, by their names in `_KEPT`.
        self._kept_s: dict[str, float] = {}
        #: Another machine name received below the same prefix, and when.
        self._other: tuple[str, float] = ("", -1e9)

    # ------------------------------------------------------------------ messages

    def update(self, kind: str, payload: bytes, now_ns: int, monotonic_s: float, *, asked: bool = False) -> bool:
        """Add a message; return whether it is new.

        Parameters
        ----------
        kind : str
            `offset`, `sample`, `estimate`, `status` or `event`; `z_offset` and so on of further axes.
        payload : bytes
            JSON, or anything else.
        now_ns, monotonic_s : int, float
            When it arrived: on the wall clock, ns since 1970 UTC, and on a monotonic clock, s.
        asked : bool
            Whether it is the answer to a query, which repeats an earlier message.
        """
        try:
            message = decoded(kind, payload)
        except Malformed as error:
            self.malformed += 1
            self.last_malformed = str(error)[:200]
            return False
        if isinstance(message, AxisOffset) and kind != "offset":
            return self._update_axis(axis_of(kind) or "", message, monotonic_s, asked)
        if message.machine != self.name and kind == "offset":
            if self._offset is not None:
                self._other = (self.name, monotonic_s)
            self.name, self.numbers = message.machine, Sequence()
        if isinstance(message, Offset):
            return self._update_offset(message, now_ns, monotonic_s, asked)
        if isinstance(message, Event) and len(payload) > EVENT_BYTES:
            message = _without_bulk(message)
        return self._update_other(message, now_ns, monotonic_s)

    def _update_offset(self, message: Offset, now_ns: int, monotonic_s: float, asked: bool) -> bool:
        if self._counts_anew(message, monotonic_s):
            self.numbers, self._offset, self._axes = Sequence(), None, {}
        # Answers are not counted: until the subscription has reached every service, messages between an answer and
        # the first message received are not sent here.
        if not asked and not self.numbers.update(message.seq, message.time_utc_ns):
            return False
        if self._offset is not None and message.machine == self._offset.machine and message.seq <= self._offset.seq:
            return False
        before = self._offset
        self._seq_before = before.seq if before is not None and before.machine == message.machine else -1
        self._offset, self._arrived_s = message, monotonic_s
        if not asked:
            self._axis_arrived_s = monotonic_s
        self.history.add(message, now_ns)
        return True

    def _counts_anew(self, message: Offset, monotonic_s: float) -> bool:
        """Return whether a lower number is that of a service that counts anew, as after a new installation.

        While the newest offset is valid it is a repetition. A repetition that comes later is shown with its own age.
        """
        known = self._offset
        return (
            known is not None
            and message.machine == known.machine
            and message.seq < known.seq
            and monotonic_s - self._arrived_s > known.valid_for_s
        )

    def _is_older(self, message: Offset | Sample | EstimateMessage | Status, known: Any) -> bool:
        """Return whether a message is no newer than the kept one, which belongs to the last offset or the next."""
        ahead = self._offset is not None and known.seq > self._offset.seq + 1
        return message.machine == known.machine and message.seq <= known.seq and not ahead

    def _update_axis(self, axis: str, message: AxisOffset, monotonic_s: float, asked: bool) -> bool:
        """Keep the newest offset of a further axis."""
        known = self._axes.get(axis)
        if known is not None and self._is_older(message, known):
            return False
        self._axes[axis] = message
        if not asked:
            self._axis_arrived_s = monotonic_s
        return True

    def _update_other(
        self, message: Sample | EstimateMessage | Status | Event, now_ns: int, monotonic_s: float
    ) -> bool:
        """Add a message other than an offset; messages older than the last are ignored."""
        if isinstance(message, Event):
            kind, text = _shortened(message.kind), _shortened(message.text)
            message = msgspec.structs.replace(message, kind=kind, text=text)
            if message in self.events:
                return False
            self.events.append(message)
            if message.kind == EventKind.START:
                self.numbers.started(message.time_utc_ns)
            pause = pause_of(message)
            if pause is not None and pause.missing is not None:
                self.numbers.stood_still(pause.missing)
            return True
        if isinstance(message, Status):
            self.numbers.started(message.started_utc_ns)
            self.history.add_candidate(message)
        else:
            self.history.add(message, now_ns)
        return self._keep(message, monotonic_s)

    def _keep(self, message: Sample | EstimateMessage | Status, monotonic_s: float) -> bool:
        """Keep the newest message of its kind; return whether this is the newest."""
        # Recorded estimates and status of several axes are subclasses.
        name = next(name for name, kind in _KEPT.items() if isinstance(message, kind))
        known = getattr(self, name)
        if known is not None and self._is_older(message, known):
            return False
        setattr(self, name, message)
        self._kept_s[name] = monotonic_s
        return True

    def add_recorded(
        self, message: Sample | EstimateMessage | Offset | Candidate | Event, now_ns: int, monotonic_s: float
    ) -> None:
        """Add a message of a recording, read now, to the history; a recorded offset is never shown as current."""
        if isinstance(message, Candidate):
            self.history.add_recorded_candidate(message)
        elif not isinstance(message, Event):
            self.history.add(message, now_ns)
            if not isinstance(message, Offset):
                self._keep(message, monotonic_s)
        elif message not in self.events:
            self.events = deque(sorted([*self.events, message], key=lambda e: e.time_utc_ns), maxlen=EVENTS)

    # ------------------------------------------------------------------ views

    def age_s(self, now_ns: int, monotonic_s: float) -> float | None:
        """Return the age of the last offset by its own time, at least the time since its arrival, s."""
        if self._offset is None:
            return None
        return max((now_ns - self._offset.time_utc_ns) / NS, monotonic_s - self._arrived_s)

    def shown(self, now_ns: int, monotonic_s: float) -> str:
        """Return the state to show: that of the last offset while it is valid, else `silent` or `unknown`."""
        old_s = self.age_s(now_ns, monotonic_s)
        if self._offset is None or old_s is None:
            return WatchWarning.UNKNOWN
        return WatchWarning.SILENT if old_s > self._offset.valid_for_s else self._worst()[0]

    def _worst(self) -> tuple[str, list[str]]:
        """Return the worst state of all axes, and the reasons of all."""
        assert self._offset is not None
        return worst(self._offset, self._axes, self._seq_before)

    def warnings(self, now_ns: int, monotonic_s: float) -> list[Remark]:
        """Return warnings about what was received."""
        found = []
        offset, shown = self._offset, self.shown(now_ns, monotonic_s)
        if self.alive is False and shown not in (WatchWarning.SILENT, WatchWarning.UNKNOWN):
            found.append(
                Remark(
                    WatchWarning.TOKEN_GONE, "Its liveliness token is gone: the service has ended or is disconnected."
                )
            )
        if self.alive and shown == WatchWarning.SILENT:
            figures = "Its liveliness token exists: the service is connected, but publishes nothing new."
            found.append(Remark(WatchWarning.ALIVE_BUT_SILENT, figures))
        other, heard_s = self._other
        if offset is not None and monotonic_s - heard_s < 4.0 * offset.valid_for_s:
            found.append(
                Remark(WatchWarning.TWO_SERVICES, f"Two services publish below this prefix: {other} and {self.name}.")
            )
        # While those of the newest sample are on their way, those of the one before are all here.
        is_on_its_way = monotonic_s - self._axis_arrived_s <= TOGETHER_S
        missing = missing_axes(offset, self._axes, self._seq_before if is_on_its_way else None)
        if missing and shown != WatchWarning.SILENT:
            figures = f"No offset of the newest sample has arrived for {', '.join(missing)}."
            found.append(Remark(WatchWarning.AXIS_MISSING, figures))
        if offset is not None and offset.time_utc_ns - now_ns > AHEAD_S * NS:
            ahead_ns = offset.time_utc_ns - now_ns
            figures = f"Its clock is ahead of this computer's by {age(ahead_ns / NS)}."
            if ahead_ns > AHEAD_NS:
                figures += " Curves and tables are without its messages."
            found.append(Remark(WatchWarning.CLOCK_AHEAD, figures))
        if (
            offset is not None
            and shown == WatchWarning.SILENT
            and monotonic_s - self._arrived_s < offset.valid_for_s / 2.0
        ):
            figures = "Messages arrive with old times: one of the two clocks is wrong, or messages are repeated."
            found.append(Remark(WatchWarning.OLD_MESSAGES, figures))
        misfit = self._misfit(now_ns, shown)
        if misfit is not None:
            found.append(misfit)
        if self.malformed:
            figures = f"{self.malformed} malformed message(s), the last: {self.last_malformed}."
            found.append(Remark(WatchWarning.MALFORMED_MESSAGES, figures))
        if self.numbers.missed:
            found.append(Remark(WatchWarning.MISSED_MESSAGES, f"{self.numbers.missed} message(s) did not arrive here."))
        if self.numbers.repeated:
            figures = f"{self.numbers.repeated} message(s) had a number that was received before."
            found.append(Remark(WatchWarning.REPEATED_NUMBERS, figures))
        return found

    def _misfit(self, now_ns: int, shown: str) -> Remark | None:
        """Warn if Y differs from its prediction by more than the service states, unless the service itself warns of it.

        The median is used because a valid model deviates for some minutes after the heat is switched.
        """
        if self._offset is None or shown not in (State.OK, State.DEGRADED):
            return None
        if any(code.startswith(Reason.IMPLAUSIBLE) for code in self._offset.reasons):
            return None
        residual_um, std_um, count = self.history.misfit(now_ns, MISFIT_MIN)
        if count < MISFIT_MIN // 2 or residual_um < max(MISFIT_STDS * std_um, MISFIT_UM):
            return None
        figures = (
            f"Over half an hour, measured and predicted Y differed by {residual_um:.1f} µm (median); the service "
            f"states a standard deviation of {std_um:.2f} µm."
        )
        return Remark(WatchWarning.MISFIT, figures)

    def snapshot(self, now_ns: int, monotonic_s: float) -> dict[str, Any]:
        """Return the present state for a view or as JSON.

        Values past their validity are omitted, except the last offset, which is given with its age.

        Parameters
        ----------
        now_ns : int
            The wall clock, ns since 1970 UTC.
        monotonic_s : float
            The clock of `update`, s.
        """
        offset, status = self._offset, self._status
        shown = self.shown(now_ns, monotonic_s)
        old_s = self.age_s(now_ns, monotonic_s)
        reasons = explained_together(self._worst()[1]) if offset else []
        warnings = self.warnings(now_ns, monotonic_s)
        found: dict[str, Any] = {
            "prefix": self.prefix,
            "machine": self.name,
            "shown": shown,
            "tone": _tone(shown, warnings),
            "means": explained(shown).means,
            "do": explained(shown).do,
            "alive": self.alive,
            "reasons": [words._asdict() for words in reasons],
            "to_do": _to_do(shown, reasons, warnings),
            "headline": self._headline(shown, warnings, now_ns, monotonic_s)._asdict(),
            "warnings": list(warnings),
            "warning_codes": [warning.code for warning in warnings],
            "age_s": round(old_s, 3) if old_s is not None else None,
            **{name: getattr(offset, name, None) for name in _OFFSET},
            "y_offset_rate_um_per_min": offset.y_offset_rate_um_per_min
            if offset and shown != WatchWarning.SILENT
            else None,
            **self._estimated(now_ns, monotonic_s),
            **self._measured(now_ns, monotonic_s),
            "received": self.numbers.received,
            "missed": self.numbers.missed,
            "repeated": self.numbers.repeated,
            "malformed": self.malformed,
            "last_malformed": self.last_malformed,
            "events": [self._event(event) for event in reversed(self.events)],
        }
        fresh = status if self._fresh("_status", now_ns, monotonic_s) else None
        loop = self._loop(fresh)
        if loop is not None:
            found["loop"] = loop
        if isinstance(offset, AxisOffset):
            found["axes"] = axis_snapshot(offset, self._axes, silent=shown == WatchWarning.SILENT)
        found["probe"] = self._probe(fresh)
        return found | {name: getattr(status, name, None) for name in _STATUS}

    def _headline(self, shown: str, warnings: list[Remark], now_ns: int, monotonic_s: float) -> Headline:
        """Return whether one may cut, and until when."""
        status = self._status if self._fresh("_status", now_ns, monotonic_s) else None
        until = status.predicts_until_utc_ns if status is not None else UNSET
        return headline(
            shown=shown,
            tone=_tone(shown, warnings),
            reasons=self._worst()[1] if self._offset is not None else (),
            channels=self._measured(now_ns, monotonic_s)["channels"],
            until_ns=None if isinstance(until, UnsetType) else until,
            now_ns=now_ns,
            std_um=self._offset.y_offset_std_um if self._offset is not None else None,
            warnings=sorted(warnings, key=lambda one: one.code not in ATTENTION | FORBID),
            is_proposed=_is_proposed(status),
        )

    @staticmethod
    def _probe(status: Status | None) -> dict[str, Any] | None:
        """Return whether, by when and why a probe is wanted; None for a machine without probes."""
        if status is None or isinstance(status.probe_wanted, UnsetType):
            return None
        why = explained(status.wanted_why) if status.wanted_why else None
        return {
            "wanted": status.probe_wanted,
            "by_ns": status.wanted_by_ns,
            "why": why.code if why else "",
            "means": why.means if why else "",
            "do": why.do if why else "",
            "std_um": status.wanted_std_um,
            "tolerance_um": status.wanted_tolerance_um,
        }

    def _loop(self, status: Status | None) -> dict[str, Any] | None:
        """Return how the loop is, with its line and its commands; None for a machine without one."""
        if status is None or isinstance(status.loop, UnsetType):
            return None
        found = msgspec.structs.asdict(status.loop)
        commands = loop_commands(status.loop.model_sha256, self.config) if _is_proposed(status) else ()
        return found | {"line": loop_text(found), "commands": list(commands)}

    def _fresh(self, name: str, now_ns: int, monotonic_s: float) -> bool:
        """Return whether a kept message is still valid by its own time, which may be ahead, and by its arrival."""
        message: Sample | EstimateMessage | Status | None = getattr(self, name)
        if message is None:
            return False
        valid_s = self._offset.valid_for_s if self._offset else 150.0
        return max((now_ns - message.time_utc_ns) / NS, monotonic_s - self._kept_s[name]) <= valid_s

    def _estimated(self, now_ns: int, monotonic_s: float) -> dict[str, Any]:
        estimate = self._estimate
        if estimate is None or not self._fresh("_estimate", now_ns, monotonic_s):
            return {**dict.fromkeys(_ESTIMATE), "shares": []}
        effects = [(name, value) for name, value in zip(self.effects(), estimate.y_effects_um, strict=False)]
        parts = [("DTF", estimate.y_dtf_um), ("TDTF", estimate.y_tdtf_um), *effects]
        # The prediction at the zero is subtracted from the sum; a level that was raised since is added.
        level_um = estimate.level_um or 0.0
        at_zero_um = estimate.y_base_um + level_um
        parts += [("at the zero", -at_zero_um)] if at_zero_um else []
        parts += [("level", level_um)] if level_um else []
        if self._status is not None and not isinstance(self._status.probe_wanted, UnsetType):
            shown = [value for _, value in parts if value is not None]
            parts += [("probes", estimate.y_pred_um - math.fsum(shown))] if estimate.y_pred_um is not None else []
        shares = [{"name": name, "y_um": value} for name, value in parts]
        return {**{name: getattr(estimate, name) for name in _ESTIMATE}, "shares": shares}

    def effects(self) -> list[str]:
        """Return the names of the running model's effects, by number if they are unknown."""
        count = len(self._estimate.y_effects_um) if self._estimate else 0
        named = list(self._status.effects) if self._status else []
        return named if len(named) == count else [f"effect {i + 1}" for i in range(count)]

    def _measured(self, now_ns: int, monotonic_s: float) -> dict[str, Any]:
        sample = self._sample
        if sample is None or not self._fresh("_sample", now_ns, monotonic_s):
            return {"t_q_degc": None, "at_degc": None, "period_s": None, "channels": {}}
        channels: dict[str, Any] = {}
        for name, channel in sample.channels.items():
            _, means, do = explained(channel.quality)
            values = {"mean": usable(sample, name), "quality": channel.quality, "errors": channel.errors}
            channels[name] = values | {"means": means, "do": do}
        temperatures = {name: usable(sample, name) for name in ("t_q_degc", "at_degc")}
        return {**temperatures, "period_s": sample.period_s, "channels": channels}

    def _event(self, event: Event) -> dict[str, Any]:
        return {
            "time_utc_ns": event.time_utc_ns,
            "kind": _shortened(event.kind),  # recorded ones are kept as they are
            "text": _shortened(event.text),
            "do": _shortened(to_do(event, self.config)),
        }


def _shortened(text: str) -> str:
    """Cut a text that no service writes: it is kept, and the page asks for all events every two seconds."""
    return text if len(text) <= TEXT else f"{text[:TEXT]}…"


def _without_bulk(event: Event) -> Event:
    """Return an event that no service writes with the first texts of its data, cut, and nothing else of them."""
    texts = ((name, text) for name, text in event.data.items() if isinstance(text, str) and len(name) <= 50)
    data = {name: _shortened(text) for name, text in islice(texts, 20)}
    return msgspec.structs.replace(event, machine=_shortened(event.machine), data=data)


def _tone(shown: str, warnings: list[Remark]) -> Tone:
    """Return the severity of a machine's state and warnings."""
    codes = {warning.code for warning in warnings}
    if WatchWarning.TWO_SERVICES in codes:
        return "bad"
    tone = TONES[shown]
    return "warn" if tone == "good" and codes & ATTENTION else tone


def _to_do(shown: str, reasons: list[ExplainedCode], warnings: list[Remark]) -> str:
    """Return the actions in one line; the last reasons of a silent machine are out of date and ignored."""
    asked = [words.do for words in reasons if shown not in (WatchWarning.SILENT, WatchWarning.UNKNOWN)]
    if not asked and not (warnings and shown == State.OK):
        asked = [explained(shown).do]
    return " ".join(dict.fromkeys([*asked, *map(str, warnings)]))


def _is_proposed(status: Status | None) -> bool:
    """Return whether a candidate waits for a person's answer."""
    return status is not None and not isinstance(status.loop, UnsetType) and status.loop.phase == "proposed"
