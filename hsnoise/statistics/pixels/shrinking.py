"""Maps without the noise of their estimation: each pixel is drawn from its posterior.

A map with the noise of its estimation is too rough, and the mean of the posterior is too smooth; a draw from the
posterior has the true spread (Louis, "Estimating a population of parameter values using Bayes and empirical Bayes
methods", JASA 79, 1984). The distribution of true values over pixels is free in shape: weights on a grid, by maximum
likelihood (Laird, "Nonparametric maximum likelihood estimation of a mixing distribution", JASA 73, 1978).
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import zoom
from scipy.stats import chi2

BLOCK = 16  # side in pixels over which the level of a map is smooth
NEAR = 10.0  # errors from its surroundings, beyond which a pixel keeps its measured value
BIN, SPACING, GRID = 0.05, 0.1, 120  # in errors; points of the grid of variances
LEAST_ERROR = 0.1  # of the expected one
STEPS = 100  # of expectation and maximisation
RARE = 1e-3  # initial weight of values anywhere
WIDEST = 12.0  # of the logarithm of a variance, beyond the typical one
LEAST_RATIO = 1e-3  # of variances
TINY = 1e-12
CORE = (0.1587, 0.5, 0.8413)  # quantiles at one standard deviation


def surroundings(values: np.ndarray) -> np.ndarray:
    """The smooth part of a map [row, column]: medians of blocks, interpolated."""
    return _interpolated(_medians(values), values.shape)


def _medians(values: np.ndarray) -> np.ndarray:
    blocks = values
    for axis, size in enumerate(values.shape):
        parts = np.array_split(blocks, max(1, size // BLOCK), axis=axis)
        blocks = np.concatenate([np.median(part, axis=axis, keepdims=True) for part in parts], axis=axis)
    return blocks


def _interpolated(blocks: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    factors = [size / of for size, of in zip(shape, blocks.shape, strict=True)]
    return zoom(blocks, factors, order=1, mode="nearest", grid_mode=True)


def surroundings_from_posterior(estimate: np.ndarray, halves: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The smooth part of a map [row, column] drawn from its posterior, scale by scale; its mean stays.

    halves [half, row, column]: as in `values_from_posterior`.
    """
    blocks = _medians(estimate)
    power = dctn(blocks, norm="ortho")
    one, two = (dctn(_medians(half), norm="ortho") for half in halves)
    scale = np.ceil(np.log2(1 + np.hypot(*np.indices(power.shape)))).astype(int)  # octaves of cycles over the map
    counts = np.bincount(scale.ravel())
    prior, error = (np.bincount(scale.ravel(), of.ravel()) / counts for of in (one * two, (one - two) ** 2 / 4))
    share = (np.maximum(prior, 0) / (np.maximum(prior, 0) + error + TINY))[scale]
    share[0, 0] = 1.0
    noise = rng.standard_normal(power.shape) * np.sqrt(share * error[scale])
    noise[0, 0] = 0.0
    return _interpolated(idctn(share * power + noise, norm="ortho"), estimate.shape)


def values_from_posterior(
    estimate: np.ndarray, halves: np.ndarray, error: float, rng: np.random.Generator
) -> np.ndarray:
    """True values of pixels [row, column] drawn from their posterior.

    Args:
        estimate: measured; halves [half, row, column]: from two halves of the frames, whose covariance is free of the
            noise of estimation.
        error: expected variance of the errors; a pixel farther than NEAR errors from its surroundings keeps its value.
    """
    even = surroundings(estimate)
    is_near = np.abs(estimate - even) < NEAR * np.sqrt(error)
    local, (a, b) = (estimate - even)[is_near], (halves - even)[:, is_near]
    width = NEAR * np.sqrt(2 * error)
    spread = max(float(np.mean(np.clip(a, -width, width) * np.clip(b, -width, width))), 0.0)
    # Any difference between these pixels beyond that is error, whatever its cause.
    sigma = np.sqrt(max(float(np.mean(local**2)) - spread, LEAST_ERROR * error))
    edges = np.arange(-NEAR, NEAR + BIN, BIN) * np.sqrt(error) / sigma
    grid = np.arange(edges[0], edges[-1], SPACING)
    grid -= grid[np.argmin(np.abs(grid))]
    first = np.exp(-0.5 * (grid * sigma) ** 2 / (spread + TINY)) + RARE / len(grid)
    middle = (edges[1:] + edges[:-1]) / 2
    drawn = _drawn(local / sigma, edges, grid, -0.5 * (middle[:, None] - grid) ** 2, first, rng)
    found = estimate.copy()
    found[is_near] = surroundings_from_posterior(estimate, halves, rng)[is_near] + sigma * drawn
    return found


def variances_from_posterior(ratio: np.ndarray, dof: int, rng: np.random.Generator) -> np.ndarray:
    """True variances of pixels drawn from their posterior, given measured ones of `dof` degrees of freedom."""
    y = np.log(np.maximum(ratio, LEAST_RATIO))
    high = max(min(y.max(), np.median(y) + WIDEST), y.min() + LEAST_RATIO)
    edges, grid = np.linspace(y.min(), high, 4 * GRID + 1), np.linspace(y.min() / 2, high, GRID)
    off = ((edges[1:] + edges[:-1]) / 2)[:, None] - grid
    # The widths of the cores: measured, and by chance.
    core, chance = (np.quantile(y, CORE), np.log(chi2.ppf(CORE, dof) / dof))
    spread = max((np.ptp(core[[0, 2]]) ** 2 - np.ptp(chance[[0, 2]]) ** 2) / 4, 0.0)
    first = np.exp(-0.5 * (grid - core[1] + chance[1]) ** 2 / (spread + (grid[1] - grid[0]) ** 2)) + RARE / GRID
    return np.exp(_drawn(np.clip(y, y.min(), high), edges, grid, dof / 2 * (off - np.exp(off)), first, rng))


def _drawn(values, edges, grid, log_density, weight, rng) -> np.ndarray:
    """True values on a grid, given measured ones and the density [bin, grid] of a measured value at each true one."""
    place = np.clip(np.searchsorted(edges, values) - 1, 0, len(edges) - 2)
    counts = np.bincount(place.ravel(), minlength=len(edges) - 1)
    density = np.exp(log_density - log_density.max(1, keepdims=True)) + TINY
    for _ in range(STEPS):
        posterior = density * weight
        posterior /= posterior.sum(1, keepdims=True)
        weight = counts @ posterior / counts.sum()
    # One rising sequence: the distribution function of bin b runs from b to b + 1.
    cumulative = np.minimum(np.cumsum(posterior, axis=1), 1) + np.arange(len(posterior))[:, None]
    chosen = np.searchsorted(cumulative.ravel(), place + rng.random(place.shape)) - place * len(grid)
    step = grid[1] - grid[0]
    return grid[np.clip(chosen, 0, len(grid) - 1)] + step * (rng.random(place.shape) - 0.5)
