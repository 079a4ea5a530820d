"""The table of errors in free run says when most of an error is the constant of a zero that was not at rest."""

from __future__ import annotations

import numpy as np
import pytest

import compensator as tc
from compensator.display import Table
from compensator.model.free_run import CONSTANT, NOTHING, PERSISTENCE, table_of_scores
from compensator.model.simulation import Scores
from tests.diagnose.scenarios import draw, record


def row(rms_um: float, about_mean_um: float) -> Scores:
    return Scores(fit_pct=90.0, rms_um=rms_um, peak_to_peak_um=3.0, rms_about_mean_um=about_mean_um, mean_abs_um=1.0)


@pytest.mark.parametrize(
    ("model", "said"),
    [(row(9.0, 3.0), True), (row(4.0, 3.0), False), (row(0.5, 0.1), False)],
    ids=["a constant", "much beside it", "too small to matter"],
)
def test_the_note_names_a_constant(model: Scores, *, said: bool) -> None:
    others = {NOTHING: row(60.0, 20.0), PERSISTENCE: row(60.0, 20.0)}
    assert (CONSTANT in table_of_scores([{"quill": model, **others}]).note) is said


@pytest.mark.parametrize("wrong_um", [0.0, 8.0])
def test_a_wrong_first_value_is_told_by_the_command(wrong_um: float) -> None:
    columns, _, _ = record([draw("none", 1)], 1500, 12.0)
    columns["y_um"][0] += wrong_um
    found = tc.simulate("quill", {"t_s": 60.0 * np.arange(columns["y_um"].size), **columns})
    notes = [part.note for part in found.contents() if isinstance(part, Table)]
    assert len(notes) == 1
    assert (CONSTANT in notes[0]) is (wrong_um > 0.0)
