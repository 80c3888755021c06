"""The distribution of what was added to normal noise, from their sum."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

BINS, ATOMS, STEPS = 601, 400, 80
WIDTH = 0.5  # of the normal noise, up to which bins are equal


def quantiles_beside_normal(values: np.ndarray, sigma: float, probabilities: np.ndarray) -> np.ndarray:
    """Quantiles at `probabilities` of x, where values are x + Normal(0, sigma^2).

    The distribution of x is free in shape: atoms on a grid, by maximum likelihood (the Richardson-Lucy iteration).
    """
    scale = WIDTH * sigma
    low, high = (float(np.arcsinh(end / scale)) for end in (values.min(), values.max()))
    edges = scale * np.sinh(np.linspace(low - 0.01, high + 0.01, BINS))
    atoms = scale * np.sinh(np.linspace(low, high, ATOMS))
    counts = np.histogram(values, edges)[0]
    below = ndtr((edges[:, None] - atoms) / sigma)
    inside = np.diff(below, axis=0) + 1e-12
    weight = np.full(ATOMS, 1 / ATOMS)
    for _ in range(STEPS):
        weight = weight * (counts / (inside @ weight) @ inside) / counts.sum()
    share = np.cumsum(weight) - weight / 2
    return np.interp(probabilities, share, atoms)
