"""Levels and noise of pixels whose noise is below a count, from how often they hold each count."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise.statistics.pixels.narrow import is_narrow, narrow_from_posterior, narrow_law


@pytest.mark.parametrize(("noise", "offsets", "n_frames"), [(0.25, 0.15, 20), (0.15, 0.3, 10), (0.32, 0.1, 6)])
def test_frames_drawn_from_the_posterior_are_like_new_frames(noise, offsets, n_frames):
    rng, shape = np.random.default_rng(1), (160, 256)
    rows, columns = 0.08 * rng.normal(size=(shape[0], 1)), 0.05 * rng.normal(size=(1, shape[1]))
    level = 2.9 + offsets * rng.normal(size=shape) + rows + columns
    sigma = noise * np.exp(0.2 * rng.normal(size=shape))

    def frames(level, sigma):
        return np.rint(level + sigma * rng.normal(size=(n_frames, *shape)))

    seen, new = frames(level, sigma), frames(level, sigma)
    found = narrow_from_posterior(seen, rng)
    drawn = frames(found.level, found.sigma)
    assert is_narrow(seen)
    assert np.sqrt(np.mean(found.sigma**2)) == pytest.approx(np.sqrt(np.mean(sigma**2)), rel=0.05)
    assert found.level.std() == pytest.approx(level.std(), rel=0.06)
    # Counts as they are would give these too small or too large by up to a half.
    assert drawn.var(0, ddof=1).mean() == pytest.approx(new.var(0, ddof=1).mean(), rel=0.04)
    assert drawn.mean(0).std() == pytest.approx(new.mean(0).std(), rel=0.04)
    for axis in (1, 2):
        assert drawn.mean((0, axis)).std() == pytest.approx(new.mean((0, axis)).std(), rel=0.15)
    for count in (2, 3, 4):
        assert np.mean(drawn == count) == pytest.approx(np.mean(new == count), rel=0.05, abs=1e-3)
    # A draw from the posterior is as far from the truth as the truth is from it.
    told = np.corrcoef(seen.mean(0).ravel(), new.mean(0).ravel())[0, 1]
    assert np.corrcoef(drawn.mean(0).ravel(), new.mean(0).ravel())[0, 1] == pytest.approx(told, abs=0.25)


def test_the_slope_says_how_much_counts_move_with_levels():
    rng = np.random.default_rng(2)
    level = 3.0 + 0.05 * rng.normal(size=(100, 200))

    def mean_of(level):
        return np.mean(np.rint(level + 0.25 * rng.normal(size=(20, *level.shape))))

    found = narrow_from_posterior(np.rint(level + 0.25 * rng.normal(size=(20, *level.shape))), rng)
    assert found.slope == pytest.approx((mean_of(level + 0.05) - mean_of(level - 0.05)) / 0.1, abs=0.05)
    assert found.slope < 0.5


def test_pixels_far_from_the_others_keep_their_level():
    rng = np.random.default_rng(3)
    level = np.full((64, 64), 5.0)
    level[10, 20] = 40.2
    counts = np.rint(level + 0.3 * rng.normal(size=(8, 64, 64)))
    assert narrow_from_posterior(counts, rng).level[10, 20] == pytest.approx(counts[:, 10, 20].mean())


def test_ordinary_noise_is_not_narrow():
    rng = np.random.default_rng(4)
    assert not is_narrow(np.rint(100 + rng.normal(size=(6, 64, 64))))


def darks_below_a_count(n_frames: int = 16, seed: int = 5) -> hsnoise.FrameStack:
    """8-bit darks of one exposure: noise of 0.24 DN, offsets of pixels, rows and columns, rows and frames that move."""
    rng, shape = np.random.default_rng(seed), (192, 256)
    level = (
        2.9 + 0.12 * rng.normal(size=shape) + 0.06 * rng.normal(size=(shape[0], 1)) + 0.05 * rng.normal(size=shape[1])
    )
    frames = level + 0.24 * rng.normal(size=(n_frames, *shape))
    frames += 0.03 * rng.normal(size=(n_frames, shape[0], 1)) + 0.03 * rng.normal(size=(n_frames, 1, 1))
    counts = np.rint(frames).astype(np.uint8)
    return hsnoise.FrameStack([counts], [1e-4], white_level=255, cfa="mono", shutter="global")


def test_fits_measure_levels_and_not_counts():
    """Rows and columns came out a third too small, with errors of 4 %, and pixels at 0.09 +- 0.09 DN."""
    params = hsnoise.fit(darks_below_a_count()).params
    truth = {"read_noise": (0.24, 0.02), "dark_signal_nonuniformity": (0.12, 0.05), "row_noise": (0.03, 0.15)}
    truth |= {"row_fixed_pattern": (0.06, 0.2), "column_fixed_pattern": (0.05, 0.2), "frame_offset": (0.03, 0.6)}
    for name, (true, within) in truth.items():
        assert float(params[name].sigma) == pytest.approx(true, rel=within), name
    assert "read_noise_nonuniformity" not in params


@pytest.mark.slow
def test_noise_that_differs_between_narrow_pixels_is_measured():
    rng, shape, laws = np.random.default_rng(7), (256, 256), []
    for spread in (0.0, 0.15, 0.3):
        sigma = 0.25 * np.exp(spread * rng.normal(size=shape))
        level = 2.9 + 0.15 * rng.normal(size=shape)
        law = narrow_law(np.rint(level + sigma * rng.normal(size=(20, *shape))))
        assert law.sigma[0] == pytest.approx(np.sqrt(np.mean(sigma**2)), abs=4 * law.sigma[1])
        assert law.offset[0] == pytest.approx(0.15, abs=4 * law.offset[1])
        laws.append(law)
    assert laws[0].spread[0] < 4 * laws[0].spread[1]
    for law, spread in zip(laws[1:], (0.15, 0.3), strict=True):
        assert law.spread[0] == pytest.approx(spread, abs=3 * law.spread[1]) and law.spread[1] < 0.03


def test_frames_of_a_fit_are_like_darks_below_a_count():
    """`compare` of a right fit ended at 345."""
    stack = darks_below_a_count()
    assert hsnoise.compare(hsnoise.fit(stack), stack, draws=20).error < 5
