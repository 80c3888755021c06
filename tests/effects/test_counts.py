"""From electrons to counts: gain, black level, rounding, clipping."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from hsnoise.effects import ADC, BlackLevel, Gain
from hsnoise.model import NoiseModel, sample

KEY = jax.random.key(17)


def counts(clean, *effects, cfa="mono"):
    model = NoiseModel(effects, cfa=cfa, shutter="rolling", exposure_s=0.05)
    return sample(KEY, np.asarray(clean, float), model)


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_gain_and_black_level_belong_to_the_colour_of_the_pixel(cfa):
    gain, black = {"R": 1.5, "G": 1.2, "B": 1.3}, {"R": 64.0, "G": 65.0, "B": 66.0}
    drawn = counts(np.full((1, 4, 6), 10.0), Gain(list(gain.values())), BlackLevel(list(black.values())), cfa=cfa)
    expected = [
        [10 * gain[cfa[2 * (r % 2) + c % 2]] + black[cfa[2 * (r % 2) + c % 2]] for c in range(6)] for r in range(4)
    ]
    np.testing.assert_allclose(drawn[0], expected, rtol=1e-12)


def test_counts_are_the_nearest_integer_clipped_at_zero_and_white():
    signal = [[0.0, 1.4, 1.6, 4094.6, 4095.4, 1e6]]
    drawn = counts(signal, BlackLevel(-1.0), ADC(4094))
    np.testing.assert_array_equal(drawn, [[0, 0, 1, 4094, 4094, 4094]])
    assert drawn.dtype == np.uint16


@pytest.mark.parametrize(
    ("white", "dtype"), [(255, np.uint16), (65535.0, np.uint16), (65536, np.uint32), (None, np.uint32)]
)
def test_counts_never_wrap_around(white, dtype):
    drawn = np.asarray(counts([[0.0, 70000.0, 1e30]], ADC(white)))
    assert drawn.dtype == dtype
    largest = 2**32 - 256 if white is None else white  # the largest whole number below 2^32 in float32
    np.testing.assert_array_equal(drawn, [[0, min(70000, largest), largest]])


@pytest.mark.parametrize("white", [0, -1, 4095.5, float("nan"), 2.0**32])
def test_impossible_white_levels_are_refused(white):
    with pytest.raises(ValueError, match="white_level_dn: expected"):
        ADC(white)
