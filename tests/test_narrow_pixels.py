"""Levels and noise of pixels whose noise is below a count, from how often they hold each count."""

from __future__ import annotations

import numpy as np
import pytest

from hsnoise.statistics.pixels.narrow import is_narrow, narrow_from_posterior


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
