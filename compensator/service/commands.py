"""Commands of operators: checked on the thread that receives them, applied between two samples."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import msgspec

from compensator.clock import Clock
from compensator.codes import ProbeCode
from compensator.errors import ServiceError
from compensator.events import DOUBT, CommandName, EventKind
from compensator.messages import UNREADABLE, Probe
from compensator.service.compensation import Compensation, doubt_of_rest
from compensator.service.event_log import EventLog
from compensator.service.loop.live import ServiceLoop
from compensator.service.probing import ReceivedProbe, read_probe
from compensator.service.probing.received import ProbeRefused, unused_probe
from compensator.service.publisher import COMMANDS, Reply, Sender, longest, refusal
from compensator.service.replay import execute
from compensator.service.transfer.adoption import Adoption, ModelRequest
from compensator.service.transfer.second_opinion import described, without_move

#: Largest number of commands that wait for the next sample. A `hold` has one more place: it stops the offset.
WAITING_COMMANDS = 100
#: Largest number of probes that wait for the next sample to be compared with the prediction.
WAITING_PROBES = 20
#: Largest number of probes refused at once that are recorded with the next sample; of the others their number is.
REFUSED_PROBES = 20
#: Largest number of refused commands noted between two samples; a flood must not displace other events.
NOTED_REFUSALS = 10
#: Fewest digits of a hash that name a candidate.
FEWEST_DIGITS = 6
#: Commands whose arguments are a `ModelRequest`.
_ABOUT_MODELS = (CommandName.ADOPT, CommandName.BACK, CommandName.DISMISS)
#: Longest part of a mode that a refusal repeats, characters.
_SHOWN = 40


class Commands:
    """Receives commands from other threads.

    Parameters
    ----------
    events : EventLog
        For the events of commands and refusals.
    adoption : Adoption
        Executes `adopt` and `back`.
    clock : Clock
        For the arrival of a probe.
    running : callable
        Returns the running compensation.
    machine : str
        Name of the machine.
    unproven : bool
        Whether unauthenticated senders are accepted.
    loop : ServiceLoop, optional
        Executes `dismiss`, and `adopt` of its candidate.
    """

    def __init__(
        self,
        events: EventLog,
        adoption: Adoption,
        *,
        clock: Clock,
        running: Callable[[], Compensation],
        machine: str,
        unproven: bool,
        loop: ServiceLoop | None = None,
    ) -> None:
        self._events = events
        self._adoption = adoption
        self._clock = clock
        self._running = running
        self._machine = machine
        self._unproven = unproven
        self._loop = loop
        #: Probes for the next sample in the order of their arrival, those of them that passed the checks, records of
        #: what cannot be decided with it, and how many more were refused.
        self._probes: list[ReceivedProbe] = []
        self._admitted: list[ReceivedProbe] = []
        self._unused: list[Probe] = []
        self._more = 0
        self._waiting: asyncio.Queue[tuple[str, dict[str, Any], Sender]] = asyncio.Queue()
        self._refused = 0
        #: Whether an answer about the candidate of the loop waits for the next sample.
        self._is_answered = False
        self._event_loop: asyncio.AbstractEventLoop | None = None

    def open(self) -> None:
        """Accept commands from now on, in the running event loop."""
        self._event_loop = asyncio.get_running_loop()

    def close(self) -> None:
        """Refuse commands from now on."""
        self._event_loop = None

    def receive(self, name: str, payload: bytes, sender: Sender) -> Reply:
        """Accept or refuse a command from another thread; see `Daemon.command`."""
        event_loop = self._event_loop
        try:
            self._check_sender(name, payload, sender)
            if event_loop is not None and name == CommandName.PROBE:
                decided: Future[dict[str, Any]] = Future()
                event_loop.call_soon_threadsafe(self._receive_probe, payload, sender, self._clock.utc_ns(), decided)
                return decided
            arguments = self._checked(name, payload)
            if event_loop is None or self._is_full(name):
                raise ServiceError("the service cannot accept a command now")
            if name in _ABOUT_MODELS:
                request = ModelRequest.of(name, arguments)
                reply: Future[dict[str, Any]] = Future()
                if name == CommandName.DISMISS or request.candidate:
                    event_loop.call_soon_threadsafe(self._decide_candidate, name, request, sender, reply)
                    return reply
                event_loop.call_soon_threadsafe(self._begin_change, name, request, sender, reply)
                return reply
        except ServiceError as error:
            if event_loop is not None:
                event_loop.call_soon_threadsafe(self._note_refusal, name, str(error), sender)
            return refusal(str(error))
        warm_um = self._running().warm_um if arguments.get("mode") == "rest" else None
        event_loop.call_soon_threadsafe(self._enqueue, name, arguments, sender)
        warning = f"{DOUBT}{doubt_of_rest(warm_um)}" if warm_um is not None else ""
        waits = _counts_on_state(name, arguments) and self._running().has_gap
        when = "once T_Q and AT have been there for a sample" if waits else "at the next sample"
        return {"ok": True, "text": f"{name}: acts {when}{warning}"}

    def apply(self, compensation: Compensation) -> None:
        """Apply the commands that arrived since the last sample.

        A zero on a warm machine waits for the sample after a gap: it is set before the engine has repeated the gap.
        """
        self._refused, self._is_answered = 0, False
        for _ in range(self._waiting.qsize()):
            name, arguments, sender = self._waiting.get_nowait()
            if _counts_on_state(name, arguments) and compensation.has_gap:
                self._waiting.put_nowait((name, arguments, sender))
                continue
            self._events.note(EventKind.COMMAND, name, arguments | {"command": name} | sender.data())
            execute(compensation, name, arguments)
            try:
                self._answer(compensation, name, arguments)
            except ServiceError as error:
                self._note_refusal(name, f"{name}: {error}", sender)

    def refuse_waiting(self) -> None:
        """Note of each command that was accepted for the next sample that it did not act: the service ends before."""
        while not self._waiting.empty():
            name, _, sender = self._waiting.get_nowait()
            text = f"{name}: the service ended before the next sample; send it again"
            self._events.note(EventKind.COMMAND_REFUSED, text, {"name": name, "ok": False} | sender.data())

    def _answer(self, compensation: Compensation, name: str, arguments: dict[str, Any]) -> None:
        """Pass a command on to the loop; the candidate that was meant may have given its place since the answer."""
        if self._loop is None:
            return
        if name == CommandName.DISMISS:
            self._loop.dismiss(compensation, arguments["sha256"])
        elif name == CommandName.RESUME:
            self._loop.resume()
        elif name == CommandName.ADOPT:
            self._loop.accept(arguments["sha256"])

    def _decide_candidate(
        self, name: str, request: ModelRequest, sender: Sender, reply: Future[dict[str, Any]]
    ) -> None:
        """Answer a command about the candidate of the loop; it acts with the next sample. In the event loop only."""
        try:
            if self._loop is None:
                raise ServiceError(
                    'the service looks for no better model; expected [loop] with policy = "propose" or "adopt"'
                )
            if self._event_loop is None:
                raise ServiceError("the service is ending")
            if 0 < len(request.sha256) < FEWEST_DIGITS:
                raise ServiceError(f"sha256 = {request.sha256!r}, expected at least {FEWEST_DIGITS} digits of a hash")
            if self._is_answered:
                raise ServiceError("the candidate was answered already, which acts at the next sample")
            if self._is_full(name):
                raise ServiceError("too many commands are waiting")
            if self._adoption.is_under_way:
                raise ServiceError("another model is being prepared; answer again after the next sample")
            unproposed = "wait, or use --force"
            if name == CommandName.DISMISS:
                unproposed = "" if request.sha256 else "name it: compensator dismiss HASH"
            offer = self._loop.offer(self._running(), request.sha256, unproposed="" if request.force else unproposed)
        except ServiceError as error:
            self._note_refusal(name, f"{name}: {error}", sender)
            reply.set_result(refusal(f"{name}: {error}"))
            return
        self._is_answered = True
        self._enqueue(name, {"candidate": True, "force": request.force, "sha256": offer.sha256}, sender)
        is_adopted = name == CommandName.ADOPT
        compared = described(offer.comparison if is_adopted else without_move(offer.comparison))
        done = "is adopted" if is_adopted else "is dismissed"
        text = f"candidate {offer.named} {done}; {compared}; acts at the next sample"
        figures = {"model_sha256": offer.sha256, "comparison": offer.comparison.table()}
        reply.set_result({"ok": True, "text": text} | figures)

    def _begin_change(self, name: str, request: ModelRequest, sender: Sender, reply: Future[dict[str, Any]]) -> None:
        """Begin to change the model, unless an answer that is accepted would be lost by it. In the event loop only."""
        if not self._is_answered:
            self._adoption.begin(name, request, reply, sender)
            return
        why = f"{name}: the candidate was answered, which acts at the next sample; retry after it"
        self._note_refusal(name, why, sender)
        reply.set_result(refusal(why))

    def drain_probes(self) -> tuple[list[ReceivedProbe], list[Probe]]:
        """Return the probes that arrived since the last call, and records of those that are not decided."""
        probes, unused = self._probes, self._unused
        if self._more:
            text = f"probe: {self._more} more were refused"
            unused.append(unused_probe(self._machine, self._clock.utc_ns(), ProbeCode.TOO_MANY, text))
        self._probes, self._admitted, self._unused, self._more = [], [], [], 0
        return probes, unused

    def _receive_probe(self, payload: bytes, sender: Sender, now_ns: int, reply: Future[dict[str, Any]]) -> None:
        """Check a probe at once; it is compared with the prediction at the next sample. In the event loop only."""
        try:
            text = self._admit_probe(payload, sender, now_ns)
            reply.set_result({"ok": True, "code": "", "text": text})
        except ProbeRefused as refused:
            reply.set_result(refusal(str(refused)) | {"code": refused.code})

    def _admit_probe(self, payload: bytes, sender: Sender, now_ns: int) -> str:
        """Return the reply to a probe that can be used; one that is refused is recorded, too."""
        probing = self._running().probing
        try:
            if probing is None:
                raise ProbeRefused(ProbeCode.NOT_CONFIGURED, "probe: the configuration has no table [probe]")
            request = read_probe(payload)
        except ProbeRefused as refused:
            self._refuse_unused(refused, now_ns, sender)
            raise
        received = ReceivedProbe(request=request, received_utc_ns=now_ns, **sender.data())
        try:
            if self._event_loop is None:
                raise ProbeRefused(ProbeCode.TIME_UNKNOWN, "probe: the service is ending")
            probing.check(received, self._admitted)
        except ProbeRefused:
            # The next sample refuses it again, and records it so.
            if len(self._probes) - len(self._admitted) < REFUSED_PROBES:
                self._probes.append(received)
            else:
                self._more += 1
            raise
        if len(self._admitted) >= WAITING_PROBES:
            full = ProbeRefused(
                ProbeCode.TOO_MANY,
                f"probe of {request.measured_um:.2f} µm at {request.feature!r}: "
                f"{WAITING_PROBES} wait for the next sample already",
            )
            self._refuse_unused(full, request.time_utc_ns, sender)
            raise full
        self._probes.append(received)
        self._admitted.append(received)
        return "received; compared with the prediction at the next sample; see thermal/event or watch"

    def _refuse_unused(self, refused: ProbeRefused, time_ns: int, sender: Sender) -> None:
        """Record a probe that the next sample cannot decide."""
        self._note_refusal(CommandName.PROBE, str(refused), sender)
        if refused.code == ProbeCode.NOT_CONFIGURED:
            return
        if len(self._unused) < NOTED_REFUSALS:
            by = (sender.name, sender.proof)
            self._unused.append(unused_probe(self._machine, time_ns, refused.code, str(refused), *by))
        else:
            self._more += 1

    def _check_sender(self, name: str, payload: bytes, sender: Sender) -> None:
        """Refuse a command that is too long, or whose sender may be anyone."""
        if len(payload) > longest(name):
            raise ServiceError(f"{name}: the payload is longer than {longest(name)} bytes")
        if sender.proof == "none" and not self._unproven:
            raise ServiceError(
                f"{name}: the sender {sender.name} is not authenticated; expected a router with TLS and the key "
                f"thermal/command/{name}/<common name of the certificate>, or zenoh.unproven_commands = true"
            )

    def _checked(self, name: str, payload: bytes) -> dict[str, Any]:
        """Return the arguments of an acceptable command, as far as they act."""
        try:
            arguments = msgspec.json.decode(payload, type=dict[str, Any]) if payload else {}
        except UNREADABLE as error:
            raise ServiceError(f"{name}: the payload is not a JSON object") from error
        mode = arguments.get("mode", "auto")
        if name not in COMMANDS or (name == CommandName.ZERO and mode not in ("auto", "rest", "warm")):
            shown = repr(mode[:_SHOWN]) if isinstance(mode, str) else type(mode).__name__
            raise ServiceError(
                f"{name} {shown}: expected zero with mode auto, rest or warm, hold, resume, adopt with a model, back, "
                "dismiss"
            )
        if name in _ABOUT_MODELS:
            return arguments
        # What does not act is not recorded either: it may hold numbers and depths that no reader of a recording takes,
        # and a start uses a recording up to such a record only.
        return {"mode": mode} if name == CommandName.ZERO and "mode" in arguments else {}

    def _is_full(self, name: str) -> bool:
        return self._waiting.qsize() >= WAITING_COMMANDS + (name == CommandName.HOLD)

    def _enqueue(self, name: str, arguments: dict[str, Any], sender: Sender) -> None:
        if self._is_full(name):
            self._note_refusal(name, "too many commands are waiting", sender)
        else:
            self._waiting.put_nowait((name, arguments, sender))

    def _note_refusal(self, name: str, why: str, sender: Sender) -> None:
        self._refused += 1
        if self._refused <= NOTED_REFUSALS:
            self._events.note(EventKind.COMMAND_REFUSED, why, {"name": name, "ok": False} | sender.data())


def _counts_on_state(name: str, arguments: dict[str, Any]) -> bool:
    """Return whether a command needs to know what the machine has stored: a zero that may be on a warm one."""
    return name == CommandName.ZERO and arguments.get("mode", "auto") != "rest"
