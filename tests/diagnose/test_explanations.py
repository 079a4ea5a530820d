"""An explanation begins with micrometres at the range that was seen; coefficients come after them."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest

from compensator.diagnose.choice.found_effect import described, seen_of
from compensator.diagnose.fitting.fit import Term, response
from compensator.diagnose.residual.evidence import Evidence, evidence_of
from compensator.model.effects import Effect, effect_from
from compensator.model.effects.hypothesis import Hypothesis, proposals
from compensator.model.effects.seen import Range, Seen
from compensator.model.effects.unobserved import Unobserved
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import record
from tests.identify.quill_runs import runs_from

#: A size in µm, alone or as a range.
SIZE = re.compile(r"(Up to )?[−+±][\d.]+( to [−+][\d.]+)? µm")


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    columns, _, _ = record([], 5, 12.0)
    columns["spindle_rpm"][400] = 90_000.0  # a single spike is no range
    return evidence_of(load_model("quill"), runs_from(columns))


def at_speed(**changes: object) -> Effect:
    table = {"channel": "spindle_rpm", "curve": "linear", "tau_min": [114.0 / math.log(2.0)], "gain": [-84.0 / 5000.0]}
    return effect_from("input", {**table, "delay_min": 0.0, **changes})


SEEN = Seen(rms_um=31.0, added_um=Range(-71.4, 0.2), channel=Range(2.0, 5000.0))


def test_a_size_at_the_speed_that_was_seen_and_its_half_time() -> None:
    words = at_speed().explain(SEEN)
    assert words.startswith("−84 µm at 5000 rpm of spindle_rpm, half of it after 114 min; ")
    # A size at rest is more than the data showed where the speed did not last: both are given.
    assert "in the data up to −71 µm (31 µm rms)" in words
    assert words.index("a lag of 164 min") > words.index("−84 µm")


@pytest.mark.parametrize(
    ("changes", "seen", "words"),
    [
        # From where to where, if the channel was never near its zero, or has none.
        ({}, Range(1250.0, 5000.0), "−63 µm from 1250 to 5000 rpm of spindle_rpm"),
        ({"channel": "coolant_degc", "gain": [4.0]}, Range(-0.4, 3.1), "+14 µm from −0.4 to 3.1 °C of coolant_degc"),
        # The other direction of rotation.
        ({}, Range(-5000.0, 3000.0), "+84 µm at −5000 rpm"),
        ({"curve": "abs"}, Range(-5000.0, 3000.0), "−84 µm at −5000 rpm"),
        ({"curve": "square", "gain": [1e-6]}, Range(0.0, 5000.0), "+25 µm at 5000 rpm"),
        ({"delay_min": 10.0}, Range(0.0, 5000.0), "half of it after 124 min"),
        ({"tau_min": [10.0, 10.0], "gain": [-0.01, -0.0068]}, Range(0.0, 5000.0), "−84 µm at 5000 rpm"),
    ],
)
def test_the_size_is_that_between_the_ends_of_the_range(changes: dict[str, object], seen: Range, words: str) -> None:
    assert words in at_speed(**changes).explain(dataclasses.replace(SEEN, channel=seen))


def test_half_of_two_lags_is_between_their_own_halves() -> None:
    [minutes] = re.findall(r"after ([\d.]+) min", at_speed(tau_min=[10.0, 100.0], gain=[-0.01, -0.01]).explain(SEEN))
    t = np.linspace(0.0, 200.0, 200_001)
    step = 0.5 * (1.0 - np.exp(-t / 10.0)) + 0.5 * (1.0 - np.exp(-t / 100.0))
    assert float(minutes) == pytest.approx(t[np.argmax(step >= 0.5)], rel=0.01)


def explained(evidence: Evidence, hypothesis: Hypothesis) -> str:
    values = tuple(free.grid[len(free.grid) // 2] for free in hypothesis.free)
    term = Term(hypothesis=hypothesis, values=values, amplitudes=(0.3,) * len(hypothesis.amplitudes))
    return described(term, dict.fromkeys(term.named, 0.1), response(evidence, term), evidence).explanation


def test_every_kind_begins_with_its_size_in_the_data(evidence: Evidence) -> None:
    context = dataclasses.replace(evidence.context, approximate=True)
    found = [*proposals(context), *proposals(context, background=True)]
    hidden = Unobserved(tau_min=9.0, times=((0, 90.0),), sizes_um=(1.0,))
    found.append(Hypothesis(effect=hidden, amplitudes=("size_1_um",)))
    assert {h.effect.kind for h in found} >= {"input", "gain", "dynamics", "delay", "nonlinear", "scheduled", "drift"}
    for hypothesis in found:
        words = explained(evidence, hypothesis)
        assert SIZE.match(words), words
        # No number of a search, and no hyphen for a minus.
        assert not re.search(r"\d[eE][+-]?\d|nan|inf\b|-\d|None", words), words
        assert words.endswith(".") and " ,  " not in words and "  " not in words


def test_the_sizes_are_those_of_the_samples_that_were_used(evidence: Evidence) -> None:
    signal = np.zeros(evidence.used.size)
    signal[:300] = np.linspace(0.0, 30.0, 300)
    used = evidence.used.copy()
    used[150:] = False
    effect = effect_from("gain", {"path": "DTF", "change": 0.15})
    seen = seen_of(effect, signal, dataclasses.replace(evidence, used=used))
    assert seen.added_um.high == pytest.approx(signal[149])
    assert seen.rms_um == pytest.approx(np.std(signal[:150]))
    [record_signals] = evidence.signals
    assert seen.path_um is not None and seen.channel is None
    assert seen.path_um.high == pytest.approx(record_signals.y_dtf_um.max(), rel=0.01)


def test_a_spike_is_no_range(evidence: Evidence) -> None:
    seen = seen_of(at_speed(), np.zeros(evidence.used.size), evidence)
    assert seen.channel is not None and seen.channel.high < 20_000.0


def test_a_path_is_named_with_what_it_does() -> None:
    seen = Seen(rms_um=2.0, added_um=Range(-1.5, 8.2), path_um=Range(-10.0, 54.6))
    words = effect_from("gain", {"path": "DTF", "change": 0.15}).explain(seen)
    assert words.startswith(
        "−1.5 to +8.2 µm (2.0 µm rms): the model's gain of the DTF, which moves Y by −10 to +55 µm, is 15 % too low."
    )
