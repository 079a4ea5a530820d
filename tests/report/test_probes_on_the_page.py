"""`compensator report` of a machine whose Y is measured by a touch probe."""

from __future__ import annotations

import html
from pathlib import Path

import numpy as np
import pytest

from compensator.recording.reading import recordings
from compensator.report.gathering import read_history
from compensator.report.page import codes_of, html_of
from compensator.report.recordings import figures, page_of, verdict
from tests.service.living import MACHINE
from tests.service.probed import PROBED, ProbedMachine


async def test_a_day_with_probes_shows_them(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(400)
    machine.at_sample[200] = lambda: machine.probe(25.0)  # a chip
    await machine.run(420)
    history = read_history(recordings(machine.recordings, MACHINE))
    taken = [probe for probe in machine.recorded() if probe.taken]
    assert (history.probes_count, history.probes_taken) == (7, len(taken)) == (7, 6)
    left = [probe.measured_um for probe in taken]
    assert history.probes_left.rms == pytest.approx(np.sqrt(np.mean(np.square(left))))
    chip = next(probe for probe in history.probes if not probe.taken)
    assert chip.code == "probe_outlier" and chip.deformation_um - chip.predicted_um == pytest.approx(25.0, abs=8.0)
    page = page_of(history)
    shown = html.unescape(html_of(page))
    assert "probe_outlier" in codes_of(page.blocks) and "Y was not measured" not in shown
    assert "6 of 7 probe(s) taken" in shown and "is a share of its own" in shown
    assert f"6 probe(s) found {history.probes_left.rms:.1f} µm rms" in verdict(history)
    assert (figures(history)["probes"], figures(history)["probes_taken"]) == (7, 6)
    # The correction makes the shares add up to the prediction.
    curves = {name: curve.points() for name, curve in history.curves.items()}
    t, correction = curves["share probes"]
    parts = sum(np.interp(t, *curves[name]) for name in curves if name.startswith("share ") and name != "share probes")
    assert parts + correction == pytest.approx(np.interp(t, *curves["predicted"]), abs=1e-9)
    assert np.max(np.abs(correction)) > 1.0


async def test_probes_that_were_all_refused_are_no_error_of_zero(tmp_path: Path) -> None:
    """As in a calibration, where the control applies nothing."""
    config = PROBED.replace(b"measured_max_um = 60.0", b"measured_max_um = 200.0")
    machine = ProbedMachine(tmp_path, config=config)
    machine.at_sample[100] = lambda: machine.probe(measured_um=machine.truth_um(), offset_applied_um=0.0)
    await machine.run(110)
    history = read_history(recordings(machine.recordings, MACHINE))
    shown = html.unescape(html_of(page_of(history)))
    assert "0 of 1 probe(s) taken" in shown and "probe_mismatch" in shown
    assert figures(history)["probes_left_rms_um"] is None and "nan" not in shown.lower()
