"""Whether one may cut, and until when: the headline of a machine, for the person who stands at it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from compensator.codes import Reason, Remark, SampleQuality, State, WatchWarning, explain
from compensator.report.local_time import here
from compensator.watch.words import SEVERAL_SUSPECTS

#: Names of channels at the machine.
NAMES: Mapping[str, str] = {"t_q_degc": "T_Q", "at_degc": "AT", "y_um": "Y", "heat_w": "Heat"}
#: What a channel has, in two or three words.
_HAS: Mapping[str, str] = {
    SampleQuality.OPEN_CIRCUIT: "wire open",
    SampleQuality.OVER_RANGE: "above its range",
    SampleQuality.UNDER_RANGE: "below its range",
    SampleQuality.STALE: "no new values",
    SampleQuality.OUT_OF_RANGE: "out of range",
    SampleQuality.TOO_FAST: "changes too fast",
    SampleQuality.SUSPECT: "has jumped",
    SampleQuality.STUCK: "value frozen",
    SampleQuality.T_Q_BELOW_AT: "below AT",
    SampleQuality.DEVICE_TIMEOUT: "device does not answer",
    SampleQuality.DEVICE_DISCONNECTED: "device disconnected",
}
#: Reasons that name a doubt in the offset itself; others in state degraded are restrictions that pass by themselves.
_DOUBTS = (Reason.IMPLAUSIBLE, Reason.T_Q_AT_APART, Reason.CORRECTION_LIMITED, Reason.OFFSET_LIMITED)
#: The model lacks an effect, and what to do where the service has found it.
_LACKS = f"{Reason.IMPLAUSIBLE}:model"
_ANSWER = "The service proposes a better model: answer the proposal."
#: Warnings that need attention although the service itself reports `ok`.
ATTENTION = {WatchWarning.TOKEN_GONE, WatchWarning.AXIS_MISSING, WatchWarning.MALFORMED_MESSAGES, WatchWarning.MISFIT}
#: With these the offset and the state that are shown need not be those of the machine.
FORBID = {WatchWarning.TWO_SERVICES, WatchWarning.AXIS_MISSING}


class Headline(NamedTuple):
    """Whether one may cut (`yes`, `until`, `care`, `no`), in words, and why with what to do."""

    cut: str
    word: str
    text: str


def headline(
    *,
    shown: str,
    tone: str,
    reasons: Sequence[str],
    channels: Mapping[str, Mapping[str, Any]],
    until_ns: int | None,
    now_ns: int,
    std_um: float | None = None,
    warnings: Sequence[Remark] = (),
    is_proposed: bool = False,
) -> Headline:
    """Return the headline of a machine.

    Parameters
    ----------
    shown, tone : str
        State that is shown, and its severity with the warnings.
    reasons : sequence of str
        Codes of the last offset.
    channels : mapping of str to mapping
        Channels of the last sample with `quality` and `do`.
    until_ns : int, optional
        When the offset will be held, ns since 1970 UTC; None if nothing is missing or it is unknown.
    now_ns : int
        Now, ns since 1970 UTC.
    std_um : float, optional
        Standard deviation of the offset, µm.
    warnings : sequence of Remark
        What the watch warns about, the severest first.
    is_proposed : bool
        Whether the service proposes a better model: a person answers, instead of looking for one.
    """
    words = partial(_words, is_proposed=is_proposed)
    found = _headline(shown, tone, reasons, channels, until_ns, now_ns, warnings, words)
    if is_proposed and found.cut == "yes":
        # Measured Y speaks against the model that it follows.
        found = Headline("care", "Cut with care", f"{found.text} {_ANSWER}")
    if found.cut == "no" or std_um is None:
        return found
    # The deviation is that of the target; until the offset is there it is wrong by the rest of the way, too.
    there = " once it has reached its target" if Reason.RATE_LIMITED in reasons else ""
    return found._replace(text=f"{found.text} Offset ±{std_um:.1f} µm (one standard deviation){there}.")


def _headline(
    shown: str,
    tone: str,
    reasons: Sequence[str],
    channels: Mapping[str, Mapping[str, Any]],
    until_ns: int | None,
    now_ns: int,
    warnings: Sequence[Remark],
    words: Callable[[Sequence[str]], list[str]],
) -> Headline:
    if shown == State.STARTING and list(reasons[:1]) == [Reason.NO_ZERO]:
        # Reason and state say the same; what to do at a start is to wait.
        return Headline("no", "Do not cut to size", f"{words(reasons[:1])[0]} {State.STARTING.action}")
    if shown in (WatchWarning.SILENT, WatchWarning.UNKNOWN, State.FAULT, State.STARTING):
        return Headline("no", "Do not cut to size", " ".join(words([*reasons[:1], shown])))
    lost = _lost(channels, reasons)
    doubts = [reason for reason in reasons if reason.partition(":")[0] in _DOUBTS]
    if shown == State.HOLD:
        why = lost or words([reason for reason in reasons if reason != Reason.PREDICTING][-1:])
        frozen = [] if Reason.OPERATOR_HOLD in reasons else ["The offset is frozen."]
        return Headline("no", "Do not cut to size", " ".join([*frozen, *why]))
    forbidding = [warning for warning in warnings if warning.code in FORBID]
    if forbidding:
        return Headline("no", "Do not cut to size", forbidding[0])
    # What the service cannot know of itself stands beside what it says.
    severe = [warning for warning in warnings if warning.code in ATTENTION][:1]
    if Reason.PREDICTING in reasons:
        if until_ns is None:
            parts = [*lost, "Predicted for a limited time, then held.", *severe]
            return Headline("care", "Cut with care", " ".join(parts))
        minutes = max(until_ns - now_ns, 0) / 60e9
        held = f"Predicted for another {minutes:.0f} min, then held."
        parts = [*lost[:1], held, *lost[1:], *words(doubts[:1])[:1], *severe]
        may = "Cut with care" if doubts or severe else "May cut"
        return Headline("until", f"{may} until {here(until_ns):%H:%M}", " ".join(parts))
    suspects = [reason.partition(":")[2] for reason in reasons if reason.startswith(f"{Reason.IMPLAUSIBLE}:")]
    if len(suspects) > 1:
        others = " or ".join(f"{NAMES.get(name, name)} is wrong" for name in suspects if name != "model")
        lacks = "the model lacks an effect" if "model" in suspects else ""
        causes = " or ".join(filter(None, (lacks, others)))
        text = f"Measured and predicted Y diverge; not known yet whether {causes}."
        return Headline("care", "Cut with care", " ".join([text, SEVERAL_SUSPECTS, *severe]))
    if doubts:
        return Headline("care", "Cut with care", " ".join([*words(doubts[:1]), *severe]))
    if reasons:
        return Headline("care", "Cut with care", " ".join([*(lost or words(reasons[:1])), *severe]))
    if tone != "good":
        return Headline("care", "Cut with care", " ".join(warnings[:1] or words([shown])))
    return Headline("yes", "May cut", "The offset follows the model.")


def _lost(channels: Mapping[str, Mapping[str, Any]], reasons: Sequence[str]) -> list[str]:
    """Return which temperature is missing, why, and what to do; the cause first."""
    known = {"t_q_degc": Reason.T_Q_MISSING, "at_degc": Reason.AT_MISSING}
    missing = [name for name, reason in known.items() if reason in reasons]
    if not missing:
        return []
    causes, to_do = [], []
    for name in missing:
        channel = channels.get(name, {})
        quality = str(channel.get("quality", ""))
        if quality == SampleQuality.GOOD:
            # The last sample that arrived is older than the offset: its quality explains nothing.
            causes.append(f"{NAMES[name]}: missing.")
            to_do.append(known[name].action)
            continue
        causes.append(f"{NAMES[name]}: {_HAS.get(quality, quality.replace('_', ' ') or 'missing')}.")
        to_do.append(str(channel.get("do", "")))
    return [" ".join(causes), *dict.fromkeys(filter(None, to_do))]


def _words(codes: Sequence[str], *, is_proposed: bool) -> list[str]:
    """Return meaning and action of codes, each sentence once."""
    found = []
    for code in codes:
        meaning, action = explain(code) or (code, "")
        found += [meaning, _ANSWER if is_proposed and code == _LACKS else action]
    return list(dict.fromkeys(part for part in found if part not in ("", "See the reasons.")))
