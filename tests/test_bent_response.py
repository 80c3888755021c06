"""Flats whose variance bends: by the response, which a fit describes, or by electrons that spread, which it names."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import FrameStack
from hsnoise.effects import Nonlinearity

GAIN, READ_E, BLACK_DN, WHITE_DN, SHAPE, PRNU = 0.25, 6.0, 300.0, 16383, (192, 256), 0.01
FULL_E = (WHITE_DN - BLACK_DN) / GAIN
LIGHTS = np.linspace(0.05, 0.85, 8)


def capture(rng, short=0.0, spread=0.0, cfa="mono"):
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
    flats = FrameStack([frames(share * FULL_E, 4) for share in LIGHTS], LIGHTS, kind="flat", **options)
    return FrameStack.join(darks, flats)


@pytest.mark.parametrize("short", [0.04, -0.04])
@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
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


@pytest.mark.parametrize("spread", [0.01, 0.02])
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
