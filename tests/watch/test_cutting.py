"""The headline says whether one may cut, and until when; each code with its own words."""

from __future__ import annotations

from typing import Any

import pytest

from compensator.codes import SUFFIX_WORDS, SUFFIXES, Reason, Remark, SampleQuality, State, WatchWarning, explain
from compensator.watch.cutting import Headline, headline

NOW_NS = 1_767_600_000_000_000_000
GONE = Remark(WatchWarning.TOKEN_GONE, "Its liveliness token is gone.")
TWO = Remark(WatchWarning.TWO_SERVICES, "Two services publish below this prefix: vmc-07 and vmc-08.")
MISSED = Remark(WatchWarning.MISSED_MESSAGES, "1 message(s) did not arrive here.")


def of(shown: str, *reasons: str, tone: str = "warn", until_min: float | None = None, **channels: str) -> Headline:
    qualities: dict[str, dict[str, Any]] = {
        name: {"quality": quality, "do": SampleQuality(quality).action} for name, quality in channels.items()
    }
    until_ns = None if until_min is None else NOW_NS + round(until_min * 60e9)
    return headline(shown=shown, tone=tone, reasons=reasons, channels=qualities, until_ns=until_ns, now_ns=NOW_NS)


def test_a_broken_couple_is_named_with_the_time_that_is_left() -> None:
    found = of("degraded", "t_q_missing", "predicting", until_min=58.2, t_q_degc="open_circuit")
    assert found.cut == "until" and found.word.startswith("May cut until ")
    assert found.text == ("T_Q: wire open. Predicted for another 58 min, then held. Check thermocouple and terminals.")
    held = of("hold", "t_q_missing", "prediction_expired", tone="bad", t_q_degc="open_circuit")
    assert (held.cut, held.word) == ("no", "Do not cut to size")
    assert held.text == "The offset is frozen. T_Q: wire open. Check thermocouple and terminals."


def test_a_missing_temperature_whose_last_known_quality_was_good_is_not_called_good() -> None:
    found = of("degraded", "t_q_missing", "predicting", until_min=58.2, t_q_degc="good")
    assert found.text.startswith("T_Q: missing. Predicted for another 58 min") and "Nothing" not in found.text
    assert Reason.T_Q_MISSING.action in found.text


@pytest.mark.parametrize(
    ("shown", "reasons", "cut", "words"),
    [
        ("ok", (), "yes", "The offset follows the model."),
        ("starting", ("no_zero",), "no", "No zero has been set yet."),
        ("fault", ("t_q_at_exchanged",), "no", "the two sensors are exchanged"),
        (WatchWarning.SILENT, ("predicting",), "no", ""),
        ("hold", ("operator_hold",), "no", "Send the command resume."),
        ("hold", ("outside_validity:at_degc",), "no", "AT is outside the range in which the machine was calibrated."),
        ("degraded", ("implausible:y_um",), "care", "Check the displacement sensor"),
        ("degraded", ("implausible:model",), "care", "run `compensator diagnose`"),
        ("degraded", ("rate_limited",), "care", "Wait;"),
    ],
)
def test_each_state_says_whether_one_may_cut(shown: str, reasons: tuple[str, ...], cut: str, words: str) -> None:
    found = of(shown, *reasons, tone="good" if shown == State.OK else "warn")
    assert found.cut == cut and words in found.text


@pytest.mark.parametrize("reasons", [("implausible:model",), ("implausible:model", "rate_limited")])
def test_the_deviation_of_an_offset_on_its_way_is_that_of_its_target(reasons: tuple[str, ...]) -> None:
    found = headline(
        shown="degraded", tone="warn", reasons=reasons, channels={}, until_ns=None, now_ns=NOW_NS, std_um=0.53
    )
    end = " once it has reached its target." if len(reasons) > 1 else "."
    assert found.text.endswith(f"Offset ±0.5 µm (one standard deviation){end}")


def test_a_start_says_once_that_there_is_no_zero() -> None:
    found = of("starting", "no_zero")
    assert found.text == f"No zero has been set yet. {State.STARTING.action}"
    # With a cause, the cause comes first.
    assert of("starting", "t_q_missing", "no_zero").text.startswith(Reason.T_Q_MISSING.meaning)


def test_a_doubt_in_the_model_beside_a_lost_couple_asks_for_care() -> None:
    found = of("degraded", "t_q_missing", "implausible:model", "predicting", until_min=29.0, t_q_degc="open_circuit")
    assert found.cut == "until" and found.word.startswith("Cut with care until ")
    # The doubt has its words beside the wire that is open.
    meaning, _ = explain("implausible:model") or ("", "")
    assert "T_Q: wire open." in found.text and meaning and found.text.endswith(meaning)


def test_the_standard_deviation_stands_beside_what_may_be_cut() -> None:
    options: dict[str, Any] = {"tone": "good", "reasons": (), "channels": {}, "until_ns": None, "now_ns": NOW_NS}
    assert "±0.4 µm" in headline(shown="ok", std_um=0.42, **options).text
    assert "±" not in headline(shown="fault", std_um=0.42, **options).text


def test_warnings_of_a_machine_that_is_ok_ask_for_care() -> None:
    options: dict[str, Any] = {"reasons": (), "channels": {}, "until_ns": None, "now_ns": NOW_NS}
    found = headline(shown="ok", tone="warn", warnings=[GONE, MISSED], **options)
    assert (found.cut, found.text) == ("care", GONE)
    # Nothing is pointed at that is not there.
    assert "below" not in of("degraded").text and of("degraded").text != ""


@pytest.mark.parametrize(
    ("until_min", "reasons", "word"),
    [
        (20.0, ("t_q_missing", "predicting"), "Cut with care until "),
        (None, ("t_q_missing", "predicting"), "Cut with care"),
        (None, ("implausible:at_degc", "implausible:model"), "Cut with care"),
        (None, ("implausible:model",), "Cut with care"),
        (None, ("rate_limited",), "Cut with care"),
        (None, ("t_q_missing",), "Cut with care"),
    ],
)
def test_what_the_service_cannot_know_stands_beside_its_reasons(
    until_min: float | None, reasons: tuple[str, ...], word: str
) -> None:
    options: dict[str, Any] = {"shown": "degraded", "tone": "warn", "reasons": reasons, "channels": {}}
    options |= {"until_ns": None if until_min is None else NOW_NS + round(until_min * 60e9), "now_ns": NOW_NS}
    without = headline(**options, warnings=[MISSED])
    found = headline(**options, warnings=[GONE, MISSED])
    assert found.word.startswith(word) and found.text == f"{without.text} {GONE}"
    assert headline(**options, warnings=[TWO, GONE]) == Headline("no", "Do not cut to size", TWO)


def test_nobody_cuts_by_the_offset_of_one_of_two_services() -> None:
    found = headline(shown="ok", tone="bad", reasons=(), channels={}, until_ns=None, now_ns=NOW_NS, warnings=[TWO])
    assert found == Headline("no", "Do not cut to size", TWO)


def test_several_suspects_send_nobody_to_a_healthy_sensor() -> None:
    found = of("degraded", "implausible:at_degc", "implausible:model", "implausible:t_q_degc")
    assert found.cut == "care"
    assert "whether the model lacks an effect or AT is wrong or T_Q is wrong" in found.text
    assert "terminals" not in found.text and "Measure the part" in found.text


def test_codes_with_a_listed_suffix_have_words_of_their_own() -> None:
    for code in (Reason.IMPLAUSIBLE, Reason.SUSPECT_CHANNEL, Reason.OUTSIDE_VALIDITY):
        found = [explain(f"{code}:{suffix}") for suffix in SUFFIXES[code]]
        assert None not in found and len(set(found)) == len(SUFFIXES[code]), code
    assert explain("implausible:oil") == (Reason.IMPLAUSIBLE.meaning, Reason.IMPLAUSIBLE.action)
    assert all(code.partition(":")[2] in SUFFIXES[code.partition(":")[0]] for code in SUFFIX_WORDS)


def test_while_the_service_proposes_a_model_nobody_is_sent_to_look_for_one() -> None:
    given: dict[str, Any] = {"shown": "degraded", "tone": "warn", "reasons": ["implausible:model"], "channels": {}}
    found = headline(**given, until_ns=None, now_ns=NOW_NS, is_proposed=True)
    assert "diagnose" not in found.text and found.text.endswith("answer the proposal.")
    assert "`compensator diagnose`" in headline(**given, until_ns=None, now_ns=NOW_NS).text


def test_no_machine_is_all_well_while_measured_y_speaks_against_its_model() -> None:
    """With probes, which correct the present model, no other reason shows it."""
    well: dict[str, Any] = {"shown": "ok", "tone": "good", "reasons": [], "channels": {}, "until_ns": None}
    assert headline(**well, now_ns=NOW_NS).cut == "yes"
    found = headline(**well, now_ns=NOW_NS, is_proposed=True)
    assert found.cut == "care" and found.text.endswith("answer the proposal.")
