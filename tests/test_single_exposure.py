"""Bias frames and a few flats, as a CCD's owner has them: clipping, warm pixels, slow rows, a vignette."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise._core.coloured import EXPONENTS, exponent_of, fading_power
from hsnoise.statistics.pixels.flags import FLAGS, flags_of
from hsnoise.statistics.pixels.survey import survey

GAIN, READ_E, BLACK_DN, SHAPE, WARM, CHARGE_E, SLOW_E = 2.2, 16.0, 105.0, (192, 256), 0.03, 40.0, 1.2


class Ccd:
    """Read noise that clips at 0 in 0.2 % of the counts, warm pixels in bias frames, row noise of slow rows.

    growth: of the warm pixels' charge in a second, relative to that of a bias frame.
    """

    def __init__(self, seed=0, exponent=1.5, growth=0.0):
        self.growth = growth
        self.rng = np.random.default_rng(seed)
        hot = self.rng.random(SHAPE) < WARM
        self.warm_e = np.where(hot, self.rng.exponential(CHARGE_E, SHAPE), 0.0)
        frequency = np.abs(np.fft.rfftfreq(SHAPE[0], 1 / SHAPE[0]))
        self.slow = np.where(frequency > 0, np.maximum(frequency, 1.0) ** (-exponent / 2), 0.0)

    def rows(self, n):
        white = np.fft.rfft(self.rng.standard_normal((n, SHAPE[0])), axis=1)
        series = np.fft.irfft(white * self.slow, SHAPE[0], axis=1)
        return SLOW_E * series / np.sqrt((series**2).mean())

    def frames(self, n, light_e=0.0, exposure_s=0.0):
        charge_e = self.warm_e * (1 + self.growth * exposure_s) + light_e
        electrons = self.rng.poisson(charge_e, (n, *SHAPE)) + READ_E * self.rng.standard_normal((n, *SHAPE))
        return np.clip(np.rint(BLACK_DN + GAIN * (electrons + self.rows(n)[:, :, None])), 0, 65535).astype(np.uint16)

    def stack(self, dark_s=0.0, flats_s=(1.0, 4.0)):
        # Light falls to a hundredth in a corner: a spectrograph's slit, a small lens.
        y, x = np.meshgrid(np.linspace(0, 1, SHAPE[0]), np.linspace(0, 1, SHAPE[1]), indexing="ij")
        self.light_e = 8000 * np.clip(1.2 - np.hypot(x - 0.3, y - 0.4), 0.01, 1)
        lit = [self.frames(4, f * self.light_e, t) for f, t in zip((0.25, 1.0), flats_s, strict=True)]
        groups = [self.frames(8, exposure_s=dark_s), *lit]
        return hsnoise.FrameStack(
            groups, (dark_s, *flats_s), kind=("dark", "flat", "flat"), white_level=65535, shutter="global"
        )


@pytest.fixture(scope="module")
def ccd():
    sensor = Ccd()
    stack = sensor.stack()
    return sensor, stack, hsnoise.fit(stack)


def within(fit, name, truth, share=0.0):
    value, error, _ = fit.table[name]
    assert abs(value - truth) < max(4 * error, share * truth), f"{name}: {value} +- {error}, truth {truth}"


def test_darks_that_clip_a_little_leave_the_flats_their_gain(ccd):
    _, stack, fit = ccd
    assert 0.001 < np.mean([(frame == 0).mean() for frame in stack.frames(0)]) < 0.01
    within(fit, "gain", GAIN, 0.01)
    within(fit, "read_noise.sigma", READ_E, 0.01)


def test_warm_pixels_of_bias_frames_are_in_the_model(ccd):
    sensor, stack, fit = ccd
    within(fit, "hot_pixels.fraction", WARM, 0.1)
    within(fit, "hot_pixels.at_readout", CHARGE_E, 0.1)
    mean = np.mean([frame.mean() for frame in stack.frames(0)])
    charge = fit.table["hot_pixels.fraction"][0] * fit.table["hot_pixels.at_readout"][0]
    assert fit.table["black_level"][0] + GAIN * charge == pytest.approx(mean, abs=0.3)


def test_warm_pixels_whose_charge_does_not_grow_in_flats_are_charge_of_the_readout(ccd):
    _, _, fit = ccd
    assert float(fit.params["hot_pixels"].rate) == 0


@pytest.mark.parametrize(("dark_s", "at_readout_e"), [(0.0, CHARGE_E), (2.0, CHARGE_E)])
def test_flats_tell_how_the_charge_of_warm_pixels_grows(dark_s, at_readout_e):
    growth = 3.0
    fit = hsnoise.fit(Ccd(1, growth=growth).stack(dark_s))
    within(fit, "hot_pixels.rate", growth * CHARGE_E, 0.1)
    within(fit, "hot_pixels.at_readout", at_readout_e, 0.1)


def test_rows_that_are_not_white_have_an_exponent(ccd):
    _, _, fit = ccd
    within(fit, "row_noise.sigma", SLOW_E, 0.1)
    within(fit, "row_noise.exponent", 1.5)
    assert fit.table["row_noise.exponent"][1] < 0.5


def test_dim_corners_are_not_dead_and_pixels_that_see_nothing_are(ccd):
    sensor, _, _ = ccd
    blind = np.zeros(SHAPE, bool)
    blind[50, ::16], blind[:, -12:] = True, True  # among others that respond, and a stripe of overscan
    counts = [sensor.frames(4), sensor.frames(4, np.where(blind, 0.0, sensor.light_e))]
    found = flags_of(survey(hsnoise.FrameStack(counts, (0.0, 1.0), kind=("dark", "flat"))), 0) & FLAGS["dead"] > 0
    missed = blind & ~found.reshape(SHAPE) & (sensor.light_e > 300)
    assert missed[50].mean() < 0.01 and missed[:, -12:].mean() < 0.2
    assert (found.reshape(SHAPE) & ~blind).mean() < 0.002


def test_what_lies_beside_a_wide_overscan_is_not_dead():
    """Where most of a run of neighbours sees no light, the others do."""
    sensor, blind = Ccd(), np.zeros(SHAPE, bool)
    blind[:, -20:] = True
    counts = [sensor.frames(4), sensor.frames(4, np.where(blind, 0.0, 3000.0))]
    found = flags_of(survey(hsnoise.FrameStack(counts, (0.0, 1.0), kind=("dark", "flat"))), 0) & FLAGS["dead"] > 0
    assert (found.reshape(SHAPE) & ~blind).mean() < 0.002
    assert found.reshape(SHAPE)[blind].mean() > 0.95


@pytest.mark.parametrize(("exponent", "lag"), [(-1.0, 1), (0.5, 1), (2.0, 1), (0.5, 2), (2.0, 2)])
def test_exponent_of_a_correlation_is_that_of_the_spectrum(exponent, lag):
    n = 128
    power = np.array(fading_power(n, np.float32(exponent)), float)
    power[0] = 0
    correlation = float((power * np.cos(2 * np.pi * lag * np.arange(n) / n)).sum() / power.sum())
    assert exponent_of(correlation, n, lag) == pytest.approx(exponent, abs=0.01)


def test_exponent_of_what_no_power_law_reaches_is_at_a_bound():
    assert (exponent_of(-0.99, 64), exponent_of(1.0, 64)) == EXPONENTS


def test_offsets_with_tails_are_not_warm_pixels(rng):
    """They were `hot_pixels` with a rate, in green."""
    offset = 100 + 2 * rng.standard_t(4, (192, 256))
    frames = offset + 2 * rng.standard_normal((8, 192, 256))
    fit = hsnoise.fit(hsnoise.FrameStack([np.rint(frames).astype(np.uint16)], [1.0], shutter="global"))
    assert "hot_pixels" not in fit.params and "dark_signal_nonuniformity" in fit.params
