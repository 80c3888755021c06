"""Safe mathematics for the likelihood: the distribution of Poisson plus normal, quadrature weights.

Everything here is meant to run in float64 (callers enable it locally) and differentiates once and twice.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln

GRID_POINTS = 1024  # electron grid of the distribution; 0.018 standard deviations apart
GRID_HALF_WIDTH = 9.0  # standard deviations; beyond lies 2e-19 of a normal distribution
EXTRA_E = 4.0
SUM_TERMS = 128  # terms of the sum over photoelectrons: lambda + 9 sqrt(lambda) at lambda = 60
SADDLE_FROM, SADDLE_TO = 45.0, 60.0  # the sum hands over to the saddle-point density between these means


def _density_sum(x, mean_e, sigma_e):
    """Density of Poisson(mean_e) + Normal(0, sigma_e^2) and its derivative, as the sum over electrons."""
    k = jnp.arange(SUM_TERMS, dtype=x.dtype)
    log_pmf = k * jnp.log(jnp.maximum(mean_e, 1e-300)) - mean_e - gammaln(k + 1)
    u = (x[:, None] - k[None, :]) / sigma_e
    term = jnp.exp(log_pmf[None, :] - 0.5 * u * u)
    norm = 1.0 / (sigma_e * jnp.sqrt(2 * jnp.pi))
    return norm * term.sum(1), -norm / sigma_e * (u * term).sum(1)


def _log_density_saddle(x, mean_e, sigma_e):
    """Saddle-point log density with its first correction (Daniels 1954); relative error O(mean_e^-2)."""
    variance = sigma_e**2

    def newton(s):
        rate = mean_e * jnp.exp(s)
        return s - (rate + variance * s - x) / (rate + variance)

    start = jnp.where(x > mean_e, jnp.log(jnp.maximum(x, mean_e) / mean_e), (x - mean_e) / (mean_e + variance))
    # The equation is convex and increasing; from the right of the root Newton descends to it.
    s = jax.lax.fori_loop(0, 40, lambda _, v: newton(v), start)
    rate = mean_e * jnp.exp(s)
    curvature = rate + variance
    correction = rate / curvature**2 / 8 - 5 * rate**2 / curvature**3 / 24
    log_density = rate - mean_e + 0.5 * variance * s**2 - s * x - 0.5 * jnp.log(2 * jnp.pi * curvature)
    # d/dx of the leading terms: ds/dx = 1 / curvature.
    slope = -s - 0.5 * rate / curvature**2
    slope += rate / curvature**3 * (1 / 8 - 2 * rate / curvature / 8 - 10 * rate / curvature / 24)
    slope += 15 * rate**3 / curvature**5 / 24
    return log_density + jnp.log1p(correction), slope


def poisson_normal_law(mean_e, sigma_e):
    """Distribution function of Poisson(mean_e) + Normal(0, sigma_e^2) on a grid, for `distribution`.

    Below a mean of 45 electrons the exact sum, above 60 the saddle point, in between a smooth mixture of both.
    Returns `(origin, step, nodes)`: `nodes[i] = (H, density, slope, side)` at `origin + i * step`. Left of the
    median (side 0) H is the distribution function, right of it (side 1) minus the survival function, so that
    differences on one side keep their relative precision in the tail. H + side is the distribution function.
    """
    mean_e, sigma_e = jax.lax.stop_gradient((mean_e, sigma_e))  # see `distribution`
    spread = jnp.sqrt(mean_e + sigma_e**2)
    # A Poisson's right tail is heavier than a normal's: the grid reaches a few electrons further there.
    step = (2 * GRID_HALF_WIDTH * spread + EXTRA_E) / (GRID_POINTS - 1)
    origin = mean_e - GRID_HALF_WIDTH * spread
    x = origin + step * jnp.arange(GRID_POINTS, dtype=jnp.result_type(mean_e, sigma_e))
    few = jnp.minimum(mean_e, SADDLE_TO)
    many = jnp.maximum(mean_e, SADDLE_FROM)
    density_few, slope_few = _density_sum(x, few, sigma_e)
    # The grid is placed for mean_e; where only the sum counts, the saddle's argument is moved with its mean.
    log_many, log_slope = _log_density_saddle(x + (many - mean_e), many, sigma_e)
    density_many = jnp.exp(log_many)
    t = jnp.clip((mean_e - SADDLE_FROM) / (SADDLE_TO - SADDLE_FROM), 0.0, 1.0)
    weight = t * t * t * (10 - 15 * t + 6 * t * t)
    density = (1 - weight) * density_few + weight * density_many
    slope = (1 - weight) * slope_few + weight * density_many * log_slope
    cell = 0.5 * step * (density[1:] + density[:-1]) + step**2 / 12 * (slope[:-1] - slope[1:])
    total = cell.sum()
    zero = jnp.zeros(1, x.dtype)
    below = jnp.concatenate([zero, jnp.cumsum(cell)]) / total
    above = jnp.concatenate([jnp.cumsum(cell[::-1])[::-1], zero]) / total
    side = below >= 0.5
    signed = jnp.where(side, -above, below)
    return origin, step, jnp.stack([signed, density / total, slope / total, side.astype(x.dtype)], axis=-1)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def distribution(order: int, x, mean_e, sigma_e, law):
    """H, or for order n > 0 the n-th derivative of the distribution function, at `x` (any shape), and the side.

    Quintic Hermite interpolation of `law = poisson_normal_law(mean_e, sigma_e)`; 0 outside its grid. The
    derivatives are exact, not of the table: G_mean(x) = G(x - 1) - G(x) and G_sigma(x) = sigma G''(x), which spares
    the derivative of the table.
    """
    origin, step, nodes = law
    last = nodes.shape[0] - 1
    position = (x - origin) / step
    index = jnp.clip(jnp.floor(position), 0, last - 1).astype(jnp.int32)
    s = jnp.clip(position - index, 0.0, 1.0)
    left, right = nodes[index], nodes[index + 1]
    h0 = left[..., 0]
    d0, d1 = step * left[..., 1], step * right[..., 1]
    c0, c1 = step**2 * left[..., 2], step**2 * right[..., 2]
    # In the one cell that holds the median the right end is brought to the left end's side.
    rise = right[..., 0] + (right[..., 3] - left[..., 3]) - h0
    coefficients = [
        h0,
        d0,
        0.5 * c0,
        10 * rise - 6 * d0 - 4 * d1 - 1.5 * c0 + 0.5 * c1,
        -15 * rise + 8 * d0 + 7 * d1 + 1.5 * c0 - c1,
        6 * rise - 3 * d0 - 3 * d1 - 0.5 * c0 + 0.5 * c1,
    ]
    for _ in range(order):
        coefficients = [k * a / step for k, a in enumerate(coefficients)][1:]
    value = coefficients[-1]
    for a in coefficients[-2::-1]:
        value = a + s * value
    outside = (position <= 0) | (position >= last)
    side = jnp.where(position >= last, 1.0, jnp.where(position <= 0, 0.0, left[..., 3]))
    return jnp.where(outside, 0.0, value), side


@distribution.defjvp
def _distribution_jvp(order, primals, tangents):
    x, mean_e, sigma_e, law = primals
    dx, dmean, dsigma, _ = tangents
    value, side = distribution(order, x, mean_e, sigma_e, law)
    before, side_before = distribution(order, x - 1, mean_e, sigma_e, law)
    jump = side_before - side if order == 0 else 0.0
    slope, _ = distribution(order + 1, x, mean_e, sigma_e, law)
    bend, _ = distribution(order + 2, x, mean_e, sigma_e, law)
    tangent = slope * dx + (before - value + jump) * dmean + sigma_e * bend * dsigma
    return (value, side), (tangent, jnp.zeros_like(side))


def bin_probability(h, side):
    """Probabilities of bins from H and side at the inner edges `[..., bins - 1]`; the end bins take the tails."""
    shape, dtype = h.shape[:-1] + (1,), h.dtype
    h = jnp.concatenate([jnp.zeros(shape, dtype), h, jnp.zeros(shape, dtype)], axis=-1)
    side = jnp.concatenate([jnp.zeros(shape, dtype), side, jnp.ones(shape, dtype)], axis=-1)
    return jnp.clip(h[..., 1:] - h[..., :-1] + (side[..., 1:] - side[..., :-1]), 0.0, 1.0)
