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
    reach = np.arcsinh(np.array([values.min(), values.max()]) / scale)
    edges = scale * np.sinh(np.linspace(reach[0] - 0.01, reach[1] + 0.01, BINS))
    atoms = scale * np.sinh(np.linspace(*reach, ATOMS))
    counts = np.histogram(values, edges)[0]
    below = ndtr((edges[:, None] - atoms) / sigma)
    inside = np.diff(below, axis=0) + 1e-12
    weight = np.full(ATOMS, 1 / ATOMS)
    for _ in range(STEPS):
        weight = weight * (counts / (inside @ weight) @ inside) / counts.sum()
    share = np.cumsum(weight) - weight / 2
    return np.interp(probabilities, share, atoms)
