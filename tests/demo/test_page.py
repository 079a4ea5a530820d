"""What the demo says of its loop is what happened: a model that was left as it was is not said to be taken over."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from compensator.report.demonstration import MachineDay, page_of
from compensator.report.page import Table, html_of
from tests.demo.made import SHOP_DAY

T_H = np.arange(240) / 60.0


def words(loop: dict[str, Any]) -> str:
    figures = {key: {"rms_um": 1.0, "peak_to_peak_um": 9.0} for key in ("without", "held", "followed")}
    errors = {"t_h": T_H, "without": 90.0 * np.sin(T_H), "followed": np.sin(9.0 * T_H)}
    day = MachineDay(name="conduction", figures=figures, errors=errors, heat=(T_H, T_H, T_H, T_H))
    lines = dict.fromkeys(("first", "extended"), (T_H, errors["followed"]))
    return html_of(page_of([day], Table(head=["a"], rows=[["b"]]), loop, lines, SHOP_DAY, []))


@pytest.mark.parametrize(
    ("adopted", "offset_changes", "there", "not_there"),
    [
        (True, True, "adopted the extended model; errors from 1.0 h on", "not changed"),
        (True, False, "the model changes its standard deviation only", "found in the recordings, 1.2"),
        (False, False, "The model was not changed", "adopted the extended model"),
    ],
)
def test_the_page_says_whether_a_model_was_taken_over(
    adopted: bool, offset_changes: bool, there: str, not_there: str
) -> None:
    loop = {
        "second_day_rms_um": {"without": 38.3, "first": 6.3, "extended": 1.2 if adopted else 6.3},
        "found": ["drift"],
        "verdict": "partly_explained",
        "drawn": "drift",
        "adopted": adopted,
        "offset_changes": offset_changes,
        "adopted_after_h": float(adopted),
    }
    page = words(loop)
    assert there in page and not_there not in page and "partly explained" in page
    assert ("drift) are not deployable" in page) is not offset_changes
