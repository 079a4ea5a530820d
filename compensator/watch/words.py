"""Text of the views: severity and signs, meaning and action of codes and events, times and ages."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from compensator.codes import Reason, State, WatchWarning, explain
from compensator.events import EventKind, LoopAction, RecordingCode, RecordingData, data_of
from compensator.messages import Event
from compensator.report.local_time import here
from compensator.report.notation import plain

#: Configuration file in commands where the watch was given none.
CONFIG = "machine.toml"
Tone = Literal["good", "warn", "bad"]

#: Severity of each state, the worst first.
TONES: Mapping[str, Tone] = {
    WatchWarning.SILENT: "bad",
    WatchWarning.UNKNOWN: "bad",
    State.FAULT: "bad",
    State.HOLD: "bad",
    State.DEGRADED: "warn",
    State.STARTING: "warn",
    State.OK: "good",
}
#: Sign of each severity, readable without colour.
SIGNS: Mapping[Tone, str] = {"good": "✓", "warn": "⚠", "bad": "✗"}
#: What to do as long as several suspects explain why measured and predicted Y diverge.
SEVERAL_SUSPECTS = "Measure the part; check a sensor when it is named alone."
#: What probes on demand are for.
PROBE_FOR = (
    "Probing before a tight feature only when a probe is wanted saves about half of the probes; timing alone saves "
    "nothing at equal mean error."
)
#: Action for each kind of event.
_DO: Mapping[str, str] = {
    EventKind.DEVICE: "Check the power, cable and address of the device; `compensator probe` reads it once.",
    EventKind.RECORDING: "Check free space, permissions and the disk.",
    EventKind.CLOCK: "Check the time service of the machine's computer.",
    EventKind.ERROR: "Report it with its text; the offset is held until the error is gone.",
    EventKind.COMMAND_REFUSED: "See the reason; if nobody here sent it, find out who did. The offset did not change.",
    EventKind.ADOPT: "The previous model remains active; the text states why the new one was refused.",
    EventKind.RESTART: "Nothing, if the standard deviation is small enough for the work.",
}


class ExplainedCode(NamedTuple):
    """A code with its meaning and action."""

    code: str
    means: str
    do: str


def explained(code: str) -> ExplainedCode:
    """Return a state or reason with its meaning and action, also if it is unknown.

    Examples
    --------
    >>> explained("ok").do
    'Nothing.'
    """
    found = explain(code)
    if found is None:
        return ExplainedCode(
            code,
            "Unknown code: the service may be newer than this program.",
            "Install the same version on both computers.",
        )
    return ExplainedCode(code, *found)


def explained_together(codes: Sequence[str]) -> list[ExplainedCode]:
    """Return the reasons of an offset; several suspects send nobody to a sensor that may be healthy.

    Examples
    --------
    >>> explained_together(["implausible:at_degc", "implausible:model"])[0].do
    'Measure the part; check a sensor when it is named alone.'
    """
    found = [explained(code) for code in codes]
    suspects = [code for code in codes if code.startswith(f"{Reason.IMPLAUSIBLE}:")]
    if len(suspects) < 2:
        return found
    return [one._replace(do=SEVERAL_SUSPECTS) if one.code in suspects else one for one in found]


def to_do(event: Event, config: str = CONFIG) -> str:
    """Return the action for an event, with the configuration file that its commands need; empty if none is needed."""
    if event.kind in (EventKind.DEVICE, EventKind.ADOPT) and event.data.get("ok") is not False:
        return ""
    if event.kind == EventKind.PROBE:
        code = str(event.data.get("code", ""))
        return explained(code).do if code else ""
    if event.kind == EventKind.STATE:
        state = str(event.data.get("state", ""))
        reasons = event.data.get("reasons")
        codes = [str(code) for code in reasons] if isinstance(reasons, list) and reasons else [state]
        return (
            " ".join(dict.fromkeys(one.do for one in explained_together(codes))) if state not in ("", State.OK) else ""
        )
    if event.kind == EventKind.DIAGNOSIS:
        return str(event.data.get("needs", ""))
    if event.kind == EventKind.LOOP and event.data.get("step") == LoopAction.PROPOSE:
        yes, no = loop_commands(str(event.data.get("model_sha256", "")), config)
        return f"Answer with `{yes}` or `{no}`."
    if event.kind == EventKind.ADOPT and event.data.get("by") == "loop":
        return "Check free space, permissions and the disk; the adopted model remains active until then."
    recording = data_of(event, RecordingData) if event.kind == EventKind.RECORDING else None
    if recording is not None and recording.is_resolved:
        return ""
    if recording is not None and recording.code == RecordingCode.NOT_AS_WRITTEN:
        return "Audit the recordings with the public key, and find out who had access to the folder."
    return _DO.get(event.kind, "")


def probe_text(probe: dict[str, Any]) -> str:
    """Return in one line whether a probe is wanted, by when and why, and what it is for.

    Parameters
    ----------
    probe : dict
        `probe` of a snapshot.
    """
    tolerance = probe["tolerance_um"]
    figures = f"standard deviation {plain(probe['std_um'])} µm"
    figures += f", tolerance {plain(tolerance)} µm" if tolerance is not None else ""
    if probe["wanted"]:
        return f"Probe wanted ({figures}): {probe['means']} {probe['do']}"
    if probe["by_ns"] is not None:
        return f"No probe wanted before {here(probe['by_ns']):%H:%M} ({figures}). {PROBE_FOR}"
    return f"No probe wanted ({figures}). {PROBE_FOR}"


def loop_commands(sha256: str, config: str) -> tuple[str, str]:
    """Return what a person can answer to a candidate: yes and no, about this one and no other.

    Examples
    --------
    >>> loop_commands("055e0d2a1b2c3d4e", "vmc 07.toml")[1]
    "compensator dismiss 055e0d2a1b2c --config 'vmc 07.toml'"
    """
    rest = f" --config {shlex.quote(config)}"
    rest = f" {sha256[:12]}{rest}" if sha256 else rest
    return f"compensator adopt --candidate{rest}", f"compensator dismiss{rest}"


def loop_text(loop: Mapping[str, Any]) -> str:
    """Return in one line what the service does about its model.

    Parameters
    ----------
    loop : mapping
        `loop` of a status.
    """
    effects = ", ".join(loop["effects"]) or "no added effect"
    why = f"{loop['text'][:1].upper()}{loop['text'][1:]}"
    words = {
        "idle": "Model: no other one is compared with it.",
        "shadow": f"Model: a candidate with {effects} runs beside the present one. {why}.",
        "proposed": f"Model: one that has shown itself better is proposed, with {effects}. Now: {loop['text']}.",
        "watching": f"Model: the service goes back to one with {effects} where that is better. {why}.",
    }
    text = words[loop["phase"]]
    if loop.get("before_effects") is not None:
        before = ", ".join(loop["before_effects"]) or "no added effect"
        text += f" The one before the last change, with {before}, goes on, too: {loop['before_text']}."
    if loop.get("others"):
        text += f" Compared, too: {'. '.join(loop['others'])}."
    return f"{text} A diagnosis is in progress." if loop["diagnosing"] else text


def age(seconds: float) -> str:
    """Format an age.

    Examples
    --------
    >>> age(7.4), age(130), age(7000), age(200_000)
    ('7 s', '2 min', '1 h 56 min', '2.3 d')
    """
    if seconds < 120:
        return f"{max(seconds, 0.0):.0f} s"
    if seconds < 3600:
        return f"{seconds // 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{seconds // 3600:.0f} h {seconds % 3600 // 60:.0f} min"
    return f"{seconds / 86400:.1f} d"
