"""What closes a model: frames taken apart, posteriors of maps, spectra and variances, a distribution beside noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from hsnoise.effects.measured_distribution import knots
from hsnoise.statistics.apart import Apart
from hsnoise.statistics.deconvolution import quantiles_beside_normal
from hsnoise.statistics.pixels.shrinking import (
    surroundings,
    surroundings_from_posterior,
    values_from_posterior,
    variances_from_posterior,
)
from hsnoise.statistics.spectra import not_negative, periodogram, series_from_posterior, smoothed

SHAPE = (160, 200)


def test_frames_are_taken_apart(rng):
    n, (h, w) = 5, SHAPE
    static, row, column, frame = (
        rng.normal(50, 3, SHAPE),
        rng.normal(0, 2, (n, h)),
        rng.normal(0, 1, (n, w)),
        np.arange(n),
    )
    counts = static + row[:, :, None] + column[:, None] + frame[:, None, None] + rng.normal(0, 2, (n, h, w))
    counts[2, 7, 9] += 500
    found = Apart.of(counts, 1.0)
    assert found.hits.shape == (1,) and abs(found.hits[0] - 500) < 15 and np.argwhere(found.is_hit).tolist() == [[7, 9]]
    centred = row - row.mean(1, keepdims=True) - (row - row.mean(1, keepdims=True)).mean(0)
    np.testing.assert_allclose(found.row, centred, atol=6 * 2 / np.sqrt(w))
    assert abs(found.ordinary_variance() / 4 - 1) < 0.02
    assert found.powers["row"][1:].mean() == pytest.approx(4 + 4 / w, rel=5 * np.sqrt(2 / (4 * h)))
    np.testing.assert_allclose(found.halves.mean(0), found.mean, atol=3)


def test_two_frames_hold_no_hits(rng):
    counts = rng.normal(50, 3, (2, *SHAPE))
    counts[0, 3, 3] = 900
    assert not len(Apart.of(counts, 0.0).hits)


def test_one_frame_far_from_the_others_moves_no_map(rng):
    counts = rng.normal(50, 1, (8, *SHAPE)) + np.array([9, *rng.normal(0, 0.1, 7)])[:, None, None]
    found = Apart.of(counts, 0.0)
    assert abs(found.mean.mean() - 50) < 0.3 and found.powers["frame"][0] < 1


@pytest.mark.parametrize("spread", [0.0, 0.3, 3.0])
def test_a_map_from_the_posterior_is_as_rough_as_the_truth(rng, spread):
    """Neither the noise of estimation nor shrinkage shows; hot pixels stay."""
    trend = np.linspace(0, 5, SHAPE[1]) * np.ones((SHAPE[0], 1))
    truth = trend + spread * rng.standard_exponential(SHAPE)
    truth[5, 5] = 1000
    halves = truth + rng.normal(0, np.sqrt(2), (2, *SHAPE))
    drawn = values_from_posterior(halves.mean(0), halves, 1.0, rng)
    inside = (slice(16, -16), slice(16, -16))  # the trend is extrapolated at the edges
    found, expected = ((x - trend)[inside].var() for x in (drawn, truth))
    assert found == pytest.approx(expected, rel=0.06, abs=0.04) and abs(drawn[5, 5] - 1000) < 6
    assert drawn[inside].mean() == pytest.approx(truth[inside].mean(), abs=0.05)  # the smooth part is a draw, too
    assert spread < 1 or stats.skew((drawn - trend)[inside].ravel()) > 1


@pytest.mark.parametrize(("height", "most"), [(0.0, 0.5), (3.0, 1.5)])
def test_a_smooth_part_from_the_posterior_has_no_noise_of_estimation(rng, height, most):
    """Blocks of 16 pixels of noise 1 scatter by 0.08: added to a map, frames drawn from it would scatter twice.

    Where there is structure, the draw is one of those that the blocks allow.
    """
    shape = (320, 320)
    truth = height * np.cos(np.arange(shape[1]) / 40) * np.ones((shape[0], 1))
    halves = truth + rng.normal(0, np.sqrt(2), (2, *shape))
    drawn = surroundings_from_posterior(halves.mean(0), halves, rng)
    even = surroundings(truth)
    off, measured = ((x - even)[16:-16, 16:-16].std() for x in (drawn, surroundings(halves.mean(0))))
    assert off < most * measured
    assert drawn.std() == pytest.approx(even.std(), rel=0.05, abs=0.02)


def test_surroundings_are_even(rng):
    plane = np.add.outer(np.arange(64.0), 2 * np.arange(80.0))
    np.testing.assert_allclose(surroundings(plane)[8:-8, 8:-8], plane[8:-8, 8:-8], atol=1e-9)


@pytest.mark.parametrize("dof", [2, 8])
@pytest.mark.parametrize("spread", [0.0, 0.7])
def test_variances_from_the_posterior_spread_like_the_truth(rng, dof, spread):
    truth = np.exp(spread * rng.standard_normal(40_000))
    drawn = variances_from_posterior(truth * rng.chisquare(dof, truth.size) / dof, dof, rng)
    assert np.log(drawn).std() == pytest.approx(spread, rel=0.1, abs=0.16)
    assert drawn.mean() == pytest.approx(truth.mean(), rel=0.05)
    assert spread == 0 or np.corrcoef(np.log(drawn), np.log(truth))[0, 1] > 0.25


def test_a_noisy_spectrum_keeps_its_total_and_its_line(rng):
    truth = np.linspace(4, 0, 200) + 60 * (np.arange(200) == 150)
    noise = 4.0 * np.ones(200)
    found = np.mean([not_negative(truth + rng.normal(0, noise), noise) for _ in range(400)], 0)
    assert found.min() >= 0 and found.sum() == pytest.approx(truth.sum(), rel=0.03)
    assert found[150] == pytest.approx(60, rel=0.15) and found[140] < 3
    assert not not_negative(rng.normal(0, noise), noise).any()
    np.testing.assert_allclose(smoothed(np.full(20, 3.0), np.ones(20)), 3.0)


def test_series_from_the_posterior_have_the_spectrum_of_the_truth(rng):
    n, drawn_power, true_power = 256, [], []
    for _ in range(60):
        truth = 2 * np.cumsum(rng.standard_normal(n)) / 8
        halves = truth + rng.normal(0, np.sqrt(2) * 0.5, (2, n))
        error = np.full(n // 2 + 1, 0.25)
        drawn = series_from_posterior(halves.mean(0), halves, error, rng)
        for power, of in ((drawn_power, drawn), (true_power, truth)):
            power.append(periodogram((of - of.mean())[None]))
    found, expected = np.mean(drawn_power, 0), np.mean(true_power, 0)
    assert found.sum() == pytest.approx(expected.sum(), rel=0.1)
    assert found[1:9].sum() == pytest.approx(expected[1:9].sum(), rel=0.1)


def test_the_distribution_beside_normal_noise(rng):
    jumps = np.where(rng.random(400_000) < 0.1, 6.0, 0.0)
    quantiles = quantiles_beside_normal(jumps + rng.standard_normal(jumps.size), 1.0, knots(512))
    levels = knots(512)
    assert np.all(np.diff(quantiles) >= 0)
    assert np.interp(0.5, levels, quantiles) == pytest.approx(0, abs=0.2)
    assert np.interp(0.97, levels, quantiles) == pytest.approx(6, abs=0.2)
