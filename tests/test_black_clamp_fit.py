"""A camera that subtracts its dark signal: the likelihood knows the clamp, and the gain with it."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.simulation.draws import draw_capture

MODEL = hsnoise.cameras.grasshopper3(black_level_dn=64)
EXPOSURE_S = (0.02, 0.05, 0.1, 0.2)


def frames_like(model, frames=2, shape=(32, 32)):
    """Frames of any counts."""
    rng = np.random.default_rng(0)
    counts = [rng.integers(60, 80, (frames, *shape)).astype(np.uint16) for _ in EXPOSURE_S]
    return hsnoise.FrameStack(counts, EXPOSURE_S, black_level=64, cfa=model.cfa, shutter=model.shutter)


def capture(model, seed=3, frames=4, shape=(96, 128)):
    drawn = draw_capture(seed, model, frames_like(model, frames, shape))
    return hsnoise.FrameStack(drawn.counts, EXPOSURE_S, black_level=64, cfa=model.cfa, shutter=model.shutter)


@pytest.mark.slow
def test_clamp_and_gain_are_found_together():
    whole = np.asarray(MODEL["gain"].value) * float(MODEL["dark_current"].rate)
    clamped = MODEL.add(fx.BlackClamp(whole))
    result = hsnoise.fit(capture(clamped), model=clamped)
    assert result.method == "ml"
    for name, (truth, _, _) in clamped.table.items():
        value, error, _ = result.table[name]
        assert error == 0 or abs(value - truth) < 4 * error, name


@pytest.mark.parametrize(
    ("stack", "method", "message"),
    [
        (frames_like(MODEL), "line", "method"),
        (frames_like(MODEL).select(exposures=[1]), "ml", "two or more exposures"),
    ],
)
def test_clamp_that_cannot_be_fitted_is_refused(stack, method, message):
    with pytest.raises(ValueError, match=message):
        hsnoise.fit(stack, model=MODEL.add(fx.BlackClamp(1.0)), method=method)
