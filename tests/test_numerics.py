"""The law of Poisson plus normal against sums of scipy's laws."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise.likelihood.poisson_normal import SADDLE_FROM, SADDLE_TO, bin_probability, distribution, poisson_normal_law


@jax.jit  # one program, not one for each operation
def compiled(mean_e, sigma_e, edges):
    return bin_probability(*distribution(0, edges, mean_e, sigma_e, poisson_normal_law(mean_e, sigma_e)))


def probabilities(mean_e, sigma_e, edges):
    return np.asarray(compiled(jnp.float64(mean_e), jnp.float64(sigma_e), jnp.asarray(edges)))


def brute_force(mean_e, sigma_e, edges):
    spread = np.sqrt(mean_e + sigma_e**2)
    k = np.arange(max(0, int(mean_e - 12 * spread)), int(mean_e + 14 * spread) + 30)
    pmf = stats.poisson.pmf(k, mean_e)
    below = (pmf * stats.norm.cdf((edges[:, None] - k) / sigma_e)).sum(1)
    above = (pmf * stats.norm.sf((edges[:, None] - k) / sigma_e)).sum(1)
    inner = np.where(below[1:] < 0.5, np.diff(below), -np.diff(above))
    return np.concatenate([below[:1], inner, above[-1:]])


@pytest.mark.parametrize(
    ("mean_e", "sigma_e", "tolerance"),
    [
        (0.0, 2.0, 1e-6),
        (1e-3, 0.3, 1e-5),
        (1.03, 3.54, 1e-6),
        (10.3, 3.54, 1e-6),
        (3.0, 0.4, 1e-4),  # single electrons resolved
        (44.0, 2.0, 1e-6),
        (52.0, 2.0, 1e-5),  # the sum hands over to the saddle point
        (61.0, 2.0, 1e-5),
        (1000.0, 5.0, 1e-6),
        (1e4, 2.0, 1e-6),
    ],
)
def test_bins_match_the_sum_of_scipy_laws(mean_e, sigma_e, tolerance):
    spread = np.sqrt(mean_e + sigma_e**2)
    edges = np.arange(mean_e - 7.5 * spread, mean_e + 8 * spread, spread / 3.3)
    ours, exact = probabilities(mean_e, sigma_e, edges), brute_force(mean_e, sigma_e, edges)
    likely = exact > 1e-7
    np.testing.assert_allclose(ours[likely], exact[likely], rtol=tolerance)
    np.testing.assert_allclose(ours.sum(), 1.0, atol=1e-12)
    assert (ours >= 0).all()


def test_bins_wider_than_the_law_take_all_of_it():
    edges = np.array([-1e4, -500.0, 500.0, 1e4])
    np.testing.assert_allclose(probabilities(5.0, 2.0, edges), [0, 0, 1, 0, 0], atol=1e-15)


@pytest.mark.parametrize("boundary", [SADDLE_FROM, SADDLE_TO])
def test_the_change_of_method_leaves_no_step(boundary):
    edges = np.arange(boundary - 40, boundary + 40, 2.0)
    step = 1e-6
    below, above = (probabilities(boundary + s, 3.0, edges) for s in (-step, step))
    likely = below > 1e-8
    slope = np.abs(np.log(above[likely] / below[likely])).max()
    assert slope < 20 * step  # d log P / d mean is at most a few standard deviations over the spread


@pytest.mark.parametrize("mean_e", [52.0, *(pytest.param(mean, marks=pytest.mark.slow) for mean in (2.0, 300.0))])
def test_derivatives_match_differences_of_the_exact_law(mean_e):
    x = np.linspace(mean_e - 15, mean_e + 15, 7)

    def ours(mean, sigma, x):
        h, side = distribution(0, x, mean, sigma, poisson_normal_law(mean, sigma))
        return h + side

    def exact(mean, sigma, x):
        return np.cumsum(brute_force(mean, sigma, x))[:-1]

    args = jnp.float64(mean_e), jnp.float64(3.0), jnp.asarray(x)
    slopes = jax.jit(jax.jacfwd(ours, argnums=(0, 1, 2)))(*args)
    step = 1e-4
    for i, argument in enumerate((mean_e, 3.0)):
        d_ours = np.asarray(slopes[i])
        shifted = [[mean_e, 3.0], [mean_e, 3.0]]
        shifted[0][i], shifted[1][i] = argument - step, argument + step
        d_exact = (exact(*shifted[1], x) - exact(*shifted[0], x)) / (2 * step)
        np.testing.assert_allclose(d_ours, d_exact, atol=2e-7)
    density = (exact(mean_e, 3.0, x + step) - exact(mean_e, 3.0, x - step)) / (2 * step)
    np.testing.assert_allclose(np.diagonal(slopes[2]), density, atol=2e-7)
    second = jax.jit(jax.jacfwd(jax.jacrev(ours, argnums=0), argnums=0))(*args)
    assert np.isfinite(np.asarray(second)).all()
