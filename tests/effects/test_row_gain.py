"""Law of the row gains: spectrum, variance, colours, frames."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise.effects import RowGain
from hsnoise.likelihood import rows as rows_module
from hsnoise.model import NoiseModel, sample

KEY = jax.random.key(13)
FRAMES, ROWS = 400, 64
P_VALUE = 1e-5


def beta(sigma, exponent, white_share=0.0, *, cfa="mono", shutter="rolling", rows=ROWS, frames=FRAMES):
    """Row gains [frame, row, column] that a uniform signal of 1 shows."""
    model = NoiseModel([RowGain(sigma, exponent, white_share)], cfa=cfa, shutter=shutter, exposure_s=0.05)
    return np.asarray(sample(KEY, np.ones((frames, rows, 2)), model))


def powers(exponent, rows=ROWS):
    """Power of each Fourier bin in units of sigma^2, by the definition: sum 1, none at DC."""
    k = np.minimum(np.arange(1, rows), rows - np.arange(1, rows))
    power = np.concatenate([[0.0], k**-exponent])
    return power / power.sum()


def bins(series):
    """Mean power of each bin [frame, k], k = 0 ... rows/2, so that all rows bins sum to the mean square."""
    return np.abs(np.fft.rfft(series, axis=1) / series.shape[1]) ** 2


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("rows", [64, 63])
def test_rolling_spectrum_is_the_power_law(exponent, rows):
    drawn = bins(beta(0.05, exponent, rows=rows)[:, :, 0] - 1)
    expected = 0.05**2 * powers(exponent, rows)[: rows // 2 + 1]
    np.testing.assert_allclose(drawn[:, 0], 0, atol=1e-20)
    relative = drawn[:, 1:] / expected[1:]
    inner = relative[:, : (rows - 1) // 2]
    assert stats.kstest(inner.ravel(), "expon").pvalue > P_VALUE
    z = (inner.mean(0) - 1) * np.sqrt(FRAMES)
    assert stats.chi2.sf(np.sum(z**2), len(z)) > P_VALUE
    if rows % 2 == 0:  # the bin at rows/2 is real
        assert stats.kstest(relative[:, -1], stats.chi2(1).cdf).pvalue > P_VALUE


@pytest.mark.parametrize("exponent", [0.5, 1.0])
def test_spectral_slope_is_the_exponent(exponent):
    mean_power = bins(beta(0.05, exponent)[:, :, 0] - 1)[:, 1 : ROWS // 2].mean(0)
    log_k = np.log(np.arange(1, ROWS // 2))
    centred = log_k - log_k.mean()
    slope = centred @ np.log(mean_power) / (centred @ centred)
    assert abs(slope + exponent) < 5 / np.sqrt(FRAMES * (centred @ centred))


@pytest.mark.parametrize(("exponent", "shutter"), [(1.0, "rolling"), (2.0, "rolling"), (0.0, "global")])
def test_variance_over_rows_is_sigma_squared_on_average(exponent, shutter):
    variance = np.mean((beta(0.1, exponent, shutter=shutter)[:, :, 0] - 1) ** 2, axis=1)
    assert abs(variance.mean() - 0.01) < 5 * variance.std() / np.sqrt(FRAMES)
    # The variance of one frame fluctuates as independent bins make it: 2 sum of power^2.
    white = shutter == "global"
    expected = 0.01**2 * 2 * np.sum((np.full(ROWS, 1 / ROWS) if white else powers(exponent)) ** 2)
    squares = (variance - 0.01) ** 2
    assert abs(squares.mean() - expected) < 5 * squares.std() / np.sqrt(FRAMES)


@pytest.mark.parametrize(
    ("exponent", "white_share", "shutter"), [(0.0, 0.0, "global"), (1.0, 0.3, "global"), (1.0, 1.0, "rolling")]
)
def test_white_rows_are_independent_normals(exponent, white_share, shutter):
    z = (beta(0.1, exponent, white_share, shutter=shutter)[:, :, 0] - 1) / 0.1
    assert stats.kstest(z.ravel(), "norm").pvalue > P_VALUE
    assert abs(np.mean(z[:, 1:] * z[:, :-1])) < 5 / np.sqrt(z.size)
    # With its DC term: the mean of a frame is Normal(1, sigma^2 / rows).
    assert stats.kstest(z.mean(1) * np.sqrt(ROWS), "norm").pvalue > P_VALUE


def test_negative_gains_are_zero():
    z = (beta(0.5, 0.0, shutter="global")[:, :, 0] - 1) / 0.5
    dark = np.mean(z == -2.0)
    expected = stats.norm.cdf(-2.0)
    assert z.min() == -2.0
    assert abs(dark - expected) < 5 * np.sqrt(expected / z.size)


def test_a_colour_has_one_gain_in_a_row():
    drawn = beta([0.1, 0.2, 0.3], 1.0, cfa="GRBG", frames=2)
    model = NoiseModel([RowGain([0.1, 0.2, 0.3], 1.0)], cfa="GRBG", shutter="rolling", exposure_s=0.05)
    wide = np.asarray(sample(KEY, np.ones((2, ROWS, 6)), model))
    np.testing.assert_array_equal(wide, np.tile(drawn, (1, 1, 3)))
    assert np.all(drawn[:, :, 0] != drawn[:, :, 1])


def test_red_uses_every_other_row_of_a_series_over_all_rows():
    red = beta([0.05, 0.1, 0.2], 1.0, cfa="RGGB")[:, ::2, 0] - 1
    half = ROWS // 2
    # Every other row folds the spectrum: bin k gets k and k + rows/2 of the whole series; DC gets rows/2.
    folded = 0.05**2 * (powers(1.0)[:half] + powers(1.0)[half:])[: half // 2 + 1]
    relative = bins(red) / folded
    assert stats.kstest(relative[:, 1:-1].ravel(), "expon").pvalue > P_VALUE
    assert stats.kstest(relative[:, 0], stats.chi2(1).cdf).pvalue > P_VALUE
    assert stats.kstest(relative[:, -1], stats.chi2(1).cdf).pvalue > P_VALUE


def test_both_greens_use_one_series():
    drawn = beta([0.05, 0.1, 0.2], 1.0, cfa="RGGB")
    green = np.where(np.arange(ROWS) % 2, drawn[:, :, 0], drawn[:, :, 1]) - 1
    relative = bins(green)[:, 1 : ROWS // 2] / (0.1**2 * powers(1.0)[1 : ROWS // 2])
    assert stats.kstest(relative.ravel(), "expon").pvalue > P_VALUE


def test_colours_and_frames_are_independent():
    drawn = (beta([0.1, 0.1, 0.1], 0.0, cfa="RGGB", shutter="global") - 1) / 0.1
    products = {
        "red and green of a row": drawn[:, ::2, 0] * drawn[:, ::2, 1],
        "green and blue of a row": drawn[:, 1::2, 0] * drawn[:, 1::2, 1],
        "neighbouring frames": drawn[1:] * drawn[:-1],
        "red and blue of neighbouring rows": drawn[:, ::2, 0] * drawn[:, 1::2, 1],
    }
    for name, product in products.items():
        assert abs(product.mean()) < 5 / np.sqrt(product.size / 2), name


def test_exponent_has_the_gradient_of_finite_differences():
    def energy(exponent):
        model = NoiseModel([RowGain(0.05, exponent)], cfa="mono", shutter="rolling", exposure_s=0.05)
        return jnp.sum(jnp.sin(40 * sample(KEY, np.ones((1, 16, 2)), model)))

    step = 1e-5
    difference = (energy(1.0 + step) - energy(1.0 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(energy)(1.0), difference, rtol=1e-6)


def test_a_single_rolling_row_has_gain_one():
    np.testing.assert_array_equal(beta(0.1, 1.0, rows=1, frames=3), 1.0)


LAWS = [*((exponent, 0.0) for exponent in (0.0, 0.05, 0.2, 0.29, 0.31, 0.5, 1.0)), (1.0, 0.3), (0.5, 0.9), (0.0, 0.4)]


@pytest.mark.parametrize(("exponent", "white_share"), LAWS)
@pytest.mark.parametrize("stride", [1, 2])
def test_draws_have_the_spectrum_of_the_likelihood(exponent, white_share, stride):
    """Each bin, DC too; of all rows, and of a colour that has every second one."""
    drawn = (beta(0.05, exponent, white_share)[:, ::stride, 0] - 1) / 0.05
    n = ROWS // stride
    expected = np.asarray(rows_module.row_spectrum(jnp.float64(exponent), ROWS, stride, white_share))[: n // 2 + 1]
    power = np.abs(np.fft.rfft(drawn, axis=1)) ** 2 / n
    if stride == 1:
        stated = (1 - white_share) * ROWS * powers(exponent) + white_share
        np.testing.assert_allclose(expected, stated[: n // 2 + 1], atol=1e-12)
    if expected[0] == 0:
        np.testing.assert_allclose(power[:, 0], 0, atol=1e-20)
        power, expected = power[:, 1:], expected[1:]
    degrees = np.full(len(expected), 2)
    degrees[-1] = 1  # the bins at DC and n/2 are real
    degrees[0] = 1 if len(expected) > n // 2 else 2
    z = ((power / expected).mean(0) - 1) / np.sqrt(2 / degrees / FRAMES)
    assert stats.chi2.sf(np.sum(z**2), len(z)) > P_VALUE
    assert np.abs(z).max() < 5


@pytest.mark.parametrize("white_share", [0.0, 0.3])
def test_white_share_has_the_gradient_of_finite_differences(white_share):
    def energy(share, exponent=1.0):
        model = NoiseModel([RowGain(0.05, exponent, share)], cfa="mono", shutter="rolling", exposure_s=0.05)
        return jnp.sum(jnp.sin(40 * sample(KEY, np.ones((1, 16, 2)), model)))

    assert np.isfinite(jax.grad(energy, argnums=1)(white_share, 1.0))
    if white_share:
        difference = (energy(white_share + 1e-5) - energy(white_share - 1e-5)) / 2e-5
        np.testing.assert_allclose(jax.grad(energy)(white_share), difference, rtol=1e-6)
