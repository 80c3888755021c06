"""Flats whose variance bends: by the response, which a fit describes, or by electrons that spread, which it names."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import FrameStack
from hsnoise.effects import Nonlinearity
from hsnoise.likelihood import flat_gain as flat_gain_module

GAIN, READ_E, BLACK_DN, WHITE_DN, SHAPE, PRNU = 0.25, 6.0, 300.0, 16383, (192, 256), 0.01
FULL_E = (WHITE_DN - BLACK_DN) / GAIN
LIGHTS = np.linspace(0.05, 0.85, 8)


def capture(rng, short=0.0, spread=0.0, cfa="mono", lights=LIGHTS):
    """Darks and flats: `short` of the response is missing at the full well; there, each of four neighbours takes the
    share `spread` of what a pixel has in excess."""
    response, offset = 1 + PRNU * rng.standard_normal(SHAPE), BLACK_DN + 0.8 * rng.standard_normal(SHAPE)

    def frames(light_e, n):
        electrons = rng.poisson(light_e * response, (n, *SHAPE)).astype(float)
        around = sum(np.roll(electrons**2, way, axis) for way in (1, -1) for axis in (1, 2))
        electrons += spread / FULL_E / 2 * (around - 4 * electrons**2)
        electrons -= short / FULL_E * electrons**2
        counts = offset + GAIN * (electrons + READ_E * rng.standard_normal(electrons.shape))
        return np.clip(np.rint(counts), 0, WHITE_DN).astype(np.uint16)

    options = {"shutter": "global", "white_level": WHITE_DN, "cfa": cfa}
    darks = FrameStack([frames(0.0, 8)], [0.01], **options)
    flats = FrameStack([frames(share * FULL_E, 4) for share in lights], lights, kind="flat", **options)
    return FrameStack.join(darks, flats)


@pytest.mark.parametrize(
    ("cfa", "short"),
    [
        ("RGGB", -0.04),
        pytest.param("mono", 0.04, marks=pytest.mark.slow),
        pytest.param("mono", -0.04, marks=pytest.mark.slow),
        pytest.param("RGGB", 0.04, marks=pytest.mark.slow),
    ],
)
def test_a_bent_response_is_measured_and_drawn(rng, short, cfa):
    """Without it a right gain was red: 215 for a response that falls 3 % short. The photo response fell, too."""
    stack = capture(rng, short, cfa=cfa)
    fit = hsnoise.fit(stack)
    for name, truth in (("nonlinearity.curvature", short / FULL_E), ("photo_response_nonuniformity.sigma", PRNU)):
        value, error, _ = fit.table[name]
        assert abs(value - truth) < 4 * error < 0.8 * abs(truth)
    assert np.allclose(fit.params["gain"].value, GAIN, rtol=0.02)
    assert any("bends (nonlinearity.curvature)" in note for note in fit.notes)
    assert hsnoise.compare(fit, stack, draws=20).error < 3


def test_three_levels_show_a_strong_bend(rng):
    """It was announced, but not in the model: `compare` ended at 40, the photo response was 5 % too small."""
    fit = hsnoise.fit(capture(rng, 0.06, lights=np.array([0.1, 0.45, 0.85])))
    value, error, _ = fit.table["photo_response_nonuniformity.sigma"]
    assert "nonlinearity" in fit.params and abs(value - PRNU) < 4 * error < 0.05 * PRNU


def test_a_bend_that_is_not_quite_significant_widens_the_error_of_the_gain(rng):
    """Gains were 1.0 to 1.6 % too small, by 4 to 6 of their errors, in green."""
    signal, errors = 2000.0 * np.arange(1, 9), np.full(8, 8.0)

    def levels(bend):
        curve = signal * (1 + bend * signal / signal[-1])
        return flat_gain_module._Levels(signal, curve, errors)

    found = []
    of_bend = flat_gain_module._least_squares(levels(0.0), signal[-1], 1).covariance[1, 1] ** 0.5
    for bend in (0.0, 2.6 * of_bend):
        curve = flat_gain_module._curve(levels(bend), signal[-1])
        assert len(curve.coefficients) == 1
        unseen = flat_gain_module._unseen_bend(levels(bend), signal[-1], curve)
        error = np.hypot(np.sqrt(curve.covariance[0, 0]), unseen)
        found.append((curve.coefficients[0] - 1, error, unseen))
    assert found[0][2] == 0 and found[1][2] > 0
    assert abs(found[1][0]) < 2 * found[1][1]


@pytest.mark.parametrize("spread", [pytest.param(0.01, marks=pytest.mark.slow), 0.02])
@pytest.mark.slow
def test_electrons_that_spread_are_no_bent_response(rng, spread):
    """The variance falls as much as where the response bends, but neighbours share what is missing."""
    stack = capture(rng, spread=spread)
    fit = hsnoise.fit(stack)
    assert "nonlinearity" not in fit.params
    for name, truth in (("brighter_fatter.strength", spread / FULL_E), ("photo_response_nonuniformity.sigma", PRNU)):
        value, error, _ = fit.table[name]
        assert abs(value - truth) < 4 * error < 0.5 * truth
    assert any("(brighter_fatter)" in note for note in fit.notes)
    assert hsnoise.compare(fit, stack, draws=20).error < 3


def test_both_at_once_are_told_apart(rng):
    fit = hsnoise.fit(capture(rng, short=0.04, spread=0.02))
    for name, truth in (("brighter_fatter.strength", 0.02 / FULL_E), ("nonlinearity.curvature", 0.04 / FULL_E)):
        value, error, _ = fit.table[name]
        assert abs(value - truth) < 4 * error < truth


def test_a_straight_response_has_no_curvature(rng):
    assert "nonlinearity" not in hsnoise.fit(capture(rng)).params


@pytest.mark.parametrize("curvature", [1e-5, -1e-5, 0.0])
def test_what_was_there_before_the_bend(curvature):
    bend, signal = Nonlinearity(curvature), np.array([-3.0, 0.0, 10.0, 2e4])
    reads = np.where(signal > 0, signal - curvature * signal**2, signal)
    np.testing.assert_allclose(bend.before(reads), signal, rtol=1e-6)
