"""The published functions against the digits of the checked model."""

import numpy as np
import pytest
from scipy.signal import lfilter

from sim_hardware.physics import Duty, Inputs, PublishedQuill, SensorSpec, World
from sim_hardware.physics.effects import FanOnFilm, ProbeDrift, SealedEffect
from sim_hardware.physics.published import DEFORMATION_POLES, DTF, TDTF, TTF, TTF_POLES, tustin

A = [1.0, -2.4658088, 1.9560319, -0.4901457]


@pytest.mark.parametrize(
    ("numerator", "denominator", "b", "a", "tolerance"),
    [
        (DTF, DEFORMATION_POLES, [-0.0056638, 0.0429893, -0.0372474, 0.0], A, 1e-6),
        (TDTF, DEFORMATION_POLES, [0.3784485, -0.3776426, 0.0, 0.0], A, 3e-5),
        (TTF, TTF_POLES, [0.0155746, -0.0153274, 0.0], [1.0, -1.9118946, 0.9128718], 3e-6),
    ],
)
def test_tustin_gives_the_identified_polynomials(numerator, denominator, b, a, tolerance):
    got_b, got_a = tustin(numerator, denominator)
    np.testing.assert_allclose(got_a, a, atol=6e-8)
    # The zeros at -2.000/min are printed to four digits: that well do the last terms vanish.
    np.testing.assert_allclose(got_b, b, atol=tolerance)


def test_90_w_gives_the_checked_figures():
    quill, y, rise = PublishedQuill(), [], []
    for _ in range(3000):
        quill.advance(60.0, Inputs(heat_w=90.0))
        signals = quill.signals()
        y.append(signals["y_um"])
        rise.append(signals["t_q_degc"] - signals["at_degc"])
    y = np.array(y)
    assert y[0] == pytest.approx(-0.5, abs=0.05)
    assert y[60] == pytest.approx(114.3, abs=0.05)
    digits = lfilter([-0.0056638, 0.0429893, -0.0372474], A, 90.0 * np.ones(300))
    assert y.max() == pytest.approx(digits.max(), abs=0.2)
    assert y.max() == pytest.approx(116.5, abs=1.0)
    assert 80 < y.argmax() < 110
    assert y[-1] == pytest.approx(91.7, abs=0.1)
    assert rise[-1] == pytest.approx(22.6, abs=0.05)
    assert np.diff(y).max() == pytest.approx(5.0, abs=0.3)


def test_a_kelvin_of_air_gives_10_3_um():
    quill = PublishedQuill()
    for _ in range(3000):
        quill.advance(60.0, Inputs(ambient_degc=21.0))
    assert quill.signals()["y_um"] == pytest.approx(10.335, abs=0.01)


def test_pieces_of_a_minute_hold_the_minute():
    whole, pieces = PublishedQuill(), PublishedQuill()
    for k in range(120):
        inputs = Inputs(heat_w=float(k % 7), ambient_degc=20.0 + 0.01 * k)
        whole.advance(60.0, inputs)
        for _ in range(600):
            pieces.advance(0.1, inputs)
        assert pieces.signals() == whole.signals()


def test_a_record_is_exactly_the_discrete_model():
    duty = Duty.paper_validation(seed=5)
    exact = {name: SensorSpec() for name in ("heat_w", "t_q_degc", "at_degc", "y_um")}
    table = World(PublishedQuill(), duty, exact).record()
    rise = lfilter(*tustin(TTF, TTF_POLES), table["heat_w"])
    np.testing.assert_allclose(table["t_q_degc"] - table["at_degc"], rise, atol=1e-9)
    air = np.array([duty.at(t).ambient_degc for t in table["t_s"]]) - 20.0
    y = lfilter(*tustin(DTF, DEFORMATION_POLES), table["heat_w"])
    y += lfilter(*tustin(TDTF, DEFORMATION_POLES), air)
    np.testing.assert_allclose(table["y_um"], y, atol=1e-9)


def test_effects_on_the_outlet_work_and_thermal_ones_are_refused():
    quill = PublishedQuill([ProbeDrift(um_per_h=2.0)])
    for _ in range(60):
        quill.advance(60.0, Inputs())
    assert quill.signals()["y_um"] == pytest.approx(2.0, abs=1e-9)
    for effect in (FanOnFilm(full_speed_factor=2.0), SealedEffect(FanOnFilm(full_speed_factor=2.0))):
        with pytest.raises(ValueError, match="QuillMachine"):
            PublishedQuill([effect])
