"""Laws of a gain register: mean, excess noise, third moment, clock-induced charge; the same on a real EMCCD."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy import stats

from hsnoise.effects import Crosstalk, DarkCurrent, ElectronMultiplication, HotPixels, ReadNoise, ShotNoise
from hsnoise.model import NoiseModel, sample, sample_dark

KEY = jax.random.key(37)
P_VALUE = 1e-5
ELECTRONS_PER_DN = 3.859  # of the real EMCCD without multiplication
GAIN_ERROR = 0.015  # relative: six levels of light give 3.78 to 3.92


def mono(*effects):
    return NoiseModel(effects, cfa="mono", shutter="global", exposure_s=1.0)


@pytest.mark.parametrize("multiplication", [1.25, 5.0, 300.0])
@pytest.mark.parametrize("n", [1, 40])
def test_electrons_become_gamma_distributed(n, multiplication):
    excess = 1 - 1 / multiplication
    drawn = np.ravel(sample(KEY, np.full((1, 200, 200), float(n)), mono(ElectronMultiplication(excess))))
    assert drawn.min() >= n / multiplication * (1 - 1e-9)
    assert stats.kstest(drawn - n * (1 - excess), stats.gamma(excess * n).cdf).pvalue > P_VALUE


def test_one_electron_is_exponential_in_the_limit_and_none_is_none():
    drawn = np.ravel(sample(KEY, np.full((1, 100, 100), 1.0), mono(ElectronMultiplication(1.0))))
    assert stats.kstest(drawn, "expon").pvalue > P_VALUE
    assert not np.any(sample_dark(KEY, 2, (20, 20), mono(ElectronMultiplication(1.0))))


@pytest.mark.parametrize("excess", [0.0, 0.5, 1.0])
def test_shot_noise_has_the_excess_noise_factor(excess):
    """The third moment of Poisson numbers of them is 1 + 5 e times their mean: 6, not 4 as of a gain of 2."""
    mean = 3.0
    drawn = np.ravel(sample(KEY, np.full((8, 100, 100), mean), mono(ShotNoise(), ElectronMultiplication(excess))))
    off = drawn - drawn.mean()
    for power, expected in ((2, (1 + excess) * mean), (3, (1 + 5 * excess) * mean)):
        error = np.std(off**power) / np.sqrt(off.size)
        assert abs(np.mean(off**power) - expected) < 5 * error
    assert abs(drawn.mean() - mean) < 5 * np.sqrt((1 + excess) * mean / off.size)


def test_clocks_add_electrons_whatever_the_exposure():
    model = mono(ElectronMultiplication(0.9, 0.05))
    for exposure_s in (0.0, 10.0):
        drawn = np.ravel(sample_dark(KEY, 4, (100, 100), model, exposure_s=exposure_s))
        assert abs(drawn.mean() - 0.05) < 5 * np.sqrt(1.9 * 0.05 / drawn.size)
        assert abs(np.mean(drawn > 0) - (1 - np.exp(-0.05))) < 5 * np.sqrt(0.05 / drawn.size)


def test_it_multiplies_all_electrons_and_no_read_noise():
    """Whatever the order in which they were added."""
    effects = [ShotNoise(), DarkCurrent(4.0), ReadNoise(3.0), ElectronMultiplication(1.0), HotPixels(0.1, 9.0)]
    model = mono(*effects, Crosstalk(0.01))
    assert model.names[-2:] == ("electron_multiplication", "read_noise")
    drawn, electrons = (
        np.asarray(sample_dark(KEY, 4, (60, 60), one, sensor_key=KEY)) for one in (model, model.remove("read_noise"))
    )
    assert electrons.min() >= 0
    assert stats.kstest(np.ravel(drawn - electrons) / 3.0, "norm").pvalue > P_VALUE


@pytest.mark.slow
def test_draws_do_not_depend_on_the_batch():
    model, light = mono(ShotNoise(), ElectronMultiplication(0.99, 0.1)), np.full((6, 20, 30), 2.0)
    whole = sample(KEY, light, model)
    np.testing.assert_array_equal(sample(KEY, light[:2], model), whole[:2])


def above_dark(shared_data, name, dark):
    """Counts of a real EMCCD in constant light [frame, row, column] above the dark level, and its read noise, DN."""
    with np.load(shared_data / "data" / "emccd_lanl.npz") as arrays:
        return arrays[name] - arrays[f"{dark}_no_signal_S0"].astype(float), arrays[f"{dark}_no_signal_sigma"]


@pytest.mark.parametrize("setting", [5, 25, 100, 300])
def test_variance_over_mean_of_a_real_register(shared_data, setting):
    light, _ = above_dark(shared_data, "gain_GS_1x_gain", "gain_GS_1x_gain")
    counts, read_noise = above_dark(shared_data, f"gain_GS_{setting}x_gain", f"gain_GS_{setting}x_gain")
    multiplication = counts.mean() / light.mean()
    gain, excess = multiplication / ELECTRONS_PER_DN, 1 - 1 / multiplication  # DN/e- at the input

    factor = (counts.var(0, ddof=1) - read_noise**2) / counts.mean(0) / gain
    error = np.hypot(factor.std(ddof=1) / np.sqrt(factor.size), GAIN_ERROR * factor.mean())
    assert abs(factor.mean() - (1 + excess)) < 3 * error

    model = mono(ShotNoise(), ElectronMultiplication(excess), ReadNoise(read_noise.mean() / gain))
    drawn = gain * np.asarray(sample(KEY, np.broadcast_to(counts.mean(0) / gain, counts.shape), model))
    ratio = drawn.var(0, ddof=1).mean() / counts.var(0, ddof=1).mean()
    assert abs(ratio - 1) < 3 * np.hypot(GAIN_ERROR, np.sqrt(2 * 2 / counts.size))


@pytest.mark.parametrize("level", [1, 2, 3])
def test_the_shape_of_a_real_register_is_not_that_of_a_gain(shared_data, level):
    """20 to 66 electrons. Both models have the mean and the variance of the counts: skewness tells them apart."""
    counts, read_noise = above_dark(shared_data, f"gain_IS_100x_gain_level_0{level}", "gain_IS_100x_gain")
    electrons_dn2, excess = (counts.var(0, ddof=1) - read_noise**2).mean(), 1 - 1 / 90.1
    skewness = []
    for factor, effects in ((1 + excess, [ElectronMultiplication(excess)]), (1.0, [])):
        gain = electrons_dn2 / counts.mean() / factor
        model = mono(ShotNoise(), *effects, ReadNoise(read_noise.mean() / gain))
        drawn = np.asarray(sample(KEY, np.full(counts.shape, counts.mean() / gain), model))
        skewness.append(stats.skew(drawn.ravel()))
    measured = stats.skew(counts.reshape(len(counts), -1)).mean()
    error = np.sqrt(2 * 6 / counts.size)  # of measured less drawn
    assert abs(measured - skewness[0]) < 4 * error < abs(measured - skewness[1])
