"""Jumping pixels: how many, by how much and of which kind; what is only noisier does not pass for them."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise.statistics.pixels.jumps import jumps_of
from hsnoise.statistics.pixels.survey import survey

SHAPE, NOISE_DN = (200, 320), 4.0


def capture(values, exposure_s=0.01):
    counts = np.clip(np.round(100 + values), 0, 65535).astype(np.uint16)
    return hsnoise.FrameStack([counts], (exposure_s,), kind="dark")


def noise(frames, seed=1):
    return NOISE_DN * np.random.default_rng(seed).standard_normal((frames, *SHAPE))


def jumps(frames, fraction, mean_dn, duty, double, exponential, seed=2):
    rng = np.random.default_rng(seed)
    size = mean_dn * (rng.exponential(size=SHAPE) if exponential else 1.0) * (rng.random(SHAPE) < fraction)
    first, second = (rng.random((frames, *SHAPE)) < duty for _ in range(2))
    return size * (first.astype(float) - second if double else first)


@pytest.mark.parametrize(
    ("frames", "fraction", "mean_dn", "duty", "double", "exponential"),
    [
        (8, 0.01, 20.0, 0.3, False, False),
        pytest.param(12, 0.02, 14.0, 0.5, False, True, marks=pytest.mark.slow),
        pytest.param(20, 0.01, 16.0, 0.2, True, False, marks=pytest.mark.slow),
        (24, 0.03, 12.0, 0.15, True, True),
    ],
)
def test_fraction_size_duty_and_kind_are_found(frames, fraction, mean_dn, duty, double, exponential):
    values = noise(frames) + jumps(frames, fraction, mean_dn, duty, double, exponential)
    found = jumps_of(survey(capture(values)), 0)[0]
    assert (found.double_sampling, found.exponential) == (double, exponential)
    for (value, error), true in zip(found[:3], (fraction, mean_dn, duty), strict=True):
        assert 0 < error < true / 3 and abs(value - true) < 4 * error, (value, error, true)


@pytest.mark.slow
def test_many_jumping_pixels_move_the_typical_one_and_are_counted_all_the_same():
    found = jumps_of(survey(capture(noise(16) + jumps(16, 0.2, 16.0, 0.3, False, False))), 0)[0]
    assert abs(found.fraction[0] - 0.2) < 0.03 and abs(found.amplitude_dn[0] - 16.0) < 1.6


def hot(frames):
    rng = np.random.default_rng(3)
    charge = rng.exponential(60.0, SHAPE) * (rng.random(SHAPE) < 0.02)
    return rng.poisson(charge, (frames, *SHAPE))


def noisier(frames, spread):
    return noise(frames) * np.exp(spread * np.random.default_rng(3).standard_normal(SHAPE))


def struck(frames):
    rng = np.random.default_rng(3)
    return np.where(rng.random((frames, *SHAPE)) < 1e-3, rng.exponential(200.0, (frames, *SHAPE)), 0.0)


@pytest.mark.parametrize(
    "values",
    [
        noise(16),
        noisier(16, 0.3),
        pytest.param(noisier(16, 0.6), marks=pytest.mark.slow),
        noise(16) + hot(16),
        noise(16) + struck(16),
        NOISE_DN * np.random.default_rng(3).standard_t(4, (16, *SHAPE)),
        noise(5) + jumps(5, 0.02, 20.0, 0.5, False, False),
    ],
    ids=["normal", "noise differs", "noise differs much", "hot", "hit", "heavy tails", "too few frames"],
)
def test_noisier_pixels_do_not_jump(values):
    assert jumps_of(survey(capture(values)), 0)[0] is None


def test_a_fit_adds_them_and_takes_neither_their_noise_nor_their_share_for_that_of_all_pixels():
    quiet, loud = noise(12), noise(12, seed=5)
    rng = np.random.default_rng(6)
    growing = rng.poisson(3.0 * np.exp(0.5 * rng.standard_normal(SHAPE)), (12, *SHAPE))
    of = [jumps(24, 0.03, 14.0, 0.3, False, True)[i : i + 12] for i in (0, 12)]
    counts = [np.round(100 + one).astype(np.uint16) for one in (quiet + of[0], loud + growing + of[1])]
    result = hsnoise.fit(hsnoise.FrameStack(counts, (0.0, 1.0), kind="dark"), pixels="differ")
    assert "random_telegraph_noise" in result.added and "read_noise_nonuniformity" not in result.added
    assert not any("telegraph" in sentence for sentence in result.doubts)
    value, error, _ = result.table["random_telegraph_noise.fraction"]
    assert abs(value - 0.03) < 4 * error
    # Those that jump by less than the noise stay among the classes of pixels.
    rate = 3.0 * np.exp(0.5**2 / 2)
    for name, true in {"gain": 1.0, "read_noise.sigma": NOISE_DN, "dark_current.rate": rate}.items():
        assert abs(result.table[name][0] / true - 1) < 0.1, name


def differing(spread, fraction):
    """Darks whose pixels differ in read noise (5 e- on average) and dark current; some jump by 30 e-. Gain 2 DN/e-."""
    rng = np.random.default_rng(0)
    rate, sigma = 20 * rng.lognormal(-0.08, 0.4, SHAPE), 5 * rng.lognormal(0, spread, SHAPE)
    trap = 30 * (rng.random(SHAPE) < fraction)
    exposure_s = 0.05, 0.1, 0.2, 0.4
    of = []
    for t in exposure_s:
        normal, states = rng.standard_normal((16, *SHAPE)), rng.random((16, *SHAPE)) < 0.5
        of.append(256 + 2 * (rng.poisson(np.broadcast_to(rate * t, normal.shape)) + sigma * normal + trap * states))
    return hsnoise.FrameStack(
        [np.clip(np.rint(e), 0, 4095).astype(np.uint16) for e in of], exposure_s, white_level=4095
    )


def test_pixels_that_differ_in_noise_bend_no_gain_where_others_jump():
    """Pixels are left out by the other half of the frames: a cut on those that measure made the gain 12 % too large."""
    found = hsnoise.fit(differing(0.4, 0.02))
    gain, error, _ = found.table["gain"]
    assert "random_telegraph_noise" in found.added
    assert abs(gain - 2) < 3 * error and error < 0.1


@pytest.mark.parametrize("spread", [0.25, pytest.param(0.4, marks=pytest.mark.slow)])
def test_log_normal_noise_is_no_doubt(spread):
    found = hsnoise.fit(differing(spread, 0.0))
    assert "random_telegraph_noise" not in found.added
    assert found.trustworthy and not any("telegraph" in doubt for doubt in found.doubts)
