"""EMCCDs: gain, read noise and dark current from the single electrons of darks; what only resembles a register."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise.statistics.pixels.register import register_of

MULTIPLICATION, DN_PER_E = 300.0, 0.2  # of an electron at the output
STEP_DN, NOISE_DN = MULTIPLICATION * DN_PER_E, 10.0
CLOCKS, RATE = 0.01, 0.005
SHAPE = (96, 128)


class Camera:
    """An EMCCD by NumPy alone, with offsets of pixels, columns and frames, and dark currents that differ."""

    def __init__(self, seed, *, spread=0.0, hot=0.0, clocks=CLOCKS, shape=SHAPE):
        self.rng, self.clocks, self.shape = np.random.default_rng(seed), clocks, shape
        self.offset = 200 + self.rng.normal(0, 0.3, shape) + self.rng.normal(0, 1, (1, shape[1]))
        self.rate = RATE * np.exp(self.rng.normal(-(spread**2) / 2, spread, shape))
        self.rate[self.rng.random(shape) < hot] += 100 * RATE

    def frames(self, exposure_s, n, light_e=0.0):
        entered = self.rng.poisson(self.clocks + self.rate * exposure_s + light_e, (n, *self.shape))
        multiplied = np.where(entered > 0, self.rng.gamma(np.maximum(entered, 1), MULTIPLICATION), 0.0)
        read = self.rng.normal(0, NOISE_DN, entered.shape) + self.rng.normal(0, 0.5, (n, 1, 1))
        return np.clip(np.round(multiplied * DN_PER_E + read + self.offset), 0, 65535).astype(np.uint16)


@pytest.mark.parametrize("clocks", [0.003, 0.03, 0.5])
def test_step_noise_and_electrons_of_darks_are_covered(clocks):
    """Over eight captures, whose pulls scatter by one standard error."""
    true = STEP_DN, np.hypot(NOISE_DN, 12**-0.5), clocks
    found = [register_of(Camera(seed, clocks=clocks).frames(0.0, 20)) for seed in range(8)]
    pulls = np.array([[(v - x) / e for (v, e), x in zip(one[:3], true, strict=True)] for one in found])
    assert np.abs(pulls).max() < 4.0 and np.sqrt((pulls**2).mean()) < 1.6
    assert np.all(np.abs(pulls.mean(0)) < 4.0 / np.sqrt(8))


NORMAL = np.random.default_rng(7).normal(200, NOISE_DN, (16, *SHAPE))
ONE_IN_FIFTY = np.random.default_rng(8).random(SHAPE) < 0.02
NOW_AND_THEN = np.random.default_rng(9).random(NORMAL.shape)


@pytest.mark.parametrize(
    "values",
    [
        NORMAL,
        NORMAL + 12 * NOISE_DN * ONE_IN_FIFTY * (NOW_AND_THEN < 0.3),
        NORMAL + 12 * NOISE_DN * (NOW_AND_THEN < 0.01),
        NORMAL + np.where(NOW_AND_THEN < 1e-4, 900.0, 0.0),
        200 + NOISE_DN * np.random.default_rng(6).standard_t(3, NORMAL.shape),
        200 + (NORMAL - 200) * np.where(ONE_IN_FIFTY, 8, 1),
        200 + np.random.default_rng(5).poisson(np.where(ONE_IN_FIFTY, 900, 100), NORMAL.shape),
    ],
    ids=["normal", "jumps", "jumps of all pixels", "hits", "heavy tails", "noisy pixels", "hot pixels"],
)
def test_other_noise_is_no_register(values):
    assert register_of(np.round(values).astype(np.uint16)) is None


def test_few_frames_show_none():
    assert (
        register_of(Camera(1).frames(0.0, 5)) is None and register_of(Camera(1, clocks=0.03).frames(0.0, 6)) is not None
    )


def test_a_fit_of_darks_tells_all_that_electrons_tell():
    camera = Camera(3, spread=0.3, hot=0.004)
    exposures = [0.05, 40.0]
    fit = hsnoise.fit([camera.frames(t, 16) for t in exposures], exposure_s=exposures)
    assert fit.conclusion.light.value == "green" and not fit.doubts
    assert any("EMCCD" in note for note in fit.notes)
    ordinary = float(np.median(camera.rate))
    for name, true in {
        "gain": STEP_DN,
        "read_noise.sigma": NOISE_DN / STEP_DN,
        "electron_multiplication.clock_induced": CLOCKS,
        "hot_pixels.fraction": float((camera.rate > 50 * RATE).mean()),
        "black_level": 200.0,
    }.items():
        value, error, _ = fit.table[name]
        assert 0 < error < 0.3 * true and abs(value - true) < 4 * error, name
    rate, error, _ = fit.table["dark_current.rate"]
    assert ordinary - 4 * error < rate < RATE + 4 * error
    spread, error, _ = fit.table["dark_current_nonuniformity.spread"]
    assert abs(spread - 0.3) < 4 * error
    assert fit.params["electron_multiplication"].excess == 1.0


def ordinary(hit, exposures, lights=(), gain=0.7, read_e=5.0, rate=0.001, seed=1, level=300):
    """A camera without a register, in which `hit(rng, exposure_s)` adds electrons to a frame; its stack."""
    rng = np.random.default_rng(seed)
    offset = level + rng.normal(0, 3, SHAPE)
    dark = rate * rng.lognormal(0, 0.3, SHAPE)

    def frames(exposure_s, n, light_e=0.0):
        electrons = rng.poisson(dark * exposure_s + light_e, (n, *SHAPE)) + rng.normal(0, read_e, (n, *SHAPE))
        struck = [hit(rng, exposure_s) for _ in range(n)]
        return np.clip(np.round(offset + gain * (electrons + struck)), 0, 65535).astype(np.uint16)

    counts = [frames(t, 16) for t in exposures] + [frames(0.01, 4, light) for light in lights]
    kinds = ["dark"] * len(exposures) + ["flat"] * len(lights)
    return hsnoise.FrameStack(counts, [*exposures, *[0.01] * len(lights)], kind=kinds)


def rays(rng, exposure_s):
    return (rng.random(SHAPE) < 3e-3 * exposure_s / 3600) * rng.exponential(400, SHAPE)


def glitches(rng, exposure_s):
    return (rng.random(SHAPE) < 5e-3) * rng.exponential(60, SHAPE)


@pytest.mark.parametrize(
    ("hit", "exposures", "lights"),
    [(rays, (0.0, 3600.0), ()), (glitches, (0.01,), (1e3, 5e3, 2e4)), (glitches, (0.01, 5000.0), ())],
    ids=["rays of an hour", "glitches beside flats", "glitches beside a dark current"],
)
def test_hits_are_no_electrons_of_a_register(hit, exposures, lights):
    """Though exponential and spread by chance: flats, the growth of the level, or bias frames contradict."""
    fit = hsnoise.fit(ordinary(hit, exposures, lights))
    assert "electron_multiplication" not in fit.params
    gain, error, _ = fit.table["gain"]
    assert abs(gain - 0.7) < max(4 * error, 0.1)


def test_bright_pixels_of_one_exposure_may_be_glitches_and_the_fit_says_so():
    fit = hsnoise.fit(ordinary(glitches, (0.01,)))
    assert "electron_multiplication" in fit.params and fit.conclusion.light.value == "amber"
    assert any("hits or glitches" in doubt for doubt in fit.doubts)


def test_inspect_says_that_the_camera_may_multiply():
    camera = Camera(6)
    darks = [camera.frames(t, 16) for t in (0.0, 60.0)]
    said = " ".join(hsnoise.inspect(darks, exposure_s=[0.0, 60.0]).findings)
    assert "EMCCD" in said and "averages" not in said
    assert "EMCCD" not in " ".join(hsnoise.inspect(ordinary(rays, (0.0, 60.0))).findings)


def test_skewed_read_noise_is_fitted_or_refused():
    """Its tail passes for hot pixels."""
    rng = np.random.default_rng(1)
    counts = np.round(300 + 2 * (rng.gamma(0.3, 6, (16, *SHAPE)) - 1.8)).astype(np.uint16)
    fit = hsnoise.fit([counts], exposure_s=[0.0])
    assert fit.conclusion.light.value != "green"


def test_flats_make_the_gain_better_and_tell_a_small_multiplication():
    camera = Camera(4)
    darks, flats = [camera.frames(0.05, 16)], [camera.frames(0.05, 4, light) for light in (10.0, 40.0)]
    kinds = ["dark", "flat", "flat"]
    alone = hsnoise.fit(darks, exposure_s=[0.05])
    both = hsnoise.fit([*darks, *flats], exposure_s=[0.05, 0.05, 0.05], kind=kinds)
    (_, wide, _), (gain, error, _) = alone.table["gain"], both.table["gain"]
    assert error < wide / 2 and abs(gain - STEP_DN) < 4 * error
    # Electrons that hardly scatter: light without the register, as of stages that multiply by 1.25.
    rng = camera.rng
    few = [
        np.round(rng.poisson(light, (8, *SHAPE)) * STEP_DN + rng.normal(0, NOISE_DN, (8, *SHAPE)) + camera.offset)
        for light in (10.0, 40.0)
    ]
    less = hsnoise.fit([*darks, *(f.astype(np.uint16) for f in few)], exposure_s=[0.05, 0.05, 0.05], kind=kinds)
    assert less.table["electron_multiplication.excess"][0] < 0.2


@pytest.mark.slow
def test_the_model_draws_such_frames_again():
    camera = Camera(5)
    darks = [camera.frames(0.0, 16)]
    fit = hsnoise.fit(darks, exposure_s=[0.0])
    assert hsnoise.compare(fit, darks, exposure_s=[0.0]).fits
    assert np.isnan(fit.table["dark_current.rate"][0])
