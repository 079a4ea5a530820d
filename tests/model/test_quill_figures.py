"""The published model against the figures computed from its printed equations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compensator.model.model_file import load_model
from compensator.model.transfer_function import TransferFunction, continuous_image

QUILL = load_model("quill")


def test_gains_and_time_constants() -> None:
    assert QUILL.ttf is not None and QUILL.tdtf is not None
    dtf, tdtf, ttf = QUILL.dtf.in_s(), QUILL.tdtf.in_s(), QUILL.ttf.in_s()
    assert dtf.dc_gain == pytest.approx(1.0182, abs=5e-5)
    assert tdtf.dc_gain == pytest.approx(10.335, abs=5e-4)
    assert ttf.dc_gain == pytest.approx(0.25117, abs=1e-5)
    assert dtf.time_constants_min() == pytest.approx([1.566, 20.92, 291.9], rel=5e-4)
    assert ttf.time_constants_min() == pytest.approx([12.82, 76.34], rel=5e-4)
    assert sorted(dtf.zeros_per_min().real) == pytest.approx([-2.0, -0.002488, 1.473], rel=1e-3)
    assert sorted(ttf.zeros_per_min().real) == pytest.approx([-2.0, -0.01588], rel=1e-3)


def test_tustin_gives_the_identified_polynomials_back() -> None:
    assert QUILL.ttf is not None and QUILL.tdtf is not None
    a = (1.0, -2.4658088, 1.9560319, -0.4901457)
    assert QUILL.dtf.sampled.a == pytest.approx(a, abs=6e-8)
    assert QUILL.dtf.sampled.b[:3] == pytest.approx((-0.0056638, 0.0429893, -0.0372474), abs=6e-8)
    assert QUILL.tdtf.sampled.a == pytest.approx(a, abs=6e-8)
    assert QUILL.tdtf.sampled.b[:2] == pytest.approx((0.3784485, -0.3776426), abs=6e-8)
    assert QUILL.ttf.sampled.b[:2] == pytest.approx((0.0155746, -0.0153274), abs=6e-8)
    assert QUILL.ttf.sampled.a == pytest.approx((1.0, -1.9118946, 0.9128718), abs=6e-8)
    # What the printed digits leave of the zeros at z = 0.
    assert max(abs(QUILL.dtf.sampled.b[3]), abs(QUILL.ttf.sampled.b[2]), abs(QUILL.tdtf.sampled.b[3])) < 1e-4


def test_step_of_90_w() -> None:
    assert QUILL.ttf is not None
    heat = np.full(3000, 90.0)
    y, difference = QUILL.dtf.sampled.response(heat), QUILL.ttf.sampled.response(heat)
    assert y[0] == pytest.approx(-0.51, abs=0.01)
    assert y[60] == pytest.approx(114.3, abs=0.3)
    assert 115.0 < y.max() < 118.0 and 80 < y.argmax() < 110
    assert y[-1] == pytest.approx(91.64, abs=0.1)
    assert difference[-1] == pytest.approx(22.6, abs=0.05)
    assert np.max(np.diff(y)) == pytest.approx(5.0, abs=0.6)


def test_noise_gain_of_the_inverse_at_nyquist() -> None:
    assert QUILL.ttf is not None
    sign = (-1.0) ** np.arange(3)
    ttf = QUILL.ttf.sampled
    assert abs(np.dot(ttf.a, sign) / np.dot(ttf.b, sign)) == pytest.approx(123.8, abs=0.1)


def test_method_i_is_an_alternative() -> None:
    other = QUILL.with_alternative("TDTF-I")
    assert other.tdtf is not None
    assert other.tdtf.in_s().dc_gain == -3.0
    assert other.tdtf.in_s().time_constants_min() == pytest.approx([100.0 / 60.0])


@given(
    st.lists(st.floats(0.5, 500.0), min_size=1, max_size=3, unique=True),
    st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=4),
)
def test_continuous_image_undoes_the_sampling(time_constants: list[float], numerator: list[float]) -> None:
    denominator = np.poly([-1.0 / t for t in time_constants])[::-1]
    function = TransferFunction(
        numerator=tuple(numerator[: len(denominator)]), denominator=tuple(denominator), unit="um/W"
    )
    image = continuous_image(function.sampled(60.0), unit="um/W")
    for s in (0.003j, 0.03j, 0.3j):
        expected = np.polyval(function.numerator[::-1], s) / np.polyval(function.denominator[::-1], s)
        found = np.polyval(image.numerator[::-1], s) / np.polyval(image.denominator[::-1], s)
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-9 * max(1.0, max(map(abs, numerator))))
