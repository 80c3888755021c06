"""Hits of single frames: cosmic rays with their rate and charge, and what only looks like them."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.simulation.draws import draw_capture
from hsnoise.statistics.pixels.hits import hits_of, rays_of

NOISE_DN = 4.0


def noise(frames=8, pixels=200_000, seed=3):
    return np.random.default_rng(seed).normal(900, NOISE_DN, (frames, pixels)).astype(np.float32)


def struck(values, per_pixel, mean_dn, seed=4):
    rng = np.random.default_rng(seed)
    return values + np.where(rng.random(values.shape) < per_pixel, rng.exponential(mean_dn, values.shape), 0)


@pytest.mark.parametrize("frames", [4, 5, 12])
def test_rate_charge_and_hits_at_readout_are_found(frames):
    several = [(t, hits_of(struck(noise(frames), 1e-6 * (3 * t + 20), 150.0))) for t in (0.0, 60.0)]
    rays = rays_of(several)
    for (value, error), true in zip(rays, (3.0, 150.0, 20.0), strict=True):
        assert 0 < error < true and abs(value - true) < 4 * error


def test_of_one_exposure_all_hits_grow_with_it_unless_it_is_bias():
    hits = hits_of(struck(noise(), 1e-4, 150.0))
    assert rays_of([(30.0, hits)]).at_readout == (0.0, 0.0) and abs(rays_of([(30.0, hits)]).rate[0] - 100 / 30) < 1.0
    assert rays_of([(0.0, hits)]).rate == (0.0, 0.0) and abs(rays_of([(0.0, hits)]).at_readout[0] - 100) < 30


def jumping(values, share, duty):
    rng = np.random.default_rng(5)
    return values + 15 * NOISE_DN * (rng.random(values.shape[1]) < share) * (rng.random(values.shape) < duty)


@pytest.mark.parametrize(
    "values",
    [
        noise(),
        noise(4),
        jumping(noise(), 0.01, 0.5),
        jumping(noise(), 0.01, 0.1),
        900 + NOISE_DN * np.random.default_rng(6).standard_t(3, (8, 200_000)).astype(np.float32),
        noise() * np.where(np.arange(200_000) < 4000, 8, 1),  # noisy pixels
    ],
    ids=["normal", "four frames", "jumps", "rare jumps", "heavy tails", "noisy pixels"],
)
def test_noise_is_no_ray(values):
    assert rays_of([(0.0, hits_of(values)), (60.0, hits_of(values))]) is None


def test_three_frames_cannot_show_a_hit():
    assert hits_of(noise(3, 100)) is None


@pytest.mark.parametrize("cfa", ["mono", pytest.param("RGGB", marks=pytest.mark.slow)])
def test_a_fit_adds_them_in_electrons_and_keeps_the_rest(cfa):
    effects = [
        fx.ShotNoise(),
        fx.DarkCurrent(1.0),
        fx.ReadNoise(10.0),
        fx.Gain(0.5),
        fx.BlackLevel(900.0),
        fx.ADC(None),
    ]
    extra = [fx.HotPixels(0.01, 20.0), fx.DarkCurrentNonuniformity(0.3), fx.CosmicRays(5.0, 800.0)]
    model = hsnoise.NoiseModel([*effects, *extra], cfa=cfa, shutter="rolling", exposure_s=60.0)
    exposure_s, shape = (0.0, 60.0), (200, 256)
    empty = [np.arange(8 * np.prod(shape), dtype=np.uint16).reshape(8, *shape) for _ in exposure_s]
    result = hsnoise.fit(draw_capture(7, model, hsnoise.FrameStack(empty, exposure_s, cfa=cfa)))
    assert "cosmic_rays" in result.added
    for name, true in {"cosmic_rays.rate": 5.0, "cosmic_rays.charge": 800.0, "read_noise.sigma": 10.0}.items():
        value, error, _ = result.table[name]
        assert abs(value - true) < 4 * error, (name, value, error)
