"""What is known of one machine from what it published; knows no clock, socket or file."""

from __future__ import annotations

from collections import deque
from typing import Any

import msgspec

from compensator.clock import NS
from compensator.messages import MESSAGES, SCHEMA, EstimateMessage, Event, Offset, Sample, Status
from compensator.reasons import Remark
from compensator.watch.history import History, usable
from compensator.watch.sequence import Sequence
from compensator.watch.words import TONES, Tone, Words, age, in_words, to_do

#: Kinds of messages by what stands behind `thermal/` in their key.
KINDS = {"y/offset": "offset", "sample": "sample", "estimate": "estimate", "status": "status", "event": "event"}
#: Longest payload that is believed, bytes; ours are below 64 KiB.
LONGEST = 2**20
#: Events kept of each machine.
EVENTS = 50
#: Measured and predicted Y are too far apart where the median of so many minutes is beyond so many standard deviations
#: and so many µm.
MISFIT_MIN, MISFIT_STDS, MISFIT_UM = 30, 5.0, 1.0
#: Warnings for which a machine that says itself that it is well needs somebody all the same.
NEEDY = {"token_gone", "malformed_messages", "misfit"}
#: A message whose time lies farther ahead says that two clocks differ, s.
AHEAD_S = 5.0

_DECODERS = {kind: msgspec.json.Decoder(MESSAGES[kind]) for kind in KINDS.values()}


class Malformed(ValueError):
    """A payload that is no message of the contract."""


def decoded(kind: str, payload: bytes) -> Any:
    """Decode a message.

    Raises
    ------
    Malformed
        In words what is wrong.
    """
    if len(payload) > LONGEST:
        raise Malformed(f"{kind}: {len(payload)} bytes, expected at most {LONGEST}")
    try:
        message: Any = _DECODERS[kind].decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise Malformed(f"{kind}: {error}") from error
    if message.schema != SCHEMA:
        raise Malformed(f"{kind}: schema = {message.schema}, expected {SCHEMA}")
    if not (0 <= message.seq < 2**63 and 0 <= message.time_utc_ns < 2**63):
        raise Malformed(f"{kind}: seq = {message.seq}, time_utc_ns = {message.time_utc_ns}, expected 0 to 2^63")
    return message


class Machine:
    """One machine.

    Parameters
    ----------
    prefix : str
        What stands before `/thermal/` in its keys.
    """

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.name = prefix.rpartition("/")[2]
        #: Whether its liveliness token is there; None where that is not known.
        self.alive: bool | None = None
        self.numbers = Sequence()
        self.history = History()
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self.malformed = 0
        self.last_malformed = ""
        self._offset: Offset | None = None
        self._sample: Sample | None = None
        self._estimate: EstimateMessage | None = None
        self._status: Status | None = None
        self._arrived_s = 0.0
        #: Another name that is heard below the same prefix, and when.
        self._other: tuple[str, float] = ("", -1e9)

    # ------------------------------------------------------------------ what arrives

    def take(self, kind: str, payload: bytes, monotonic_s: float, *, asked: bool = False) -> bool:
        """Take a payload in; tell whether it brought anything new.

        Parameters
        ----------
        kind : str
            `offset`, `sample`, `estimate`, `status` or `event`.
        payload : bytes
            JSON, or whatever somebody sent.
        monotonic_s : float
            When it arrived, on a clock that nobody sets, s.
        asked : bool
            Whether it is the answer to a question, which repeats what was published before.
        """
        try:
            message = decoded(kind, payload)
        except Malformed as error:
            self.malformed += 1
            self.last_malformed = str(error)[:200]
            return False
        if message.machine != self.name and kind == "offset":
            if self._offset is not None:
                self._other = (self.name, monotonic_s)
            self.name, self.numbers = message.machine, Sequence()
        if isinstance(message, Offset):
            return self._take_offset(message, monotonic_s, asked)
        return self._take_other(message)

    def _take_offset(self, message: Offset, monotonic_s: float, asked: bool) -> bool:
        # Between an answer and the first message that is heard, the subscription may not have reached everybody yet:
        # what is missing there was never on its way here.
        if not asked and not self.numbers.take(message.seq, message.time_utc_ns):
            return False
        if self._offset is not None and message.machine == self._offset.machine and message.seq <= self._offset.seq:
            return False
        self._offset, self._arrived_s = message, monotonic_s
        self.history.add(message)
        self.history.prune(message.time_utc_ns)
        return True

    def _take_other(self, message: Sample | EstimateMessage | Status | Event) -> bool:
        """Take the rest of a sample in; what is older than what is known is left out."""
        if isinstance(message, Event):
            if message in self.events:
                return False
            self.events.append(message)
            if message.kind == "start":
                self.numbers.started(message.time_utc_ns)
            return True
        if isinstance(message, Status):
            self.numbers.started(message.started_utc_ns)
        else:
            self.history.add(message)
        return self._keep(message)

    def _keep(self, message: Sample | EstimateMessage | Status) -> bool:
        """Keep the newest of its kind; tell whether this is it."""
        name = f"_{type(message).__name__.lower().removesuffix('message')}"
        known = getattr(self, name)
        if known is not None and message.machine == known.machine and message.seq <= known.seq:
            return False
        setattr(self, name, message)
        return True

    def past(self, message: Sample | EstimateMessage | Offset | Event) -> None:
        """Take in what a recording has from before; no offset of it says anything of now."""
        if not isinstance(message, Event):
            self.history.add(message)
            if not isinstance(message, Offset):
                self._keep(message)
        elif message not in self.events:
            self.events = deque(sorted([*self.events, message], key=lambda e: e.time_utc_ns), maxlen=EVENTS)

    # ------------------------------------------------------------------ what is known

    def age_s(self, now_ns: int, monotonic_s: float) -> float | None:
        """Return the age of the last offset by its own time, but no less than since it arrived, s."""
        if self._offset is None:
            return None
        return max((now_ns - self._offset.time_utc_ns) / NS, monotonic_s - self._arrived_s)

    def shown(self, now_ns: int, monotonic_s: float) -> str:
        """Return what it is to be shown as: its state while that is valid, else `silent` or `unknown`."""
        old_s = self.age_s(now_ns, monotonic_s)
        if self._offset is None or old_s is None:
            return "unknown"
        return "silent" if old_s > self._offset.valid_for_s else self._offset.state

    def warnings(self, now_ns: int, monotonic_s: float) -> list[Remark]:
        """Return what is odd about what is heard, in words."""
        said = []
        offset, shown = self._offset, self.shown(now_ns, monotonic_s)
        if self.alive is False and shown not in ("silent", "unknown"):
            said.append(Remark("token_gone", "The service has ended or is cut off: its liveliness token is gone."))
        if self.alive and shown == "silent":
            figures = "Its liveliness token is there: the service is connected but publishes nothing that is newer."
            said.append(Remark("alive_but_silent", figures))
        other, heard_s = self._other
        if offset is not None and monotonic_s - heard_s < 4.0 * offset.valid_for_s:
            said.append(Remark("two_services", f"Two services publish below this prefix: {other} and {self.name}."))
        if offset is not None and offset.time_utc_ns - now_ns > AHEAD_S * NS:
            figures = f"Its clock is ahead of this computer's by {age((offset.time_utc_ns - now_ns) / NS)}."
            said.append(Remark("clock_ahead", figures))
        if offset is not None and shown == "silent" and monotonic_s - self._arrived_s < offset.valid_for_s / 2.0:
            figures = "Messages arrive but carry an old time: one of the two clocks is wrong, or somebody repeats them."
            said.append(Remark("old_messages", figures))
        misfit = self._misfit(now_ns, shown)
        if misfit is not None:
            said.append(misfit)
        if self.malformed:
            figures = f"{self.malformed} malformed message(s), the last: {self.last_malformed}."
            said.append(Remark("malformed_messages", figures))
        if self.numbers.missed:
            said.append(Remark("missed_messages", f"{self.numbers.missed} message(s) never arrived here."))
        if self.numbers.repeated:
            figures = f"{self.numbers.repeated} message(s) came with a number that was there already."
            said.append(Remark("repeated_numbers", figures))
        return said

    def _misfit(self, now_ns: int, shown: str) -> Remark | None:
        """Say that the probe sees more than the service states, where the service itself raises no alarm of it.

        A median: after the heat is switched a sound model is off for some minutes.
        """
        if self._offset is None or shown not in ("ok", "degraded"):
            return None
        if any(code.startswith("implausible") for code in self._offset.reasons):
            return None
        residual_um, std_um, count = self.history.misfit(now_ns, MISFIT_MIN)
        if count < MISFIT_MIN // 2 or residual_um < max(MISFIT_STDS * std_um, MISFIT_UM):
            return None
        figures = (
            f"Measured and predicted Y have been {residual_um:.1f} µm apart for half an hour (median); the "
            f"service states a standard deviation of {std_um:.2f} µm."
        )
        return Remark("misfit", figures)

    def snapshot(self, now_ns: int, monotonic_s: float) -> dict[str, Any]:
        """Return everything that is known now, for a view or as JSON.

        A value that is older than the validity of its own time is left out; only the last offset stands, with its age.

        Parameters
        ----------
        now_ns : int
            The wall clock, ns since 1970 UTC.
        monotonic_s : float
            The clock that `take` was given, s.
        """
        offset, status = self._offset, self._status
        shown = self.shown(now_ns, monotonic_s)
        old_s = self.age_s(now_ns, monotonic_s)
        reasons = [in_words(code) for code in offset.reasons] if offset else []
        warnings = self.warnings(now_ns, monotonic_s)
        found: dict[str, Any] = {
            "prefix": self.prefix,
            "machine": self.name,
            "shown": shown,
            "tone": _tone(shown, warnings),
            "means": in_words(shown).means,
            "do": in_words(shown).do,
            "alive": self.alive,
            "state": offset.state if offset else None,
            "reasons": [words._asdict() for words in reasons],
            "to_do": _to_do(shown, reasons, warnings),
            "warnings": list(warnings),
            "warning_codes": [warning.code for warning in warnings],
            "seq": offset.seq if offset else None,
            "time_utc_ns": offset.time_utc_ns if offset else None,
            "age_s": round(old_s, 3) if old_s is not None else None,
            "valid_for_s": offset.valid_for_s if offset else None,
            "y_offset_um": offset.y_offset_um if offset else None,
            "y_offset_rate_um_per_min": offset.y_offset_rate_um_per_min if offset and shown != "silent" else None,
            "y_offset_std_um": offset.y_offset_std_um if offset else None,
            "model_sha256": offset.model_sha256 if offset else None,
            **self._estimated(now_ns),
            **self._measured(now_ns),
            "received": self.numbers.received,
            "missed": self.numbers.missed,
            "repeated": self.numbers.repeated,
            "malformed": self.malformed,
            "last_malformed": self.last_malformed,
            "events": [self._event(event) for event in reversed(self.events)],
        }
        names = ("version", "model", "model_kind", "started_utc_ns", "recording", "devices")
        return found | {name: getattr(status, name) if status else None for name in names}

    def _fresh(self, message: Any, now_ns: int) -> bool:
        """Whether a message belongs to now by its own time."""
        valid_s = self._offset.valid_for_s if self._offset else 150.0
        return message is not None and (now_ns - message.time_utc_ns) / NS <= valid_s

    def _estimated(self, now_ns: int) -> dict[str, Any]:
        names = ("y_um", "y_pred_um", "residual_um", "heat_w", "heat_std_w")
        estimate = self._estimate
        if estimate is None or not self._fresh(estimate, now_ns):
            return {**dict.fromkeys(names), "shares": []}
        effects = [(name, value) for name, value in zip(self.effects(), estimate.y_effects_um, strict=False)]
        parts = [("DTF", estimate.y_dtf_um), ("TDTF", estimate.y_tdtf_um), *effects]
        # Taken off the sum: what stood at the zero.
        parts += [("at the zero", -estimate.y_base_um)] if estimate.y_base_um else []
        shares = [{"name": name, "y_um": value} for name, value in parts]
        return {**{name: getattr(estimate, name) for name in names}, "shares": shares}

    def effects(self) -> list[str]:
        """Return the names of the effects of the running model, by number where nobody says them."""
        count = len(self._estimate.y_effects_um) if self._estimate else 0
        named = list(self._status.effects) if self._status else []
        return named if len(named) == count else [f"effect {i + 1}" for i in range(count)]

    def _measured(self, now_ns: int) -> dict[str, Any]:
        sample = self._sample
        if sample is None or not self._fresh(sample, now_ns):
            return {"t_q_degc": None, "at_degc": None, "period_s": None, "channels": {}}
        channels = {
            name: {
                "mean": usable(sample, name),
                "quality": channel.quality,
                "errors": channel.errors,
                "means": in_words(channel.quality).means,
                "do": in_words(channel.quality).do,
            }
            for name, channel in sample.channels.items()
        }
        return {
            "t_q_degc": usable(sample, "t_q_degc"),
            "at_degc": usable(sample, "at_degc"),
            "period_s": sample.period_s,
            "channels": channels,
        }

    @staticmethod
    def _event(event: Event) -> dict[str, Any]:
        return {"time_utc_ns": event.time_utc_ns, "kind": event.kind, "text": event.text, "do": to_do(event)}


def _tone(shown: str, warnings: list[Remark]) -> Tone:
    """Return how much a machine needs somebody."""
    codes = {warning.code for warning in warnings}
    if "two_services" in codes:
        return "bad"
    tone = TONES[shown]
    return "warn" if tone == "good" and codes & NEEDY else tone


def _to_do(shown: str, reasons: list[Words], warnings: list[Remark]) -> str:
    """Return in one line what is to be done; what the service said last is no news of one that is silent."""
    asked = [words.do for words in reasons if shown not in ("silent", "unknown")]
    if not asked and not (warnings and shown == "ok"):
        asked = [in_words(shown).do]
    return " ".join(dict.fromkeys([*asked, *map(str, warnings)]))
