"""Where and when frames differ from a model: the data of the figure are checked, not its pixels."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
import hsnoise.effects as fx
from hsnoise import plots
from hsnoise.plots._residuals import Apart, _blocks, _maps
from hsnoise.simulation.draws import draw_capture

BASE = (fx.ShotNoise(), fx.DarkCurrent(20.0), fx.ReadNoise(4.0), fx.Gain(2.0), fx.BlackLevel(100.0), fx.ADC())


def model(cfa: str = "mono") -> hsnoise.NoiseModel:
    return hsnoise.NoiseModel(BASE, cfa=cfa, shutter="global", exposure_s=0.1)


def captured(cfa: str = "mono", frames: int = 6, shape: tuple[int, int] = (48, 72), seed: int = 0):
    like = [np.full((frames, *shape), 100 + i, np.uint16) for i in range(2)]
    like = [one + np.random.default_rng(i).integers(0, 9, one.shape, np.uint16) for i, one in enumerate(like)]
    return draw_capture(seed, model(cfa), hsnoise.FrameStack(like, (0.01, 0.1), cfa=cfa, shutter="global"))


def changed(stack, change):
    counts = [one.astype(np.int32) for one in stack.counts]
    change(counts)
    return hsnoise.FrameStack(counts, stack.exposure_s, cfa=stack.cfa, shutter=stack.shutter)


def apart(cfa: str, change=lambda frames: None) -> list[Apart]:
    of = [np.asarray(captured(cfa, seed=i).counts[1], float) for i in range(5)]
    change(of[0])
    return [Apart.of(one, 4, cfa) for one in of]


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
def test_maps_show_where_mean_and_noise_differ(cfa):
    def change(frames):
        frames[:, :16, :24] += 6.0
        frames[::2, 32:, 48:] += 30.0  # between frames: a standard deviation of 15 beside about 9
        frames[:, 20, 30] += 4000.0  # one hot pixel is no place

    (mean, by_chance), (noise, noise_by_chance) = _maps(apart(cfa, change))
    rest = mean[4:8, 6:12].mean()
    assert mean[:4, :6].mean() - rest == pytest.approx(6.0, abs=0.5) and by_chance < 2.0
    assert noise[8:, 12:].mean() > 50 and abs(noise[:8, :12].mean()) < 5 and noise_by_chance < 30


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
def test_draws_of_the_model_differ_by_chance(cfa):
    for shown, chance in _maps(apart(cfa)):
        assert np.sqrt(np.mean(shown**2)) == pytest.approx(chance, rel=0.25)


def test_a_frame_that_is_brighter_or_noisier_stands_out():
    def change(frames):
        frames[2] += 5.0
        frames[4] += np.random.default_rng(0).normal(0, 20, frames[4].shape)

    measured, *drawn = apart("mono", change)
    assert measured.levels.argmax() == 2 and measured.levels[2] == pytest.approx(5 * 5 / 6, abs=0.5)
    assert measured.noise.argmax() == 4 and measured.noise[4] > 1.5 * max(one.noise.max() for one in drawn)


def test_blocks_cover_all_pixels():
    pixels = np.arange(9 * 11, dtype=float).reshape(9, 11)
    found = _blocks(pixels, 4)
    assert found.shape == (3, 3) and found[0, 0] == np.median(pixels[:4, :4])
    assert found[2, 2] == np.median(pixels[8:, 8:]) and found[0, 2] == np.median(pixels[:4, 8:])


def test_the_exposure_is_shown_where_it_stands_out_most():
    def brighter(counts):
        counts[0][:, :24] += 12

    figure = plots.residuals(model(), changed(captured(), brighter))
    assert figure.get_suptitle().endswith("darks of 10 ms")
    assert "rms 6" in figure.axes[4].get_xlabel() or "rms 5" in figure.axes[4].get_xlabel()
    assert len(figure.axes) == 6


def test_single_frames_have_no_residuals():
    with pytest.raises(ValueError, match="residuals need a dark exposure of two frames or more"):
        plots.residuals(model(), captured(frames=1))
    with pytest.raises(ValueError, match="params: made for RGGB"):
        plots.residuals(model("RGGB"), captured())
